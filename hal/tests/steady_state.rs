//! What the capture loop costs: no allocation per message, little time, and no reaction to hostile bytes. The counting
//! allocator counts per thread, so that other tests and the feeding side do not disturb.
#![allow(clippy::expect_used, clippy::panic, reason = "a test fails by panicking")]
#![allow(unsafe_code, reason = "a counting allocator has to implement GlobalAlloc")]

use std::path::Path;
use std::time::{Duration, Instant};

use config::mission::{CameraSettings, MountAttitude, MountSettings};
use geometry::geodesy::Geodetic;
use hal::link::{LinkAddress, SerialLink, TlogLink};
use hal::mavlink::Encoder;
use hal::mavlink::dialect::{
    ATTITUDE_QUATERNION_DATA, GLOBAL_POSITION_INT_DATA, HEARTBEAT_DATA, MavAutopilot, MavMessage,
};
use hal::traits::{Link, PictureClues};
use hal::vehicle::{Vehicle, VehicleSettings};
use mavlink::Message;

#[path = "../fuzz/src/targets.rs"]
mod targets;

#[path = "../../tests/counting_allocator.rs"]
mod counting_allocator;

use counting_allocator::allocations;
use targets::CaptureLoop;

/// Processor time of this thread.
fn cpu() -> Duration {
    let stat = std::fs::read_to_string("/proc/thread-self/schedstat").expect("Linux");
    Duration::from_nanos(stat.split(' ').next().and_then(|n| n.parse().ok()).expect("a number"))
}

fn settings() -> VehicleSettings {
    VehicleSettings {
        mount: MountSettings { attitude: MountAttitude::Fixed, ..MountSettings::default() },
        ..VehicleSettings::new(
            LinkAddress::Pty(None),
            CameraSettings::pinhole(640, 480, 400.0),
            Geodetic { lat_deg: 46.84265, lon_deg: -91.9939, alt_m: 158.6 },
        )
    }
}

/// One message of a stream of 1,000 a second: attitudes, every tenth a position, a heartbeat a second.
fn message(encoder: &mut Encoder, tick: u32) -> &[u8] {
    let time_boot_ms = 10_000 + tick;
    if tick.is_multiple_of(1000) {
        let autopilot = MavAutopilot::MAV_AUTOPILOT_ARDUPILOTMEGA;
        encoder.encode(&HEARTBEAT_DATA { autopilot, ..HEARTBEAT_DATA::default() }, None)
    } else if tick.is_multiple_of(10) {
        let (lat, lon) = (468_426_500 + tick as i32 / 20, -919_939_000);
        let position = GLOBAL_POSITION_INT_DATA { time_boot_ms, lat, lon, alt: 198_000, vx: 500, ..Default::default() };
        encoder.encode(&position, None)
    } else {
        encoder.encode(&ATTITUDE_QUATERNION_DATA { time_boot_ms, q1: 1.0, ..Default::default() }, None)
    }
}

#[test]
fn a_thousand_messages_a_second_cost_no_allocation_and_little_time() {
    let mut vehicle = Vehicle::open(&settings()).expect("a pty");
    let path = vehicle.link().link().and_then(|l| l.pty_path()).expect("its path").to_path_buf();
    let feeder = std::thread::spawn(move || {
        let mut far = SerialLink::open(&path, 921_600).expect("the far end");
        let mut encoder = Encoder::new(1, 1);
        let (start, mut ignored) = (Instant::now(), [0; 4096]);
        for tick in 0..4000u32 {
            far.write(message(&mut encoder, tick)).expect("the near end reads");
            let due = start + Duration::from_millis(tick.into());
            if tick.is_multiple_of(10) {
                // What the vehicle sends must be taken off the line.
                let _ =
                    far.read(&mut ignored, due.saturating_duration_since(Instant::now()).max(Duration::from_micros(1)));
                std::thread::sleep(due.saturating_duration_since(Instant::now()));
            }
        }
    });
    let run = |vehicle: &mut Vehicle, seconds: f64| {
        let (until, mut events) = (Instant::now() + Duration::from_secs_f64(seconds), 0);
        while Instant::now() < until {
            events += usize::from(vehicle.poll(Duration::from_millis(100)).expect("a pty does not fail").is_some());
        }
        events
    };
    run(&mut vehicle, 1.5); // warm
    let (cpu_before, frames) = (cpu(), vehicle.counters().link.frames);
    let counted_from = allocations();
    let events = run(&mut vehicle, 2.0);
    let counted = allocations() - counted_from;
    let spent = cpu() - cpu_before;
    let frames = vehicle.counters().link.frames - frames;
    println!("{frames} messages, {events} poses: {counted} allocations, {:.1} % of a core", spent.as_secs_f64() / 0.02);
    assert!(frames > 1500 && events > 100, "{frames} messages, {events} events");
    assert_eq!(counted, 0);
    assert!(spent < Duration::from_millis(100), "5 % of a core is 100 ms, not {spent:?}");
    feeder.join().expect("fed");
}

