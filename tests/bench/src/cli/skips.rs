//! `bench skips [DATASET]`.

use std::path::PathBuf;

use models::formats::read_bounded;
use survey::dataset::Dataset;

use super::Init;
use crate::csv::csv;
use crate::skips::{NOT_SWITCHED, Run, SKIPS, captured, fastest, mean, table, train};
use runtime::cli::CliError;
use runtime::cli::output::outln;
use runtime::device_report::survey as world;
use runtime::figures::{markdown, write_json, write_text};

/// Arguments of `bench skips`.
#[derive(Debug, clap::Args)]
pub struct Args {
    /// Folder of posed pictures; without one, a small ray-cast world.
    pub dataset: Option<PathBuf>,
    /// Optimiser steps of every run.
    #[arg(long, default_value_t = 300, value_parser = clap::value_parser!(u32).range(1..))]
    pub steps: u32,
    /// Where the first Gaussians come from; pairs and confidence only matter to feed-forward.
    #[arg(long, value_enum, default_value = "feed-forward")]
    init: Init,
    /// Most Gaussians.
    #[arg(long, default_value_t = 30_000)]
    pub max_gaussians: usize,
    /// Device memory, MiB.
    #[arg(long, default_value_t = 512)]
    pub budget_mib: u32,
    /// Image scale, above 0 and at most 1.
    #[arg(long, default_value_t = 1.0)]
    pub scale: f64,
    /// Seeds whose mean is shown, separated by commas.
    #[arg(long, value_delimiter = ',', default_value = "1")]
    pub seeds: Vec<u64>,
    /// Every run is repeated this often and its fastest time counts.
    #[arg(long, default_value_t = 1, value_parser = clap::value_parser!(u32).range(1..))]
    pub repeats: u32,
    /// TOML file with recipe tables that hold for every run.
    #[arg(long, value_name = "FILE")]
    pub settings: Option<PathBuf>,
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

/// Runs `bench skips`.
///
/// # Errors
/// Whatever ends the command; its kind is the exit code.
pub fn run(args: Args) -> Result<(), CliError> {
    let base: toml::Table = match &args.settings {
        None => toml::Table::new(),
        Some(path) => {
            let text = String::from_utf8_lossy(&read_bounded(path, 1 << 20)?).into_owned();
            toml::from_str(&text).map_err(|e| CliError::input(format!("{}: {e}", path.display())))?
        }
    };
    let temporary = tempfile::tempdir()?;
    let out = args.out.clone().unwrap_or_else(|| temporary.path().to_path_buf());
    let dataset = match &args.dataset {
        Some(root) => root.clone(),
        None => {
            let root = temporary.path().join("world");
            world::write_data_set(&root, 1, 1.0)?;
            root
        }
    };
    let measured = |name: &str, on: &dyn Fn(usize) -> bool| -> Result<Run, CliError> {
        let mut runs = Vec::new();
        for seed in &args.seeds {
            let mut arguments = vec![dataset.display().to_string()];
            for (flag, value) in [
                ("--init", args.init.flag()),
                ("--steps", args.steps.to_string()),
                ("--max-gaussians", args.max_gaussians.to_string()),
                ("--budget-mib", args.budget_mib.to_string()),
                ("--scale", args.scale.to_string()),
                ("--seed", seed.to_string()),
            ] {
                arguments.extend([flag.to_owned(), value]);
            }
            if let Some(device) = &args.device {
                arguments.extend(["--device".to_owned(), device.clone()]);
            }
            let folder = out.join(name.replace([' ', '\''], "-")).join(seed.to_string());
            let repeated = (0..args.repeats).map(|_| train(name, &base, on, &arguments, &folder));
            runs.extend(fastest(&repeated.collect::<Result<Vec<_>, _>>()?));
        }
        let run = mean(&runs).ok_or_else(|| CliError::input("--seeds needs at least one seed"))?;
        tracing::info!("{name}: {:.1} s, {:.2} dB", run.seconds, run.psnr);
        Ok(run)
    };
    // The first process of a device compiles its kernels for all that follow.
    measured("warm-up", &|_| true)?;
    let none = measured("none", &|_| false)?;
    let acts = |i: usize| !SKIPS[i].feed_forward || args.init == Init::FeedForward;
    let mut runs = Vec::new();
    for i in (0..SKIPS.len()).filter(|i| acts(*i)) {
        runs.push(measured(SKIPS[i].name, &|j| j == i)?);
    }
    runs.push(measured("all together", &|_| true)?);
    let table = table(&none, &runs);
    outln!("{}", markdown(&table));
    let set = Dataset::open(&dataset)?;
    let poses: Vec<_> = set.frames.iter().map(|f| f.view.pose).collect();
    let [with, without] = captured(&poses);
    outln!("Covered places not captured again: {with} key frames of {} pictures instead of {without}.", poses.len());
    for (name, why) in NOT_SWITCHED {
        outln!("Not switched here: {name}: {why}.");
    }
    if let Some(path) = &args.csv {
        write_text(path, &csv(&table))?;
    }
    if let Some(path) = &args.json {
        let key_frames = serde_json::json!({ "with": with, "without": without });
        write_json(path, &serde_json::json!({ "none": none, "runs": runs, "key_frames": key_frames }))?;
    }
    Ok(())
}
