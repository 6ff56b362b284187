//! Position and angle error of poses against true ones, as they are and up to one similarity.

use glam::{DMat3, DQuat, DVec3};
use models::camera::Pose;

/// Root mean squares over frames: metres and degrees.
#[derive(Clone, Copy, Debug)]
#[allow(dead_code)] // each test binary prints all and asserts some
pub struct PoseErrors {
    pub position: f64,
    pub angle: f64,
    /// After the similarity that fits positions best.
    pub aligned_position: f64,
    /// See `aligned_position`.
    pub aligned_angle: f64,
    /// Scale of that similarity.
    pub scale: f64,
}

pub fn angle_deg(a: DQuat, b: DQuat) -> f64 {
    2.0 * (a.conjugate() * b).xyz().length().min(1.0).asin().to_degrees()
}

pub fn pose_errors(found: &[Pose], truth: &[Pose]) -> PoseErrors {
    let n = truth.len() as f64;
    let rms = |it: &mut dyn Iterator<Item = f64>| (it.map(|x| x * x).sum::<f64>() / n).sqrt();
    let mean = |p: &[Pose]| p.iter().map(|p| p.center).sum::<DVec3>() / n;
    let (from, to) = (mean(found), mean(truth));
    // Umeyama 1991.
    let (mut h, mut spread) = (nalgebra::Matrix3::<f64>::zeros(), 0.0);
    let v = |d: DVec3| nalgebra::Vector3::new(d.x, d.y, d.z);
    for (a, b) in found.iter().zip(truth) {
        h += v(b.center - to) * v(a.center - from).transpose();
        spread += (a.center - from).length_squared();
    }
    let svd = h.svd(true, true);
    let (u, vt) = (svd.u.unwrap(), svd.v_t.unwrap());
    let mut flip = nalgebra::Matrix3::identity();
    flip[(2, 2)] = (u.determinant() * vt.determinant()).signum();
    let rotation = DQuat::from_mat3(&DMat3::from_cols_slice((u * flip * vt).as_slice()));
    let scale = (nalgebra::Matrix3::from_diagonal(&svd.singular_values) * flip).trace() / spread;
    let apply = |p: DVec3| to + rotation * (p - from) * scale;
    let both = || found.iter().zip(truth);
    PoseErrors {
        position: rms(&mut both().map(|(a, b)| (a.center - b.center).length())),
        angle: rms(&mut both().map(|(a, b)| angle_deg(a.rotation, b.rotation))),
        aligned_position: rms(&mut both().map(|(a, b)| (apply(a.center) - b.center).length())),
        aligned_angle: rms(&mut both().map(|(a, b)| angle_deg(rotation * a.rotation, b.rotation))),
        scale,
    }
}
