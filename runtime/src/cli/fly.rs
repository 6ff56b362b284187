//! `dgtr fly`: the onboard job.

use std::path::PathBuf;
use std::time::{Duration, Instant};

use config::mission::Mission;

use super::CliError;
use crate::fly::{EndOfFlight, Ended, FlyError, FlyOptions, FlyOutcome, fly};
use crate::interrupt::Interrupt;
use crate::run_json::RunReport;

/// Reads pose and triggers from the autopilot and pictures from the camera, and builds the model while flying.
#[derive(Debug, clap::Args)]
pub struct Args {
    /// Mission file shared by all aircraft and the ground.
    #[arg(long, value_name = "FILE")]
    mission: PathBuf,
    /// Which aircraft of the mission this is; not needed when there is only one.
    #[arg(long, value_name = "ID")]
    aircraft: Option<String>,
    /// Folder of key frames, model and run.json; a folder of an earlier run is continued.
    #[arg(long, value_name = "DIR")]
    out: PathBuf,
    /// Another link than the mission's, e.g. `serial:/dev/ttyAMA0:921600`.
    #[arg(long, value_name = "ADDRESS")]
    link: Option<String>,
    /// Take the aircraft for landed when nothing was heard for this many seconds after it flew.
    #[arg(long, value_name = "S", default_value_t = 20.0)]
    silence: f64,
    /// Give up when nothing was ever heard for this many seconds; 0 waits for ever.
    #[arg(long, value_name = "S", default_value_t = 0.0)]
    patience: f64,
}

/// Runs the command.
pub fn run(args: Args) -> Result<(), CliError> {
    let started = Instant::now();
    let mission = Mission::read(&args.mission).map_err(CliError::input)?;
    let mut aircraft = mission.aircraft(args.aircraft.as_deref()).map_err(CliError::input)?.clone();
    if let Some(link) = args.link {
        aircraft.link = link;
    }
    let seconds = |s: f64, name: &str| {
        Duration::try_from_secs_f64(s)
            .map_err(|_| CliError::input(format!("--{name} {s}: must be zero or more seconds")))
    };
    let patience = seconds(args.patience, "patience")?;
    let end =
        EndOfFlight { silence: seconds(args.silence, "silence")?, patience: (!patience.is_zero()).then_some(patience) };
    let interrupt = Interrupt::install().map_err(CliError::failed)?;
    let options = FlyOptions { out: args.out.clone(), end };
    let outcome = fly(&mission, &aircraft, &options, &interrupt)?;
    let mut report = report(&outcome);
    report.seed = mission.training.seed;
    report.wall_s = started.elapsed().as_secs_f64();
    let path = report.write(&args.out).map_err(CliError::failed)?;
    println!(
        "{}: {} Gaussians from {} key frames after {} steps; {}",
        outcome.model.display(),
        outcome.gaussians,
        outcome.keyframes,
        outcome.progress.steps,
        path.display()
    );
    match (outcome.finished, outcome.ended) {
        (true, Ended::NeverHeard) | (false, _) => Err(CliError::interrupted(format!(
            "stopped before the end; {} is a valid checkpoint, the same command continues",
            outcome.model.display()
        ))),
        (true, _) => Ok(()),
    }
}

fn report(outcome: &FlyOutcome) -> RunReport {
    let mut r = RunReport::new("fly");
    r.outcome = if outcome.finished { "done" } else { "interrupted" }.into();
    r.steps = outcome.progress.steps;
    r.gaussians = outcome.gaussians as u64;
    r.views = outcome.keyframes as u64;
    r.device = outcome.device.clone();
    [r.device_bytes_planned, r.device_bytes_peak] = outcome.device_bytes;
    for (name, ms) in &outcome.stage_ms {
        r.stage_ms.insert((*name).to_owned(), *ms);
    }
    r.stage_ms.insert("initialise".into(), outcome.progress.init_s * 1e3);
    r.stage_ms.insert("train".into(), outcome.progress.train_s * 1e3);
    let k = outcome.flight.keyframes;
    for (name, count) in [
        ("pictures_too_close", k.too_close),
        ("pictures_covered", k.covered),
        ("pictures_bad_pose", k.bad_pose),
        ("pictures_over_plan", k.full),
        ("pictures_unusable", k.unusable),
        ("pictures_undecodable", outcome.flight.undecodable),
        ("pictures_or_triggers_unmatched", outcome.flight.unmatched),
    ] {
        r.skip(name, u64::from(count));
    }
    if let Some(i) = &outcome.progress.initialised {
        r.skip("pairs_not_sent_to_the_network", i.skipped.total() as u64);
    }
    let counters = serde_json::to_value(outcome.flight.hal).unwrap_or_default();
    r.more.insert("hal".into(), counters);
    r.more.insert("ended".into(), format!("{:?}", outcome.ended).into());
    r.more.insert("delivered".into(), outcome.delivered.into());
    r.more.insert("builds".into(), outcome.progress.builds.into());
    r.more.insert("links_lost".into(), outcome.flight.links_lost.into());
    if let Some(refined) = &outcome.progress.refined {
        r.more.insert("reprojection_rms_px".into(), refined.reprojection_rms_px.into());
    }
    r
}

impl From<FlyError> for CliError {
    fn from(e: FlyError) -> Self {
        match e {
            FlyError::Mission(_) | FlyError::Plan(_) | FlyError::TooFewKeyframes { .. } => Self::input(e),
            FlyError::Gpu(_) => Self::device(e),
            FlyError::Refine(models::refine::RefineError::Network(_)) => Self::device(e),
            FlyError::Init(e) => e.into(),
            FlyError::Hal(_) => Self::input(e),
            _ => Self::failed(e),
        }
    }
}
