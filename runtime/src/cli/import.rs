//! `dgtr import FILE`: Gaussians in another program's form as a model to evaluate, render, continue or merge.

use std::path::PathBuf;

use glam::DVec3;
use models::cloud::GaussianCloud;
use models::formats::model::{self, ModelHeader};
use models::formats::reconstruction::LocalFrame;
use models::formats::splats;

use super::CliError;
use super::export::SpzAxes;
use crate::cli::output::outln;

/// Arguments of `dgtr import`.
#[derive(Debug, clap::Args)]
pub struct Args {
    /// A PLY (3DGS, 2DGS, compressed), SPZ, SOG, .glb or .splat file, told by its content.
    pub file: PathBuf,
    /// Axes of an SPZ file.
    #[arg(long, value_enum, default_value = "rub")]
    pub axes: SpzAxes,
    /// Where to write the model; default: beside the file, with the extension .dgtr.
    #[arg(long)]
    pub out: Option<PathBuf>,
}

/// Runs `dgtr import`.
///
/// # Errors
/// Whatever ends the command; its kind is the exit code.
pub fn run(args: Args) -> Result<(), CliError> {
    let read = splats::read(&args.file, args.axes.into())?;
    let (mut cloud, origin, dropped) = (read.cloud, read.origin, read.dropped);
    if read.is_antialiased {
        tracing::warn!(
            "{}: trained with antialiasing (Mip-Splatting), which dgtr does not render: what is thinner than a pixel looks fuller",
            args.file.display()
        );
    }
    if cloud.is_empty() {
        return Err(CliError::input(format!("{}: holds no usable Gaussian", args.file.display())));
    }
    let out = args.out.unwrap_or_else(|| args.file.with_extension("dgtr"));
    if out == args.file {
        return Err(CliError::input(format!("{}: would overwrite itself; give another --out", out.display())));
    }
    let local = if origin.is_none() { moved(&mut cloud) } else { None };
    if let Some(local) = local {
        tracing::warn!(
            "{}: lies far from its origin; its coordinates are brought near it ({local})",
            args.file.display()
        );
    }
    let header = ModelHeader { origin, local, finished: true, ..Default::default() };
    model::write(&out, &header, &cloud)?;
    outln!("{}: {} Gaussians of a {}, {dropped} unusable ones left out", out.display(), cloud.len(), read.form);
    Ok(())
}

/// Means sampled to find where a cloud lies.
const SAMPLED: usize = 100_000;

/// Brings a cloud that lies far from its origin near it; its size is its trainer's business.
fn moved(cloud: &mut GaussianCloud) -> Option<LocalFrame> {
    let every = cloud.len().div_ceil(SAMPLED).max(1);
    let places: Vec<DVec3> = cloud.means.iter().step_by(every).map(|m| DVec3::from_array(m.map(f64::from))).collect();
    let local = LocalFrame { scale: 1.0, ..LocalFrame::of(&places)? };
    if local.shift == [0.0; 3] {
        return None;
    }
    for m in &mut cloud.means {
        *m = local.into_own(DVec3::from_array(m.map(f64::from))).as_vec3().to_array();
    }
    Some(local)
}
