//! `dgtr survey AREA --aircraft N --out DIR`: an area dealt to a fleet, with a mission and a plan for each flight.

use std::path::{Path, PathBuf};

use config::survey::SurveySettings;

use super::CliError;
use crate::cli::init::{field_of_view, numbers, size};
use crate::cli::output::outln;
use crate::survey_job::{self, Camera, Flying, MISSION, Pictures, Planned, Request, Rest, Source};

/// Deals an area to a fleet in regions that take equally long to fly, and writes the mission, a plan for each flight, a figure and a
/// table.
#[derive(Debug, clap::Args)]
#[command(
    after_help = "Plans are for QGroundControl, ArduPilot and PX4. Flight times count turns, climbing and landing, in a wind from any \
                  side. Aircraft cross others' ground at heights of their own. Holes are not photographed, and flown round. Check each \
                  plan against fences, rules and obstacles. With --after, what is not given is as it was planned before."
)]
pub struct Args {
    /// The area: a polygon, with holes or without, as GeoJSON, KML, or the fence of a QGroundControl plan.
    #[arg(required_unless_present = "after")]
    area: Option<PathBuf>,
    /// Folder for mission.toml, the plans, survey.svg and survey.csv [default with --after: a new one beside that folder].
    #[arg(long, value_name = "DIR", required_unless_present = "after")]
    out: Option<PathBuf>,
    /// Number of aircraft.
    #[arg(long, value_name = "N", default_value_t = 1, conflicts_with = "after")]
    aircraft: usize,
    /// Short name of the mission.
    #[arg(long, default_value = "survey", conflicts_with = "after")]
    name: String,
    /// Link from each companion computer to its autopilot.
    #[arg(long, value_name = "ADDRESS", default_value = "serial:/dev/ttyAMA0:921600", conflicts_with = "after")]
    link: String,
    #[command(flatten, next_help_heading = "When an aircraft failed")]
    rest: RestArgs,
    #[command(flatten, next_help_heading = "Camera")]
    camera: CameraArgs,
    #[command(flatten, next_help_heading = "Pictures")]
    pictures: PictureArgs,
    #[command(flatten, next_help_heading = "Flight")]
    flight: FlightArgs,
}

#[derive(Debug, clap::Args)]
struct RestArgs {
    /// Folder of dgtr serve: what its models do not cover is dealt to the aircraft that are left.
    #[arg(long, value_name = "DIR", conflicts_with = "area")]
    after: Option<PathBuf>,
    /// Mission file that was flown [default: the one that dgtr serve keeps in that folder].
    #[arg(long, value_name = "FILE", requires = "after")]
    mission: Option<PathBuf>,
    /// An aircraft that does not fly any more, once for each [default: those whose final model did not arrive].
    #[arg(long, value_name = "ID", requires = "after")]
    without: Vec<String>,
}

#[derive(Debug, clap::Args)]
struct CameraArgs {
    /// Width and height of the camera's pictures, pixels.
    #[arg(long, value_name = "WIDTHxHEIGHT", value_parser = size, required_unless_present = "after", conflicts_with = "after")]
    picture: Option<[u32; 2]>,
    /// The camera's horizontal field of view, degrees.
    #[arg(long, value_name = "DEG", value_parser = field_of_view, required_unless_present_any = ["focal_mm", "after"],
        conflicts_with_all = ["focal_mm", "after"])]
    fov_deg: Option<f64>,
    /// Focal length, millimetres, with --sensor-mm.
    #[arg(long, value_name = "MM", requires = "sensor_mm", conflicts_with = "after")]
    focal_mm: Option<f64>,
    /// Width of the sensor, millimetres.
    #[arg(long, value_name = "MM", requires = "focal_mm")]
    sensor_mm: Option<f64>,
    /// Seconds that the camera needs from picture to picture [default: 1].
    #[arg(long, value_name = "S")]
    interval: Option<f64>,
}

#[derive(Debug, clap::Args)]
struct PictureArgs {
    /// Ground sampling distance, centimetres to a pixel.
    #[arg(long, value_name = "CM", required_unless_present = "after")]
    gsd: Option<f64>,
    /// Share of a picture seen again by the next one on the line [default: 0.75].
    #[arg(long, value_name = "SHARE")]
    forward_overlap: Option<f64>,
    /// Share of a picture seen again from the next line [default: 0.65].
    #[arg(long, value_name = "SHARE")]
    side_overlap: Option<f64>,
}

