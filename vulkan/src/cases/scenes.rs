//! Small scenes for the numerical cases, and the twin's answer to them.

use glam::{DQuat, DVec3};
use image::RgbImage;
use models::camera::{Intrinsics, Pose, PoseSigma, PosedImage, View};
use models::cloud::{GaussianCloud, SH_C0};
use rand::{Rng, SeedableRng};
use rand_pcg::Pcg64Mcg;

use super::Broken;
use crate::gpu::Gpu;
use crate::trainer::Trainer;
use crate::twin::camera::Camera;
use crate::twin::gaussian::Gaussian;
use crate::twin::loss::{Exposure, Target};
use crate::twin::project::{Culled, Limits};
use crate::twin::rasterise::Pixel;
use crate::twin::real::Real;
use crate::twin::step::{ViewGradient, backward, forward};
use config::plan::{Plan, PlanRequest};
use config::training::{
    DensitySettings, LossSettings, RegulariseSettings, ResolutionSettings, ShSettings, Strategy, TrainSettings,
};

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
pub struct Answer<R = f32> {
    /// The picture, row by row.
    pub picture: Vec<Pixel<R>>,
    /// Gaussian–tile instances.
    pub instances: usize,
    /// Why each Gaussian was not drawn.
    pub culled: Vec<Option<Culled>>,
    /// Loss and every gradient.
    pub gradient: ViewGradient<R>,
}

impl<R: Real> Answer<R> {
    /// How many Gaussians were not drawn for this reason.
    pub fn count(&self, why: Culled) -> usize {
        self.culled.iter().filter(|c| **c == Some(why)).count()
    }

    /// Every number of the picture and of every gradient.
    pub fn check_finite(&self, case: &str) -> Result<(), Broken> {
        for p in &self.picture {
            promise!(p.rgb.iter().chain([&p.depth, &p.transmittance]).all(|v| v.is_finite()), "{case}: picture");
        }
        promise!(self.gradient.loss.total.is_finite(), "{case}: loss");
        for g in &self.gradient.gaussians {
            let mut g = *g;
            promise!((0..59).all(|k| g.parameter(k).is_finite()), "{case}: gradient {g:?}");
        }
        promise!(self.gradient.pose.iter().all(|v| v.is_finite()), "{case}: pose");
        Ok(())
    }
}

/// The twin's full step before the optimiser, in f32, with the shaders' limits.
pub fn answer(cloud: &GaussianCloud, view: &View, photo: &[[f32; 3]], settings: &LossSettings) -> Answer {
    answer_in(cloud, view, photo, settings)
}

/// The same in the arithmetic of choice.
pub fn answer_in<R: Real>(
    cloud: &GaussianCloud,
    view: &View,
    photo: &[[f32; 3]],
    settings: &LossSettings,
) -> Answer<R> {
    let gaussians = Gaussian::<R>::of_cloud(cloud);
    let camera = Camera::<R>::of(view);
    let limits = Limits::default();
    let all = |_: usize| R::ONE;
    let degree = |_: usize| cloud.sh_degree;
    let rendered = forward(&gaussians, &camera, degree, all, &limits);
    let rgb: Vec<_> = photo.iter().map(|p| p.map(|v| R::of(v.into()))).collect();
    let target = Target { width: view.intrinsics.width as usize, rgb: &rgb, depth: None, background: [R::ZERO; 3] };
    let exposure = Exposure::default();
    let gradient = backward(&gaussians, &camera, degree, all, &limits, &rendered, &target, &exposure, settings);
    Answer {
        picture: rendered.picture,
        instances: rendered.instances.gaussians.len(),
        culled: rendered.culled,
        gradient,
    }
}

/// One degree, one size, no chance: what is left is the arithmetic.
pub fn plain() -> TrainSettings {
    TrainSettings {
        steps: 1000,
        density: DensitySettings { strategy: Strategy::None, ..Default::default() },
        sh: ShSettings { degree: 3, raise_at: [0.0; 3], ..Default::default() },
        resolution: ResolutionSettings { quarter_until: 0.0, half_until: 0.0, least_side: 1, ..Default::default() },
        regularise: RegulariseSettings { drop: 0.0, noise: 0.0, opacity_decay: 0.0, background: 0.0 },
        ..Default::default()
    }
}

/// `photo` as a picture taken from `view`.
pub fn posed(view: &View, photo: &[[f32; 3]]) -> PosedImage {
    let (w, h) = (view.intrinsics.width, view.intrinsics.height);
    let image =
        RgbImage::from_fn(w, h, |x, y| image::Rgb(photo[(y * w + x) as usize].map(|v| (v * 255.0).round() as u8)));
    let sigma = PoseSigma { position_m: [0.0; 3], rotation_rad: [0.0; 3] };
    PosedImage { name: "a".into(), time_ns: 0, image, view: *view, sigma }
}

/// A trainer with `cloud` loaded and room for two views of `view`'s size.
pub fn trainer(gpu: &Gpu, cloud: &GaussianCloud, view: &View, settings: &TrainSettings) -> Result<Trainer, Broken> {
    let mut trainer = empty_trainer(gpu, cloud.sh_degree, cloud.len().max(256), view, settings)?;
    trainer.load(cloud)?;
    Ok(trainer)
}

/// The same with nothing loaded yet.
pub fn empty_trainer(
    gpu: &Gpu,
    sh_degree: u8,
    capacity: usize,
    view: &View,
    settings: &TrainSettings,
) -> Result<Trainer, Broken> {
    let request = PlanRequest {
        device_mib: 64,
        width: view.intrinsics.width,
        height: view.intrinsics.height,
        views: 2,
        sh_degree,
        max_gaussians: Some(capacity),
        ..Default::default()
    };
    Ok(Trainer::new(gpu, &Plan::new(&request)?, settings)?)
}

/// Parameter `k` of row `i`: mean, log scale, rotation, opacity, SH.
pub fn parameter(cloud: &mut GaussianCloud, i: usize, k: usize) -> &mut f32 {
    let stride = cloud.sh_stride();
    match k {
        0..3 => &mut cloud.means[i][k],
        3..6 => &mut cloud.log_scales[i][k - 3],
        6..10 => &mut cloud.rotations[i][k - 6],
        10 => &mut cloud.opacity_logits[i],
        _ => &mut cloud.sh[i * stride + k - 11],
    }
}
