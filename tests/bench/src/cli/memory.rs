//! `bench memory [DATASET]`.

use std::path::PathBuf;

use vulkan::gpu::Gpu;

use super::Init;
use crate::csv::csv;
use crate::memory::{Recipe, measure, table};
use runtime::cli::CliError;
use runtime::cli::output::outln;
use runtime::device_report::survey as world;
use runtime::figures::{markdown, write_json, write_text};

/// Arguments of `bench memory`.
#[derive(Debug, clap::Args)]
pub struct Args {
    /// Folder of posed pictures; without one, a small ray-cast world.
    pub dataset: Option<PathBuf>,
    /// Device memory, MiB, separated by commas.
    #[arg(long, value_delimiter = ',', default_value = "64,128,256,512,1024,2048,4096")]
    pub budgets: Vec<u32>,
    /// What the host may write to besides the budget, MiB; the child is bounded to the sum.
    #[arg(long, default_value_t = 512)]
    pub host_mib: u64,
    /// Where the first Gaussians come from.
    #[arg(long, value_enum, default_value = "feed-forward")]
    init: Init,
    /// Seconds of training at each budget.
    #[arg(long, default_value_t = 20.0)]
    pub seconds: f64,
    /// Optimiser steps at each budget instead of seconds.
    #[arg(long, conflicts_with = "seconds")]
    pub steps: Option<u32>,
    /// Image scale, above 0 and at most 1.
    #[arg(long, default_value_t = 1.0)]
    pub scale: f64,
    /// Seed.
    #[arg(long, default_value_t = 1)]
    pub seed: u64,
    /// Device whose name contains this: processor, or a Vulkan device.
    #[arg(long)]
    pub device: Option<String>,
    /// Keep models and logs here; default: a temporary folder.
    #[arg(long, value_name = "DIR")]
    pub out: Option<PathBuf>,
    /// Write everything as JSON.
    #[arg(long, value_name = "FILE")]
    pub json: Option<PathBuf>,
    /// Write the table as CSV.
    #[arg(long, value_name = "FILE")]
    pub csv: Option<PathBuf>,
}

/// Runs `bench memory`.
///
/// # Errors
/// Whatever ends the command; its kind is the exit code.
pub fn run(args: Args) -> Result<(), CliError> {
    let gpu = Gpu::open(args.device.as_deref())?;
    let temporary = tempfile::tempdir()?;
    let out = args.out.clone().unwrap_or_else(|| temporary.path().to_path_buf());
    let dataset = match &args.dataset {
        Some(root) => root.clone(),
        None => {
            let root = temporary.path().join("world");
            world::write_data_set(&root, args.seed, 1.0)?;
            root
        }
    };
    let mut train = vec![dataset.display().to_string()];
    let length = match args.steps {
        Some(steps) => ("--steps", steps.to_string()),
        None => ("--seconds", args.seconds.to_string()),
    };
    let more = [("--init", args.init.flag()), ("--scale", args.scale.to_string()), ("--seed", args.seed.to_string())];
    for (flag, value) in more.into_iter().chain([length]) {
        train.extend([flag.to_owned(), value]);
    }
    if let Some(device) = &args.device {
        train.extend(["--device".to_owned(), device.clone()]);
    }
    let recipe = Recipe { train, host_mib: args.host_mib };
    let mut figures = Vec::new();
    for &budget in &args.budgets {
        let one = measure(budget, &recipe, &out)?;
        tracing::info!("{budget} MiB: {}", one.failed.as_deref().unwrap_or("measured"));
        figures.push(one);
    }
    let table = table(&figures, gpu.info().is_cpu);
    outln!("{}\n\n{}", gpu.info().name, markdown(&table));
    if let Some(path) = &args.csv {
        write_text(path, &csv(&table))?;
    }
    if let Some(path) = &args.json {
        write_json(path, &serde_json::json!({ "device": gpu.info().name, "budgets": figures }))?;
    }
    match figures.iter().find(|f| f.failed.is_none() && !f.kept()) {
        Some(f) => Err(CliError::failed(format!(
            "{} MiB: {} bytes were planned and {} allocated",
            f.budget_mib, f.planned_bytes, f.allocated_bytes
        ))),
        None => Ok(()),
    }
}
