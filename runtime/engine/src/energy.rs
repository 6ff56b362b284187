//! A schedule that ends with the energy it may take: seconds that change with what the board takes.

use config::training::TrainSettings;
use job::health::power::Power;

use crate::error::EngineError;

/// Power is read this often, seconds of training.
pub(super) const EVERY_S: f64 = 1.0;
const JOULES_PER_WH: f64 = 3600.0;

/// What a schedule has taken, and may take.
#[derive(Debug)]
pub struct Meter {
    power: Power,
    allowed_j: f64,
    used_j: f64,
    /// Seconds of the schedule at the last reading, and what it said, watts.
    read_s: f64,
    watts: f64,
}

impl Meter {
    /// Of `training.energy_wh`; `None` where nobody asks.
    ///
    /// # Errors
    /// Neither the board nor `training.watts` says what is taken.
    pub fn of(training: &TrainSettings) -> Result<Option<Self>, EngineError> {
        let meter = |wh| Self::new(Power::new(training.watts), wh);
        training.energy_wh.map(meter).transpose()
    }

    fn new(power: Power, wh: f64) -> Result<Self, EngineError> {
        let Some(watts) = power.watts() else {
            let what = "[training] energy_wh: this computer does not say what it takes (no power monitor in hwmon, no vcgencmd); \
                        say it with --watts or [training] watts, or give --seconds instead";
            return Err(EngineError::Request(what.into()));
        };
        Ok(Self { power, allowed_j: wh * JOULES_PER_WH, used_j: 0.0, read_s: 0.0, watts })
    }

    /// Seconds of the whole schedule as things are, after `spent_s` of it.
    pub(super) fn read(&mut self, spent_s: f64) -> f64 {
        if spent_s < self.read_s {
            // Another schedule began.
            (self.used_j, self.read_s) = (0.0, 0.0);
        }
        let now = self.power.watts().unwrap_or(self.watts);
        self.used_j += 0.5 * (self.watts + now) * (spent_s - self.read_s);
        (self.read_s, self.watts) = (spent_s, now);
        spent_s + (self.allowed_j - self.used_j).max(0.0) / now
    }

    /// Seconds that the energy lasts, before anything is trained.
    pub fn seconds(&self) -> f64 {
        self.allowed_j / self.watts
    }

    /// Watt-hours that the schedule has taken.
    pub(super) fn used_wh(&self) -> f64 {
        self.used_j / JOULES_PER_WH
    }
}

/// Of two bounds the one that is nearer.
pub fn shorter(a: Option<f64>, b: Option<f64>) -> Option<f64> {
    a.into_iter().chain(b).reduce(f64::min)
}

#[cfg(test)]
mod tests {
    use std::ops::ControlFlow;
    use std::path::Path;

    use vulkan::gpu::Gpu;
    use vulkan::trainer::{RunBudget, StepReport, StopReason};

    use super::*;
    use crate::testing::{picture, settings};
    use crate::{EngineSettings, Reconstruct, Reconstruction};

    /// A board whose power monitor can be set.
    fn board() -> (tempfile::TempDir, impl Fn(&Path, f64)) {
        let sys = tempfile::tempdir().expect("a folder");
        let set = |sys: &Path, watts: f64| {
            let monitor = sys.join("class/hwmon/hwmon0");
            std::fs::create_dir_all(&monitor).expect("a folder");
            std::fs::write(monitor.join("power1_input"), format!("{}\n", (watts * 1e6) as u64)).expect("written");
        };
        (sys, set)
    }

    #[test]
    fn a_schedule_gets_shorter_while_the_board_takes_more_and_begins_anew_with_another() {
        let (sys, set) = board();
        set(sys.path(), 10.0);
        let mut meter = Meter::new(Power::with_sensors(sys.path(), None), 0.1).expect("it says what it takes");
        assert_eq!((meter.seconds(), meter.read(0.0)), (36.0, 36.0));
        assert_eq!(meter.read(6.0), 36.0);
        // 300 J are left; at 20 W they last 15 s, and from 10 to 20 W a second takes 15 J.
        set(sys.path(), 20.0);
        assert_eq!(meter.read(7.0), 7.0 + (300.0 - 15.0) / 20.0);
        assert!((meter.used_wh() - 75.0 / 3600.0).abs() < 1e-12);
        // A monitor that falls silent: the last reading holds.
        std::fs::remove_dir_all(sys.path().join("class")).expect("removed");
        assert_eq!(meter.read(21.25), 21.25);
        assert_eq!(meter.read(40.0), 40.0, "over");
        assert_eq!(meter.read(2.0), 2.0 + (360.0 - 40.0) / 20.0, "another schedule");
    }

    #[test]
    fn a_board_that_does_not_say_what_it_takes_is_refused_with_what_to_do() {
        let error = Meter::new(Power::with_sensors(Path::new("/nonexistent"), None), 1.0).expect_err("it does not");
        assert!(error.to_string().contains("--watts"), "{error}");
        assert!(Meter::of(&TrainSettings::default()).expect("nobody asks").is_none());
    }

    #[test]
    fn of_two_bounds_the_nearer_one_holds() {
        assert_eq!(shorter(None, None), None);
        assert_eq!(shorter(Some(3.0), None), Some(3.0));
        assert_eq!(shorter(Some(3.0), Some(2.0)), Some(2.0));
    }

    #[test]
    fn training_ends_with_its_energy() {
        if Gpu::list().is_err() {
            needs::missing(needs::Need::Vulkan, "no Vulkan device (install mesa-vulkan-drivers)");
            return;
        }
        let mut settings = EngineSettings { ..settings() };
        settings.training.steps = config::training::MOST_STEPS;
        // Two and a half seconds of it.
        (settings.training.energy_wh, settings.training.watts) = (Some(25.0 / 3600.0), Some(10.0));
        let mut engine = Reconstruction::open(settings, Default::default(), "train").expect("opens");
        (0..3).for_each(|i| engine.add(picture(i), i < 2).expect("taken"));
        assert!(engine.build(&|| false).expect("built"));
        let budget = RunBudget { steps: None, seconds: None };
        let mut progress = 0.0;
        let mut each = |step: &StepReport| {
            progress = step.progress;
            ControlFlow::Continue(())
        };
        assert_eq!(engine.train(&budget, &mut each).expect("trains"), StopReason::Schedule);
        let used = engine.report.more["energy_wh"].as_f64().expect("a number");
        assert!(progress > 0.9 && used > 0.9 * 25.0 / 3600.0, "{progress} of the schedule, {used} Wh");
    }
}
