//! `dgtr volume HEIGHTS AREAS`: how much lies above and below the ground of polygons.

use std::path::{Path, PathBuf};

use disk::Disk;
use geometry::polygon;
use glam::DVec2;
use measure::areas::{self, Area};
use measure::base::Kind;
use measure::heights::{HeightMap, Heights, MOST_PIXELS};
use measure::noise::{Apart, Noise, apart};
use measure::volume::{Below, Volume, measure, write_table};
use serde::Serialize;

use super::CliError;
use super::ortho::heights_of;
use crate::cli::output::outln;
use crate::error::JobError;

/// The part of a map around an area that is read with it: of the area's own size, each side.
const AROUND: f64 = 0.5;

/// Arguments of `dgtr volume`.
#[derive(Debug, clap::Args)]
#[command(
    after_help = "A standard deviation counts noise with the square root of the area, and what all heights have in common with the \
                  area. Without --sigma the noise is told from the map's own roughness."
)]
pub struct Args {
    /// Heights: a GeoTIFF, the folder of a map, or a .dgtr model.
    pub heights: PathBuf,
    /// Polygons: GeoJSON or KML.
    pub areas: PathBuf,
    /// The ground below: lowest, plane or triangulated of the polygon's rim, or another map or model.
    #[arg(long, value_name = "GROUND", default_value = "triangulated")]
    pub base: String,
    /// Standard deviation of a height, centimetres.
    #[arg(long, value_name = "CM", value_parser = centimetres)]
    pub sigma: Option<f64>,
    /// Errors nearer to each other than this are one, metres.
    #[arg(long, value_name = "M", value_parser = centimetres, requires = "sigma")]
    pub reach: Option<f64>,
    /// Standard deviation of what two maps are apart, centimetres [default: what the ground around the polygons says].
    #[arg(long, value_name = "CM", value_parser = centimetres)]
    pub bias: Option<f64>,
    /// Folder for volumes.csv and volumes.json, and for the map of a model.
    #[arg(long, value_name = "DIR")]
    pub out: Option<PathBuf>,
    /// Device whose name contains this: processor, or a Vulkan device, for a model.
    #[arg(long)]
    pub device: Option<String>,
}

fn centimetres(text: &str) -> Result<f64, String> {
    text.parse()
        .ok()
        .filter(|v: &f64| v.is_finite() && *v >= 0.0)
        .ok_or_else(|| "a length is needed, zero or more".into())
}

/// What `volumes.json` says.
#[derive(Serialize)]
struct Answer<'a> {
    heights: &'a Path,
    base: &'a str,
    noise: Noise,
    #[serde(skip_serializing_if = "Option::is_none")]
    base_noise: Option<Noise>,
    /// What was found around the polygons; it is taken off.
    #[serde(skip_serializing_if = "Option::is_none")]
    apart: Option<Apart>,
    noise_from: &'static str,
    volumes: &'a [Volume],
}

