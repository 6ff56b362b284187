//! What is known of a Gaussian from those coded before it. Encoder and decoder must come to the same numbers on any machine:
//! only additions, products, quotients and square roots, no function of the platform's mathematics library.

use super::coder::{Coder, Garbled};
use crate::align::nearest::KdTree;
use glam::Vec3;

/// Neighbours that predict.
const USED: usize = 6;
/// Neighbours looked for; those coded later cannot be used.
const FOUND: usize = 16;
/// Metres added to a distance: coincident ones do not weigh infinitely.
const NEAR: f64 = 1e-6;
/// Steps of a regression's coefficients.
const COEFFICIENT: f64 = 1.0 / 4096.0;

/// For every Gaussian, the nearest ones before it, and their weights (inverse distance, adding up to 1).
pub struct Neighbours(Vec<[(u32, f32); USED]>);

impl Neighbours {
    pub fn new(means: &[Vec3]) -> Self {
        let tree = KdTree::new(means);
        let mut found = [(0.0, 0); FOUND];
        let all = means.iter().enumerate().map(|(i, mean)| {
            let mut used = [(0, 0.0); USED];
            let n = tree.nearest(*mean, Some(i as u32), &mut found);
            let earlier = found[..n].iter().filter(|(_, j)| (*j as usize) < i).take(USED);
            let mut sum = 0.0;
            for (to, (squared, j)) in used.iter_mut().zip(earlier) {
                let weight = 1.0 / (f64::from(*squared).sqrt() + NEAR);
                *to = (*j, weight as f32);
                sum += weight;
            }
            if sum > 0.0 {
                used.iter_mut().for_each(|(_, w)| *w = (f64::from(*w) / sum) as f32);
            } else if i > 0 {
                used[0] = (i as u32 - 1, 1.0);
            }
            used
        });
        Self(all.collect())
    }

    /// The weighted mean of `value` over the neighbours of `i`; 0 for the first Gaussian.
    pub fn mean(&self, i: usize, value: impl Fn(usize) -> f64) -> f64 {
        self.0[i].iter().filter(|(_, w)| *w > 0.0).map(|(j, w)| f64::from(*w) * value(*j as usize)).sum()
    }
}

/// Coefficients of a linear prediction with a constant, of at most `N` - 1 variables.
pub struct Linear<const N: usize>([f64; N]);

impl<const N: usize> Linear<N> {
    /// Least squares over `rows` of variables (the last is 1) and what they should give. Of no use to a decoder, which
    /// passes no rows.
    pub fn fit(rows: impl Iterator<Item = ([f64; N], f64)>) -> Self {
        let mut normal = nalgebra::SMatrix::<f64, N, N>::zeros();
        let mut right = nalgebra::SVector::<f64, N>::zeros();
        for (x, y) in rows {
            let x = nalgebra::SVector::<f64, N>::from(x);
            normal += x * x.transpose();
            right += x * y;
        }
        // Variables that never change, or together, get a coefficient all the same.
        let ridge = 1e-9 * (normal.trace() + 1.0);
        normal += nalgebra::SMatrix::<f64, N, N>::identity() * ridge;
        let solved = normal.cholesky().map(|c| c.solve(&right));
        Self(solved.map_or([0.0; N], |s| std::array::from_fn(|i| s[i])))
    }

    /// Sends the coefficients along, rounded; both sides then use those.
    pub fn code(self, coder: &mut impl Coder) -> Result<Self, Garbled> {
        let mut coded = [0.0; N];
        for (to, from) in coded.iter_mut().zip(self.0) {
            let steps = (from / COEFFICIENT).round().clamp(-2e9, 2e9) as i32;
            *to = f64::from(coder.bits(32, u64::from(steps as u32))? as u32 as i32) * COEFFICIENT;
        }
        Ok(Self(coded))
    }

    pub fn at(&self, x: &[f64; N]) -> f64 {
        self.0.iter().zip(x).map(|(c, x)| c * x).sum()
    }
}

/// The binary logarithm, within 0.01: exponent and a parabola.
pub fn log2(x: f64) -> f64 {
    let bits = x.to_bits();
    let exponent = f64::from((bits >> 52) as u16 & 0x7ff) - 1023.0;
    let mantissa = f64::from_bits((bits & ((1 << 52) - 1)) | 1023 << 52);
    exponent + (2.0 - mantissa / 3.0) * mantissa - 5.0 / 3.0
}

/// 2^(half / 2).
pub fn half_power(half: i32) -> f64 {
    let whole = f64::from_bits(((1023 + half.div_euclid(2)) as u64) << 52);
    if half.rem_euclid(2) == 1 { whole * std::f64::consts::SQRT_2 } else { whole }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn logarithms_and_powers_are_near_the_true_ones() {
        for i in 1..2000 {
            let x = f64::from(i) * 0.013;
            assert!((log2(x) - x.log2()).abs() < 0.02, "{x}");
        }
        for half in -8..=16 {
            assert!((half_power(half) / (f64::from(half) / 2.0).exp2() - 1.0).abs() < 1e-12);
        }
    }

    #[test]
    fn a_line_through_points_is_found_and_a_constant_variable_does_no_harm() {
        let rows = (0..50).map(|i| ([f64::from(i), 3.0, 1.0], 2.0 * f64::from(i) - 7.0));
        let line = Linear::fit(rows);
        assert!((line.at(&[10.0, 3.0, 1.0]) - 13.0).abs() < 1e-3);
        assert_eq!(Linear::<3>::fit(std::iter::empty()).at(&[1.0, 1.0, 1.0]), 0.0);
    }
}
