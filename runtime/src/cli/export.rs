//! `dgtr export MODEL --to …`: the Gaussians for viewers, the poses for other programs.

use std::path::{Path, PathBuf};

use clap::ValueEnum;
use disk::Disk;
use geometry::lens::Distortion;
use glam::DVec3;
use models::camera::Pose;
use models::cloud::{GaussianCloud, SH_C0};
use models::formats::colmap::Point;
use models::formats::delivery::Rounding;
use models::formats::model::{Chunks, ModelHeader};
use models::formats::reconstruction::{LensDescription, Reconstruction, Shot};
use models::formats::spz::{Axes, SpzOptions};
use models::formats::{colmap, gltf, model, opensfm, ply, sog, spz, transforms};
use models::levels;
use pages::viewer::{self, ViewerRequest};
use survey::dataset::Dataset;
use survey::ortho::georef::{FROM_Y_UP, Georef, Rows, shifted};

use super::CliError;
use crate::cli::output::outln;

/// Formats that can be written.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub enum Format {
    /// 3DGS point cloud: every viewer reads it; keeps the georeference as a comment.
    Ply,
    /// Niantic's SPZ: a tenth of the size, rounded.
    Spz,
    /// PlayCanvas' SOG: a tenth of the size, rounded less than SPZ; for viewers in a browser.
    Sog,
    /// Binary glTF (.glb) with KHR_gaussian_splatting.
    Gltf,
    /// A page with the scene and its viewer inside: opens by double click, without a network.
    Html,
    /// A folder with levels of detail that a viewer streams (PlayCanvas' streamed SOG) and a page that shows them: a scene of any size.
    Streamed,
    /// Rounded and entropy-coded .dgtr, about a thirtieth of the exact one: what an aircraft delivers.
    Delivery,
    /// Poses, lenses and Gaussians' centres as a COLMAP model, binary, in a folder.
    Colmap,
    /// Poses and lenses as a transforms.json.
    Nerfstudio,
    /// Poses and lenses as OpenSfM's and OpenDroneMap's reconstruction.json, in a folder.
    Opensfm,
}

/// Which way the coordinates of an SPZ file point.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub enum SpzAxes {
    /// Right, up, back, as the format says: half a turn about x from a PLY's.
    Rub,
    /// The model's own, as a PLY has them.
    Own,
}

impl From<SpzAxes> for Axes {
    fn from(axes: SpzAxes) -> Self {
        match axes {
            SpzAxes::Rub => Self::Rub,
            SpzAxes::Own => Self::Own,
        }
    }
}

impl Format {
    /// Whether it is the Gaussians for others, who know nothing of origins.
    fn is_scene(self) -> bool {
        matches!(self, Self::Ply | Self::Spz | Self::Sog | Self::Gltf | Self::Html)
    }
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
    /// With `--to ply|spz|sog|gltf|html|streamed`: leave out colours of a higher degree (0: the same colour from every side).
    #[arg(long, value_name = "0-3", value_parser = clap::value_parser!(u8).range(0..=3))]
    pub sh_degree: Option<u8>,
    /// With `--to spz`: axes of the file.
    #[arg(long, value_enum)]
    pub axes: Option<SpzAxes>,
    /// With `--to spz`: version of the format, 3 (which all viewers read) or 4.
    #[arg(long, value_name = "3|4", value_parser = clap::value_parser!(u8).range(3..=4))]
    pub spz_version: Option<u8>,
    /// With `--to delivery`: rounded more finely, for scenes seen from near (trained with `--for-delivery=fine`); a third more bytes.
    #[arg(long)]
    pub fine: bool,
    /// With `--to html`: so many of the cameras as small pictures to jump to, evenly chosen; 0 needs no Vulkan device.
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u16).range(0..=i64::from(viewer::MAX_THUMBNAILS)))]
    pub thumbnails: Option<u16>,
    /// With `--to html`: device for the small pictures, by part of its name.
    #[arg(long)]
    pub device: Option<String>,
    /// Poses and lenses of this data set (the folder that a card was trained into holds its own) instead of the model's
    /// undistorted views.
    #[arg(long, value_name = "FOLDER")]
    pub cameras: Option<PathBuf>,
}

