//! `dgtr export MODEL --to ply|spz`: for viewers and other tools.

use std::path::PathBuf;

use clap::ValueEnum;
use models::formats::{model, ply, spz};

use super::CliError;

/// Formats that can be written.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub enum Format {
    /// 3DGS point cloud: every viewer reads it; keeps the georeference as a comment.
    Ply,
    /// Niantic's SPZ: a tenth of the size, rounded, without the georeference.
    Spz,
}

/// Arguments of `dgtr export`.
#[derive(Debug, clap::Args)]
pub struct Args {
    /// The .dgtr model.
    pub model: PathBuf,
    /// Format to write.
    #[arg(long = "to", value_enum)]
    pub format: Format,
    /// Where to write; default: beside the model, with the format's extension.
    #[arg(long)]
    pub out: Option<PathBuf>,
}

/// Runs `dgtr export`.
pub fn run(args: Args) -> Result<(), CliError> {
    let (header, cloud) = model::read(&args.model)?;
    let out = args.out.unwrap_or_else(|| match args.format {
        Format::Ply => args.model.with_extension("ply"),
        Format::Spz => args.model.with_extension("spz"),
    });
    if out == args.model {
        return Err(CliError::input(format!("{}: would overwrite the model; give another --out", out.display())));
    }
    match args.format {
        Format::Ply => ply::write(&out, &cloud, header.origin)?,
        Format::Spz => spz::write(&out, &cloud)?,
    }
    println!("{}: {} Gaussians, SH degree {}", out.display(), cloud.len(), cloud.sh_degree);
    Ok(())
}
