//! Rotation vectors: the chart in which rotations are differentiated and averaged.

use glam::{DMat3, DQuat, DVec3};

/// Rotation by `|v|` radians about `v`.
pub(crate) fn exp(v: DVec3) -> DQuat {
    DQuat::from_scaled_axis(v)
}

/// Rotation vector of `q`, at most π long (a quaternion and its negative are the same rotation).
pub(crate) fn log(q: DQuat) -> DVec3 {
    let q = if q.w < 0.0 { -q } else { q };
    let sine = q.xyz().length();
    // 2·asin(s)/s → 2 as s → 0; atan2 keeps its digits at both ends, which acos does not.
    let factor = if sine < 1e-12 { 2.0 } else { 2.0 * sine.atan2(q.w) / sine };
    q.xyz() * factor
}

/// Cross-product matrix: `skew(a)·b = a × b`.
pub(crate) fn skew(v: DVec3) -> DMat3 {
    DMat3::from_cols(DVec3::new(0.0, v.z, -v.y), DVec3::new(-v.z, 0.0, v.x), DVec3::new(v.y, -v.x, 0.0))
}

/// Inverse right Jacobian to second order: `log(exp(e)·exp(d)) ≈ e + J·d` (Barfoot, State Estimation for
/// Robotics, eq. 7.80); its transpose is the left one. The third-order rest is below 1 % up to 0.7 rad.
pub(crate) fn right_jacobian_inverse(e: DVec3) -> DMat3 {
    let s = skew(e);
    DMat3::IDENTITY + s * 0.5 + s * s * (1.0 / 12.0)
}

/// Rotation that takes most `from` directions onto their `to` directions, least squares (Kabsch, proper
/// rotations only); `None` for fewer than two pairs or without a spread of directions.
pub(crate) fn align_directions(pairs: impl Iterator<Item = (DVec3, DVec3)>) -> Option<DQuat> {
    let mut h = nalgebra::Matrix3::<f64>::zeros();
    let mut count = 0usize;
    for (from, to) in pairs {
        let (f, t) = (from.normalize_or_zero(), to.normalize_or_zero());
        h += nalgebra::Vector3::new(t.x, t.y, t.z) * nalgebra::RowVector3::new(f.x, f.y, f.z);
        count += 1;
    }
    if count < 2 || !h.iter().all(|x| x.is_finite()) {
        return None;
    }
    let svd = h.svd(true, true);
    let (u, vt) = (svd.u?, svd.v_t?);
    if svd.singular_values[1] < 1e-9 * svd.singular_values[0].max(f64::MIN_POSITIVE) {
        return None;
    }
    let mut flip = nalgebra::Matrix3::identity();
    flip[(2, 2)] = (u.determinant() * vt.determinant()).signum();
    let r = u * flip * vt;
    Some(DQuat::from_mat3(&DMat3::from_cols_slice(r.as_slice())).normalize())
}

#[cfg(test)]
#[allow(clippy::unwrap_used)] // a test may
mod tests {
    use super::*;

    #[test]
    fn log_undoes_exp_from_a_nanoradian_to_a_half_turn() {
        for angle in [0.0, 1e-9, 1e-3, 1.0, 3.0, std::f64::consts::PI - 1e-5] {
            let v = DVec3::new(0.6, -0.64, 0.48) * angle;
            assert!((log(exp(v)) - v).length() < 1e-9 * (1.0 + angle), "{angle}");
            assert!((log(-exp(v)) - v).length() < 1e-9 * (1.0 + angle), "{angle}");
        }
    }

    #[test]
    fn right_jacobian_inverse_is_the_derivative_of_log() {
        let e = DVec3::new(0.1, -0.2, 0.05);
        for axis in [DVec3::X, DVec3::Y, DVec3::Z] {
            let h = 1e-6;
            let numeric = (log(exp(e) * exp(axis * h)) - log(exp(e) * exp(-axis * h))) / (2.0 * h);
            assert!((numeric - right_jacobian_inverse(e) * axis).length() < 1e-4);
        }
    }

    #[test]
    fn kabsch_finds_the_rotation_and_refuses_a_single_direction() {
        let q = exp(DVec3::new(0.3, 1.2, -2.0));
        let rays = [DVec3::X, DVec3::new(0.2, 0.5, 1.0), DVec3::new(-0.4, 0.1, 1.0)];
        let found = align_directions(rays.iter().map(|r| (*r, q * *r))).unwrap();
        assert!(log(found * q.conjugate()).length() < 1e-9);
        assert!(align_directions([(DVec3::X, DVec3::Y); 5].into_iter()).is_none());
        assert!(align_directions(std::iter::empty()).is_none());
    }
}
