//! What the tests of the engine begin with.

use config::budget::Memory;
use config::mission::NetworkSettings;
use glam::{DQuat, DVec3};
use models::camera::{Intrinsics, Pose, PoseSigma, PosedImage, View};

use super::{EngineSettings, InitKind};
use crate::device::DeviceRequest;

/// Three pictures of [`picture`] and 300 Gaussians, all of them at random and on the device.
pub fn settings() -> EngineSettings {
    EngineSettings {
        disk: Default::default(),
        device: DeviceRequest {
            device: None,
            memory: Memory { device_mib: Some(64), max_gaussians: Some(300), ..Memory::default() },
            size: (32, 24),
            views: 3,
            crops: 0,
            folder: None,
        },
        camera_pixels: 32 * 24,
        ahead: 0,
        ahead_in_memory: false,
        delivers: None,
        map: None,
        scale: 1.0,
        network: NetworkSettings::default(),
        training: Default::default(),
        init: Default::default(),
        refine: None,
        start: InitKind::Random,
        incremental: false,
    }
}

/// One of pictures straight down, side by side, a metre apart.
pub fn picture(i: u32) -> PosedImage {
    let intrinsics = Intrinsics { width: 32, height: 24, fx: 30.0, fy: 30.0, cx: 16.0, cy: 12.0 };
    let center = DVec3::new(f64::from(i), 0.0, 20.0);
    let pose = Pose { rotation: DQuat::from_xyzw(1.0, 0.0, 0.0, 0.0), center };
    PosedImage {
        name: format!("{i}.png"),
        time_ns: 0,
        image: image::RgbImage::from_fn(32, 24, |x, y| image::Rgb([(8 * x) as u8, (10 * y) as u8, 90])),
        view: View { intrinsics, pose },
        mask: None,
        sigma: PoseSigma { position_m: [0.0; 3], rotation_rad: [0.0; 3] },
    }
}
