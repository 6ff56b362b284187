//! Whatever strangers send to an open UDP port, a flight is what it is without them. One recorded flight is flown again beside
//! random streams of theirs, alone and several at once: noise, frames cut anywhere, frames in the autopilot's name. `DGTR_STREAMS` says
//! how many streams (3,000).
#![allow(clippy::expect_used, clippy::panic, reason = "a test fails by panicking")]

use std::collections::VecDeque;
use std::net::{IpAddr, Ipv4Addr, SocketAddr};
use std::path::Path;
use std::sync::{Arc, Mutex};
use std::time::Duration;

use config::link::LinkSettings;
use config::mission::{CameraSettings, MountAttitude, MountSettings};
use geometry::geodesy::Geodetic;
use hal::camera::Picture;
use hal::counters::{HalCounters, LinkCounters};
use hal::error::HalError;
use hal::link::{LinkAddress, TlogLink};
use hal::mavlink::Framer;
use hal::mavlink::dialect::CAMERA_FEEDBACK_DATA;
use hal::time::ManualClock;
use hal::traits::{Camera, Flow, Link, PictureClues, Received};
use hal::vehicle::{Vehicle, VehicleSettings};

#[path = "../../tests/strangers.rs"]
mod strangers;

use strangers::Stranger;

/// When, from whom, what.
type Datagram = (u64, SocketAddr, Vec<u8>);

/// Streams beside one flight. A port remembers eight peers, and a stranger has three addresses.
const MOST_AT_ONCE: u64 = 15;

/// Where the autopilot's come from.
const AUTOPILOT: SocketAddr = SocketAddr::new(IpAddr::V4(Ipv4Addr::LOCALHOST), 14_555);

fn address(port: u16) -> SocketAddr {
    SocketAddr::from(([127, 0, 0, 1], port))
}

/// What has arrived at a port.
type Arrived = Arc<Mutex<VecDeque<(SocketAddr, Vec<u8>)>>>;

/// A port at which datagrams arrive when the test says so.
struct Port {
    arrived: Arrived,
}

impl Link for Port {
    type Error = HalError;

    fn read(&mut self, into: &mut [u8], _timeout: Duration) -> Result<Received, HalError> {
        let Some((peer, bytes)) = self.arrived.lock().expect("lock").pop_front() else {
            return Ok(Received::default());
        };
        let count = bytes.len().min(into.len());
        into[..count].copy_from_slice(&bytes[..count]);
        Ok(Received { bytes: count, time_ns: None, peer: Some(peer), flow: Flow::Whole })
    }

    fn write(&mut self, _frame: &[u8]) -> Result<(), HalError> {
        Ok(())
    }
}

/// A picture 60 ms after each announcement.
struct Shutter(VecDeque<u64>, u64);

impl Camera for Shutter {
    type Picture = Picture;
    type Error = HalError;

    fn next_picture(&mut self, now_ns: u64) -> Result<Option<(PictureClues, Picture)>, HalError> {
        let Some(arrived_ns) = self.0.front().copied().filter(|at| *at <= now_ns) else { return Ok(None) };
        self.0.pop_front();
        self.1 += 1;
        let clues = PictureClues { arrived_ns, number: Some(self.1), ..PictureClues::default() };
        Ok(Some((clues, Picture::Path(format!("{}.jpg", self.1).into()))))
    }
}

/// The autopilot's datagrams of a recorded survey's first seconds, fast ones together, and when its pictures
/// were there. The clock starts with it.
fn recorded() -> (Vec<Datagram>, VecDeque<u64>) {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("../tests/data/run8_trimmed.tlog");
    let (mut link, mut framer, mut buffer) = (TlogLink::open(&path).expect("log"), Framer::new(), [0; 512]);
    let (mut datagrams, mut pictures, mut start) = (Vec::<Datagram>::new(), VecDeque::new(), None);
    while let Ok(received) = link.read(&mut buffer, Duration::ZERO) {
        framer.push(&buffer[..received.bytes]);
        let at = received.time_ns.expect("a log has times");
        let at = at - *start.get_or_insert(at) + 1_000_000_000;
        while let Some(frame) = framer.next_frame() {
            let fast = [30, 31, 32, 33, 108, 285].contains(&frame.id());
            if frame.message::<CAMERA_FEEDBACK_DATA>().is_some() {
                pictures.push_back(at + 60_000_000);
            }
            match datagrams.last_mut() {
                Some((_, _, bytes)) if fast && bytes.len() < 120 => bytes.extend(frame.bytes()),
                _ => datagrams.push((at, AUTOPILOT, frame.bytes().to_vec())),
            }
        }
        if at > 7_000_000_000 {
            break;
        }
    }
    (datagrams, pictures)
}

