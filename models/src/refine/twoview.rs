//! Relative pose of two views from matches, most of which may be wrong: the telemetry is the first hypothesis,
//! minimal samples are solved by Gauss–Newton from it (5 matches, 5 unknowns), and turned headings are tried
//! when asked for. A flat scene seen from above, on which linear eight-point solvers are singular and where a tilt
//! looks much like a shift, is the ordinary case here: telemetry stays in every estimate with its own weight.

use super::so3;
use glam::{DQuat, DVec3};
use nalgebra::{SMatrix, SVector};

/// `x_b = rotation · x_a + translation` (translation known up to its length), camera axes.
#[derive(Clone, Copy, Debug)]
pub(crate) struct RelativePose {
    /// Camera a → camera b.
    pub rotation: DQuat,
    /// Unit vector: centre of camera a, seen from b.
    pub translation: DVec3,
}

/// One match as rays with z = 1.
#[derive(Clone, Copy, Debug)]
pub(crate) struct RayPair {
    pub a: DVec3,
    pub b: DVec3,
}

/// What verification found.
#[derive(Clone, Debug)]
pub(crate) struct TwoView {
    pub pose: RelativePose,
    /// Indices into the given matches.
    pub inliers: Vec<u32>,
    /// A rotation alone explains the matches: depth cannot be told from this pair.
    pub rotation_only: bool,
}

/// Limits of the search.
#[derive(Clone, Copy, Debug)]
pub(crate) struct TwoViewLimits {
    /// Largest epipolar distance, in ray units (pixels / focal length).
    pub threshold: f64,
    pub min_inliers: usize,
    /// Try headings of `b` all around, too.
    pub any_heading: bool,
    /// Believed error of the prior's rotation and of its direction, radians.
    pub rotation_sigma: f64,
    /// See `rotation_sigma`.
    pub direction_sigma: f64,
    /// Rounds of random samples; 0 when the prior is known to be close.
    pub rounds: usize,
}

/// Where the search starts and how firmly it is held there.
#[derive(Clone, Copy)]
pub(super) struct Prior {
    pub pose: RelativePose,
    pub rotation_weight: f64,
    pub direction_weight: f64,
    /// Noise of a match, ray units.
    pub noise: f64,
    pub threshold: f64,
}

/// Rounds of sampling per start: with half the matches right, 1 − (1 − 0.5⁵)¹²⁰ = 98 % to draw a clean sample,
/// and guided matches are better than that.
pub(crate) const ROUNDS: usize = 120;
/// Results further than this many sigma from the prior (plus a degree) are chance.
const GATE: f64 = 3.5;
/// Random matches agree with *some* epipolar geometry by chance; measured below 12 % on all-wrong matches
/// (test `all_wrong_matches_are_not_verified`).
const MIN_INLIER_SHARE: f64 = 0.2;

impl RelativePose {
    /// Squared Sampson distance in ray units, and the signed algebraic error with its gradient norm.
    fn error(&self, m: &RayPair) -> (f64, f64) {
        let y = self.rotation * m.a;
        let line_b = self.translation.cross(y);
        let line_a = self.rotation.conjugate() * m.b.cross(self.translation);
        let norm = (line_b.truncate().length_squared() + line_a.truncate().length_squared()).max(1e-18);
        (m.b.dot(line_b), norm)
    }

    fn distance2(&self, m: &RayPair) -> f64 {
        let (e, norm) = self.error(m);
        e * e / norm
    }

