//! The similarity (scale, rotation, translation) that best maps one point set onto another in least squares
//! (Umeyama 1991), with the cases refused in which it is not determined.

use glam::{DMat3, DQuat, DVec3};
use nalgebra::Matrix3;

/// x ↦ scale · (rotation · x) + translation.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Similarity {
    /// Above 0.
    pub scale: f64,
    /// Unit quaternion.
    pub rotation: DQuat,
    /// Added last.
    pub translation: DVec3,
}

impl Similarity {
    /// Changes nothing.
    pub const IDENTITY: Self = Self { scale: 1.0, rotation: DQuat::IDENTITY, translation: DVec3::ZERO };

    /// The mapped point.
    pub fn apply(&self, p: DVec3) -> DVec3 {
        self.rotation * p * self.scale + self.translation
    }

    /// First `self`, then `after`.
    pub fn then(&self, after: &Self) -> Self {
        Self {
            scale: self.scale * after.scale,
            rotation: (after.rotation * self.rotation).normalize(),
            translation: after.apply(self.translation),
        }
    }
}

/// Why no similarity is determined.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
pub enum Undetermined {
    /// Fewer than three weighted points.
    #[error("alignment needs at least 3 points, there are {0}")]
    TooFew(usize),
    /// All on one line or in one spot.
    #[error("alignment points lie on a line or in one spot: rotation or scale is not determined")]
    Degenerate,
    /// The iteration left all bounds.
    #[error("ICP diverged: no correspondences within the gate")]
    Diverged,
}

/// Second-largest variance below this share of the largest is a line.
const LINE: f64 = 1e-9;

/// Weighted least-squares similarity from `from` to `to`; pairs that are not finite or without weight are ignored.
///
/// # Errors
/// Too few points, or points on a line.
pub fn umeyama(from: &[DVec3], to: &[DVec3], weights: Option<&[f64]>) -> Result<Similarity, Undetermined> {
    let pairs: Vec<(DVec3, DVec3, f64)> = from
        .iter()
        .zip(to)
        .enumerate()
        .map(|(i, (a, b))| (*a, *b, weights.map_or(1.0, |w| w[i])))
        .filter(|(a, b, w)| a.is_finite() && b.is_finite() && w.is_finite() && *w > 0.0)
        .collect();
    if pairs.len() < 3 {
        return Err(Undetermined::TooFew(pairs.len()));
    }
    let total: f64 = pairs.iter().map(|p| p.2).sum();
    let mean = |f: &dyn Fn(&(DVec3, DVec3, f64)) -> DVec3| pairs.iter().map(|p| f(p) * p.2).sum::<DVec3>() / total;
    let (ca, cb) = (mean(&|p| p.0), mean(&|p| p.1));
    let mut cross = Matrix3::<f64>::zeros();
    let mut spread = Matrix3::<f64>::zeros();
    let mut variance = 0.0;
    for (a, b, w) in &pairs {
        let (a, b) = (*a - ca, *b - cb);
        let (a, b) = (nalgebra::Vector3::from(a.to_array()), nalgebra::Vector3::from(b.to_array()));
        cross += b * a.transpose() * *w;
        spread += a * a.transpose() * *w;
        variance += a.norm_squared() * w;
    }
    let mut own = spread.symmetric_eigenvalues().as_slice().to_vec();
    own.sort_by(|a, b| b.total_cmp(a));
    let svd = cross.svd(true, true);
    let (Some(u), Some(vt)) = (svd.u, svd.v_t) else { return Err(Undetermined::Degenerate) };
    if !(own[0] > 0.0 && own[1] > LINE * own[0] && svd.singular_values[0] > 0.0) {
        return Err(Undetermined::Degenerate);
    }
    // The sign keeps a reflection from passing as a rotation.
    let sign = if (u.determinant() * vt.determinant()) < 0.0 { -1.0 } else { 1.0 };
    let smallest = svd.singular_values.iter().enumerate().min_by(|a, b| a.1.total_cmp(b.1)).map_or(2, |m| m.0);
    let mut d = Matrix3::<f64>::identity();
    d[(smallest, smallest)] = sign;
    let r = u * d * vt;
    let scale = (0..3).map(|k| svd.singular_values[k] * d[(k, k)]).sum::<f64>() / variance;
    if !(scale > 0.0 && scale.is_finite()) {
        return Err(Undetermined::Degenerate);
    }
    let m = DMat3::from_cols_array(&[
        r[(0, 0)],
        r[(1, 0)],
        r[(2, 0)],
        r[(0, 1)],
        r[(1, 1)],
        r[(2, 1)],
        r[(0, 2)],
        r[(1, 2)],
        r[(2, 2)],
    ]);
    let rotation = DQuat::from_mat3(&m).normalize();
    Ok(Similarity { scale, rotation, translation: cb - rotation * ca * scale })
}

#[cfg(test)]
mod tests {
    use super::*;

    fn cloud() -> Vec<DVec3> {
        (0..30).map(|i| DVec3::new((i * 7 % 11) as f64, (i * 5 % 13) as f64, (i * 3 % 7) as f64)).collect()
    }

    fn truth() -> Similarity {
        Similarity {
            scale: 2.5,
            rotation: DQuat::from_euler(glam::EulerRot::XYZ, 0.4, -1.2, 2.0),
            translation: DVec3::new(10.0, -3.0, 0.5),
        }
    }

    #[test]
    fn recovers_the_truth_and_composes() {
        let from = cloud();
        let to: Vec<DVec3> = from.iter().map(|p| truth().apply(*p)).collect();
        let s = umeyama(&from, &to, None).unwrap();
        assert!((s.scale - 2.5).abs() < 1e-9 && from.iter().zip(&to).all(|(a, b)| (s.apply(*a) - *b).length() < 1e-9));
        let twice = s.then(&s);
        assert!((twice.apply(from[3]) - s.apply(s.apply(from[3]))).length() < 1e-9);
    }

    #[test]
    fn a_mirror_image_gives_a_rotation_never_a_reflection() {
        let from = cloud();
        let to: Vec<DVec3> = from.iter().map(|p| DVec3::new(-p.x, p.y, p.z)).collect();
        match umeyama(&from, &to, None) {
            Ok(s) => assert!((DMat3::from_quat(s.rotation).determinant() - 1.0).abs() < 1e-9 && s.scale > 0.0),
            Err(e) => assert_eq!(e, Undetermined::Degenerate),
        }
    }

    #[test]
    fn lines_spots_and_too_few_points_are_refused() {
        let line: Vec<DVec3> = (0..9).map(|i| DVec3::new(i as f64, 2.0 * i as f64, 0.0)).collect();
        assert_eq!(umeyama(&line, &line, None), Err(Undetermined::Degenerate));
        assert_eq!(umeyama(&[DVec3::ONE; 9], &[DVec3::ONE; 9], None), Err(Undetermined::Degenerate));
        assert_eq!(umeyama(&line[..2], &line[..2], None), Err(Undetermined::TooFew(2)));
        let nan = [DVec3::NAN, DVec3::X, DVec3::Y, DVec3::NAN];
        assert_eq!(umeyama(&nan, &nan, None), Err(Undetermined::TooFew(2)));
    }
}
