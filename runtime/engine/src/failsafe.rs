//! The failsafe ladder of a training: what the computer and, in flight, the HAL see decides on a rung, and the rung is acted
//! on in the engine. A flight always has one; `dgtr train --failsafe` has the same.

use std::fmt;

use config::failsafe::FailsafeSettings;
use hal::failsafe::{self, Action, Cause, Flags, State};
use job::health::Health;
use vulkan::trainer::{RunBudget, StepReport};

use crate::Reconstruct;
use crate::error::EngineError;

/// In the middle of training the flags are read this often.
const LOOK_EVERY_NS: u64 = 1_000_000_000;

/// Where the ladder stands, and what it has already led to.
pub struct Failsafe {
    health: Health,
    state: State,
    acted_on: Action,
    looked_ns: Option<u64>,
}

/// A rung that was climbed to, up or down.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Rung {
    /// What is done.
    pub action: Action,
    /// Whether it is worse than the one before.
    pub is_worse: bool,
    cause: Option<Cause>,
}

impl fmt::Display for Rung {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{} ({})", self.action.name(), self.cause.map_or("recovered", Cause::name))
    }
}

impl Failsafe {
    /// At the foot of the ladder.
    pub fn new(health: Health, settings: &FailsafeSettings) -> Self {
        Self { health, state: State::new(settings.into()), acted_on: Action::Nominal, looked_ns: None }
    }

    /// Training reported a step.
    pub fn note_step(&mut self, report: &StepReport) {
        self.health.note_step(report);
    }

    /// Decides anew, by what the HAL has `seen` and the computer says; `views` are trained on within `budget`.
    pub fn look(&mut self, now_ns: u64, seen: Flags, training_failed: bool, budget: &RunBudget, views: usize) {
        self.looked_ns = Some(now_ns);
        let flags = self.health.flags(seen, training_failed, budget, views);
        self.state = failsafe::update(now_ns / 1_000_000, &self.state, &flags);
    }

    /// [`Failsafe::look`] for the middle of training: once a second. True when there is something to act on.
    pub fn glance(&mut self, now_ns: u64, seen: Flags, budget: &RunBudget, views: usize) -> bool {
        if self.looked_ns.is_none_or(|at| now_ns.saturating_sub(at) >= LOOK_EVERY_NS) {
            self.look(now_ns, seen, false, budget, views);
        }
        self.state.action() != self.acted_on
    }

    /// Does in the engine what a new rung asks for, and says which one it is.
    ///
    /// # Errors
    /// The device fails.
    pub fn act<R: Reconstruct>(&mut self, engine: &mut R) -> Result<Option<Rung>, EngineError> {
        let action = self.state.action();
        if action == self.acted_on {
            return Ok(None);
        }
        let rung = Rung { action, is_worse: action > self.acted_on, cause: self.state.cause() };
        self.acted_on = action;
        match action {
            Action::HalfResolution => engine.halve_resolution(true),
            Action::SmallerModel if engine.has_model() => engine.shrink()?,
            Action::Nominal | Action::Warn => engine.halve_resolution(false),
            _ => {}
        }
        Ok(Some(rung))
    }

    /// Where it stands.
    pub fn state(&self) -> State {
        self.state
    }
}