#[derive(Debug, clap::Args)]
struct FlightArgs {
    /// Speed over ground, m/s [default: 8].
    #[arg(long, value_name = "M/S")]
    speed: Option<f64>,
    /// The fastest that an aircraft flies through the air, m/s [default: 15].
    #[arg(long, value_name = "M/S")]
    fastest: Option<f64>,
    /// Wind from any side, m/s [default: 5].
    #[arg(long, value_name = "M/S")]
    wind: Option<f64>,
    /// Minutes that a battery lasts, once or for each aircraft [default: 25].
    #[arg(long, value_name = "MIN", value_delimiter = ',')]
    endurance: Vec<f64>,
    /// Share of the battery that is left at the landing [default: 0.25].
    #[arg(long, value_name = "SHARE")]
    reserve: Option<f64>,
    /// Where aircraft take off and land, once or for each [default: the area's corner nearest to its middle].
    #[arg(long, value_name = "LAT,LON", allow_hyphen_values = true, value_parser = numbers::<2>)]
    take_off: Vec<[f64; 2]>,
    /// Height of the take-off places as the autopilot reports it, metres [default: 0].
    #[arg(long, value_name = "M", allow_hyphen_values = true, conflicts_with_all = ["terrain", "after"])]
    home_height: Option<f64>,
    /// Height above ground that nobody exceeds, metres [default: 120].
    #[arg(long, value_name = "M")]
    highest: Option<f64>,
    /// Room that is kept around holes of the area, metres [default: 10].
    #[arg(long, value_name = "M")]
    clearance: Option<f64>,
    /// Heights of the ground, a GeoTIFF: lines follow it.
    #[arg(long, value_name = "GEOTIFF")]
    terrain: Option<PathBuf>,
}

/// The camera that the options describe.
fn camera(args: &CameraArgs) -> Result<Camera, CliError> {
    let fov_deg = match (args.fov_deg, args.focal_mm, args.sensor_mm) {
        (Some(fov), ..) => fov,
        (_, Some(focal), Some(sensor)) if focal > 0.0 && sensor > 0.0 => {
            2.0 * (sensor / (2.0 * focal)).atan().to_degrees()
        }
        _ => return Err(CliError::input("survey: --focal-mm and --sensor-mm must be lengths above zero")),
    };
    let picture = args.picture.ok_or_else(|| CliError::input("survey: give --picture WIDTHxHEIGHT"))?;
    Ok(Camera { picture, fov_deg })
}

/// What is left of a mission, from the folder of its ground station.
fn rest(args: &RestArgs, ground: &Path) -> Result<Rest, CliError> {
    let kept = ground.join(MISSION);
    match &args.mission {
        None if !kept.is_file() => Err(CliError::input(format!(
            "{}: is not there; give the folder that was --out of dgtr serve, or the mission that was flown with --mission",
            kept.display()
        ))),
        file => Ok(Rest::of(file.as_ref().unwrap_or(&kept), ground, &args.without)?),
    }
}

fn request(args: &Args) -> Result<Request, CliError> {
    let most = fleet::deal::MOST_CRAFT;
    if args.aircraft > most {
        return Err(CliError::input(format!("--aircraft {}: must be 1 to {most}", args.aircraft)));
    }
    let Args { pictures, flight, .. } = args;
    let (source, name, aircraft, camera, home_m, before) = match (&args.rest.after, &args.area) {
        (Some(ground), _) => {
            let rest = rest(&args.rest, ground)?;
            let (name, aircraft, camera) = (rest.name().to_owned(), rest.aircraft(), rest.camera());
            let (home_m, before) = (rest.origin().alt_m, rest.settings());
            (Source::Rest(Box::new(rest)), name, aircraft, camera, home_m, before)
        }
        (None, Some(area)) => {
            let aircraft = (1..=args.aircraft).map(|k| (format!("a{k}"), args.link.clone())).collect();
            let home_m = flight.home_height.unwrap_or(0.0);
            (Source::File(area.clone()), args.name.clone(), aircraft, camera(&args.camera)?, home_m, None)
        }
        (None, None) => return Err(CliError::input("survey: give an area, or --after")),
    };
    // The ground sampling distance has no usual value.
    let before = before.unwrap_or_else(|| SurveySettings::usual(f64::NAN));
    let Some(gsd_cm) = pictures.gsd.or(Some(before.gsd_cm).filter(|gsd| gsd.is_finite())) else {
        return Err(CliError::input(
            "survey: the mission does not say how it was planned ([survey]); give --gsd, and what else is not usual",
        ));
    };
    Ok(Request {
        source,
        name,
        aircraft,
        camera,
        pictures: Pictures {
            gsd_m: gsd_cm / 100.0,
            forward_overlap: pictures.forward_overlap.unwrap_or(before.forward_overlap),
            side_overlap: pictures.side_overlap.unwrap_or(before.side_overlap),
            interval_s: args.camera.interval.unwrap_or(before.interval_s),
        },
        flying: Flying {
            speed_m_s: flight.speed.unwrap_or(before.speed_m_s),
            fastest_m_s: flight.fastest.unwrap_or(before.fastest_m_s),
            wind_m_s: flight.wind.unwrap_or(before.wind_m_s),
            endurance_min: if flight.endurance.is_empty() { before.endurance_min } else { flight.endurance.clone() },
            reserve: flight.reserve.unwrap_or(before.reserve),
            take_off: if flight.take_off.is_empty() { before.take_off } else { flight.take_off.clone() },
            highest_m: flight.highest.unwrap_or(before.highest_m),
            clearance_m: flight.clearance.unwrap_or(before.clearance_m),
        },
        home_m,
        terrain: flight.terrain.clone().or(before.terrain),
    })
}

