//! `dgtr sim`: an aircraft that is not there, for tests without an autopilot.

use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

use config::mission::{CameraSource, Mission};
use hal::link::LinkAddress;
use models::formats::flight_plan;
use sim::aircraft::Imperfections;
use sim::attached::{AttachedSettings, photograph};
use sim::autopilot::{Announcing, AutopilotSettings};
use sim::reference::Lens;
use sim::survey::SurveySettings;
use sim::world::WorldSettings;
use sim::{SessionSettings, SimSettings};

mod card;

use flight::coverage::route;
use job::interrupt::Interrupt;

use super::CliError;
use crate::cli::output::outln;

/// Heading of the options.
const INSTEAD: &str = "Instead of a simulated survey flight";

/// A simulated autopilot and camera over a ray-cast world: real MAVLink on a pseudo-terminal or socket, JPEG files in
/// the camera folder; or, with --autopilot, the camera alone beside an autopilot that runs already.
#[derive(Debug, clap::Args)]
pub struct Args {
    /// Mission file: origin, camera, region, seed and [faults].
    #[arg(long, value_name = "FILE")]
    mission: PathBuf,
    /// Which aircraft to simulate; not needed when there is only one.
    #[arg(long, value_name = "ID")]
    aircraft: Option<String>,
    /// Where to speak: `pty` (its path is printed), `pty:/path/of/a/link`, `udpout:HOST:PORT`, `tcpin:HOST:PORT`.
    #[arg(long, value_name = "ADDRESS", default_value = "pty")]
    link: String,
    /// Be only the camera of the vehicle that is heard at this address, e.g. a running SITL. It photographs the simulated ground
    /// at each trigger, until Ctrl-C.
    #[arg(long, value_name = "ADDRESS", help_heading = INSTEAD, conflicts_with_all = ["link", "reference", "card", "plan", "speed", "height",
        "forward_overlap", "side_overlap", "pitch", "triggers", "cross", "perfect", "linger"])]
    autopilot: Option<String>,
    /// Camera folder [default: the mission's].
    #[arg(long, value_name = "DIR")]
    camera_dir: Option<PathBuf>,
    /// Also write the truth here, as a data set with held-out views.
    #[arg(long, value_name = "DIR")]
    reference: Option<PathBuf>,
    /// Write the survey's pictures here as a camera's card, with EXIF and XMP, instead of flying.
    #[arg(long, value_name = "DIR", help_heading = INSTEAD)]
    card: Option<PathBuf>,
    /// Fly this plan instead: QGroundControl's `.plan` of waypoints, surveys and corridor scans, or a list of waypoints ("QGC WPL 110").
    #[arg(long, value_name = "FILE", help_heading = INSTEAD, conflicts_with_all = ["height", "forward_overlap", "side_overlap", "cross"])]
    plan: Option<PathBuf>,
    #[command(flatten, next_help_heading = "Flight")]
    flight: FlightArgs,
}

/// The simulated flight.
#[derive(Debug, clap::Args)]
struct FlightArgs {
    /// Seconds of flight per second of wall clock.
    #[arg(long, value_name = "X", default_value_t = 1.0)]
    speed: f64,
    /// Height of the flight, metres.
    #[arg(long, value_name = "M", default_value_t = 40.0)]
    height: f64,
    /// Share of a picture seen again by the next one on the line.
    #[arg(long, value_name = "SHARE", default_value_t = 0.75)]
    forward_overlap: f64,
    /// Share of a picture seen again from the next line.
    #[arg(long, value_name = "SHARE", default_value_t = 0.6)]
    side_overlap: f64,
    /// Pitch of the camera, degrees; −90 looks straight down.
    #[arg(long, value_name = "DEG", default_value_t = -90.0, allow_hyphen_values = true)]
    pitch: f64,
    /// Messages that announce exposures.
    #[arg(long, value_enum, default_value_t = Triggers::Ardupilot)]
    triggers: Triggers,
    /// Fly a second set of lines across the first.
    #[arg(long)]
    cross: bool,
    /// Leave out wind, noise and bias.
    #[arg(long)]
    perfect: bool,
    /// Seconds to go on speaking after the flight.
    #[arg(long, value_name = "S", default_value_t = 5.0)]
    linger: f64,
}

/// How exposures are announced.
#[derive(Clone, Copy, Debug, clap::ValueEnum)]
enum Triggers {
    /// ArduPilot's CAMERA_FEEDBACK.
    Ardupilot,
    /// PX4's CAMERA_TRIGGER with its two commands.
    Px4,
    /// PX4's messages and CAMERA_IMAGE_CAPTURED.
    Px4Feedback,
    /// CAMERA_IMAGE_CAPTURED alone.
    Captured,
}

impl From<Triggers> for Announcing {
    fn from(triggers: Triggers) -> Self {
        match triggers {
            Triggers::Ardupilot => Self::Feedback,
            Triggers::Px4 => Self::Trigger,
            Triggers::Px4Feedback => Self::TriggerAndCaptured,
            Triggers::Captured => Self::Captured,
        }
    }
}

