//! Where a picture was taken, from points whose places are known and of which many may be wrong, with no idea beforehand: three points
//! at a time (Lambda Twist, Persson and Nordberg 2018), the place that most of the others agree with, then all of those together.

use glam::{DMat3, DQuat, DVec2, DVec3};
use nalgebra::Matrix3;

use super::resect::resect;
use super::twoview::SplitMix;
use crate::camera::{Pinhole, Pose};

/// Samples at most: with 0.25 of the points right, 1 − (1 − 0.25³)³⁰⁰ = 99 % to draw a clean one.
const ROUNDS: usize = 300;

/// The pose that most of `seen` (world point, pixel) agree with to within `limit` pixels, and how many do; `None` where fewer than
/// `least` agree with any.
pub(super) fn find(lens: Pinhole, seen: &[(DVec3, [f32; 2])], limit: f64, least: usize) -> Option<(Pose, usize)> {
    if seen.len() < least.max(4) {
        return None;
    }
    let agree = |pose: &Pose| -> Vec<(DVec3, [f32; 2])> {
        let camera = Pinhole { pose: *pose, ..lens };
        let near = |(world, pixel): &&(DVec3, [f32; 2])| {
            let pixel = DVec2::new(pixel[0].into(), pixel[1].into());
            camera.project(*world).is_some_and(|q| q.distance(pixel) < limit)
        };
        seen.iter().filter(near).copied().collect()
    };
    let mut random = SplitMix::default();
    let mut best: (usize, Option<Pose>) = (0, None);
    for round in 0..ROUNDS {
        let share = best.0 as f64 / seen.len() as f64;
        if round as f64 * share.powi(3) > 5.0 {
            break; // e⁻⁵ = 1 % chance that no clean sample has been seen
        }
        let [i, j, k] = std::array::from_fn(|_| random.below(seen.len()));
        if i == j || j == k || i == k {
            continue;
        }
        let of = [seen[i], seen[j], seen[k]];
        for pose in solve(of.map(|s| lens.ray(s.1).normalize()), of.map(|s| s.0)) {
            let count = agree(&pose).len();
            if count > best.0 {
                best = (count, Some(pose));
            }
        }
    }
    let mut pose = best.1.filter(|_| best.0 >= least)?;
    // Those that agree, together; what agrees with that, once more.
    for _ in 0..2 {
        pose = resect(Pinhole { pose, ..lens }, &agree(&pose), limit)?;
    }
    let count = agree(&pose).len();
    (count >= least).then_some((pose, count))
}

/// Poses (camera axes → world) from which three points are seen along three unit rays; up to four.
fn solve(y: [DVec3; 3], x: [DVec3; 3]) -> Vec<Pose> {
    let [d12, d13, d23] = [x[0] - x[1], x[0] - x[2], x[1] - x[2]];
    let [a12, a13, a23] = [d12, d13, d23].map(DVec3::length_squared);
    if d12.cross(d13).length_squared() < 1e-12 * a12 * a13 {
        return Vec::new();
    }
    let [c12, c31, c23] = [y[0].dot(y[1]), y[0].dot(y[2]), y[1].dot(y[2])];
    let [b12, b13, b23] = [-2.0 * c12, -2.0 * c31, -2.0 * c23];
    let [s12, s31, s23] = [c12, c31, c23].map(|c| 1.0 - c * c);
    let blob = c12 * c23 * c31 - 1.0;
    // The cubic of which every root makes the pencil of the two quadratic forms degenerate.
    let p3 = a13 * (a23 * s31 - a13 * s23);
    let p2 = 2.0 * blob * a23 * a13 + a13 * (2.0 * a12 + a13) * s23 + a23 * (a23 - a12) * s31;
    let p1 = a23 * (a13 - a23) * s12 - a12 * a12 * s23 - 2.0 * a12 * (blob * a23 + a13 * s23);
    let p0 = a12 * (a12 * s23 - a23 * s12);
    let Some(g) = root([p0, p1, p2, p3]) else { return Vec::new() };
    let a00 = a23 * (1.0 - g);
    let a01 = a23 * b12 * 0.5;
    let a02 = -a23 * b13 * g * 0.5;
    let a11 = a23 - a12 + a13 * g;
    let a12_ = b23 * (a13 * g - a12) * 0.5;
    let a22 = g * (a13 - a23) - a12;
    let form = Matrix3::new(a00, a01, a02, a01, a11, a12_, a02, a12_, a22);
    let eigen = form.symmetric_eigen();
    let mut order = [0, 1, 2];
    order.sort_by(|i, j| eigen.eigenvalues[*j].abs().total_cmp(&eigen.eigenvalues[*i].abs()));
    let (l0, l1) = (eigen.eigenvalues[order[0]], eigen.eigenvalues[order[1]]);
    let v = |row: usize, column: usize| eigen.eigenvectors[(row, order[column])];
    let ratio = (-l1 / l0).max(0.0).sqrt();
    let mut found = Vec::new();
    for s in [ratio, -ratio] {
        let w2 = 1.0 / (s * v(0, 1) - v(0, 0));
        let w0 = (v(1, 0) - s * v(1, 1)) * w2;
        let w1 = (v(2, 0) - s * v(2, 1)) * w2;
        let a = 1.0 / ((a13 - a12) * w1 * w1 - a12 * b13 * w1 - a12);
        let b = (a13 * b12 * w1 - a12 * b13 * w0 - 2.0 * w0 * w1 * (a12 - a13)) * a;
        let c = ((a13 - a12) * w0 * w0 + a13 * b12 * w0 + a13) * a;
        let disc = b * b - 4.0 * c;
        if disc.is_nan() || disc < 0.0 {
            continue;
        }
        for tau in [(-b + disc.sqrt()) / 2.0, (-b - disc.sqrt()) / 2.0] {
            let d = a23 / (tau * (b23 + tau) + 1.0);
            if !(tau > 0.0 && d > 0.0) {
                continue;
            }
            let l2 = d.sqrt();
            let l3 = tau * l2;
            let l1 = w0 * l2 + w1 * l3;
            if l1 > 0.0 {
                found.extend(pose_of([l1, l2, l3], y, x));
            }
        }
    }
    found
}

