//! `dgtr init`: a commented mission file to start from, and the reference of all settings.

use std::io::{IsTerminal, stderr, stdin};
use std::path::{Path, PathBuf};

use config::mission::{Draft, DraftArea, Mission, reference};
use config::preset::Preset;
use geometry::geodesy::Geodetic;

use super::{CliError, train::presets};
use crate::cli::output::{out, outln};
use ask::Terminal;

mod ask;

/// Writes a mission file to start from; the reference of all settings with --reference. Without --origin, --picture and --fov-deg
/// it asks, where there is a terminal.
#[derive(Debug, clap::Args)]
pub struct Args {
    /// Print every setting with its default, unit, limits and source, and write nothing.
    #[arg(long, exclusive = true)]
    reference: bool,
    /// The file to write; one that exists is left alone.
    #[arg(long, value_name = "FILE", default_value = "mission.toml")]
    out: PathBuf,
    /// Short name of the mission.
    #[arg(long, default_value = "mission")]
    name: String,
    /// Middle of the area: latitude and longitude in degrees, height in metres as the autopilot reports it.
    #[arg(long, value_name = "LAT,LON,ALT", allow_hyphen_values = true, value_parser = numbers::<3>)]
    origin: Option<[f64; 3]>,
    /// Width and height of the camera's pictures, pixels.
    #[arg(long, value_name = "WIDTHxHEIGHT", value_parser = size)]
    picture: Option<[u32; 2]>,
    /// The camera's horizontal field of view, degrees.
    #[arg(long, value_name = "DEG", value_parser = field_of_view)]
    fov_deg: Option<f64>,
    /// Extent of the area, metres east-west and north-south; split among the aircraft from west to east.
    #[arg(long, value_name = "EAST,NORTH", value_parser = numbers::<2>, default_value = "200,200")]
    area_m: [f64; 2],
    /// An aircraft and the link to its autopilot; once for each.
    #[arg(long, value_name = "ID=LINK", value_parser = aircraft, default_value = "drone=serial:/dev/ttyAMA0:921600")]
    aircraft: Vec<(String, String)>,
    /// Budgets of a size of job.
    #[arg(long, value_parser = presets())]
    preset: Option<Preset>,
}

pub(super) fn numbers<const N: usize>(text: &str) -> Result<[f64; N], String> {
    let read: Option<Vec<f64>> = text.split(',').map(|n| n.trim().parse().ok()).collect();
    read.and_then(|n| n.try_into().ok()).ok_or_else(|| format!("give {N} numbers with commas between them"))
}

pub(super) fn size(text: &str) -> Result<[u32; 2], String> {
    let read = text.split_once('x').and_then(|(w, h)| Some([w.parse().ok()?, h.parse().ok()?]));
    read.ok_or_else(|| "give width and height as in 4056x3040".to_owned())
}

pub(super) fn field_of_view(text: &str) -> Result<f64, String> {
    let within = |deg: &f64| *deg > 1.0 && *deg < 170.0;
    text.parse().ok().filter(within).ok_or_else(|| "give an angle of 1 to 170 degrees".to_owned())
}

fn aircraft(text: &str) -> Result<(String, String), String> {
    let (id, link) = text.split_once('=').ok_or("give an id and a link as in west=udpin:0.0.0.0:14550")?;
    Ok((id.to_owned(), link.to_owned()))
}

/// Ids and links with spaces between them.
fn fleet(text: &str) -> Result<Vec<(String, String)>, String> {
    text.split_whitespace().map(aircraft).collect()
}

/// What only the author of a mission knows.
struct Given {
    name: String,
    origin: [f64; 3],
    picture: [u32; 2],
    fov_deg: f64,
    area_m: [f64; 2],
    aircraft: Vec<(String, String)>,
}

/// Asks for all of it; what was given on the command line is what an empty answer means.
fn asked(args: &Args) -> std::io::Result<Given> {
    let mut terminal = Terminal::new(stdin().lock(), stderr());
    let list = |numbers: &[f64]| numbers.iter().map(f64::to_string).collect::<Vec<_>>().join(",");
    let links: Vec<String> = args.aircraft.iter().map(|(id, link)| format!("{id}={link}")).collect();
    // Somewhere for a simulator to fly; picture and angle are the help's example.
    let origin = args.origin.map_or("47.4,8.5,430".to_owned(), |o| list(&o));
    let picture = args.picture.map_or("4056x3040".to_owned(), |[w, h]| format!("{w}x{h}"));
    let fov = args.fov_deg.unwrap_or(62.0).to_string();
    Ok(Given {
        name: terminal.ask("Name of the mission", &args.name, |text| Ok(text.to_owned()))?,
        origin: terminal.ask(
            "Middle of the area: latitude, longitude (degrees), height (m); Enter to simulate",
            &origin,
            numbers::<3>,
        )?,
        area_m: terminal.ask("Its extent east-west and north-south, metres", &list(&args.area_m), numbers::<2>)?,
        picture: terminal.ask("Size of the camera's pictures, pixels", &picture, size)?,
        fov_deg: terminal.ask("Its horizontal field of view, degrees", &fov, field_of_view)?,
        aircraft: terminal.ask(
            "Aircraft and their links, as in west=serial:/dev/ttyAMA0:921600 east=udpin:0.0.0.0:14550",
            &links.join(" "),
            fleet,
        )?,
    })
}

/// Runs `dgtr init`.
///
/// # Errors
/// Values that no mission can be made of; a file that is there already or cannot be written; nobody to ask for what is missing.
pub fn run(args: Args) -> Result<(), CliError> {
    if args.reference {
        out!("{}", reference());
        return Ok(());
    }
    let given = match (args.origin, args.picture, args.fov_deg) {
        (Some(origin), Some(picture), Some(fov_deg)) => {
            let (name, aircraft) = (args.name.clone(), args.aircraft.clone());
            Given { name, origin, picture, fov_deg, area_m: args.area_m, aircraft }
        }
        _ if args.out.exists() => return Err(taken(&args.out, "it is there already")),
        _ if stdin().is_terminal() => {
            asked(&args).map_err(|e| CliError::input(format!("questions not answered ({e}); nothing was written")))?
        }
        _ => {
            return Err(CliError::input(
                "init: give --origin LAT,LON,ALT, --picture WIDTHxHEIGHT and --fov-deg DEG; on a terminal it asks for them",
            ));
        }
    };
    let Given { name, origin: [lat_deg, lon_deg, alt_m], picture, fov_deg, area_m, aircraft } = given;
    let origin = Geodetic { lat_deg, lon_deg, alt_m };
    let text = Draft {
        name,
        origin,
        picture,
        fov_deg,
        area: DraftArea::Box(area_m),
        aircraft,
        preset: args.preset,
        survey: None,
    }
    .text();
    Mission::parse(&text, Path::new(".")).map_err(CliError::input)?;
    write_new(&args.out, &text).map_err(|e| taken(&args.out, e))?;
    let file = args.out.display();
    outln!("{file}: calibrate [camera], say how the camera is mounted ([mount]) and draw the regions");
    outln!("next: dgtr doctor --mission {file}, dgtr plan --mission {file}, dgtr fly --mission {file} --out out");
    Ok(())
}

fn taken(file: &Path, why: impl std::fmt::Display) -> CliError {
    CliError::input(format!("{}: {why}; choose another file with --out", file.display()))
}

fn write_new(path: &Path, text: &str) -> std::io::Result<()> {
    use std::io::Write;
    let mut file = std::fs::File::create_new(path)?;
    file.write_all(text.as_bytes())?;
    file.sync_all()
}
