//! What keeps a vehicle from posing pictures, named within ten seconds of listening: while there is somebody who can mend it.

use heapless::Vec;

use super::{Event, Vehicle};
use crate::camera::Picture;
use crate::error::HalError;
use crate::link::LinkAddress;
use crate::mavlink::Frame;
use crate::mavlink::MessageData;
use crate::mavlink::dialect::{HEARTBEAT_DATA, MavAutopilot, MavSeverity, PARAM_REQUEST_READ_DATA};
use crate::traits::{Camera, Clock, Link, LinkState};

/// An autopilot that is there was heard by then: it proves itself by three heartbeats at 1 Hz.
const HEARD_AFTER_NS: u64 = 8_000_000_000;
const EVERY_NS: u64 = 1_000_000_000;
/// So many pictures that nobody announced are no test of the shutter.
const UNANNOUNCED: u64 = 3;
/// Bytes that are no message: a line whose other end speaks at another rate gives noise.
const NOISE: u64 = 64;
/// The parameter of the trigger is asked for so often.
const ASKED: u8 = 3;
/// Other systems that are named.
const SYSTEMS: usize = 8;

/// What is wrong.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Complaint {
    /// The link cannot be opened.
    Closed,
    /// No autopilot speaks on it.
    Nobody,
    /// What comes is no MAVLink.
    Noise,
    /// The mission's system is not among those that are heard.
    OtherSystem,
    /// Signing refuses what is heard.
    Signing,
    /// The autopilot triggers no camera.
    NoTrigger,
    /// Pictures come that nobody announces.
    Unannounced,
    /// The camera's folder is missing.
    NoFolder,
}

impl Complaint {
    /// All of them, what hides others first.
    pub const ALL: [Self; 8] = [
        Self::Closed,
        Self::Nobody,
        Self::Noise,
        Self::OtherSystem,
        Self::Signing,
        Self::NoFolder,
        Self::NoTrigger,
        Self::Unannounced,
    ];

    /// In a few words.
    pub fn name(self) -> &'static str {
        match self {
            Self::Closed => "the link cannot be opened",
            Self::Nobody => "no autopilot is heard",
            Self::Noise => "no MAVLink is heard",
            Self::OtherSystem => "only other systems are heard",
            Self::Signing => "signing refuses what is heard",
            Self::NoTrigger => "the autopilot triggers no camera",
            Self::Unannounced => "no exposure is announced",
            Self::NoFolder => "the camera's folder is missing",
        }
    }
}

/// What was seen of it.
#[derive(Default)]
pub(super) struct Complaints {
    started_ns: Option<u64>,
    next_ns: u64,
    standing: [bool; Complaint::ALL.len()],
    /// Autopilots that are heard, whoever they are.
    systems: Vec<u8, SYSTEMS>,
    asked: u8,
    first_picture_ns: Option<u64>,
}

impl Complaints {
    pub(super) fn hear(&mut self, frame: &Frame<'_>) {
        let system = frame.system();
        if frame.id() == HEARTBEAT_DATA::ID
            && !self.systems.contains(&system)
            && frame.message::<HEARTBEAT_DATA>().is_some_and(|h| h.autopilot != MavAutopilot::MAV_AUTOPILOT_INVALID)
        {
            // A ninth is one too many to name.
            let _ = self.systems.push(system);
        }
    }
}

/// Looks for what is wrong, now and then; says what begins and what is over, in the log, to the ground station and as an event.
pub(super) fn look<L, C, K>(vehicle: &mut Vehicle<L, C, K>, now_ns: u64)
where
    L: Link<Error = HalError>,
    C: Camera<Picture = Picture, Error = HalError>,
    K: Clock,
{
    let is_recording = matches!(vehicle.settings.address, LinkAddress::File(_));
    if now_ns < vehicle.service.complaints.next_ns || is_recording || vehicle.finished {
        return;
    }
    vehicle.service.complaints.next_ns = now_ns + EVERY_NS;
    let started_ns = *vehicle.service.complaints.started_ns.get_or_insert(now_ns);
    if vehicle.pictures() > 0 {
        vehicle.service.complaints.first_picture_ns.get_or_insert(now_ns);
    }
    ask_for_trigger(vehicle);
    let due = now_ns.saturating_sub(started_ns) >= HEARD_AFTER_NS;
    for (i, what) in Complaint::ALL.into_iter().enumerate() {
        let stands = stands(vehicle, what, due, now_ns);
        if stands == vehicle.service.complaints.standing[i] {
            continue;
        }
        vehicle.service.complaints.standing[i] = stands;
        let line = stands.then(|| line(vehicle, what));
        match &line {
            Some(line) => {
                tracing::warn!("{line}");
                vehicle.status_text(MavSeverity::MAV_SEVERITY_WARNING, &format!("dgtr: {line}"));
            }
            None => tracing::info!("{}: no longer so", what.name()),
        }
        vehicle.events.push(Event::Complaint { what, line });
    }
}