/// A real root of a cubic, lowest power first, or of what is left where the highest vanishes.
fn root(p: [f64; 4]) -> Option<f64> {
    let size = p.iter().fold(0.0f64, |a, b| a.max(b.abs()));
    if size.is_nan() || p[3].abs() < 1e-14 * size {
        return None;
    }
    let [c, b, a] = [p[0] / p[3], p[1] / p[3], p[2] / p[3]];
    let at = |x: f64| ((x + a) * x + b) * x + c;
    // A cubic has one real root at least, within Cauchy's bound.
    let bound = 1.0 + a.abs().max(b.abs()).max(c.abs());
    let (mut low, mut high) = (-bound, bound);
    for _ in 0..200 {
        let middle = 0.5 * (low + high);
        if middle <= low || middle >= high {
            break;
        }
        if at(middle) > 0.0 { high = middle } else { low = middle }
    }
    let x = 0.5 * (low + high);
    x.is_finite().then_some(x)
}

/// The pose that puts three points at these distances along their rays.
fn pose_of(lengths: [f64; 3], y: [DVec3; 3], x: [DVec3; 3]) -> Option<Pose> {
    let at: [DVec3; 3] = std::array::from_fn(|i| y[i] * lengths[i]);
    let frame = |p: [DVec3; 3]| {
        let (u, v) = ((p[0] - p[1]).try_normalize()?, p[0] - p[2]);
        let w = u.cross(v).try_normalize()?;
        Some(DMat3::from_cols(u, w.cross(u), w))
    };
    let rotation = DQuat::from_mat3(&(frame(x)? * frame(at)?.transpose())).normalize();
    let center = x[0] - rotation * at[0];
    (rotation.is_finite() && center.is_finite()).then_some(Pose { rotation, center })
}

#[cfg(test)]
#[allow(clippy::unwrap_used)] // a test may
mod tests {
    use rand::{Rng, SeedableRng};

    use super::*;
    use crate::camera::Intrinsics;

    const K: Intrinsics = Intrinsics { width: 640, height: 480, fx: 500.0, fy: 500.0, cx: 320.0, cy: 240.0 };

    fn scene(rng: &mut rand_pcg::Pcg64Mcg) -> (Pose, Vec<(DVec3, [f32; 2])>) {
        let mut at = |size: f64| DVec3::from_array(std::array::from_fn(|_| rng.random_range(-size..size)));
        let truth = Pose { rotation: DQuat::from_scaled_axis(at(2.0)).normalize(), center: at(30.0) };
        let camera = Pinhole::new(truth, &K, 1.0);
        let seen = std::iter::repeat_with(|| {
            let p = truth.center + truth.rotation * (at(6.0) + DVec3::Z * 14.0);
            (p, camera.project(p).unwrap().as_vec2().to_array())
        });
        (truth, seen.take(60).collect())
    }

    #[test]
    fn three_exact_points_give_the_pose_they_were_made_with() {
        let mut rng = rand_pcg::Pcg64Mcg::seed_from_u64(5);
        let mut found = 0;
        for _ in 0..200 {
            let (truth, seen) = scene(&mut rng);
            let lens = Pinhole::new(truth, &K, 1.0);
            let of = [seen[0], seen[1], seen[2]];
            let near =
                |p: &Pose| p.rotation.angle_between(truth.rotation) < 1e-3 && p.center.distance(truth.center) < 0.05;
            found += usize::from(solve(of.map(|s| lens.ray(s.1).normalize()), of.map(|s| s.0)).iter().any(near));
        }
        assert!(found >= 190, "{found} of 200");
    }

    #[test]
    fn a_place_is_found_among_two_thirds_of_wrong_points_and_none_where_all_are_wrong() {
        let mut rng = rand_pcg::Pcg64Mcg::seed_from_u64(6);
        for _ in 0..20 {
            let (truth, mut seen) = scene(&mut rng);
            let lens = Pinhole::new(Pose { rotation: DQuat::IDENTITY, center: DVec3::ZERO }, &K, 1.0);
            let anywhere = |rng: &mut rand_pcg::Pcg64Mcg| [rng.random_range(0.0..640.0), rng.random_range(0.0..480.0)];
            seen.iter_mut().skip(20).for_each(|s| s.1 = anywhere(&mut rng));
            let (pose, agree) = find(lens, &seen, 3.0, 15).unwrap();
            assert!(agree >= 20 && pose.center.distance(truth.center) < 0.1, "{agree}, {pose:?}");
            seen.iter_mut().for_each(|s| s.1 = anywhere(&mut rng));
            assert!(find(lens, &seen, 3.0, 15).is_none());
        }
    }
}
