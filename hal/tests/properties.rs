//! What must hold for any input, tried on many.
#![allow(clippy::expect_used, clippy::panic, reason = "a test fails by panicking")]

use glam::DQuat;
use hal::frames::{attitude_to_enu, attitude_to_ned, euler_to_ned, ned_to_enu};
use hal::link::LinkAddress;
use hal::matcher::{Matcher, MatcherSettings};
use hal::mavlink::dialect::SYSTEM_TIME_DATA;
use hal::mavlink::{Encoder, Frame, Framer, MessageData};
use hal::time::boot::BootClock;
use hal::time::map::ClockMap;
use hal::traits::PictureClues;
use hal::trigger::{Trigger, TriggerKind};
use proptest::prelude::*;

const S: u64 = 1_000_000_000;

/// All boot times of a stream that comes in pieces of `cut` bytes and then ends; `None` where a frame of a message was found that nobody
/// sent: of 65,536 noises one has a right checksum, and what it reaches over is lost.
fn all_found(stream: &[u8], cut: usize) -> Option<Vec<u32>> {
    let mut framer = Framer::new();
    let mut all: Vec<_> = stream.chunks(cut).flat_map(|chunk| found(&mut framer, chunk)).collect();
    framer.end();
    while let Some(frame) = framer.next_frame() {
        all.push(boot_time(&frame));
    }
    all.into_iter().collect()
}

fn found(framer: &mut Framer, bytes: &[u8]) -> Vec<Option<u32>> {
    let (mut rest, mut found) = (bytes, Vec::new());
    while !rest.is_empty() {
        rest = &rest[framer.push(rest)..];
        while let Some(frame) = framer.next_frame() {
            found.push(boot_time(&frame));
        }
    }
    found
}

