//! `dgtr init`: a commented mission file to start from, and the reference of all settings.

use std::path::{Path, PathBuf};

use config::geodesy::Geodetic;
use config::mission::{Draft, Mission, reference};
use config::preset::Preset;

use super::{CliError, train::presets};
use crate::cli::output::{out, outln};

/// Writes a mission file to start from; the reference of all settings with --reference.
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
    #[arg(long, value_name = "LAT,LON,ALT", allow_hyphen_values = true, value_parser = numbers::<3>, required_unless_present = "reference")]
    origin: Option<[f64; 3]>,
    /// Width and height of the camera's pictures, pixels.
    #[arg(long, value_name = "WIDTHxHEIGHT", value_parser = size, required_unless_present = "reference")]
    picture: Option<[u32; 2]>,
    /// The camera's horizontal field of view, degrees.
    #[arg(long, value_name = "DEG", value_parser = field_of_view, required_unless_present = "reference")]
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

fn numbers<const N: usize>(text: &str) -> Result<[f64; N], String> {
    let read: Option<Vec<f64>> = text.split(',').map(|n| n.trim().parse().ok()).collect();
    read.and_then(|n| n.try_into().ok()).ok_or_else(|| format!("give {N} numbers with commas between them"))
}

fn size(text: &str) -> Result<[u32; 2], String> {
    let read = text.split_once('x').and_then(|(w, h)| Some([w.parse().ok()?, h.parse().ok()?]));
    read.ok_or_else(|| "give width and height as in 4056x3040".to_owned())
}

fn field_of_view(text: &str) -> Result<f64, String> {
    let within = |deg: &f64| *deg > 1.0 && *deg < 170.0;
    text.parse().ok().filter(within).ok_or_else(|| "give an angle of 1 to 170 degrees".to_owned())
}

fn aircraft(text: &str) -> Result<(String, String), String> {
    let (id, link) = text.split_once('=').ok_or("give an id and a link as in west=udpin:0.0.0.0:14550")?;
    Ok((id.to_owned(), link.to_owned()))
}

/// Runs `dgtr init`.
///
/// # Errors
/// Values that no mission can be made of; a file that is there already or cannot be written.
pub fn run(args: Args) -> Result<(), CliError> {
    let (Some([lat_deg, lon_deg, alt_m]), Some(picture), Some(fov_deg)) = (args.origin, args.picture, args.fov_deg)
    else {
        out!("{}", reference());
        return Ok(());
    };
    let origin = Geodetic { lat_deg, lon_deg, alt_m };
    let Args { name, area_m, aircraft, preset, out, .. } = args;
    let text = Draft { name, origin, picture, fov_deg, area_m, aircraft, preset }.text();
    Mission::parse(&text, Path::new(".")).map_err(CliError::input)?;
    write_new(&out, &text)
        .map_err(|e| CliError::input(format!("{}: {e}; choose another file with --out", out.display())))?;
    outln!("{}: calibrate [camera], say how the camera is mounted ([mount]) and draw the regions", out.display());
    Ok(())
}

fn write_new(path: &Path, text: &str) -> std::io::Result<()> {
    use std::io::Write;
    let mut file = std::fs::File::create_new(path)?;
    file.write_all(text.as_bytes())?;
    file.sync_all()
}
