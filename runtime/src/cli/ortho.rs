//! `dgtr ortho MODEL --out DIR`: orthophoto and heights as Cloud-Optimised GeoTIFF.

use std::io::Read;
use std::path::{Path, PathBuf};

use clap::builder::{PossibleValuesParser, TypedValueParser};
use disk::Disk;
use engine::device::map_renderer;
use engine::ortho::{Map, MapRequest, keep_scratch_in};
use job::console;
use job::interrupt;
use measure::contours;
use measure::heights::{HeightMap, MOST_PIXELS};
use models::formats::model::Chunks;
use survey::coordinates::Reference;
use survey::ortho::files::Written;
use survey::ortho::up::Up;

use super::CliError;
use crate::error::JobError;

/// Arguments of `dgtr ortho`.
#[derive(Debug, clap::Args)]
#[command(
    after_help = "Writes ortho.tif (colour and alpha), dsm.tif (heights, metres), dsm_sigma.tif and ortho_sigma.tif (standard deviations \
                        of heights and of places, metres), world files, small pictures, and map.georef.json. The reference system is \
                        the UTM zone of the model's origin. Standard deviations are those within the map: what the poses put it off by \
                        as a whole is not in them."
)]
pub struct Args {
    /// The .dgtr model.
    pub model: PathBuf,
    /// Folder to write to.
    #[arg(long)]
    pub out: PathBuf,
    /// Side of a pixel on the ground, centimetres; default: that of the training pictures.
    #[arg(long, value_name = "CM")]
    pub gsd: Option<f64>,
    /// West, south, east, north in metres of the reference system; default: what the pictures cover, inside the region.
    #[arg(long, value_name = "W,S,E,N", value_parser = four, allow_hyphen_values = true)]
    pub bounds: Option<[f64; 4]>,
    /// Another projected reference system in metres, by its EPSG code.
    #[arg(long, value_name = "CODE")]
    pub epsg: Option<u16>,
    /// The axis that points up, of a model that is nowhere on Earth [default: what its cameras say].
    #[arg(long, value_name = "AXIS", value_parser = ups(), allow_hyphen_values = true)]
    pub up: Option<Up>,
    /// Leave out ground that fewer training pictures saw.
    #[arg(long, value_name = "N", default_value_t = MapRequest::default().min_views)]
    pub min_views: usize,
    /// Leave out ground whose height has a larger standard deviation, or none, centimetres.
    #[arg(long, value_name = "CM", value_parser = above_zero)]
    pub max_sigma: Option<f64>,
    /// Also draw lines of equal height every M metres: contours.geojson and contours.dxf.
    #[arg(long, value_name = "M", value_parser = above_zero)]
    pub contours: Option<f64>,
    /// Device whose name contains this: processor, or a Vulkan device.
    #[arg(long)]
    pub device: Option<String>,
}

fn above_zero(text: &str) -> Result<f64, String> {
    let metres = text.parse().ok().filter(|v: &f64| v.is_finite() && *v > 0.0);
    metres.ok_or_else(|| "a length above zero is needed".to_owned())
}

fn ups() -> impl TypedValueParser<Value = Up> {
    let names = Up::NAMED.map(|(name, _)| name);
    PossibleValuesParser::new(names).try_map(|name| Up::named(&name).ok_or("no such axis"))
}

fn four(text: &str) -> Result<[f64; 4], String> {
    let numbers: Result<Vec<f64>, _> = text.split(',').map(|n| n.trim().parse()).collect();
    let numbers = numbers.ok().and_then(|n| n.try_into().ok());
    numbers.ok_or_else(|| "four numbers with commas between them are needed: west, south, east, north".to_owned())
}

