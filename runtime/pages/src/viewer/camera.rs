//! Cameras of the viewer: a place, what it looks at, and the angle across the longer edge, in its world (x east, y up, z south).
//! It keeps the horizon level, so that a picture's roll is lost.

use glam::DVec3;
use models::camera::View;
use models::cloud::GaussianCloud;
use serde::Serialize;

/// Angle of the first view: a normal lens.
pub(super) const OVERVIEW_FOV_DEG: f64 = 60.0;
/// Share of the Gaussians that the first view has in sight; those far away are sky and mistakes.
const IN_SIGHT: f64 = 0.8;
/// How steeply the first view looks down: distance to the south and height, in radii of what is in sight.
const OVERVIEW: [f64; 2] = [1.6, 1.3];
/// Looking straight down has no heading. Below this share of level the look is tipped by as much towards the picture's upper edge,
/// which then is where the viewer's screen has it.
const TIP: f64 = 1e-3;

/// Where a camera stands.
#[derive(Debug, Serialize)]
pub(super) struct Stand {
    pub position: [f64; 3],
    pub target: [f64; 3],
    pub fov: f64,
}

/// East, north, up → the viewer's world.
fn world(p: DVec3) -> [f64; 3] {
    [p.x, p.z, -p.y]
}

/// Place and target of the first view: from the south, north on top.
pub(super) fn overview(cloud: &GaussianCloud) -> [[f64; 3]; 2] {
    let middle = DVec3::from_array(cloud.middle().map(f64::from));
    let away = |m: &[f32; 3]| (DVec3::from_array(m.map(f64::from)) - middle).length();
    let mut far: Vec<f64> = cloud.means.iter().map(away).collect();
    let at = ((far.len() as f64 * IN_SIGHT) as usize).min(far.len().saturating_sub(1));
    let radius = if far.is_empty() { 1.0 } else { far.select_nth_unstable_by(at, f64::total_cmp).1.max(0.1) };
    [world(middle + radius * DVec3::new(0.0, -OVERVIEW[0], OVERVIEW[1])), world(middle)]
}

/// Where a picture was taken; it is turned around a point as far away as the scene is in its direction.
pub(super) fn stand(view: &View, cloud: &GaussianCloud) -> Stand {
    let mut forward = view.pose.forward();
    if forward.truncate().length() < TIP {
        forward = (forward - TIP * (view.pose.rotation * DVec3::Y)).normalize();
    }
    let middle = DVec3::from_array(cloud.middle().map(f64::from));
    let distance = (middle - view.pose.center).dot(forward).max(1.0);
    let k = &view.intrinsics;
    let (edge, focal) = if k.width >= k.height { (k.width, k.fx) } else { (k.height, k.fy) };
    Stand {
        position: world(view.pose.center),
        target: world(view.pose.center + distance * forward),
        fov: (2.0 * (0.5 * f64::from(edge) / f64::from(focal)).atan()).to_degrees(),
    }
}

#[cfg(test)]
mod tests {
    use glam::{DMat3, DQuat};
    use models::camera::{Intrinsics, Pose};

    use super::*;

    fn cloud() -> GaussianCloud {
        let mut cloud = GaussianCloud::with_capacity(0, 9);
        for i in 0..9 {
            let (e, n) = ((i % 3) as f32 * 10.0, (i / 3) as f32 * 10.0);
            cloud.push([e, n, 2.0], [-1.0; 3], [1.0, 0.0, 0.0, 0.0], 1.0, &[0.0; 3]);
        }
        cloud
    }

    #[test]
    fn a_camera_straight_down_keeps_its_heading() {
        // Upper edge to the east: x (right) south, y (down the picture) west, z down.
        let axes = DMat3::from_cols(DVec3::NEG_Y, DVec3::NEG_X, DVec3::NEG_Z);
        let intrinsics = Intrinsics { width: 200, height: 100, fx: 100.0, fy: 100.0, cx: 100.0, cy: 50.0 };
        let pose = Pose { rotation: DQuat::from_mat3(&axes), center: DVec3::new(10.0, 10.0, 52.0) };
        let stand = stand(&View { intrinsics, pose }, &cloud());
        let look = DVec3::from_array(stand.target) - DVec3::from_array(stand.position);
        assert!((look.length() - 50.0).abs() < 0.1 && look.y < -49.0, "down: {look}");
        assert!(look.x > 0.01 && look.z.abs() < 1e-6, "to the east: {look}");
        assert!((stand.fov - 90.0).abs() < 1e-4, "across the longer edge: {}", stand.fov);
    }

    #[test]
    fn the_first_view_looks_north_and_down_on_the_middle() {
        let [position, target] = overview(&cloud());
        assert_eq!(target, [10.0, 2.0, -10.0]);
        let look = DVec3::from_array(target) - DVec3::from_array(position);
        assert!(look.x.abs() < 1e-9 && look.y < 0.0 && look.z < 0.0, "{look}");
    }
}
