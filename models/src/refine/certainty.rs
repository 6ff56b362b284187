//! How well the place of each picture is known: what the equations of the adjustment leave open, few sightings of a picture taken for
//! independent, and how far adjustments of disjoint halves of the points put it apart, which also shows what no formula knows. A small
//! residual says neither: a block may be bent, or hang together by a hinge, at half a pixel.

use std::time::{Duration, Instant};

use glam::DVec3;
use nalgebra::DMatrix;

use super::adjust::{Limits, adjust};
use super::calibration::LENS;
use super::keyframe::belongs;
use super::linking::median;
use super::problem::{FOCAL, INDEPENDENT, Loss, Problem, SHARED};
use super::report::{LENS_PARAMETERS, LensPrecision, PosePrecision};
use super::schur::Reduced;
use super::tracks::Tracks;
use super::{Refiner, agreement};
use crate::align::similarity::{Similarity, umeyama};

/// Key frames up to which the equations are inverted as a whole (2,400 unknowns: 46 MB); of more the halves alone are asked.
const MOST: usize = 400;
/// Steps of the adjustment of a half, which starts where the whole came to rest.
const STEPS: u32 = 8;
/// A place known worse than this share of the distance to what the picture shows is none.
const LOOSE: f64 = 0.1;
/// No place is known better than to this share of that distance: key points are of single precision.
const LEAST: f64 = 1e-6;

/// Standard deviations of a place along each axis, in the scene's units, and of the angles.
#[derive(Clone, Copy, Debug, Default)]
struct Doubt {
    /// Once what moves, turns and scales all places alike is taken out.
    within: DVec3,
    on_earth: DVec3,
    /// About the camera's axes, radians; of the scene as it lies.
    angles: DVec3,
}

/// Tells of every tied key frame how well its place is known, and no longer takes those for tied whose place is known to a tenth of the
/// distance to what they show or worse. Call it after the last [`Refiner::solve`].
pub(super) fn judge(refiner: &mut Refiner) -> Option<LensPrecision> {
    let tracks = Tracks::build(&mut refiner.union, &refiner.frames, refiner.settings.max_observations);
    agreement::agree(refiner, &tracks);
    let most = refiner.settings.max_tracks.max(refiner.settings.tracks_per_keyframe * refiner.frames.len());
    let chosen = tracks.select(refiner.frames.len(), most);
    let ((formal, lens), halves) = (by_equations(refiner, &tracks, &chosen), by_halves(refiner, &tracks, &chosen));
    let floats = refiner.standing.floating && !refiner.standing.fixed;
    let by_equations = !formal.is_empty();
    for (i, frame) in refiner.frames.iter_mut().enumerate() {
        frame.known.precision = None;
        let Some((near, far)) = frame.known.depths.filter(|_| frame.tied && !frame.known.apart) else { continue };
        let depth = f64::from(near * far).sqrt();
        let formal = formal.get(i).copied().unwrap_or_default();
        let least = DVec3::splat(LEAST * depth / 3f64.sqrt());
        let sigma = |of: fn(&Doubt) -> DVec3| {
            let (a, b) = (of(&formal), of(&halves[i]));
            (a * a + b * b + least * least).map(f64::sqrt)
        };
        let within = sigma(|d| d.within);
        let rotation_deg = (by_equations && !floats).then(|| formal.angles.map(f64::to_degrees).to_array());
        let position = if floats { within } else { sigma(|d| d.on_earth) }.to_array();
        frame.known.precision = Some(PosePrecision { position, by_equations, rotation_deg });
        // Positions that are good to metres are no fault of a scene that is seen from as near.
        frame.known.loose = within.is_nan() || within.length() > LOOSE * depth;
    }
    lens
}

