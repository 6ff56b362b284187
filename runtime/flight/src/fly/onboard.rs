//! The onboard job, turn by turn: takes key frames, builds, trains, saves, offers, climbs the failsafe ladder. It decides what
//! is done when; a [`Reconstruct`] does it, and the clock is anybody's, so that a whole flight can be rehearsed in a second.

use std::ops::ControlFlow;
use std::path::{Path, PathBuf};
use std::time::Duration;

use engine::error::EngineError;
use engine::failsafe::Failsafe;
use engine::{PictureSource, Reconstruct, model_path};
use hal::failsafe::Action;
use hal::mavlink::dialect::MavSeverity;
use hal::mavlink_camera::Activity;
use hal::traits::Clock;
use job::interrupt::Interrupt;
use job::service::Supervisor;
use pages::watch::Watch;
use uplink::Offerer;
use vulkan::trainer::{RunBudget, StepReport};

use super::handover::Handover;
use super::show::ShownJob;
use crate::error::FlightError;
use crate::keyframe_store::Relief;

mod landing;

/// Between two checkpoints: what a power cut may cost.
const CHECKPOINT_EVERY_NS: u64 = 15_000_000_000;
/// Between two lines to the ground control station.
const SAY_EVERY_NS: u64 = 10_000_000_000;
/// Key frames for which training can be owed at once.
const OWED_FOR: u32 = 4;
/// While there is nothing to train on a turn waits this long for the next key frame, and this long when there is
/// nothing to do at all.
const FOR_A_FRAME: Duration = Duration::from_millis(200);
const IDLE: Duration = Duration::from_millis(50);

/// One flight's job.
pub(super) struct Job<R, K> {
    reconstruction: R,
    offerer: Offerer,
    out: PathBuf,
    budget: RunBudget,
    clock: K,
    failsafe: Failsafe,
    supervisor: Supervisor,
    shown: ShownJob,
    /// The device failed; the last checkpoint is what there is.
    training_failed: bool,
    /// Steps trained for each key frame, however many more wait, and those that are still to be trained.
    steps_each: u32,
    owed: u32,
    saved_ns: u64,
    said_ns: Option<u64>,
    for_a_frame: Duration,
    idle: Duration,
}

/// What a job leaves behind.
pub(super) struct JobEnd<R> {
    pub(super) reconstruction: R,
    pub(super) offerer: Offerer,
    pub(super) supervisor: Supervisor,
    pub(super) model: PathBuf,
    pub(super) gaussians: usize,
    /// Whether the schedule was finished (false: the model is a checkpoint).
    pub(super) finished: bool,
}

impl<R: Reconstruct, K: Clock> Job<R, K> {
    pub(super) fn new(
        reconstruction: R,
        offerer: Offerer,
        out: &Path,
        budget: RunBudget,
        failsafe: Failsafe,
        clock: K,
    ) -> Self {
        Self {
            reconstruction,
            offerer,
            out: out.into(),
            budget,
            saved_ns: clock.now_ns(),
            clock,
            failsafe,
            supervisor: Supervisor::default(),
            shown: ShownJob::default(),
            training_failed: false,
            steps_each: 0,
            owed: 0,
            said_ns: None,
            for_a_frame: FOR_A_FRAME,
            idle: IDLE,
        }
    }

    /// A service manager hears of every turn and every step, and so does whoever looks at the page.
    pub(super) fn supervised(self, supervisor: Supervisor, watch: Watch) -> Self {
        Self { supervisor, shown: ShownJob::new(watch), ..self }
    }

    /// Trains so many steps for every key frame it takes in, though more wait (`keyframes.train_steps`).
    pub(super) fn training_for_each(self, steps: u32) -> Self {
        Self { steps_each: steps, ..self }
    }

    fn show(&self, state: &'static str) {
        self.shown.state(state, self.reconstruction.keyframes(), self.reconstruction.gaussians());
    }

    /// As [`Job::show`], and to the ground station.
    fn act_as(&self, capture: &Handover, activity: Activity) {
        self.show(activity.name());
        capture.tell(|told| {
            told.activity = activity;
            (told.key_frames, told.gaussians) =
                (count(self.reconstruction.keyframes()), count(self.reconstruction.gaussians()));
        });
    }

    /// What the ground station has asked for since the last turn.
    fn obey(&mut self, capture: &Handover) {
        capture.tell(|told| told.training_over = self.training_failed);
        let Some(seconds) = capture.seconds_asked() else { return };
        self.budget.seconds = seconds;
        self.reconstruction.set_seconds(seconds);
    }

    /// Key frames taken so far.
    pub(super) fn keyframes(&self) -> usize {
        self.reconstruction.keyframes()
    }

