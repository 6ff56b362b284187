//! Each Gaussian's own SH degree: how many of its coefficients are evaluated, stepped and moved through memory. It is
//! raised, one degree at a time, where the residual asks for it: where a Gaussian's colour is pulled one way by some
//! views and another way by others.

use super::parameters::Parameters;
use super::state::{degree_of, with_degree};
use super::{TrainError, Trainer};
use crate::arena::Arena;
use models::cloud::sh_coefficients;

/// Progress from which the next raise is due, one after the other.
const OCCASIONS: [f32; 6] = [0.05, 0.1, 0.2, 0.3, 0.4, 0.5];

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
            let degree = self.plan.sh_degree;
            for g in &mut self.parameters.geometry_mut(&mut self.arena)[..self.gaussians] {
                g.state = with_degree(g.state, degree);
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
        let (n, parameters, t) = (self.gaussians, self.parameters, self.updates as i32);
        let unbias = |beta: f32| 1.0 / (1.0 - f64::from(beta).powi(t)) as f32;
        let (first, second) = (unbias(self.settings.adam.beta1), unbias(self.settings.adam.beta2));
        let Degrees { asks, ranked, .. } = &mut self.degrees;
        asks.clear();
        let scale = self.frame.moment_scale;
        asks.extend((0..n).map(|i| ask(&self.arena, &parameters, i, limit, scale, [first, second])));
        ranked.clear();
        ranked.extend_from_slice(asks);
        let raised = ((n as f32 * share) as usize).min(n.saturating_sub(1));
        let (_, least, _) = ranked.select_nth_unstable_by(raised, |a, b| b.total_cmp(a));
        // No one is raised for asking more than others where all ask about the same.
        let mean = asks.iter().map(|a| f64::from(*a)).sum::<f64>() / n.max(1) as f64;
        let least = least.max(mean as f32);
        for index in 0..n {
            if self.degrees.asks[index] > least {
                raise(&mut self.arena, &parameters, index);
                self.counters.sh_raised += 1;
            }
        }
        self.count_missing();
        Ok(())
    }

    pub(super) fn count_missing(&mut self) {
        let most = sh_coefficients(self.plan.sh_degree);
        let geometry = &self.parameters.geometry(&self.arena)[..self.gaussians];
        let missing = |state: f32| (most - sh_coefficients(degree_of(state)).min(most)) as u64;
        self.degrees.missing = geometry.iter().map(|g| missing(g.state)).sum();
    }

    /// Coefficients that a step does not touch, because no Gaussian has them.
    pub(super) fn missing_coefficients(&self) -> u64 {
        self.degrees.missing
    }
}

/// How much of a Gaussian's colour gradient the views disagree on: the variance of Adam's moments of degree 0, which a colour
/// that depends on the direction could follow. 0 for those that have the highest degree, or were never in view.
fn ask(arena: &Arena, parameters: &Parameters, index: usize, limit: u8, scale: f32, unbias: [f32; 2]) -> f32 {
    if degree_of(parameters.geometry(arena)[index].state) >= limit {
        return 0.0;
    }
    let channel = |k: usize| {
        let m = parameters.sh_first.first(arena, index, k, scale);
        let v = parameters.sh_second.second(arena, index, k, scale);
        (v * unbias[1] - (m * unbias[0]).powi(2)).max(0.0)
    };
    let variance: f32 = (0..3).map(channel).sum();
    if variance.is_finite() { variance } else { 0.0 }
}

/// One degree more. The new coefficients are zero; their second moments start where degree 0's is, because the basis
/// functions have the same mean square over the sphere: from zero, the first steps would be several times too long.
fn raise(arena: &mut Arena, parameters: &Parameters, index: usize) {
    let g = &mut parameters.geometry_mut(arena)[index];
    let degree = degree_of(g.state) + 1;
    g.state = with_degree(g.state, degree);
    let new = sh_coefficients(degree - 1)..sh_coefficients(degree);
    parameters.sh_second.repeat_first_coefficient(arena, index, new);
}
