//! `dgtr bench device`.

use std::path::PathBuf;
use std::time::Duration;

use pages::report::Table;

use crate::bench::device::{Extent, SIZES, measure};
use crate::bench::figures::{markdown, write_json};
use crate::cli::CliError;
use crate::cli::output::outln;

/// Arguments of `dgtr bench device`.
#[derive(Debug, clap::Args)]
pub struct Args {
    /// The report.
    #[arg(long, value_name = "FILE")]
    pub out: PathBuf,
    /// Vulkan device whose name contains this.
    #[arg(long)]
    pub device: Option<String>,
    /// No further kernel configuration is tried after so many seconds.
    #[arg(long, default_value_t = 120)]
    pub autotune_seconds: u64,
    /// How many of the three sizes are measured, the smallest first.
    #[arg(long, default_value_t = SIZES.len(), value_name = "N")]
    pub sizes: usize,
    /// Steps of the survey.
    #[arg(long, default_value_t = 500, value_parser = clap::value_parser!(u32).range(1..))]
    pub steps: u32,
}

/// Runs `dgtr bench device`.
///
/// # Errors
/// Whatever ends the command; its kind is the exit code.
pub fn run(args: Args) -> Result<(), CliError> {
    let folder = tempfile::tempdir().map_err(CliError::failed)?;
    let autotuning = Duration::from_secs(args.autotune_seconds);
    let extent = Extent { device: args.device, autotuning, sizes: args.sizes, steps: args.steps };
    let report = measure(&extent, folder.path())?;
    write_json(&args.out, &report)?;
    let head = ["board", "device", "kernels", "10 k, ms", "100 k, ms", "500 k, ms", "survey, s", "PSNR, dB", "W", "°C"];
    let table = Table {
        title: format!("{}: the row for tests/DEVICES.md, which says where to send the report", args.out.display()),
        note: format!(
            "{:.0} s; the device's loss {}, the reference's {}.",
            report.seconds, report.reference["loss"], report.reference["reference_loss"]
        ),
        head: head.map(str::to_owned).to_vec(),
        rows: vec![report.row()],
    };
    outln!("{}", markdown(&table));
    report.left_out.iter().for_each(|line| outln!("left out: {line}"));
    Ok(())
}
