//! Announced exposures, from whichever message the autopilot uses.

/// Which message announced an exposure.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum TriggerKind {
    /// CAMERA_FEEDBACK (ArduPilot).
    Feedback,
    /// CAMERA_TRIGGER (PX4).
    CameraTrigger,
    /// CAMERA_IMAGE_CAPTURED (PX4 with feedback, MAVLink cameras).
    ImageCaptured,
    /// A capture command to us as the MAVLink camera.
    Command,
}

/// The camera whose exposure was announced, of all that speak in the vehicle's name.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord)]
pub struct Source {
    /// Component that announces: the autopilot, or a camera with a component of its own.
    pub component: u8,
    /// Its camera, as CAMERA_FEEDBACK.cam_idx or CAMERA_IMAGE_CAPTURED.camera_id numbers it; 0 where a message has no number.
    pub camera: u8,
}

impl core::fmt::Display for Source {
    fn fmt(&self, f: &mut core::fmt::Formatter<'_>) -> core::fmt::Result {
        write!(f, "camera {} of component {}", self.camera, self.component)
    }
}

/// One announced exposure.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Trigger {
    /// Whose exposure.
    pub source: Source,
    /// Counter of the announcing message, mended where it does not count.
    pub sequence: u32,
    /// Autopilot's boot clock, ns.
    pub boot_ns: u64,
    /// Companion's clock, ns.
    pub time_ns: u64,
    /// One standard deviation of the time, ns.
    pub sigma_ns: u64,
    /// Which message announced it.
    pub kind: TriggerKind,
}
