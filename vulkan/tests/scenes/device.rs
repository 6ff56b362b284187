//! The same scenes on the device.
#![allow(dead_code, reason = "each test binary uses its own part")]
#![allow(clippy::unwrap_used, clippy::panic, reason = "a test fails by panicking")]

use config::plan::{Plan, PlanRequest};
use config::training::{DensitySettings, RegulariseSettings, ResolutionSettings, ShSettings, Strategy, TrainSettings};
use image::RgbImage;
use models::camera::{PoseSigma, PosedImage, View};
use models::cloud::GaussianCloud;
use vulkan::gpu::Gpu;
use vulkan::trainer::Trainer;

/// One degree, one size, no chance: what is left is the arithmetic.
pub fn plain() -> TrainSettings {
    TrainSettings {
        steps: 1000,
        density: DensitySettings { strategy: Strategy::None, ..Default::default() },
        sh: ShSettings { degree: 3, raise_at: [0.0; 3] },
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

/// A trainer with `cloud` loaded and room for one view of `view`'s size; `None` (and a line saying so) without a device.
pub fn trainer(cloud: &GaussianCloud, view: &View, settings: &TrainSettings) -> Option<Trainer> {
    let mut trainer = empty_trainer(cloud.sh_degree, cloud.len().max(256), view, settings)?;
    trainer.load(cloud).unwrap();
    Some(trainer)
}

/// The same with nothing loaded yet.
pub fn empty_trainer(sh_degree: u8, capacity: usize, view: &View, settings: &TrainSettings) -> Option<Trainer> {
    let gpu = match Gpu::open(None) {
        Ok(gpu) => gpu,
        Err(e) => {
            println!("skipped: {e}");
            return None;
        }
    };
    let request = PlanRequest {
        device_mib: 64,
        width: view.intrinsics.width,
        height: view.intrinsics.height,
        views: 2,
        sh_degree,
        max_gaussians: Some(capacity),
    };
    let plan = Plan::new(&request).unwrap();
    Some(Trainer::new(&gpu, &plan, settings).unwrap())
}
