//! What a ground station or the autopilot commands: COMMAND_LONG and COMMAND_INT alike, each command obeyed once however
//! often it is sent again.

use heapless::HistoryBuf;

use super::{Due, MavlinkCamera, Request};
use crate::mavlink::dialect::{
    CAMERA_CAPTURE_STATUS_DATA, CAMERA_IMAGE_CAPTURED_DATA, CAMERA_INFORMATION_DATA, CAMERA_SETTINGS_DATA,
    COMMAND_ACK_DATA, COMMAND_INT_DATA, COMMAND_LONG_DATA, CameraMode, MavCmd, MavResult, STORAGE_INFORMATION_DATA,
};
use crate::mavlink::{Frame, MessageData};

/// Shortest interval of a series, s; shorter ones are denied (no companion computer can train on them).
const LEAST_INTERVAL_S: f32 = 0.1;
/// PX4 sends IMAGE_START_CAPTURE and DO_DIGICAM_CONTROL for the same exposure: one capture within this.
const SAME_CAPTURE_NS: u64 = 200_000_000;
/// Commands remembered, to know one that is sent again because its acknowledgement was lost.
const REMEMBERED: usize = 8;
/// Whoever sends again without saying so (MAVSDK: three times, half a second apart) has done so within this.
const RETRY_NS: u64 = 5_000_000_000;
/// Whoever says so by `confirmation` (QGroundControl: four times, three seconds apart) within this.
const CONFIRMED_RETRY_NS: u64 = 15_000_000_000;

/// A command as either message carries it.
#[derive(Clone, Copy, Debug)]
pub(super) struct Command {
    id: MavCmd,
    /// 1 … 5; the others mean nothing to a camera.
    params: [f32; 5],
    /// How often it was sent before; COMMAND_INT does not say.
    confirmation: u8,
    sender: (u8, u8),
    /// Asked of all components.
    to_all: bool,
}

impl Command {
    pub(super) fn from_long(m: &COMMAND_LONG_DATA, frame: &Frame<'_>) -> Self {
        Self {
            id: m.command,
            params: [m.param1, m.param2, m.param3, m.param4, m.param5],
            confirmation: m.confirmation,
            sender: (frame.system(), frame.component()),
            to_all: m.target_component == 0,
        }
    }

    pub(super) fn from_int(m: &COMMAND_INT_DATA, frame: &Frame<'_>) -> Self {
        Self {
            id: m.command,
            params: [m.param1, m.param2, m.param3, m.param4, m.x as f32],
            confirmation: 0,
            sender: (frame.system(), frame.component()),
            to_all: m.target_component == 0,
        }
    }

    /// Number of a single capture, by which it is known when it is sent again.
    fn capture_id(&self) -> Option<f32> {
        (self.id == MavCmd::MAV_CMD_IMAGE_START_CAPTURE && self.params[2] == 1.0 && self.params[3] > 0.0)
            .then_some(self.params[3])
    }
}

/// A series of captures (an intervalometer set by IMAGE_START_CAPTURE).
#[derive(Clone, Copy, Debug)]
struct Series {
    every_ns: u64,
    next_ns: u64,
    /// `None` = until stopped.
    left: Option<u32>,
}

/// Captures asked for.
#[derive(Default)]
pub(super) struct Captures {
    count: u32,
    /// When the last single one was asked for, and by which message or command.
    last: Option<(u64, u32)>,
    series: Option<Series>,
    obeyed: HistoryBuf<(Command, u64), REMEMBERED>,
}

impl Captures {
    /// Interval of the series that runs, s.
    pub(super) fn interval_s(&self) -> Option<f32> {
        self.series.map(|s| s.every_ns as f32 * 1e-9)
    }

