//! The point where the rays of one track come closest, with the checks that keep nonsense out.

use crate::camera::Pinhole;
use glam::{DMat3, DVec2, DVec3};

/// A triangulated point.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Triangulated {
    pub world: DVec3,
    /// Largest angle between two of its rays, radians.
    pub angle: f64,
    /// Root mean square reprojection error, pixels.
    pub rms_px: f64,
}

/// Rays compared for the largest angle; beyond that many sightings, the first and last are representative.
const MAX_RAYS: usize = 12;

/// Least-squares meeting point of the rays, then two Gauss–Newton steps on the reprojection error. `None` when
/// the rays are parallel to below `min_angle` (radians), or the point lies behind a camera or is not finite.
pub(crate) fn triangulate(views: &[(Pinhole, [f32; 2])], min_angle: f64) -> Option<Triangulated> {
    if views.len() < 2 {
        return None;
    }
    let (mut a, mut b) = (DMat3::ZERO, DVec3::ZERO);
    let mut rays = [DVec3::ZERO; MAX_RAYS];
    let mut count = 0;
    for (i, (camera, pixel)) in views.iter().enumerate() {
        let d = camera.world_ray(*pixel).normalize();
        if count < MAX_RAYS - 1 || (i + 1 == views.len() && count < MAX_RAYS) {
            rays[count] = d;
            count += 1;
        }
        let off = DMat3::IDENTITY - DMat3::from_cols(d * d.x, d * d.y, d * d.z);
        a += off;
        b += off * camera.pose.center;
    }
    let mut cosine = 1.0f64;
    for i in 0..count {
        for j in 0..i {
            cosine = cosine.min(rays[i].dot(rays[j]));
        }
    }
    let angle = cosine.clamp(-1.0, 1.0).acos();
    if angle.is_nan() || angle < min_angle {
        return None;
    }
    let mut world = a.inverse() * b;
    for _ in 0..2 {
        let (mut h, mut g) = (DMat3::ZERO, DVec3::ZERO);
        for (camera, pixel) in views {
            let p = camera.local(world);
            if p.z.is_nan() || p.z <= 1e-6 {
                return None;
            }
            let r = camera.pixel(p) - DVec2::new(pixel[0].into(), pixel[1].into());
            let (jx, jy) = pixel_by_world(camera, p);
            h += DMat3::from_cols(jx * jx.x + jy * jy.x, jx * jx.y + jy * jy.y, jx * jx.z + jy * jy.z);
            g += jx * r.x + jy * r.y;
        }
        let d = h.inverse() * g;
        if d.is_finite() {
            world -= d;
        }
    }
    let mut sum = 0.0;
    for (camera, pixel) in views {
        let q = camera.project(world)?;
        sum += (q - DVec2::new(pixel[0].into(), pixel[1].into())).length_squared();
    }
    let rms_px = (sum / views.len() as f64).sqrt();
    rms_px.is_finite().then_some(Triangulated { world, angle, rms_px })
}

/// Rows of d(pixel)/d(world point), for the point at `p` in camera axes.
pub(crate) fn pixel_by_world(camera: &Pinhole, p: DVec3) -> (DVec3, DVec3) {
    let (x, y) = pixel_by_local(camera, p);
    (camera.pose.rotation * x, camera.pose.rotation * y)
}

/// Rows of d(pixel)/d(point in camera axes).
pub(crate) fn pixel_by_local(camera: &Pinhole, p: DVec3) -> (DVec3, DVec3) {
    let z = 1.0 / p.z;
    let x = DVec3::new(camera.f.x * z, 0.0, -camera.f.x * p.x * z * z);
    let y = DVec3::new(0.0, camera.f.y * z, -camera.f.y * p.y * z * z);
    (x, y)
}

#[cfg(test)]
#[allow(clippy::unwrap_used)] // a test may
mod tests {
    use super::*;
    use crate::camera::{Intrinsics, Pose};
    use glam::DQuat;

    fn at(x: f64) -> Pinhole {
        let k = Intrinsics { width: 640, height: 480, fx: 400.0, fy: 400.0, cx: 320.0, cy: 240.0 };
        Pinhole::new(Pose { rotation: DQuat::IDENTITY, center: DVec3::new(x, 0.0, 0.0) }, &k, 1.0)
    }

    fn views(point: DVec3, xs: &[f64]) -> Vec<(Pinhole, [f32; 2])> {
        xs.iter().map(|x| (at(*x), at(*x).project(point).unwrap().as_vec2().to_array())).collect()
    }

    #[test]
    fn exact_rays_meet_in_their_point() {
        let p = DVec3::new(3.0, -2.0, 40.0);
        let t = triangulate(&views(p, &[0.0, 5.0, 10.0]), 0.02).unwrap();
        assert!((t.world - p).length() < 1e-3 && t.rms_px < 1e-3);
        assert!((t.angle - 0.245).abs() < 0.01);
    }

    #[test]
    fn parallel_rays_single_views_and_points_behind_are_refused() {
        assert!(triangulate(&views(DVec3::new(0.0, 0.0, 40.0), &[0.0, 0.0]), 0.02).is_none());
        assert!(triangulate(&views(DVec3::new(0.0, 0.0, 40.0), &[0.0]), 0.02).is_none());
        // Rays that diverge meet behind the cameras.
        assert!(triangulate(&[(at(0.0), [300.0, 240.0]), (at(5.0), [340.0, 240.0])], 0.02).is_none());
        assert!(triangulate(&[(at(0.0), [f32::NAN, 240.0]), (at(5.0), [340.0, 240.0])], 0.02).is_none());
    }
}
