//! The matcher's promises, on exposures every two seconds with pictures 0.4 s later.

use std::vec::Vec;

use super::*;
use crate::trigger::{Source, TriggerKind};

const S: u64 = 1_000_000_000;
const MS: u64 = 1_000_000;

fn trigger(i: u32) -> Trigger {
    let boot_ns = (100 + 2 * u64::from(i)) * S;
    Trigger {
        sequence: i,
        boot_ns,
        time_ns: boot_ns - 90 * S,
        sigma_ns: MS,
        kind: TriggerKind::Feedback,
        source: Source::default(),
    }
}

/// One picture: of which exposure, at which delay, with which number.
#[derive(Clone, Copy)]
struct Shot {
    of: u32,
    delay_ms: u64,
    number: Option<u64>,
    camera: bool,
}

fn shots(n: u32) -> Vec<Shot> {
    (1..=n).map(|of| Shot { of, delay_ms: 400, number: Some(1000 + 2 * u64::from(of)), camera: false }).collect()
}

/// Plays exposures (except `unannounced`) and shots in order of time; returns what was matched and what stayed alone.
fn play(n: u32, shots: &[Shot], unannounced: &[u32]) -> (Vec<(u32, u32)>, Vec<Reason>) {
    let mut matcher = Matcher::new(MatcherSettings::default());
    let (mut matched, mut alone) = (Vec::new(), Vec::new());
    let mut take = |outcome| match outcome {
        Outcome::Matched { trigger, picture, .. } => matched.push((trigger.sequence, picture)),
        Outcome::Picture { reason, .. } | Outcome::Trigger { reason, .. } => alone.push(reason),
    };
    for now in (0..(2 * u64::from(n) + 40) * 10).map(|tick| 10 * S + tick * 100 * MS) {
        for t in (1..=n).map(trigger).filter(|t| t.time_ns / (100 * MS) == now / (100 * MS)) {
            if !unannounced.contains(&t.sequence) {
                matcher.push_trigger(t).map(&mut take);
            }
        }
        for shot in shots {
            let arrived_ns = trigger(shot.of).time_ns + shot.delay_ms * MS;
            if arrived_ns / (100 * MS) == now / (100 * MS) {
                let camera_ns = shot.camera.then(|| (trigger(shot.of).boot_ns + 7777 * S) / S * S);
                let clues = PictureClues {
                    arrived_ns,
                    number: shot.number,
                    camera_ns,
                    camera_resolution_ns: S,
                    ..PictureClues::default()
                };
                matcher.push_picture(clues, shot.of).map(&mut take);
            }
        }
        while let Some(outcome) = matcher.poll(now) {
            take(outcome);
        }
    }
    while let Some(outcome) = matcher.flush() {
        take(outcome);
    }
    (matched, alone)
}

fn all_right(matched: &[(u32, u32)]) -> bool {
    matched.iter().all(|(exposure, picture)| exposure == picture)
}

#[test]
fn every_picture_finds_its_exposure() {
    let (matched, alone) = play(40, &shots(40), &[]);
    assert!(matched.len() == 40 && all_right(&matched) && alone.is_empty(), "{matched:?} {alone:?}");
}

#[test]
fn a_skipped_exposure_does_not_shift_the_following_pictures() {
    // The camera did not fire for 9 and 20; its numbers go on without a gap.
    let mut shots = shots(40);
    shots.retain(|s| s.of != 9 && s.of != 20);
    for (i, shot) in shots.iter_mut().enumerate() {
        shot.number = Some(500 + i as u64);
    }
    let (matched, alone) = play(40, &shots, &[]);
    assert!(matched.len() == 38 && all_right(&matched), "{matched:?}");
    assert_eq!(alone, [Reason::NoPicture; 2]);
}

#[test]
fn pictures_that_fall_behind_a_busy_computer_keep_their_exposures() {
    // From the 10th on each is 0.37 s later than the one before, up to five exposures late; then the backlog is made up.
    let mut shots = shots(40);
    for (i, shot) in shots.iter_mut().enumerate().skip(9) {
        shot.delay_ms += 370 * (i as u64 - 8).min(34 - (i as u64).min(34));
    }
    let (matched, alone) = play(40, &shots, &[]);
    assert!(all_right(&matched), "{matched:?}");
    assert!(matched.len() >= 38 && alone.len() <= 4, "{} {alone:?}", matched.len());
}

#[test]
fn a_picture_that_comes_after_its_exposure_was_given_up_takes_no_other_ones_place() {
    let mut shots = shots(40);
    shots[11].delay_ms = 16_000;
    shots[12].delay_ms = 17_000;
    let (matched, alone) = play(40, &shots, &[]);
    assert!(matched.len() == 38 && all_right(&matched), "{matched:?}");
    assert_eq!(alone.len(), 4, "{alone:?}");
}

#[test]
fn a_camera_that_starts_to_count_anew_is_understood_after_a_few_pictures() {
    let mut shots = shots(40);
    shots.iter_mut().skip(20).for_each(|s| s.number = s.number.map(|n| n - 1040));
    let (matched, _) = play(40, &shots, &[]);
    assert!(matched.len() >= 34 && all_right(&matched), "{matched:?}");
}