    /// Whether the next picture of a series is due; counts it.
    pub(super) fn is_due(&mut self, now_ns: u64) -> bool {
        let Some(series) = self.series.as_mut().filter(|s| now_ns >= s.next_ns) else { return false };
        series.next_ns = now_ns + series.every_ns;
        series.left = series.left.map(|n| n.saturating_sub(1));
        if series.left == Some(0) {
            self.series = None;
        }
        true
    }

    /// Whether this command was obeyed before and is only sent again.
    fn is_repeated(&self, command: &Command, now_ns: u64) -> bool {
        self.obeyed.as_slice().iter().any(|(before, at_ns)| {
            let age_ns = now_ns.saturating_sub(*at_ns);
            let bits = |c: &Command| c.params.map(f32::to_bits);
            let same_id = command.capture_id().is_some() && command.capture_id() == before.capture_id();
            let same = command.confirmation > 0 && bits(command) == bits(before);
            let limit_ns = if command.confirmation > 0 { CONFIRMED_RETRY_NS } else { RETRY_NS };
            (before.id, before.sender) == (command.id, command.sender) && age_ns < limit_ns && (same_id || same)
        })
    }
}

impl MavlinkCamera {
    pub(super) fn on_command(&mut self, command: &Command, now_ns: u64) {
        let result = self.obey(command, now_ns);
        // To all components: others may know what we do not.
        if command.to_all && result == MavResult::MAV_RESULT_UNSUPPORTED {
            return;
        }
        // The acknowledgement leaves before what was asked for.
        let (target_system, target_component) = command.sender;
        let ack =
            COMMAND_ACK_DATA { command: command.id, result, target_system, target_component, ..Default::default() };
        self.queue_first(Due::Ack(ack));
    }

    fn obey(&mut self, command: &Command, now_ns: u64) -> MavResult {
        use MavResult::{MAV_RESULT_ACCEPTED as ACCEPTED, MAV_RESULT_DENIED as DENIED};
        let [param1, param2, param3, _, param5] = command.params;
        #[expect(deprecated, reason = "ArduPilot and older ground stations still send the superseded requests")]
        let (requested, index) = match command.id {
            MavCmd::MAV_CMD_REQUEST_MESSAGE => (param1 as u32, param2),
            MavCmd::MAV_CMD_REQUEST_CAMERA_INFORMATION => (CAMERA_INFORMATION_DATA::ID, 0.0),
            MavCmd::MAV_CMD_REQUEST_CAMERA_SETTINGS => (CAMERA_SETTINGS_DATA::ID, 0.0),
            MavCmd::MAV_CMD_REQUEST_STORAGE_INFORMATION => (STORAGE_INFORMATION_DATA::ID, 0.0),
            MavCmd::MAV_CMD_REQUEST_CAMERA_CAPTURE_STATUS => (CAMERA_CAPTURE_STATUS_DATA::ID, 0.0),
            MavCmd::MAV_CMD_REQUEST_CAMERA_IMAGE_CAPTURE => (CAMERA_IMAGE_CAPTURED_DATA::ID, param1),
            _ => (0, 0.0),
        };
        match command.id {
            _ if requested != 0 => self.request(requested, index),
            // param1: the camera, where a command to all components means one; 0 is any.
            MavCmd::MAV_CMD_IMAGE_START_CAPTURE | MavCmd::MAV_CMD_IMAGE_STOP_CAPTURE
                if command.to_all && param1 > 0.0 && param1 != f32::from(self.component) =>
            {
                MavResult::MAV_RESULT_UNSUPPORTED
            }
            MavCmd::MAV_CMD_IMAGE_START_CAPTURE | MavCmd::MAV_CMD_DO_DIGICAM_CONTROL
                if self.captures.is_repeated(command, now_ns) =>
            {
                ACCEPTED
            }
            // param2 interval s, param3 count (0 = until stopped), param4 number of a single capture.
            MavCmd::MAV_CMD_IMAGE_START_CAPTURE => {
                let result = self.start(command.id as u32, param2, param3, now_ns);
                if result == ACCEPTED {
                    self.captures.obeyed.write((*command, now_ns));
                }
                result
            }
            MavCmd::MAV_CMD_IMAGE_STOP_CAPTURE => {
                self.captures.series = None;
                ACCEPTED
            }
            // param5 is the shot.
            MavCmd::MAV_CMD_DO_DIGICAM_CONTROL if param5 == 1.0 => {
                self.captures.obeyed.write((*command, now_ns));
                self.shoot(command.id as u32, now_ns);
                ACCEPTED
            }
            // QGroundControl's surveys set 2, which means pictures for a map.
            MavCmd::MAV_CMD_SET_CAMERA_MODE if param2 == 0.0 || param2 == 2.0 => {
                let survey = param2 == 2.0;
                self.mode = if survey { CameraMode::CAMERA_MODE_IMAGE_SURVEY } else { CameraMode::CAMERA_MODE_IMAGE };
                ACCEPTED
            }
            MavCmd::MAV_CMD_SET_CAMERA_MODE => DENIED,
            // param1 message, param2 interval µs: −1 off, 0 default.
            MavCmd::MAV_CMD_SET_MESSAGE_INTERVAL if param1 as u32 == CAMERA_CAPTURE_STATUS_DATA::ID => {
                let every_us = if param2 == 0.0 { 1e6 } else { param2 };
                if every_us > 0.0 && every_us < 1e5 {
                    return DENIED;
                }
                self.status = (every_us > 0.0).then_some(((f64::from(every_us) * 1e3) as u64, now_ns));
                ACCEPTED
            }
            MavCmd::MAV_CMD_SET_MESSAGE_INTERVAL => DENIED,
            _ => MavResult::MAV_RESULT_UNSUPPORTED,
        }
    }

