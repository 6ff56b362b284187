//! `bench map`.

use std::path::PathBuf;

use engine::evaluate::heights::HeightScores;
use engine::ortho::MapRequest;
use pages::report::Table;

use crate::map::measure;
use runtime::cli::CliError;
use runtime::cli::output::outln;
use runtime::figures::{markdown, short, write_json};

/// Arguments of `bench map`.
#[derive(Debug, clap::Args)]
pub struct Args {
    /// Where the survey, its models and its figures go.
    #[arg(long)]
    pub out: PathBuf,
    /// Seed of the world and of the training.
    #[arg(long, default_value_t = 1)]
    pub seed: u64,
    /// Training steps.
    #[arg(long, default_value_t = 1500)]
    pub steps: u32,
    /// Most Gaussians: about half as many as the map has pixels.
    #[arg(long, default_value_t = 100_000)]
    pub max_gaussians: usize,
    /// Leave out ground that fewer training pictures saw.
    #[arg(long, default_value_t = MapRequest::default().min_views)]
    pub min_views: usize,
    /// Write everything as JSON.
    #[arg(long, value_name = "FILE")]
    pub json: Option<PathBuf>,
}

/// Runs `bench map`.
///
/// # Errors
/// Whatever ends the command; its kind is the exit code.
pub fn run(args: Args) -> Result<(), CliError> {
    let training = [("--steps", args.steps as usize), ("--max-gaussians", args.max_gaussians)];
    let training: Vec<String> = training.iter().flat_map(|(flag, n)| [(*flag).to_owned(), n.to_string()]).collect();
    let scores = measure(&args.out, args.seed, args.min_views, &training)?;
    let row = |what: &str, h: &HeightScores| {
        let metres = [h.rmse_m, h.bias_m, h.median_abs_m, h.le90_m].map(|m| format!("{m:.3} m"));
        let pixels = short(h.rmse_m / scores.gsd_m);
        [what.to_owned()].into_iter().chain(metres).chain([pixels, h.missing.to_string()]).collect()
    };
    let table = Table {
        title: "Heights on bare ground and roofs".into(),
        note: format!(
            "Pixels of {:.3} m, {} compared ({:.1} % of what two pictures saw). Orthophoto against the exact one: {:.2} dB; \
             {} squares shifted by {:.2} pixels RMS.",
            scores.gsd_m,
            scores.pixels,
            100.0 * scores.covered,
            scores.psnr,
            scores.squares,
            scores.shift_px
        ),
        head: ["from", "RMSE", "bias", "median", "LE90", "RMSE in pixels", "without height"]
            .map(str::to_owned)
            .to_vec(),
        rows: vec![row("the trained model", &scores.heights), row("the fused depth maps", &scores.fused_depth)],
    };
    outln!("{}", markdown(&table));
    if let Some(path) = &args.json {
        write_json(path, &scores)?;
    }
    Ok(())
}
