//! A recorded flight sent again over a living link, at its own pace, with a simulated camera that photographs the
//! ray-cast world from where the aircraft truly was.

use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use ::mavlink::{MAVLinkV2MessageRaw, Message, calculate_crc};
use config::faults::FaultSettings;

use super::Recording;
use crate::aircraft::{Exposure, Flight};
use crate::faulty_link::FaultyLink;
use crate::photographer::{Photographer, PictureCounters};
use crate::reference::Lens;
use crate::session::{self, SessionSettings};
use crate::world::{World, WorldSettings};
use crate::{SimError, camera_over};
use hal::error::{Error, ErrorKind};
use hal::link::LinkAddress;
use hal::mavlink::dialect::{HEARTBEAT_DATA, MavMessage, TIMESYNC_DATA};
use hal::mavlink::{Encoder, Framer};
use hal::traits::Link;

/// From the exposure to the finished file, seconds of flight.
const TRANSFER_S: f64 = 0.3;
/// Heartbeats of the vehicle after the recording's end, seconds of wall clock.
const HEARTBEAT_S: f64 = 1.0;

/// How a log is played.
#[derive(Clone, Debug)]
pub struct TlogSettings {
    /// Seed of world and faults.
    pub seed: u64,
    /// The world under the aircraft.
    pub world: WorldSettings,
    /// The camera's lens.
    pub lens: Lens,
    /// Speed relative to the recording (a log of an 8× simulator plays 8× at speed 1), and waiting.
    pub session: SessionSettings,
    /// Faults; those of the line and of the pictures act, the messages are what was recorded.
    pub faults: FaultSettings,
}

/// What was played.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct TlogReport {
    /// True when it was played to the end and every picture was delivered.
    pub completed: bool,
    /// Frames of the vehicle sent.
    pub frames_sent: u64,
    /// Frames the link would not take.
    pub frames_dropped: u64,
    /// Exposures announced in the log.
    pub exposures: u64,
    /// What was done with the pictures.
    pub pictures: PictureCounters,
    /// Stretches of the log that were no record.
    pub damaged: u64,
    /// The log ended inside a record.
    pub truncated: bool,
}

/// Plays the log at `path` on `address`. With `camera_dir`, every CAMERA_FEEDBACK brings a picture of the ray-cast world
/// from the SIM_STATE pose of that moment; with `reference_dir`, the truth is saved as a data set.
///
/// Requests for the time are answered from the recorded boot clock. `on_ready` and `stop` as in [`super::play`].
///
/// # Errors
/// A log without an autopilot, or without SIM_STATE when pictures are wanted; a link or folder that cannot be used.
pub fn play_tlog(
    path: &Path,
    settings: &TlogSettings,
    address: &LinkAddress,
    camera_dir: Option<&Path>,
    reference_dir: Option<&Path>,
    stop: &AtomicBool,
    on_ready: &mut dyn FnMut(Option<&Path>),
) -> Result<TlogReport, SimError> {
    settings.session.check()?;
    let recording = Recording::read(path)?;
    let mut camera = match camera_dir {
        Some(folder) => Some(camera(&recording, settings, folder, reference_dir)?),
        None => None,
    };
    let link = session::open(address, settings.seed, on_ready)?;
    let mut player = Player {
        link,
        framer: Framer::new(),
        encoder: Encoder::new(recording.ids.0, recording.ids.1),
        sequence: 0,
        sent: 0,
        dropped: 0,
        heard: false,
    };
    let begun = Instant::now();
    while !stop.load(Ordering::Relaxed)
        && !player.heard
        && begun.elapsed().as_secs_f64() < settings.session.wait_for_peer_s
    {
        player.listen(&|| recording.boot_s(0.0))?;
    }
    let start = Instant::now();
    let now = || start.elapsed().as_secs_f64() * settings.session.speed;
    let first_boot_s = recording.boot_s(0.0);
    let (mut next, mut over, mut beaten, mut completed) = (0, None::<Instant>, 0.0, false);
    while !stop.load(Ordering::Relaxed) {
        player.listen(&|| recording.boot_s(now()))?;
        let time_s = now();
        let boot_s = recording.boot_s(time_s);
        let acting = settings.faults.acting(boot_s - first_boot_s);
        player.link.set(acting);
        while let Some(record) = recording.records.get(next).filter(|r| r.time_s <= time_s) {
            player.send_recorded(&recording.bytes[record.range.0..record.range.1], recording.ids)?;
            next += 1;
        }
        if let Some(camera) = &mut camera {
            camera.deliver(boot_s, &acting)?;
        }
        if next == recording.records.len() && camera.as_ref().is_none_or(Photographer::done) {
            completed = true;
            let after = over.get_or_insert_with(Instant::now).elapsed().as_secs_f64();
            if after >= settings.session.linger_s {
                break;
            }
            if after >= beaten {
                player.beat()?;
                beaten += HEARTBEAT_S;
            }
        }
    }
    let pictures = match camera {
        Some(camera) => camera.finish(!completed)?,
        None => PictureCounters::default(),
    };
    Ok(TlogReport {
        completed,
        frames_sent: player.sent,
        frames_dropped: player.dropped,
        exposures: recording.exposures.len() as u64,
        pictures,
        damaged: recording.damaged,
        truncated: recording.truncated,
    })
}

