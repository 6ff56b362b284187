//! The smallest lens that a vehicle is tested with.

use config::mission::CameraSettings;

pub const LENS: CameraSettings = CameraSettings {
    width: 32,
    height: 24,
    fx: 25.0,
    fy: 25.0,
    cx: 16.0,
    cy: 12.0,
    distortion: [0.0; 4],
    exposure_delay_ms: 0.0,
    index: None,
};
