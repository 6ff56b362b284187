//! Acting as a MAVLink camera, so that ArduPilot (CAM1_TYPE 6), PX4 and QGroundControl find one and drive it: heartbeat,
//! information on request, capture commands answered at once, everything else refused politely. A state machine without
//! I/O: frames in, replies out.

use heapless::Deque;

use crate::mavlink::dialect::{
    CAMERA_CAPTURE_STATUS_DATA, CAMERA_IMAGE_CAPTURED_DATA, CAMERA_INFORMATION_DATA, CAMERA_SETTINGS_DATA,
    COMMAND_ACK_DATA, COMMAND_LONG_DATA, CameraCapFlags, CameraMode, HEARTBEAT_DATA, MavAutopilot, MavCmd, MavResult,
    MavState, MavType, STORAGE_INFORMATION_DATA, StorageStatus,
};
use crate::mavlink::{Frame, MessageData};

/// Replies waiting to be sent.
const REPLIES: usize = 16;
/// Captures asked for and not yet made.
const REQUESTS: usize = 8;
/// Shortest interval of a series, s; shorter ones are denied (no companion computer can train on them).
const LEAST_INTERVAL_S: f32 = 0.1;
/// PX4 sends IMAGE_START_CAPTURE and DO_DIGICAM_CONTROL for the same exposure: one capture within this.
const SAME_CAPTURE_NS: u64 = 200_000_000;

/// What the camera says about itself.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct CameraInfo {
    /// Picture width, pixels.
    pub width: u32,
    /// Picture height, pixels.
    pub height: u32,
}

/// Something the camera was asked to do.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Request {
    /// Take one picture now; the counter of this capture.
    Capture(u32),
}

/// A message to send.
#[derive(Clone, Debug)]
pub enum Reply {
    /// COMMAND_ACK
    Ack(COMMAND_ACK_DATA),
    /// CAMERA_INFORMATION
    Information(CAMERA_INFORMATION_DATA),
    /// CAMERA_SETTINGS
    Settings(CAMERA_SETTINGS_DATA),
    /// STORAGE_INFORMATION
    Storage(STORAGE_INFORMATION_DATA),
    /// CAMERA_CAPTURE_STATUS
    Status(CAMERA_CAPTURE_STATUS_DATA),
    /// CAMERA_IMAGE_CAPTURED
    Captured(CAMERA_IMAGE_CAPTURED_DATA),
}

/// What to send once the boot time is known.
#[derive(Clone, Debug)]
#[expect(clippy::large_enum_variant, reason = "no heap here; the queue is a few KiB")]
enum Due {
    Ack(COMMAND_ACK_DATA),
    Message(u32),
    Captured(CAMERA_IMAGE_CAPTURED_DATA),
}

/// A series of captures (an intervalometer set by IMAGE_START_CAPTURE).
#[derive(Clone, Copy, Debug)]
struct Series {
    every_ns: u64,
    next_ns: u64,
    /// `None` = until stopped.
    left: Option<u32>,
}

/// The MAVLink camera.
pub struct MavlinkCamera {
    info: CameraInfo,
    component: u8,
    due: Deque<Due, REPLIES>,
    requests: Deque<u32, REQUESTS>,
    captures: u32,
    pictures: i32,
    last_capture_ns: Option<u64>,
    series: Option<Series>,
    /// SET_MESSAGE_INTERVAL for CAMERA_CAPTURE_STATUS: period and next time.
    status: Option<(u64, u64)>,
}

impl MavlinkCamera {
    /// A camera with this component id.
    pub fn new(info: CameraInfo, component: u8) -> Self {
        Self {
            info,
            component,
            due: Deque::new(),
            requests: Deque::new(),
            captures: 0,
            pictures: 0,
            last_capture_ns: None,
            series: None,
            status: None,
        }
    }

    /// The heartbeat to send at 1 Hz.
    pub fn heartbeat(&self) -> HEARTBEAT_DATA {
        HEARTBEAT_DATA {
            mavtype: MavType::MAV_TYPE_CAMERA,
            autopilot: MavAutopilot::MAV_AUTOPILOT_INVALID,
            system_status: MavState::MAV_STATE_ACTIVE,
            mavlink_version: 3,
            ..HEARTBEAT_DATA::default()
        }
    }

