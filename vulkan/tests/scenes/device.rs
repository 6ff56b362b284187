//! Scenes on the device; `None` (and a line saying so) where there is none.
#![allow(dead_code, unused_imports, reason = "each test binary uses its own part")]
#![allow(clippy::unwrap_used, clippy::panic, reason = "a test fails by panicking")]

use config::training::TrainSettings;
use models::camera::View;
use models::cloud::GaussianCloud;
pub use vulkan::cases::scenes::{plain, posed};
use vulkan::fixture::Fixture;
use vulkan::gpu::Gpu;

/// A trainer with `cloud` loaded and room for two views of `view`'s size.
pub fn trainer(cloud: &GaussianCloud, view: &View, settings: &TrainSettings) -> Option<Fixture> {
    Some(vulkan::cases::scenes::trainer(&open()?, cloud, view, settings).unwrap())
}

/// A trainer with room for `capacity` Gaussians, none of them loaded.
pub fn empty_trainer(sh_degree: u8, capacity: usize, view: &View, settings: &TrainSettings) -> Option<Fixture> {
    Some(vulkan::cases::scenes::empty_trainer(&open()?, sh_degree, capacity, view, settings).unwrap())
}

/// The Gaussians as they are.
pub fn model(trainer: &mut Fixture) -> GaussianCloud {
    let mut model = GaussianCloud::with_capacity(3, trainer.gaussians());
    trainer.snapshot(&mut model).unwrap();
    model
}

/// The first device.
pub fn open() -> Option<Gpu> {
    match Gpu::open(None) {
        Ok(gpu) => Some(gpu),
        Err(e) => {
            needs::missing(needs::Need::Vulkan, e);
            None
        }
    }
}
