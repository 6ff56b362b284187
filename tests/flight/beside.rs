//! Whatever strangers send beside an aircraft, over a serial line that others share or to an open UDP port: the flight has the same key
//! frames and the same model, to the byte, as without them. `DGTR_FLIGHTS` says by how many seeds (3).

use std::collections::{BTreeMap, VecDeque};
use std::net::SocketAddr;
use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

use disk::Disk;
use hal::error::HalError;
use hal::link::{LinkAddress, WireLink};
use hal::time::ManualClock;
use hal::traits::{Clock, Flow, Link, Received};
use sim::world::World;

use super::fault_table::usual;
use super::rehearsal::{Rehearsed, rehearse_over};

#[path = "../strangers.rs"]
mod strangers;

use strangers::Stranger;

/// Where the autopilot's datagrams come from.
const AUTOPILOT: u16 = 14_555;
/// Frames that a stranger has overheard and may repeat.
const OVERHEARD: usize = 64;

#[derive(Clone, Copy, PartialEq)]
enum Line {
    /// A serial line that a router shares with other systems.
    Serial,
    /// A UDP port that anybody may send to.
    Udp,
}

/// The vehicle's end of a line on which strangers speak, too.
struct Shared {
    wire: WireLink,
    clock: Arc<ManualClock>,
    line: Line,
    stranger: Option<Stranger>,
    /// What the autopilot has said and nobody has read yet: whole frames, and the beginning of one.
    said: VecDeque<Vec<u8>>,
    begun: Vec<u8>,
    overheard: Vec<Vec<u8>>,
    /// What a serial line gives next, whoever it is from.
    serial: VecDeque<u8>,
    /// Whether more can be read at once.
    has_more: Arc<AtomicBool>,
}

impl Shared {
    /// Takes whole MAVLink 2 frames off the wire.
    fn listen(&mut self) -> Result<(), HalError> {
        let mut buffer = [0; 512];
        loop {
            let count = self.wire.read(&mut buffer, Duration::ZERO)?.bytes;
            if count == 0 {
                break;
            }
            self.begun.extend(&buffer[..count]);
        }
        while let [0xFD, payload, flags, ..] = self.begun[..] {
            let length = 12 + usize::from(payload) + if flags & 1 == 1 { 13 } else { 0 };
            if self.begun.len() < length {
                break;
            }
            let frame: Vec<u8> = self.begun.drain(..length).collect();
            if self.overheard.len() == OVERHEARD {
                self.overheard.remove(0);
            }
            self.overheard.push(frame.clone());
            self.said.push_back(frame);
        }
        Ok(())
    }

    /// What a stranger says before the autopilot's next frame, if he speaks.
    fn strange(&mut self) -> Option<Vec<u8>> {
        let at_ns = self.clock.now_ns();
        let stranger = self.stranger.as_mut()?;
        if stranger.roll(3) != 0 {
            return None;
        }
        Some(match self.line {
            Line::Udp => stranger.datagram(at_ns, &self.overheard),
            // Other systems on the same wire, whose frames a router passes on whole, and noise in between.
            Line::Serial if stranger.roll(4) == 0 => {
                (0..1 + stranger.roll(100)).map(|_| stranger.roll(0xFD) as u8).collect()
            }
            Line::Serial => {
                let system = 2 + stranger.roll(250) as u8;
                stranger.frame(at_ns, system)
            }
        })
    }

    fn give(into: &mut [u8], bytes: &[u8], port: u16) -> Received {
        let count = bytes.len().min(into.len());
        into[..count].copy_from_slice(&bytes[..count]);
        let peer = Some(SocketAddr::from(([127, 0, 0, 1], port)));
        Received { bytes: count, peer, flow: Flow::Whole, ..Received::default() }
    }
}

impl Link for Shared {
    type Error = HalError;

    fn read(&mut self, into: &mut [u8], _timeout: Duration) -> Result<Received, HalError> {
        let received = self.next(into)?;
        self.has_more.store(!(self.said.is_empty() && self.serial.is_empty()), Ordering::Relaxed);
        Ok(received)
    }

    fn write(&mut self, frame: &[u8]) -> Result<(), HalError> {
        self.wire.write(frame)
    }
}

