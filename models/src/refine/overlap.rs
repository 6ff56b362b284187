//! Which pictures see the same ground, and where a pixel of one should lie in the other: both predicted from
//! poses and a ground height, before any descriptor is compared.

use crate::camera::{Intrinsics, Pinhole, Pose};
use glam::{DVec2, DVec3};

/// Ground points sampled per side of a picture.
const GRID: u32 = 5;
/// Rays that meet the ground further away than this many heights (or not at all) are cut there.
const FAR: f64 = 6.0;
/// Metres above ground assumed while nothing better is known (a typical mapping height).
const UNKNOWN_HEIGHT: f64 = 50.0;

/// Horizontal plane that stands for the scene.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Ground(pub Option<f64>);

impl Ground {
    /// Height of `pose` above the ground, metres; a camera at or below it is taken as flying at a typical
    /// height, since then one of the two heights is wrong.
    pub fn height(&self, pose: &Pose) -> f64 {
        let above = pose.center.z - self.0.unwrap_or(0.0);
        if above > 2.0 { above } else { UNKNOWN_HEIGHT }
    }

    /// World point at which the pixel's ray meets the ground.
    pub fn meet(&self, camera: &Pinhole, pixel: [f32; 2]) -> DVec3 {
        let ray = camera.world_ray(pixel);
        let height = self.height(&camera.pose);
        let along =
            if ray.z < 0.0 { (height / -ray.z).min(FAR * height / ray.length()) } else { FAR * height / ray.length() };
        camera.pose.center + ray * along
    }
}

/// Share of the two footprints that both see, 0..1 (the smaller of the two shares).
pub(crate) fn overlap(a: (&Pinhole, &Intrinsics), b: (&Pinhole, &Intrinsics), ground: Ground) -> f64 {
    let seen = |from: (&Pinhole, &Intrinsics), to: (&Pinhole, &Intrinsics)| {
        let mut inside = 0u32;
        for y in 0..GRID {
            for x in 0..GRID {
                let px = (x as f32 + 0.5) / GRID as f32 * from.1.width as f32;
                let py = (y as f32 + 0.5) / GRID as f32 * from.1.height as f32;
                let world = ground.meet(from.0, [px, py]);
                inside += u32::from(to.0.project(world).is_some_and(|q| to.1.contains(q)));
            }
        }
        f64::from(inside) / f64::from(GRID * GRID)
    };
    seen(a, b).min(seen(b, a))
}

/// Where the scene at `pixel` of `from` should appear in `to`.
pub(crate) fn predict(from: &Pinhole, to: &Pinhole, ground: Ground, pixel: [f32; 2]) -> Option<DVec2> {
    to.project(ground.meet(from, pixel))
}

/// How far a prediction may be off, pixels: three sigma of both poses, and relief of ±20 % of the height times
/// the parallax of the baseline.
pub(crate) fn search_radius(a: &Pinhole, b: &Pinhole, rotation_sigma: f64, position_sigma: f64, ground: Ground) -> f64 {
    let f = a.f.max_element().max(b.f.max_element());
    let height = ground.height(&b.pose).min(ground.height(&a.pose));
    let baseline = (a.pose.center - b.pose.center).length();
    let pose = 3.0 * (rotation_sigma * rotation_sigma + (position_sigma / height).powi(2)).sqrt();
    f * (pose + 0.2 * baseline / height) + 4.0
}

#[cfg(test)]
#[allow(clippy::unwrap_used)] // a test may
mod tests {
    use super::*;
    use glam::{DMat3, DQuat};

    fn nadir(center: DVec3) -> Pinhole {
        // x east, y south, z down.
        let r = DMat3::from_cols(DVec3::X, -DVec3::Y, -DVec3::Z);
        let pose = Pose { rotation: DQuat::from_mat3(&r), center };
        Pinhole::new(pose, &K, 1.0)
    }
    const K: Intrinsics = Intrinsics { width: 640, height: 480, fx: 400.0, fy: 400.0, cx: 320.0, cy: 240.0 };

    #[test]
    fn footprints_overlap_by_what_the_geometry_says() {
        // 640 px at f 400 and 50 m: 80 m wide; 40 m apart = half.
        let a = nadir(DVec3::new(0.0, 0.0, 50.0));
        let share = |x: f64| overlap((&a, &K), (&nadir(DVec3::new(x, 0.0, 50.0)), &K), Ground(Some(0.0)));
        assert_eq!(share(0.0), 1.0);
        assert!((share(40.0) - 0.5).abs() <= 0.11);
        assert_eq!(share(100.0), 0.0);
    }

    #[test]
    fn a_camera_that_claims_to_be_below_ground_still_gets_a_footprint() {
        let a = nadir(DVec3::new(0.0, 0.0, -5.7));
        let b = nadir(DVec3::new(10.0, 0.0, -5.7));
        assert!(overlap((&a, &K), (&b, &K), Ground(None)) > 0.5);
    }

    #[test]
    fn prediction_is_exact_on_the_plane() {
        let (a, b) = (nadir(DVec3::new(0.0, 0.0, 50.0)), nadir(DVec3::new(10.0, 0.0, 50.0)));
        let p = predict(&b, &a, Ground(Some(0.0)), [320.0, 240.0]).unwrap();
        assert!((p - DVec2::new(400.0, 240.0)).length() < 1e-9);
    }
}
