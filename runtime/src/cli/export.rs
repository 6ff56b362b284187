//! `dgtr export MODEL --to ply|spz|delivery|colmap|nerfstudio|opensfm`: the Gaussians for viewers, the poses for other programs.

use std::path::PathBuf;

use clap::ValueEnum;
use config::disk::Disk;
use config::lens::Distortion;
use models::cloud::{GaussianCloud, SH_C0};
use models::dataset::Dataset;
use models::formats::colmap::Point;
use models::formats::delivery::Rounding;
use models::formats::model::ModelHeader;
use models::formats::reconstruction::{LensDescription, Reconstruction, Shot};
use models::formats::{colmap, model, opensfm, ply, spz, transforms};

use super::CliError;

/// Formats that can be written.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub enum Format {
    /// 3DGS point cloud: every viewer reads it; keeps the georeference as a comment.
    Ply,
    /// Niantic's SPZ: a tenth of the size, rounded, without the georeference.
    Spz,
    /// Rounded and entropy-coded .dgtr, about a thirtieth of the exact one: what an aircraft delivers.
    Delivery,
    /// Poses, lenses and Gaussians' centres as a COLMAP model, binary, in a folder.
    Colmap,
    /// Poses and lenses as a transforms.json.
    Nerfstudio,
    /// Poses and lenses as OpenSfM's and OpenDroneMap's reconstruction.json, in a folder.
    Opensfm,
}

/// Arguments of `dgtr export`.
#[derive(Debug, clap::Args)]
pub struct Args {
    /// The .dgtr model.
    pub model: PathBuf,
    /// Format to write.
    #[arg(long = "to", value_enum)]
    pub format: Format,
    /// Where to write; default: beside the model, with the format's extension or name.
    #[arg(long)]
    pub out: Option<PathBuf>,
    /// With `--to delivery`: rounded more finely, for scenes seen from near; a third more bytes.
    #[arg(long)]
    pub fine: bool,
    /// Poses and lenses of this data set (the folder that a card was trained into holds its own) instead of the model's
    /// undistorted views.
    #[arg(long, value_name = "FOLDER")]
    pub cameras: Option<PathBuf>,
}

/// Runs `dgtr export`.
///
/// # Errors
/// Whatever ends the command; its kind is the exit code.
pub fn run(args: Args) -> Result<(), CliError> {
    if args.fine && args.format != Format::Delivery {
        return Err(CliError::input("--fine is for --to delivery; leave it out"));
    }
    let (header, cloud) = model::read(&args.model)?;
    let out = args.out.unwrap_or_else(|| match args.format {
        Format::Ply => args.model.with_extension("ply"),
        Format::Spz => args.model.with_extension("spz"),
        Format::Delivery => args.model.with_extension("delivery.dgtr"),
        Format::Colmap => args.model.with_file_name("colmap"),
        Format::Nerfstudio => args.model.with_file_name("cameras.json"),
        Format::Opensfm => args.model.with_file_name("opensfm"),
    });
    if out == args.model {
        return Err(CliError::input(format!("{}: would overwrite the model; give another --out", out.display())));
    }
    let gaussians = match args.format {
        Format::Ply => ply::write(&out, &cloud, header.origin).map(|()| Some(cloud.len()))?,
        Format::Spz => spz::write(&out, &cloud).map(|()| Some(cloud.len()))?,
        Format::Delivery => {
            let rounding = if args.fine { Rounding::fine() } else { Rounding::default() };
            Some(model::write_rounded(&Disk::default(), &out, &header, &cloud, &rounding)?)
        }
        Format::Colmap | Format::Nerfstudio | Format::Opensfm => None,
    };
    if let Some(n) = gaussians {
        println!("{}: {n} Gaussians, SH degree {}", out.display(), cloud.sh_degree);
        return Ok(());
    }
    let cameras = match &args.cameras {
        Some(folder) => Dataset::open(folder)?.reconstruction(),
        None => views(&header),
    };
    if cameras.shots.is_empty() {
        return Err(CliError::input(format!("{}: keeps no views; give --cameras", args.model.display())));
    }
    match args.format {
        Format::Colmap => colmap::write(&out, &cameras, &points(&cloud))?,
        Format::Nerfstudio => transforms::write(&out, &cameras)?,
        _ => opensfm::write(&out, &cameras)?,
    }
    println!("{}: {} poses", out.display(), cameras.shots.len());
    Ok(())
}

/// What the model was trained on: undistorted pictures of the trained size.
fn views(header: &ModelHeader) -> Reconstruction {
    let shots = header.views.iter().map(|(name, view)| Shot {
        path: name.clone(),
        lens: LensDescription::new(&view.intrinsics, Distortion::default()),
        pose: view.pose,
    });
    Reconstruction { shots: shots.collect(), origin: header.origin }
}

/// Centres and plain colours: what other trainers start from.
fn points(cloud: &GaussianCloud) -> Vec<Point> {
    let stride = cloud.sh_stride();
    let color =
        |i: usize| [0, 1, 2].map(|c| ((0.5 + SH_C0 * cloud.sh[i * stride + c]).clamp(0.0, 1.0) * 255.0).round() as u8);
    let valid = (0..cloud.len()).filter(|i| cloud.is_valid(*i));
    valid.map(|i| Point { position: cloud.means[i].map(f64::from), color: color(i) }).collect()
}
