//! Pose of one frame from points whose place is known: for frames whose telemetry position is far off.

use super::problem::Loss;
use super::so3;
use super::triangulate::pixel_by_local;
use crate::camera::{Pinhole, Pose};
use glam::{DVec2, DVec3};
use nalgebra::{SMatrix, SVector};

/// Gauss–Newton on the reprojection error with a convex robust loss. `None` when fewer than half of the points
/// end up within `inlier_px`: then telemetry is the better guess.
pub(crate) fn resect(start: Pinhole, seen: &[(DVec3, [f32; 2])], inlier_px: f64) -> Option<Pose> {
    let mut camera = start;
    for _ in 0..20 {
        let mut h = SMatrix::<f64, 6, 6>::zeros();
        let mut g = SVector::<f64, 6>::zeros();
        for (world, pixel) in seen {
            let p = camera.local(*world);
            if p.z <= 1e-6 {
                continue;
            }
            let r = camera.pixel(p) - DVec2::new(pixel[0].into(), pixel[1].into());
            let w = Loss::Huber(inlier_px).at(r.length_squared()).1;
            let (du, dv) = pixel_by_local(&camera, p);
            let turn = so3::skew(p).transpose();
            for (d, r) in [(du, r.x), (dv, r.y)] {
                let (t, x) = (turn * d, camera.pose.rotation * d);
                let j = SVector::<f64, 6>::new(t.x, t.y, t.z, -x.x, -x.y, -x.z);
                h += j * j.transpose() * w;
                g += j * (r * w);
            }
        }
        for k in 0..6 {
            h[(k, k)] *= 1.0 + 1e-6;
        }
        let d = -h.cholesky()?.solve(&g);
        camera.pose.rotation = (camera.pose.rotation * so3::exp(DVec3::new(d[0], d[1], d[2]))).normalize();
        camera.pose.center += DVec3::new(d[3], d[4], d[5]);
        if !camera.pose.center.is_finite() || !camera.pose.rotation.is_finite() {
            return None;
        }
        if d.norm() < 1e-7 {
            break;
        }
    }
    let good = seen
        .iter()
        .filter(|(world, pixel)| {
            let pixel = DVec2::new(pixel[0].into(), pixel[1].into());
            camera.project(*world).is_some_and(|q| (q - pixel).length() < inlier_px)
        })
        .count();
    (good * 2 >= seen.len()).then_some(camera.pose)
}

#[cfg(test)]
#[allow(clippy::unwrap_used)] // a test may
mod tests {
    use super::*;
    use crate::camera::Intrinsics;
    use glam::DQuat;

    fn points() -> Vec<DVec3> {
        (0..40)
            .map(|i| DVec3::new((i % 8) as f64 * 5.0 - 18.0, (i / 8) as f64 * 6.0 - 12.0, 40.0 + (i % 3) as f64))
            .collect()
    }
    const K: Intrinsics = Intrinsics { width: 640, height: 480, fx: 400.0, fy: 400.0, cx: 320.0, cy: 240.0 };

    #[test]
    fn a_position_off_by_30_metres_is_found_from_points() {
        let truth = Pose { rotation: DQuat::IDENTITY, center: DVec3::new(1.0, 2.0, 3.0) };
        let camera = Pinhole::new(truth, &K, 1.0);
        let mut seen: Vec<_> =
            points().iter().map(|p| (*p, camera.project(*p).unwrap().as_vec2().to_array())).collect();
        for s in seen.iter_mut().take(8) {
            s.1[0] += 90.0;
        }
        let start =
            Pose { rotation: so3::exp(DVec3::new(0.02, 0.0, 0.05)), center: truth.center - DVec3::new(4.0, 0.0, 30.0) };
        let found = resect(Pinhole::new(start, &K, 1.0), &seen, 12.0).unwrap();
        assert!((found.center - truth.center).length() < 0.7, "{found:?}");
    }

    #[test]
    fn points_that_agree_with_no_place_are_refused() {
        let camera = Pinhole::new(Pose { rotation: DQuat::IDENTITY, center: DVec3::ZERO }, &K, 1.0);
        let seen: Vec<_> =
            points().iter().enumerate().map(|(i, p)| (*p, [(i * 199 % 640) as f32, (i * 83 % 480) as f32])).collect();
        assert!(resect(camera, &seen, 12.0).is_none());
    }
}
