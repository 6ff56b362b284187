//! `dgtr export MODEL --to ply`: for viewers and other tools.

use std::path::PathBuf;

use clap::ValueEnum;
use models::formats::{model, ply};

use super::CliError;

/// Formats that can be written.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub enum Format {
    /// 3DGS point cloud: every viewer reads it; keeps the georeference as a comment.
    Ply,
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
    });
    if out == args.model {
        return Err(CliError::input(format!("{}: would overwrite the model; give another --out", out.display())));
    }
    match args.format {
        Format::Ply => ply::write(&out, &cloud, header.origin)?,
    }
    println!("{}: {} Gaussians, SH degree {}", out.display(), cloud.len(), cloud.sh_degree);
    Ok(())
}
