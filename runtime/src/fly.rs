//! `dgtr fly`: the onboard job. While pictures come in, the reconstruction already refines, initialises, trains, saves
//! and offers; after landing it finishes the schedule. Ctrl-C at any moment leaves a valid model behind.

use std::ops::ControlFlow;
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use config::mission::{Aircraft, Mission};
use hal::failsafe::{self, Action};
use hal::mavlink::dialect::MavSeverity;
use hal::vehicle::VehicleSettings;
use models::camera::Intrinsics;
use vulkan::trainer::{RunBudget, StepReport};

mod carry;
mod error;
mod flight;
mod geotags;
mod health;
mod reconstruction;

pub use error::FlyError;
pub use flight::{EndOfFlight, Ended, FlightCounters};
pub use reconstruction::{Progress, Reconstruction};

use crate::interrupt::Interrupt;
use crate::upload::Offerer;
use flight::{Flight, FlightPlan};
use geotags::Geotags;
use health::Health;

/// Between two checkpoints: what a power cut may cost.
const CHECKPOINT_EVERY: Duration = Duration::from_secs(15);
/// Between two lines to the ground control station.
const SAY_EVERY: Duration = Duration::from_secs(10);
/// How long a finished aircraft keeps its model on offer for the ground to fetch.
const DELIVERY: Duration = Duration::from_secs(120);

/// What the command line adds to the mission.
#[derive(Clone, Debug)]
pub struct FlyOptions {
    /// Output folder.
    pub out: PathBuf,
    /// When capture is over.
    pub end: EndOfFlight,
}

/// How the job ended.
#[derive(Debug)]
pub struct FlyOutcome {
    /// The model's file.
    pub model: PathBuf,
    /// Its Gaussians.
    pub gaussians: usize,
    /// Why capture ended.
    pub ended: Ended,
    /// Whether the schedule was finished (false: interrupted, the model is a checkpoint).
    pub finished: bool,
    /// Whether the ground has the model.
    pub delivered: bool,
    /// What capture counted.
    pub flight: FlightCounters,
    /// What reconstruction did.
    pub progress: Progress,
    /// Key frames used.
    pub keyframes: usize,
    /// Device bytes planned and allocated.
    pub device_bytes: [u64; 2],
    /// Name of the device.
    pub device: String,
    /// Device milliseconds by stage.
    pub stage_ms: Vec<(&'static str, f64)>,
}

/// The lens of the pictures that are trained on.
pub fn training_lens(mission: &Mission) -> Intrinsics {
    let c = &mission.camera;
    let full = Intrinsics { width: c.width, height: c.height, fx: c.fx, fy: c.fy, cx: c.cx, cy: c.cy };
    let scaled = |side: u32| ((side as f32 * mission.memory.image_scale).round() as u32).max(1);
    full.resized(scaled(c.width), scaled(c.height))
}

/// Flies one aircraft's mission to its end.
///
/// # Errors
/// Whatever keeps the job from going on; what was saved before stays valid.
pub fn fly(
    mission: &Mission,
    aircraft: &Aircraft,
    options: &FlyOptions,
    interrupt: &Interrupt,
) -> Result<FlyOutcome, FlyError> {
    let intrinsics = training_lens(mission);
    let reconstruction = Reconstruction::open(mission, aircraft, &intrinsics, &options.out)?;
    let offerer = Offerer::start(&mission.upload, &mission.name, &aircraft.id)?;
    let flight = Flight::start(FlightPlan {
        vehicle: VehicleSettings::from_mission(mission, aircraft)?,
        lens: mission.camera,
        intrinsics,
        keyframes: mission.keyframes,
        earlier: reconstruction.store().poses(),
        end: options.end,
        geotags: Geotags::open(&options.out, mission.origin).map_err(FlyError::Geotags)?,
    })?;
    tracing::info!("{}: listening on {}, pictures from {:?}", aircraft.id, aircraft.link, aircraft.camera);
    let budget = RunBudget { steps: Some(mission.training.steps), seconds: mission.training.seconds };
    let job = Job {
        reconstruction,
        offerer,
        out: options.out.clone(),
        budget,
        health: Health::new(mission.memory.host_mib),
        failsafe: failsafe::State::default(),
        training_failed: false,
        started: Instant::now(),
        last_save: Instant::now(),
        last_said: None,
    };
    job.run(flight, interrupt)
}

struct Job {
    reconstruction: Reconstruction,
    offerer: Offerer,
    out: PathBuf,
    budget: RunBudget,
    health: Health,
    failsafe: failsafe::State,
    /// The device failed; the last checkpoint is what there is.
    training_failed: bool,
    started: Instant,
    last_save: Instant,
    last_said: Option<Instant>,
}

impl Job {
    fn run(mut self, flight: Flight, interrupt: &Interrupt) -> Result<FlyOutcome, FlyError> {
        while flight.is_flying() && !interrupt.requested() {
            self.take(&flight)?;
            match self.watch(&flight)? {
                Action::StopTraining | Action::UploadBest | Action::Hold => {
                    std::thread::sleep(Duration::from_millis(50));
                    continue;
                }
                _ => {}
            }
            let worked = self.reconstruct(&flight, interrupt);
            self.survive(worked)?;
        }
        // What capture still hands over, until its thread has nothing left.
        while !interrupt.requested() && (flight.waiting() > 0 || flight.is_flying()) {
            self.take(&flight)?;
        }
        let (ended, counters) = flight.finish()?;
        tracing::info!("capture is over ({ended:?}): {} key frames", self.reconstruction.keyframes());
        if !self.training_failed {
            let landed = self.land(interrupt);
            self.survive(landed)?;
        }
        let finished = self.reconstruction.has_model() && !interrupt.requested() && !self.training_failed;
        self.report(ended, counters, finished, interrupt)
    }

