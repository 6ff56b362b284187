//! A whole flight in a fraction of a second, for tests: the simulated aircraft, the real vehicle, capture and job, all on one
//! clock that moves only when told. In the reconstruction's place stands a [`Ledger`], which takes key frames and writes
//! model files as the real one does, without a network or a device.

use std::ops::ControlFlow;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::Duration;

use config::mission::KeyframeSettings;
use config::upload::UploadSettings;
use hal::camera::FolderCamera;
use hal::failsafe::Action;
use hal::sim::rehearsal::Rehearsal;
use hal::sim::world::World;
use hal::sim::{SessionReport, SimSettings};
use hal::time::ManualClock;
use hal::vehicle::{Vehicle, VehicleSettings};
use models::camera::{Intrinsics, PosedImage, View};
use models::cloud::GaussianCloud;
use models::formats::model::{self, ModelHeader};
use vulkan::trainer::{RunBudget, StepReport};

use super::flight::{EndOfFlight, Ended, FlightCounters, FlightPlan};
use super::geotags::Geotags;
use super::handover::handover;
use super::health::Health;
use super::intake::Intake;
use super::job::Job;
use super::reconstruct::Reconstruct;
use super::{FlyError, model_path};
use crate::interrupt::Interrupt;
use crate::upload::Offerer;

/// Time between two turns; one training step is taken in each.
const TURN_NS: u64 = 20_000_000;
/// No rehearsal takes longer, turns: ten minutes.
const MOST_TURNS: u32 = 30_000;

/// What would have been reconstructed.
pub(super) struct Ledger {
    views: Vec<(String, View)>,
    built: usize,
    steps: u32,
    /// In flight a turn has time for one step; afterwards there is all the time.
    landed: bool,
}

impl Reconstruct for Ledger {
    fn add(&mut self, frame: &PosedImage) -> Result<(), FlyError> {
        self.views.push((frame.name.clone(), frame.view));
        Ok(())
    }

    fn keyframes(&self) -> usize {
        self.views.len()
    }

    fn wants_build(&self, last: bool) -> bool {
        // As the real one: three to begin with, then every third more.
        let (now, then) = (self.views.len(), self.built);
        now >= 3 && if last { now > then } else { then == 0 || now as f64 >= 1.34 * then as f64 }
    }

    fn has_model(&self) -> bool {
        self.built > 0
    }

    fn build(&mut self) -> Result<(), FlyError> {
        (self.built, self.steps) = (self.views.len(), 0);
        Ok(())
    }

    fn is_done(&self, budget: &RunBudget) -> bool {
        budget.steps.is_some_and(|s| self.steps >= s)
    }

    fn steps(&self) -> u32 {
        self.steps
    }

    fn train(
        &mut self,
        budget: &RunBudget,
        each: &mut dyn FnMut(&StepReport) -> ControlFlow<()>,
    ) -> Result<(), FlyError> {
        while !self.is_done(budget) {
            self.steps += 1;
            let report = StepReport {
                step: self.steps,
                view: 0,
                loss: 1.0 / self.steps as f32,
                l1: 0.0,
                ssim: 0.0,
                depth_correlation: None,
                gaussians: 0,
                visible: 0,
                instances: 0,
                bands: 1,
                divisor: 1,
                elapsed_s: 0.0,
                progress: 0.0,
                settled: true,
            };
            if each(&report).is_break() || !self.landed {
                break;
            }
        }
        Ok(())
    }

    fn halve_resolution(&mut self, _on: bool) {}

    fn shrink(&mut self) -> Result<(), FlyError> {
        Ok(())
    }

    fn gaussians(&self) -> usize {
        0
    }

    fn checkpoint(&mut self, out: &Path, finished: bool) -> Result<(PathBuf, usize), FlyError> {
        let views = self.views[..self.built].to_vec();
        let header = ModelHeader { views, steps: self.steps.into(), finished, ..ModelHeader::default() };
        let path = model_path(out);
        model::write(&path, &header, &GaussianCloud::default())?;
        Ok((path, 0))
    }
}

/// One flight to rehearse.
#[derive(Clone)]
pub(super) struct Script {
    pub(super) sim: SimSettings,
    pub(super) vehicle: VehicleSettings,
    pub(super) end: EndOfFlight,
    /// Somebody asks the program to end (Ctrl-C) at this time.
    pub(super) interrupt_at: Option<Duration>,
}

