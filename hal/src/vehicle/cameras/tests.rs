//! Two and three cameras on one autopilot, and pictures of one of them.

use super::*;

const MS: u64 = 1_000_000;

fn trigger(camera: u8, at_ms: u64) -> Trigger {
    Trigger {
        source: Source { component: 1, camera },
        sequence: at_ms as u32,
        boot_ns: at_ms * MS,
        time_ns: at_ms * MS,
        sigma_ns: MS,
        kind: TriggerKind::Feedback,
    }
}

/// Exposures of each camera, and the one whose pictures come, without those `skipped`; which camera was decided for.
fn decide(exposures: &[&[u64]], of: usize, skipped: &[usize]) -> Option<Decision> {
    let taken = exposures[of].iter().enumerate().filter(|(k, _)| !skipped.contains(k));
    decide_by(exposures, &taken.map(|(k, t)| t + k as u64 % 3 * 50).collect::<std::vec::Vec<_>>())
}

/// Announced exposures of each camera, and when the shutter opened whose pictures come 0.3 s later.
fn decide_by(exposures: &[&[u64]], opened: &[u64]) -> Option<Decision> {
    let mut cameras = Cameras::new(None, 15_000 * MS);
    let mut events: std::vec::Vec<(u64, Option<u8>)> = std::vec::Vec::new();
    for (camera, times) in exposures.iter().enumerate() {
        events.extend(times.iter().map(|t| (*t, Some(camera as u8))));
    }
    events.extend(opened.iter().map(|t| (t + 300, None)));
    events.sort_unstable();
    for (at_ms, camera) in events {
        match camera {
            Some(camera) => drop(cameras.take_trigger(trigger(camera, at_ms))),
            None => {
                let clues = PictureClues { arrived_ns: at_ms * MS, ..PictureClues::default() };
                let _ = cameras.take_picture(clues, Picture::Path("p.jpg".into()));
            }
        }
        if let Some(decision) = cameras.decide(false) {
            return Some(decision);
        }
    }
    cameras.decide(true)
}

fn every(ms: u64, from: u64, n: u64) -> std::vec::Vec<u64> {
    // Distances flown, not a clock: no two intervals are quite the same.
    (0..n).map(|k| from + k * ms + k * k % 7 * 11).collect()
}

#[test]
fn the_camera_whose_rhythm_fits_the_pictures_is_taken() {
    for (first, second) in [(2000, 700), (700, 2000), (3000, 300), (2000, 1000), (1500, 1300), (500, 450)] {
        let (a, b) = (every(first, 8_000, 40), every(second, 8_130, 60));
        for of in [0, 1] {
            for skipped in [&[][..], &[3], &[1, 6]] {
                let decision = decide(&[&a, &b], of, skipped).expect("decided");
                assert!(
                    decision.source.camera == of as u8 || decision.confidence < 0.9,
                    "{first} and {second} ms, pictures of {of} without {skipped:?}: {decision:?}"
                );
            }
            let decision = decide(&[&a, &b], of, &[]).expect("decided");
            assert_eq!(decision.source.camera, of as u8, "{first} and {second} ms");
        }
    }
}

#[test]
fn two_that_expose_together_give_the_same_poses_and_the_first_is_taken() {
    let (a, b) = (every(2000, 8_000, 30), every(2000, 8_004, 30));
    let decision = decide(&[&a, &b, &every(700, 8_000, 80)], 1, &[]).expect("decided");
    assert_eq!((decision.source.camera, decision.confidence), (0, 1.0));
}

#[test]
fn two_of_the_same_rhythm_at_different_times_are_no_certain_choice() {
    let (a, b) = (every(2000, 8_000, 30), every(2000, 8_900, 30));
    let decision = decide(&[&a, &b], 1, &[]).expect("decided");
    assert!(decision.confidence <= 0.5, "{decision:?}");
}

/// Our own announcements are lost now and then, and the other camera's fit every picture but the first.
#[test]
fn of_two_of_the_same_rhythm_what_is_lost_says_nothing_of_whose_the_pictures_are() {
    let (a, b) = (every(2000, 8_000, 24), every(2000, 8_900, 24));
    let heard: std::vec::Vec<u64> = a.iter().enumerate().filter(|(k, _)| k % 4 != 2).map(|(_, t)| *t).collect();
    let decision = decide_by(&[&heard, &b], &a).expect("decided");
    assert!(decision.confidence <= 0.5, "{decision:?}");
}

#[test]
fn the_missions_index_leaves_the_others_out() {
    let mut cameras = Cameras::new(Some(1), 15_000 * MS);
    assert_eq!(cameras.take_trigger(trigger(0, 8_000)), Passage::Other);
    assert_eq!(cameras.take_trigger(trigger(1, 8_010)), Passage::Through(trigger(1, 8_010)));
    assert_eq!(cameras.decide(true), None);
    assert_eq!(cameras.confidence(), 1.0);
}
