//! Velocity of the aircraft at each key frame from its neighbours in time: the direction in which a delay between
//! GPS and shutter shifts positions.

use glam::DVec3;

/// Neighbours further apart than this say nothing about the speed at either, seconds.
const MAX_GAP_S: f64 = 60.0;
/// Shorter steps are lost in GPS noise, metres.
const MIN_STEP_M: f64 = 2.0;
/// Cosine above which two steps are one straight line (37°: wind and GPS noise make short steps swing).
const STRAIGHT: f64 = 0.8;

/// Neighbours on either side whose velocities are averaged, where they go the same way.
const SMOOTH: usize = 4;

/// Velocities in m/s, in the order given; unit vectors when any time is missing; zero where the path turns or
/// too little is known.
pub(crate) fn velocities(frames: &[(u64, DVec3)]) -> Vec<DVec3> {
    let timed = frames.iter().all(|f| f.0 != 0);
    let mut order: Vec<usize> = (0..frames.len()).collect();
    if timed {
        order.sort_by_key(|i| frames[*i].0);
    }
    // Step from each frame to the next in time.
    let steps: Vec<DVec3> = order
        .windows(2)
        .map(|w| {
            let (from, to) = (frames[w[0]], frames[w[1]]);
            let way = to.1 - from.1;
            let seconds = to.0.saturating_sub(from.0) as f64 * 1e-9;
            match (way.length() >= MIN_STEP_M, timed) {
                (false, _) => DVec3::ZERO,
                (true, false) => way.normalize(),
                (true, true) if seconds > 0.0 && seconds <= MAX_GAP_S => way / seconds,
                _ => DVec3::ZERO,
            }
        })
        .collect();
    let step = |i: isize| steps.get(i as usize).copied().filter(|_| i >= 0).unwrap_or(DVec3::ZERO);
    let straight = |a: DVec3, b: DVec3| a.normalize_or_zero().dot(b.normalize_or_zero()) > STRAIGHT;
    let raw: Vec<DVec3> = (0..order.len() as isize)
        .map(|k| {
            let (back, forth) = (step(k - 1), step(k));
            if straight(back, forth) {
                return (back + forth) / 2.0;
            }
            // End or start of a line: the side that goes on straight is the line, the other the hop to the next.
            match (straight(step(k - 2), back), straight(forth, step(k + 1))) {
                (true, false) => back,
                (false, true) => forth,
                _ => DVec3::ZERO,
            }
        })
        .collect();
    // Differences between neighbours on one line are GPS noise; left in, they would pass for knowledge of the delay.
    let mut out = vec![DVec3::ZERO; frames.len()];
    for (k, i) in order.into_iter().enumerate() {
        let near = &raw[k.saturating_sub(SMOOTH)..(k + SMOOTH + 1).min(raw.len())];
        let alike = || near.iter().filter(|v| straight(**v, raw[k]));
        out[i] = alike().sum::<DVec3>() / (alike().count().max(1) as f64);
    }
    out
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Three lines of four pictures, 20 m apart, back and forth at 5 m/s.
    fn survey(timed: bool) -> Vec<(u64, DVec3)> {
        let mut out = Vec::new();
        for line in 0..3 {
            for k in 0..4 {
                let x = if line % 2 == 0 { k } else { 3 - k } as f64 * 20.0;
                let time = (1 + out.len() as u64) * 4_000_000_000;
                out.push((if timed { time } else { 0 }, DVec3::new(x, line as f64 * 20.0, 40.0)));
            }
        }
        out
    }

    #[test]
    fn lines_flown_back_and_forth_have_opposite_velocities_up_to_their_ends() {
        let v = velocities(&survey(true));
        for k in 0..4 {
            assert!((v[k] - DVec3::new(5.0, 0.0, 0.0)).length() < 1e-9, "{k} {}", v[k]);
            assert!((v[4 + k] - DVec3::new(-5.0, 0.0, 0.0)).length() < 1e-9, "{k} {}", v[4 + k]);
        }
        assert!(velocities(&survey(false)).iter().all(|v| (v.length() - 1.0).abs() < 1e-9));
    }

    #[test]
    fn order_of_arrival_does_not_matter_when_times_are_known() {
        let mut frames = survey(true);
        let sorted = velocities(&frames);
        frames.swap(0, 7);
        let v = velocities(&frames);
        assert_eq!((v[0], v[7]), (sorted[7], sorted[0]));
    }

    #[test]
    fn hovering_and_single_frames_have_no_velocity() {
        assert!(velocities(&[]).is_empty());
        assert_eq!(velocities(&[(1, DVec3::ONE)]), vec![DVec3::ZERO]);
        let still: Vec<_> = (1..9u64).map(|k| (k * 1_000_000_000, DVec3::ONE)).collect();
        assert!(velocities(&still).iter().all(|v| *v == DVec3::ZERO));
    }
}
