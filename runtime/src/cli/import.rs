//! `dgtr import FILE`: a 3DGS PLY or an SPZ, from any trainer, as a model to evaluate, render, continue or merge.

use std::path::PathBuf;

use models::formats::model::{self, ModelHeader};
use models::formats::{ply, spz};

use super::CliError;
use crate::cli::output::outln;

/// Arguments of `dgtr import`.
#[derive(Debug, clap::Args)]
pub struct Args {
    /// The 3DGS .ply or .spz file.
    pub file: PathBuf,
    /// Where to write the model; default: beside the file, with the extension .dgtr.
    #[arg(long)]
    pub out: Option<PathBuf>,
}

/// Runs `dgtr import`.
///
/// # Errors
/// Whatever ends the command; its kind is the exit code.
pub fn run(args: Args) -> Result<(), CliError> {
    let is_spz = args.file.extension().is_some_and(|e| e.eq_ignore_ascii_case("spz"));
    let (cloud, origin, dropped) = if is_spz {
        let read = spz::read(&args.file)?;
        (read.cloud, None, read.dropped)
    } else {
        let read = ply::read(&args.file)?;
        (read.cloud, read.origin, read.dropped)
    };
    if cloud.is_empty() {
        return Err(CliError::input(format!("{}: holds no usable Gaussian", args.file.display())));
    }
    let out = args.out.unwrap_or_else(|| args.file.with_extension("dgtr"));
    if out == args.file {
        return Err(CliError::input(format!("{}: would overwrite itself; give another --out", out.display())));
    }
    let header = ModelHeader { origin, finished: true, ..Default::default() };
    model::write(&out, &header, &cloud)?;
    outln!("{}: {} Gaussians, {} unusable ones left out", out.display(), cloud.len(), dropped);
    Ok(())
}