impl Args {
    /// Options that the format does not know are mistakes.
    fn check(&self) -> Result<(), CliError> {
        let of_html = self.format == Format::Html;
        let misplaced = [
            (self.fine && self.format != Format::Delivery, "--fine", "delivery"),
            (
                self.sh_degree.is_some() && !self.format.is_scene() && self.format != Format::Streamed,
                "--sh-degree",
                "ply, spz, sog, gltf, html and streamed",
            ),
            (self.axes.is_some() && self.format != Format::Spz, "--axes", "spz"),
            (self.spz_version.is_some() && self.format != Format::Spz, "--spz-version", "spz"),
            (self.thumbnails.is_some() && !of_html, "--thumbnails", "html"),
            (self.device.is_some() && !of_html, "--device", "html"),
        ];
        match misplaced.iter().find(|row| row.0) {
            Some((_, option, format)) => Err(CliError::input(format!("{option} is for --to {format}; leave it out"))),
            None => Ok(()),
        }
    }

    fn default_out(&self) -> PathBuf {
        match self.format {
            Format::Ply => self.model.with_extension("ply"),
            Format::Spz => self.model.with_extension("spz"),
            Format::Sog => self.model.with_extension("sog"),
            Format::Gltf => self.model.with_extension("glb"),
            Format::Html => self.model.with_extension("html"),
            Format::Streamed => self.model.with_extension("streamed"),
            Format::Delivery => self.model.with_extension("delivery.dgtr"),
            Format::Colmap => self.model.with_file_name("colmap"),
            Format::Nerfstudio => self.model.with_file_name("cameras.json"),
            Format::Opensfm => self.model.with_file_name("opensfm"),
        }
    }
}

/// Runs `dgtr export`.
///
/// # Errors
/// Whatever ends the command; its kind is the exit code.
pub fn run(args: Args) -> Result<(), CliError> {
    args.check()?;
    let out = args.out.clone().unwrap_or_else(|| args.default_out());
    if out == args.model {
        return Err(CliError::input(format!("{}: would overwrite the model; give another --out", out.display())));
    }
    if args.format == Format::Streamed {
        return streamed(&args, &out);
    }
    let (header, mut cloud, _) = model::read_what_is_there(&args.model)?;
    if args.format.is_scene() {
        cloud.lower_sh_degree(args.sh_degree.unwrap_or(cloud.sh_degree));
        return scene(&args, &out, &header, &cloud);
    }
    if args.format == Format::Delivery {
        let rounding = if args.fine { Rounding::fine() } else { Rounding::default() };
        let n = model::write_rounded(&Disk::default(), &out, &header, &cloud, &rounding)?;
        outln!("{}: {n} Gaussians, SH degree {}", out.display(), cloud.sh_degree);
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
        Format::Colmap => colmap::write(&out, &cameras, &points(&header, &cloud))?,
        Format::Nerfstudio => transforms::write(&out, &cameras)?,
        _ => opensfm::write(&out, &cameras)?,
    }
    outln!("{}: {} poses", out.display(), cameras.shots.len());
    Ok(())
}

