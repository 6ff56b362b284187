//! `dgtr replay`: recorded pictures or a recorded telemetry log, played as a living aircraft.

use std::path::{Path, PathBuf};

use geometry::geodesy::{EnuFrame, Geodetic};
use sim::SessionSettings;
use sim::autopilot::AutopilotSettings;
use sim::reference::Lens;
use sim::replay::{Playlist, PlaylistItem, ReplaySettings, TlogSettings, play, play_tlog};
use sim::world::WorldSettings;
use survey::dataset::{Dataset, DatasetFrame, PoseSource};

use super::CliError;
use super::sim::stop_flag;
use crate::cli::output::outln;

/// Plays a folder of posed photographs, or a .tlog, as an autopilot and a camera.
#[derive(Debug, clap::Args)]
pub struct Args {
    /// Folder of posed pictures (transforms.json or COLMAP, gps.csv), or a .tlog file.
    dataset: PathBuf,
    /// Where to speak: `pty` (its path is printed), `pty:/path/of/a/link`, `udp:HOST:PORT`, `tcp:HOST:PORT` (listens).
    #[arg(long, value_name = "ADDRESS", default_value = "pty")]
    link: String,
    /// Seconds of flight per second of wall clock.
    #[arg(long, value_name = "X", default_value_t = 1.0)]
    speed: f64,
    /// Folder the pictures appear in, each at its time; left out: no pictures.
    #[arg(long, value_name = "DIR")]
    camera_dir: Option<PathBuf>,
    /// Poses that the autopilot reports: the raw GPS and gimbal angles of gps.csv, or the data set's own.
    #[arg(long, value_enum, default_value_t = Poses::Telemetry)]
    poses: Poses,
    /// Only the pictures of this list of split.json.
    #[arg(long, value_name = "NAME", default_value = "train_dense")]
    split: String,
    /// Only the pictures of this region.
    #[arg(long, value_name = "NAME")]
    region: Option<String>,
    /// MAVLink system id of the autopilot.
    #[arg(long, value_name = "N", default_value_t = 1)]
    system_id: u8,
    /// Seed of noise, faults and, for a log, of the world under it.
    #[arg(long, value_name = "N", default_value_t = 1)]
    seed: u64,
    /// For a log: also write the true poses and held-out views here, as a data set.
    #[arg(long, value_name = "DIR")]
    reference: Option<PathBuf>,
    /// Seconds to go on speaking after the last picture.
    #[arg(long, value_name = "S", default_value_t = 5.0)]
    linger: f64,
}

/// Which poses the autopilot reports.
#[derive(Clone, Copy, Debug, PartialEq, Eq, clap::ValueEnum)]
enum Poses {
    /// gps.csv.
    Telemetry,
    /// The reconstruction that came with the data set.
    Dataset,
}

/// Seconds between two pictures of a data set without times.
const DEFAULT_INTERVAL_S: f64 = 4.0;
/// Lens of the simulated camera over a recorded log: 640×480 with a 79° field of view, as the reference data sets'.
const TLOG_LENS: Lens = Lens { width: 640, height: 480, fx: 385.0, fy: 385.0, cx: 320.0, cy: 240.0 };

/// Runs the command.
///
/// # Errors
/// Whatever ends the command; its kind is the exit code.
pub fn run(args: Args) -> Result<(), CliError> {
    let link = match args.link.split_once(':') {
        Some(("udp", rest)) => format!("udpout:{rest}"),
        Some(("tcp", rest)) => format!("tcpin:{rest}"),
        _ => args.link.clone(),
    };
    let address = link.parse()?;
    let session = SessionSettings { speed: args.speed, linger_s: args.linger, ..SessionSettings::default() };
    let stop = stop_flag()?;
    let mut ready = |pty: Option<&Path>| {
        if let Some(path) = pty {
            outln!("{}", path.display());
        }
    };
    if let Some(folder) = &args.camera_dir {
        std::fs::create_dir_all(folder)
            .map_err(|e| CliError::input(format!("{}: {}", folder.display(), disk::told(&e))))?;
    }
    let camera_dir = args.camera_dir.as_deref();
    let completed = if args.dataset.is_file() {
        let settings = TlogSettings {
            seed: args.seed,
            world: WorldSettings::default(),
            lens: TLOG_LENS,
            session,
            faults: config::faults::FaultSettings::default(),
        };
        let reference = args.reference.as_deref();
        let r = play_tlog(&args.dataset, &settings, &address, camera_dir, reference, &stop, &mut ready)?;
        tracing::info!("{} frames, {} exposures, {} pictures", r.frames_sent, r.exposures, r.pictures.delivered);
        if r.truncated || r.damaged > 0 {
            tracing::warn!(
                "the log has {} damaged stretches{}",
                r.damaged,
                if r.truncated { " and is cut short" } else { "" }
            );
        }
        r.completed
    } else {
        let list = playlist(&args)?;
        let settings = ReplaySettings {
            autopilot: AutopilotSettings {
                system_id: args.system_id,
                seed: args.seed,
                ..ReplaySettings::default().autopilot
            },
            session,
            ..ReplaySettings::default()
        };
        let r = play(&list, &settings, &address, camera_dir, &stop, &mut ready)?;
        tracing::info!("{} exposures, {} pictures", r.triggers, r.pictures.delivered);
        r.completed
    };
    if completed { Ok(()) } else { Err(CliError::interrupted("the replay was ended early")) }
}

fn playlist(args: &Args) -> Result<Playlist, CliError> {
    let set = Dataset::open(&args.dataset)?;
    let Some(home) = set.origin else {
        return Err(CliError::input(format!(
            "{}: has no enu_origin_wgs84 in transforms.json, so it cannot be played as GPS positions",
            set.root.display()
        )));
    };
    let split = if set.split.lists.contains_key(&args.split) { args.split.as_str() } else { "train" };
    let mut items = Vec::new();
    for (number, &i) in set.select(split, args.region.as_deref())?.iter().enumerate() {
        items.push(item(&set.frames[i], number, home, args.poses)?);
    }
    items.sort_by(|a, b| a.time_s.total_cmp(&b.time_s));
    Ok(Playlist { home, items })
}

fn item(frame: &DatasetFrame, number: usize, home: Geodetic, poses: Poses) -> Result<PlaylistItem, CliError> {
    let recorded = frame.prior.filter(|p| p.time_ns > 0).map(|p| p.time_ns as f64 * 1e-9);
    let time_s = recorded.unwrap_or(number as f64 * DEFAULT_INTERVAL_S);
    let picture = frame.path.clone();
    let source = if poses == Poses::Telemetry { PoseSource::Telemetry } else { PoseSource::Dataset };
    match (source, frame.telemetry) {
        (PoseSource::Dataset, _) => {
            let position = EnuFrame::new(home).to_geodetic(frame.view.pose.center);
            Ok(PlaylistItem::from_camera(time_s, position, frame.view.pose.rotation, picture))
        }
        (PoseSource::Telemetry, Some(t)) => {
            let vehicle = t.flight_ypr_deg.unwrap_or([t.gimbal_ypr_deg[0], 0.0, 0.0]);
            Ok(PlaylistItem::from_angles(time_s, t.position, vehicle, t.gimbal_ypr_deg, picture))
        }
        (PoseSource::Telemetry, None) => {
            Err(CliError::input(format!("{}: has no row in gps.csv; play it with --poses dataset", frame.name)))
        }
    }
}
