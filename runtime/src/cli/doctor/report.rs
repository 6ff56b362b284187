//! `dgtr doctor --report FILE`.

use std::path::{Path, PathBuf};
use std::time::Duration;

use pages::report::Table;

use crate::cli::CliError;
use crate::cli::output::outln;
use crate::device_report::{Extent, SIZES, measure};
use crate::figures::{markdown, write_json};

/// Arguments of `dgtr doctor` that are about its report.
#[derive(Debug, clap::Args)]
#[command(next_help_heading = "Report")]
pub struct Args {
    /// Instead of the checks, measure the device in ten minutes and write a report to send in.
    #[arg(long = "report", value_name = "FILE", conflicts_with_all = ["model", "mission", "autotune"])]
    pub path: Option<PathBuf>,
    /// Device whose name contains this: processor, or a Vulkan device.
    #[arg(long, requires = "path")]
    pub device: Option<String>,
    /// No further kernel configuration is tried after so many seconds.
    #[arg(long, default_value_t = 120, requires = "path")]
    pub autotune_seconds: u64,
    /// How many of the three sizes are measured, the smallest first.
    #[arg(long, default_value_t = SIZES.len(), value_name = "N", requires = "path")]
    pub sizes: usize,
    /// Steps of the survey.
    #[arg(long, default_value_t = 500, value_parser = clap::value_parser!(u32).range(1..), requires = "path")]
    pub steps: u32,
}

/// Measures, and writes the report to `path`.
///
/// # Errors
/// No device, one that computes something else than the reference, or a file that cannot be written.
pub fn run(path: &Path, args: &Args) -> Result<(), CliError> {
    let folder = tempfile::tempdir().map_err(CliError::failed)?;
    let autotuning = Duration::from_secs(args.autotune_seconds);
    let extent = Extent { device: args.device.clone(), autotuning, sizes: args.sizes, steps: args.steps };
    let report = measure(&extent, folder.path())?;
    write_json(path, &report)?;
    let head = ["board", "device", "kernels", "10 k, ms", "100 k, ms", "500 k, ms", "survey, s", "PSNR, dB", "W", "°C"];
    let table = Table {
        title: format!("{}: the row for tests/DEVICES.md, which says where to send the report", path.display()),
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
