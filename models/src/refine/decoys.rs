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
/// Share of the matches that are kept that may be wrong.
const WRONG_SHARE: f64 = 0.2;

/// Matches of `b` against `a` within `width` pixels of its key points' epipolar lines in `a`, the likeliest first.
pub(super) fn match_along(a: &KeyFrame, b: &KeyFrame, lines: &[DVec3], width: f64, limits: MatchLimits) -> Vec<Match> {
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
    matches.truncate(believed(&likenesses(a, b, &matches), &wrong, BESIDE.len(), WRONG_SHARE));
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
    use super::*;

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
