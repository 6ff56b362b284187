//! A whole flight in a fraction of a second, for tests: the simulated aircraft, the real vehicle, capture and job, all on one
//! clock that moves only when told. In the reconstruction's place stands a [`Ledger`], which takes key frames and writes
//! model files as the real one does, without a network or a device.

use std::ops::ControlFlow;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

use config::coverage::CoverageSettings;
use config::failsafe::FailsafeSettings;
use config::mission::{CameraSettings, KeyframeSettings};
use config::upload::UploadSettings;
use disk::Disk;
use engine::error::EngineError;
use engine::failsafe::Failsafe;
use engine::{Reconstruct, model_path};
use geometry::geodesy::Geodetic;
use hal::camera::FolderCamera;
use hal::error::HalError;
use hal::failsafe::{Action, Cause};
use hal::link::WireLink;
use hal::time::ManualClock;
use hal::traits::Link;
use hal::vehicle::{Vehicle, VehicleSettings};
use job::health::Health;
use job::interrupt::Interrupt;
use job::service::Supervisor;
use models::camera::{Intrinsics, Pose, PosedImage, View};
use models::cloud::GaussianCloud;
use models::formats::model::{self, ModelHeader};
use pages::report::{Craft, ReportData};
use pages::watch::Watch;
use sim::rehearsal::Rehearsal;
use sim::world::World;
use sim::{SessionReport, SimSettings};
use uplink::keys::Identity;
use uplink::{Offerer, Source};
use vulkan::trainer::{RunBudget, StepReport, StopReason};

use super::geotags::Geotags;
use super::handover::handover;
use super::intake::Intake;
use super::intake::{EndOfFlight, Ended, FlightCounters, FlightPlan};
use super::onboard::Job;
use super::record::Recorder;
use crate::error::FlightError;
use crate::keyframe_store::KeyframeStore;

/// Time between two turns; one training step is taken in each.
const TURN_NS: u64 = 20_000_000;
/// No rehearsal takes longer, turns: ten minutes.
const MOST_TURNS: u32 = 30_000;

/// An aircraft without keys, every start of which is its first flight.
pub(super) fn unsigned(mission: &str, aircraft: &str) -> Source {
    let (mission, aircraft, identity) = (mission.into(), aircraft.into(), Identity::unsigned());
    Source { mission, aircraft, identity, flight_number: None, session: None, disk: Disk::default(), territory: None }
}

/// What would have been reconstructed. Key frames and checkpoints are kept on disk as the real one keeps them.
pub(super) struct Ledger {
    disk: Disk,
    views: Vec<(String, View)>,
    built: usize,
    steps: u32,
    /// Steps over all builds and starts.
    steps_total: u64,
    /// In flight a turn has time for one step; afterwards there is all the time.
    pub(super) landed: bool,
    /// What has been promised to be on disk, told to whoever cuts the power.
    pub(super) promised: Box<dyn FnMut(Promise) + Send>,
}

/// What is on disk from now on, whatever happens.
#[derive(Clone, Debug, PartialEq)]
pub(super) enum Promise {
    /// A key frame by its name.
    KeyFrame(String),
    /// A checkpoint after so many steps.
    Checkpoint(u64),
}

impl Ledger {
    /// Takes up what an earlier run left in `out`, as `fly` does; and the store of its key frames.
    pub(super) fn open(
        disk: &Disk,
        camera: &CameraSettings,
        origin: Geodetic,
        out: &Path,
    ) -> Result<(Self, KeyframeStore), FlightError> {
        let lens = intrinsics(camera);
        let mut store = KeyframeStore::open(disk, &out.join("keyframes"), camera, &lens, origin)?;
        let views: Vec<_> = (0..).map_while(|i| store.sound(i)).map(|frame| (frame.name, frame.view)).collect();
        let before = model::read_checkpoint(disk, &model_path(out)).map_err(EngineError::from)?;
        let steps_total = before.map_or(0, |(header, _)| header.steps);
        let (disk, promised) = (disk.clone(), Box::new(|_| {}));
        let ledger = Self { disk, views, built: 0, steps: 0, steps_total, landed: false, promised };
        Ok((ledger, store))
    }

    /// Names of the key frames.
    pub(super) fn names(&self) -> impl Iterator<Item = &str> {
        self.views.iter().map(|(name, _)| name.as_str())
    }

    /// Steps over all builds and starts.
    pub(super) fn steps_total(&self) -> u64 {
        self.steps_total
    }
}

