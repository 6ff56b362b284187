//! Training in slices: to the goal, with a checkpoint from time to time, and with rests where the computer needs them.

use std::ops::ControlFlow;
use std::time::Duration;

use engine::Reconstruct;
use engine::failsafe::Failsafe;
use hal::failsafe::{Action, Flags};
use hal::traits::Clock;
use job::console::Progress;
use job::interrupt::Interrupt;
use vulkan::trainer::{RunBudget, StopReason};

use crate::error::JobError;

/// While training rests, its cause is looked at this often.
pub(super) const REST: Duration = Duration::from_secs(1);

/// How training is cut, and what it heeds.
pub(super) struct Slices<K> {
    pub(super) budget: RunBudget,
    pub(super) checkpoint_every: Duration,
    /// Steps of earlier processes, for what is said at the end.
    pub(super) steps_before: u64,
    /// `None`: whatever the computer says.
    pub(super) failsafe: Option<Failsafe>,
    pub(super) clock: K,
    pub(super) rest: Duration,
}

/// Writes the model; whether the goal is reached.
type Save<'a, R> = &'a mut dyn FnMut(&mut R, bool) -> Result<(), JobError>;

impl<K: Clock> Slices<K> {
    /// Trains to the goal; false when asked to stop before it.
    pub(super) fn run<R: Reconstruct>(
        mut self,
        engine: &mut R,
        stop: &Interrupt,
        save: Save<'_, R>,
    ) -> Result<bool, JobError> {
        let Self { budget, steps_before, .. } = self;
        let views = engine.keyframes();
        // There is no flight's time that training could be behind.
        let at_leisure = RunBudget { seconds: None, ..budget };
        let goal = u64::from(budget.steps.unwrap_or(100));
        let mut progress = Progress::new("training", goal);
        let every_ns = u64::try_from(self.checkpoint_every.as_nanos()).unwrap_or(u64::MAX);
        let mut due_ns = self.clock.now_ns().saturating_add(every_ns);
        let (mut steps, mut last, mut words) = (steps_before, 0, String::new());
        loop {
            let mut alarmed = false;
            let (clock, failsafe) = (&self.clock, &mut self.failsafe);
            let reason = engine.train(&budget, &mut |step| {
                // A step of a scene larger than the device takes several updates.
                steps += u64::from(std::mem::replace(&mut last, step.step) != step.step);
                let at = (f64::from(step.progress) * goal as f64).round() as u64;
                progress.set(at, || format!("loss {:.4}, {} Gaussians", step.loss, step.gaussians));
                words = format!("loss {:.4}", step.loss);
                let now_ns = clock.now_ns();
                alarmed = failsafe.as_mut().is_some_and(|f| f.glance(now_ns, Flags::default(), &at_leisure, views));
                // Only where saving leaves no trace: the same seed gives the same bytes however slow the machine is.
                if stop.requested() || alarmed || (step.settled && now_ns >= due_ns) {
                    ControlFlow::Break(())
                } else {
                    ControlFlow::Continue(())
                }
            })?;
            let over = reason != StopReason::Caller;
            if over || stop.requested() {
                save(engine, over)?;
                progress.finish(&format!("{steps} steps, {words}, {} Gaussians", engine.gaussians()));
                return Ok(over);
            }
            if alarmed {
                self.spare(engine, stop, save)?;
            } else {
                save(engine, false)?;
                due_ns = self.clock.now_ns().saturating_add(every_ns);
            }
        }
    }

    /// Does what the failsafe ladder asks for; where that is no training, saves the model and waits until it may go on.
    fn spare<R: Reconstruct>(&mut self, engine: &mut R, stop: &Interrupt, save: Save<'_, R>) -> Result<(), JobError> {
        let Some(failsafe) = &mut self.failsafe else { return Ok(()) };
        let mut saved = false;
        loop {
            if let Some(rung) = failsafe.act(engine)? {
                tracing::warn!("{rung}");
            }
            if failsafe.state().action() < Action::StopTraining || stop.requested() {
                return Ok(());
            }
            if !std::mem::replace(&mut saved, true) {
                save(engine, false)?;
            }
            std::thread::sleep(self.rest);
            let views = engine.keyframes();
            let nothing = RunBudget { steps: None, seconds: None };
            failsafe.look(self.clock.now_ns(), Flags::default(), false, &nothing, views);
        }
    }
}

#[cfg(test)]
mod tests {
    use std::cell::Cell;
    use std::path::{Path, PathBuf};

    use config::failsafe::FailsafeSettings;
    use models::camera::{Pose, PosedImage};
    use vulkan::trainer::StepReport;

    use super::*;
    use job::health::Health;

    /// A second a step.
    #[derive(Default)]
    struct Seconds(Cell<u64>);