/// By the equations, and of the lens; nothing where there are too many of them.
fn by_equations(refiner: &Refiner, tracks: &Tracks, chosen: &[u32]) -> (Vec<Doubt>, Option<LensPrecision>) {
    let n = refiner.frames.len();
    if n > MOST {
        return (Vec::new(), None);
    }
    let mut problem = refiner.problem(tracks, chosen, refiner.settings.outlier_px);
    // Whatever is not known exactly is open, be it estimated or not.
    problem.free = problem.shared_weight.map(|w| w > 0.0);
    let per_frame = problem.observations.len() as f64 / n.max(1) as f64;
    let (noise, dependence) = (noise(refiner, &problem), (per_frame / INDEPENDENT).sqrt().max(1.0));
    problem.pixel_sigma = noise * dependence;
    let mut equations = Reduced::new(&problem);
    equations.fill(&problem, Loss::Cauchy(2.0), 0.0);
    let unknown = DVec3::INFINITY;
    let mut doubt = vec![Doubt { within: unknown, on_earth: unknown, angles: unknown }; n];
    let Some(all) = equations.inverse() else { return (doubt, None) };
    let tied: Vec<usize> = (0..n).filter(|i| belongs(&refiner.frames[*i])).collect();
    let at = |k: usize| 6 * tied[k / 3] + 3 + k % 3;
    let mut places = DMatrix::from_fn(3 * tied.len(), 3 * tied.len(), |r, c| all[(at(r), at(c))]);
    let sigma = |of: &DMatrix<f64>, first: usize| {
        DVec3::from_array(std::array::from_fn(|axis| of[(first + axis, first + axis)].max(0.0).sqrt()))
    };
    for (k, i) in tied.iter().enumerate() {
        (doubt[*i].on_earth, doubt[*i].angles) = (sigma(&places, 3 * k), sigma(&all, 6 * i));
    }
    let centers: Vec<DVec3> = tied.iter().map(|i| refiner.frames[*i].pose.center).collect();
    without_similarities(&mut places, &centers);
    tied.iter().enumerate().for_each(|(k, i)| doubt[*i].within = sigma(&places, 3 * k));
    let lens = of_lens(&all, 6 * n + FOCAL, &problem.free);
    (doubt, Some(LensPrecision { sighting_sigma_px: noise, dependence, ..lens }))
}

/// What the covariance of all, in which the lens begins at row `first`, says of the lens.
fn of_lens(all: &DMatrix<f64>, first: usize, free: &[bool; SHARED]) -> LensPrecision {
    let open = |k: usize| free[FOCAL + k];
    let sigma: [f64; LENS] =
        std::array::from_fn(|k| if open(k) { all[(first + k, first + k)].max(0.0).sqrt() } else { 0.0 });
    let correlation = |r: usize, c: usize| match (r == c, sigma[r] * sigma[c] > 0.0) {
        (true, _) => 1.0,
        (_, true) => (all[(first + r, first + c)] / (sigma[r] * sigma[c])).clamp(-1.0, 1.0),
        _ => 0.0,
    };
    let correlation = std::array::from_fn(|r| std::array::from_fn(|c| correlation(r, c)));
    LensPrecision { parameters: LENS_PARAMETERS, sigma, correlation, sighting_sigma_px: 0.0, dependence: 1.0 }
}

/// What is left of the sightings, robustly, and no less than the key points' own noise; pixels.
fn noise(refiner: &Refiner, problem: &Problem) -> f64 {
    let mut left = Vec::with_capacity(2 * problem.observations.len());
    for (i, point) in problem.points.iter().enumerate() {
        for o in problem.sightings(i) {
            let camera = problem.camera(o.camera as usize);
            left.extend(problem.residual(&camera, *point, o).into_iter().flat_map(|r| [r.x.abs(), r.y.abs()]));
        }
    }
    // Of a normal distribution the median is 0.6745 standard deviations.
    (median(&mut left) / 0.6745).max(refiner.settings.pixel_sigma)
}

/// By how far two adjustments, each with half of the points, put a place apart.
fn by_halves(refiner: &Refiner, tracks: &Tracks, chosen: &[u32]) -> Vec<Doubt> {
    let deadline = Instant::now() + Duration::from_secs_f64(refiner.settings.solve_seconds);
    let of = |half: usize| -> Vec<DVec3> {
        let some: Vec<u32> = chosen.iter().skip(half).step_by(2).copied().collect();
        let mut problem = refiner.problem(tracks, &some, refiner.settings.outlier_px);
        problem.free = refiner.freed;
        adjust(&mut problem, Limits { loss: Loss::Cauchy(2.0), max_steps: STEPS, deadline });
        problem.poses.iter().map(|p| p.center).collect()
    };
    let (one, other) = (of(0), of(1));
    let tied: Vec<usize> = (0..refiner.frames.len()).filter(|i| belongs(&refiner.frames[*i])).collect();
    let pick = |of: &[DVec3]| tied.iter().map(|i| of[*i]).collect::<Vec<_>>();
    let by = umeyama(&pick(&other), &pick(&one), None).unwrap_or(Similarity::IDENTITY);
    // Each half has twice the variance of the whole, their difference four times.
    let half = |off: DVec3| off.abs() / 2.0;
    let doubt = |(a, b): (&DVec3, &DVec3)| Doubt {
        within: half(*a - by.apply(*b)),
        on_earth: half(*a - *b),
        angles: DVec3::ZERO,
    };
    one.iter().zip(&other).map(doubt).collect()
}

