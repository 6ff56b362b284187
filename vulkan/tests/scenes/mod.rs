//! Small scenes for the numerical cases, and the twin's answer to them.
#![allow(dead_code, reason = "each test binary uses its own part")]

pub mod device;

use glam::{DQuat, DVec3};
use models::camera::{Intrinsics, Pose, View};
use models::cloud::{GaussianCloud, SH_C0};
use rand::{Rng, SeedableRng};
use rand_pcg::Pcg64Mcg;

use config::training::LossSettings;
use vulkan::twin::camera::Camera;
use vulkan::twin::gaussian::Gaussian;
use vulkan::twin::loss::{Exposure, Target};
use vulkan::twin::project::{Culled, Limits};
use vulkan::twin::rasterise::Pixel;
use vulkan::twin::step::{ViewGradient, backward, forward};

/// A camera at the origin that looks along +z, principal point off centre.
pub fn view(width: u32, height: u32) -> View {
    let f = 1.1 * width.max(height) as f32;
    let intrinsics =
        Intrinsics { width, height, fx: f, fy: 1.05 * f, cx: 0.55 * width as f32, cy: 0.4 * height as f32 };
    View { intrinsics, pose: Pose { rotation: DQuat::IDENTITY, center: DVec3::ZERO } }
}

/// Grey of brightness `v` as the constant SH coefficient.
pub fn grey(v: f32) -> f32 {
    (v - 0.5) / SH_C0
}

/// `n` Gaussians in front of [`view`], of sizes that overlap.
pub fn cloud(seed: u64, n: usize, degree: u8) -> GaussianCloud {
    let mut rng = Pcg64Mcg::seed_from_u64(seed);
    let mut cloud = GaussianCloud::with_capacity(degree, n);
    for _ in 0..n {
        let z: f32 = rng.random_range(2.0..8.0);
        let sh: Vec<f32> =
            (0..cloud.sh_stride()).map(|k| rng.random_range(-1.0..1.0) * if k < 3 { 1.2 } else { 0.2 }).collect();
        cloud.push(
            [rng.random_range(-0.5..0.5) * z, rng.random_range(-0.5..0.5) * z, z],
            std::array::from_fn(|_| rng.random_range(-4.0..-0.7)),
            std::array::from_fn(|_| rng.random_range(-1.0..1.0)),
            rng.random_range(-3.0..3.0),
            &sh,
        );
    }
    cloud
}

/// A photograph of nothing in particular.
pub fn photo(seed: u64, view: &View) -> Vec<[f32; 3]> {
    let mut rng = Pcg64Mcg::seed_from_u64(seed ^ 0x9e37);
    (0..view.intrinsics.pixels()).map(|_| std::array::from_fn(|_| f32::from(rng.random::<u8>()) / 255.0)).collect()
}

/// What the twin makes of a scene.
pub struct Answer {
    pub picture: Vec<Pixel<f32>>,
    pub instances: usize,
    pub culled: Vec<Option<Culled>>,
    pub gradient: ViewGradient<f32>,
}

impl Answer {
    pub fn count(&self, why: Culled) -> usize {
        self.culled.iter().filter(|c| **c == Some(why)).count()
    }

    /// Every number of the picture and of every gradient.
    pub fn assert_finite(&self, case: &str) {
        for p in &self.picture {
            assert!(p.rgb.iter().chain([&p.depth, &p.transmittance]).all(|v| v.is_finite()), "{case}: picture");
        }
        assert!(self.gradient.loss.total.is_finite(), "{case}: loss");
        for g in &self.gradient.gaussians {
            let mut g = *g;
            assert!((0..59).all(|k| g.parameter(k).is_finite()), "{case}: gradient {g:?}");
        }
        assert!(self.gradient.pose.iter().all(|v| v.is_finite()), "{case}: pose");
    }
}

/// The twin's full step before the optimiser, in f32, with the shaders' limits.
pub fn answer(cloud: &GaussianCloud, view: &View, photo: &[[f32; 3]], settings: &LossSettings) -> Answer {
    let gaussians = Gaussian::<f32>::of_cloud(cloud);
    let camera = Camera::<f32>::of(view);
    let limits = Limits::default();
    let all = |_: usize| 1.0;
    let degree = |_: usize| cloud.sh_degree;
    let rendered = forward(&gaussians, &camera, degree, all, &limits);
    let target = Target { width: view.intrinsics.width as usize, rgb: photo, depth: None, background: [0.0; 3] };
    let exposure = Exposure::default();
    let gradient = backward(&gaussians, &camera, degree, all, &limits, &rendered, &target, &exposure, settings);
    Answer {
        picture: rendered.picture,
        instances: rendered.instances.gaussians.len(),
        culled: rendered.culled,
        gradient,
    }
}