#[test]
fn pictures_released_by_hand_in_between_do_not_cost_the_announced_ones() {
    // Their files lie elsewhere; what is seen is that the numbers jump, at last with the last picture.
    let mut shots = shots(40);
    for (i, shot) in shots.iter_mut().enumerate() {
        shot.number = shot.number.map(|n| n + 2 * [7, 8, 20, 39].iter().filter(|at| i >= **at).count() as u64);
    }
    let (matched, alone) = play(40, &shots, &[]);
    assert!(matched.len() == 40 && all_right(&matched) && alone.is_empty(), "{matched:?} {alone:?}");
}

#[test]
fn a_late_picture_is_found_by_its_number() {
    let mut shots = shots(40);
    shots[11].delay_ms = 6_900;
    shots[25].delay_ms = 4_500;
    let (matched, alone) = play(40, &shots, &[]);
    assert!(matched.len() == 40 && all_right(&matched) && alone.is_empty(), "{matched:?} {alone:?}");
}

#[test]
fn a_late_picture_without_a_number_is_found_by_the_cameras_clock() {
    let mut shots = shots(40);
    shots[11].delay_ms = 6_900;
    shots.iter_mut().for_each(|s| (s.number, s.camera) = (None, true));
    let (matched, _) = play(40, &shots, &[]);
    assert!(matched.len() == 40 && all_right(&matched), "{matched:?}");
}

#[test]
fn a_duplicate_is_known_and_a_lost_announcement_costs_its_picture_only() {
    let mut shots = shots(30);
    shots.push(Shot { delay_ms: 900, ..shots[14] });
    let (matched, alone) = play(30, &shots, &[20]);
    assert!(matched.len() == 29 && all_right(&matched), "{matched:?}");
    assert_eq!(alone, [Reason::Duplicate, Reason::NoTrigger]);
}

#[test]
fn a_flood_is_bounded_and_every_piece_accounted_for() {
    let mut matcher = Matcher::new(MatcherSettings::default());
    let mut out = 0;
    for i in 0..1000 {
        out += usize::from(matcher.push_trigger(trigger(i)).is_some());
        let clues = PictureClues { arrived_ns: 900_000 * S, ..PictureClues::default() };
        out += usize::from(matcher.push_picture(clues, i).is_some());
    }
    while matcher.flush().is_some() {
        out += 1;
    }
    assert_eq!(out, 2000);
}

#[test]
fn a_camera_that_is_late_from_the_start_is_matched_to_no_other_exposures() {
    // Later than patience, later than several exposures, and all at once when the card is read at last.
    for delay_ms in [40_000, 9_000] {
        let mut shots = shots(40);
        shots.iter_mut().for_each(|s| s.delay_ms = delay_ms);
        let (matched, alone) = play(40, &shots, &[]);
        assert!(all_right(&matched), "{delay_ms} ms: {matched:?}");
        assert!(!alone.is_empty());
    }
    let mut burst = shots(30);
    burst.iter_mut().for_each(|s| s.delay_ms = 61_000 - 2000 * u64::from(s.of));
    let (matched, alone) = play(30, &burst, &[]);
    assert!(all_right(&matched) && !alone.is_empty(), "{matched:?}");
}

#[test]
fn announcements_that_come_late_shift_no_picture_by_one() {
    // Over a slow link each comes so much after its exposure, stamped right; pictures are there after 0.4 s.
    for late_ms in [100, 1000, 1300, 2000, 2600, 3000, 4000] {
        let (mut matcher, mut matched) = (Matcher::new(MatcherSettings::default()), Vec::new());
        for now in (0..1000).map(|tick| 10 * S + tick * 100 * MS) {
            let due = |at_ns: u64| at_ns / (100 * MS) == now / (100 * MS);
            for t in (1..=30).map(trigger) {
                if due(t.time_ns + late_ms * MS) {
                    assert!(matcher.push_trigger(t).is_none());
                }
                if due(t.time_ns + 400 * MS) {
                    let number = Some(1000 + u64::from(t.sequence));
                    let clues = PictureClues { arrived_ns: now, number, ..PictureClues::default() };
                    assert!(matcher.push_picture(clues, t.sequence).is_none());
                }
            }
            while let Some(outcome) = matcher.poll(now) {
                if let Outcome::Matched { trigger, picture, confidence, .. } = outcome {
                    assert!(confidence >= LEAST_CONFIDENCE);
                    matched.push((trigger.sequence, picture));
                }
            }
        }
        assert!(matched.len() == 30 && all_right(&matched), "{late_ms} ms: {matched:?}");
    }
}

#[test]
fn one_announcement_that_is_overtaken_costs_no_picture() {
    let (mut matcher, mut matched) = (Matcher::new(MatcherSettings::default()), Vec::new());
    for now in (0..1000).map(|tick| 10 * S + tick * 100 * MS) {
        let due = |at_ns: u64| at_ns / (100 * MS) == now / (100 * MS);
        for t in (1..=30).map(trigger) {
            if due(t.time_ns + if t.sequence == 7 { 2500 * MS } else { 100 * MS }) {
                matcher.push_trigger(t);
            }
            if due(t.time_ns + 400 * MS) {
                matcher.push_picture(PictureClues { arrived_ns: now, ..PictureClues::default() }, t.sequence);
            }
        }
        while let Some(outcome) = matcher.poll(now) {
            if let Outcome::Matched { trigger, picture, .. } = outcome {
                matched.push((trigger.sequence, picture));
            }
        }
    }
    assert!(matched.len() == 30 && all_right(&matched), "{matched:?}");
}