fn settings() -> VehicleSettings {
    let lens = CameraSettings::pinhole(640, 480, 400.0);
    VehicleSettings {
        link: LinkSettings { exif_pose: false, ..LinkSettings::default() },
        mount: MountSettings { attitude: MountAttitude::Fixed, ..MountSettings::default() },
        ..VehicleSettings::new(
            LinkAddress::UdpIn("0.0.0.0:14550".into()),
            lens,
            Geodetic { lat_deg: 46.84265, lon_deg: -91.99390, alt_m: 158.6 },
        )
    }
}

/// Flies: every event, what is known of the autopilot after each second, and the totals but those of what was refused.
fn fly(datagrams: &[Datagram], pictures: &VecDeque<u64>) -> Vec<String> {
    let (clock, arrived) = (Arc::new(ManualClock::default()), Arc::default());
    let port = Port { arrived: Arc::clone(&arrived) };
    let camera = Shutter(pictures.clone(), 0);
    let mut vehicle = Vehicle::new(port, camera, clock.clone(), &settings()).expect("a vehicle");
    let (mut told, mut second) = (Vec::new(), 0);
    for (at, from, bytes) in datagrams {
        clock.set(*at);
        // What is due by now is done before anything arrives, whoever sends it.
        while let Some(event) = vehicle.poll(Duration::ZERO).expect("a port does not fail") {
            told.push(format!("{event:?}"));
        }
        arrived.lock().expect("lock").push_back((*from, bytes.clone()));
        while let Some(event) = vehicle.poll(Duration::ZERO).expect("a port does not fail") {
            told.push(format!("{event:?}"));
        }
        if *from == AUTOPILOT && at / 1_000_000_000 > second {
            second = at / 1_000_000_000;
            told.push(format!("{:?}", vehicle.autopilot()));
        }
    }
    let all = vehicle.counters();
    let link = LinkCounters {
        frames: 0,
        damaged: 0,
        skipped_bytes: 0,
        unknown: 0,
        refused_peers: 0,
        sent: 0,
        send_failed: 0,
        ..all.link
    };
    let counted = HalCounters { link, ..all };
    told.push(format!("{counted:?}"));
    told
}

#[test]
fn whatever_strangers_send_a_flight_over_udp_is_the_flight_without_them() {
    let (flight, pictures) = recorded();
    let alone = fly(&flight, &pictures);
    let posed = alone.iter().filter(|told| told.starts_with("Posed")).count();
    assert!(posed >= 10, "{posed} pictures posed of a flight that has 15");
    let overheard: Vec<Vec<u8>> = flight.iter().map(|(_, _, bytes)| bytes.clone()).collect();
    let streams = std::env::var("DGTR_STREAMS").ok().and_then(|n| n.parse().ok()).unwrap_or(3000);
    let (mut next, mut flights) = (0, 0);
    while next < streams {
        // Of one stranger, of more than a port remembers, and of every number between.
        let seeds = next..streams.min(next + 1 + flights % MOST_AT_ONCE);
        let mut strangers: Vec<_> = seeds.clone().map(|seed| (seed, Stranger(seed))).collect();
        let often: Vec<_> = strangers.iter_mut().map(|(_, dice)| 1 + dice.roll(12)).collect();
        let mut all = Vec::with_capacity(2 * flight.len());
        for datagram in &flight {
            for ((seed, dice), often) in strangers.iter_mut().zip(&often) {
                while dice.roll(12) < *often {
                    let bytes = dice.datagram(datagram.0, &overheard);
                    let port = 40_000 + 3 * (*seed % MOST_AT_ONCE) as u16 + dice.roll(3) as u16;
                    all.push((datagram.0, address(port), bytes));
                    if dice.roll(2) == 0 {
                        break;
                    }
                }
            }
            all.push(datagram.clone());
        }
        let beside = fly(&all, &pictures);
        if beside != alone {
            let first = beside.iter().zip(&alone).find(|(a, b)| a != b);
            panic!("streams {seeds:?}: {first:#?}");
        }
        (next, flights) = (seeds.end, flights + 1);
    }
    println!("{streams} streams beside {flights} flights");
}