/// What became of it.
pub(super) struct Rehearsed {
    pub(super) happened: SessionReport,
    pub(super) ended: Ended,
    pub(super) counters: FlightCounters,
    /// The rungs of the failsafe ladder that were climbed to, with their cause.
    pub(super) rungs: Vec<(Action, &'static str)>,
    /// Views and completeness of the model file that remained; else how many key frames there were, and why so few.
    pub(super) model: Result<(usize, bool), (usize, String)>,
}

/// Flies `script`, with its files in `folder`.
pub(super) fn rehearse(script: &Script, world: Arc<World>, folder: &Path) -> Rehearsed {
    let (pictures, out) = (folder.join("pictures"), folder.join("out"));
    std::fs::create_dir_all(&pictures).expect("folder");
    std::fs::create_dir_all(&out).expect("folder");
    let clock = Arc::new(ManualClock::default());
    let (mut aircraft, wire) =
        Rehearsal::new(&script.sim, world, &pictures, clock.clone()).expect("a simulated aircraft");
    let camera = FolderCamera::open(&pictures).expect("the folder").on_simulated_clock();
    let vehicle = Vehicle::new(wire, camera, clock.clone(), &script.vehicle).expect("a vehicle");
    let (capture, end) = handover();
    let lens = script.vehicle.lens;
    let plan = FlightPlan {
        vehicle: script.vehicle.clone(),
        intrinsics: Intrinsics {
            width: lens.width,
            height: lens.height,
            fx: lens.fx,
            fy: lens.fy,
            cx: lens.cx,
            cy: lens.cy,
        },
        keyframes: KeyframeSettings::default(),
        earlier: Vec::new(),
        end: script.end,
        geotags: Geotags::open(&out, script.vehicle.origin).expect("a file"),
    };
    let mut intake = Some(Intake::new(plan, vehicle, clock.clone(), end));
    let offerer = Offerer::start(&UploadSettings::default(), "rehearsal", "one").expect("a thread");
    let ledger = Ledger { views: Vec::new(), built: 0, steps: 0, landed: false };
    let budget = RunBudget { steps: Some(200), seconds: None };
    let health = Health::without_sensors(1 << 20);
    let mut job = Job::new(ledger, offerer, &out, budget, health, clock.clone()).without_waiting();
    let interrupt = Interrupt::default();
    let (mut flying, mut over, mut rungs) = (true, None, Vec::new());
    for turn in 1..=MOST_TURNS {
        clock.set(u64::from(turn) * TURN_NS);
        if script.interrupt_at.is_some_and(|at| Duration::from_nanos(u64::from(turn) * TURN_NS) >= at) {
            interrupt.request();
        }
        flying = flying && aircraft.turn().expect("the aircraft flies");
        if let Some(mut capturing) = intake.take() {
            match capturing.turn(Duration::ZERO).expect("capture goes on") {
                Some(ended) => over = Some((ended, capturing.finish())),
                None => intake = Some(capturing),
            }
        }
        let goes_on = job.turn(&capture, &interrupt).expect("the job goes on");
        let state = job.failsafe();
        if rungs.last().map_or(Action::Nominal, |r: &(Action, _)| r.0) != state.action() {
            rungs.push((state.action(), state.cause().unwrap_or("recovered")));
        }
        if !goes_on {
            break;
        }
    }
    // As `Flight::finish`: a capture that goes on is asked to end.
    capture.stop();
    while let Some(mut capturing) = intake.take() {
        match capturing.turn(Duration::ZERO).expect("capture goes on") {
            Some(ended) => over = Some((ended, capturing.finish())),
            None => intake = Some(capturing),
        }
    }
    let (ended, counters) = over.expect("the flight ends");
    assert!(ended != Ended::Asked || interrupt.requested(), "still flying after ten minutes");
    job.reconstruction_mut().landed = true;
    let model = match job.land(&counters, &interrupt) {
        Ok(end) => {
            let (header, _) = model::read(&end.model).expect("a valid model file");
            assert_eq!(header.finished, end.finished);
            Ok((header.views.len(), header.finished))
        }
        Err(FlyError::TooFewKeyframes { keyframes, cause }) => Err((keyframes, cause)),
        Err(e) => panic!("the job failed: {e}"),
    };
    Rehearsed { happened: aircraft.finish().expect("a report"), ended, counters, rungs, model }
}
