//! Settings of the link to the autopilot and of what the HAL does with pictures: table `[link]` of the mission.

use std::path::PathBuf;

use serde::{Deserialize, Serialize};

/// MAVLink 2 message signing.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Deserialize, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum Signing {
    /// Nothing is signed or checked.
    #[default]
    Off,
    /// We sign; unsigned frames are accepted, wrongly signed ones are not.
    Accept,
    /// We sign; only rightly signed frames are accepted.
    Require,
}

/// The link to the autopilot, and the pictures.
#[derive(Clone, Debug, PartialEq, Deserialize, Serialize)]
#[serde(deny_unknown_fields, default)]
pub struct LinkSettings {
    /// Our MAVLink component id: 100 to 105 for the camera that we act as.
    pub own_component: u8,
    /// Act as a MAVLink camera (heartbeat, information, capture commands), so that ArduPilot's CAM1_TYPE 6 and ground
    /// control stations see one.
    pub act_as_camera: bool,
    /// The link counts as lost after this long without a heartbeat, seconds.
    pub heartbeat_timeout_s: f32,
    /// Message signing.
    pub signing: Signing,
    /// File with the 32-byte key, raw or as 64 hexadecimal digits. The last time stamp is kept beside it.
    pub signing_key: Option<PathBuf>,
    /// Expected time from exposure to complete picture, milliseconds; learnt from there on.
    pub picture_latency_ms: f32,
    /// Pictures and exposures that do not find each other are given up after this, seconds.
    pub patience_s: f32,
    /// Pictures that belong to no announced exposure (video, intervalometer) are used, posed at their arrival less the
    /// latency.
    pub free_running: bool,
    /// Least time between two free-running pictures, milliseconds; those between are dropped.
    pub picture_interval_ms: f32,
    /// A picture without a pose from the autopilot takes the one in its EXIF and XMP data, if it has one.
    pub exif_pose: bool,
}

impl Default for LinkSettings {
    fn default() -> Self {
        Self {
            own_component: 100,
            act_as_camera: true,
            // QGroundControl's and ArduPilot's own rule: 3 to 5 heartbeats at 1 Hz.
            heartbeat_timeout_s: 5.0,
            signing: Signing::Off,
            signing_key: None,
            picture_latency_ms: 200.0,
            patience_s: 15.0,
            free_running: false,
            picture_interval_ms: 500.0,
            exif_pose: true,
        }
    }
}