impl Shared {
    fn next(&mut self, into: &mut [u8]) -> Result<Received, HalError> {
        self.listen()?;
        if self.line == Line::Udp {
            if self.said.is_empty() {
                return Ok(Received::default());
            }
            if let Some(bytes) = self.strange() {
                let port = 40_000 + u16::from(bytes[0]) % 3;
                return Ok(Self::give(into, &bytes, port));
            }
            let frame = self.said.pop_front().unwrap_or_default();
            return Ok(Self::give(into, &frame, AUTOPILOT));
        }
        while let Some(frame) = self.said.pop_front() {
            let strange = self.strange().unwrap_or_default();
            self.serial.extend(strange.into_iter().chain(frame));
        }
        let count = self.serial.len().min(into.len());
        for (to, from) in into.iter_mut().zip(self.serial.drain(..count)) {
            *to = from;
        }
        Ok(Received { bytes: count, ..Received::default() })
    }
}

/// Every file below `folder`.
fn files(folder: &Path, at: &str, all: &mut BTreeMap<String, Vec<u8>>) {
    for entry in std::fs::read_dir(folder).expect("a folder").flatten() {
        let name = format!("{at}/{}", entry.file_name().to_string_lossy());
        match entry.file_type().expect("a type").is_dir() {
            true => files(&entry.path(), &name, all),
            false => drop(all.insert(name, std::fs::read(entry.path()).expect("readable"))),
        }
    }
}

/// A flight, what it left of key frames, and the hash of its model.
fn flown(
    line: Line,
    stranger: Option<u64>,
    world: &Arc<World>,
) -> (Rehearsed, BTreeMap<String, Vec<u8>>, blake3::Hash) {
    let folder = tempfile::tempdir().expect("a folder");
    let mut script = usual();
    if line == Line::Udp {
        script.vehicle.address = LinkAddress::UdpIn("0.0.0.0:14550".into());
    }
    let shared = |wire, clock| {
        let has_more = Arc::<AtomicBool>::default();
        let more = Arc::clone(&has_more);
        (
            Shared {
                has_more,
                wire,
                clock,
                line,
                stranger: stranger.map(Stranger),
                said: VecDeque::new(),
                begun: Vec::new(),
                overheard: Vec::new(),
                serial: VecDeque::new(),
            },
            more,
        )
    };
    let disk = Disk::default();
    let flight = rehearse_over(shared, &disk, &script, world.clone(), folder.path(), Box::new(|_| {}));
    let mut kept = BTreeMap::new();
    files(&folder.path().join("out/keyframes"), "", &mut kept);
    let model = std::fs::read(folder.path().join("out/model.dgtr")).expect("a model");
    (flight, kept, blake3::hash(&model))
}

#[test]
fn flights_on_serial_and_udp_beside_strangers_have_the_key_frames_and_the_model_of_flights_without_them() {
    let script = usual();
    let world = Arc::new(World::new(script.sim.world_seed, &script.sim.world));
    let seeds = std::env::var("DGTR_FLIGHTS").ok().and_then(|n| n.parse().ok()).unwrap_or(3);
    for line in [Line::Serial, Line::Udp] {
        let (alone, kept, model) = flown(line, None, &world);
        let (views, finished) = *alone.model.as_ref().expect("a model");
        assert!(finished && views >= 3 && kept.len() > views, "{views} views, {} files", kept.len());
        for seed in 1..=seeds {
            let (beside, kept_beside, model_beside) = flown(line, Some(seed), &world);
            // They were heard.
            let [with, without] = [&beside, &alone].map(|f| &f.counters.hal.link);
            let strange = |c: &hal::counters::LinkCounters| c.refused_peers + c.skipped_bytes + c.unknown + c.foreign;
            assert!(strange(with) > strange(without) + 100, "seed {seed}: {with:?}");
            assert_eq!(beside.names, alone.names, "seed {seed}");
            let differs = kept.keys().chain(kept_beside.keys()).find(|name| kept.get(*name) != kept_beside.get(*name));
            assert_eq!(differs, None, "seed {seed}: a key frame's file");
            assert_eq!(model_beside, model, "seed {seed}");
        }
    }
}
