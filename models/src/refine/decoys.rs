//! Matches along epipolar lines, and how many of them are wrong.
//!
//! Of the many key points near a line some look alike by chance, and all of those agree with the line. How many they are is measured: the
//! same search along lines beside the right ones finds nothing but wrong matches. As in target-decoy searches (Elias and Gygi, "Target-decoy
//! search strategy", Nature Methods 2007), the matches that look most alike are kept, down to where a stated share of them may be wrong.

use glam::{DVec2, DVec3};

use super::keyframe::KeyFrame;
use super::matching::{Guide, Match, MatchLimits, likeliest_first, likenesses, match_frames};

/// Where nothing can match: lines beside the right ones, in widths of the search on either side.
const BESIDE: [f64; 2] = [-4.0, 4.0];
/// Share of the matches that are kept that may be wrong. A track joins those of many pairs, and one wrong match of them spoils it: with a
/// fifth, a sixth of the tracks along a paved street were right, with a twentieth two fifths.
pub(super) const FEW_WRONG: f64 = 0.05;
/// This share, of a picture that has too few matches to be placed: it is placed by what most of them agree on.
pub(super) const SOME_WRONG: f64 = 0.2;

/// Matches of `b` against `a` within `width` pixels of its key points' epipolar lines in `a`, the likeliest first; a `share` of them may be
/// wrong.
pub(super) fn match_along(
    (a, b): (&KeyFrame, &KeyFrame),
    (lines, width): (&[DVec3], f64),
    limits: MatchLimits,
    share: f64,
) -> Vec<Match> {
    let center = DVec2::new(a.intrinsics.cx.into(), a.intrinsics.cy.into());
    let anywhere = vec![Some(center); b.keypoints().len()];
    let along = |lines: &[DVec3]| {
        match_frames(a, b, &Guide { predicted: &anywhere, radius: f64::INFINITY, lines: Some((lines, width)) }, limits)
    };
    let mut matches = along(lines);
    likeliest_first(a, b, &mut matches);
    let mut wrong: Vec<i32> = Vec::new();
    for beside in BESIDE {
        let lines: Vec<DVec3> = lines.iter().map(|l| l.truncate().extend(l.z + 2.0 * beside * width)).collect();
        wrong.extend(likenesses(a, b, &along(&lines)));
    }
    wrong.sort_unstable_by_key(|score| std::cmp::Reverse(*score));
    matches.truncate(believed(&likenesses(a, b, &matches), &wrong, BESIDE.len(), share));
    matches
}

/// How many matches to believe, the likeliest first: down to the last at which no more than `share` of them are expected to be wrong.
/// `wrong` has the scores of `searches` searches that found nothing but wrong ones; both begin with the highest.
fn believed(scores: &[i32], wrong: &[i32], searches: usize, share: f64) -> usize {
    let mut believed = 0;
    for (i, score) in scores.iter().enumerate() {
        let by_chance = wrong.partition_point(|w| w >= score) as f64 / searches as f64;
        if by_chance <= share * (i + 1) as f64 {
            believed = i + 1;
        }
    }
    believed
}

#[cfg(test)]
mod tests {
    use glam::DQuat;

    use super::*;
    use crate::camera::{Intrinsics, Pose, PoseSigma, View};
    use crate::frame_file::Kept;
    use crate::refine::intake::arrived;
    use crate::refine::keyframe::{DESCRIPTOR, Descriptors};

    /// Side of the pictures, pixels, and key points in each.
    const SIDE: u32 = 1000;
    const POINTS: usize = 900;
    /// Points of the second picture that are the first one's.
    const SAME: usize = POINTS / 8;

    /// Numbers by chance, 0 … 1, the same ones for the same seed.
    struct Chance(u64);

    impl Chance {
        fn unit(&mut self) -> f64 {
            self.0 = self.0.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
            ((self.0 ^ (self.0 >> 33)).wrapping_mul(0xff51_afd7_ed55_8ccd) >> 11) as f64 / (1u64 << 53) as f64
        }

        /// A unit vector times 127 that lies `off` from `from`, in units of its own length.
        fn near(&mut self, from: &[f64], off: f64) -> Vec<f64> {
            let noise: Vec<f64> = from.iter().map(|_| self.unit() - 0.5).collect();
            let long = |v: &[f64]| v.iter().map(|x| x * x).sum::<f64>().sqrt();
            let scale = off * 127.0 / long(&noise);
            let moved: Vec<f64> = from.iter().zip(&noise).map(|(f, n)| f + scale * n).collect();
            let length = long(&moved);
            moved.iter().map(|v| v * 127.0 / length).collect()
        }
    }