/// Runs `dgtr ortho`.
///
/// # Errors
/// Whatever ends the command; its kind is the exit code.
pub fn run(args: Args) -> Result<(), CliError> {
    let model = Chunks::open(&args.model)?;
    let request = MapRequest {
        gsd: args.gsd.map(|cm| cm / 100.0),
        epsg: args.epsg,
        bounds: args.bounds,
        min_views: args.min_views,
        max_sigma_m: args.max_sigma.map(|cm| cm / 100.0),
        up: args.up,
        ..MapRequest::default()
    };
    let map = Map::of_file(&model, &request)?;
    let [columns, rows] = map.grid().size();
    let mut progress = console::Progress::new("drawing", map.grid().blocks().count() as u64);
    let written = draw(&map, &model, &args.out, args.device.as_deref(), &mut progress)?;
    if let Some(local) = model.header.local {
        tracing::info!("{}: the map's metres are not those of the pictures' poses ({local})", args.out.display());
    }
    if let Some(interval) = args.contours {
        draw_contours(&args.out, interval, map.surface().side())?;
    }
    let crs = map.grid().crs().epsg().map_or("the model's own metres".to_owned(), |code| format!("EPSG:{code}"));
    let worth = match written.sigma_m {
        [Some(height), Some(plane)] => {
            format!("heights within ± {height:.3} m and places within ± {plane:.3} m of each other (medians)")
        }
        _ => "nothing vouches for its heights: fewer than two pictures show them".to_owned(),
    };
    progress.finish(&format!(
        "{}: {columns} × {rows} pixels of {:.3} m in {crs}, {:.1} % covered, {worth}",
        args.out.display(),
        map.grid().gsd(),
        100.0 * written.covered as f64 / (f64::from(columns) * f64::from(rows)),
    ));
    Ok(())
}

/// Draws a model's map into a folder.
fn draw(
    map: &Map,
    model: &Chunks,
    out: &Path,
    device: Option<&str>,
    progress: &mut console::Progress,
) -> Result<Written, CliError> {
    let mut trainer = map_renderer(device, model)?;
    let stop = interrupt::Interrupt::install()?;
    let [columns, rows] = map.grid().size();
    std::fs::create_dir_all(out).map_err(JobError::io(out))?;
    keep_scratch_in(out);
    let written = map.write(&mut trainer, &model.header, (&Disk::default(), out), |done, _| {
        progress.set(done as u64, || format!("{columns} × {rows} pixels"));
        !stop.requested()
    })?;
    written.ok_or_else(|| CliError::interrupted(format!("stopped; no new map in {}", out.display())))
}

/// The heights that `path` is or holds: a raster, a map's folder, or a model, of which a map is drawn into `into` first.
pub(super) fn heights_of(path: &Path, into: Option<&Path>, device: Option<&str>) -> Result<PathBuf, CliError> {
    if path.is_dir() {
        return Ok(path.join("dsm.tif"));
    }
    if !is_model(path) {
        return Ok(path.to_owned());
    }
    let into = into.ok_or_else(|| {
        CliError::input(format!("{}: is a model; give --out, where a map of it is drawn first", path.display()))
    })?;
    let model = Chunks::open(path)?;
    let map = Map::of_file(&model, &MapRequest::default())?;
    let mut progress = console::Progress::new("drawing", map.grid().blocks().count() as u64);
    draw(&map, &model, into, device, &mut progress)?;
    progress.finish(&format!("{}: a map of {}", into.display(), path.display()));
    Ok(into.join("dsm.tif"))
}

/// By its first bytes: a TIFF begins with its byte order.
fn is_model(path: &Path) -> bool {
    let mut head = [0; 4];
    let read = disk::regular::open(path).and_then(|mut file| file.read_exact(&mut head));
    read.is_ok() && &head == b"dgtr"
}

/// Draws lines of equal height of the map in `folder`, of the means of squares of `side` pixels: nearer heights share their rays.
fn draw_contours(folder: &Path, interval: f64, side: usize) -> Result<(), CliError> {
    let mut map = HeightMap::open(&folder.join("dsm.tif"))?;
    let reference = map.epsg().and_then(|code| Reference::named(&format!("EPSG:{code}"))).transpose();
    let reference = reference.map_err(CliError::input)?;
    let Some(heights) = map.part(map.bounds(), MOST_PIXELS)? else { return Ok(()) };
    let contours = contours::draw(&heights.coarser(side), interval)?;
    let disk = Disk::default();
    let [geojson, dxf] = ["contours.geojson", "contours.dxf"].map(|name| folder.join(name));
    disk.replace(&geojson, |file| contours::write_geojson(file, &contours, reference.as_ref()))
        .map_err(|e| JobError::io(&geojson)(e.into()))?;
    disk.replace(&dxf, |file| contours::write_dxf(file, &contours)).map_err(|e| JobError::io(&dxf)(e.into()))?;
    Ok(())
}