    /// One Gauss–Newton step on rotation (3) and direction (2) over matches and prior; `scale` is the Cauchy scale
    /// in ray units, infinite for plain least squares.
    fn step<'a>(&self, matches: impl Iterator<Item = &'a RayPair>, scale: f64, prior: &Prior) -> Option<Self> {
        let (u, v) = self.translation.any_orthonormal_pair();
        let mut h = SMatrix::<f64, 5, 5>::zeros();
        let mut g = SVector::<f64, 5>::zeros();
        for m in matches {
            let (e, norm) = self.error(m);
            let d2 = e * e / norm;
            let w = 1.0 / (norm * (1.0 + d2 / (scale * scale)));
            let y = self.rotation * m.a;
            // e = b·(t × Ry): e's gradient by a left rotation is y × (b × t), by t is y × b.
            let by_rotation = y.cross(m.b.cross(self.translation));
            let by_t = y.cross(m.b);
            let j = SVector::<f64, 5>::new(by_rotation.x, by_rotation.y, by_rotation.z, by_t.dot(u), by_t.dot(v));
            h += j * j.transpose() * w;
            g += j * (e * w);
        }
        let noise2 = prior.noise * prior.noise;
        let (turn, shift) = self.away(&prior.pose);
        let off = [turn.x, turn.y, turn.z, shift.dot(u), shift.dot(v)];
        for (i, off) in off.into_iter().enumerate() {
            let weight = noise2 * if i < 3 { prior.rotation_weight } else { prior.direction_weight };
            h[(i, i)] += weight + f64::MIN_POSITIVE;
            g[i] += weight * off;
        }
        let d = -h.cholesky()?.solve(&g);
        if !d.iter().all(|x| x.abs() < 3.0) {
            return None;
        }
        Some(Self {
            rotation: (so3::exp(DVec3::new(d[0], d[1], d[2])) * self.rotation).normalize(),
            translation: (self.translation + u * d[3] + v * d[4]).normalize(),
        })
    }

    /// Rotation vector and difference of directions from `other` to here.
    fn away(&self, other: &Self) -> (DVec3, DVec3) {
        (so3::log(self.rotation * other.rotation.conjugate()), self.translation - other.translation)
    }

    /// Squared distances over all matches, truncated at the threshold (MSAC), and from the prior, in units of
    /// their noise: lower is better.
    pub(super) fn cost(&self, matches: &[RayPair], prior: &Prior) -> f64 {
        let t2 = prior.threshold * prior.threshold;
        let sum: f64 = matches.iter().map(|m| self.distance2(m).min(t2)).sum();
        let (turn, shift) = self.away(&prior.pose);
        sum / (prior.noise * prior.noise)
            + turn.length_squared() * prior.rotation_weight
            + shift.length_squared() * prior.direction_weight
    }

    /// Point in front of both cameras along both rays.
    pub(super) fn in_front(&self, m: &RayPair) -> bool {
        let y = self.rotation * m.a;
        // Depths (p, q) of p·y + t = q·b in the least-squares sense; parallel rays are far away, not behind.
        let (yy, yb, bb) = (y.dot(y), y.dot(m.b), m.b.dot(m.b));
        let (yt, bt) = (y.dot(self.translation), m.b.dot(self.translation));
        let det = yy * bb - yb * yb;
        if det < 1e-8 * yy * bb {
            return yb > 0.0;
        }
        (yb * bt - bb * yt) / det > 0.0 && (yy * bt - yb * yt) / det > 0.0
    }
}

/// Finds the relative pose that most matches agree with; `None` when too few agree with any.
pub(crate) fn verify(matches: &[RayPair], prior: RelativePose, limits: TwoViewLimits) -> Option<TwoView> {
    if matches.len() < limits.min_inliers.max(6) {
        return None;
    }
    let headings = if limits.any_heading { 8 } else { 1 };
    let mut best: Option<(f64, RelativePose, Prior)> = None;
    for k in 0..headings {
        let turn = DQuat::from_rotation_z(std::f64::consts::TAU * k as f64 / headings as f64);
        let start = Prior {
            pose: RelativePose {
                rotation: (turn * prior.rotation).normalize(),
                translation: (turn * prior.translation).try_normalize().unwrap_or(DVec3::X),
            },
            rotation_weight: limits.rotation_sigma.powi(-2),
            direction_weight: limits.direction_sigma.powi(-2),
            noise: limits.threshold / 2.0,
            threshold: limits.threshold,
        };
        let (cost, pose) = search(matches, &start, limits.rounds, k as u64);
        if best.as_ref().is_none_or(|(least, ..)| cost < *least) {
            best = Some((cost, pose, start));
        }
    }
    let (_, pose, start) = best?;
    let found = judged(matches, pose, limits.threshold, limits.min_inliers, MIN_INLIER_SHARE)?;
    let (turn, shift) = found.pose.away(&start.pose);
    let far = turn.length() > GATE * limits.rotation_sigma + 0.02
        || (!found.rotation_only && shift.length() > GATE * limits.direction_sigma + 0.02);
    (!far).then_some(found)
}

/// A relative pose as the matches want it, from one that is nearly right, and what is wrong with it then: the sum over all matches of
/// squared distances from their lines in units of the noise, each no more than the threshold's.
pub(crate) fn adapted(matches: &[RayPair], pose: RelativePose, threshold: f64) -> (f64, RelativePose) {
    let free = Prior { pose, rotation_weight: 0.0, direction_weight: 0.0, noise: threshold / 2.0, threshold };
    let polished = polish(matches, pose, 3.0 * threshold, &free);
    (polished.cost(matches, &free), polished)
}