/// The camera over the recorded flight; its time is the boot clock.
fn camera(
    recording: &Recording,
    settings: &TlogSettings,
    folder: &Path,
    reference_dir: Option<&Path>,
) -> Result<Photographer, SimError> {
    let Some(truth) = recording.truth.clone() else {
        return Err(SimError::Settings {
            what: "telemetry log",
            why: "holds no SIM_STATE, so there is no true pose to photograph from; play it without a camera folder"
                .into(),
        });
    };
    let exposures = recording.exposures.iter().map(|(boot_s, index)| Exposure {
        trigger_s: *boot_s,
        middle_s: *boot_s,
        ready_s: boot_s + TRANSFER_S,
        name: format!("IMG_{index:04}.jpg"),
    });
    let flight = Flight { origin: recording.home, reported: truth.clone(), truth, exposures: exposures.collect() };
    let world = Arc::new(World::new(settings.seed, &settings.world));
    camera_over(world, &flight, &settings.lens, folder, reference_dir, settings.seed)
}

/// The vehicle's end of the link.
struct Player {
    link: FaultyLink,
    framer: Framer,
    encoder: Encoder,
    sequence: u8,
    sent: u64,
    dropped: u64,
    heard: bool,
}

impl Player {
    /// Sends a recorded frame of the autopilot, with a sequence number of its own so that the answers given in between
    /// leave no gaps. Frames of others (ground station, companion) are not repeated: they are not the vehicle's.
    fn send_recorded(&mut self, frame: &[u8], ids: (u8, u8)) -> Result<(), SimError> {
        let mut raw = MAVLinkV2MessageRaw::new();
        let v2 = frame.first() == Some(&0xFD);
        let (system_at, sequence_at) = if v2 { (5, 4) } else { (3, 2) };
        if frame.len() < 8 || frame.len() > raw.as_slice().len() || (frame[system_at], frame[system_at + 1]) != ids {
            return Ok(());
        }
        let target = &mut raw.as_mut_slice()[..frame.len()];
        target.copy_from_slice(frame);
        let signed = v2 && frame[2] & 1 != 0;
        if !signed {
            let id = if v2 { u32::from_le_bytes([frame[7], frame[8], frame[9], 0]) } else { u32::from(frame[5]) };
            target[sequence_at] = self.sequence;
            self.sequence = self.sequence.wrapping_add(1);
            let end = frame.len() - 2;
            let crc = calculate_crc(&target[1..end], MavMessage::extra_crc(id));
            target[end..].copy_from_slice(&crc.to_le_bytes());
        }
        let target = &raw.as_slice()[..frame.len()];
        Self::count(self.link.write(target), &mut self.sent, &mut self.dropped)
    }

    /// Sends a message of the player's own in the autopilot's name.
    fn say<D: hal::mavlink::MessageData>(&mut self, message: &D) -> Result<(), SimError> {
        self.encoder.set_sequence(self.sequence);
        self.sequence = self.sequence.wrapping_add(1);
        let frame = self.encoder.encode(message, None);
        Self::count(self.link.write(frame), &mut self.sent, &mut self.dropped)
    }

    fn count(result: Result<(), hal::error::HalError>, sent: &mut u64, dropped: &mut u64) -> Result<(), SimError> {
        match result {
            Ok(()) => *sent += 1,
            Err(e) if e.kind() == ErrorKind::Busy => *dropped += 1,
            Err(e) => return Err(e.into()),
        }
        Ok(())
    }

    fn beat(&mut self) -> Result<(), SimError> {
        self.say(&crate::messages::heartbeat())
    }

    /// Reads for a moment and answers requests for the time.
    fn listen(&mut self, boot_s: &dyn Fn() -> f64) -> Result<(), SimError> {
        let received = self.link.read(self.framer.space(), Duration::from_millis(1))?;
        self.framer.filled(received.bytes);
        loop {
            let Some(frame) = self.framer.next_frame() else { return Ok(()) };
            let request = frame.message::<TIMESYNC_DATA>();
            let (target_system, target_component) = (frame.system(), frame.component());
            self.heard |= request.is_some() || frame.message::<HEARTBEAT_DATA>().is_some();
            if let Some(m) = request.filter(|m| m.tc1 == 0) {
                let tc1 = (boot_s() * 1e9) as i64;
                self.say(&TIMESYNC_DATA { tc1, ts1: m.ts1, target_system, target_component })?;
            }
        }
    }
}
