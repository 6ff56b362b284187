//! Relative pose of two views of which nothing is known beforehand: five matches at a time, the likeliest first, and no more belief than
//! chance allows.

use glam::{DQuat, DVec2, DVec3};

use super::fivepoint;
use super::twoview::{Prior, RayPair, RelativePose, SplitMix, TwoView, judged, polish};

/// Samples of [`discover`]: with 0.45 of the matches right, 1 − (1 − 0.45⁵)²⁰⁰ = 97 % to draw a clean one; of the best matches, which are
/// asked first, more are right than of all.
const DISCOVERIES: usize = 200;
/// Matches that the first samples are drawn from.
const FIRST_ASKED: usize = 24;
/// Poses that are judged in the end.
const CANDIDATES: usize = 4;
/// Share of the matches that must agree where nothing guided them: the edges of two pictures may be all that they have in common.
const LEAST_SHARE: f64 = 0.1;
/// Decimal logarithm of the number of relative poses that as many matches would agree with by chance, all of them wrong, from which on
/// they are taken for right (Moisan and Stival 2004).
const BY_CHANCE: f64 = -4.0;

/// Finds the relative pose that most matches agree with where nothing is known of it beforehand; `None` when no more agree with any than
/// would by chance. The likeliest matches come first; `size` is that of a picture in ray units.
pub(crate) fn discover(matches: &[RayPair], size: DVec2, threshold: f64, min_inliers: usize) -> Option<TwoView> {
    if matches.len() < min_inliers.max(6) {
        return None;
    }
    let anywhere = RelativePose { rotation: DQuat::IDENTITY, translation: DVec3::X };
    let free = Prior { pose: anywhere, rotation_weight: 0.0, direction_weight: 0.0, noise: threshold / 2.0, threshold };
    // The cheapest come first: a pose that agrees with many wrong matches by chance may cost less than the right one.
    let mut best = [(f64::INFINITY, anywhere); CANDIDATES];
    let mut random = SplitMix::default();
    let all = matches.len() as f64 * 4.0;
    for round in 0..DISCOVERIES {
        let share = (1.0 - best[0].0 / all).max(0.0);
        if round as f64 * share.powi(5) > 4.0 {
            break; // e⁻⁴ = 2 % chance that no clean sample has been seen
        }
        // The best first, then more and more of them (Chum and Matas 2005); all of them in the second half.
        let asked =
            (2 * matches.len() * (round + 1) / DISCOVERIES).clamp(FIRST_ASKED.min(matches.len()), matches.len());
        let sample: [RayPair; 5] = std::array::from_fn(|_| matches[random.below(asked)]);
        for pose in fivepoint::solve(&sample) {
            if pose.cost(matches, &free) < best[CANDIDATES - 1].0 {
                let polished = polish(matches, pose, 2.0 * threshold, &free);
                let candidate = [pose, polished].map(|pose| (pose.cost(matches, &free), pose));
                let candidate = if candidate[1].0 < candidate[0].0 { candidate[1] } else { candidate[0] };
                let at = best.partition_point(|b| b.0 <= candidate.0);
                if at < CANDIDATES {
                    best[at..].rotate_right(1);
                    best[at] = candidate;
                }
            }
        }
    }
    // A wrong match lies as near to a line by the share of the picture that is so near to it.
    let near = (2.0 * threshold * size.length() / (size.x * size.y)).min(1.0);
    let judge = |(cost, pose): &(f64, RelativePose)| {
        cost.is_finite().then(|| judged(matches, *pose, threshold, min_inliers, LEAST_SHARE)).flatten()
    };
    let sure = |found: &TwoView| by_chance(matches.len(), found.inliers.len(), near) < BY_CHANCE;
    best.iter().filter_map(judge).find(sure)
}

/// Decimal logarithm of the number of relative poses, each of five of `all` matches, that `agree` of them would agree with if all were
/// wrong and each lay near a line with probability `near`.
fn by_chance(all: usize, agree: usize, near: f64) -> f64 {
    if agree <= 5 {
        return f64::INFINITY;
    }
    // Ten poses of every five, at the most; C(n, k) and C(k, 5).
    let choose = |n: usize, k: usize| (0..k).map(|i| (((n - i) as f64) / ((i + 1) as f64)).log10()).sum::<f64>();
    let tests = (10.0 * (all - 5).max(1) as f64).log10();
    tests + choose(all, agree) + choose(agree, 5) + (agree - 5) as f64 * near.max(1e-12).log10()
}

#[cfg(test)]
#[allow(clippy::unwrap_used)] // a test may
mod tests {
    use super::*;
    use crate::refine::so3;
    use crate::refine::twoview::tests::{angle, scene};

    #[test]
    fn a_strip_of_right_matches_is_found_among_many_wrong_ones_with_no_idea_beforehand_and_none_where_all_are_wrong() {
        let (baseline, turn) = (DVec3::new(9.0, 4.0, 0.5), so3::exp(DVec3::new(0.05, -0.1, 0.4)));
        let size = DVec2::new(1.2, 0.9);
        for seed in 0..6 {
            // The likeliest come first: most of the first are right, and one in six of all.
            let all = scene(baseline, turn, 50, 270, seed);
            let mut matches: Vec<RayPair> = all[..40].iter().chain(&all[50..56]).copied().collect();
            matches.extend(&all[56..]);
            matches.extend(&all[40..50]);
            let found = discover(&matches, size, 2.0 / 400.0, 16).unwrap();
            assert!(angle(found.pose.rotation, turn) < 4.0, "{}", angle(found.pose.rotation, turn));
            assert!(discover(&all[50..], size, 2.0 / 400.0, 16).is_none(), "{seed}");
        }
    }
}
