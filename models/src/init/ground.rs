//! The ground as a plane through the sparse points of the whole flight: what bounds the depths of a picture that few
//! points happen to lie in. Only from above and only where a plane describes the scene; elsewhere it has no opinion.

use geometry::median;
use glam::{DVec3, Vec3};
use nalgebra::{Matrix3, Vector3};

use crate::camera::{Pinhole, View};

/// Points needed before a plane is believed.
const MIN_POINTS: usize = 60;
/// Rounds of reweighting; trees, roofs and wrong matches are outliers of the ground.
const ROUNDS: usize = 10;
/// Steeper planes are no ground (rise over run).
const STEEPEST: f64 = 0.5;
/// Rays that come down less than this per unit along the optical axis meet the ground too far away to say where.
const GRAZING: f64 = 0.25;
/// Points further from the plane than this share of the camera's height above it are wrong matches.
const HIGHEST: f64 = 0.35;
/// The bounds hold this share of the points on either side.
const QUANTILE: f64 = 0.03;

/// z = plane(x, y) and how the points spread about it.
#[derive(Clone, Debug)]
pub struct Ground {
    /// Height at `middle`, slopes along x and y.
    plane: [f64; 3],
    middle: DVec3,
    /// Heights of the points above the plane, growing.
    above: Vec<f32>,
}

impl Ground {
    /// Robust plane through world points (z up); `None` when they are too few or lie in no plane over x and y.
    pub fn fit(points: &[Vec3]) -> Option<Self> {
        if points.len() < MIN_POINTS {
            return None;
        }
        let middle = points.iter().map(|p| p.as_dvec3()).sum::<DVec3>() / points.len() as f64;
        let mut plane = Vector3::new(0.0, 0.0, 0.0);
        // The first scale is the spread of the heights themselves: the median deviation from their median.
        let mut heights: Vec<f64> = points.iter().map(|p| f64::from(p.z) - middle.z).collect();
        plane[0] = median(&mut heights)?;
        for _ in 0..ROUNDS {
            let residual = |p: &Vec3| {
                let d = p.as_dvec3() - middle;
                (Vector3::new(1.0, d.x, d.y), d.z - plane.dot(&Vector3::new(1.0, d.x, d.y)))
            };
            let mut sizes: Vec<f64> = points.iter().map(|p| residual(p).1.abs()).collect();
            let scale = median(&mut sizes)?.max(1e-3);
            let (mut a, mut b) = (Matrix3::zeros(), Vector3::zeros());
            for p in points {
                let (x, r) = residual(p);
                // Cauchy's weights squared: far outliers stop pulling altogether.
                let weight = (1.0 + (r / (2.0 * scale)).powi(2)).powi(-2);
                a += x * x.transpose() * weight;
                b += x * (r * weight);
            }
            plane += a.cholesky()?.solve(&b);
        }
        if !plane.iter().all(|v| v.is_finite()) || plane[1].hypot(plane[2]) > STEEPEST {
            return None;
        }
        let mut ground = Self { plane: [plane[0] + middle.z, plane[1], plane[2]], middle, above: Vec::new() };
        ground.above = points.iter().map(|p| ground.over(p.as_dvec3()) as f32).collect();
        ground.above.sort_by(f32::total_cmp);
        Some(ground)
    }

    fn over(&self, p: DVec3) -> f64 {
        p.z - self.plane[0] - self.plane[1] * (p.x - self.middle.x) - self.plane[2] * (p.y - self.middle.y)
    }

    /// Nearest and farthest depth along the optical axis at which a view's picture meets what stands on the ground;
    /// `None` when part of the picture looks past it.
    pub fn depths(&self, view: &View) -> Option<[f32; 2]> {
        let height = self.over(view.pose.center);
        let limit = (HIGHEST * height) as f32;
        let heights = &self.above[self.above.partition_point(|h| *h < -limit)..];
        let heights = &heights[..heights.partition_point(|h| *h < limit)];
        if height <= 0.0 || 2 * heights.len() < self.above.len() {
            return None;
        }
        let at = |share: f64| f64::from(heights[((heights.len() - 1) as f64 * share) as usize]);
        let (low, high) = (at(QUANTILE), at(1.0 - QUANTILE));
        let k = &view.intrinsics;
        let (mut near, mut far) = (f64::INFINITY, 0.0f64);
        for (u, v) in [(0.0, 0.0), (1.0, 0.0), (0.0, 1.0), (1.0, 1.0)] {
            let ray = Pinhole::from(view).world_ray([u * k.width as f32, v * k.height as f32]);
            let fall = self.plane[1] * ray.x + self.plane[2] * ray.y - ray.z;
            if fall.is_nan() || fall < GRAZING {
                return None;
            }
            near = near.min((height - high) / fall);
            far = far.max((height - low) / fall);
        }
        (near > 0.0).then_some([near as f32, far as f32])
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::camera::{Intrinsics, Pose};
    use glam::DQuat;

    fn view(tilt: f64) -> View {
        let intrinsics = Intrinsics { width: 640, height: 480, fx: 400.0, fy: 400.0, cx: 320.0, cy: 240.0 };
        let rotation = DQuat::from_rotation_x(std::f64::consts::PI - tilt);
        View { intrinsics, pose: Pose { rotation, center: DVec3::new(0.0, 0.0, 60.0) } }
    }

    /// Rolling ground with trees, a tenth of wrong matches.
    fn points() -> Vec<Vec3> {
        (0..600u32)
            .map(|i| {
                let (x, y) = ((i % 30) as f32 * 4.0 - 60.0, (i / 30) as f32 * 4.0 - 40.0);
                let z = match i % 10 {
                    0 if i % 20 == 0 => -95.0,
                    0 => 40.0,
                    1 => 9.0,
                    _ => 0.05 * x + (x / 9.0).sin(),
                };
                Vec3::new(x, y, z)
            })
            .collect()
    }

    #[test]
    fn the_ground_bounds_the_depths_however_many_matches_are_wrong() {
        let ground = Ground::fit(&points()).unwrap();
        let [near, far] = ground.depths(&view(0.0)).unwrap();
        assert!((45.0..54.0).contains(&near) && (61.0..68.0).contains(&far), "{near} {far}");
        // Tilted by 20°: the upper edge of the picture is farther away.
        let [near, far] = ground.depths(&view(0.35)).unwrap();
        assert!((38.0..50.0).contains(&near) && (78.0..95.0).contains(&far), "{near} {far}");
    }

    #[test]
    fn where_there_is_no_ground_there_is_no_opinion() {
        let ground = Ground::fit(&points()).unwrap();
        assert!(ground.depths(&view(1.2)).is_none(), "the horizon is in the picture");
        let mut below = view(0.0);
        below.pose.center.z = -10.0;
        assert!(ground.depths(&below).is_none());
        assert!(Ground::fit(&points()[..20]).is_none());
        let facade: Vec<Vec3> = points().iter().map(|p| Vec3::new(p.x, p.z, p.y)).collect();
        assert!(Ground::fit(&facade).is_none_or(|g| g.depths(&view(0.0)).is_none_or(|[n, f]| f / n > 1.5)));
    }
}
