//! `bench detail`.

use std::path::PathBuf;

use config::training::CropSettings;
use pages::report::Table;

use crate::detail::measure;
use runtime::cli::CliError;
use runtime::cli::output::outln;
use runtime::device_report::survey as world;
use runtime::figures::{markdown, short, write_json};

/// How much larger than the survey of the other benchmarks the pictures of this one are: 2,400 × 1,800 pixels.
const LARGER: f64 = 7.5;

/// Arguments of `bench detail`.
#[derive(Debug, clap::Args)]
pub struct Args {
    /// A data set [default: a simulated survey of 2,400 × 1,800 pixels].
    pub dataset: Option<PathBuf>,
    /// Where the survey, the models and their figures go.
    #[arg(long)]
    pub out: PathBuf,
    /// Seed of the world and of the training.
    #[arg(long, default_value_t = 1)]
    pub seed: u64,
    /// Scale of the whole pictures.
    #[arg(long, default_value_t = 0.25)]
    pub scale: f64,
    /// Seconds of training.
    #[arg(long, default_value_t = 100.0)]
    pub seconds: f64,
    /// Steps of training instead.
    #[arg(long)]
    pub steps: Option<u32>,
    /// Gaussians.
    #[arg(long, default_value_t = 100_000)]
    pub max_gaussians: usize,
    /// Numbers of crops to compare.
    #[arg(long, value_delimiter = ',', default_values_t = [0, CropSettings::default().most])]
    pub crops: Vec<u32>,
    /// Write everything as JSON.
    #[arg(long, value_name = "FILE")]
    pub json: Option<PathBuf>,
}

/// Runs `bench detail`.
///
/// # Errors
/// Whatever ends the command; its kind is the exit code.
pub fn run(args: Args) -> Result<(), CliError> {
    let data = match args.dataset {
        Some(data) => data,
        None => {
            let data = args.out.join("data");
            world::write_data_set(&data, args.seed, LARGER)?;
            data
        }
    };
    let length = match args.steps {
        Some(steps) => ["--steps".to_owned(), steps.to_string()],
        None => ["--seconds".to_owned(), args.seconds.to_string()],
    };
    let mut training = vec!["--seed".to_owned(), args.seed.to_string()];
    training.extend(["--max-gaussians".to_owned(), args.max_gaussians.to_string()]);
    training.extend(length);
    let all = measure(&data, &args.out, args.scale, &args.crops, &training)?;
    let rows = all.iter().map(|s| {
        let psnr = [&s.small, &s.full].map(|scores| format!("{:.2} / {:.3}", scores.psnr, scores.ssim));
        let [small, full] = psnr;
        let ms = 1e3 * s.seconds / s.steps.max(1) as f64;
        vec![
            s.taken.to_string(),
            s.steps.to_string(),
            short(s.seconds),
            short(ms),
            (s.device_bytes >> 20).to_string(),
            small,
            full,
        ]
    });
    let table = Table {
        title: "Held-out PSNR in dB and SSIM".into(),
        note: format!("Whole pictures at {} of their size; {} Gaussians at the most.", args.scale, args.max_gaussians),
        head: ["crops", "steps", "seconds", "ms a step", "device MiB", "at that size", "at full size"]
            .map(str::to_owned)
            .to_vec(),
        rows: rows.collect(),
    };
    outln!("{}", markdown(&table));
    if let Some(path) = &args.json {
        write_json(path, &all)?;
    }
    Ok(())
}
