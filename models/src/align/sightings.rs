//! A similarity between two models from what both show in the same pictures.
//!
//! Points lifted from renderings are known to a fraction of a pixel across the line of sight and to a pixel's parallax along it:
//! where few pictures saw the ground, depths of two models differ by metres per hundred, and a fit in space takes that for a tilt.
//! So only what a picture shows is compared, the distance *across* the line of sight; what lies along it is determined by
//! perspective and by views from several places.

use glam::{DMat3, DQuat, DVec2, DVec3};
use nalgebra::{SMatrix, SVector};

use super::similarity::Similarity;
use crate::camera::Pose;

/// A detail that two models have, seen from one place.
#[derive(Clone, Copy, Debug)]
pub struct Sighting {
    /// Where both were drawn from, in the frame of `to`.
    pub from: Pose,
    /// Where the one has it, metres in its frame.
    pub moving: DVec3,
    /// Where the other has it.
    pub fixed: DVec3,
}

impl Sighting {
    /// By how much they differ across the line of sight, metres at the depth of the fixed one; None where the moving one is behind
    /// the camera.
    pub fn across(&self, motion: &Similarity) -> Option<DVec2> {
        let into = self.from.rotation.conjugate();
        let (p, q) = (into * (motion.apply(self.moving) - self.from.center), into * (self.fixed - self.from.center));
        (p.z > 0.0 && q.z > 0.0).then(|| (p.truncate() / p.z - q.truncate() / q.z) * q.z)
    }

    /// [`Sighting::across`] and its derivatives by turn and logarithm of the scale about `pivot`, and by shift.
    fn linear(&self, motion: &Similarity, pivot: DVec3) -> Option<(DVec2, [DVec2; 7])> {
        let at = self.across(motion)?;
        let into = DMat3::from_quat(self.from.rotation.conjugate());
        let moved = motion.apply(self.moving);
        let (p, depth) = (into * (moved - self.from.center), (into * (self.fixed - self.from.center)).z);
        let by = |d: DVec3| {
            let d = into * d;
            (d.truncate() - p.truncate() * (d.z / p.z)) * (depth / p.z)
        };
        let lever = moved - pivot;
        let turn = |axis: DVec3| by(axis.cross(lever));
        let rows =
            [turn(DVec3::X), turn(DVec3::Y), turn(DVec3::Z), by(lever), by(DVec3::X), by(DVec3::Y), by(DVec3::Z)];
        Some((at, rows))
    }
}

/// What is known beforehand of a motion, one standard deviation each: that it turns by little and keeps sizes.
#[derive(Clone, Copy, Debug)]
pub struct Prior {
    /// Radians.
    pub turn: f64,
    /// Natural logarithm of the scale.
    pub log_scale: f64,
}