    fn reconstruct(&mut self, flight: &Flight, interrupt: &Interrupt) -> Result<(), FlyError> {
        if self.reconstruction.wants_build(false) {
            self.build(flight)?;
        }
        self.train(flight, interrupt)
    }

    /// A device that fails in flight must not end the capture: once there is a checkpoint, it is offered instead.
    fn survive(&mut self, worked: Result<(), FlyError>) -> Result<(), FlyError> {
        match worked {
            Err(FlyError::Train(e)) if model_path(&self.out).is_file() => {
                tracing::error!("{e}; training is over, the last checkpoint is kept");
                self.training_failed = true;
                self.offerer.offer(&model_path(&self.out));
                Ok(())
            }
            other => other,
        }
    }

    fn take(&mut self, flight: &Flight) -> Result<(), FlyError> {
        let patience = if self.reconstruction.has_model() { Duration::ZERO } else { Duration::from_millis(200) };
        if let Some(frame) = flight.next(patience) {
            self.reconstruction.add(&frame)?;
            tracing::info!("key frame {}: {}", self.reconstruction.keyframes(), frame.name);
        }
        Ok(())
    }

    /// One step of the failsafe ladder; says and does what a new rung asks for.
    fn watch(&mut self, flight: &Flight) -> Result<Action, FlyError> {
        let flags = self.health.flags(flight.flags(), self.training_failed);
        let now_ms = self.started.elapsed().as_millis() as u64;
        let before = self.failsafe.action();
        self.failsafe = failsafe::update(now_ms, &self.failsafe, &flags);
        let action = self.failsafe.action();
        if action != before {
            let line = format!("dgtr: {} ({})", action.name(), self.failsafe.cause().unwrap_or("recovered"));
            tracing::warn!("{line}");
            flight.say(
                if action > before { MavSeverity::MAV_SEVERITY_WARNING } else { MavSeverity::MAV_SEVERITY_INFO },
                line,
            );
            match action {
                Action::UploadBest if self.reconstruction.has_model() && !self.training_failed => self.save(false)?,
                Action::HalfResolution => self.reconstruction.halve_resolution(true),
                Action::SmallerModel if self.reconstruction.has_model() => self.reconstruction.shrink()?,
                Action::Nominal | Action::Warn => self.reconstruction.halve_resolution(false),
                _ => {}
            }
        }
        Ok(action)
    }

    fn build(&mut self, flight: &Flight) -> Result<(), FlyError> {
        match self.reconstruction.build() {
            Ok(()) => self.save(false),
            // In flight more pictures may mend what too few of them could not do.
            Err(FlyError::Init(e)) if flight.is_flying() => {
                tracing::warn!("not built yet: {e}");
                Ok(())
            }
            Err(e) => Err(e),
        }
    }