/// Asks for the parameter that says whether the autopilot triggers a camera, once it is heard.
fn ask_for_trigger<L: Link<Error = HalError>, C, K>(vehicle: &mut Vehicle<L, C, K>) {
    let (trigger, ids) = (vehicle.autopilot.camera_trigger(), vehicle.autopilot.ids());
    let Some(name) = trigger.parameter().filter(|_| vehicle.service.complaints.asked < ASKED) else { return };
    if trigger.is_set().is_some() || ids.system == 0 {
        return;
    }
    vehicle.service.complaints.asked += 1;
    let request = PARAM_REQUEST_READ_DATA {
        param_index: -1,
        target_system: ids.system,
        target_component: ids.autopilot,
        param_id: name.into(),
    };
    // Asked again where the link does not take it.
    let _ = vehicle.channel.send(&request);
}

fn stands<L, C, K>(vehicle: &Vehicle<L, C, K>, complaint: Complaint, due: bool, now_ns: u64) -> bool
where
    L: Link<Error = HalError>,
    C: Camera<Picture = Picture, Error = HalError>,
    K: Clock,
{
    let wire = vehicle.channel.counters();
    let refused = wire.wrong_key + wire.unsigned + wire.replayed;
    let state = vehicle.channel.link().state();
    let unheard = vehicle.autopilot().heartbeat_ns.is_none();
    let wanted = vehicle.settings.system_id;
    let systems = &vehicle.service.complaints.systems;
    let announced = vehicle.autopilot.counters().exposures.triggers > 0;
    let unsigned = due && unheard && refused > 0 && 2 * refused >= wire.frames.frames;
    let noisy = wire.frames.frames == 0 && wire.frames.skipped_bytes >= NOISE;
    let quiet = due && unheard && state == LinkState::Up && systems.is_empty() && !unsigned;
    match complaint {
        Complaint::Closed => unheard && state == LinkState::Down,
        Complaint::Nobody => quiet && !noisy,
        Complaint::Noise => quiet && noisy,
        Complaint::OtherSystem => due && unheard && wanted != 0 && !systems.is_empty() && !systems.contains(&wanted),
        Complaint::Signing => unsigned,
        Complaint::NoTrigger => {
            !vehicle.is_free_running() && !announced && vehicle.autopilot.camera_trigger().is_set() == Some(false)
        }
        Complaint::Unannounced => {
            let since_ns = vehicle.service.complaints.first_picture_ns.unwrap_or(now_ns);
            let waited = now_ns.saturating_sub(since_ns) >= HEARD_AFTER_NS;
            !vehicle.is_free_running() && !unheard && !announced && waited && vehicle.pictures() >= UNANNOUNCED
        }
        Complaint::NoFolder => vehicle.camera.is_missing(),
    }
}

/// What is wrong, with its figures, and how to mend it: one line.
fn line<L, C, K>(vehicle: &Vehicle<L, C, K>, complaint: Complaint) -> String
where
    L: Link<Error = HalError>,
    C: Camera<Picture = Picture, Error = HalError>,
    K: Clock,
{
    let (wire, address) = (vehicle.channel.counters(), &vehicle.settings.address);
    let name = complaint.name();
    match complaint {
        Complaint::Closed => {
            let why = vehicle.channel.link().why_down().unwrap_or_else(|| address.to_string());
            format!("{name} and is waited for: {why}")
        }
        Complaint::Nobody => {
            let others = match wire.frames.frames {
                0 => String::new(),
                frames => format!(", only {frames} messages of others"),
            };
            format!("{name} on {address}{others}; let the autopilot or its router send there, and check the port")
        }
        Complaint::Noise => {
            format!("{name} on {address}, {} bytes of something else; check its baud rate", wire.frames.skipped_bytes)
        }
        Complaint::OtherSystem => {
            let heard: std::vec::Vec<String> = vehicle.service.complaints.systems.iter().map(u8::to_string).collect();
            format!(
                "{name}: {}, not system_id = {}; mend it in the mission, or in the autopilot (SYSID_THISMAV, MAV_SYSID, MAV_SYS_ID)",
                heard.join(", "),
                vehicle.settings.system_id
            )
        }
        Complaint::Signing => format!(
            "{name}: {} messages unsigned, {} of another key, {} with an old time stamp; give the autopilot the key of [link] signing_key, or set signing",
            wire.unsigned, wire.wrong_key, wire.replayed
        ),
        Complaint::NoTrigger => format!(
            "{name}: its {} is 0; set it, or [link] free_running for a camera that nobody triggers",
            vehicle.autopilot.camera_trigger().parameter().unwrap_or("trigger")
        ),
        Complaint::Unannounced => format!(
            "{name} for {} pictures; check the autopilot's camera trigger, or set [link] free_running",
            vehicle.pictures()
        ),
        Complaint::NoFolder => {
            let folder = match &vehicle.settings.camera {
                Some(config::mission::CameraSource::Folder(folder)) => folder.display().to_string(),
                _ => String::new(),
            };
            format!("{name} and is waited for: {folder}; create it or correct the mission's camera")
        }
    }
}
