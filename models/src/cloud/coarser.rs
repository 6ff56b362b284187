//! Several Gaussians as one: the moments of what they cover.
//!
//! Weights are the areas that the Gaussians cover, opacity times the mean area of their projections, as 3DGS's own levels of detail
//! have it (Kerbl et al. 2024, "A Hierarchical 3D Gaussian Representation", §4.1): mean, covariance and colours are weighted means, the covariance
//! with the spread of the means. What covers more than itself, several layers of a surface, becomes wider instead of more than opaque.

use glam::{DMat3, DQuat, DVec3};
use nalgebra::{Matrix3, SymmetricEigen};

use crate::cloud::GaussianCloud;

/// Exponent of Thomsen's formula for the surface of an ellipsoid, within 1.1 %.
const THOMSEN: f64 = 1.6075;
/// Opacity that a Gaussian of several layers has at most: the trainer's own bound of what a Gaussian hides is 0.99.
const MAX_OPACITY: f64 = 0.99;
/// Standard deviation up to which what covers more than itself is widened, in sides of a voxel: that of trained Gaussians on a
/// closed surface, whose neighbours are a side away.
const WIDEST: f64 = 0.6;
/// Smallest standard deviation, in sides of a voxel: a flat group has none across.
const THINNEST: f64 = 1e-3;

/// One Gaussian for each voxel with edges of `side` metres: what lies in it, merged. A Gaussian larger than its voxel stays as it is. Rows that are not
/// valid are left out. The same cloud gives the same rows, in the order of their voxels.
pub(crate) fn coarser(cloud: &GaussianCloud, side: f64) -> GaussianCloud {
    // Casts saturate: what lies beyond 2³¹ voxels shares the last.
    let voxel = |m: [f32; 3]| m.map(|v| (f64::from(v) / side).floor() as i32);
    let large = |i: usize| cloud.log_scales[i].iter().any(|s| f64::from(*s).exp() > side);
    let mut rows: Vec<([i32; 3], bool, u32)> =
        (0..cloud.len()).filter(|i| cloud.is_valid(*i)).map(|i| (voxel(cloud.means[i]), large(i), i as u32)).collect();
    rows.sort_unstable();
    let mut merged = GaussianCloud::with_capacity(cloud.sh_degree, rows.len() / 2);
    let mut sums = Sums::new(cloud.sh_stride());
    for group in rows.chunk_by(|a, b| a.0 == b.0 && !a.1 && !b.1) {
        match group {
            [(.., one)] => push(&mut merged, cloud, *one as usize),
            many => {
                sums.clear();
                many.iter().for_each(|(.., i)| sums.add(&Gaussian::of(cloud, *i as usize), sh(cloud, *i as usize)));
                sums.push_to(&mut merged, side);
            }
        }
    }
    merged
}

fn sh(cloud: &GaussianCloud, i: usize) -> &[f32] {
    let stride = cloud.sh_stride();
    &cloud.sh[i * stride..(i + 1) * stride]
}

fn push(into: &mut GaussianCloud, cloud: &GaussianCloud, i: usize) {
    into.push(cloud.means[i], cloud.log_scales[i], cloud.rotations[i], cloud.opacity_logits[i], sh(cloud, i));
}

/// A valid row, in f64.
struct Gaussian {
    mean: DVec3,
    covariance: DMat3,
    /// Opacity · mean projected area, m².
    covers: f64,
}

impl Gaussian {
    fn of(cloud: &GaussianCloud, i: usize) -> Self {
        let [w, x, y, z] = cloud.rotations[i].map(f64::from);
        let axes = DMat3::from_quat(DQuat::from_xyzw(x, y, z, w).normalize());
        let sigma = DVec3::from_array(cloud.log_scales[i].map(|s| f64::from(s).exp()));
        let covariance = axes * DMat3::from_diagonal(sigma * sigma) * axes.transpose();
        let opacity = 1.0 / (1.0 + (-f64::from(cloud.opacity_logits[i])).exp());
        Self { mean: DVec3::from_array(cloud.means[i].map(f64::from)), covariance, covers: opacity * area(sigma) }
    }
}

