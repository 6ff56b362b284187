//! `dgtr fly`: the onboard job. While pictures come in, the reconstruction already refines, initialises, trains, saves
//! and offers; after landing it finishes the schedule. Ctrl-C at any moment leaves a valid model behind.

use std::path::{Path, PathBuf};
use std::time::{Duration, SystemTime};

use config::mission::{Aircraft, Mission};
use hal::time::MonotonicClock;
use hal::vehicle::VehicleSettings;
use models::camera::Intrinsics;
use vulkan::trainer::RunBudget;

mod carry;
mod error;
mod flight;
mod geotags;
mod handover;
mod health;
mod intake;
mod job;
mod reconstruct;
mod reconstruction;
mod shortage;

#[cfg(test)]
mod fault_table;
#[cfg(test)]
mod rehearsal;

pub use error::FlyError;
pub use flight::{EndOfFlight, Ended, FlightCounters};
pub use handover::Handover;
pub use reconstruction::{Progress, Reconstruction};

use crate::interrupt::Interrupt;
use crate::upload::Offerer;
use flight::{Flight, FlightPlan};
use geotags::Geotags;
use health::Health;
use job::{Job, JobEnd};

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
        vehicle: VehicleSettings {
            pictures_since: last_saved(&options.out),
            ..VehicleSettings::from_mission(mission, aircraft)?
        },
        intrinsics,
        keyframes: mission.keyframes,
        earlier: reconstruction.store().poses(),
        end: options.end,
        geotags: Geotags::open(&options.out, mission.origin).map_err(FlyError::Geotags)?,
    })?;
    tracing::info!("{}: listening on {}, pictures from {:?}", aircraft.id, aircraft.link, aircraft.camera);
    let budget = RunBudget { steps: Some(mission.training.steps), seconds: mission.training.seconds };
    let health = Health::new(mission.memory.host_mib);
    let mut job = Job::new(reconstruction, offerer, &options.out, budget, health, MonotonicClock::default());
    while job.turn(flight.handover(), interrupt)? {}
    let (ended, counters) = flight.finish()?;
    tracing::info!("capture is over ({ended:?}): {} key frames", job.keyframes());
    let end = job.land(&counters, interrupt)?;
    Ok(outcome(ended, counters, end, interrupt))
}

/// Waits for the ground to have the finished model, then says what became of everything.
fn outcome(ended: Ended, flight: FlightCounters, end: JobEnd<Reconstruction>, interrupt: &Interrupt) -> FlyOutcome {
    let JobEnd { reconstruction, offerer, model, gaussians, finished } = end;
    let delivered = finished && offerer.wait_delivered(DELIVERY, || !interrupt.requested());
    offerer.shutdown();
    let trainer = reconstruction.trainer();
    FlyOutcome {
        model,
        gaussians,
        ended,
        finished,
        delivered,
        flight,
        keyframes: reconstruction.keyframes(),
        device_bytes: [trainer.plan().total_bytes, trainer.device_bytes()],
        device: trainer.gpu().info().name.clone(),
        stage_ms: trainer.stage_ms().to_vec(),
        progress: reconstruction.progress().clone(),
    }
}

/// When an earlier run in `out` last saved a key frame or a model: what the camera wrote since then nobody has seen.
fn last_saved(out: &Path) -> Option<SystemTime> {
    let saved = [model_path(out), out.join("keyframes/transforms.json")];
    saved.iter().filter_map(|path| path.metadata().ok()?.modified().ok()).max()
}

/// Where `dgtr fly` puts the model of an aircraft.
pub fn model_path(out: &Path) -> PathBuf {
    Reconstruction::model_path(out)
}
