//! `bench forecast`.

use std::path::PathBuf;

use tuning::kernels;
use vulkan::gpu::Gpu;

use crate::forecast::{measured, table};
use runtime::cli::CliError;
use runtime::cli::output::outln;
use runtime::device_report::SIZES;
use runtime::figures::{markdown, write_json};

/// Arguments of `bench forecast`.
#[derive(Debug, clap::Args)]
pub struct Args {
    /// How many of the three sizes are measured, the smallest first.
    #[arg(long, default_value_t = SIZES.len(), value_name = "N")]
    pub sizes: usize,
    /// Steps that are measured at each size.
    #[arg(long, default_value_t = 10, value_parser = clap::value_parser!(u32).range(1..))]
    pub steps: u32,
    /// Device whose name contains this: processor, or a Vulkan device.
    #[arg(long)]
    pub device: Option<String>,
    /// Write everything as JSON.
    #[arg(long, value_name = "FILE")]
    pub json: Option<PathBuf>,
}

/// Runs `bench forecast`.
///
/// # Errors
/// Whatever ends the command; its kind is the exit code.
pub fn run(args: Args) -> Result<(), CliError> {
    let gpu = Gpu::open(args.device.as_deref())?;
    let (model, all) = measured(&gpu, kernels::config_of(&gpu), args.sizes, args.steps)?;
    outln!("{}", markdown(&table(&gpu, &model, &all)));
    if let Some(path) = &args.json {
        write_json(path, &serde_json::json!({ "device": gpu.info().name, "cost": model, "sizes": all }))?;
    }
    Ok(())
}