/// Runs the command.
///
/// # Errors
/// Whatever ends the command; its kind is the exit code.
pub fn run(args: Args) -> Result<(), CliError> {
    let mission = Mission::read(&args.mission)?;
    let aircraft = mission.aircraft(args.aircraft.as_deref())?;
    let address = args.link.parse()?;
    let lens = lens(&mission);
    let prefix = format!("{}_", aircraft.id);
    if let Some(autopilot) = &args.autopilot {
        let settings = AttachedSettings {
            world_seed: mission.seed,
            world: WorldSettings::default(),
            origin: mission.origin,
            lens,
            mount: mission.mount,
            link: mission.link.clone(),
            system_id: aircraft.system_id,
            prefix,
        };
        return attach(&settings, &autopilot.parse()?, &camera_dir(args.camera_dir, &aircraft.camera)?);
    }
    let number = mission.aircraft.iter().position(|a| a.id == aircraft.id).unwrap_or(0) as u64;
    let plan = args.plan.as_deref().map(flight_plan::read).transpose()?;
    let settings = SimSettings {
        world_seed: mission.seed,
        seed: mission.seed.wrapping_mul(1000).wrapping_add(number),
        world: WorldSettings::default(),
        origin: mission.origin,
        lens,
        region: mission.region(aircraft),
        route: plan.map(|plan| route(&plan, mission.origin, args.flight.pitch)),
        survey: SurveySettings {
            height_m: args.flight.height,
            forward_overlap: args.flight.forward_overlap,
            side_overlap: args.flight.side_overlap,
            gimbal_pitch_deg: args.flight.pitch,
            cross: args.flight.cross,
            ..SurveySettings::default()
        },
        imperfections: if args.flight.perfect { Imperfections::none() } else { Imperfections::default() },
        autopilot: AutopilotSettings {
            system_id: aircraft.system_id,
            faults: mission.faults,
            announcing: args.flight.triggers.into(),
            ..AutopilotSettings::default()
        },
        session: SessionSettings {
            speed: args.flight.speed,
            linger_s: args.flight.linger,
            ..SessionSettings::default()
        },
        prefix,
    };
    let stop = stop_flag()?;
    if let Some(folder) = &args.card {
        let written = card::write(&settings, folder, &stop)?;
        outln!("{}: {written} pictures", folder.display());
        return Ok(());
    }
    let camera_dir = camera_dir(args.camera_dir.clone(), &aircraft.camera)?;
    let report = sim::run(&settings, &address, &camera_dir, args.reference.as_deref(), &stop, &mut say_where)?;
    tracing::info!(
        "{} exposures, {} pictures, {:.0} s of flight",
        report.triggers,
        report.pictures.delivered,
        report.flight_s
    );
    if report.completed { Ok(()) } else { Err(CliError::interrupted("the flight was ended early")) }
}

/// The camera of another program's vehicle, until Ctrl-C.
fn attach(settings: &AttachedSettings, autopilot: &LinkAddress, folder: &Path) -> Result<(), CliError> {
    let report = photograph(settings, autopilot, folder, &*stop_flag()?, &mut say_where)?;
    outln!("{} exposures, {} pictures, {} missed", report.triggers, report.pictures.delivered, report.missed);
    Ok(())
}

fn lens(mission: &Mission) -> Lens {
    let c = &mission.camera;
    Lens { width: c.width, height: c.height, fx: c.fx.into(), fy: c.fy.into(), cx: c.cx.into(), cy: c.cy.into() }
}

fn say_where(pty: Option<&Path>) {
    if let Some(path) = pty {
        outln!("{}", path.display());
    }
}

/// A flag that Ctrl-C sets.
///
/// # Errors
/// The signal handler cannot be installed.
pub fn stop_flag() -> Result<Arc<AtomicBool>, CliError> {
    let interrupt = Interrupt::install()?;
    let stop = Arc::new(AtomicBool::new(false));
    let flag = Arc::clone(&stop);
    std::thread::Builder::new().name("interrupt".into()).spawn(move || {
        while !interrupt.requested() {
            std::thread::sleep(std::time::Duration::from_millis(50));
        }
        flag.store(true, Ordering::Relaxed);
    })?;
    Ok(stop)
}

/// The camera folder: the one asked for, else the mission's.
///
/// # Errors
/// The aircraft has no camera folder.
pub fn camera_dir(asked: Option<PathBuf>, camera: &CameraSource) -> Result<PathBuf, CliError> {
    let folder = match (asked, camera) {
        (Some(folder), _) => folder,
        (None, CameraSource::Folder(folder)) => folder.clone(),
        (None, _) => {
            return Err(CliError::input("the mission's camera is no folder; say where pictures go with --camera-dir"));
        }
    };
    std::fs::create_dir_all(&folder)
        .map_err(|e| CliError::input(format!("{}: {}", folder.display(), disk::told(&e))))?;
    Ok(folder)
}
