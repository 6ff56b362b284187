//! Each Gaussian's own SH degree: how many of its coefficients are evaluated, stepped and moved through memory. It is
//! raised, one degree at a time, where the residual asks for it: where a Gaussian's colour is pulled one way by some
//! views and another way by others.

use super::parameters::{Geometry, Parameters};
use super::state::{degree_of, with_degree};
use crate::arena::Arena;
use crate::device::Device;
use config::plan::Plan;
use models::cloud::sh_coefficients;

/// Progress from which the next raise is due, one after the other.
const OCCASIONS: [f32; 6] = [0.05, 0.1, 0.2, 0.3, 0.4, 0.5];

/// Room for the ranking, allocated once, and how many raises are over.
pub(super) struct Degrees {
    asks: Vec<f32>,
    ranked: Vec<f32>,
    raises: usize,
    /// Coefficients (of three numbers) that Gaussians could have and have not.
    pub missing: u64,
}

impl Degrees {
    pub fn new(capacity: usize) -> Self {
        Self { asks: Vec::with_capacity(capacity), ranked: Vec::with_capacity(capacity), raises: 0, missing: 0 }
    }

    pub fn reset(&mut self) {
        (self.raises, self.missing) = (0, 0);
    }
}

/// What a raise goes by.
pub(super) struct Asking {
    /// Gaussians on the device.
    pub of: usize,
    /// Share of them that is raised at most.
    pub share: f32,
    /// The highest degree.
    pub limit: u8,
    /// What first and second moments are multiplied by.
    pub unbias: [f32; 2],
}

impl Degrees {
    /// Whether an occasion has come since the last raise; it is taken then.
    pub fn is_due(&mut self, progress: f32) -> bool {
        let due = OCCASIONS.iter().take_while(|p| progress >= **p).count();
        let is_due = due > self.raises;
        self.raises = due.max(self.raises);
        is_due
    }

    /// Raises the degree of those that ask most; returns of how many.
    pub fn raise(&mut self, device: &mut Device, parameters: &Parameters, asking: &Asking) -> u64 {
        let Self { asks, ranked, .. } = self;
        let Asking { of: n, share, limit, unbias } = *asking;
        asks.clear();
        let scale = device.frame.moment_scale;
        asks.extend((0..n).map(|i| ask(&device.arena, parameters, i, limit, scale, unbias)));
        ranked.clear();
        ranked.extend_from_slice(asks);
        let raised = ((n as f32 * share) as usize).min(n.saturating_sub(1));
        let (_, least, _) = ranked.select_nth_unstable_by(raised, |a, b| b.total_cmp(a));
        // No one is raised for asking more than others where all ask about the same.
        let mean = asks.iter().map(|a| f64::from(*a)).sum::<f64>() / n.max(1) as f64;
        let least = least.max(mean as f32);
        let mut count = 0;
        for index in (0..n).filter(|index| asks[*index] > least) {
            raise(&mut device.arena, parameters, index);
            count += 1;
        }
        count
    }

    pub fn count_missing(&mut self, geometry: &[Geometry], plan: &Plan) {
        let most = sh_coefficients(plan.sh_degree);
        let missing = |state: f32| (most - sh_coefficients(degree_of(state)).min(most)) as u64;
        self.missing = geometry.iter().map(|g| missing(g.state)).sum();
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