/// Most folders beside a ground station's that are tried.
const MOST_AFTER: u32 = 999;

/// Where everything is written.
fn out(args: &Args) -> Result<PathBuf, CliError> {
    let Some(ground) = args.rest.after.as_ref().filter(|_| args.out.is_none()) else {
        return Ok(args.out.clone().unwrap_or_default());
    };
    // What lies in the folder itself is put aside with it.
    let whole = std::fs::canonicalize(ground)
        .map_err(|e| CliError::input(format!("{}: {}", ground.display(), disk::told(&e))))?;
    let name = whole.file_name().unwrap_or_default().to_string_lossy().into_owned();
    let named = (1..=MOST_AFTER).map(|n| whole.with_file_name(format!("{name}-after-{n}")));
    let free = named.into_iter().find(|path| path.symlink_metadata().is_err());
    free.ok_or_else(|| CliError::input("survey: give --out, as no folder beside that of --after has a free name"))
}

/// Runs `dgtr survey`.
///
/// # Errors
/// Whatever ends the command; its kind is the exit code.
pub fn run(args: Args) -> Result<(), CliError> {
    let (request, out) = (request(&args)?, out(&args)?);
    let planned = survey_job::run(&request, &out)?;
    if let Source::Rest(rest) = &request.source {
        outln!("what {} left is dealt to the others", rest.lost.join(", "));
    }
    print(&request, &planned);
    let mission = out.join(MISSION);
    outln!("next: load each plan into its aircraft; dgtr doctor --mission {}", mission.display());
    if let (Source::Rest(rest), Some(ground)) = (&request.source, &args.rest.after) {
        let flown = args.rest.mission.as_ref().map_or("MISSION".into(), |path| path.display().to_string());
        outln!(
            "on every aircraft and the ground, replace the mission file that was flown by this one: its paths are relative to that \
             file's folder"
        );
        outln!("aircraft fly with the --out of their first flight: their models become those of both flights");
        outln!("the ground goes on: dgtr serve --mission {flown} --out {}", ground.display());
        outln!("what the ground has of {} counts as final; no more is awaited", rest.lost.join(", "));
    }
    Ok(())
}

fn print(request: &Request, planned: &Planned) {
    outln!(
        "{:.1} ha from {:.0} m above ground at {:.1} m/s, {:.1} cm a pixel, forward overlap {:.0} %",
        planned.hectares,
        planned.height_m,
        planned.speed_m_s,
        request.pictures.gsd_m * 100.0,
        request.pictures.forward_overlap * 100.0
    );
    if planned.speed_m_s < request.flying.speed_m_s {
        tracing::warn!(
            "slower than --speed {} m/s, as the camera needs {} s from picture to picture or the wind leaves no more",
            request.flying.speed_m_s,
            request.pictures.interval_s
        );
    }
    if let Some(at) = planned.take_off {
        outln!("take-off and landing at {:.6},{:.6}, the area's corner nearest to its middle", at.lat_deg, at.lon_deg);
    }
    match planned.beyond_m {
        Some(metres) => outln!("lines reach {metres:.0} m beyond the area"),
        None => outln!("no flight leaves the fence; its border is seen in fewer pictures than its middle"),
    }
    if planned.holes > 0 {
        outln!(
            "holes of the area are flown round, {} m off, by {} detours; lines end there",
            request.flying.clearance_m,
            planned.detours
        );
    }
    outln!("{:<20} {:>9} {:>8} {:>7} {:>6} {:>10}", "plan", "pictures", "min", "km", "side", "region ha");
    for row in &planned.rows {
        let plan = row.plan.file_name().unwrap_or_default().to_string_lossy();
        let side = format!("{:.0} %", 100.0 * row.side_overlap);
        outln!("{plan:<20} {:>9} {:>8.1} {:>7.2} {side:>6} {:>10.2}", row.pictures, row.minutes, row.km, row.hectares);
    }
}
