//! What a step costs on one device: so much fixed, and so much for each of what its stages loop over.

use config::plan::sh_columns;
use serde::{Deserialize, Serialize};
use vulkan::stages::STAGES;
use vulkan::stages::work::Load;

use crate::slopes::{DRIVERS, Driver, nonnegative};

/// SH degree of the scenes that costs are measured with; a lower one costs less.
pub const SH_DEGREE: u8 = 3;

/// The coefficients.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct CostModel {
    /// Milliseconds of every step.
    pub fixed_ms: f64,
    /// Nanoseconds per Gaussian on the device.
    pub gaussian_ns: f64,
    /// Per Gaussian in view.
    pub visible_ns: f64,
    /// Per pixel.
    pub pixel_ns: f64,
    /// Per Gaussian–tile instance.
    pub instance_ns: f64,
    /// Per Gaussian–pixel evaluation of the forward blend.
    pub evaluation_ns: f64,
}

/// A step's work and what it took.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Sample {
    /// What it worked on.
    pub load: Load,
    /// Device milliseconds per stage; zeros where the device has no timestamps.
    pub stage_ms: [f64; STAGES.len()],
    /// Milliseconds of wall clock.
    pub step_ms: f64,
}

impl CostModel {
    /// The model that comes nearest to what was measured: stage by stage, each against the one quantity it loops over, where the
    /// device tells its stages' times, else of whole steps.
    pub fn fitted(samples: &[Sample]) -> Self {
        let mut found = Self::default();
        if samples.iter().any(|s| s.stage_ms.iter().sum::<f64>() <= 0.0) {
            let rows: Vec<_> = samples.iter().map(|s| (amounts(&s.load), s.step_ms)).collect();
            found.add(nonnegative(&rows));
            return found;
        }
        for (i, stage) in STAGES.iter().enumerate() {
            let (driver, _) = Driver::of(*stage);
            let rows: Vec<_> = samples.iter().map(|s| ([1.0, driver.amount(&s.load) as f64], s.stage_ms[i])).collect();
            let [fixed, each] = nonnegative(&rows);
            let mut costs = [0.0; 1 + DRIVERS.len()];
            costs[0] = fixed;
            costs[1 + DRIVERS.iter().position(|d| *d == driver).unwrap_or(0)] = each;
            found.add(costs);
        }
        // What the host does between the stages.
        let between = |s: &Sample| (s.step_ms - s.stage_ms.iter().sum::<f64>()).max(0.0);
        found.fixed_ms += samples.iter().map(between).sum::<f64>() / samples.len().max(1) as f64;
        found
    }

    /// What lies in the middle between two, coefficient by coefficient.
    pub fn between(&self, other: &Self) -> Self {
        let mut both = Self { fixed_ms: 0.5 * (self.fixed_ms + other.fixed_ms), ..Self::default() };
        for driver in DRIVERS {
            *both.of_mut(driver) = 0.5 * (self.of(driver) + other.of(driver));
        }
        both
    }

    /// Adds a fixed time and one per driver, in milliseconds.
    fn add(&mut self, ms: [f64; 1 + DRIVERS.len()]) {
        self.fixed_ms += ms[0];
        for (driver, ms) in DRIVERS.into_iter().zip(&ms[1..]) {
            *self.of_mut(driver) += 1e6 * ms;
        }
    }

    fn of_mut(&mut self, driver: Driver) -> &mut f64 {
        match driver {
            Driver::Gaussians => &mut self.gaussian_ns,
            Driver::Visible => &mut self.visible_ns,
            Driver::Pixels => &mut self.pixel_ns,
            Driver::Instances => &mut self.instance_ns,
            Driver::Evaluations => &mut self.evaluation_ns,
        }
    }

    /// Nanoseconds per unit of `driver`.
    pub fn of(&self, driver: Driver) -> f64 {
        *self.clone().of_mut(driver)
    }

    /// Milliseconds of a step with this work.
    pub fn step_ms(&self, load: &Load) -> f64 {
        self.fixed_ms + DRIVERS.iter().map(|d| 1e-6 * self.of(*d) * d.amount(load) as f64).sum::<f64>()
    }

    /// Whether anybody could have measured it.
    pub fn is_sound(&self) -> bool {
        let all = [self.fixed_ms].into_iter().chain(DRIVERS.map(|d| self.of(d)));
        all.clone().all(|c| c.is_finite() && c >= 0.0) && all.sum::<f64>() > 0.0
    }
}

/// One, and how much of every driver there was.
fn amounts(load: &Load) -> [f64; 1 + DRIVERS.len()] {
    let mut all = [1.0; 1 + DRIVERS.len()];
    for (amount, driver) in all[1..].iter_mut().zip(DRIVERS) {
        *amount = driver.amount(load) as f64;
    }
    all
}

/// A step's work; `evaluations` of the forward blend.
pub fn load(gaussians: u64, visible: u64, instances: u64, evaluations: u64, pixels: u64) -> Load {
    Load { gaussians, visible, instances, evaluations, pixels, sh_columns: sh_columns(SH_DEGREE) }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::fixtures::{CARD, PROCESSOR};

    const LOADS: [(u64, u64, u64, u64, u64); 6] = [
        (5000, 4000, 28_000, 900_000, 27_000),
        (60_000, 46_000, 120_000, 3_800_000, 27_000),
        (5000, 4000, 77_000, 2_400_000, 110_000),
        (60_000, 46_000, 190_000, 6_000_000, 110_000),
        (20_000, 3000, 15_000, 480_000, 50_000),
        (20_000, 16_000, 55_000, 1_500_000, 12_000),
    ];

    fn samples(timed: bool) -> Vec<Sample> {
        let sample = |(gaussians, visible, instances, evaluations, pixels): (u64, u64, u64, u64, u64)| {
            let load = load(gaussians, visible, instances, evaluations, pixels);
            let mut stage_ms = [0.0; STAGES.len()];
            if timed {
                // Stages of one driver share it.
                for (ms, stage) in stage_ms.iter_mut().zip(STAGES) {
                    let (driver, _) = Driver::of(stage);
                    let sharing = STAGES.iter().filter(|s| Driver::of(**s).0 == driver).count() as f64;
                    *ms = 1e-6 * PROCESSOR.of(driver) * driver.amount(&load) as f64 / sharing;
                }
            }
            Sample { load, stage_ms, step_ms: PROCESSOR.step_ms(&load) }
        };
        LOADS.into_iter().map(sample).collect()
    }

    #[test]
    fn a_device_with_timestamps_and_one_without_are_both_forecast() {
        let larger = load(500_000, 150_000, 900_000, 28_000_000, 307_200);
        let truth = PROCESSOR.step_ms(&larger);
        for timed in [true, false] {
            let found = CostModel::fitted(&samples(timed));
            let ratio = found.step_ms(&larger) / truth;
            assert!(found.is_sound() && (ratio - 1.0).abs() < 0.05, "timed {timed}: {ratio} {found:?}");
        }
    }

    #[test]
    fn what_nobody_could_have_measured_is_not_sound() {
        assert!(PROCESSOR.is_sound() && CARD.is_sound());
        let bad = [f64::NAN, f64::INFINITY, -1.0].map(|pixel_ns| CostModel { pixel_ns, ..PROCESSOR });
        assert!(bad.iter().chain([&CostModel::default()]).all(|model| !model.is_sound()));
        assert!(!CostModel::fitted(&[]).is_sound());
    }
}
