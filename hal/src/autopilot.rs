//! One autopilot as heard on its link: a state machine fed with frames, which keeps the clocks, the track and the announced
//! exposures. No I/O and no allocation; [`crate::vehicle`] feeds it.

mod camera_trigger;
pub mod landing;
mod motion;
mod mounts;
mod timing;
mod triggers;

use heapless::{Deque, LinearMap};

use crate::counters::{HalCounters, TelemetryCounters};
use crate::mavlink::Frame;
use crate::mavlink::MessageData;
use crate::mavlink::dialect::{
    ATTITUDE_DATA, ATTITUDE_QUATERNION_DATA, CAMERA_FEEDBACK_DATA, CAMERA_IMAGE_CAPTURED_DATA, CAMERA_TRIGGER_DATA,
    EXTENDED_SYS_STATE_DATA, GIMBAL_DEVICE_ATTITUDE_STATUS_DATA, GLOBAL_POSITION_INT_DATA, GPS_GLOBAL_ORIGIN_DATA,
    GPS_RAW_INT_DATA, HEARTBEAT_DATA, MavAutopilot, MavModeFlag, ODOMETRY_DATA, PARAM_VALUE_DATA, SYS_STATUS_DATA,
    SYSTEM_TIME_DATA, TIMESYNC_DATA,
};
use crate::pose::track::Track;
use crate::pose::{BodyPose, PoseError};
use crate::time::boot::BootClock;
use crate::time::map::ClockMap;
use crate::time::unix::UnixMap;
use crate::traits::{PoseSource, TriggerSource};
use crate::trigger::Trigger;

pub use camera_trigger::CameraTrigger;
use landing::Landing;
use motion::Motion;
pub use mounts::Gimbal;
use mounts::Mounts;
use triggers::Announcements;

/// Senders of one system whose sequence is watched: autopilot, gimbal, cameras.
const SENDERS: usize = 8;
/// TIMESYNC answers waiting to be sent.
const ANSWERS: usize = 4;

/// Who is listened to, and who we are.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Ids {
    /// The vehicle's system id; 0 takes the first autopilot heard.
    pub system: u8,
    /// The autopilot's component id, 1 by convention.
    pub autopilot: u8,
    /// Our component id on the vehicle: 100 to 105 for a camera.
    pub own_component: u8,
}

/// What a frame was.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Handled {
    /// Another system's: ignored.
    Foreign,
    /// A position was added to the track.
    Position,
    /// The autopilot's heartbeat.
    Heartbeat,
    /// Anything else of this system.
    Other,
}

/// What the autopilot says about itself.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct AutopilotState {
    /// Companion time of the last heartbeat, ns.
    pub heartbeat_ns: Option<u64>,
    /// Motors may turn.
    pub armed: bool,
    /// It flew and is down again: several signs have agreed for seconds.
    pub landed: bool,
    /// GPS fix type as MAVLink counts it: 3 = 3D, 6 = RTK fixed; `None` before the first GPS_RAW_INT.
    pub gps_fix: Option<u8>,
    /// Remaining battery, percent.
    pub battery_percent: Option<u8>,
    /// Height of home, where it takes off and lands, metres on the scale of its positions.
    pub home_alt_m: Option<f64>,
}

/// The autopilot's side of the HAL.
pub struct Autopilot {
    ids: Ids,
    boot: BootClock,
    clock: ClockMap,
    unix: UnixMap,
    track: Track,
    motion: Motion,
    mounts: Mounts,
    announcements: Announcements,
    asked_ns: Option<i64>,
    answers: Deque<TIMESYNC_DATA, ANSWERS>,
    sequences: LinearMap<u8, u8, SENDERS>,
    state: AutopilotState,
    landing: Landing,
    trigger: CameraTrigger,
    counters: HalCounters,
}

impl Autopilot {
    /// Nothing heard yet.
    pub fn new(ids: Ids) -> Self {
        Self {
            ids,
            boot: BootClock::default(),
            clock: ClockMap::default(),
            unix: UnixMap::default(),
            track: Track::default(),
            motion: Motion::default(),
            mounts: Mounts::default(),
            announcements: Announcements::default(),
            asked_ns: None,
            answers: Deque::new(),
            sequences: LinearMap::new(),
            state: AutopilotState::default(),
            landing: Landing::default(),
            trigger: CameraTrigger::default(),
            counters: HalCounters::default(),
        }
    }

    /// A flight that an earlier start began is over when the aircraft has stood disarmed for `standing_ns`.
    pub fn continued(mut self, standing_ns: u64) -> Self {
        self.landing = Landing::continued(standing_ns);
        self
    }

    /// Only the gimbal with this device id is believed; 0 takes the first one.
    pub fn with_gimbal(mut self, device: u8) -> Self {
        self.mounts = Mounts::of(device);
        self
    }

    /// The gimbal that is believed, and those that are left out.
    pub fn gimbals(&self) -> (Option<Gimbal>, &[Gimbal]) {
        self.mounts.chosen()
    }

    /// Who is listened to; `system` is 0 until one was heard when it is to be learnt.
    pub fn ids(&self) -> Ids {
        self.ids
    }

