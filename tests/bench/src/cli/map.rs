//! `bench map`.

use std::path::PathBuf;

use engine::evaluate::heights::HeightScores;
use engine::ortho::MapRequest;
use pages::report::Table;

use crate::map::survey::Survey;
use crate::map::{MapScores, measure};
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
    /// One of eight surveys, 1 to 8, by height, overlap and ground; all: each of them [default: the one that doctor flies].
    #[arg(long, value_name = "N", value_parser = surveys)]
    pub survey: Option<Surveys>,
    /// Leave out ground that fewer training pictures saw.
    #[arg(long, default_value_t = MapRequest::default().min_views)]
    pub min_views: usize,
    /// Write everything as JSON.
    #[arg(long, value_name = "FILE")]
    pub json: Option<PathBuf>,
}

/// What `--survey` names.
#[derive(Clone, Copy, Debug)]
pub enum Surveys {
    /// One of [`Survey::EIGHT`].
    One(usize),
    /// Each of them.
    All,
}

fn surveys(text: &str) -> Result<Surveys, String> {
    match text.parse::<usize>() {
        Ok(n) if (1..=Survey::EIGHT.len()).contains(&n) => Ok(Surveys::One(n - 1)),
        _ if text == "all" => Ok(Surveys::All),
        _ => Err(format!("a number from 1 to {}, or all", Survey::EIGHT.len())),
    }
}

/// Runs `bench map`.
///
/// # Errors
/// Whatever ends the command; its kind is the exit code.
pub fn run(args: Args) -> Result<(), CliError> {
    let training = [("--steps", args.steps as usize), ("--max-gaussians", args.max_gaussians)];
    let training: Vec<String> = training.iter().flat_map(|(flag, n)| [(*flag).to_owned(), n.to_string()]).collect();
    if let Some(Surveys::All) = args.survey {
        return run_all(&args, &training);
    }
    let survey = match args.survey {
        Some(Surveys::One(i)) => Some(&Survey::EIGHT[i]),
        _ => None,
    };
    let scores = measure(&args.out, survey, args.seed, args.min_views, &training)?;
    let row = |what: &str, h: &HeightScores| {
        let metres = [h.rmse_m, h.bias_m, h.median_abs_m, h.le90_m].map(|m| format!("{m:.3} m"));
        let pixels = short(h.rmse_m / scores.gsd_m);
        [what.to_owned()].into_iter().chain(metres).chain([pixels, h.missing.to_string()]).collect()
    };
    let table = Table {
        title: "Heights on bare ground and roofs".into(),
        note: format!(
            "Pixels of {:.3} m, {} compared ({:.1} % of what {} pictures saw). Orthophoto against the exact one: {:.2} dB; \
             {} squares shifted by {:.2} pixels RMS.",
            scores.gsd_m,
            scores.pixels,
            100.0 * scores.covered,
            args.min_views,
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
    outln!("{}", markdown(&worth(&[("this survey".into(), &scores)])));
    if let Some(path) = &args.json {
        write_json(path, &scores)?;
    }
    Ok(())
}

/// Each of the eight surveys, with a seed of its own.
fn run_all(args: &Args, training: &[String]) -> Result<(), CliError> {
    let mut all = Vec::new();
    for (i, survey) in Survey::EIGHT.iter().enumerate() {
        let out = args.out.join(format!("survey-{}", i + 1));
        let scores = measure(&out, Some(survey), args.seed + i as u64, args.min_views, training)?;
        all.push((survey.shown(), scores));
    }
    let rows: Vec<(String, &MapScores)> = all.iter().map(|(name, scores)| (name.clone(), scores)).collect();
    outln!("{}", markdown(&worth(&rows)));
    if let Some(path) = &args.json {
        write_json(path, &all)?;
    }
    Ok(())
}

/// How the maps' standard deviations hold.
fn worth(surveys: &[(String, &MapScores)]) -> Table {
    let percent = |share: f64| format!("{:.1} %", 100.0 * share);
    let row = |(name, scores): &(String, &MapScores)| {
        let h = &scores.all_heights;
        let sigmas = h.sigmas.unwrap_or_default();
        let metres = [h.rmse_m, h.median_abs_m, sigmas.median_m].map(|m| format!("{m:.3} m"));
        let heights = [sigmas.within_one, sigmas.within_two].map(percent);
        let places = scores.shift_within.map(percent);
        let missing = percent(1.0 - sigmas.points as f64 / h.points.max(1) as f64);
        [name.clone()].into_iter().chain(metres).chain(heights).chain([missing]).chain(places).collect()
    };
    Table {
        title: "Standard deviations of heights and places".into(),
        note: "All heights but those of plants, steps included. Normal errors: 68.3 % within one, 95.4 % within two."
            .into(),
        head: [
            "survey",
            "RMSE",
            "median error",
            "median sigma",
            "within 1",
            "within 2",
            "no sigma",
            "places within 1",
            "within 2",
        ]
        .map(str::to_owned)
        .to_vec(),
        rows: surveys.iter().map(row).collect(),
    }
}