/// Deterministic bytes (PCG's multiplier).
struct Random(u64);

impl Random {
    fn next(&mut self) -> u32 {
        self.0 = self.0.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        (self.0 >> 33) as u32
    }

    fn one_in(&mut self, n: u32) -> bool {
        self.next().is_multiple_of(n)
    }
}

/// Frames of a real flight.
fn flight() -> Vec<Vec<u8>> {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("../tests/data/run8_trimmed.tlog");
    let (mut link, mut buffer, mut frames) = (TlogLink::open(&path).expect("log"), [0; 512], Vec::new());
    while let Ok(received) = link.read(&mut buffer, Duration::ZERO) {
        frames.push(buffer[..received.bytes].to_vec());
    }
    frames
}

/// Damages a frame: bit flips, or a payload of other values under a right checksum, or another message's id.
fn damage(frame: &mut Vec<u8>, random: &mut Random) {
    for _ in 0..1 + random.next() % 6 {
        let at = random.next() as usize % frame.len();
        frame[at] = match random.next() % 4 {
            0 => 0xFF,
            1 => frame[at] ^ (1 << (random.next() % 8)),
            _ => random.next() as u8,
        };
    }
    if !random.one_in(4) {
        // Repaired header and checksum: the damage reaches the decoder.
        let len = frame.len();
        (frame[0], frame[1], frame[2]) = (0xFD, (len - 12) as u8, 0);
        (frame[5], frame[6]) = (1, [1, 1, 100, 154][random.next() as usize % 4]);
        if random.one_in(8) {
            frame[7] = random.next() as u8;
        }
        let id = u32::from_le_bytes([frame[7], frame[8], frame[9], 0]);
        let crc = mavlink::calculate_crc(&frame[1..len - 2], MavMessage::extra_crc(id));
        frame[len - 2..].copy_from_slice(&crc.to_le_bytes());
    } else if random.one_in(3) {
        let keep = random.next() as usize % frame.len();
        frame.truncate(keep.max(1));
    }
}

#[test]
fn ten_million_hostile_bytes_neither_panic_nor_allocate() {
    let frames = flight();
    let mut random = Random(11);
    let mut capture = CaptureLoop::new();
    let mut scratch = Vec::with_capacity(4096);
    let (mut bytes, mut now_ns, mut index) = (0usize, 1_000_000_000u64, 0usize);
    let before = allocations();
    while bytes < 10_000_000 {
        scratch.clear();
        if random.one_in(5) {
            scratch.extend((0..random.next() % 600).map(|_| random.next() as u8));
        } else {
            scratch.extend_from_slice(&frames[index % frames.len()]);
            index += 1;
            if random.one_in(2) {
                damage(&mut scratch, &mut random);
            }
        }
        bytes += scratch.len();
        // Time mostly goes on; sometimes it leaps.
        now_ns = now_ns.wrapping_add(u64::from(random.next() % 20_000_000));
        if random.one_in(5000) {
            now_ns = now_ns.wrapping_add(u64::from(random.next()) << 20);
        }
        capture.handle(&scratch, now_ns, || {
            let wild = random.one_in(3);
            PictureClues {
                arrived_ns: if wild { u64::from(random.next()) << (random.next() % 33) } else { now_ns },
                number: (!random.one_in(4)).then(|| u64::from(random.next() % 100)),
                camera_ns: (random.one_in(4)).then(|| u64::from(random.next()) << 31),
                camera_resolution_ns: 1_000_000_000,
                ..PictureClues::default()
            }
        });
    }
    let allocated = allocations() - before;
    let CaptureLoop { framer, autopilot, outcomes, poses, .. } = &capture;
    println!("{:?} {:?} {outcomes} outcomes {poses} poses", framer.counters(), autopilot.counters());
    assert_eq!(allocated, 0);
    assert!(
        autopilot.counters().telemetry.positions > 1000
            && autopilot.counters().telemetry.impossible > 100
            && *outcomes > 100
    );
}

#[test]
fn what_the_fuzz_targets_run_survives_seeded_input() {
    let (mut random, frames) = (Random(5), flight());
    for round in 0..2000usize {
        let noise: Vec<u8> = (0..random.next() % 1200).map(|_| random.next() as u8).collect();
        targets::parse(&noise);
        targets::match_up(&noise);
        // Real frames, each in a piece of its own, some damaged.
        let mut line = Vec::new();
        for frame in frames.iter().cycle().skip(round * 20).take(20) {
            let mut frame = frame.clone();
            if random.one_in(3) {
                damage(&mut frame, &mut random);
            }
            line.push(u8::try_from(frame.len()).unwrap_or(u8::MAX));
            line.extend_from_slice(&frame);
        }
        targets::parse(&line);
    }
}
