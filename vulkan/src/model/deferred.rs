//! The table of lazy Adam updates: what the steps amount to that a Gaussian missed outside the view.
//!
//! With a zero gradient the moments only decay: m β₁ᵏ, v β₂ᵏ, so the step j after it was last in view moves a parameter by
//! (m/√v) · rʲ κ_s with r = β₁/√β₂ and κ_s = rate · √(1−β₂ˢ)/(1−β₁ˢ) (ε = 1e-15 left out). Their sum depends only on
//! how many steps were missed and when, not on the Gaussian: one table serves all.

use crate::layout::{DEFERRED_STEPS, MissedSteps};
use config::training::AdamSettings;

pub(crate) struct Deferred {
    /// Per number of missed steps k: sum with the means' rate, sum with rate one.
    sums: Vec<[f64; 2]>,
    ratio_powers: Vec<f64>,
    beta1: f64,
    beta2: f64,
}

impl Deferred {
    pub fn new(adam: &AdamSettings) -> Self {
        let (beta1, beta2) = (f64::from(adam.beta1), f64::from(adam.beta2));
        let r = beta1 / beta2.sqrt();
        Self {
            sums: vec![[0.0; 2]; DEFERRED_STEPS],
            ratio_powers: (0..DEFERRED_STEPS).map(|k| r.powi(k as i32)).collect(),
            beta1,
            beta2,
        }
    }

    pub fn reset(&mut self) {
        self.sums.fill([0.0; 2]);
    }

    /// Step `t` (from 1) was taken with this rate of the means, all rates multiplied by `decay`.
    pub fn push(&mut self, t: u32, mean_rate: f32, decay: f32) {
        let unit = f64::from(decay) * (1.0 - self.beta2.powi(t as i32)).sqrt() / (1.0 - self.beta1.powi(t as i32));
        for k in (1..DEFERRED_STEPS).rev() {
            let last = self.ratio_powers[k] * unit;
            let before = self.sums[k - 1];
            self.sums[k] = [before[0] + last * f64::from(mean_rate), before[1] + last];
        }
    }

    /// Writes the table the shaders read.
    pub fn write(&self, table: &mut [MissedSteps; DEFERRED_STEPS]) {
        let (mut decay1, mut decay2) = (1.0f64, 1.0f64);
        for (entry, sums) in table.iter_mut().zip(&self.sums) {
            let [mean, unit] = sums.map(|s| s as f32);
            *entry = MissedSteps { mean, unit, first_decay: decay1 as f32, second_decay: decay2 as f32 };
            decay1 *= self.beta1;
            decay2 *= self.beta2;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use bytemuck::Zeroable;

    #[test]
    fn the_table_equals_dense_adam_with_zero_gradients() {
        let adam = AdamSettings::default();
        let mut deferred = Deferred::new(&adam);
        let rate = |s: u32| 1e-3 * 0.99f64.powi(s as i32);
        let (mut p, mut m, mut v) = (0.0f64, 0.7e-4, 0.3e-6);
        let (seen, now) = (17u32, 60u32);
        for s in 1..=now {
            deferred.push(s, rate(s) as f32, 1.0);
            if s > seen {
                m *= f64::from(adam.beta1);
                v *= f64::from(adam.beta2);
                let (b1, b2) = (f64::from(adam.beta1), f64::from(adam.beta2));
                p -= rate(s) * (m / (1.0 - b1.powi(s as i32))) / ((v / (1.0 - b2.powi(s as i32))).sqrt() + 1e-15);
            }
        }
        let mut table = [MissedSteps::zeroed(); DEFERRED_STEPS];
        deferred.write(&mut table);
        let k = (now - seen) as usize;
        let lazy = -0.7e-4 / 0.3e-6f64.sqrt() * f64::from(table[k].mean);
        assert!((lazy - p).abs() < 1e-6 * p.abs(), "{lazy} {p}");
        assert!((f64::from(table[k].first_decay) * 0.7e-4 - m).abs() < 1e-6 * m);
        assert!((f64::from(table[k].second_decay) * 0.3e-6 - v).abs() < 1e-6 * v);
    }
}
