//! One row of the cloud, and its gradient, in either number type.

use models::cloud::GaussianCloud;

use super::real::Real;

/// A Gaussian's parameters as they are optimised; also the shape of their gradient.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Gaussian<R> {
    /// World position, metres.
    pub mean: [R; 3],
    /// Natural logarithm of the standard deviations, metres.
    pub log_scale: [R; 3],
    /// Own axes → world, w x y z, any length but zero.
    pub rotation: [R; 4],
    /// logit(opacity).
    pub opacity_logit: R,
    /// SH coefficients, those beyond the cloud's degree are zero.
    pub sh: [[R; 3]; 16],
}

/// Floats of a [`Gaussian`] at degree 3.
pub const PARAMETERS: usize = 11 + 48;

impl<R: Real> Gaussian<R> {
    /// Row `i` of a cloud.
    pub fn of_row(cloud: &GaussianCloud, i: usize) -> Self {
        let stride = cloud.sh_stride();
        let mut sh = [[R::ZERO; 3]; 16];
        for (k, c) in cloud.sh[i * stride..(i + 1) * stride].chunks_exact(3).enumerate() {
            sh[k] = [R::of(c[0].into()), R::of(c[1].into()), R::of(c[2].into())];
        }
        Self {
            mean: cloud.means[i].map(|v| R::of(v.into())),
            log_scale: cloud.log_scales[i].map(|v| R::of(v.into())),
            rotation: cloud.rotations[i].map(|v| R::of(v.into())),
            opacity_logit: R::of(cloud.opacity_logits[i].into()),
            sh,
        }
    }

    /// All rows of a cloud.
    pub fn of_cloud(cloud: &GaussianCloud) -> Vec<Self> {
        (0..cloud.len()).map(|i| Self::of_row(cloud, i)).collect()
    }

    /// Parameter `k` of [`PARAMETERS`]: mean, log scale, rotation, opacity, then SH coefficient by coefficient.
    pub fn parameter(&mut self, k: usize) -> &mut R {
        match k {
            0..3 => &mut self.mean[k],
            3..6 => &mut self.log_scale[k - 3],
            6..10 => &mut self.rotation[k - 6],
            10 => &mut self.opacity_logit,
            _ => &mut self.sh[(k - 11) / 3][(k - 11) % 3],
        }
    }

    /// Whether every number is finite and the quaternion has a direction.
    pub fn is_sound(&self) -> bool {
        let q2: R = self.rotation.iter().map(|v| *v * *v).sum();
        let geometry = self.mean.iter().chain(&self.log_scale).all(|v| v.is_finite());
        geometry
            && self.opacity_logit.is_finite()
            && q2.is_finite()
            && q2 > R::of(1e-20)
            && self.sh.iter().flatten().all(|v| v.is_finite())
    }

    /// Adds another row's numbers to this one's (gradients).
    pub fn add(&mut self, other: &Self) {
        let mut other = *other;
        for k in 0..PARAMETERS {
            *self.parameter(k) += *other.parameter(k);
        }
    }
}
