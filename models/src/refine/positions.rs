//! A scene that pictures alone have placed is brought to where its pictures say they were taken: by the similarity that most of the
//! positions agree with, so that they give place, north, scale and gravity, and none of them an attitude.

use glam::DVec3;
use nalgebra::Matrix3;

use super::Refiner;
use super::bootstrap::SIGMA;
use super::keyframe::{KeyFrame, belongs};
use super::linking::median;
use crate::align::similarity::{Similarity, umeyama};

/// Positions off by more than so many of their standard deviations, and this share of the scene's extent by which a chain of pictures
/// may have bent, are not believed.
const WRONG: (f64, f64) = (4.0, 0.05);
/// Triples of positions that are tried at most.
const TRIPLES: usize = 3000;
/// How well cameras that are held level, or the ground, tell the vertical before positions do, radians.
const VERTICAL: f64 = 0.5;
/// Share of the pictures' sideways axes that must differ in direction before they tell the vertical.
const TURNED: f64 = 0.05;

/// What the positions of pictures made of a scene that was placed without them.
#[derive(Clone, Debug, Default)]
pub struct PositionsReport {
    /// Placed pictures with a position.
    pub compared: usize,
    /// Pictures whose position contradicts the others', and by how many metres.
    pub refused: Vec<(String, f64)>,
}

/// Brings a scene that [`Refiner::bootstrap`] has placed to the positions that its pictures came with, which are its priors from
/// then on. `None`, and nothing changed, where more than half of them contradict it, or fewer than three do not.
pub(super) fn take_positions(refiner: &mut Refiner) -> Option<PositionsReport> {
    let placed: Vec<usize> = (0..refiner.frames.len())
        .filter(|i| !refiner.frames[*i].unplaced && refiner.frames[*i].told.pose.center.is_finite())
        .filter(|i| refiner.frames[*i].told.sigma.position_m.iter().all(|s| s.is_finite()))
        .collect();
    let from: Vec<DVec3> = placed.iter().map(|i| refiner.frames[*i].pose.center).collect();
    let to: Vec<DVec3> = placed.iter().map(|i| refiner.frames[*i].told.pose.center).collect();
    let sigma: Vec<f64> = placed
        .iter()
        .map(|i| refiner.frames[*i].told.sigma.position_m.map(f64::from).iter().sum::<f64>() / 3.0)
        .collect();
    let (by, good) = agreed(&from, &to, &sigma, upright(refiner, &placed))?;
    if 2 * good.len() <= placed.len() {
        return None;
    }
    let mut report = PositionsReport { compared: placed.len(), refused: Vec::new() };
    for frame in &mut refiner.frames {
        frame.pose.rotation = (by.rotation * frame.pose.rotation).normalize();
        frame.pose.center = by.apply(frame.pose.center);
        (frame.prior, frame.sigma.rotation_rad) = (frame.pose, SIGMA.rotation_rad);
        frame.prior.center = frame.told.pose.center;
        frame.sigma.position_m = frame.told.sigma.position_m;
        // Its place is better known by now than its position tells.
        frame.adjusted = !frame.unplaced;
    }
    for (k, i) in placed.iter().enumerate().filter(|(k, _)| !good.contains(k)) {
        let frame = &mut refiner.frames[*i];
        frame.prior.center = frame.pose.center;
        frame.sigma.position_m = SIGMA.position_m.map(|s| s * by.scale as f32);
        report.refused.push((frame.name.clone(), by.apply(from[k]).distance(to[k])));
    }
    refiner.ground = refiner.ground.map(|z| by.apply(DVec3::new(from[0].x, from[0].y, z)).z);
    refiner.standing.floating = false;
    Some(report)
}

