//! How well an aircraft saw a piece of ground: by how many pictures, from how near and how steeply.

use glam::DVec2;
use models::camera::{Pinhole, View};
use serde::{Deserialize, Serialize};

/// Ground that fewer pictures saw than this has no depth of its own.
const FEWEST: usize = 2;

/// Where an aircraft's pictures were taken.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Visibility {
    views: Vec<View>,
    /// Height of its ground, metres.
    ground: f64,
}

impl Visibility {
    /// Of these pictures, over ground of this height.
    pub fn new(views: impl Iterator<Item = View>, ground: f64) -> Self {
        Self { views: views.collect(), ground }
    }

    /// Metres to the nearest camera, on the map; infinite without one.
    pub fn to_camera(&self, p: DVec2) -> f64 {
        self.views.iter().map(|v| v.pose.center.truncate().distance(p)).fold(f64::INFINITY, f64::min)
    }

    /// Pixels that all pictures together spent on a square metre of level ground at `p`; 0 where fewer than two saw it.
    pub fn pixels_per_m2(&self, p: DVec2) -> f64 {
        let p = p.extend(self.ground);
        let of_view = |view: &View| {
            let (camera, k) = (Pinhole::from(view), &view.intrinsics);
            let (at, depth, above) = (camera.project(p)?, camera.local(p).z, camera.pose.center.z - self.ground);
            let inside = at.cmpge(DVec2::ZERO).all() && at.cmplt(DVec2::new(k.width.into(), k.height.into())).all();
            // Jacobian of the projection restricted to the plane.
            (inside && above > 0.0).then(|| camera.f.x * camera.f.y * above / depth.powi(3))
        };
        let (count, sum) = self.views.iter().filter_map(of_view).fold((0, 0.0), |(n, sum), v| (n + 1, sum + v));
        if count < FEWEST { 0.0 } else { sum }
    }
}

#[cfg(test)]
mod tests {
    use glam::DVec3;

    use super::*;
    use crate::testing::nadir;

    #[test]
    fn ground_below_counts_as_much_as_its_pixels_and_ground_that_one_picture_saw_not_at_all() {
        let views = [nadir(0.0, 0.0, 20.0), nadir(4.0, 0.0, 20.0)];
        let visibility = Visibility::new(views.into_iter(), 0.0);
        // 50 pixels of focal length at 20 m: 6.25 to the square metre and picture.
        assert!((visibility.pixels_per_m2(DVec2::new(2.0, 1.0)) - 12.5).abs() < 1e-9);
        assert_eq!(visibility.pixels_per_m2(DVec2::new(-10.0, 0.0)), 0.0, "only the first saw it");
        assert_eq!(visibility.pixels_per_m2(DVec2::new(500.0, 0.0)), 0.0);
        assert_eq!(visibility.to_camera(DVec2::new(7.0, 4.0)), 5.0);
    }

    #[test]
    fn pixels_per_square_metre_are_those_of_a_small_square_drawn_by_an_oblique_camera() {
        let mut view = nadir(0.0, 0.0, 20.0);
        view.pose.rotation *= glam::DQuat::from_rotation_x(0.3);
        let project = |p: DVec3| {
            let c = view.pose.rotation.conjugate() * (p - view.pose.center);
            DVec2::new(50.0 * c.x / c.z, 50.0 * c.y / c.z)
        };
        let (at, small) = (DVec3::new(1.0, 2.0, 0.0), 1e-4);
        let (u, v) = (project(at + DVec3::X * small) - project(at), project(at + DVec3::Y * small) - project(at));
        let drawn = u.perp_dot(v).abs() / (small * small);
        let got = Visibility::new([view, view].into_iter(), 0.0).pixels_per_m2(at.truncate()) / 2.0;
        assert!((got - drawn).abs() < 1e-3 * drawn, "{got} {drawn}");
    }

    #[test]
    fn a_camera_below_the_ground_or_broken_sees_nothing() {
        let mut broken = nadir(0.0, 0.0, 20.0);
        broken.pose.center.x = f64::NAN;
        let visibility =
            Visibility::new([nadir(0.0, 0.0, -20.0), nadir(0.0, 0.0, -20.0), broken, broken].into_iter(), 0.0);
        assert_eq!(visibility.pixels_per_m2(DVec2::ZERO), 0.0);
    }
}
