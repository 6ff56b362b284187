//! Ground and cameras of tests: flat Gaussians in a grid, and cameras that look straight down.

use glam::{DQuat, DVec3};
use models::camera::{Intrinsics, Pose, View};
use models::cloud::GaussianCloud;

/// A grid of flat round Gaussians on z = 0, coloured by place.
pub fn carpet(low: [f64; 2], high: [f64; 2], spacing: f64) -> GaussianCloud {
    let count = |k: usize| ((high[k] - low[k]) / spacing).round() as usize;
    let mut cloud = GaussianCloud::with_capacity(0, count(0) * count(1));
    let s = (0.5 * spacing as f32).ln();
    for v in 0..count(1) {
        for u in 0..count(0) {
            let at = |k: usize, i: usize| (low[k] + (i as f64 + 0.5) * spacing) as f32;
            let (x, y) = (at(0, u), at(1, v));
            let sh = [(0.5 * x).sin(), (0.4 * y).cos(), (0.2 * (x + y)).sin()];
            cloud.push([x, y, 0.0], [s, s, s - 3.0], [1.0, 0.0, 0.0, 0.0], 3.0, &sh);
        }
    }
    cloud
}

/// A 64 × 48 camera looking straight down.
pub fn nadir(x: f64, y: f64, height: f64) -> View {
    View {
        intrinsics: Intrinsics { width: 64, height: 48, fx: 50.0, fy: 50.0, cx: 32.0, cy: 24.0 },
        pose: Pose { rotation: DQuat::from_rotation_x(std::f64::consts::PI), center: DVec3::new(x, y, height) },
    }
}
