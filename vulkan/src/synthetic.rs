//! Small made-up scenes: what autotuning measures with, what `check` compares with the reference, what the stress cases start from.

use config::training::{DensitySettings, RegulariseSettings, ResolutionSettings, ShSettings, Strategy, TrainSettings};
use glam::{DQuat, DVec3};
use image::RgbImage;
use models::camera::{Intrinsics, Pose, PoseSigma, PosedImage, View};
use models::cloud::{GaussianCloud, SH_C0};
use rand::{Rng, SeedableRng};
use rand_pcg::Pcg64Mcg;

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
    PosedImage { name: "a".into(), time_ns: 0, image, view: *view, mask: None, sigma }
}
