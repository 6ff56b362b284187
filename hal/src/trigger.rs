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

/// One announced exposure.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Trigger {
    /// Counter of the announcing message.
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
