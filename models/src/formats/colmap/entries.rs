//! What a model is made of, whichever way it is written.

use glam::{DQuat, DVec3};

use crate::camera::Pose;

/// A registered image.
#[derive(Clone, Debug)]
pub struct ColmapImage {
    /// COLMAP's own number.
    pub id: u32,
    /// Path below the image folder.
    pub name: String,
    /// Number of its camera.
    pub camera_id: u32,
    /// Camera (OpenCV axes) → world.
    pub pose: Pose,
}

/// A triangulated point.
#[derive(Clone, Debug)]
pub struct ColmapPoint {
    /// World position.
    pub position: DVec3,
    /// Mean colour of its keypoints.
    pub color: [u8; 3],
    /// Mean reprojection error, pixels.
    pub error: f64,
    /// Numbers of the images that saw it, sorted, each once; may be empty when the writer left tracks out.
    pub images: Vec<u32>,
}

/// COLMAP's rotation and translation, world → camera, as a pose.
pub(super) fn pose(q: [f64; 4], t: DVec3) -> Option<Pose> {
    let [w, x, y, z] = q;
    let q = DQuat::from_xyzw(x, y, z, w);
    if !t.is_finite() || !(1e-6..1e6).contains(&q.length()) {
        return None;
    }
    let rotation = q.normalize().conjugate();
    // A sum of three products of the largest numbers is none.
    let center = -(rotation * t);
    center.is_finite().then_some(Pose { rotation, center })
}
