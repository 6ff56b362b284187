//! What of a scene may be seen in a picture.

use glam::DVec3;
use models::camera::View;
use models::cloud::GaussianCloud;

/// Standard deviations beyond which a Gaussian is below a grey level; 1/255 of an opaque one is at 3.33.
const REACH_SIGMA: f64 = 3.4;
/// Beyond the edges of a part, pixels: what the renderer adds to a Gaussian's extent, doubled.
const MARGIN_PX: f64 = 4.0;

/// Where a Gaussian is.
pub fn mean(cloud: &GaussianCloud, i: usize) -> DVec3 {
    DVec3::from_array(cloud.means[i].map(f64::from))
}

/// How far a Gaussian is seen from its mean.
pub fn reach(cloud: &GaussianCloud, i: usize) -> f64 {
    REACH_SIGMA * cloud.log_scales[i].iter().copied().fold(f32::NEG_INFINITY, f32::max).exp() as f64
}

/// The rays of a picture: four planes through the camera, their normals pointing inwards.
pub struct Frustum {
    center: DVec3,
    forward: DVec3,
    sides: [DVec3; 4],
}

impl Frustum {
    /// Of a camera.
    pub fn of(view: &View) -> Self {
        let k = &view.intrinsics;
        let [fx, fy, cx, cy] = [k.fx, k.fy, k.cx, k.cy].map(f64::from);
        let (right, below) = (f64::from(k.width) - cx + MARGIN_PX, f64::from(k.height) - cy + MARGIN_PX);
        let sides = [
            DVec3::new(fx, 0.0, cx + MARGIN_PX),
            DVec3::new(-fx, 0.0, right),
            DVec3::new(0.0, fy, cy + MARGIN_PX),
            DVec3::new(0.0, -fy, below),
        ];
        let turn = view.pose.rotation;
        Self { center: view.pose.center, forward: turn * DVec3::Z, sides: sides.map(|n| turn * n.normalize()) }
    }

    /// Whether anything in a sphere may be seen.
    pub fn meets(&self, middle: DVec3, radius: f64) -> bool {
        let p = middle - self.center;
        p.dot(self.forward) > -radius && self.sides.iter().all(|n| p.dot(*n) > -radius)
    }
}