/// One Gauss-Newton step from `motion` towards the least squares of all sightings, each of which is good to `sigma_m`; `motion`
/// itself where they determine nothing.
pub fn step(motion: &Similarity, sightings: &[Sighting], sigma_m: f64, prior: &Prior) -> Similarity {
    let count = sightings.len().max(1) as f64;
    let pivot = sightings.iter().map(|s| motion.apply(s.moving)).sum::<DVec3>() / count;
    let (mut normal, mut right) = (SMatrix::<f64, 7, 7>::zeros(), SVector::<f64, 7>::zeros());
    for (at, rows) in sightings.iter().filter_map(|s| s.linear(motion, pivot)) {
        let [u, v] = [0, 1].map(|axis| SVector::<f64, 7>::from(rows.map(|r| r[axis])));
        normal += (u * u.transpose() + v * v.transpose()) / sigma_m.powi(2);
        right -= (u * at.x + v * at.y) / sigma_m.powi(2);
    }
    let turned = motion.rotation.to_scaled_axis();
    for axis in 0..3 {
        normal[(axis, axis)] += prior.turn.powi(-2);
        right[axis] -= turned[axis] * prior.turn.powi(-2);
    }
    normal[(3, 3)] += prior.log_scale.powi(-2);
    right[3] -= motion.scale.ln() * prior.log_scale.powi(-2);
    let Some(by) = normal.cholesky().map(|c| c.solve(&right)).filter(|by| by.iter().all(|v| v.is_finite())) else {
        return *motion;
    };
    let (rotation, scale) = (DQuat::from_scaled_axis(DVec3::new(by[0], by[1], by[2])), by[3].exp());
    let shift = DVec3::new(by[4], by[5], by[6]);
    let about = Similarity { scale, rotation, translation: pivot + shift - scale * (rotation * pivot) };
    motion.then(&about)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::align::similarity::umeyama;

    const PRIOR: Prior = Prior { turn: 0.02, log_scale: 0.01 };

    fn inverse(of: &Similarity) -> Similarity {
        let (scale, rotation) = (1.0 / of.scale, of.rotation.conjugate());
        Similarity { scale, rotation, translation: rotation * -of.translation * scale }
    }

    /// Cameras 40 m above a strip of ground of 60 × 16 m, and details in it; `along` is by how much the two models differ
    /// along the line of sight, metres.
    fn sightings(truth: &Similarity, along: f64) -> Vec<Sighting> {
        let down = DQuat::from_rotation_x(std::f64::consts::PI);
        let mut all = Vec::new();
        for (i, x) in [0.0, 20.0, 40.0, 60.0].into_iter().enumerate() {
            let from =
                Pose { rotation: down * DQuat::from_rotation_y(0.05 * i as f64), center: DVec3::new(x, 3.0, 40.0) };
            for j in 0..60 {
                let t = f64::from(j) + 100.0 * i as f64;
                let fixed = DVec3::new(x - 15.0 + (t * 7.3) % 30.0, (t * 3.1) % 16.0 - 8.0, (t * 1.7) % 5.0);
                let there = inverse(truth).apply(fixed);
                // Farther to one side: what a rim that few pictures saw does.
                let off = along * (fixed.y / 8.0 + ((t * 0.37) % 1.0 - 0.5));
                let moving = there + (there - inverse(truth).apply(from.center)).normalize() * off;
                all.push(Sighting { from, moving, fixed });
            }
        }
        all
    }

    fn truth() -> Similarity {
        let rotation = DQuat::from_scaled_axis(DVec3::new(0.004, -0.003, 0.006));
        Similarity { scale: 1.002, rotation, translation: DVec3::new(0.3, -0.2, 0.15) }
    }

    fn settled(sightings: &[Sighting], sigma_m: f64, prior: &Prior) -> Similarity {
        (0..6).fold(Similarity::IDENTITY, |motion, _| step(&motion, sightings, sigma_m, prior))
    }

    fn off(a: &Similarity, b: &Similarity) -> f64 {
        let places = [[-10.0, -8.0], [70.0, -8.0], [70.0, 8.0], [-10.0, 8.0]].map(|[x, y]| DVec3::new(x, y, 2.0));
        places.into_iter().map(|p| a.apply(p).distance(b.apply(p))).fold(0.0, f64::max)
    }

    #[test]
    fn what_is_off_along_the_line_of_sight_does_not_tilt_the_model() {
        let seen = sightings(&truth(), 0.8);
        let (moving, fixed): (Vec<DVec3>, Vec<DVec3>) = seen.iter().map(|s| (s.moving, s.fixed)).unzip();
        let in_space = umeyama(&moving, &fixed, None).unwrap();
        let across = settled(&seen, 0.01, &Prior { turn: 1.0, log_scale: 1.0 });
        assert!(off(&in_space, &truth()) > 0.5, "{}", off(&in_space, &truth()));
        assert!(off(&across, &truth()) < 0.02, "{}", off(&across, &truth()));
    }

    #[test]
    fn exact_sightings_give_the_exact_motion() {
        let across = settled(&sightings(&truth(), 0.0), 1e-4, &PRIOR);
        assert!(off(&across, &truth()) < 1e-4, "{}", off(&across, &truth()));
    }

    #[test]
    fn derivatives_are_those_of_finite_differences() {
        let (seen, motion) = (sightings(&truth(), 0.5), Similarity { scale: 0.99, ..truth() });
        let pivot = DVec3::new(20.0, 1.0, 2.0);
        for s in seen.iter().step_by(37) {
            let (at, rows) = s.linear(&motion, pivot).unwrap();
            for (k, row) in rows.iter().enumerate() {
                let small = 1e-6;
                let unit = |of: usize| if k == of { small } else { 0.0 };
                let rotation = DQuat::from_scaled_axis(DVec3::new(unit(0), unit(1), unit(2)));
                let (scale, shift) = (unit(3).exp(), DVec3::new(unit(4), unit(5), unit(6)));
                let about = Similarity { scale, rotation, translation: pivot + shift - scale * (rotation * pivot) };
                let moved = (s.across(&motion.then(&about)).unwrap() - at) / small;
                assert!(moved.distance(*row) < 1e-4 * (1.0 + row.length()), "{k}: {moved} {row}");
            }
        }
    }

    #[test]
    fn without_sightings_a_motion_stays_and_points_behind_the_camera_count_for_nothing() {
        assert_eq!(step(&truth(), &[], 1.0, &PRIOR), truth());
        let mut seen = sightings(&truth(), 0.0);
        let exact = settled(&seen, 1e-4, &PRIOR);
        let behind = Sighting { moving: DVec3::new(0.0, 0.0, 400.0), ..seen[0] };
        assert_eq!(behind.across(&truth()), None);
        seen.push(behind);
        assert!(off(&settled(&seen, 1e-4, &PRIOR), &exact) < 1e-3);
    }
}