impl Reconstruct for Ledger {
    fn add(&mut self, frame: PosedImage, _more: bool) -> Result<(), EngineError> {
        if self.views.iter().any(|(name, _)| *name == frame.name) {
            return Ok(());
        }
        (self.promised)(Promise::KeyFrame(frame.name.clone()));
        self.views.push((frame.name, frame.view));
        Ok(())
    }

    fn keyframes(&self) -> usize {
        self.views.len()
    }

    fn pose(&self, _name: &str) -> Option<Pose> {
        None
    }

    fn wants_build(&self, last: bool) -> bool {
        // As the real one: three to begin with, then every third more.
        let (now, then) = (self.views.len(), self.built);
        now >= 3 && if last { now > then } else { then == 0 || now as f64 >= 1.34 * then as f64 }
    }

    fn has_model(&self) -> bool {
        self.built > 0
    }

    fn build(&mut self, _cancelled: &dyn Fn() -> bool) -> Result<bool, EngineError> {
        (self.built, self.steps) = (self.views.len(), 0);
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
    ) -> Result<StopReason, EngineError> {
        while !self.is_done(budget) {
            self.steps += 1;
            self.steps_total += 1;
            let report =
                StepReport { step: self.steps, loss: 1.0 / self.steps as f32, settled: true, ..StepReport::default() };
            if each(&report).is_break() || !self.landed {
                return Ok(StopReason::Caller);
            }
        }
        Ok(StopReason::Schedule)
    }

    fn halve_resolution(&mut self, _on: bool) {}

    fn shrink(&mut self) -> Result<(), EngineError> {
        Ok(())
    }

    fn gaussians(&self) -> usize {
        0
    }

    fn checkpoint(&mut self, out: &Path, finished: bool) -> Result<(PathBuf, usize), EngineError> {
        let views = self.views[..self.built].to_vec();
        let header = ModelHeader { views, steps: self.steps_total, finished, ..ModelHeader::default() };
        let path = model_path(out);
        model::write_checkpoint(&self.disk, &path, &header, &GaussianCloud::default())?;
        (self.promised)(Promise::Checkpoint(self.steps_total));
        Ok((path, 0))
    }
}

/// One flight to rehearse.
#[derive(Clone)]
pub(super) struct Script {
    pub(super) sim: SimSettings,
    pub(super) vehicle: VehicleSettings,
    pub(super) end: EndOfFlight,
    /// What is to be covered.
    pub(super) ground: Vec<[f64; 2]>,
    /// Names of key frames that an earlier run has stored.
    pub(super) earlier_names: Vec<String>,
    /// Somebody asks the program to end (Ctrl-C) at this time.
    pub(super) interrupt_at: Option<Duration>,
    /// What the job writes to, for a flight whose files are in this folder.
    pub(super) disk: fn(&Path) -> Disk,
    /// What happened in the output folder before the flight.
    pub(super) before: fn(&Path),
}