    /// Takes a frame from anyone; only commands to us (or to all cameras of our system) matter. Ground stations are other
    /// systems and may command us.
    pub fn handle(&mut self, frame: &Frame<'_>, own_system: u8, now_ns: u64) {
        if frame.id() != COMMAND_LONG_DATA::ID {
            return;
        }
        let Some(m) = frame.message::<COMMAND_LONG_DATA>() else { return };
        // 0 is everybody: PX4 sends DO_DIGICAM_CONTROL to the cameras of all systems.
        let to_us = |target: u8, us: u8| target == us || target == 0;
        if !to_us(m.target_system, own_system) || !to_us(m.target_component, self.component) {
            return;
        }
        let result = self.command(&m, now_ns);
        // To all components: others may know what we do not.
        if m.target_component == 0 && result == MavResult::MAV_RESULT_UNSUPPORTED {
            return;
        }
        // The acknowledgement leaves before what was asked for.
        let ack = COMMAND_ACK_DATA {
            command: m.command,
            result,
            target_system: frame.system(),
            target_component: frame.component(),
            ..COMMAND_ACK_DATA::default()
        };
        self.queue_first(Due::Ack(ack));
    }

    /// A picture was taken and posed: everyone is told.
    pub fn captured(&mut self, message: CAMERA_IMAGE_CAPTURED_DATA) {
        self.pictures = self.pictures.saturating_add(1);
        self.queue(Due::Captured(message));
    }

    /// The next thing to do.
    pub fn next_request(&mut self, now_ns: u64) -> Option<Request> {
        if let Some(series) = &mut self.series
            && now_ns >= series.next_ns
        {
            series.next_ns = now_ns + series.every_ns;
            series.left = series.left.map(|n| n.saturating_sub(1));
            if series.left == Some(0) {
                self.series = None;
            }
            self.capture(now_ns);
        }
        self.requests.pop_front().map(Request::Capture)
    }

    /// The next message to send.
    pub fn next_reply(&mut self, boot_ms: u32, now_ns: u64) -> Option<Reply> {
        if let Some((every_ns, next_ns)) = &mut self.status
            && now_ns >= *next_ns
        {
            *next_ns = now_ns + *every_ns;
            self.queue(Due::Message(CAMERA_CAPTURE_STATUS_DATA::ID));
        }
        Some(match self.due.pop_front()? {
            Due::Ack(ack) => Reply::Ack(ack),
            Due::Captured(message) => Reply::Captured(CAMERA_IMAGE_CAPTURED_DATA { time_boot_ms: boot_ms, ..message }),
            Due::Message(CAMERA_INFORMATION_DATA::ID) => Reply::Information(self.information(boot_ms)),
            Due::Message(CAMERA_SETTINGS_DATA::ID) => Reply::Settings(CAMERA_SETTINGS_DATA {
                time_boot_ms: boot_ms,
                mode_id: CameraMode::CAMERA_MODE_IMAGE,
                zoomLevel: f32::NAN,
                focusLevel: f32::NAN,
                ..CAMERA_SETTINGS_DATA::default()
            }),
            Due::Message(STORAGE_INFORMATION_DATA::ID) => Reply::Storage(STORAGE_INFORMATION_DATA {
                time_boot_ms: boot_ms,
                storage_id: 1,
                storage_count: 1,
                status: StorageStatus::STORAGE_STATUS_NOT_SUPPORTED,
                ..STORAGE_INFORMATION_DATA::default()
            }),
            Due::Message(_) => Reply::Status(CAMERA_CAPTURE_STATUS_DATA {
                time_boot_ms: boot_ms,
                // 0 idle, 2 interval set but idle.
                image_status: if self.series.is_some() { 2 } else { 0 },
                image_interval: self.series.map_or(0.0, |s| s.every_ns as f32 * 1e-9),
                available_capacity: f32::NAN,
                image_count: self.pictures,
                ..CAMERA_CAPTURE_STATUS_DATA::default()
            }),
        })
    }

    fn information(&self, boot_ms: u32) -> CAMERA_INFORMATION_DATA {
        let name = |text: &str| {
            let mut bytes = [0; 32];
            bytes[..text.len()].copy_from_slice(text.as_bytes());
            bytes
        };
        CAMERA_INFORMATION_DATA {
            time_boot_ms: boot_ms,
            vendor_name: name("dgtr"),
            model_name: name("companion"),
            firmware_version: 1,
            focal_length: f32::NAN,
            sensor_size_h: f32::NAN,
            sensor_size_v: f32::NAN,
            resolution_h: self.info.width.min(u16::MAX.into()) as u16,
            resolution_v: self.info.height.min(u16::MAX.into()) as u16,
            flags: CameraCapFlags::CAMERA_CAP_FLAGS_CAPTURE_IMAGE,
            ..CAMERA_INFORMATION_DATA::default()
        }
    }

