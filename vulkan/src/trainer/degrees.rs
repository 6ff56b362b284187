//! Each Gaussian's own SH degree: how many of its coefficients are evaluated, stepped and moved through memory. It is
//! raised, one degree at a time, where the residual asks for it: where a Gaussian's colour is pulled one way by some
//! views and another way by others.

use super::rows::{GEOMETRY, Rows};
use super::{TrainError, Trainer};
use crate::arena::Arena;
use models::cloud::sh_coefficients;

/// Progress from which the next raise is due, one after the other.
const OCCASIONS: [f32; 6] = [0.05, 0.1, 0.2, 0.3, 0.4, 0.5];

/// Bits of the state word (`shaders/deferred.glsl`).
const DEGREE_SHIFT: u32 = 26;
const ORDINARY: u32 = 1 << 29;

/// The state word, as the float it travels as, of a row of `degree` that was never stepped.
pub(super) fn state(degree: u8) -> f32 {
    f32::from_bits(ORDINARY | u32::from(degree & 3) << DEGREE_SHIFT)
}

fn degree_of(state: f32) -> u8 {
    (state.to_bits() >> DEGREE_SHIFT & 3) as u8
}

fn with_degree(state: f32, degree: u8) -> f32 {
    f32::from_bits(state.to_bits() & !(3 << DEGREE_SHIFT) | u32::from(degree & 3) << DEGREE_SHIFT)
}

/// Degree of the highest coefficient (r, g, b each) that is not zero.
pub(super) fn degree_in_use(coefficients: &[f32]) -> u8 {
    let used = coefficients.iter().rposition(|c| *c != 0.0).map_or(0, |i| i / 3 + 1);
    (0..3).find(|d| sh_coefficients(*d) >= used).unwrap_or(3)
}

/// Room for the ranking, allocated once, and how many raises are over.
pub(crate) struct Degrees {
    asks: Vec<f32>,
    ranked: Vec<f32>,
    raises: usize,
    /// Coefficients (of three numbers) that Gaussians could have and have not.
    missing: u64,
}

impl Degrees {
    pub fn new(capacity: usize) -> Self {
        Self { asks: Vec::with_capacity(capacity), ranked: Vec::with_capacity(capacity), raises: 0, missing: 0 }
    }

    pub fn reset(&mut self) {
        (self.raises, self.missing) = (0, 0);
    }
}

impl Trainer {
    /// Before the first step: where degrees are not raised by residual, every Gaussian has the highest at once.
    pub(super) fn open_degrees(&mut self) {
        if self.settings.sh.raise_share >= 1.0 {
            let (n, degree) = (self.gaussians, self.plan.sh_degree);
            for g in self.arena.slice_mut::<[f32; 4]>(self.rows.geometry).chunks_exact_mut(GEOMETRY).take(n) {
                g[1][3] = with_degree(g[1][3], degree);
            }
        }
        self.count_missing();
    }

    /// Raises the degree of those that ask most, when an occasion has come.
    pub(super) fn raise_degrees(&mut self, progress: f32) -> Result<(), TrainError> {
        let share = self.settings.sh.raise_share;
        let due = OCCASIONS.iter().take_while(|p| progress >= **p).count();
        if share >= 1.0 || due <= self.degrees.raises {
            return Ok(());
        }
        self.degrees.raises = due;
        self.flush()?;
        let limit = self.settings.sh.degree.min(self.plan.sh_degree);
        let (n, rows, t) = (self.gaussians, self.rows, self.steps as i32);
        let unbias = |beta: f32| 1.0 / (1.0 - f64::from(beta).powi(t)) as f32;
        let (first, second) = (unbias(self.settings.adam.beta1), unbias(self.settings.adam.beta2));
        let Degrees { asks, ranked, .. } = &mut self.degrees;
        asks.clear();
        let scale = self.frame.adam[3];
        asks.extend((0..n).map(|row| ask(&self.arena, &rows, row, limit, scale, [first, second])));
        ranked.clear();
        ranked.extend_from_slice(asks);
        let raised = ((n as f32 * share) as usize).min(n.saturating_sub(1));
        let (_, least, _) = ranked.select_nth_unstable_by(raised, |a, b| b.total_cmp(a));
        // No one is raised for asking more than others where all ask about the same.
        let mean = asks.iter().map(|a| f64::from(*a)).sum::<f64>() / n.max(1) as f64;
        let least = least.max(mean as f32);
        for row in 0..n {
            if self.degrees.asks[row] > least {
                raise(&mut self.arena, &rows, row);
                self.totals.counters.sh_raised += 1;
            }
        }
        self.count_missing();
        Ok(())
    }