/// What became of it.
pub(super) struct Rehearsed {
    pub(super) happened: SessionReport,
    pub(super) ended: Ended,
    pub(super) counters: FlightCounters,
    /// Key frames for which the disk had no room.
    pub(super) without_room: u64,
    /// The rungs of the failsafe ladder that were climbed to, with their cause.
    pub(super) rungs: Vec<(Action, &'static str)>,
    /// Views and completeness of the model file that remained; else how many key frames there were, and why so few.
    pub(super) model: Result<(usize, bool), (usize, String)>,
    /// Names of the model's views.
    pub(super) names: Vec<String>,
    /// The page as it was at the end.
    pub(super) page: ReportData,
}

/// Flies `script`, with its files in `folder`.
pub(super) fn rehearse(script: &Script, world: Arc<World>, folder: &Path) -> Rehearsed {
    let disk = (script.disk)(&folder.join("out"));
    rehearse_on(&disk, script, world, folder, Box::new(|_| {}))
}

/// Pictures are trained on as large as they come.
pub(super) fn intrinsics(camera: &CameraSettings) -> Intrinsics {
    let c = camera;
    Intrinsics { width: c.width, height: c.height, fx: c.fx, fy: c.fy, cx: c.cx, cy: c.cy }
}

/// As [`rehearse`], with what is on disk told to `promised`.
pub(super) fn rehearse_on(
    disk: &Disk,
    script: &Script,
    world: Arc<World>,
    folder: &Path,
    promised: Box<dyn FnMut(Promise) + Send>,
) -> Rehearsed {
    rehearse_over(|wire, _| (wire, Arc::default()), disk, script, world, folder, promised)
}

/// As [`rehearse_on`]; what comes over the wire from the aircraft reaches the vehicle over `line`, which says whether more can be read at once.
pub(super) fn rehearse_over<L: Link<Error = HalError>>(
    line: impl FnOnce(WireLink, Arc<ManualClock>) -> (L, Arc<AtomicBool>),
    disk: &Disk,
    script: &Script,
    world: Arc<World>,
    folder: &Path,
    promised: Box<dyn FnMut(Promise) + Send>,
) -> Rehearsed {
    let (pictures, out) = (folder.join("pictures"), folder.join("out"));
    std::fs::create_dir_all(&pictures).expect("folder");
    std::fs::create_dir_all(&out).expect("folder");
    (script.before)(&out);
    let clock = Arc::new(ManualClock::default());
    let (mut aircraft, wire) =
        Rehearsal::new(&script.sim, world, &pictures, clock.clone()).expect("a simulated aircraft");
    let camera = FolderCamera::open(&pictures).expect("the folder").on_simulated_clock();
    let (link, has_more) = line(wire, clock.clone());
    let vehicle = Vehicle::new(link, camera, clock.clone(), &script.vehicle).expect("a vehicle");
    let (mut capture, end) = handover();
    let (mut ledger, store) = Ledger::open(disk, &script.vehicle.lens, script.vehicle.origin, &out).expect("opens");
    ledger.promised = promised;
    let page = ReportData { aircraft: vec![Craft::new("one", "listening")], ..ReportData::default() };
    let watch = Watch::new(page, &out, script.vehicle.origin);
    let plan = FlightPlan {
        vehicle: script.vehicle.clone(),
        intrinsics: intrinsics(&script.vehicle.lens),
        keyframes: KeyframeSettings::default(),
        training_seconds: None,
        coverage: CoverageSettings::default(),
        region: script.ground.clone(),
        earlier: store.poses(),
        earlier_names: script.earlier_names.iter().cloned().collect(),
        end: script.end,
        geotags: Geotags::open(disk, &out, script.vehicle.origin).expect("a file"),
        watch: watch.clone(),
        recorder: Recorder::default(),
    };
    capture.keep_in(store, model_path(&out));
    let mut intake = Some(Intake::new(plan, vehicle, clock.clone(), end));
    let offerer = Offerer::start(&UploadSettings::default(), unsigned("rehearsal", "one")).expect("a thread");
    let budget = RunBudget { steps: Some(200), seconds: None };
    let limits = FailsafeSettings { disk_low_mib: 0, ..FailsafeSettings::default() };
    let health = Health::with_sensors(Path::new("/nonexistent"), limits, 1 << 20, &out);
    let mut job =
        Job::new(ledger, offerer, &out, budget, Failsafe::new(health, &limits), clock.clone()).without_waiting();
    job = job.supervised(Supervisor::default(), watch.clone());
    let interrupt = Interrupt::default();
    let (mut flying, mut over, mut rungs) = (true, None, Vec::new());
    for turn in 1..=MOST_TURNS {
        clock.set(u64::from(turn) * TURN_NS);
        if script.interrupt_at.is_some_and(|at| Duration::from_nanos(u64::from(turn) * TURN_NS) >= at) {
            interrupt.request();
        }
        flying = flying && aircraft.turn().expect("the aircraft flies");
        if let Some(mut capturing) = intake.take() {
            let mut turned = capturing.turn(Duration::ZERO).expect("capture goes on");
            while turned.is_none() && has_more.load(Ordering::Relaxed) {
                turned = capturing.turn(Duration::ZERO).expect("capture goes on");
            }
            match turned {
                Some(ended) => over = Some((ended, capturing.finish())),
                None => intake = Some(capturing),
            }
        }
        let goes_on = job.turn(&mut capture, &interrupt).expect("the job goes on");
        let state = job.failsafe();
        if rungs.last().map_or(Action::Nominal, |r: &(Action, _)| r.0) != state.action() {
            rungs.push((state.action(), state.cause().map_or("recovered", Cause::name)));
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
    let mut names = Vec::new();
    let model = match job.land(&mut capture, &counters, &interrupt) {
        Ok(end) => {
            let (header, _) = model::read(&end.model).expect("a valid model file");
            assert_eq!(header.finished, end.finished);
            names.extend(header.views.iter().map(|(name, _)| name.clone()));
            Ok((header.views.len(), header.finished))
        }
        Err(FlightError::TooFewKeyframes { keyframes, cause }) => Err((keyframes, cause)),
        Err(e) => panic!("the job failed: {e}"),
    };
    let without_room = capture.without_room();
    Rehearsed {
        happened: aircraft.finish().expect("a report"),
        ended,
        counters,
        without_room,
        rungs,
        model,
        names,
        page: watch.freeze(),
    }
}
