//! `dgtr fly`: the onboard job. While pictures come in, the reconstruction already refines, initialises, trains, saves
//! and offers; after landing it finishes the schedule. Ctrl-C at any moment leaves a valid model behind.

use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::AtomicU64;
use std::time::{Duration, SystemTime};

use config::mission::{Aircraft, CameraSettings, CameraSource, Mission};
use config::plan::Lanes;
use disk::bounded::{Bounded, bytes_below};
use disk::plan::{DiskPlan, DiskRequest};
use disk::{Disk, System};
use hal::mavlink_camera::Activity;
use hal::time::MonotonicClock;
use hal::vehicle::VehicleSettings;
use models::formats::delivery::{ENCODED_BYTES, Rounding};
use models::formats::model::ModelHeader;
use vulkan::trainer::RunBudget;

mod flight;
mod geotags;
mod handover;
mod intake;
mod onboard;
mod record;
mod shortage;
mod show;

#[cfg(test)]
#[path = "../../../tests/flight/battery_swap.rs"]
mod battery_swap;
#[cfg(test)]
#[cfg(feature = "lab")]
#[path = "../../../tests/flight/beside.rs"]
mod beside;
#[cfg(test)]
#[cfg(feature = "lab")]
#[path = "../../../tests/flight/fault_table/mod.rs"]
mod fault_table;
#[cfg(test)]
#[cfg(feature = "lab")]
#[path = "../../../tests/flight/heat.rs"]
mod heat;
#[cfg(test)]
#[cfg(feature = "lab")]
#[path = "../../../tests/flight/killed.rs"]
mod killed;
#[cfg(test)]
#[cfg(feature = "lab")]
#[path = "../../../tests/flight/outrun.rs"]
mod outrun;
#[cfg(test)]
#[cfg(feature = "lab")]
#[path = "../../../tests/flight/power_cut.rs"]
mod power_cut;
#[cfg(test)]
#[cfg(feature = "lab")]
#[path = "../../../tests/flight/reflown.rs"]
mod reflown;
#[cfg(test)]
#[cfg(feature = "lab")]
#[path = "../../../tests/flight/rehearsal.rs"]
mod rehearsal;

use engine::device::{DeviceRequest, training_lens};
use engine::error::EngineError;
use engine::failsafe::Failsafe;
use engine::{EngineSettings, InitKind, Reconstruct, Reconstruction, model_path, scratch_bytes};
use flight::Flight;
pub use handover::Handover;
pub use intake::{EndOfFlight, Ended, FlightCounters};
use job::health::Health;
use job::interrupt::Interrupt;
use job::resources;
use job::run_json::RunReport;
use job::service::Supervisor;
use pages::watch::Watch;
pub use record::{RecordError, Recorder, Recording};
use uplink::{Offerer, Source, UploadError};

use crate::error::FlightError;
use crate::keyframe_store::KeyframeStore;
use geotags::Geotags;
use intake::{DECODED_AHEAD, FlightPlan};
use onboard::{Job, JobEnd};

/// How long a finished aircraft keeps its model on offer for the ground to fetch.
const DELIVERY: Duration = Duration::from_secs(120);

/// What the command line adds to the mission.
#[derive(Clone, Debug)]
pub struct FlyOptions {
    /// Output folder.
    pub out: PathBuf,
    /// When capture is over.
    pub end: EndOfFlight,
    /// The live page; this is its aircraft 0.
    pub watch: Watch,
    /// Takes what happens in the flight.
    pub recorder: Recorder,
    /// Most bytes of its recording below `out`.
    pub recording_bytes: u64,
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
    /// Key frames used.
    pub keyframes: usize,
    /// What reconstruction did and what it took.
    pub report: RunReport,
}

