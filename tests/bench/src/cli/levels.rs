//! `bench levels`.

use std::path::PathBuf;

use pages::report::Table;

use crate::levels::{FARTHER, measure, write_scene};
use runtime::cli::CliError;
use runtime::cli::output::outln;
use runtime::error::JobError;
use runtime::figures::{markdown, short, write_json};

/// Arguments of `bench levels`.
#[derive(Debug, clap::Args)]
pub struct Args {
    /// A model [default: a made-up scene].
    pub model: Option<PathBuf>,
    /// Gaussians of the made-up scene; one of more than two million is compared from the first distance only.
    #[arg(long, default_value_t = 1_000_000, conflicts_with = "model", value_parser = clap::value_parser!(u32).range(1..=100_000_000))]
    pub gaussians: u32,
    /// Where the made-up scene (scene.dgtr) and the levels (streamed) go.
    #[arg(long)]
    pub out: PathBuf,
    /// Device whose name contains this: processor, or a Vulkan device.
    #[arg(long)]
    pub device: Option<String>,
    /// Write everything as JSON.
    #[arg(long, value_name = "FILE")]
    pub json: Option<PathBuf>,
}

/// Runs `bench levels`.
///
/// # Errors
/// Whatever ends the command; its kind is the exit code.
pub fn run(args: Args) -> Result<(), CliError> {
    let model = match args.model {
        Some(model) => model,
        None => {
            std::fs::create_dir_all(&args.out).map_err(JobError::io(&args.out))?;
            let scene = args.out.join("scene.dgtr");
            write_scene(&scene, args.gaussians as usize, 0)?;
            scene
        }
    };
    let all = measure(&model, &args.out.join("streamed"), args.device.as_deref())?;
    let rows = all.levels.iter().enumerate().map(|(number, level)| {
        vec![number.to_string(), level.gaussians.to_string(), format!("{:.2}", level.voxel_m), short(level.distance_m)]
            .into_iter()
            .chain(
                FARTHER
                    .iter()
                    .enumerate()
                    .map(|(k, _)| level.psnr.get(k).map_or_else(|| "–".to_owned(), |p| format!("{p:.2}"))),
            )
            .collect()
    });
    let farther = FARTHER.map(|f| format!("dB from {f} ×"));

    let table = Table {
        title: "Levels of detail against the whole scene, from the distance where a voxel is a pixel and farther"
            .into(),
        note: format!("{} leaves, written in {} s; drawn on {}.", all.leaves, short(all.seconds), all.device),
        head: ["level", "Gaussians", "voxel, m", "distance, m"].map(str::to_owned).into_iter().chain(farther).collect(),
        rows: rows.collect(),
    };
    outln!("{}", markdown(&table));
    if let Some(path) = &args.json {
        write_json(path, &all)?;
    }
    Ok(())
}
