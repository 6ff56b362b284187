//! The directions that a scene was seen from: SH coefficients are only worth what they change in those.
//!
//! Mean m of the SH basis above degree 0 and its covariance G over (Gaussian, view) pairs, one for the whole scene. A
//! Gaussian's colour, averaged over its views, is dc + mᵀc; how much it varies with the view is cᵀGc, so c is rounded in G's
//! eigenvectors, each as finely as its eigenvalue asks.

use super::coder::{Coder, Garbled};
use crate::camera::View;
use crate::cloud::sh_basis;
use glam::Vec3;

/// SH coefficients above degree 0 at degree 3.
pub const MOST: usize = 15;
/// Pairs of Gaussians and views are counted for so many Gaussians at least.
const SAMPLE: usize = 1024;
/// Added to the covariance: what no view saw may still be seen once.
const UNSEEN: f64 = 0.003;
/// Variance of a basis function over the sphere, 1/4π: what is assumed where there are no views.
const SPHERE: f64 = 0.079_577_47;
/// A Gaussian counts as seen up to 5 % outside the picture, from 0.1 m on.
const MARGIN: f32 = 1.05;
const NEAR_M: f32 = 0.1;

/// Bits of a component of an eigenvector in a cell, and its steps from 0 to 1.
const VECTOR_BITS: u32 = 10;
const VECTOR_STEPS: f32 = 511.0;

/// Mean, eigenvectors (columns, falling eigenvalues) and eigenvalues, of `coefficients` basis functions.
#[derive(Clone, Debug)]
pub struct ViewBasis {
    pub coefficients: usize,
    pub mean: [f32; MOST],
    pub vectors: [[f32; MOST]; MOST],
    pub values: [f32; MOST],
}

impl ViewBasis {
    /// Of the pairs that `views` hold; `weights` say how much a Gaussian is seen.
    pub fn of(coefficients: usize, means: &[Vec3], weights: &[f64], views: &[View]) -> Self {
        let mut sum = nalgebra::SVector::<f64, MOST>::zeros();
        let mut square = nalgebra::SMatrix::<f64, MOST, MOST>::zeros();
        let mut total = 0.0;
        let cameras: Vec<_> = views.iter().map(|v| (v, v.pose.world_to_camera())).collect();
        for i in (0..means.len()).step_by((means.len() / SAMPLE).max(1)) {
            let mut seen = Vec::with_capacity(cameras.len());
            for (view, (rotation, shift)) in &cameras {
                let (k, p) = (&view.intrinsics, *rotation * means[i] + *shift);
                let reach = MARGIN * p.z * 0.5;
                if p.z > NEAR_M
                    && (p.x * k.fx).abs() < reach * k.width as f32
                    && (p.y * k.fy).abs() < reach * k.height as f32
                {
                    seen.push(sh_basis((means[i].as_dvec3() - view.pose.center).normalize().to_array()));
                }
            }
            for b in &seen {
                let b = nalgebra::SVector::<f64, MOST>::from(*b);
                let weight = weights[i] / seen.len() as f64;
                sum += b * weight;
                square += b * b.transpose() * weight;
                total += weight;
            }
        }
        let n = coefficients;
        let mut basis = Self { coefficients, mean: [0.0; MOST], vectors: [[0.0; MOST]; MOST], values: [0.0; MOST] };
        let mut covariance = nalgebra::DMatrix::<f64>::identity(n, n) * SPHERE;
        if total > 0.0 && total.is_finite() {
            let mean = sum / total;
            (0..n).for_each(|i| basis.mean[i] = mean[i] as f32);
            covariance = nalgebra::DMatrix::from_fn(n, n, |r, c| {
                square[(r, c)] / total - mean[r] * mean[c] + if r == c { UNSEEN } else { 0.0 }
            });
        }
        if n > 0 {
            let eigen = covariance.symmetric_eigen();
            let mut order: Vec<usize> = (0..n).collect();
            order.sort_by(|a, b| eigen.eigenvalues[*b].total_cmp(&eigen.eigenvalues[*a]));
            for (to, from) in order.into_iter().enumerate() {
                basis.values[to] = eigen.eigenvalues[from].max(UNSEEN / 10.0) as f32;
                (0..n).for_each(|r| basis.vectors[r][to] = eigen.eigenvectors[(r, from)] as f32);
            }
        }
        basis
    }

    pub fn code(mut self, coder: &mut impl Coder) -> Result<Self, Garbled> {
        let n = self.coefficients;
        let (mean, values) = (&mut self.mean[..n], &mut self.values[..n]);
        let vectors = self.vectors[..n].iter_mut().flat_map(|row| &mut row[..n]);
        for v in mean.iter_mut().chain(values) {
            // Half of a number's bits: sign, exponent and seven of its digits.
            *v = f32::from_bits((coder.bits(16, u64::from(v.to_bits() >> 16))? as u32) << 16);
        }
        for v in vectors {
            let step = ((*v + 1.0) * VECTOR_STEPS).round().clamp(0.0, 2.0 * VECTOR_STEPS);
            *v = coder.bits(VECTOR_BITS, step as u64)? as f32 / VECTOR_STEPS - 1.0;
        }
        let finite = self.mean[..n].iter().chain(self.vectors[..n].as_flattened()).all(|v| v.is_finite());
        if finite && self.values[..n].iter().all(|v| *v > 0.0 && v.is_finite()) { Ok(self) } else { Err(Garbled) }
    }
}
