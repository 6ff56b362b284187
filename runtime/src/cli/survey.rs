//! `dgtr survey AREA --aircraft N --out DIR`: an area dealt to a fleet, with a mission and a plan for each flight.

use std::path::PathBuf;

use super::CliError;
use crate::cli::init::{field_of_view, numbers, size};
use crate::cli::output::outln;
use crate::survey_job::{self, Camera, Flying, MISSION, Pictures, Planned, Request, Rest, Source};

/// Deals an area to a fleet in regions that take equally long to fly, and writes the mission, a plan for each flight, a figure and a
/// table.
#[derive(Debug, clap::Args)]
#[command(
    after_help = "Plans are for QGroundControl, ArduPilot and PX4. Flight times count turns, climbing and landing, in a wind from any \
                  side. Aircraft cross others' ground at heights of their own. Holes are not photographed, but may be flown over. Check each \
                  plan against fences, rules and obstacles."
)]
pub struct Args {
    /// The area: a polygon, with holes or without, as GeoJSON, KML, or the fence of a QGroundControl plan.
    #[arg(required_unless_present = "after")]
    area: Option<PathBuf>,
    /// Folder for mission.toml, the plans, survey.svg and survey.csv.
    #[arg(long, value_name = "DIR")]
    out: PathBuf,
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
    #[arg(long, value_name = "DIR", requires = "mission", conflicts_with = "area")]
    after: Option<PathBuf>,
    /// Mission file that was flown; the one that is written has its regions changed.
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
    /// Seconds that the camera needs from picture to picture.
    #[arg(long, value_name = "S", default_value_t = 1.0)]
    interval: f64,
}

#[derive(Debug, clap::Args)]
struct PictureArgs {
    /// Ground sampling distance, centimetres to a pixel.
    #[arg(long, value_name = "CM")]
    gsd: f64,
    /// Share of a picture seen again by the next one on the line.
    #[arg(long, value_name = "SHARE", default_value_t = 0.75)]
    forward_overlap: f64,
    /// Share of a picture seen again from the next line.
    #[arg(long, value_name = "SHARE", default_value_t = 0.65)]
    side_overlap: f64,
}

#[derive(Debug, clap::Args)]
struct FlightArgs {
    /// Speed over ground, m/s.
    #[arg(long, value_name = "M/S", default_value_t = 8.0)]
    speed: f64,
    /// The fastest that an aircraft flies through the air, m/s.
    #[arg(long, value_name = "M/S", default_value_t = 15.0)]
    fastest: f64,
    /// Wind from any side, m/s.
    #[arg(long, value_name = "M/S", default_value_t = 5.0)]
    wind: f64,
    /// Minutes that a battery lasts, once or for each aircraft.
    #[arg(long, value_name = "MIN", value_delimiter = ',', default_value = "25")]
    endurance: Vec<f64>,
    /// Share of the battery that is left at the landing.
    #[arg(long, value_name = "SHARE", default_value_t = 0.25)]
    reserve: f64,
    /// Where aircraft take off and land, once or for each [default: the area's corner nearest to its middle].
    #[arg(long, value_name = "LAT,LON", allow_hyphen_values = true, value_parser = numbers::<2>)]
    take_off: Vec<[f64; 2]>,
    /// Height of the take-off places as the autopilot reports it, metres.
    #[arg(long, value_name = "M", default_value_t = 0.0, allow_hyphen_values = true, conflicts_with_all = ["terrain", "after"])]
    home_height: f64,
    /// Height above ground that nobody exceeds, metres.
    #[arg(long, value_name = "M", default_value_t = 120.0)]
    highest: f64,
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

fn request(args: &Args) -> Result<Request, CliError> {
    let most = fleet::deal::MOST_CRAFT;
    if args.aircraft > most {
        return Err(CliError::input(format!("--aircraft {}: must be 1 to {most}", args.aircraft)));
    }
    let RestArgs { after, mission, without } = &args.rest;
    let (source, name, aircraft, camera, home_m) = match (after, mission, &args.area) {
        (Some(ground), Some(mission), _) => {
            let rest = Rest::of(mission, ground, without)?;
            let (name, aircraft, camera) = (rest.name().to_owned(), rest.aircraft(), rest.camera());
            let home_m = rest.origin().alt_m;
            (Source::Rest(Box::new(rest)), name, aircraft, camera, home_m)
        }
        (_, _, Some(area)) => {
            let aircraft = (1..=args.aircraft).map(|k| (format!("a{k}"), args.link.clone())).collect();
            (Source::File(area.clone()), args.name.clone(), aircraft, camera(&args.camera)?, args.flight.home_height)
        }
        _ => return Err(CliError::input("survey: give an area, or --after and --mission")),
    };
    let flight = &args.flight;
    Ok(Request {
        source,
        name,
        aircraft,
        camera,
        pictures: Pictures {
            gsd_m: args.pictures.gsd / 100.0,
            forward_overlap: args.pictures.forward_overlap,
            side_overlap: args.pictures.side_overlap,
            interval_s: args.camera.interval,
        },
        flying: Flying {
            speed_m_s: flight.speed,
            fastest_m_s: flight.fastest,
            wind_m_s: flight.wind,
            endurance_min: flight.endurance.clone(),
            reserve: flight.reserve,
            take_off: flight.take_off.clone(),
            highest_m: flight.highest,
        },
        home_m,
        terrain: flight.terrain.clone(),
    })
}

/// Runs `dgtr survey`.
///
/// # Errors
/// Whatever ends the command; its kind is the exit code.
pub fn run(args: Args) -> Result<(), CliError> {
    let request = request(&args)?;
    let planned = survey_job::run(&request, &args.out)?;
    if let Source::Rest(rest) = &request.source {
        outln!("what {} left is dealt to the others", rest.lost.join(", "));
    }
    print(&request, &planned);
    let mission = args.out.join(MISSION);
    outln!("next: load each plan into its aircraft; dgtr doctor --mission {}", mission.display());
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
    outln!("lines reach {:.0} m beyond the area", planned.beyond_m);
    if planned.holes > 0 {
        tracing::warn!(
            "holes of the area are left out of the pictures, and not avoided: {} lines reach into them, and {} ways to, from and between \
             lines lead over them",
            planned.lines_over_holes,
            planned.over_holes
        );
    }
    outln!("{:<20} {:>9} {:>8} {:>7} {:>6} {:>10}", "plan", "pictures", "min", "km", "side", "region ha");
    for row in &planned.rows {
        let plan = row.plan.file_name().unwrap_or_default().to_string_lossy();
        let side = format!("{:.0} %", 100.0 * row.side_overlap);
        outln!("{plan:<20} {:>9} {:>8.1} {:>7.2} {side:>6} {:>10.2}", row.pictures, row.minutes, row.km, row.hectares);
    }
}