    fn frame(seen: Vec<[f32; 2]>, descriptors: &[Vec<f64>]) -> KeyFrame {
        let intrinsics = Intrinsics { width: SIDE, height: SIDE, fx: 800.0, fy: 800.0, cx: 500.0, cy: 500.0 };
        let pose = Pose { rotation: DQuat::IDENTITY, center: DVec3::ZERO };
        let sigma = PoseSigma { position_m: [1.0; 3], rotation_rad: [0.01; 3] };
        let mut frame = arrived("a.jpg", 0, &View { intrinsics, pose }, &sigma);
        let values = descriptors.iter().flatten().map(|v| v.round() as i8).collect();
        frame.descriptors = Kept::at_best(Descriptors(values), None);
        frame.settled = vec![false; seen.len()];
        frame.seen = seen;
        frame
    }

    /// A picture and another one taken beside it, of a world that repeats itself: every key point is of one of 15 kinds. The
    /// first of the second picture's points are the first one's, moved along the row; those have the same index in both.
    fn repetitive_pair(chance: &mut Chance) -> (KeyFrame, KeyFrame) {
        let kinds: Vec<Vec<f64>> = (0..40).map(|_| chance.near(&[0.0; DESCRIPTOR], 1.0)).collect();
        let (mut in_a, mut in_b, mut of_a, mut of_b) = (Vec::new(), Vec::new(), Vec::new(), Vec::new());
        for i in 0..POINTS {
            let mut place = || [(chance.unit() * 1000.0) as f32, (chance.unit() * 1000.0) as f32];
            let (a, b) = (place(), place());
            let mut thing = || {
                let kind = (chance.unit() * 15.0) as usize;
                chance.near(&kinds[kind], 0.4)
            };
            let (seen, other) = (thing(), thing());
            let is_same = i < SAME;
            in_a.push(a);
            of_a.push(seen.clone());
            in_b.push(if is_same { [b[0], a[1]] } else { b });
            of_b.push(if is_same { chance.near(&seen, 0.3) } else { other });
        }
        (frame(in_a, &of_a), frame(in_b, &of_b))
    }

    #[test]
    fn of_the_matches_along_lines_of_a_world_that_repeats_itself_at_most_the_stated_share_is_wrong() {
        let limits = MatchLimits { min_cosine: 0.5, cosine_margin: 0.0, features: POINTS };
        for seed in 0..5 {
            let (a, b) = repetitive_pair(&mut Chance(seed));
            // The second camera stands beside the first: every line is the point's own row.
            let rows: Vec<DVec3> = b.keypoints().iter().map(|p| DVec3::new(0.0, 1.0, -f64::from(p[1]))).collect();
            let wrong_of = |found: &[Match]| found.iter().filter(|m| m.a != m.b).count() as f64;
            let anywhere = vec![Some(DVec2::splat(500.0)); b.keypoints().len()];
            let guide = Guide { predicted: &anywhere, radius: f64::INFINITY, lines: Some((&rows, 4.0)) };
            let all = match_frames(&a, &b, &guide, limits);
            assert!(
                wrong_of(&all) > 0.5 * all.len() as f64,
                "hardly any are wrong: {} of {}",
                wrong_of(&all),
                all.len()
            );
            let found = match_along((&a, &b), (&rows, 4.0), limits, FEW_WRONG);
            let wrong = wrong_of(&found);
            let right = found.len() as f64 - wrong;
            assert!(wrong <= 0.08 * found.len() as f64, "{wrong} of {}", found.len());
            assert!(right >= 0.8 * SAME as f64, "{right} of {SAME}");
        }
    }

    #[test]
    fn as_many_matches_are_believed_as_look_more_alike_than_wrong_ones_do() {
        assert_eq!(believed(&[9, 8, 7, 6], &[], 2, 0.2), 4, "nothing was found beside the lines");
        assert_eq!(believed(&[5, 4, 3], &[5, 5, 4, 4, 3, 3], 2, 0.2), 0, "as many beside them as along them");
        // Ten that look alike; then one in two is by chance.
        let scores: Vec<i32> = (0..10).map(|i| 100 - i).chain((0..10).map(|i| 50 - i)).collect();
        let wrong: Vec<i32> = (0..10).flat_map(|i| [50 - i; 2]).collect();
        assert_eq!(believed(&scores, &wrong, 2, 0.2), 12, "2 of 12 may be wrong, 3 of 13 are too many");
    }
}