/// Tied pictures whose solved places are further from the positions that they came with than these may be wrong, and how far, metres:
/// either the scene is bent, or they are wrong.
pub(super) fn places_off(refiner: &Refiner) -> Vec<(String, f64)> {
    let stated = |f: &&KeyFrame| belongs(f) && f.told.sigma.position_m.iter().all(|s| s.is_finite());
    let off = |f: &KeyFrame| {
        let away = f.pose.center - f.told.pose.center;
        let per = DVec3::from_array(f.told.sigma.position_m.map(f64::from)) * WRONG.0;
        // What cannot be known of the place itself is no fault of the position.
        let room = WRONG.0 * f.known.precision.map_or(0.0, |p| p.distance());
        let excess = (away.abs() - DVec3::splat(room)).max(DVec3::ZERO) / per;
        (excess.length() > 1.0).then(|| (f.name.clone(), away.length()))
    };
    refiner.frames.iter().filter(stated).filter_map(off).collect()
}

/// How far the solved heights of tied pictures are from those that they came with in the median, and the standard deviation that
/// these came with, metres; `None` of fewer than three.
pub(super) fn height_off_m(refiner: &Refiner) -> Option<(f64, f64)> {
    let of = refiner.frames.iter().filter(|f| belongs(f) && f.told.sigma.position_m[2].is_finite());
    let both = of.map(|f| ((f.pose.center.z - f.told.pose.center.z).abs(), f64::from(f.told.sigma.position_m[2])));
    let (mut off, mut sigma): (Vec<f64>, Vec<f64>) = both.unzip();
    (off.len() >= 3).then(|| (median(&mut off), median(&mut sigma)))
}

/// The vertical of the scene as its pictures tell it: people and gimbals hold cameras level, so that their sideways axes lie in one
/// plane; where all of these point the same way, as the ground tells it.
fn upright(refiner: &Refiner, placed: &[usize]) -> DVec3 {
    let mut spread = Matrix3::<f64>::zeros();
    let mut top = DVec3::ZERO;
    for i in placed {
        let rotation = refiner.frames[*i].pose.rotation;
        let x = nalgebra::Vector3::from((rotation * DVec3::X).to_array());
        spread += x * x.transpose();
        top -= rotation * (DVec3::Y + DVec3::Z);
    }
    let eigen = spread.symmetric_eigen();
    let least = eigen.eigenvalues.imin();
    let second = eigen.eigenvalues.iter().enumerate().filter(|(k, _)| *k != least).map(|(_, v)| *v);
    if second.fold(f64::INFINITY, f64::min) < TURNED * placed.len() as f64 {
        return DVec3::Z;
    }
    let column = eigen.eigenvectors.column(least);
    let up = DVec3::new(column[0], column[1], column[2]);
    if up.dot(top) < 0.0 { -up } else { up }
}