/// Runs `dgtr volume`.
///
/// # Errors
/// Whatever ends the command; its kind is the exit code.
pub fn run(args: Args) -> Result<(), CliError> {
    let path =
        heights_of(&args.heights, args.out.as_ref().map(|out| out.join("map")).as_deref(), args.device.as_deref())?;
    let mut map = HeightMap::open(&path)?;
    let drawn = areas::read(&args.areas, map.epsg())?;
    if drawn.others > 0 {
        tracing::warn!("{}: {} features are no polygons and are left out", args.areas.display(), drawn.others);
    }
    let bounds = around(&drawn.areas);
    let nothing = |path: &Path| {
        CliError::input(format!("{}: holds nothing of the polygons of {}", path.display(), args.areas.display()))
    };
    let heights = map.part(bounds, MOST_PIXELS)?.ok_or_else(|| nothing(&path))?;
    let noise = worth(&args, &path, &heights)?;
    let mut answer = Answer {
        heights: &path,
        base: &args.base,
        noise,
        base_noise: None,
        apart: None,
        noise_from: if args.sigma.is_some() { "given" } else { "the map's own roughness" },
        volumes: &[],
    };
    let kind = Kind::NAMED.iter().find(|(name, _)| *name == args.base).map(|(_, kind)| *kind);
    let volumes: Result<Vec<Volume>, _> = match kind {
        Some(kind) => {
            let below = Below::Rim(kind);
            drawn.areas.iter().map(|area| measure(area, &heights, &noise, &below)).collect()
        }
        None => {
            let into = args.out.as_ref().map(|out| out.join("base"));
            let base = heights_of(Path::new(&args.base), into.as_deref(), args.device.as_deref())?;
            let mut before = HeightMap::open(&base).map_err(|e| {
                CliError::input(format!(
                    "--base {}: is none of lowest, plane, triangulated, and no map: {e}",
                    args.base
                ))
            })?;
            if before.epsg() != map.epsg() {
                return Err(CliError::input(format!(
                    "{} and {} are in different reference systems; gdalwarp -t_srs brings one into the other's",
                    path.display(),
                    base.display()
                )));
            }
            let before = before.part(bounds, MOST_PIXELS)?.ok_or_else(|| nothing(&base))?;
            let base_noise = worth(&args, &base, &before)?;
            answer.base_noise = Some(base_noise);
            let (before, noise) = match args.bias {
                Some(bias) => (before, Noise { bias_m: bias / 100.0, ..noise }),
                None => {
                    let outside = |p: DVec2| !drawn.areas.iter().any(|a| polygon::contains(&a.outside, p));
                    let found = apart(&heights, &before, [&noise, &base_noise], outside).ok_or_else(|| {
                        CliError::input("too little of both maps lies around the polygons to tell how far they are apart; give --bias")
                    })?;
                    answer.apart = Some(found);
                    (before.lifted(found.offset_m), Noise { bias_m: found.sigma_m, ..noise })
                }
            };
            answer.noise = noise;
            let below = Below::Map(&before, base_noise);
            drawn.areas.iter().map(|area| measure(area, &heights, &noise, &below)).collect()
        }
    };
    let volumes = volumes?;
    answer.volumes = &volumes;
    print(&answer);
    if let Some(out) = &args.out {
        write(out, &answer)?;
    }
    Ok(())
}

/// The box around all areas and the ground around them.
fn around(areas: &[Area]) -> [DVec2; 2] {
    let [low, high] = areas
        .iter()
        .map(Area::bounds)
        .fold([DVec2::INFINITY, DVec2::NEG_INFINITY], |[a, b], [low, high]| [a.min(low), b.max(high)]);
    let more = AROUND * (high - low);
    [low - more, high + more]
}

fn worth(args: &Args, path: &Path, heights: &Heights) -> Result<Noise, CliError> {
    let given = args.sigma.map(|cm| Noise { sigma_m: cm / 100.0, reach_m: heights.gsd(), bias_m: 0.0 });
    let noise = given.or_else(|| Noise::of(heights)).ok_or_else(|| {
        CliError::input(format!("{}: too few heights to tell what they are worth; give --sigma", path.display()))
    })?;
    Ok(Noise { reach_m: args.reach.unwrap_or(noise.reach_m), ..noise })
}

fn print(answer: &Answer<'_>) {
    let noise = &answer.noise;
    outln!(
        "a height is worth ± {:.3} m (from {}), errors reach {:.2} m",
        noise.sigma_m,
        answer.noise_from,
        noise.reach_m
    );
    if let Some(apart) = &answer.apart {
        outln!(
            "the maps are {:+.3} ± {:.3} m apart around the polygons; it is taken off",
            apart.offset_m,
            apart.sigma_m
        );
    }
    outln!("{:<24} {:>12} {:>20} {:>20} {:>20}", "name", "area m²", "cut m³", "fill m³", "net m³");
    for v in answer.volumes {
        let [cut, fill, net] = [v.cut_m3, v.fill_m3, v.net_m3].map(|m| format!("{:.2} ± {:.2}", m.value, m.sigma));
        outln!("{:<24} {:>12.2} {cut:>20} {fill:>20} {net:>20}", disk::escaped(&v.name), v.area_m2);
        if v.unseen_m2 > 0.01 * v.area_m2 {
            tracing::warn!(
                "{}: the map holds no height on {:.0} % of it; the volumes are of the rest",
                v.name,
                100.0 * v.unseen_m2 / v.area_m2
            );
        }
    }
}

fn write(out: &Path, answer: &Answer<'_>) -> Result<(), CliError> {
    let disk = Disk::default();
    std::fs::create_dir_all(out).map_err(JobError::io(out))?;
    let table = out.join("volumes.csv");
    disk.replace(&table, |file| write_table(file, answer.volumes)).map_err(|e| JobError::io(&table)(e.into()))?;
    let json = serde_json::to_vec_pretty(answer).map_err(CliError::failed)?;
    let path = out.join("volumes.json");
    disk.replace(&path, |file| file.write_all(&json)).map_err(|e| JobError::io(&path)(e.into()))?;
    Ok(())
}