    impl Clock for &Seconds {
        fn now_ns(&self) -> u64 {
            self.0.set(self.0.get() + 1_000_000_000);
            self.0.get()
        }
    }

    /// Steps on a computer whose temperature follows a script.
    struct Warming<'a> {
        zone: PathBuf,
        script: &'a [(u32, &'a str)],
        steps: u32,
        halved: Vec<bool>,
    }

    impl Reconstruct for Warming<'_> {
        fn add(&mut self, _: PosedImage, _: bool) -> Result<(), engine::error::EngineError> {
            Ok(())
        }

        fn keyframes(&self) -> usize {
            1
        }

        fn pose(&self, _: &str) -> Option<Pose> {
            None
        }

        fn wants_build(&self, _: bool) -> bool {
            false
        }

        fn has_model(&self) -> bool {
            true
        }

        fn build(&mut self, _: &dyn Fn() -> bool) -> Result<bool, engine::error::EngineError> {
            Ok(true)
        }

        fn set_seconds(&mut self, _seconds: Option<f64>) {}

        fn is_done(&self, budget: &RunBudget) -> bool {
            budget.steps.is_some_and(|s| self.steps >= s)
        }

        fn train(
            &mut self,
            budget: &RunBudget,
            each: &mut dyn FnMut(&StepReport) -> ControlFlow<()>,
        ) -> Result<StopReason, engine::error::EngineError> {
            while !self.is_done(budget) {
                self.steps += 1;
                if let Some((_, temperature)) = self.script.iter().find(|s| s.0 == self.steps) {
                    std::fs::write(&self.zone, temperature).expect("written");
                }
                let report = StepReport { step: self.steps, settled: true, ..StepReport::default() };
                if each(&report).is_break() {
                    return Ok(StopReason::Caller);
                }
            }
            Ok(StopReason::Schedule)
        }

        fn halve_resolution(&mut self, on: bool) {
            self.halved.push(on);
        }

        fn shrink(&mut self) -> Result<(), engine::error::EngineError> {
            Ok(())
        }

        fn gaussians(&self) -> usize {
            0
        }

        fn checkpoint(&mut self, _: &Path, _: bool) -> Result<(PathBuf, usize), engine::error::EngineError> {
            Ok((PathBuf::new(), 0))
        }
    }

    #[test]
    fn a_warm_computer_trains_at_half_size_and_a_hot_one_saves_rests_and_goes_on() {
        let sys = tempfile::tempdir().expect("a folder");
        let zone = sys.path().join("class/thermal/thermal_zone0/temp");
        std::fs::create_dir_all(zone.parent().expect("a parent")).expect("a folder");
        std::fs::write(&zone, "50000").expect("written");
        let limits = FailsafeSettings { disk_low_mib: 0, ..FailsafeSettings::default() };
        let health = Health::with_sensors(sys.path(), limits, u32::MAX, sys.path());
        let clock = Seconds::default();
        let mut engine = Warming {
            zone: zone.clone(),
            script: &[(10, "85000"), (40, "50000"), (80, "95000")],
            steps: 0,
            halved: Vec::new(),
        };
        let slices = Slices {
            budget: RunBudget { steps: Some(120), seconds: None },
            checkpoint_every: Duration::from_secs(100_000),
            steps_before: 0,
            failsafe: Some(Failsafe::new(health, &limits)),
            clock: &clock,
            rest: Duration::ZERO,
        };
        let mut saved = Vec::new();
        let done = slices.run(&mut engine, &Interrupt::default(), &mut |engine, over| {
            saved.push((engine.steps, over));
            // It cools down while it rests.
            std::fs::write(&zone, "50000").expect("written");
            Ok(())
        });
        assert!(done.expect("trains"));
        assert_eq!(engine.halved, [true, false, false], "warm, cool again, cool after the rest");
        let [(rested_at, false), (120, true)] = saved[..] else { panic!("{saved:?}") };
        assert!((80..90).contains(&rested_at), "{rested_at}");
    }

    #[test]
    fn without_the_failsafe_nothing_is_looked_at() {
        let clock = Seconds::default();
        let mut engine = Warming { zone: PathBuf::new(), script: &[], steps: 0, halved: Vec::new() };
        let slices = Slices {
            budget: RunBudget { steps: Some(50), seconds: None },
            checkpoint_every: Duration::from_secs(20),
            steps_before: 0,
            failsafe: None,
            clock: &clock,
            rest: Duration::ZERO,
        };
        let mut saved = 0;
        assert!(
            slices
                .run(&mut engine, &Interrupt::default(), &mut |_, _| {
                    saved += 1;
                    Ok(())
                })
                .expect("trains")
        );
        assert!(engine.halved.is_empty() && (2..=4).contains(&saved), "{saved}");
    }
}