    fn command(&mut self, m: &COMMAND_LONG_DATA, now_ns: u64) -> MavResult {
        use MavResult::{MAV_RESULT_ACCEPTED as ACCEPTED, MAV_RESULT_DENIED as DENIED};
        #[expect(deprecated, reason = "ArduPilot and older ground stations still send the superseded requests")]
        let requested = match m.command {
            MavCmd::MAV_CMD_REQUEST_MESSAGE => m.param1 as u32,
            MavCmd::MAV_CMD_REQUEST_CAMERA_INFORMATION => CAMERA_INFORMATION_DATA::ID,
            MavCmd::MAV_CMD_REQUEST_CAMERA_SETTINGS => CAMERA_SETTINGS_DATA::ID,
            MavCmd::MAV_CMD_REQUEST_STORAGE_INFORMATION => STORAGE_INFORMATION_DATA::ID,
            MavCmd::MAV_CMD_REQUEST_CAMERA_CAPTURE_STATUS => CAMERA_CAPTURE_STATUS_DATA::ID,
            _ => 0,
        };
        match m.command {
            _ if requested != 0 => match requested {
                CAMERA_INFORMATION_DATA::ID
                | CAMERA_SETTINGS_DATA::ID
                | STORAGE_INFORMATION_DATA::ID
                | CAMERA_CAPTURE_STATUS_DATA::ID => {
                    self.queue(Due::Message(requested));
                    ACCEPTED
                }
                _ => MavResult::MAV_RESULT_UNSUPPORTED,
            },
            // param2 interval s, param3 count (0 = until stopped), param4 sequence for single captures.
            MavCmd::MAV_CMD_IMAGE_START_CAPTURE => self.start(m.param2, m.param3, now_ns),
            MavCmd::MAV_CMD_IMAGE_STOP_CAPTURE => {
                self.series = None;
                ACCEPTED
            }
            // param5 is the shot.
            MavCmd::MAV_CMD_DO_DIGICAM_CONTROL if m.param5 == 1.0 => self.start(0.0, 1.0, now_ns),
            MavCmd::MAV_CMD_SET_CAMERA_MODE if m.param2 == 0.0 => ACCEPTED,
            MavCmd::MAV_CMD_SET_CAMERA_MODE => DENIED,
            // param1 message, param2 interval µs: −1 off, 0 default.
            MavCmd::MAV_CMD_SET_MESSAGE_INTERVAL if m.param1 as u32 == CAMERA_CAPTURE_STATUS_DATA::ID => {
                let every_us = if m.param2 == 0.0 { 1e6 } else { m.param2 };
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

    fn start(&mut self, interval_s: f32, count: f32, now_ns: u64) -> MavResult {
        if count == 1.0 {
            self.capture(now_ns);
            return MavResult::MAV_RESULT_ACCEPTED;
        }
        if !(LEAST_INTERVAL_S..=3600.0).contains(&interval_s) || !(0.0..=1e6).contains(&count) {
            return MavResult::MAV_RESULT_DENIED;
        }
        let left = if count == 0.0 { None } else { Some(count as u32) };
        self.series = Some(Series { every_ns: (f64::from(interval_s) * 1e9) as u64, next_ns: now_ns, left });
        MavResult::MAV_RESULT_ACCEPTED
    }

    fn capture(&mut self, now_ns: u64) {
        if self.last_capture_ns.is_some_and(|t| now_ns.saturating_sub(t) < SAME_CAPTURE_NS && self.series.is_none()) {
            return;
        }
        self.last_capture_ns = Some(now_ns);
        self.captures = self.captures.saturating_add(1);
        // A full queue means that nobody takes pictures; the announcement would be untrue.
        let _ = self.requests.push_back(self.captures);
    }

    fn queue(&mut self, due: Due) {
        if self.due.is_full() {
            self.due.pop_front();
        }
        let _ = self.due.push_back(due);
    }

    fn queue_first(&mut self, due: Due) {
        if self.due.is_full() {
            self.due.pop_back();
        }
        let _ = self.due.push_front(due);
    }
}

#[cfg(test)]
mod tests;
