//! The companion's own state as flags of the failsafe ladder, beside those of the HAL: temperature, supply, clock, memory, disk,
//! and whether training keeps its time budget.

pub mod board;
pub mod power;

use std::path::{Path, PathBuf};

use config::failsafe::FailsafeSettings;
use hal::failsafe::Flags;
use vulkan::trainer::{RunBudget, StepReport};

use crate::resources;
use board::Board;

/// Steps after which the pace of training is believed.
const PACE_STEPS: u32 = 5;

/// Reads the flags; keeps nothing but where to look.
pub struct Health {
    board: Board,
    host_bytes: u64,
    /// Whose file system must not run full.
    out: PathBuf,
    limits: FailsafeSettings,
    pace: Pace,
}

/// How fast training goes since its schedule began.
#[derive(Clone, Copy, Debug, Default)]
struct Pace {
    from: Option<(u32, f64)>,
    step_s: Option<f64>,
}

impl Pace {
    /// The schedule stands at `step` after `elapsed_s` seconds of training.
    fn note(&mut self, step: u32, elapsed_s: f64) {
        match self.from {
            Some((before, _)) if step >= before.saturating_add(PACE_STEPS) => {
                self.step_s = self.from.map(|(b, since_s)| (elapsed_s - since_s) / f64::from(step - b));
                self.from = Some((step, elapsed_s));
            }
            Some((before, _)) if step >= before => {}
            // A new schedule.
            _ => *self = Self { from: Some((step, elapsed_s)), step_s: None },
        }
    }

    /// Visits each of `views` gets within `seconds` of training; `None` before the pace is known.
    fn visits(&self, seconds: f64, views: usize) -> Option<f64> {
        let step_s = self.step_s.filter(|s| *s > 0.0)?;
        (views > 0).then(|| seconds / step_s / views as f64)
    }
}

impl Health {
    /// Looks for the board's sensors; `host_mib` is the mission's bound on resident memory, `out` where the job writes.
    pub fn new(limits: FailsafeSettings, host_mib: u32, out: &Path) -> Self {
        Self::with_sensors(Path::new("/sys"), limits, host_mib, out)
    }

    /// As [`Health::new`], with the sensors below `sys`; a folder without any changes nothing.
    pub fn with_sensors(sys: &Path, limits: FailsafeSettings, host_mib: u32, out: &Path) -> Self {
        let host_bytes = u64::from(host_mib) << 20;
        Self { board: Board::find(sys), host_bytes, out: out.into(), limits, pace: Pace::default() }
    }

    /// Training reported a step.
    pub fn note_step(&mut self, report: &StepReport) {
        self.pace.note(report.step, report.elapsed_s);
    }

    /// What is seen now: `seen` by the HAL, and here. `views` are trained on within `budget`.
    pub fn flags(&self, seen: Flags, training_failed: bool, budget: &RunBudget, views: usize) -> Flags {
        let (board, limits) = (self.board.read(), &self.limits);
        let hotter = |limit: f32| board.hottest_c.is_some_and(|t| t >= limit);
        let rss = resources::rss_bytes().unwrap_or(0);
        let free = resources::free_disk_bytes(&self.out);
        let visits = budget.seconds.and_then(|seconds| self.pace.visits(seconds, views));
        let fewer = |limit: f32| visits.is_some_and(|v| v < f64::from(limit));
        Flags {
            hot: hotter(limits.hot_c),
            very_hot: hotter(limits.very_hot_c),
            throttled: board.throttled,
            under_voltage: board.under_voltage,
            memory_low: rss as f64 > f64::from(limits.memory_share) * self.host_bytes as f64,
            disk_low: free.is_some_and(|bytes| bytes < u64::from(limits.disk_low_mib) << 20),
            behind: fewer(limits.behind_visits),
            far_behind: fewer(limits.far_behind_visits),
            training_failed,
            ..seen
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const NO_BUDGET: RunBudget = RunBudget { steps: None, seconds: None };

    fn health(limits: FailsafeSettings, host_mib: u32) -> Health {
        Health::with_sensors(Path::new("/nonexistent"), limits, host_mib, Path::new("."))
    }

    #[test]
    fn a_small_host_budget_is_flagged_beside_what_the_hal_saw() {
        let seen = Flags { battery_low: true, ..Flags::default() };
        let limits = FailsafeSettings { disk_low_mib: 0, ..FailsafeSettings::default() };
        let flags = health(limits, 1).flags(seen, true, &NO_BUDGET, 0);
        assert!(flags.memory_low && flags.battery_low && flags.training_failed && !flags.link_lost);
        assert_eq!(health(limits, 1 << 20).flags(Flags::default(), false, &NO_BUDGET, 0), Flags::default());
    }

    #[test]
    fn a_disk_with_less_room_than_the_mission_asks_for_is_flagged() {
        let limits = FailsafeSettings { disk_low_mib: u32::MAX, ..FailsafeSettings::default() };
        assert!(health(limits, 1 << 20).flags(Flags::default(), false, &NO_BUDGET, 0).disk_low);
    }

    #[test]
    fn training_that_cannot_visit_every_view_often_enough_in_its_time_is_behind() {
        let limits = FailsafeSettings { disk_low_mib: 0, ..FailsafeSettings::default() };
        let mut health = health(limits, 1 << 20);
        let budget = RunBudget { steps: None, seconds: Some(120.0) };
        let flags = |health: &Health| {
            let f = health.flags(Flags::default(), false, &budget, 40);
            (f.behind, f.far_behind)
        };
        assert_eq!(flags(&health), (false, false), "nothing is known yet");
        // Steps of 1 s: three visits of 40 views in 120 s.
        (0..=10).for_each(|i| health.pace.note(i, f64::from(i)));
        assert_eq!(flags(&health), (false, false));
        // Of 2 s: one and a half.
        (10..=20).for_each(|i| health.pace.note(i, 10.0 + 2.0 * f64::from(i - 10)));
        assert_eq!(flags(&health), (true, false));
        (20..=30).for_each(|i| health.pace.note(i, 30.0 + 4.0 * f64::from(i - 20)));
        assert_eq!(flags(&health), (true, true));
        health.pace.note(1, 0.1);
        assert_eq!(flags(&health), (false, false), "a new schedule has no pace yet");
    }
}