    fn request(&mut self, message: u32, index: f32) -> MavResult {
        let due = match message {
            CAMERA_INFORMATION_DATA::ID
            | CAMERA_SETTINGS_DATA::ID
            | STORAGE_INFORMATION_DATA::ID
            | CAMERA_CAPTURE_STATUS_DATA::ID => Due::Message(message),
            CAMERA_IMAGE_CAPTURED_DATA::ID if index >= 0.0 && self.album.message(index as u32).is_some() => {
                Due::Captured(index as u32)
            }
            CAMERA_IMAGE_CAPTURED_DATA::ID => return MavResult::MAV_RESULT_DENIED,
            _ => return MavResult::MAV_RESULT_UNSUPPORTED,
        };
        self.queue(due);
        MavResult::MAV_RESULT_ACCEPTED
    }

    fn start(&mut self, by: u32, interval_s: f32, count: f32, now_ns: u64) -> MavResult {
        if count == 1.0 {
            self.shoot(by, now_ns);
            return MavResult::MAV_RESULT_ACCEPTED;
        }
        if !(LEAST_INTERVAL_S..=3600.0).contains(&interval_s) || !(0.0..=1e6).contains(&count) {
            return MavResult::MAV_RESULT_DENIED;
        }
        let left = if count == 0.0 { None } else { Some(count as u32) };
        let every_ns = (f64::from(interval_s) * 1e9) as u64;
        self.captures.series = Some(Series { every_ns, next_ns: now_ns, left });
        MavResult::MAV_RESULT_ACCEPTED
    }

    /// One picture, asked for by the command or message `by`.
    pub(super) fn shoot(&mut self, by: u32, now_ns: u64) {
        let twice = |(at_ns, other): (u64, u32)| other != by && now_ns.saturating_sub(at_ns) < SAME_CAPTURE_NS;
        if !self.captures.last.is_some_and(twice) {
            self.captures.last = Some((now_ns, by));
            self.capture();
        }
    }

    pub(super) fn capture(&mut self) {
        self.captures.count = self.captures.count.saturating_add(1);
        // A full queue means that nobody takes pictures; the announcement would be untrue.
        let _ = self.requests.push_back(Request::Capture(self.captures.count));
    }
}
