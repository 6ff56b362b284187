//! A scene without a place is laid level over the plane that most of its points lie near.

use glam::{DMat3, DQuat, DVec3};
use nalgebra::Matrix3;

use super::Refiner;
use super::linking::median;
use super::tracks::Tracks;

/// Height above the ground that the scene is given, metres: what is assumed of aircraft elsewhere, so that limits in metres fit.
pub(super) const HEIGHT: f64 = 50.0;
/// Points that tell a plane at least.
const PLANE_FROM: usize = 20;

impl Refiner {
    /// Lays the scene on the plane that most points lie near, pictures above it at [`HEIGHT`].
    pub(super) fn level(&mut self, tracks: &Tracks) {
        let cameras = self.cameras();
        let mut views = Vec::new();
        let mut points: Vec<DVec3> = Vec::new();
        for t in 0..tracks.len() as u32 {
            let mut seen = self.sightings(tracks, t);
            if seen.len() >= 2 {
                points.extend(
                    self.robust_point(&cameras, &mut seen, self.settings.outlier_px, &mut views).map(|p| p.world),
                );
            }
        }
        let centers: Vec<DVec3> = self.frames.iter().filter(|f| !f.unplaced).map(|f| f.pose.center).collect();
        let Some((foot, up)) = plane(&points, &centers) else { return };
        let turn = DQuat::from_rotation_arc(up, DVec3::Z);
        let height = median(&mut centers.iter().map(|c| (*c - foot).dot(up)).collect::<Vec<_>>());
        let scale = if height > 1e-9 { HEIGHT / height } else { 1.0 };
        for frame in self.frames.iter_mut() {
            frame.pose.rotation = (turn * frame.pose.rotation).normalize();
            frame.pose.center = turn * (frame.pose.center - foot) * scale;
        }
        self.ground = Some(0.0);
    }
}

/// A point of the plane that most of `points` lie near, and its normal on the side of `centers`; `None` of too few.
fn plane(points: &[DVec3], centers: &[DVec3]) -> Option<(DVec3, DVec3)> {
    let mut kept = points.to_vec();
    let mut found = None;
    for _ in 0..4 {
        if kept.len() < PLANE_FROM {
            break;
        }
        let middle = kept.iter().sum::<DVec3>() / kept.len() as f64;
        let mut spread = DMat3::ZERO;
        for p in &kept {
            let d = *p - middle;
            spread += DMat3::from_cols(d * d.x, d * d.y, d * d.z);
        }
        let eigen = Matrix3::from_column_slice(&spread.to_cols_array()).symmetric_eigen();
        let least = eigen.eigenvalues.imin();
        let column = eigen.eigenvectors.column(least);
        let normal = DVec3::new(column[0], column[1], column[2]).try_normalize()?;
        found = Some((middle, normal));
        // Trees and roofs are no ground, points at the horizon no measure.
        let off = |p: &DVec3| (*p - middle).dot(normal).abs();
        let usual = median(&mut kept.iter().map(off).collect::<Vec<_>>());
        kept.retain(|p| off(p) <= 3.0 * usual);
    }
    let (foot, normal) = found?;
    let above = centers.iter().filter(|c| (**c - foot).dot(normal) > 0.0).count();
    Some((foot, if above * 2 < centers.len() { -normal } else { normal }))
}

#[cfg(test)]
#[allow(clippy::unwrap_used)] // a test may
mod tests {
    use super::*;

    #[test]
    fn the_ground_is_found_below_the_cameras_whatever_grows_on_it() {
        let turn = DQuat::from_rotation_x(0.7) * DQuat::from_rotation_z(1.1);
        let mut points: Vec<DVec3> = (0..400).map(|i| DVec3::new(f64::from(i % 20), f64::from(i / 20), 0.0)).collect();
        points.extend((0..60).map(|i| DVec3::new(f64::from(i % 8), f64::from(i / 8), 2.0 + f64::from(i % 3))));
        let points: Vec<DVec3> = points.into_iter().map(|p| turn * p).collect();
        for side in [1.0, -1.0] {
            let centers: Vec<DVec3> = (0..5).map(|i| turn * DVec3::new(f64::from(i), 3.0, 30.0 * side)).collect();
            let (foot, up) = plane(&points, &centers).unwrap();
            assert!(up.distance(turn * DVec3::Z * side) < 0.01, "{up}");
            assert!((foot.dot(up)).abs() < 0.1);
        }
        assert!(plane(&points[..5], &[]).is_none());
    }
}
