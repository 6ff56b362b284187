//! `dgtr fly`: the onboard job.

use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use config::mission::Mission;
use disk::Disk;
use engine::device::training_lens;
use engine::ortho::keep_scratch_in;
use engine::preset;
use flight::fly::{EndOfFlight, Ended, FlyOptions, FlyOutcome, Recording, fly};
use job::interrupt::Interrupt;
use job::resources::return_freed_memory;
use job::run_json::RunReport;
use job::service::Supervisor;
use job::session::{Owner, Session};
use pages::report::{REPORT, ReportData, Timing, count, seconds};
use pages::watch::Watch;

use super::CliError;
use super::http::HttpArgs;
use crate::cli::output::outln;

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
    /// Use this link instead of the mission's, e.g. `serial:/dev/ttyAMA0:921600`.
    #[arg(long, value_name = "ADDRESS")]
    link: Option<String>,
    /// End a flight after so many seconds of silence [default: the mission's `link.silence_limit_s`].
    #[arg(long, value_name = "S")]
    silence: Option<f64>,
    /// Stop when nothing was ever heard for so many seconds; 0 waits for ever.
    #[arg(long, value_name = "S", default_value_t = 0.0)]
    patience: f64,
    /// Record poses, exposures, key frames and state for Foxglove, as MCAP, in at most 256 MiB.
    #[arg(long, value_name = "FILE")]
    record: Option<PathBuf>,
    /// The live page.
    #[command(flatten)]
    http: HttpArgs,
}

/// Runs the command.
///
/// # Errors
/// Whatever ends the command; its kind is the exit code.
pub fn run(args: Args) -> Result<(), CliError> {
    return_freed_memory();
    let started = Instant::now();
    let mut mission = Mission::read(&args.mission)?;
    let mut aircraft = mission.aircraft(args.aircraft.as_deref())?.clone();
    if let Some(link) = args.link {
        aircraft.link = link;
    }
    let seconds = |s: f64, name: &str| {
        Duration::try_from_secs_f64(s)
            .map_err(|_| CliError::input(format!("--{name} {s}: must be zero or more seconds")))
    };
    let silence = args.silence.unwrap_or(mission.link.silence_limit_s.into());
    let patience = seconds(args.patience, "patience")?;
    let end =
        EndOfFlight { silence: seconds(silence, "silence")?, patience: (!patience.is_zero()).then_some(patience) };
    let interrupt = Interrupt::install()?;
    let chosen = preset::of_flight(&mut mission, &aircraft, &args.out);
    let watch = Watch::of(&mission, &[&aircraft.id], "opening the device and the networks", &args.out);
    watch.update(|page| page.title = format!("Aircraft {}, mission {}", aircraft.id, mission.name));
    let _server = args.http.serve(&mission.http, &watch)?;
    let lens = training_lens(&mission);
    let owner = Owner {
        command: "fly".into(),
        mission: mission.name.clone(),
        aircraft: aircraft.id.clone(),
        origin: [mission.origin.lat_deg, mission.origin.lon_deg, mission.origin.alt_m],
        picture: [lens.width, lens.height],
    };
    let _session = Session::begin(&Disk::default(), &args.out, &owner)?;
    if let Some(chosen) = &chosen {
        chosen.keep(&args.out)?;
    }
    keep_scratch_in(&args.out);
    let recording = args.record.as_deref().map(|path| Recording::create(path, mission.origin)).transpose()?;
    let (recording, recorder) = recording.unzip();
    let options = FlyOptions {
        out: args.out.clone(),
        end,
        watch: watch.clone(),
        recorder: recorder.unwrap_or_default(),
        recording_bytes: args.record.as_deref().map_or(0, |path| Recording::most_bytes_below(path, &args.out)),
    };
    let outcome = fly(&mission, &aircraft, &options, &interrupt, Supervisor::from_environment());
    // The file is complete when nobody has anything to add.
    drop((options, recording));
    let outcome = outcome?;
    let mut report = report(&outcome);
    if let Some(chosen) = chosen {
        chosen.note(&mut report);
    }
    report.wall_s = started.elapsed().as_secs_f64();
    let path = report.write(&args.out)?;
    if let Err(e) = page(watch.freeze(), &report, &outcome, &path).write(&args.out.join(REPORT)) {
        // Nothing that counts is missing.
        tracing::warn!("{e}; there is no page of this flight");
    }
    outln!(
        "{}: {} Gaussians from {} key frames after {} steps; {}",
        outcome.model.display(),
        outcome.gaussians,
        outcome.keyframes,
        report.steps,
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

/// The page as it was at the end, with what only the end knows.
fn page(mut page: ReportData, run: &RunReport, outcome: &FlyOutcome, run_json: &Path) -> ReportData {
    page.subtitle = run.device.clone();
    page.headline = vec![
        ("key frames".into(), count(run.views)),
        ("Gaussians".into(), count(run.gaussians)),
        ("steps".into(), count(run.steps)),
        ("total".into(), seconds(run.wall_s)),
    ];
    let stages = run.stage_ms.iter().filter(|(name, _)| !name.starts_with("device_"));
    page.timings =
        stages.map(|(name, ms)| Timing { name: name.clone(), of: String::new(), seconds: ms * 1e-3 }).collect();
    let skipped = run.skipped.iter().filter(|s| *s.1 > 0);
    page.skipped = skipped.map(|(what, n)| (what.replace('_', " "), *n)).collect();
    page.files = vec![("model".into(), outcome.model.clone()), ("figures".into(), run_json.to_owned())];
    page
}

fn report(outcome: &FlyOutcome) -> RunReport {
    let mut r = outcome.report.clone();
    r.outcome = if outcome.finished { "done" } else { "interrupted" }.into();
    r.gaussians = outcome.gaussians as u64;
    r.views = outcome.keyframes as u64;
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
    let counters = serde_json::to_value(outcome.flight.hal).unwrap_or_default();
    r.more.insert("hal".into(), counters);
    if let Some(coverage) = &outcome.flight.coverage {
        coverage.note(&mut r);
    }
    r.more.insert("ended".into(), format!("{:?}", outcome.ended).into());
    r.more.insert("delivered".into(), outcome.delivered.into());
    r.more.insert("pictures_decoded".into(), outcome.flight.decoded.into());
    r.more.insert("links_lost".into(), outcome.flight.links_lost.into());
    r
}