    fn count_missing(&mut self) {
        let most = sh_coefficients(self.plan.sh_degree);
        let geometry = self.arena.slice::<[f32; 4]>(self.rows.geometry).chunks_exact(GEOMETRY).take(self.gaussians);
        self.degrees.missing = geometry.map(|g| (most - sh_coefficients(degree_of(g[1][3])).min(most)) as u64).sum();
    }

    /// Coefficients that a step does not touch, because no Gaussian has them.
    pub(super) fn missing_coefficients(&self) -> u64 {
        self.degrees.missing
    }
}

/// How much of a row's colour gradient the views disagree on: the variance of Adam's moments of degree 0, which a colour
/// that depends on the direction could follow. 0 for rows that have the highest degree, or were never seen.
fn ask(arena: &Arena, rows: &Rows, row: usize, limit: u8, scale: f32, unbias: [f32; 2]) -> f32 {
    if degree_of(arena.slice::<[f32; 4]>(rows.geometry)[row * GEOMETRY + 1][3]) >= limit {
        return 0.0;
    }
    let channel = |k: usize| {
        let (m, v) = (rows.sh_first.first(arena, row, k, scale), rows.sh_second.second(arena, row, k, scale));
        (v * unbias[1] - (m * unbias[0]).powi(2)).max(0.0)
    };
    let variance: f32 = (0..3).map(channel).sum();
    if variance.is_finite() { variance } else { 0.0 }
}

/// One degree more. The new coefficients are zero; their second moments start where degree 0's is, because the basis
/// functions have the same mean square over the sphere: from zero, the first steps would be several times too long.
fn raise(arena: &mut Arena, rows: &Rows, row: usize) {
    let g = &mut arena.slice_mut::<[f32; 4]>(rows.geometry)[row * GEOMETRY + 1];
    let degree = degree_of(g[3]) + 1;
    g[3] = with_degree(g[3], degree);
    let new = sh_coefficients(degree - 1)..sh_coefficients(degree);
    rows.sh_second.repeat_first_coefficient(arena, row, new);
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_state_word_is_an_ordinary_float_whatever_it_holds() {
        for degree in 0..=3 {
            for steps in [0u32, 1, 0x0FFF_FFFF & !(3 << DEGREE_SHIFT)] {
                let word = f32::from_bits(state(degree).to_bits() | steps);
                assert!(word.is_normal());
                assert_eq!(degree_of(word), degree);
                assert_eq!(degree_of(with_degree(word, 1)), 1);
                assert_eq!(with_degree(word, 2).to_bits() & steps, steps);
            }
        }
    }

    #[test]
    fn the_degree_in_use_is_that_of_the_last_coefficient_that_is_not_zero() {
        let with = |i: usize| {
            let mut c = [0.0; 48];
            c[i] = -0.1;
            degree_in_use(&c)
        };
        assert_eq!(degree_in_use(&[0.0; 48]), 0);
        assert_eq!(
            [with(0), with(2), with(3), with(11), with(12), with(26), with(27), with(47)],
            [0, 0, 1, 1, 2, 2, 3, 3]
        );
        assert_eq!(degree_in_use(&[f32::NAN; 3]), 0);
    }
}