/// Mean area of the projections of an ellipsoid with these half axes: a quarter of its surface (Cauchy).
fn area(sigma: DVec3) -> f64 {
    let [a, b, c] = sigma.to_array().map(|s| s.powf(THOMSEN));
    std::f64::consts::PI * ((a * b + b * c + c * a) / 3.0).powf(1.0 / THOMSEN)
}

/// Moments of a group: weights, and what they weigh.
struct Sums {
    weight: f64,
    mean: DVec3,
    /// E[x xᵀ] around `origin`, so that coordinates of UTM's size lose no digits.
    square: DMat3,
    origin: DVec3,
    sh: Vec<f64>,
}

impl Sums {
    fn new(stride: usize) -> Self {
        Self { weight: 0.0, mean: DVec3::ZERO, square: DMat3::ZERO, origin: DVec3::ZERO, sh: vec![0.0; stride] }
    }

    fn clear(&mut self) {
        (self.weight, self.mean, self.square) = (0.0, DVec3::ZERO, DMat3::ZERO);
        self.sh.fill(0.0);
    }

    fn add(&mut self, gaussian: &Gaussian, sh: &[f32]) {
        if self.weight == 0.0 {
            self.origin = gaussian.mean;
        }
        // Scales may have underflowed to nothing: such a group still has a middle.
        let weight = gaussian.covers.max(f64::MIN_POSITIVE);
        let at = gaussian.mean - self.origin;
        let outer = DMat3::from_cols(at * at.x, at * at.y, at * at.z);
        self.weight += weight;
        self.mean += weight * at;
        self.square += (gaussian.covariance + outer) * weight;
        self.sh.iter_mut().zip(sh).for_each(|(sum, v)| *sum += weight * f64::from(*v));
    }

