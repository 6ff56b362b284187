//! Whether the autopilot triggers a camera at all, by a parameter of its.

use crate::mavlink::Frame;
use crate::mavlink::dialect::{MavAutopilot, PARAM_VALUE_DATA};

/// What is known of it.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct CameraTrigger {
    /// Which firmware, by its heartbeat.
    kind: Option<MavAutopilot>,
    set: Option<bool>,
}

impl CameraTrigger {
    /// Name of the parameter that is 0 while no camera is triggered; `None` before a heartbeat, and for firmware without one.
    pub fn parameter(&self) -> Option<&'static str> {
        match self.kind? {
            MavAutopilot::MAV_AUTOPILOT_ARDUPILOTMEGA => Some("CAM1_TYPE"),
            MavAutopilot::MAV_AUTOPILOT_PX4 => Some("TRIG_MODE"),
            _ => None,
        }
    }

    /// Whether a camera is triggered; `None` while the autopilot has not said so.
    pub fn is_set(&self) -> Option<bool> {
        self.set
    }

    pub(super) fn on_heartbeat(&mut self, kind: MavAutopilot) {
        self.kind = Some(kind);
    }

    pub(super) fn on_parameter(&mut self, frame: &Frame<'_>) {
        let Some(m) = frame.message::<PARAM_VALUE_DATA>() else { return };
        if self.parameter().is_some_and(|name| m.param_id.to_str() == Ok(name)) {
            // PX4 sends the bits of an integer, of which 0 is 0.0 as well.
            self.set = Some(m.param_value != 0.0);
        }
    }
}
