//! Merged cells into the cloud's columns: eigenvectors become rotations, abnormal extents are removed.

use glam::{Mat3, Quat, Vec3};
use nalgebra::{Matrix3, SymmetricEigen};
use rayon::prelude::*;

use crate::cloud::{GaussianCloud, SH_C0};

use super::merge::Merged;

/// Opacities stay where the trainer's gradients live.
const OPACITY: [f32; 2] = [0.02, 0.98];
/// Thinnest Gaussian as a share of its longest axis; thinner ones are numerically planes.
const THINNEST: f32 = 0.02;

/// Standard deviations (descending) and the axes they belong to.
pub fn axes(covariance: Mat3) -> ([f32; 3], Quat) {
    let c = covariance.to_cols_array_2d();
    let m = Matrix3::from_fn(|i, j| 0.5 * (f64::from(c[i][j]) + f64::from(c[j][i])));
    let eigen = SymmetricEigen::new(m);
    let mut order = [0, 1, 2];
    order.sort_by(|&a, &b| eigen.eigenvalues[b].total_cmp(&eigen.eigenvalues[a]));
    let column = |k: usize| {
        let v = eigen.eigenvectors.column(order[k]);
        Vec3::new(v[0] as f32, v[1] as f32, v[2] as f32)
    };
    let (x, y) = (column(0), column(1));
    // Right-handed by construction: a reflection is no rotation.
    let rotation = Quat::from_mat3(&Mat3::from_cols(x, y, x.cross(y)));
    let deviation = order.map(|k| (eigen.eigenvalues[k].max(0.0) as f32).sqrt());
    let least = deviation[0] * THINNEST;
    (deviation.map(|d| d.max(least)), rotation)
}

/// The cloud, and how many Gaussians were removed as abnormal: longer than `max_ratio` medians, or not finite.
pub fn cloud(merged: &[Merged], max_ratio: f32) -> (GaussianCloud, usize) {
    let shapes: Vec<([f32; 3], Quat)> = merged.par_iter().map(|g| axes(g.covariance)).collect();
    let mut longest: Vec<f32> = shapes.iter().map(|s| s.0[0]).filter(|v| v.is_finite()).collect();
    if longest.is_empty() {
        return (GaussianCloud::default(), merged.len());
    }
    let middle = longest.len() / 2;
    let median = *longest.select_nth_unstable_by(middle, f32::total_cmp).1;
    let mut cloud = GaussianCloud::with_capacity(0, merged.len());
    for (g, (deviation, q)) in merged.iter().zip(&shapes) {
        // NaN compares false and is removed.
        if !(deviation[0] <= median * max_ratio && deviation[2] > 0.0) {
            continue;
        }
        let o = g.opacity.clamp(OPACITY[0], OPACITY[1]);
        let sh = (g.color - 0.5) / SH_C0;
        cloud.push(
            g.position.to_array(),
            deviation.map(f32::ln),
            [q.w, q.x, q.y, q.z],
            (o / (1.0 - o)).ln(),
            &sh.to_array(),
        );
    }
    cloud.drop_invalid();
    let removed = merged.len() - cloud.len();
    (cloud, removed)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn merged(covariance: Mat3) -> Merged {
        Merged { position: Vec3::ZERO, color: Vec3::ONE, covariance, opacity: 0.9 }
    }

    #[test]
    fn axes_rebuild_the_covariance() {
        let r = Mat3::from_quat(Quat::from_xyzw(0.3, -0.5, 0.2, 0.7).normalize());
        let c = r * Mat3::from_diagonal(Vec3::new(0.04, 1.0, 0.25)) * r.transpose();
        let (s, q) = axes(c);
        let r = Mat3::from_quat(q);
        let back = r * Mat3::from_diagonal(Vec3::from(s.map(|v| v * v))) * r.transpose();
        assert!((back - c).to_cols_array().iter().all(|v| v.abs() < 1e-5), "{back} {c}");
        assert!((r.determinant() - 1.0).abs() < 1e-5);
    }

    #[test]
    fn abnormal_and_invalid_gaussians_are_removed_and_counted() {
        let mut all = vec![merged(Mat3::IDENTITY * 0.01); 10];
        all.push(merged(Mat3::IDENTITY * 4.0));
        all.push(merged(Mat3::from_diagonal(Vec3::new(f32::NAN, 1.0, 1.0))));
        all.push(merged(Mat3::ZERO));
        let (cloud, removed) = cloud(&all, 8.0);
        assert_eq!((cloud.len(), removed), (10, 3));
        assert!(cloud.log_scales.iter().flatten().all(|s| (s - 0.1f32.ln()).abs() < 1e-4));
    }
}