/// Flies one aircraft's mission to its end; `supervisor` hears of it.
///
/// # Errors
/// Whatever keeps the job from going on; what was saved before stays valid.
pub fn fly(
    mission: &Mission,
    aircraft: &Aircraft,
    options: &FlyOptions,
    interrupt: &Interrupt,
    supervisor: Supervisor,
) -> Result<FlyOutcome, FlightError> {
    supervisor.status("opening the device and the networks");
    let intrinsics = training_lens(mission);
    let source = Source::of(mission, &aircraft.id, &options.out).map_err(UploadError::from)?;
    let disk = planned_disk(mission, &options.out, options.recording_bytes)?;
    let source = Source { disk: disk.clone(), ..source };
    let mut reconstruction = open(mission, aircraft, options, &disk)?;
    let store =
        KeyframeStore::open(&disk, &options.out.join("keyframes"), &mission.camera, &intrinsics, mission.origin)?;
    reconstruction.resume(&options.out)?;
    let offerer = Offerer::start(&mission.upload, source)?;
    let mut flight = Flight::start(FlightPlan {
        vehicle: VehicleSettings {
            pictures_since: last_saved(&options.out),
            ..VehicleSettings::from_mission(mission, aircraft)?
        },
        intrinsics,
        keyframes: mission.keyframes,
        training_seconds: mission.training.seconds,
        coverage: mission.coverage,
        region: mission.region(aircraft),
        earlier: store.poses(),
        earlier_names: store.names().collect(),
        end: options.end,
        geotags: Geotags::open(&disk, &options.out, mission.origin)
            .map_err(FlightError::io(&options.out.join(geotags::FILE)))?,
        watch: options.watch.clone(),
        recorder: options.recorder.clone(),
    })?;
    flight.handover().keep_in(store, model_path(&options.out));
    tracing::info!("{}: listening on {}, pictures from {:?}", aircraft.id, aircraft.link, aircraft.camera);
    supervisor.ready();
    supervisor.status(&format!("listening on {}", aircraft.link));
    options.watch.craft(0, |craft| craft.state = Activity::Listening.name());
    let budget = RunBudget { steps: Some(mission.training.steps), seconds: mission.training.seconds };
    let health = Health::new(mission.failsafe, mission.memory.host_mib, &options.out);
    let failsafe = Failsafe::new(health, &mission.failsafe);
    let job = Job::new(reconstruction, offerer, &options.out, budget, failsafe, MonotonicClock::default());
    let job = job.training_for_each(mission.keyframes.train_steps);
    let mut job = job.supervised(supervisor, options.watch.clone());
    while job.turn(flight.handover(), interrupt)? {}
    let (mut capture, ended, counters) = flight.finish()?;
    tracing::info!("capture is over ({ended:?}): {} key frames", job.keyframes());
    if let Some(coverage) = &counters.coverage {
        match coverage.write(&disk, &options.out) {
            Ok(files) => files.iter().for_each(|file| tracing::info!("wrote {}", file.display())),
            Err(e) => tracing::warn!("{e}; what the flight did not cover is not written"),
        }
    }
    let mut end = job.land(&mut capture, &counters, interrupt)?;
    if let Some(waits) = waits(capture.waited_s()) {
        end.reconstruction.report.more.insert("picture_to_model_s".into(), waits);
    }
    end.reconstruction.report.skip("key_frames_without_room_on_disk", capture.without_room());
    Ok(outcome(ended, counters, end, interrupt, &options.watch))
}

/// How long pictures took into the model, in all and hundred by hundred; `None` where there were none.
fn waits(waited_s: &[f64]) -> Option<serde_json::Value> {
    let at = |part: &[f64], share: f64| {
        let mut sorted = part.to_vec();
        sorted.sort_by(f64::total_cmp);
        sorted[((sorted.len() - 1) as f64 * share).round() as usize]
    };
    let hundreds: Vec<f64> = waited_s.chunks(100).map(|part| at(part, 0.5)).collect();
    (!waited_s.is_empty()).then(|| {
        serde_json::json!({
            "pictures": waited_s.len(), "median": at(waited_s, 0.5), "p90": at(waited_s, 0.9), "most": at(waited_s, 1.0),
            "median_by_hundred": hundreds,
        })
    })
}

/// Most bytes of a Gaussian as it is delivered; 0: models are sent as they are.
pub fn delivered_bytes(mission: &Mission) -> usize {
    Rounding::of(mission.upload.encoding).map_or(0, |_| ENCODED_BYTES)
}

/// What a flight may take of the disk.
fn disk_plan(mission: &Mission, recording: u64) -> DiskPlan {
    let (memory, sh_degree) = (&mission.memory, mission.training.sh.degree);
    // At least this much of the device's memory goes with every Gaussian: its floats, their two moments and gradient.
    let each = 16 * (11 + 3 * (u64::from(sh_degree) + 1).pow(2));
    let held = (u64::from(memory.device_mib()) << 20) / each;
    let on_device = memory.max_gaussians.map_or(held, u64::from).min(held);
    let gaussians = memory.scene_gaussians.map_or(on_device, |n| on_device.max(n.into())) as usize;
    let CameraSettings { width, height, .. } = mission.camera;
    // How many lanes sort matters little; more of them leave less room.
    let request = DeviceRequest::of_flight(mission, None).plan_request(&mission.training.sh, Lanes::CARD);
    DiskPlan::new(&DiskRequest {
        width,
        height,
        key_frames: mission.keyframes.max,
        scratch: scratch_bytes(&request, &mission.init, &mission.network, Some(&mission.refine)),
        gaussians,
        sh_degree,
        delivered: delivered_bytes(mission),
        map: mission.map.disk_bytes(),
        recording,
    })
}