    fn push_to(&self, into: &mut GaussianCloud, side: f64) {
        let at = self.mean / self.weight;
        let outer = DMat3::from_cols(at * at.x, at * at.y, at * at.z);
        let covariance = self.square * (1.0 / self.weight) - outer;
        let eigen = SymmetricEigen::new(Matrix3::from_column_slice(&covariance.to_cols_array()));
        let thinnest = THINNEST * side;
        let mut sigma = DVec3::from_array([0, 1, 2].map(|k| eigen.eigenvalues[k].max(0.0).sqrt().max(thinnest)));
        let layers = self.weight / (MAX_OPACITY * area(sigma));
        if layers > 1.0 {
            // The area grows with the square of the widening, or less where one axis is wide enough already.
            let widest = WIDEST * side;
            sigma = sigma.map(|s| if s < widest { (s * layers.sqrt()).min(widest) } else { s });
        }
        let opacity = (self.weight / area(sigma)).min(MAX_OPACITY);
        let column = |k: usize| DVec3::from_array([0, 1, 2].map(|row| eigen.eigenvectors[(row, k)]));
        let mut axes = DMat3::from_cols(column(0), column(1), column(2));
        if axes.determinant() < 0.0 {
            axes.z_axis = -axes.z_axis;
        }
        let q = DQuat::from_mat3(&axes).normalize();
        let sh: Vec<f32> = self.sh.iter().map(|sum| (sum / self.weight) as f32).collect();
        into.push(
            (self.origin + at).to_array().map(|v| v as f32),
            sigma.to_array().map(|s| s.ln() as f32),
            [q.w, q.x, q.y, q.z].map(|v| v as f32),
            // A group that covers nothing is not seen; its logit stays finite.
            (opacity / (1.0 - opacity)).max(1e-6).ln() as f32,
            &sh,
        );
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::cloud::SH_C0;

    /// Mean, standard deviations, rotation, logit of the opacity.
    type Row = ([f32; 3], [f32; 3], [f32; 4], f32);

    fn cloud(rows: &[Row]) -> GaussianCloud {
        let mut cloud = GaussianCloud::with_capacity(0, rows.len());
        rows.iter().for_each(|(m, s, q, o)| cloud.push(*m, s.map(f32::ln), *q, *o, &[m[0], 0.5, 0.0]));
        cloud
    }

    fn moments(cloud: &GaussianCloud) -> (f64, DVec3, DMat3) {
        let mut sums = Sums::new(0);
        (0..cloud.len()).for_each(|i| sums.add(&Gaussian::of(cloud, i), &[]));
        let at = sums.mean / sums.weight;
        let outer = DMat3::from_cols(at * at.x, at * at.y, at * at.z);
        (sums.weight, sums.origin + at, sums.square * (1.0 / sums.weight) - outer)
    }

    #[test]
    fn a_merged_gaussian_covers_what_its_parts_did_and_has_their_moments() {
        let parts = cloud(&[
            ([4.1, 5.2, 0.3], [0.05, 0.02, 0.01], [0.9, 0.1, -0.3, 0.2], 0.4),
            ([4.4, 5.6, 0.1], [0.03, 0.06, 0.02], [0.2, 0.7, 0.1, -0.4], -1.0),
            ([4.8, 5.3, 0.6], [0.02, 0.02, 0.04], [0.5, -0.5, 0.5, 0.5], 1.5),
        ]);
        let one = coarser(&parts, 1.0);
        assert_eq!(one.len(), 1);
        let (before, after) = (moments(&parts), moments(&one));
        assert!((before.0 - after.0).abs() < 1e-6 * before.0, "{} m² became {}", before.0, after.0);
        assert!(before.1.distance(after.1) < 1e-6);
        let off = (before.2 - after.2).to_cols_array().iter().fold(0.0f64, |most, v| most.max(v.abs()));
        assert!(off < 1e-7, "covariance off by {off}");
        assert!((one.sh[1] - 0.5).abs() < 1e-6 && one.sh[0] > 4.1 && one.sh[0] < 4.8);
    }

    #[test]
    fn layers_of_a_surface_become_wider_not_more_than_opaque() {
        let sheet: Vec<_> = (0..16)
            .map(|i| {
                (
                    [0.125 + 0.25 * (i % 4) as f32, 0.125 + 0.25 * (i / 4) as f32, 0.0],
                    [0.15, 0.15, 0.01],
                    [1.0, 0.0, 0.0, 0.0],
                    5.0,
                )
            })
            .collect();
        let one = coarser(&cloud(&sheet), 1.0);
        assert_eq!(one.len(), 1);
        let mut sigma = one.log_scales[0].map(f32::exp);
        sigma.sort_by(f32::total_cmp);
        assert!(sigma[0] < 0.05 && sigma[1] > 0.4 && sigma[2] <= 0.601, "{sigma:?}");
        assert!(1.0 / (1.0 + (-one.opacity_logits[0]).exp()) > 0.9);
    }

    #[test]
    fn a_gaussian_larger_than_its_voxel_stays_as_it_is() {
        let rows = cloud(&[
            ([0.2, 0.2, 0.2], [3.0, 0.1, 0.1], [1.0, 0.0, 0.0, 0.0], 0.0),
            ([0.3, 0.2, 0.2], [0.1, 0.1, 0.1], [1.0, 0.0, 0.0, 0.0], 0.0),
            ([0.4, 0.2, 0.2], [0.1, 0.1, 0.1], [1.0, 0.0, 0.0, 0.0], 0.0),
        ]);
        let less = coarser(&rows, 1.0);
        assert_eq!(less.len(), 2);
        assert!(less.means.contains(&rows.means[0]) && less.log_scales.contains(&rows.log_scales[0]));
    }

    #[test]
    fn degenerate_rows_give_finite_gaussians_or_none() {
        let far = [448_251.4, 5_411_932.0, 120.0];
        let mut rows = cloud(&[
            ([0.1, 0.1, 0.1], [1e-30, 1e-30, 1e-30], [1.0, 0.0, 0.0, 0.0], -40.0),
            ([0.1, 0.1, 0.1], [1e-30, 1e-30, 1e-30], [1.0, 0.0, 0.0, 0.0], -40.0),
            (far, [0.2, 0.2, 0.2], [1.0, 0.0, 0.0, 0.0], 2.0),
            (far, [0.1, 0.2, 0.3], [0.0, 0.0, 0.0, 1.0], 2.0),
            ([f32::NAN, 0.0, 0.0], [0.2; 3], [1.0, 0.0, 0.0, 0.0], 0.0),
            ([0.0; 3], [0.2; 3], [0.0; 4], 0.0),
        ]);
        rows.sh[2] = 0.1 / SH_C0;
        let less = coarser(&rows, 1.0);
        assert_eq!(less.len(), 2);
        assert!((0..less.len()).all(|i| less.is_valid(i)));
        assert!(coarser(&GaussianCloud::default(), 1.0).is_empty());
    }
}
