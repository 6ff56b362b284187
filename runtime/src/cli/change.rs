//! `dgtr change OLD NEW --out DIR`: what differs between two maps of one place.

use std::path::{Path, PathBuf};

use disk::Disk;
use measure::change::{Change, Dated, MOST_COMPARED, find, write};
use measure::heights::HeightMap;
use serde::Serialize;
use survey::coordinates::Reference;

use super::CliError;
use super::ortho::heights_of;
use crate::cli::output::outln;
use crate::error::JobError;

/// Changes that are printed; the files hold all.
const PRINTED: usize = 20;

/// Arguments of `dgtr change`.
#[derive(Debug, clap::Args)]
#[command(
    after_help = "Writes change.geojson, change.kml (where the map is on Earth), change.csv, change.tif (metres and standard \
                  deviations) and change.json. Ground that one of the two did not see, or for whose height nothing vouches \
                  (no value in the dsm_sigma.tif beside it), is no change. What a map has wrong by more than it says is one."
)]
pub struct Args {
    /// The older date: a GeoTIFF of heights, the folder of a map, or a .dgtr model.
    pub old: PathBuf,
    /// The newer date.
    pub new: PathBuf,
    /// Folder to write to.
    #[arg(long, value_name = "DIR")]
    pub out: PathBuf,
    /// Device whose name contains this: processor, or a Vulkan device, for models.
    #[arg(long)]
    pub device: Option<String>,
}

/// What `change.json` says.
#[derive(Serialize)]
struct Answer<'a> {
    old: &'a Path,
    new: &'a Path,
    registration: &'a measure::change::register::Registration,
    compared_m2: f64,
    unseen_m2: f64,
    changes: usize,
}

/// Runs `dgtr change`.
///
/// # Errors
/// Whatever ends the command; its kind is the exit code.
pub fn run(args: Args) -> Result<(), CliError> {
    let device = args.device.as_deref();
    let old = heights_of(&args.old, Some(&args.out.join("old")), device)?;
    let new = heights_of(&args.new, Some(&args.out.join("new")), device)?;
    let (mut before, mut after) = (HeightMap::open(&old)?, HeightMap::open(&new)?);
    if before.epsg() != after.epsg() {
        return Err(CliError::input(format!(
            "{} and {} are in different reference systems; gdalwarp -t_srs brings one into the other's",
            old.display(),
            new.display()
        )));
    }
    let apart = || CliError::input(format!("{} and {} have no ground in common", old.display(), new.display()));
    let common = before.common(&after).ok_or_else(apart)?;
    let dated = |map: &mut HeightMap| -> Result<Dated, CliError> {
        let heights = map.part(common, MOST_COMPARED)?.ok_or_else(apart)?;
        let sigmas = map.sigmas()?.map(|mut map| map.part(common, MOST_COMPARED)).transpose()?.flatten();
        Ok(Dated { heights, sigmas })
    };
    let (earlier, later) = (dated(&mut before)?, dated(&mut after)?);
    let change = find(&earlier, &later)?;
    let reference = after.epsg().and_then(|code| Reference::named(&format!("EPSG:{code}"))).transpose();
    let reference = reference.map_err(CliError::input)?;
    let pixel_m2 = later.heights.pixel_m2();
    let unseen = change.difference.metres.iter().filter(|m| m.is_nan()).count();
    let answer = Answer {
        old: &old,
        new: &new,
        registration: &change.registration,
        compared_m2: (change.difference.metres.len() - unseen) as f64 * pixel_m2,
        unseen_m2: unseen as f64 * pixel_m2,
        changes: change.spots.len(),
    };
    save(&args.out, &change, &answer, reference.as_ref(), after.epsg())?;
    print(&change, &answer);
    Ok(())
}

fn print(change: &Change, answer: &Answer<'_>) {
    let r = &change.registration;
    let [east, north, up] = [0, 1, 2].map(|k| format!("{:+.3} ± {:.3}", r.shift_m[k], r.sigma_m[k]));
    outln!("the older map is moved by {east} m east, {north} m north, {up} m up");
    outln!(
        "heights differ by ± {:.3} m where nothing changed ({:.0} % of {:.0} m² compared)",
        r.noise_m,
        100.0 * r.unchanged,
        answer.compared_m2
    );
    outln!("{} changes", change.spots.len());
    for (k, s) in change.spots.iter().take(PRINTED).enumerate() {
        outln!(
            "{:>4}  {:>10.2} m²  {:>+8.2} ± {:.2} m  {:>+10.2} ± {:.2} m³  at {:.1}, {:.1}",
            k + 1,
            s.area_m2,
            s.height_m.value,
            s.height_m.sigma,
            s.volume_m3.value,
            s.volume_m3.sigma,
            s.middle.x,
            s.middle.y
        );
    }
    if change.spots.len() > PRINTED {
        outln!("      and {} more in change.csv", change.spots.len() - PRINTED);
    }
}

fn save(
    out: &Path,
    change: &Change,
    answer: &Answer<'_>,
    reference: Option<&Reference>,
    epsg: Option<u16>,
) -> Result<(), CliError> {
    let disk = Disk::default();
    std::fs::create_dir_all(out).map_err(JobError::io(out))?;
    let file = |name: &str, fill: &dyn Fn(&mut dyn std::io::Write) -> std::io::Result<()>| {
        let path = out.join(name);
        disk.replace(&path, |file| fill(file)).map_err(|e| JobError::io(&path)(e.into()))
    };
    file("change.geojson", &|to| write::geojson(to, &change.spots, reference))?;
    if let Some(reference) = reference {
        file("change.kml", &|to| write::kml(to, &change.spots, reference))?;
    }
    file("change.csv", &|to| write::table(to, &change.spots))?;
    let raster = write::raster(&change.difference, epsg)?;
    file("change.tif", &|to| to.write_all(&raster))?;
    let json = serde_json::to_vec_pretty(answer).map_err(CliError::failed)?;
    file("change.json", &|to| to.write_all(&json))?;
    Ok(())
}
