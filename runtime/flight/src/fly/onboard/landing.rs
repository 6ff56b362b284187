//! After the flight: the last build, crops, the rest of the schedule, and the model that remains.

use std::ops::ControlFlow;
use std::time::Duration;

use engine::{Reconstruct, model_path};
use hal::failsafe::{Cause, Flags};
use hal::traits::Clock;
use job::interrupt::Interrupt;
use uplink::heartbeat::Condition;
use vulkan::trainer::{RunBudget, StepReport, StopReason};

use super::{CHECKPOINT_EVERY_NS, Handover, Job, JobEnd};
use crate::error::FlightError;
use crate::fly::intake::FlightCounters;
use crate::fly::shortage::likely_cause;

impl<R: Reconstruct, K: Clock> Job<R, K> {
    /// After capture, which counted `flight`: the last build, the rest of the schedule, and the model that remains.
    ///
    /// # Errors
    /// The device fails before there was a checkpoint; there are too few key frames for a model.
    pub(in crate::fly) fn land(
        mut self,
        capture: &mut Handover,
        flight: &FlightCounters,
        interrupt: &Interrupt,
    ) -> Result<JobEnd<R>, FlightError> {
        let covered_pct = flight.coverage.as_ref().map(|coverage| coverage.percent().min(100) as u8);
        self.offerer.say(Condition { landed: true, link_lost: false, covered_pct, ..capture.condition() });
        if !self.training_failed {
            let finished = self.finish_schedule(capture, interrupt);
            self.survive(finished)?;
        }
        let before = (model_path(&self.out), self.reconstruction.gaussians());
        if !self.reconstruction.has_model() && interrupt.requested() && before.0.is_file() {
            // Stopped before everything was taken up again: the checkpoint stays as it is.
            let (reconstruction, offerer, (model, gaussians)) = (self.reconstruction, self.offerer, before);
            return Ok(JobEnd {
                reconstruction,
                offerer,
                supervisor: self.supervisor,
                model,
                gaussians,
                finished: false,
            });
        }
        if !self.reconstruction.has_model() {
            let keyframes = self.reconstruction.keyframes();
            return Err(FlightError::TooFewKeyframes { keyframes, cause: likely_cause(flight) });
        }
        let state = self.failsafe.state();
        let spared = state.forbids_training();
        if spared {
            let cause = state.cause().map_or("", Cause::name);
            tracing::warn!("{cause}: the rest of the training is left; the same command continues it later");
        }
        let mut finished = !interrupt.requested() && !self.training_failed && !spared;
        let (model, gaussians) = if self.training_failed {
            before
        } else {
            match self.checkpoint(capture, finished) {
                Err(e) if e.may_pass() && before.0.is_file() => {
                    tracing::error!("{e}; the last checkpoint is kept, make room and give the same command again");
                    finished = false;
                    before
                }
                other => other?,
            }
        };
        self.show(if finished { "trained" } else { "stopped with a checkpoint" });
        if finished {
            self.offerer.offer_final(&model);
        } else {
            self.offerer.offer(&model);
        }
        let Self { reconstruction, offerer, supervisor, .. } = self;
        Ok(JobEnd { reconstruction, offerer, supervisor, model, gaussians, finished })
    }

    fn finish_schedule(&mut self, capture: &mut Handover, interrupt: &Interrupt) -> Result<(), FlightError> {
        self.reconstruction.land();
        if self.reconstruction.wants_build(true) && !interrupt.requested() {
            self.build(capture)?;
        }
        if !self.reconstruction.has_model() {
            return Ok(());
        }
        if !interrupt.requested() && !self.failsafe.state().forbids_training() {
            let supervisor = &self.supervisor;
            let cancelled = || {
                supervisor.alive();
                interrupt.requested()
            };
            self.reconstruction.look_closer(capture, &cancelled)?;
        }
        // What the autopilot said last of its battery holds; the rest of what the HAL saw ended with the flight, and there
        // is no flight's time any more that training could be behind.
        let seen = Flags { battery_low: capture.flags().battery_low, ..Flags::default() };
        let (at_leisure, views) = (RunBudget { seconds: None, ..self.budget }, self.reconstruction.keyframes());
        let mut progress = job::console::Progress::new("training", 100);
        // When this training began, and how much of the schedule was behind it then.
        let (began, mut behind) = (self.clock.now_ns(), None);
        while !self.reconstruction.is_done(&self.budget)
            && !interrupt.requested()
            && !self.failsafe.state().forbids_training()
        {
            let due_ns = self.saved_ns + CHECKPOINT_EVERY_NS;
            self.show("training after the flight");
            let (clock, failsafe, supervisor) = (&self.clock, &mut self.failsafe, &self.supervisor);
            let offerer = &self.offerer;
            let shown = &mut self.shown;
            let reason = self.reconstruction.train(&self.budget, &mut |r: &StepReport| {
                supervisor.alive();
                shown.step(r);
                progress.set((r.progress * 100.0) as u64, || {
                    format!("step {}, loss {:.4}, {} Gaussians", r.step, r.loss, r.gaussians)
                });
                let now_ns = clock.now_ns();
                let first = *behind.get_or_insert(r.progress);
                offerer.expect_last(left(Duration::from_nanos(now_ns.saturating_sub(began)), [first, r.progress]));
                let alarmed = failsafe.glance(now_ns, seen, &at_leisure, views);
                // Only where saving leaves no trace, as in any training.
                let pause = interrupt.requested() || alarmed || (now_ns >= due_ns && r.settled);
                if pause { ControlFlow::Break(()) } else { ControlFlow::Continue(()) }
            })?;
            self.act(capture)?;
            if reason != StopReason::Caller || interrupt.requested() {
                break;
            }
            if self.clock.now_ns() >= due_ns {
                self.save(capture)?;
            }
        }
        Ok(())
    }
}

/// Time that the rest of a schedule will take if it goes on as fast as from `first` to `now`, in which `trained` has passed.
fn left(trained: Duration, [first, now]: [f32; 2]) -> Duration {
    let share = f64::from(1.0 - now) / f64::from(now - first);
    Duration::try_from_secs_f64(trained.as_secs_f64() * share.max(0.0)).unwrap_or(Duration::MAX)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_left_of_a_schedule_is_estimated_from_its_pace() {
        let minute = Duration::from_secs(60);
        assert_eq!(left(minute, [0.25, 0.5]), 2 * minute);
        assert_eq!(left(minute, [0.0, 1.0]), Duration::ZERO);
        assert_eq!(left(minute, [0.5, 0.5]), Duration::MAX, "nothing is known yet");
        assert_eq!(left(minute, [1.0, 1.0]), Duration::ZERO, "nothing is left");
    }
}
