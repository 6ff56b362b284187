//! What SH coefficients above degree 0 amount to: |c|, smooth where it is small.

use super::real::Real;
use crate::constants::SH_SMALL;

/// |c| less what smoothing takes from it, s ln(1 + |c|/s); c²/2s near zero.
pub fn magnitude<R: Real>(coefficient: R) -> R {
    let (size, small) = (coefficient.abs(), R::of(f64::from(SH_SMALL)));
    size - small * (R::ONE + size / small).ln()
}

/// Its derivative: 0 at zero, ±1 far from it.
pub fn magnitude_gradient<R: Real>(coefficient: R) -> R {
    coefficient / (coefficient.abs() + R::of(f64::from(SH_SMALL)))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_magnitude_is_square_near_zero_and_straight_far_from_it() {
        let small = f64::from(SH_SMALL);
        let tiny = 1e-3 * small;
        assert!((magnitude(tiny) / (tiny * tiny / (2.0 * small)) - 1.0).abs() < 1e-2);
        assert!((magnitude(-1.0f64) - 1.0).abs() < 0.03);
        assert_eq!((magnitude(0.0f32), magnitude_gradient(0.0f32)), (0.0, 0.0));
        for c in [f32::MAX, -1e30, 1.0, -1e-30] {
            assert!(magnitude_gradient(c).abs() <= 1.0, "{c}");
        }
    }
}