/// Matches that agree with a relative pose, its direction turned so that they lie in front of both; `None` where they are too few.
pub(super) fn judged(
    matches: &[RayPair],
    mut pose: RelativePose,
    threshold: f64,
    min_inliers: usize,
    min_share: f64,
) -> Option<TwoView> {
    // Both signs of the direction explain the lines; only one puts the points in front.
    let t2 = threshold * threshold;
    let near: Vec<u32> = (0..matches.len() as u32).filter(|i| pose.distance2(&matches[*i as usize]) < t2).collect();
    let flipped = RelativePose { translation: -pose.translation, ..pose };
    let count = |p: &RelativePose| near.iter().filter(|i| p.in_front(&matches[**i as usize])).count();
    if count(&flipped) > count(&pose) {
        pose = flipped;
    }
    // The test of depths makes no sense for a pair without baseline, so that one is asked first.
    let rotation = best_rotation(matches, &near);
    let turned = |q: DQuat, m: &RayPair| {
        let y = q * m.a;
        y.z > 0.0 && (y / y.z - m.b).length() < 2.0 * threshold
    };
    let by_rotation = rotation.map_or(0, |q| near.iter().filter(|i| turned(q, &matches[**i as usize])).count());
    let rotation_only = by_rotation * 10 >= near.len() * 8 && !near.is_empty();
    let inliers: Vec<u32> = match (rotation_only, rotation) {
        (true, Some(q)) => {
            pose.rotation = q;
            near.into_iter().filter(|i| turned(q, &matches[*i as usize])).collect()
        }
        _ => near.into_iter().filter(|i| pose.in_front(&matches[*i as usize])).collect(),
    };
    let enough = inliers.len() >= min_inliers && inliers.len() as f64 >= min_share * matches.len() as f64;
    enough.then_some(TwoView { pose, inliers, rotation_only })
}

/// All matches at a shrinking robust scale.
pub(super) fn polish(matches: &[RayPair], start: RelativePose, first: f64, prior: &Prior) -> RelativePose {
    let (mut pose, threshold) = (start, prior.threshold);
    for scale in [first, first, first * 0.3, threshold, threshold, threshold] {
        match pose.step(matches.iter(), scale.max(threshold), prior) {
            Some(next) => pose = next,
            None => break,
        }
    }
    pose
}

/// Rotation that explains most of the matches at `near` without any translation: least squares, twice refitted to
/// the better half so that wrong matches have no pull.
fn best_rotation(matches: &[RayPair], near: &[u32]) -> Option<DQuat> {
    let mut kept: Vec<RayPair> = near.iter().map(|i| matches[*i as usize]).collect();
    let mut rotation = so3::align_directions(kept.iter().map(|m| (m.a, m.b)))?;
    for _ in 0..2 {
        let off = |m: &RayPair| (rotation * m.a).cross(m.b).length_squared();
        kept.sort_by(|x, y| off(x).total_cmp(&off(y)));
        kept.truncate(near.len().div_ceil(2));
        rotation = so3::align_directions(kept.iter().map(|m| (m.a, m.b)))?;
    }
    Some(rotation)
}

/// Best pose from one start: all matches at a shrinking robust scale, then samples around the best so far.
fn search(matches: &[RayPair], prior: &Prior, rounds: usize, seed: u64) -> (f64, RelativePose) {
    let (start, threshold) = (prior.pose, prior.threshold);
    let mut best = (start.cost(matches, prior), start);
    let consider = |best: &mut (f64, RelativePose), pose: RelativePose| {
        let cost = pose.cost(matches, prior);
        if cost < best.0 {
            *best = (cost, pose);
        }
        cost
    };
    consider(&mut best, polish(matches, start, 10.0 * threshold, prior));
    let mut random = SplitMix(seed ^ 0x9e37_79b9_7f4a_7c15);
    let all = matches.len() as f64 * (threshold / prior.noise).powi(2);
    for round in 0..rounds {
        // Share of matches the best hypothesis explains, from its truncated cost.
        let share = 1.0 - best.0 / all;
        if round as f64 * share.max(0.0).powi(5) > 4.0 {
            break; // e⁻⁴ = 2 % chance that no clean sample has been seen
        }
        let sample: [RayPair; 5] = std::array::from_fn(|_| matches[random.below(matches.len())]);
        let from = if round % 2 == 0 { start } else { best.1 };
        let solved = (0..4).try_fold(from, |pose, _| pose.step(sample.iter(), f64::INFINITY, prior));
        if let Some(pose) = solved {
            let before = best.0;
            if consider(&mut best, pose) < before {
                let polished = polish(matches, pose, 2.0 * threshold, prior);
                consider(&mut best, polished);
            }
        }
    }
    best
}

/// SplitMix64 (Steele, Lea, Flood 2014): the same matches give the same pose on every machine.
pub(super) struct SplitMix(u64);

impl Default for SplitMix {
    fn default() -> Self {
        Self(0x9e37_79b9_7f4a_7c15)
    }
}

impl SplitMix {
    pub(super) fn below(&mut self, n: usize) -> usize {
        self.0 = self.0.wrapping_add(0x9e37_79b9_7f4a_7c15);
        let mut z = self.0;
        z = (z ^ (z >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
        ((z ^ (z >> 31)) % n.max(1) as u64) as usize
    }
}

#[cfg(test)]
#[allow(clippy::unwrap_used)] // a test may
#[path = "twoview_tests.rs"]
pub(super) mod tests;