/// The similarity that most positions agree on, with `up` as a weak word on the vertical, and which they are.
fn agreed(from: &[DVec3], to: &[DVec3], sigma: &[f64], up: DVec3) -> Option<(Similarity, Vec<usize>)> {
    let n = from.len();
    let middle = from.iter().sum::<DVec3>() / n.max(1) as f64;
    let extent = from.iter().map(|p| p.distance(middle)).fold(0.0, f64::max);
    let fitted = |chosen: &[usize]| -> Option<Similarity> {
        let spread = |of: &[DVec3]| {
            let middle = chosen.iter().map(|i| of[*i]).sum::<DVec3>() / chosen.len() as f64;
            chosen.iter().map(|i| of[*i].distance_squared(middle)).sum::<f64>().sqrt()
        };
        let (own, told) = (spread(from), spread(to));
        if !(own > 0.0 && told > 0.0) {
            return None;
        }
        // Above every place another, as high as the places lie apart: together they hold the vertical to [`VERTICAL`].
        let of = |p: &[DVec3], above: DVec3| -> Vec<DVec3> {
            chosen.iter().map(|i| p[*i]).chain(chosen.iter().map(|i| p[*i] + above)).collect()
        };
        let weight = 1.0 / (chosen.len() as f64 * (VERTICAL * told).powi(2));
        let mut weights: Vec<f64> = chosen.iter().map(|i| sigma[*i].max(1e-6).powi(-2)).collect();
        weights.extend(std::iter::repeat_n(weight, chosen.len()));
        umeyama(&of(from, up * own), &of(to, DVec3::Z * told), Some(&weights)).ok()
    };
    let off = |by: &Similarity, i: usize| by.apply(from[i]).distance(to[i]);
    let limit = |by: &Similarity, i: usize| WRONG.0 * sigma[i] + WRONG.1 * extent * by.scale;
    let good = |by: &Similarity| (0..n).filter(|i| off(by, *i) < limit(by, *i)).collect::<Vec<_>>();
    let all = (0..n).flat_map(|a| (a + 1..n).flat_map(move |b| (b + 1..n).map(move |c| [a, b, c])));
    let every = (n * n.saturating_sub(1) * n.saturating_sub(2) / 6).div_ceil(TRIPLES).max(1);
    let cost = |by: &Similarity| (0..n).map(|i| (off(by, i) / limit(by, i)).min(1.0).powi(2)).sum::<f64>();
    let tried = all.step_by(every).filter_map(|triple| fitted(&triple)).map(|by| (cost(&by), by));
    let mut by = tried.min_by(|a, b| a.0.total_cmp(&b.0))?.1;
    for _ in 0..3 {
        let chosen = good(&by);
        if chosen.len() < 3 {
            return None;
        }
        by = fitted(&chosen)?;
    }
    // All in one spot say nothing of the scale.
    let good = good(&by);
    let apart = good.iter().map(|i| to[*i].distance(to[good[0]])).fold(0.0, f64::max);
    let usual = good.iter().map(|i| sigma[*i]).fold(0.0, f64::max);
    (good.len() >= 3 && apart > 2.0 * usual).then_some((by, good))
}

#[cfg(test)]
#[allow(clippy::unwrap_used)] // a test may
mod tests {
    use glam::DQuat;

    use super::*;

    #[test]
    fn positions_give_place_scale_and_gravity_whatever_some_of_them_say() {
        let turn = DQuat::from_scaled_axis(DVec3::new(0.9, -1.3, 0.4));
        let mut to: Vec<DVec3> = (0..24)
            .map(|i| DVec3::new(f64::from(i % 6) * 9.0, f64::from(i / 6) * 12.0, 60.0 + f64::from(i % 3)))
            .collect();
        let from: Vec<DVec3> = to.iter().map(|p| turn * (*p - DVec3::X * 7.0) * 0.02).collect();
        for i in 0..7 {
            to[3 * i] += DVec3::new(40.0, -15.0 * f64::from(i as u8), 90.0);
        }
        let (by, good) = agreed(&from, &to, &[3.0; 24], turn * DVec3::new(0.1, 0.0, 1.0).normalize()).unwrap();
        assert_eq!(good.len(), 17);
        assert!((by.scale * 0.02 - 1.0).abs() < 0.01, "{}", by.scale);
        assert!((by.rotation * turn * DVec3::Z).angle_between(DVec3::Z) < 0.02);
        // One place for all says nothing.
        assert!(agreed(&from, &[DVec3::ONE; 24], &[3.0; 24], turn * DVec3::Z).is_none());
    }

    #[test]
    fn a_single_line_of_positions_leaves_gravity_to_the_pictures() {
        let turn = DQuat::from_scaled_axis(DVec3::new(0.9, -1.3, 0.4));
        let to: Vec<DVec3> = (0..12).map(|i| DVec3::new(f64::from(i) * 9.0, f64::from(i % 2) * 0.2, 60.0)).collect();
        let from: Vec<DVec3> = to.iter().map(|p| turn * *p * 0.1).collect();
        let (by, _) = agreed(&from, &to, &[3.0; 12], turn * DVec3::Z).unwrap();
        assert!((by.rotation * turn * DVec3::Z).angle_between(DVec3::Z) < 0.05);
    }
}