/// The Gaussians for others, and beside them where on Earth they are.
fn scene(args: &Args, out: &Path, header: &ModelHeader, cloud: &GaussianCloud) -> Result<(), CliError> {
    let middle = DVec3::from_array(cloud.middle().map(f64::from));
    // Whoever puts the file beside others needs their coordinates, not ours.
    let theirs = |rows: Rows| match header.local {
        Some(local) => [0, 1, 2].map(|k| {
            let mut row = rows[k].map(|v| v / local.scale);
            row[3] += local.shift[k];
            row
        }),
        None => rows,
    };
    if let Some(local) = header.local {
        tracing::info!(
            "{}: its coordinates are not those of the pictures' poses ({local}); {} leads back",
            out.display(),
            Georef::path(out).display()
        );
    }
    let georef = |to_enu| Georef::new(out, header.origin, theirs(to_enu), middle);
    let as_they_are = shifted([0.0; 3]);
    let georef = match args.format {
        Format::Html => {
            let request = ViewerRequest { thumbnails: args.thumbnails, device: args.device.as_deref() };
            viewer::write(out, header, cloud, &request)?;
            georef(FROM_Y_UP)?
        }
        Format::Gltf => {
            gltf::write(out, cloud)?;
            georef(FROM_Y_UP)?
        }
        Format::Sog => georef(shifted(sog::write(out, cloud)?.shift.map(f64::from)))?,
        Format::Spz => {
            let axes = args.axes.map(Axes::from).unwrap_or_default();
            let written = spz::write(out, cloud, SpzOptions { axes, is_latest: args.spz_version == Some(4) })?;
            if written.strays > 0 {
                tracing::warn!(
                    "{}: {} Gaussians far from all others were left out, which would have cost everybody's precision",
                    out.display(),
                    written.strays
                );
            }
            let mut rows = shifted(written.shift.map(f64::from));
            if axes == Axes::Rub {
                (rows[1][1], rows[2][2]) = (-1.0, -1.0);
            }
            georef(rows)?
        }
        _ => {
            ply::write(out, cloud, header.origin)?;
            georef(as_they_are)?
        }
    };
    georef.write(out)?;
    outln!("{}: {} Gaussians, SH degree {}", out.display(), cloud.len(), cloud.sh_degree);
    Ok(())
}

/// Levels of detail in a folder, never more than a part of the scene in memory, and the page that shows them.
fn streamed(args: &Args, out: &Path) -> Result<(), CliError> {
    let model = Chunks::open(&args.model)?;
    let written = levels::write(&model, out, args.sh_degree.unwrap_or(model.sh_degree))?;
    if written.strays + written.non_finite > 0 {
        tracing::warn!(
            "{} Gaussians far from everything else and {} that are not finite were left out",
            written.strays,
            written.non_finite
        );
    }
    let georef = Georef::new(
        out,
        model.header.origin,
        shifted(written.shift.map(f64::from)),
        DVec3::from_array(written.shift.map(f64::from)),
    )?;
    georef.write(out)?;
    let sides = std::iter::once("as trained".to_owned()).chain(written.voxels_m.iter().map(|v| format!("{v:.3} m")));
    for (level, (side, n)) in sides.zip(&written.counts).enumerate() {
        outln!("level {level}: {n} Gaussians, {side}");
    }
    match viewer::write_streamed(out, &model.header, &written.coarsest, written.shift) {
        Ok(page) => outln!("{}: {} leaves; to be opened over HTTP", page.display(), written.leaves),
        // The levels are for other viewers, too.
        Err(e) => tracing::warn!("no page: {e}"),
    }
    Ok(())
}

/// What the model was trained on: undistorted pictures of the trained size.
fn views(header: &ModelHeader) -> Reconstruction {
    let shots = header.views.iter().map(|(name, view)| Shot {
        path: name.clone(),
        lens: LensDescription::new(&view.intrinsics, Distortion::default()),
        pose: Pose { center: theirs(header, view.pose.center), ..view.pose },
        mask: None,
    });
    Reconstruction { shots: shots.collect(), origin: header.origin }
}

/// Coordinates as the pictures' poses had them.
fn theirs(header: &ModelHeader, own: DVec3) -> DVec3 {
    header.local.map_or(own, |local| local.into_theirs(own))
}

/// Centres and plain colours: what other trainers start from.
fn points(header: &ModelHeader, cloud: &GaussianCloud) -> Vec<Point> {
    let stride = cloud.sh_stride();
    let color =
        |i: usize| [0, 1, 2].map(|c| ((0.5 + SH_C0 * cloud.sh[i * stride + c]).clamp(0.0, 1.0) * 255.0).round() as u8);
    let valid = (0..cloud.len()).filter(|i| cloud.is_valid(*i));
    let place = |i: usize| theirs(header, DVec3::from_array(cloud.means[i].map(f64::from))).to_array();
    valid.map(|i| Point { position: place(i), color: color(i) }).collect()
}
