//! Adam (Kingma & Ba 2015) and lazy Adam updates of Gaussians outside the view: such a one has gradient zero,
//! its moments decay and its parameters still drift along the first moment. The shaders take k such steps at
//! once when the Gaussian is next needed; this reference takes them one by one and is the judge of the shortcut.

use half::f16;

use super::real::Real;
use crate::constants::{ADAM_BETA1, ADAM_BETA2, ADAM_EPSILON};

/// One parameter with its moments.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Moments<R> {
    /// Running mean of the gradient.
    pub first: R,
    /// Running mean of its square.
    pub second: R,
}

/// Step `t` (from 1) with gradient `g`.
pub fn adam<R: Real>(parameter: &mut R, moments: &mut Moments<R>, g: R, rate: R, t: u32) {
    let (b1, b2) = (R::of(ADAM_BETA1.into()), R::of(ADAM_BETA2.into()));
    moments.first += (g - moments.first) * (R::ONE - b1);
    moments.second += (g * g - moments.second) * (R::ONE - b2);
    let bias = |beta: f32| R::of(1.0 - f64::from(beta).powi(t as i32));
    let first = moments.first / bias(ADAM_BETA1);
    let second = moments.second / bias(ADAM_BETA2);
    *parameter -= rate * first / (second.sqrt() + R::of(ADAM_EPSILON.into()));
}

/// What `k = rates.len()` missed steps after step `t` amount to: the factor of m/√v, and what becomes of the moments.
///
/// With g = 0, m and v only decay, so Δ = −(m/√v) Σⱼ rateⱼ (β₁/√β₂)ʲ √(1 − β₂^{t+j}) / (1 − β₁^{t+j}); ε = 1e-15 is left out.
pub fn deferred(rates: &[f64], t: u32) -> (f64, f64, f64) {
    let (b1, b2) = (f64::from(ADAM_BETA1), f64::from(ADAM_BETA2));
    let sum = rates.iter().enumerate().map(|(j, rate)| {
        let (j, at) = (j as i32 + 1, (t as i32) + j as i32 + 1);
        rate * (b1 / b2.sqrt()).powi(j) * (1.0 - b2.powi(at)).sqrt() / (1.0 - b1.powi(at))
    });
    let k = rates.len() as i32;
    (sum.sum(), b1.powi(k), b2.powi(k))
}

/// Moments as 16 bits hold them (`shaders/moments.glsl`): the first one and the root of the second one, both times
/// `scale`; the root is rounded up with the probability that makes it right on average, `chance` being uniform in 0…8191.
pub fn half_moments(moments: Moments<f32>, scale: f32, chance: u32) -> Moments<f32> {
    let most = f32::from(f16::MAX);
    let root = (moments.second.sqrt() * scale).min(most);
    let root = f32::from_bits(root.to_bits().wrapping_add(chance & DROPPED_BITS) & !DROPPED_BITS).min(most);
    if root < LEAST_HALF {
        return Moments::default();
    }
    let first = f16::from_f32((moments.first * scale).clamp(-most, most)).to_f32();
    Moments { first: first / scale, second: (f16::from_f32(root).to_f32() / scale).powi(2) }
}

/// Bits of f32's mantissa that f16 has not.
const DROPPED_BITS: u32 = 0x1FFF;
/// About the least that 16 bits tell from zero (2⁻²⁴).
const LEAST_HALF: f32 = 6.0e-8;

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn deferred_moments_equal_zero_gradient_steps_taken_one_by_one() {
        for k in [1, 2, 43, 400] {
            let rates: Vec<f64> = (0..k).map(|j| 1e-3 * 0.99f64.powi(j)).collect();
            let (mut p, mut m) = (0.3f64, Moments::default());
            for t in 1..=5 {
                adam(&mut p, &mut m, 0.1 * f64::from(t) - 0.2, 1e-3, t);
            }
            let (sum, first, second) = deferred(&rates, 5);
            let (jumped, after) = (p - sum * m.first / m.second.sqrt(), (m.first * first, m.second * second));
            for (j, rate) in rates.iter().enumerate() {
                adam(&mut p, &mut m, 0.0, *rate, 6 + j as u32);
            }
            assert!((p - jumped).abs() < 1e-9 * p.abs(), "{k}: {p} {jumped}");
            assert!((m.first - after.0).abs() <= 1e-12 && (m.second - after.1).abs() <= 1e-12);
        }
    }

    #[test]
    fn a_first_step_moves_by_the_learning_rate_whatever_the_gradients_size() {
        for g in [1e-12f32, 1e-3, 1e9] {
            let (mut p, mut m) = (0.0f32, Moments::default());
            adam(&mut p, &mut m, g, 0.01, 1);
            assert!((p + 0.01).abs() < 1e-5, "{g}: {p}");
        }
    }
}