    /// Trains until a key frame waits, a checkpoint is due, or capture ends.
    fn train(&mut self, flight: &Flight, interrupt: &Interrupt) -> Result<(), FlyError> {
        if !self.reconstruction.has_model() || flight.waiting() > 0 {
            return Ok(());
        }
        if self.reconstruction.is_done(&self.budget) {
            std::thread::sleep(Duration::from_millis(50));
            return Ok(());
        }
        let due = self.last_save + CHECKPOINT_EVERY;
        let mut last = None;
        self.reconstruction.train(&self.budget, &mut |report: &StepReport| {
            last = Some(*report);
            let go_on = flight.waiting() == 0 && flight.is_flying() && !interrupt.requested() && Instant::now() < due;
            if go_on { ControlFlow::Continue(()) } else { ControlFlow::Break(()) }
        })?;
        if let Some(report) = last {
            self.say(flight, &report);
        }
        if Instant::now() >= due { self.save(false) } else { Ok(()) }
    }

    /// After capture: the last build, and the rest of the schedule.
    fn land(&mut self, interrupt: &Interrupt) -> Result<(), FlyError> {
        if self.reconstruction.wants_build(true) && !interrupt.requested() {
            self.reconstruction.build()?;
            self.save(false)?;
        }
        if !self.reconstruction.has_model() {
            return Ok(());
        }
        let mut progress = crate::console::Progress::new("training", 100);
        while !self.reconstruction.is_done(&self.budget) && !interrupt.requested() {
            let due = self.last_save + CHECKPOINT_EVERY;
            let before = self.reconstruction.trainer().steps();
            self.reconstruction.train(&self.budget, &mut |r: &StepReport| {
                progress.set((r.progress * 100.0) as u64, || {
                    format!("step {}, loss {:.4}, {} Gaussians", r.step, r.loss, r.gaussians)
                });
                let go_on = !interrupt.requested() && Instant::now() < due;
                if go_on { ControlFlow::Continue(()) } else { ControlFlow::Break(()) }
            })?;
            if self.reconstruction.trainer().steps() == before || Instant::now() < due {
                // Converged before its budget: no step was left to take.
                break;
            }
            self.save(false)?;
        }
        Ok(())
    }

    fn save(&mut self, finished: bool) -> Result<(), FlyError> {
        let (path, gaussians) = self.reconstruction.checkpoint(&self.out, finished)?;
        self.last_save = Instant::now();
        tracing::debug!("saved {} ({gaussians} Gaussians)", path.display());
        if finished {
            self.offerer.offer_final(&path)
        } else {
            self.offerer.offer(&path)
        }
        Ok(())
    }

    fn say(&mut self, flight: &Flight, report: &StepReport) {
        if self.last_said.is_some_and(|at| at.elapsed() < SAY_EVERY) {
            return;
        }
        self.last_said = Some(Instant::now());
        let line = format!(
            "dgtr: {} views {}k gauss step {} loss {:.3}",
            self.reconstruction.keyframes(),
            report.gaussians / 1000,
            report.step,
            report.loss
        );
        tracing::info!("{line}");
        flight.say(MavSeverity::MAV_SEVERITY_INFO, line);
    }

    fn report(
        mut self,
        ended: Ended,
        flight: FlightCounters,
        finished: bool,
        interrupt: &Interrupt,
    ) -> Result<FlyOutcome, FlyError> {
        if !self.reconstruction.has_model() {
            return Err(FlyError::TooFewKeyframes(self.reconstruction.keyframes()));
        }
        let (model, gaussians) = if self.training_failed {
            (model_path(&self.out), self.reconstruction.trainer().gaussians())
        } else {
            self.reconstruction.checkpoint(&self.out, finished)?
        };
        if finished {
            self.offerer.offer_final(&model);
        } else {
            self.offerer.offer(&model);
        }
        let delivered = finished && self.offerer.wait_delivered(DELIVERY, || !interrupt.requested());
        self.offerer.shutdown();
        let trainer = self.reconstruction.trainer();
        Ok(FlyOutcome {
            model,
            gaussians,
            ended,
            finished,
            delivered,
            flight,
            keyframes: self.reconstruction.keyframes(),
            device_bytes: [trainer.plan().total_bytes, trainer.device_bytes()],
            device: trainer.gpu().info().name.clone(),
            stage_ms: trainer.stage_ms().to_vec(),
            progress: self.reconstruction.progress().clone(),
        })
    }
}

/// Where `dgtr fly` puts the model of an aircraft.
pub fn model_path(out: &Path) -> PathBuf {
    Reconstruction::model_path(out)
}
