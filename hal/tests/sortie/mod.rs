//! A flight on a simulated clock through the whole HAL: what an autopilot and others send, and pictures, each at its own time.

use std::collections::{HashMap, VecDeque};
use std::sync::{Arc, Mutex};
use std::time::Duration;

use config::link::LinkSettings;
use config::mission::{CameraSettings, MountAttitude, MountSettings};
use geometry::geodesy::{EnuFrame, Geodetic};
use glam::DVec3;
use hal::camera::Picture;
use hal::counters::HalCounters;
use hal::error::HalError;
use hal::link::LinkAddress;
use hal::mavlink::dialect::{
    ATTITUDE_DATA, GLOBAL_POSITION_INT_DATA, HEARTBEAT_DATA, MavAutopilot, MavModeFlag, MavType, STATUSTEXT_DATA,
    SYSTEM_TIME_DATA,
};
use hal::mavlink::{Encoder, Framer, MessageData};
use hal::time::ManualClock;
use hal::traits::{Camera, Flow, Link, PictureClues, Received};
use hal::vehicle::{Event, PosedPicture, Unmatched, Vehicle, VehicleSettings};

/// Nanoseconds of a second.
pub const SECOND: f64 = 1e9;
pub const ORIGIN: Geodetic = Geodetic { lat_deg: 47.397_742, lon_deg: 8.545_594, alt_m: 488.0 };
/// The autopilot started so long before the computer beside it.
const BOOT_AHEAD_S: f64 = 60.0;
const UNIX_S: f64 = 1_790_000_000.0;
/// Every frame is so long on its way.
const ON_ITS_WAY_S: f64 = 0.005;
/// The flight goes on after the last event for so many tenths of a second.
const AFTER_TENTHS: u64 = 20;

/// An aircraft of a pinhole camera that is bolted to it.
pub fn settings(system_id: u8) -> VehicleSettings {
    let lens = CameraSettings::pinhole(640, 480, 400.0);
    VehicleSettings {
        system_id,
        link: LinkSettings { exif_pose: false, ..LinkSettings::default() },
        mount: MountSettings { attitude: MountAttitude::Fixed, ..MountSettings::default() },
        ..VehicleSettings::new(LinkAddress::Pty(None), lens, ORIGIN)
    }
}

/// The autopilot's clock at a moment of the computer's, ms and µs.
pub fn boot_ms(at_s: f64) -> u32 {
    ((at_s + BOOT_AHEAD_S) * 1e3) as u32
}

pub fn boot_us(at_s: f64) -> u64 {
    ((at_s + BOOT_AHEAD_S) * 1e6) as u64
}

/// Unix time, µs.
pub fn unix_us(at_s: f64) -> u64 {
    ((UNIX_S + at_s) * 1e6) as u64
}

/// Latitude and longitude as MAVLink has them, and metres.
pub fn on_earth(enu: DVec3) -> ([i32; 2], f64) {
    let at = EnuFrame::new(ORIGIN).to_geodetic(enu);
    ([at.lat_deg, at.lon_deg].map(|deg| (deg * 1e7).round() as i32), at.alt_m)
}

/// What is sent and taken, and when.
#[derive(Default)]
pub struct Sortie {
    encoders: HashMap<(u8, u8), Encoder>,
    sent: Vec<(f64, Vec<u8>)>,
    pictures: Vec<(PictureClues, String)>,
}

/// What came of it.
pub struct Flown {
    pub posed: Vec<PosedPicture>,
    pub unmatched: Vec<Unmatched>,
    /// Exposures announced.
    pub exposures: usize,
    /// Complaints that began.
    pub complaints: Vec<String>,
    /// What the ground control station was told.
    pub said: Vec<String>,
    /// The failsafe heard in flight that no pictures come.
    pub camera_was_silent: bool,
    pub counters: HalCounters,
}

impl Flown {
    /// Of every posed picture its name, where it is said to have been taken, and how sure that is.
    pub fn places(&self) -> Vec<(String, DVec3, f32)> {
        let of = |p: &PosedPicture| (p.picture.name().to_string_lossy().into_owned(), p.pose.position, p.confidence);
        self.posed.iter().map(of).collect()
    }
}

impl Sortie {
    /// Bytes of a message of component `from` of a system.
    pub fn encode<M: MessageData>(&mut self, from: (u8, u8), message: &M) -> Vec<u8> {
        let encoder = self.encoders.entry(from).or_insert_with(|| Encoder::new(from.0, from.1));
        encoder.encode(message, None).to_vec()
    }

    /// Something arrives.
    pub fn arrives(&mut self, at_s: f64, bytes: Vec<u8>) {
        self.sent.push((at_s + ON_ITS_WAY_S, bytes));
    }

    /// A message is sent.
    pub fn say<M: MessageData>(&mut self, at_s: f64, from: (u8, u8), message: &M) {
        let bytes = self.encode(from, message);
        self.arrives(at_s, bytes);
    }

