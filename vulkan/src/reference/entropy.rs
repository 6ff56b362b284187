//! The entropy of opacities (Fed3DGS, Suzuki 2024): least where all are opaque or nothing.

use super::real::{Real, sigmoid};

/// Binary entropy of sigmoid(`logit`), nats: ln 2 at zero, 0 far from it.
pub fn entropy<R: Real>(logit: R) -> R {
    // With x = |logit| and e = exp(-x): ln(1 + e) + x e / (1 + e), which neither overflows nor cancels.
    let x = logit.abs();
    let e = (R::ZERO - x).exp();
    (R::ONE + e).ln() + x * e / (R::ONE + e)
}

/// Its derivative by the logit.
pub fn entropy_gradient<R: Real>(logit: R) -> R {
    let opacity = sigmoid(logit);
    R::ZERO - logit * opacity * (R::ONE - opacity)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn entropy_is_that_of_the_formula_and_finite_wherever_a_logit_may_be() {
        for logit in [-6.0f64, -1.5, 0.0, 0.3, 8.0] {
            let o = sigmoid(logit);
            let expected = -(o * o.ln() + (1.0 - o) * (1.0 - o).ln());
            assert!((entropy(logit) - expected).abs() < 1e-9, "{logit}");
        }
        for logit in [f32::MAX, f32::MIN, 1e4, -1e4, 88.0, -88.0, f32::MIN_POSITIVE] {
            assert!(entropy(logit).is_finite() && entropy_gradient(logit).is_finite(), "{logit}");
        }
        assert_eq!((entropy(f32::MAX), entropy_gradient(-1e4f32)), (0.0, 0.0));
    }
}