    /// One turn in flight; false when capture is over and everything it handed over is taken.
    pub(super) fn turn(&mut self, capture: &mut Handover, interrupt: &Interrupt) -> Result<bool, FlightError> {
        self.supervisor.alive();
        if interrupt.requested() {
            self.supervisor.stopping();
            return Ok(false);
        }
        self.obey(capture);
        self.offerer.say(capture.condition());
        // Asked before looking into the channel: what was handed over before the end is still there.
        let flying = capture.is_open();
        let taken = self.take(capture)?;
        if !flying {
            return Ok(taken);
        }
        match self.watch(capture)? {
            Action::StopTraining | Action::UploadBest | Action::Hold => std::thread::sleep(self.idle),
            _ => {
                let worked = self.reconstruct(capture, interrupt);
                self.survive(worked)?;
            }
        }
        Ok(true)
    }

    fn reconstruct(&mut self, capture: &mut Handover, interrupt: &Interrupt) -> Result<(), FlightError> {
        if capture.earlier_left() == 0 && self.reconstruction.wants_build(false) {
            self.build(capture)?;
        } else if self.reconstruction.wants_growth() {
            self.grow(capture)?;
        }
        self.train(capture, interrupt)
    }

    /// A device that fails in flight must not end the capture: once there is a checkpoint, it is offered instead.
    fn survive(&mut self, worked: Result<(), FlightError>) -> Result<(), FlightError> {
        match worked {
            Err(FlightError::Engine(EngineError::Train(e))) if model_path(&self.out).is_file() => {
                tracing::error!("{e}; training is over, the last checkpoint is kept");
                self.training_failed = true;
                self.offerer.offer_urgently(&model_path(&self.out));
                Ok(())
            }
            other => other,
        }
    }

    fn take(&mut self, capture: &mut Handover) -> Result<bool, FlightError> {
        let patience = if self.reconstruction.has_model() { Duration::ZERO } else { self.for_a_frame };
        let Some(frame) = capture.next(patience)? else { return Ok(false) };
        tracing::info!("key frame {}: {}", self.reconstruction.keyframes() + 1, frame.name);
        self.reconstruction.add(frame, capture.waiting() > 0)?;
        self.owed = (self.owed + self.steps_each).min(OWED_FOR * self.steps_each);
        self.act_as(capture, Activity::Collecting);
        Ok(true)
    }

    /// One step of the failsafe ladder; says and does what a new rung asks for.
    fn watch(&mut self, capture: &mut Handover) -> Result<Action, FlightError> {
        let views = self.reconstruction.keyframes();
        self.failsafe.look(self.clock.now_ns(), capture.flags(), self.training_failed, &self.budget, views);
        self.act(capture)?;
        Ok(self.failsafe.state().action())
    }

    /// Does what a new rung asks for, and tells the ground control station.
    fn act(&mut self, capture: &mut Handover) -> Result<(), FlightError> {
        let Some(rung) = self.failsafe.act(&mut self.reconstruction)? else { return Ok(()) };
        let line = format!("dgtr: {rung}");
        self.shown.rung(&self.failsafe.state());
        capture.tell(|told| told.rung = rung.action);
        tracing::warn!("{line}");
        self.supervisor.status(&line);
        let severity = if rung.is_worse { MavSeverity::MAV_SEVERITY_WARNING } else { MavSeverity::MAV_SEVERITY_INFO };
        capture.say(severity, line);
        if rung.action == Action::UploadBest && self.reconstruction.has_model() && !self.training_failed {
            self.save(capture)?;
            self.offerer.offer_urgently(&model_path(&self.out));
        }
        Ok(())
    }

    fn build(&mut self, capture: &mut Handover) -> Result<(), FlightError> {
        self.act_as(capture, Activity::Building);
        let supervisor = &self.supervisor;
        let cancelled = || {
            supervisor.alive();
            false
        };
        match self.reconstruction.build(&cancelled) {
            Ok(_) => {
                capture.note_in_model();
                capture.refined(|name| self.reconstruction.pose(name))?;
                self.save(capture)
            }
            // In flight more pictures may mend what too few of them could not do.
            Err(e @ (EngineError::Init(_) | EngineError::Network(_))) if capture.is_open() => {
                tracing::warn!("not built yet: {e}");
                Ok(())
            }
            Err(e) => Err(e.into()),
        }
    }

    /// Adds the newest key frames to the model; the next checkpoint that is due has them.
    fn grow(&mut self, capture: &mut Handover) -> Result<(), FlightError> {
        self.act_as(capture, Activity::Building);
        self.supervisor.alive();
        match self.reconstruction.grow() {
            Ok(whole) => {
                capture.note_in_model();
                if whole {
                    capture.refined(|name| self.reconstruction.pose(name))?;
                }
                Ok(())
            }
            // In flight more pictures may mend what too few of them could not do.
            Err(e @ (EngineError::Init(_) | EngineError::Network(_))) if capture.is_open() => {
                tracing::warn!("not in the model yet: {e}");
                Ok(())
            }
            Err(e) => Err(e.into()),
        }
    }