    /// Takes a frame received at `now_ns` of the companion's clock.
    pub fn handle(&mut self, frame: &Frame<'_>, now_ns: u64) -> Handled {
        let heartbeat = frame.message::<HEARTBEAT_DATA>();
        let is_autopilot = |h: &HEARTBEAT_DATA| h.autopilot != MavAutopilot::MAV_AUTOPILOT_INVALID;
        if self.ids.system == 0 && heartbeat.as_ref().is_some_and(is_autopilot) {
            self.ids.system = frame.system();
            self.ids.autopilot = frame.component();
        }
        if frame.system() != self.ids.system || frame.component() == self.ids.own_component {
            self.counters.link.foreign += 1;
            return Handled::Foreign;
        }
        self.watch_sequence(frame);
        // Cameras and gimbals have components of their own; everything else is believed from the autopilot only.
        match frame.id() {
            CAMERA_FEEDBACK_DATA::ID => self.on_feedback(frame, now_ns),
            CAMERA_TRIGGER_DATA::ID => self.on_camera_trigger(frame, now_ns),
            CAMERA_IMAGE_CAPTURED_DATA::ID => self.on_image_captured(frame, now_ns),
            GIMBAL_DEVICE_ATTITUDE_STATUS_DATA::ID => self.on_gimbal(frame, now_ns),
            TIMESYNC_DATA::ID => self.on_timesync(frame, now_ns),
            _ if frame.component() != self.ids.autopilot => {}
            HEARTBEAT_DATA::ID => {
                if let Some(h) = heartbeat.filter(is_autopilot) {
                    self.state.heartbeat_ns = Some(now_ns);
                    self.trigger.on_heartbeat(h.autopilot);
                    self.state.armed = h.base_mode.contains(MavModeFlag::MAV_MODE_FLAG_SAFETY_ARMED);
                    self.landing.on_heartbeat(self.state.armed, now_ns);
                    return Handled::Heartbeat;
                }
            }
            GLOBAL_POSITION_INT_DATA::ID => return self.on_global_position(frame, now_ns),
            ODOMETRY_DATA::ID => return self.on_odometry(frame, now_ns),
            ATTITUDE_QUATERNION_DATA::ID => self.on_attitude_quaternion(frame, now_ns),
            ATTITUDE_DATA::ID => self.on_attitude(frame, now_ns),
            GPS_RAW_INT_DATA::ID => self.on_gps(frame),
            GPS_GLOBAL_ORIGIN_DATA::ID => self.on_origin(frame),
            SYSTEM_TIME_DATA::ID => self.on_system_time(frame, now_ns),
            EXTENDED_SYS_STATE_DATA::ID => {
                if let Some(m) = frame.message::<EXTENDED_SYS_STATE_DATA>() {
                    self.landing.on_landed_state(m.landed_state, now_ns);
                }
            }
            SYS_STATUS_DATA::ID => {
                if let Some(s) = frame.message::<SYS_STATUS_DATA>() {
                    self.state.battery_percent = u8::try_from(s.battery_remaining).ok().filter(|p| *p <= 100);
                }
            }
            PARAM_VALUE_DATA::ID => self.trigger.on_parameter(frame),
            _ => {}
        }
        Handled::Other
    }

    /// What the autopilot says about itself, as it counts at `now_ns`.
    pub fn state(&self, now_ns: u64) -> AutopilotState {
        AutopilotState { landed: self.landing.is_down(now_ns), ..self.state }
    }

    /// Whether it triggers a camera.
    pub fn camera_trigger(&self) -> CameraTrigger {
        self.trigger
    }

    /// The clock mapping.
    pub fn clock(&self) -> &ClockMap {
        &self.clock
    }

    /// Unix time of a boot time, µs; `None` while the autopilot has not said it.
    pub fn unix_us(&self, boot_ns: u64) -> Option<u64> {
        self.unix.to_unix_us(boot_ns)
    }

    /// The recent track.
    pub fn track(&self) -> &Track {
        &self.track
    }

    /// As [`PoseSource::pose_at`], but takes what there is when nothing better will come.
    ///
    /// # Errors
    /// Errors of [`PoseSource::pose_at`].
    pub fn pose_near(&self, boot_ns: u64) -> Result<BodyPose, PoseError> {
        self.track.pose_near(boot_ns)
    }

    /// Totals; the link's and the cameras' fields are 0 here.
    pub fn counters(&self) -> HalCounters {
        let telemetry = TelemetryCounters {
            clock_steps: u64::from(self.clock.steps()) + u64::from(self.unix.steps()),
            clock_rejected: self.clock.rejected().into(),
            ..self.counters.telemetry
        };
        HalCounters { telemetry, ..self.counters }
    }

    fn watch_sequence(&mut self, frame: &Frame<'_>) {
        let sequence = frame.sequence();
        match self.sequences.get_mut(&frame.component()) {
            Some(last) => {
                // The same again, or one that was overtaken, is no loss of 250.
                let step = sequence.wrapping_sub(*last);
                if (1..=128).contains(&step) {
                    self.counters.link.lost += u64::from(step - 1);
                    *last = sequence;
                }
            }
            // A ninth sender goes unwatched.
            None => drop(self.sequences.insert(frame.component(), sequence)),
        }
    }

    /// What was taken so far came from somebody else.
    pub fn start_afresh(&mut self) {
        let (ids, counters, mounts) = (self.ids, self.counters, self.mounts.forgotten());
        *self = Self { counters, mounts, ..Self::new(ids) };
    }

    /// The boot clock restarted: what was known on the old one means nothing any more.
    fn forget(&mut self) {
        self.counters.telemetry.clock_restarts += 1;
        self.clock.reset();
        self.unix.reset();
        self.track.clear();
        self.motion = Motion::default();
        self.announcements.clear_times();
    }
}

impl PoseSource for Autopilot {
    fn pose_at(&self, boot_ns: u64) -> Result<BodyPose, PoseError> {
        self.track.pose_at(boot_ns)
    }
}

impl TriggerSource for Autopilot {
    fn next_trigger(&mut self) -> Option<Trigger> {
        self.announcements.next()
    }
}

#[cfg(test)]
mod tests;
