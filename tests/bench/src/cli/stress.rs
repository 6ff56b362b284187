//! `bench stress`.

use std::path::PathBuf;

use vulkan::gpu::Gpu;

use crate::csv::csv;
use crate::stress::{elsewhere, run as try_all, table};
use runtime::cli::CliError;
use runtime::cli::output::outln;
use runtime::figures::{markdown, write_json, write_text};

/// Arguments of `bench stress`.
#[derive(Debug, clap::Args)]
pub struct Args {
    /// Also train this many steps on a tiny scene (100,000 take minutes).
    #[arg(long, value_name = "STEPS", default_value_t = 0)]
    pub long: u32,
    /// Only the CPU reference, without a device.
    #[arg(long, conflicts_with_all = ["long", "device"])]
    pub reference_only: bool,
    /// Device whose name contains this: processor, or a Vulkan device.
    #[arg(long)]
    pub device: Option<String>,
    /// Write everything as JSON.
    #[arg(long, value_name = "FILE")]
    pub json: Option<PathBuf>,
    /// Write the table as CSV.
    #[arg(long, value_name = "FILE")]
    pub csv: Option<PathBuf>,
}

/// Runs `bench stress`.
///
/// # Errors
/// Whatever ends the command; its kind is the exit code.
pub fn run(args: Args) -> Result<(), CliError> {
    let gpu = match args.reference_only {
        true => None,
        false => Some(Gpu::open(args.device.as_deref())?),
    };
    let all = try_all(gpu.as_ref(), args.long, &mut |t| {
        if !t.held {
            tracing::warn!("{} ({}): {}", t.input, t.path, t.outcome);
        }
    });
    let table = table(&all);
    outln!("{}\n\n{}", gpu.as_ref().map_or("CPU reference", |g| &g.info().name), markdown(&table));
    outln!("{}", markdown(&elsewhere()));
    if let Some(path) = &args.csv {
        write_text(path, &csv(&table))?;
    }
    if let Some(path) = &args.json {
        write_json(path, &all)?;
    }
    match all.iter().filter(|t| !t.held).count() {
        0 => Ok(()),
        n => Err(CliError::failed(format!("{n} of {} promises were broken", all.len()))),
    }
}
