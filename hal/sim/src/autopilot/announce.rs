//! How an exposure is announced, in the manner of ArduPilot or of PX4.

use super::Autopilot;
use crate::messages;
use crate::random::{About, strikes};
use hal::error::HalError;
use hal::mavlink::dialect::{HEARTBEAT_DATA, MavAutopilot, MavModeFlag};
use hal::traits::Link;

/// PX4's custom mode: main mode AUTO (4), sub-mode MISSION (4).
const PX4_MISSION: u32 = 4 << 24 | 4 << 16;

/// Which messages announce an exposure.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Announcing {
    /// ArduPilot: CAMERA_FEEDBACK.
    #[default]
    Feedback,
    /// PX4 without a feedback pin: CAMERA_TRIGGER with boot µs and counter, and the same exposure once more as
    /// IMAGE_START_CAPTURE and as DO_DIGICAM_CONTROL to the camera component.
    Trigger,
    /// PX4 with a feedback pin: all of these, and CAMERA_IMAGE_CAPTURED.
    TriggerAndCaptured,
    /// A camera behind the autopilot that reports its own pictures: CAMERA_IMAGE_CAPTURED alone.
    Captured,
}

/// HEARTBEAT of the autopilot that announces this way.
pub(super) fn heartbeat(announcing: Announcing, armed: bool) -> HEARTBEAT_DATA {
    let mut heartbeat = match announcing {
        Announcing::Feedback | Announcing::Captured => messages::heartbeat(),
        Announcing::Trigger | Announcing::TriggerAndCaptured => HEARTBEAT_DATA {
            autopilot: MavAutopilot::MAV_AUTOPILOT_PX4,
            custom_mode: PX4_MISSION,
            ..messages::heartbeat()
        },
    };
    heartbeat.base_mode.set(MavModeFlag::MAV_MODE_FLAG_SAFETY_ARMED, armed);
    heartbeat
}

impl<L: Link<Error = HalError>> Autopilot<L> {
    pub(super) fn announce(&mut self, now_s: f64) -> Result<(), HalError> {
        self.triggers.next += 1;
        self.triggers.counted += 1;
        let acting = self.acting(now_s);
        if strikes(acting.trigger_loss_pct, self.settings.seed, About::Trigger, 0, u64::from(self.triggers.counted)) {
            self.triggers.lost += 1;
            return Ok(());
        }
        let (s, at) = self.reported(now_s);
        let (boot_us, unix_us) = (self.boot_us(now_s), self.unix_us(now_s));
        let announcing = self.settings.announcing;
        if announcing == Announcing::Feedback {
            // With a feedback pin ArduPilot's time is 32-bit boot µs.
            let boot = boot_us & u64::from(u32::MAX);
            let time_us = if acting.feedback_boot_time >= 0.5 { boot } else { unix_us };
            return self.channel.send(&messages::feedback(time_us, self.triggers.counted, &s, at, &self.frame));
        }
        if announcing != Announcing::Captured {
            self.channel.send(&messages::camera_trigger(boot_us, self.triggers.counted))?;
            self.channel.send(&messages::image_start_capture(self.settings.system_id))?;
            self.channel.send(&messages::digicam_control())?;
        }
        if announcing != Announcing::Trigger {
            self.channel.send(&messages::image_captured(boot_us, unix_us, self.triggers.counted, &s, at))?;
        }
        Ok(())
    }
}