/// `None`: a frame of another message.
fn boot_time(frame: &Frame<'_>) -> Option<u32> {
    let is_ours = frame.id() == SYSTEM_TIME_DATA::ID;
    is_ours.then(|| frame.message::<SYSTEM_TIME_DATA>().expect("whole").time_boot_ms)
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(256))]

    /// Noise between frames never costs one, however the stream is cut.
    #[test]
    fn no_intact_frame_is_lost_in_noise(noise in prop::collection::vec(prop::collection::vec(any::<u8>(), 0..40), 8), cut in 1usize..50) {
        let (mut encoder, mut stream) = (Encoder::new(1, 1), Vec::new());
        for (i, noise) in noise.iter().enumerate() {
            stream.extend_from_slice(noise);
            stream.extend_from_slice(encoder.encode(&SYSTEM_TIME_DATA { time_unix_usec: 1, time_boot_ms: i as u32 }, None));
        }
        let found = all_found(&stream, cut);
        prop_assume!(found.is_some());
        prop_assert_eq!(found, Some((0..8).collect::<Vec<u32>>()));
    }

    /// Noise that reads as the start of an unknown message, as long as the three frames behind it.
    #[test]
    fn noise_that_looks_like_an_unknown_message_costs_no_frame(len in 0u8..255, flags in 0u8..3, cut in 1usize..50) {
        let (mut encoder, mut stream) = (Encoder::new(1, 1), vec![0xFD, len, flags]);
        for i in 0..16 {
            stream.extend_from_slice(encoder.encode(&SYSTEM_TIME_DATA { time_unix_usec: 1, time_boot_ms: i }, None));
        }
        prop_assert_eq!(all_found(&stream, cut), Some((0..16).collect::<Vec<u32>>()));
    }

    #[test]
    fn axes_go_there_and_back(roll in -3.1f64..3.1, pitch in -1.5f64..1.5, yaw in -3.1f64..3.1, v in prop::array::uniform3(-1e4f64..1e4)) {
        let q = euler_to_ned(roll, pitch, yaw);
        let back: DQuat = attitude_to_ned(attitude_to_enu(q));
        prop_assert!(back.dot(q).abs() > 1.0 - 1e-12);
        prop_assert_eq!(ned_to_enu(ned_to_enu(v.into())), v.into());
        // Turning a body vector in either world gives the same arrow.
        let body_frd = glam::DVec3::from(v);
        let body_flu = glam::DVec3::new(body_frd.x, -body_frd.y, -body_frd.z);
        prop_assert!((attitude_to_enu(q) * body_flu - ned_to_enu(q * body_frd)).length() < 1e-6);
    }

    #[test]
    fn an_address_is_understood_or_refused_in_one_line(text in "(serial|udpin|udpout|tcpin|tcpout|file|pty|)?:?[ -~]{0,30}") {
        match text.parse::<LinkAddress>() {
            Ok(address) => prop_assert_eq!(&address.to_string().parse::<LinkAddress>().expect("its own form"), &address),
            Err(e) => prop_assert!(!e.to_string().contains('\n')),
        }
    }

    /// Whatever the stamps, the boot clock stays within what was fed and the map stays finite and monotonic.
    #[test]
    fn clocks_survive_any_stamps(stamps in prop::collection::vec((any::<u32>(), 0u64..5 * S), 1..60), probe in any::<u64>()) {
        let (mut boot, mut map, mut now) = (BootClock::default(), ClockMap::default(), 0u64);
        for (ms, step) in stamps {
            now += step;
            let (hal::time::boot::Tick::Normal(at) | hal::time::boot::Tick::Restarted(at)) = boot.tick_ms(ms, now);
            map.arrival(now, at);
            map.round_trip(now.saturating_sub(step / 2), now, at);
        }
        prop_assert!(map.rate().is_finite() && map.rate() > 0.0);
        let (a, b) = (map.to_companion_ns(probe), map.to_companion_ns(probe.saturating_add(S)));
        prop_assert!(a <= b);
        let _ = boot.near_us(probe);
    }

    /// Every exposure and every picture comes out exactly once, whatever their order and clues.
    #[test]
    fn the_matcher_accounts_for_everything(
        pictures in prop::collection::vec((0u64..200, prop::option::of(0u64..60), prop::option::of(0u64..200)), 0..60),
        exposures in prop::collection::vec(0u64..200, 0..60),
    ) {
        let mut matcher = Matcher::new(MatcherSettings::default());
        let (mut exposures, mut pictures) = (exposures, pictures);
        exposures.sort_unstable();
        pictures.sort_unstable();
        let (given, mut now, mut taken) = ((exposures.len(), pictures.len()), 0, (0, 0));
        let mut take = |outcome| match outcome {
            hal::matcher::Outcome::Matched { .. } => (taken.0, taken.1) = (taken.0 + 1, taken.1 + 1),
            hal::matcher::Outcome::Trigger { .. } => taken.0 += 1,
            hal::matcher::Outcome::Picture { .. } => taken.1 += 1,
        };
        for (i, t) in exposures.iter().enumerate() {
            let time_ns = t * S;
            let trigger = Trigger { source: Default::default(), sequence: i as u32, boot_ns: time_ns, time_ns, sigma_ns: 1, kind: TriggerKind::Feedback };
            matcher.push_trigger(trigger).map(&mut take);
            while let Some(at) = pictures.first().filter(|p| p.0 <= *t).map(|p| p.0) {
                let (_, number, camera) = pictures.remove(0);
                let camera_ns = camera.map(|c| c * S);
                let clues = PictureClues { arrived_ns: at * S, number, camera_ns, camera_resolution_ns: S, ..PictureClues::default() };
                matcher.push_picture(clues, ()).map(&mut take);
            }
            now = now.max(time_ns);
            while let Some(outcome) = matcher.poll(now) {
                take(outcome);
            }
        }
        let rest = pictures.len();
        while let Some(outcome) = matcher.flush() {
            take(outcome);
        }
        prop_assert_eq!(taken, (given.0, given.1 - rest));
    }
}