/// Takes out of the covariance of places what moves, turns and scales all of them alike.
fn without_similarities(covariance: &mut DMatrix<f64>, centers: &[DVec3]) {
    let n = centers.len();
    let middle = centers.iter().sum::<DVec3>() / n.max(1) as f64;
    let alike = DMatrix::from_fn(3 * n, 7, |row, k| {
        let (p, axis) = (centers[row / 3] - middle, row % 3);
        match k {
            0..3 => f64::from(u8::from(axis == k)),
            3..6 => DVec3::from_array(std::array::from_fn(|a| f64::from(u8::from(a == k - 3)))).cross(p)[axis],
            _ => p[axis],
        }
    });
    let mut square = alike.transpose() * &alike;
    // All on a line: turning about it changes nothing.
    let largest = square.diagonal().max().max(1e-300);
    (0..7).for_each(|k| square[(k, k)] += 1e-9 * largest);
    let Some(inverse) = square.try_inverse() else { return };
    let project = DMatrix::identity(3 * n, 3 * n) - &alike * inverse * alike.transpose();
    *covariance = &project * &*covariance * &project;
}

#[cfg(test)]
mod tests {
    use nalgebra::Matrix3;

    use super::*;

    #[test]
    fn what_moves_turns_and_scales_all_alike_is_no_doubt_within_the_scene() {
        let centers: Vec<DVec3> =
            (0..9).map(|i| DVec3::new(f64::from(i % 3) * 7.0, f64::from(i / 3) * 9.0, f64::from(i % 2))).collect();
        let at = |k: usize| {
            let axis = DVec3::new(0.3, -0.2, 0.9);
            DVec3::new(0.5, 0.1, -0.4) + axis.cross(centers[k]) + centers[k] * 0.2
        };
        let common = DMatrix::from_fn(27, 1, |r, _| at(r / 3)[r % 3]);
        let own = Matrix3::from_diagonal_element(0.04);
        let mut covariance = &common * common.transpose();
        assert!(covariance[(24, 24)] > 1.0);
        for k in 0..3 {
            covariance[(12 + k, 12 + k)] += own[(k, k)];
        }
        without_similarities(&mut covariance, &centers);
        let sigma = |i: usize| (0..3).map(|k| covariance[(3 * i + k, 3 * i + k)]).sum::<f64>().sqrt();
        assert!((0..9).filter(|i| *i != 4).all(|i| sigma(i) < 0.12), "{:?}", (0..9).map(sigma).collect::<Vec<_>>());
        assert!(sigma(4) > 0.25 && sigma(4) < 0.35, "{}", sigma(4));
    }

    #[test]
    fn what_is_said_of_the_lens_is_its_part_of_the_covariance_and_nothing_of_what_was_given_as_exact() {
        let factor = DMatrix::from_fn(SHARED + 6, SHARED + 6, |r, c| ((r * 5 + c * 3) % 7) as f64 - 3.0);
        let all = &factor * factor.transpose();
        let free = std::array::from_fn(|k| k != FOCAL + 2);
        let lens = of_lens(&all, 6 + FOCAL, &free);
        assert_eq!((lens.sigma[2], lens.correlation[2][0], lens.correlation[2][2]), (0.0, 0.0, 1.0));
        assert!((lens.sigma[0] - all[(6 + FOCAL, 6 + FOCAL)].sqrt()).abs() < 1e-12);
        let wanted = all[(6 + FOCAL, 7 + FOCAL)] / (lens.sigma[0] * lens.sigma[1]);
        assert!((lens.correlation[0][1] - wanted).abs() < 1e-12 && lens.correlation[0][1] == lens.correlation[1][0]);
    }
}
