//! The smallest lens that a vehicle is tested with.

use config::mission::CameraSettings;

pub const LENS: CameraSettings = CameraSettings::pinhole(32, 24, 25.0);