    /// An autopilot says `hz` times a second where it is, and every second that it is there.
    pub fn telemetry(&mut self, system: u8, [from_s, to_s]: [f64; 2], hz: f64, place: impl Fn(f64) -> DVec3) {
        let ticks = ((to_s - from_s) * hz).ceil() as usize;
        for tick in 0..ticks {
            let at_s = from_s + tick as f64 / hz;
            let time_boot_ms = boot_ms(at_s);
            if tick % hz.ceil() as usize == 0 {
                let mut beat = self.encode(
                    (system, 1),
                    &HEARTBEAT_DATA {
                        mavtype: MavType::MAV_TYPE_QUADROTOR,
                        autopilot: MavAutopilot::MAV_AUTOPILOT_ARDUPILOTMEGA,
                        base_mode: MavModeFlag::MAV_MODE_FLAG_SAFETY_ARMED,
                        mavlink_version: 3,
                        ..HEARTBEAT_DATA::default()
                    },
                );
                let time = SYSTEM_TIME_DATA { time_unix_usec: unix_us(at_s), time_boot_ms };
                beat.extend(self.encode((system, 1), &time));
                self.arrives(at_s, beat);
            }
            // Whole milliseconds, as the message has them.
            let ([lat, lon], alt_m) = on_earth(place(f64::from(time_boot_ms) * 1e-3 - BOOT_AHEAD_S));
            let mut pose = self.encode((system, 1), &ATTITUDE_DATA { time_boot_ms, ..ATTITUDE_DATA::default() });
            let alt = (alt_m * 1e3).round() as i32;
            pose.extend(self.encode(
                (system, 1),
                &GLOBAL_POSITION_INT_DATA { time_boot_ms, lat, lon, alt, ..GLOBAL_POSITION_INT_DATA::default() },
            ));
            self.arrives(at_s, pose);
        }
    }

    /// A picture is complete.
    pub fn takes(&mut self, clues: PictureClues, name: String) {
        self.pictures.push((clues, name));
    }

    /// Flies, and lands.
    pub fn fly(mut self, settings: &VehicleSettings) -> Flown {
        self.sent.sort_by(|a, b| a.0.total_cmp(&b.0));
        self.pictures.sort_by_key(|p| p.0.arrived_ns);
        let last_ns = self.pictures.last().map_or(0, |p| p.0.arrived_ns);
        let (clock, air) = (Arc::new(ManualClock::default()), Arc::new(Mutex::new(Air::default())));
        let camera = Shutter(self.pictures.into());
        let mut vehicle = Vehicle::new(Port(air.clone()), camera, clock.clone(), settings).expect("a vehicle");
        let mut flown = Flown {
            posed: Vec::new(),
            unmatched: Vec::new(),
            exposures: 0,
            complaints: Vec::new(),
            said: Vec::new(),
            camera_was_silent: false,
            counters: HalCounters::default(),
        };
        let mut poll = |vehicle: &mut Vehicle<Port, Shutter, Arc<ManualClock>>| {
            while let Some(event) = vehicle.poll(Duration::ZERO).expect("a port does not fail") {
                match event {
                    Event::Posed(picture) => flown.posed.push(picture),
                    Event::Unmatched(unmatched) => flown.unmatched.push(unmatched),
                    Event::Trigger(_) => flown.exposures += 1,
                    Event::Complaint { line, .. } => flown.complaints.extend(line),
                    _ => {}
                }
            }
            flown.camera_was_silent |= vehicle.flags().camera_silent;
        };
        let mut now_ns = 0;
        for (at_s, bytes) in self.sent {
            now_ns = (at_s * SECOND) as u64;
            clock.set(now_ns);
            air.lock().expect("lock").arrived.push_back(bytes);
            poll(&mut vehicle);
        }
        let after = now_ns.max(last_ns);
        for tenth in 1..=AFTER_TENTHS {
            clock.set(after + tenth * (0.1 * SECOND) as u64);
            poll(&mut vehicle);
        }
        vehicle.finish();
        for _ in 0..1000 {
            poll(&mut vehicle);
            if vehicle.is_finished() {
                break;
            }
        }
        flown.counters = vehicle.counters();
        flown.said = std::mem::take(&mut air.lock().expect("lock").said);
        flown
    }
}

/// What has arrived at a port and waits, and the words that left it.
#[derive(Default)]
struct Air {
    arrived: VecDeque<Vec<u8>>,
    said: Vec<String>,
}

struct Port(Arc<Mutex<Air>>);

impl Link for Port {
    type Error = HalError;

    fn read(&mut self, into: &mut [u8], _timeout: Duration) -> Result<Received, HalError> {
        let Some(bytes) = self.0.lock().expect("lock").arrived.pop_front() else { return Ok(Received::default()) };
        into[..bytes.len()].copy_from_slice(&bytes);
        Ok(Received { bytes: bytes.len(), time_ns: None, peer: None, flow: Flow::Whole })
    }

    fn write(&mut self, bytes: &[u8]) -> Result<(), HalError> {
        let mut framer = Framer::new();
        framer.push(bytes);
        let text = framer.next_frame().and_then(|frame| frame.message::<STATUSTEXT_DATA>());
        if let Some(text) = text {
            let words = text.text.to_str().unwrap_or_default().to_owned();
            self.0.lock().expect("lock").said.push(words);
        }
        Ok(())
    }
}

/// A camera whose pictures are complete at given times.
struct Shutter(VecDeque<(PictureClues, String)>);

impl Camera for Shutter {
    type Picture = Picture;
    type Error = HalError;

    fn next_picture(&mut self, now_ns: u64) -> Result<Option<(PictureClues, Picture)>, HalError> {
        let is_due = self.0.front().is_some_and(|(clues, _)| clues.arrived_ns <= now_ns);
        let due = if is_due { self.0.pop_front() } else { None };
        Ok(due.map(|(clues, name)| (clues, Picture::Path(name.into()))))
    }
}