    /// Trains what is owed, and on until a key frame waits, a checkpoint is due, or capture ends.
    fn train(&mut self, capture: &mut Handover, interrupt: &Interrupt) -> Result<(), FlightError> {
        if !self.reconstruction.has_model() || (self.owed == 0 && capture.waiting() > 0) {
            return Ok(());
        }
        if self.reconstruction.is_done(&self.budget) {
            self.owed = 0;
            if capture.waiting() == 0 {
                std::thread::sleep(self.idle);
            }
            return Ok(());
        }
        let due_ns = self.saved_ns + CHECKPOINT_EVERY_NS;
        let mut last = None;
        self.act_as(capture, Activity::Training);
        let (clock, failsafe, supervisor, budget) = (&self.clock, &mut self.failsafe, &self.supervisor, self.budget);
        let (shown, owed) = (&mut self.shown, &mut self.owed);
        let views = self.reconstruction.keyframes();
        self.reconstruction.train(&budget, &mut |report: &StepReport| {
            last = Some(*report);
            supervisor.alive();
            shown.step(report);
            capture.tell(|told| {
                (told.gaussians, told.progress, told.loss) = (count(report.gaussians), report.progress, report.loss);
            });
            let now_ns = clock.now_ns();
            *owed = owed.saturating_sub(1);
            let waited_for = *owed == 0 && capture.waiting() > 0;
            let undisturbed = !waited_for && capture.is_open() && !interrupt.requested();
            let alarmed = failsafe.glance(now_ns, capture.flags(), &budget, views);
            if undisturbed && now_ns < due_ns && !alarmed { ControlFlow::Continue(()) } else { ControlFlow::Break(()) }
        })?;
        if let Some(report) = last {
            self.failsafe.note_step(&report);
            self.say(capture, &report);
        }
        if self.clock.now_ns() >= due_ns { self.save(capture) } else { Ok(()) }
    }

    fn save(&mut self, capture: &mut Handover) -> Result<(), FlightError> {
        self.saved_ns = self.clock.now_ns();
        match self.checkpoint(capture, false) {
            Ok((path, gaussians)) => {
                tracing::debug!("saved {} ({gaussians} Gaussians)", path.display());
                self.offerer.offer(&path);
            }
            // The one before is whole; the next is due in the usual time.
            Err(e) if e.may_pass() => tracing::warn!("{e}; no checkpoint this time"),
            Err(e) => return Err(e.into()),
        }
        Ok(())
    }

    /// Writes a checkpoint; while there is no room, gives up what costs least and tries again.
    fn checkpoint(&mut self, capture: &mut Handover, finished: bool) -> Result<(PathBuf, usize), EngineError> {
        let mut written = self.reconstruction.checkpoint(&self.out, finished);
        for relief in Relief::LADDER {
            if let Err(e) = &written
                && e.may_pass()
                && capture.relieve(relief)
            {
                tracing::warn!("{e}: gave up {}", relief.name());
                written = self.reconstruction.checkpoint(&self.out, finished);
            }
        }
        written
    }

    fn say(&mut self, capture: &Handover, report: &StepReport) {
        let now_ns = self.clock.now_ns();
        if self.said_ns.is_some_and(|at| now_ns.saturating_sub(at) < SAY_EVERY_NS) {
            return;
        }
        self.said_ns = Some(now_ns);
        self.shown.sent(self.offerer.status().sent);
        let line = format!(
            "dgtr: {} views {}k gauss step {} loss {:.3}",
            self.reconstruction.keyframes(),
            report.gaussians / 1000,
            report.step,
            report.loss
        );
        tracing::info!("{line}");
        self.supervisor.status(&line);
        capture.say(MavSeverity::MAV_SEVERITY_INFO, line);
    }

    /// On a clock that stands still meanwhile there is nothing to wait for.
    #[cfg(all(test, feature = "lab"))]
    pub(super) fn without_waiting(self) -> Self {
        Self { for_a_frame: Duration::ZERO, idle: Duration::ZERO, ..self }
    }

    #[cfg(all(test, feature = "lab"))]
    pub(super) fn reconstruction_mut(&mut self) -> &mut R {
        &mut self.reconstruction
    }

    /// Where the failsafe ladder stands, and why.
    #[cfg(all(test, feature = "lab"))]
    pub(super) fn failsafe(&self) -> hal::failsafe::State {
        self.failsafe.state()
    }
}

/// As a ground station is told.
fn count(n: usize) -> u32 {
    u32::try_from(n).unwrap_or(u32::MAX)
}