/// The disk a flight writes to, bounded as the mission says; refused when not even a first model would fit.
fn planned_disk(mission: &Mission, out: &Path, recording: u64) -> Result<Disk, FlightError> {
    let plan = disk_plan(mission, recording);
    let here = bytes_below(out);
    let free = resources::free_disk_bytes(out).map_or(u64::MAX, |free| free.saturating_add(here));
    let limit = mission.memory.disk_mib.map_or(u64::MAX, |mib| u64::from(mib) << 20);
    // A folder that holds more than the least already is a flight that goes on: it climbs the ladder instead.
    let room = free.min(limit);
    if here < plan.min_bytes && !plan.fits(room).map_err(|e| FlightError::Disk(e.to_string()))? {
        let (room, total) = (room >> 20, plan.total_bytes >> 20);
        tracing::warn!("disk: {room} MiB for a flight that may take {total} MiB; see dgtr plan for what it is for");
    }
    // What is counted below `out` is the rest.
    let rest = limit.saturating_sub(plan.set_aside_bytes());
    Ok(Disk::new(Bounded::new(System, out, Arc::new(AtomicU64::new(rest)))))
}

/// Waits for the ground to have the finished model, then says what became of everything.
fn outcome(
    ended: Ended,
    flight: FlightCounters,
    end: JobEnd<Reconstruction>,
    interrupt: &Interrupt,
    watch: &Watch,
) -> FlyOutcome {
    let JobEnd { mut reconstruction, offerer, supervisor, model, gaussians, finished } = end;
    supervisor.status(&format!("{gaussians} Gaussians of {} key frames; delivering", reconstruction.keyframes()));
    let cancelled = || {
        supervisor.alive();
        interrupt.requested()
    };
    if finished {
        watch.craft(0, |craft| (craft.state, craft.schedule.left_s) = ("delivering the model", None));
    }
    let delivered = finished && offerer.wait_delivered(DELIVERY, cancelled);
    watch.craft(0, |craft| {
        craft.state = match (finished, delivered) {
            (true, true) => "done, the ground has the model",
            (true, false) => "done, the model is on board",
            _ => "stopped with a checkpoint",
        };
        craft.bytes = Some(offerer.status().sent);
    });
    reconstruction.report.more.insert("bytes_sent".into(), offerer.status().sent.into());
    offerer.shutdown();
    let keyframes = reconstruction.keyframes();
    FlyOutcome { model, gaussians, ended, finished, delivered, flight, keyframes, report: reconstruction.report }
}

/// The engine for `aircraft`, with everything it will ever need.
fn open(
    mission: &Mission,
    aircraft: &Aircraft,
    options: &FlyOptions,
    disk: &Disk,
) -> Result<Reconstruction, EngineError> {
    let settings = EngineSettings {
        disk: disk.clone(),
        device: DeviceRequest {
            device: aircraft.device.clone(),
            ..DeviceRequest::of_flight(mission, Some(options.out.clone()))
        },
        camera_pixels: u64::from(mission.camera.width) * u64::from(mission.camera.height),
        ahead: DECODED_AHEAD + handover::AHEAD,
        // Until they are kept on disk; those that are files already wait there.
        ahead_in_memory: !matches!(aircraft.camera, CameraSource::Folder(_)),
        delivers: Rounding::of(mission.upload.encoding),
        map: Some(mission.map).filter(|m| m.pixels > 0),
        // The capture thread has scaled them already.
        scale: 1.0,
        network: mission.network.clone(),
        training: mission.training.clone(),
        init: mission.init.clone(),
        refine: Some(mission.refine.clone()),
        start: InitKind::FeedForward,
        incremental: true,
    };
    let header = ModelHeader {
        mission: mission.name.clone(),
        aircraft: aircraft.id.clone(),
        origin: Some(mission.origin),
        region: mission.region(aircraft),
        seed: mission.training.seed,
        ..ModelHeader::default()
    };
    Reconstruction::open(settings, header, "fly")
}

/// When an earlier run in `out` last saved a key frame or a model: what the camera wrote since then nobody has seen.
fn last_saved(out: &Path) -> Option<SystemTime> {
    let saved = [model_path(out), out.join("keyframes/transforms.json")];
    saved.iter().filter_map(|path| path.metadata().ok()?.modified().ok()).max()
}
