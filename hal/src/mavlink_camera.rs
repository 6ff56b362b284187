//! Acting as a MAVLink camera, so that ArduPilot (CAM1_TYPE 6), PX4 and QGroundControl find one and drive it: heartbeat,
//! information on request, capture commands answered at once, its definition file by MAVLink FTP and its parameters,
//! everything else refused politely. A state machine without I/O: frames in, replies out.

mod album;
mod commands;
mod definition;
mod ftp;
mod parameters;
mod talk;

use core::cell::OnceCell;

use heapless::Deque;

use crate::mavlink::dialect::{
    CAMERA_CAPTURE_STATUS_DATA, CAMERA_INFORMATION_DATA, CAMERA_SETTINGS_DATA, COMMAND_ACK_DATA, COMMAND_INT_DATA,
    COMMAND_LONG_DATA, CameraCapFlags, CameraMode, DIGICAM_CONTROL_DATA, FILE_TRANSFER_PROTOCOL_DATA, HEARTBEAT_DATA,
    MavAutopilot, MavState, MavType, PARAM_EXT_ACK_DATA, PARAM_EXT_REQUEST_LIST_DATA, PARAM_EXT_REQUEST_READ_DATA,
    PARAM_EXT_SET_DATA, STORAGE_INFORMATION_DATA, StorageStatus,
};
use crate::mavlink::{Frame, MessageData};
pub use parameters::{Activity, COUNT, Kind, Parameter, ParameterId, TABLE};
pub use talk::{CameraInfo, Reply, Request};

use album::Album;
pub use album::Shot;
use commands::{Captures, Command};
use definition::{Definition, MODEL, VENDOR};
use ftp::FileServer;
use parameters::{Asked, Parameters};

/// Replies waiting to be sent.
const REPLIES: usize = 16;
/// Captures asked for and not yet made.
const REQUESTS: usize = 8;
/// Between two messages of a file or a list: 11 kB/s, what a line of 115,200 baud carries.
const BULK_EVERY_NS: u64 = 25_000_000;

/// Where the definition file is: with this component, by MAVLink FTP.
const URI: &str = "mftp:///definition.xml";

/// What to send once the boot time is known.
#[derive(Clone, Debug)]
enum Due {
    Ack(COMMAND_ACK_DATA),
    Message(u32),
    /// The picture with this index.
    Captured(u32),
    Set(PARAM_EXT_ACK_DATA),
}

/// The MAVLink camera.
pub struct MavlinkCamera {
    info: CameraInfo,
    component: u8,
    due: Deque<Due, REPLIES>,
    requests: Deque<Request, REQUESTS>,
    captures: Captures,
    album: Album,
    mode: CameraMode,
    /// SET_MESSAGE_INTERVAL for CAMERA_CAPTURE_STATUS: period and next time.
    status: Option<(u64, u64)>,
    /// Made when somebody first asks.
    definition: OnceCell<Definition>,
    files: FileServer,
    parameters: Parameters,
    next_bulk_ns: u64,
}

impl MavlinkCamera {
    /// A camera with this component id.
    pub fn new(info: CameraInfo, component: u8) -> Self {
        Self {
            info,
            component,
            due: Deque::new(),
            requests: Deque::new(),
            captures: Captures::default(),
            album: Album::default(),
            mode: CameraMode::CAMERA_MODE_IMAGE,
            status: None,
            definition: OnceCell::new(),
            files: FileServer::default(),
            parameters: Parameters::default(),
            next_bulk_ns: 0,
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

    /// Takes a frame from anyone; only what is for us (or for all cameras of our system) matters. Ground stations are other
    /// systems and may command us.
    pub fn handle(&mut self, frame: &Frame<'_>, own_system: u8, now_ns: u64) {
        // 0 is everybody: PX4 sends DO_DIGICAM_CONTROL to the cameras of all systems.
        let own_component = self.component;
        let to_us = |system: u8, component: u8| {
            (system == own_system || system == 0) && (component == own_component || component == 0)
        };
        if let Some(m) = frame.message::<COMMAND_LONG_DATA>() {
            if to_us(m.target_system, m.target_component) {
                self.on_command(&Command::from_long(&m, frame), now_ns);
            }
        } else if let Some(m) = frame.message::<COMMAND_INT_DATA>() {
            if to_us(m.target_system, m.target_component) {
                self.on_command(&Command::from_int(&m, frame), now_ns);
            }
        } else if let Some(m) = frame.message::<DIGICAM_CONTROL_DATA>() {
            // What DO_DIGICAM_CONTROL was before it became a command; nobody expects an answer.
            if to_us(m.target_system, m.target_component) && m.shot == 1 {
                self.shoot(frame.id(), now_ns);
            }
        } else if let Some(m) = frame.message::<FILE_TRANSFER_PROTOCOL_DATA>() {
            // A file is asked of one component.
            if (m.target_system, m.target_component) == (own_system, own_component) {
                let file = self.definition.get_or_init(Definition::new).bytes();
                self.files.handle(&m, (frame.system(), frame.component()), file, now_ns);
            }
        } else if let Some(m) = frame.message::<PARAM_EXT_REQUEST_LIST_DATA>() {
            if to_us(m.target_system, m.target_component) {
                self.parameters.list();
            }
        } else if let Some(m) = frame.message::<PARAM_EXT_REQUEST_READ_DATA>() {
            if to_us(m.target_system, m.target_component) {
                self.parameters.read(&m);
            }
        } else if let Some(m) = frame.message::<PARAM_EXT_SET_DATA>()
            && to_us(m.target_system, m.target_component)
        {
            match self.parameters.set(&m) {
                Asked::Answer(ack) => self.queue_first(Due::Set(ack)),
                // A full queue means that nobody obeys; whoever asks hears nothing and asks again.
                Asked::Set(id, value) => drop(self.requests.push_back(Request::Set(id, value))),
            }
        }
    }

    /// What a ground station is shown of the job: a count, a share in percent, or the number of a word. Bounded by the table.
    pub fn note_count(&mut self, id: ParameterId, value: u32) {
        self.parameters.note_count(id, value);
    }

    /// As [`MavlinkCamera::note_count`], of a setting.
    pub fn note_setting(&mut self, id: ParameterId, value: f32) {
        self.parameters.note_real(id, value);
    }

    /// The answer to a [`Request::Set`]: what it is now, or `None` when that cannot be obeyed.
    pub fn answer(&mut self, id: ParameterId, obeyed: Option<f32>) {
        let ack = self.parameters.answer(id, obeyed);
        self.queue(Due::Set(ack));
    }

    /// A picture was taken and posed: everyone is told, and may ask again.
    pub fn captured(&mut self, shot: Shot) {
        let index = self.album.add(shot);
        self.queue(Due::Captured(index));
    }

    /// The next thing to do.
    pub fn next_request(&mut self, now_ns: u64) -> Option<Request> {
        if self.captures.is_due(now_ns) {
            self.capture();
        }
        self.requests.pop_front()
    }

    /// The next message to send.
    pub fn next_reply(&mut self, boot_ms: u32, now_ns: u64) -> Option<Reply> {
        if let Some((every_ns, next_ns)) = &mut self.status
            && now_ns >= *next_ns
        {
            *next_ns = now_ns + *every_ns;
            self.queue(Due::Message(CAMERA_CAPTURE_STATUS_DATA::ID));
        }
        let Some(due) = self.due.pop_front() else { return self.next_bulk(now_ns) };
        let interval_s = self.captures.interval_s();
        Some(match due {
            Due::Ack(ack) => Reply::Ack(ack),
            Due::Set(ack) => Reply::Set(ack),
            Due::Captured(index) => Reply::Captured(self.album.message(index)?),
            Due::Message(CAMERA_INFORMATION_DATA::ID) => Reply::Information(self.information(boot_ms)),
            Due::Message(CAMERA_SETTINGS_DATA::ID) => Reply::Settings(CAMERA_SETTINGS_DATA {
                time_boot_ms: boot_ms,
                mode_id: self.mode,
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
                image_status: if interval_s.is_some() { 2 } else { 0 },
                image_interval: interval_s.unwrap_or(0.0),
                available_capacity: f32::NAN,
                image_count: self.album.count() as i32,
                ..CAMERA_CAPTURE_STATUS_DATA::default()
            }),
        })
    }

    /// The next message of a file or a list, which must not fill the line.
    fn next_bulk(&mut self, now_ns: u64) -> Option<Reply> {
        let may = now_ns >= self.next_bulk_ns;
        let file = self.definition.get().map_or(&[][..], Definition::bytes);
        let bursts = self.files.bursts();
        if let Some(m) = self.files.next(file, may) {
            self.next_bulk_ns = if bursts { now_ns + BULK_EVERY_NS } else { self.next_bulk_ns };
            return Some(Reply::File(m));
        }
        let value = if may { self.parameters.next()? } else { return None };
        self.next_bulk_ns = now_ns + BULK_EVERY_NS;
        Some(Reply::Value(value))
    }

    fn information(&self, boot_ms: u32) -> CAMERA_INFORMATION_DATA {
        let name = |text: &str| {
            let mut bytes = [0; 32];
            bytes[..text.len()].copy_from_slice(text.as_bytes());
            bytes
        };
        CAMERA_INFORMATION_DATA {
            time_boot_ms: boot_ms,
            vendor_name: name(VENDOR),
            model_name: name(MODEL),
            firmware_version: 1,
            focal_length: f32::NAN,
            sensor_size_h: f32::NAN,
            sensor_size_v: f32::NAN,
            resolution_h: self.info.width.min(u16::MAX.into()) as u16,
            resolution_v: self.info.height.min(u16::MAX.into()) as u16,
            flags: CameraCapFlags::CAMERA_CAP_FLAGS_CAPTURE_IMAGE,
            cam_definition_version: self.definition.get_or_init(Definition::new).version(),
            cam_definition_uri: URI.into(),
            ..CAMERA_INFORMATION_DATA::default()
        }
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
