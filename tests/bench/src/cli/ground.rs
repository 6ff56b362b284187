//! `bench ground`.

use std::path::PathBuf;

use pages::report::{Table, count};

use crate::ground::{field::Field, measure};
use runtime::cli::CliError;
use runtime::cli::output::outln;
use runtime::figures::{markdown, write_json};

/// Arguments of `bench ground`.
#[derive(Debug, clap::Args)]
pub struct Args {
    /// Where the models and the ground station's files go; begin with an empty folder.
    #[arg(long)]
    pub out: PathBuf,
    /// Aircraft.
    #[arg(long, default_value_t = 200)]
    pub aircraft: usize,
    /// Side of the field, metres.
    #[arg(long, default_value_t = 2000.0)]
    pub side_m: f64,
    /// Gaussians of each model.
    #[arg(long, default_value_t = 10_000)]
    pub gaussians: usize,
    /// Host memory of the ground station, MiB (a software Vulkan device takes its memory from there, too).
    #[arg(long, default_value_t = 512)]
    pub host_mib: u64,
    /// Seed of the ground and of the errors of GPS.
    #[arg(long, default_value_t = 1)]
    pub seed: u64,
    /// Write everything as JSON.
    #[arg(long, value_name = "FILE")]
    pub json: Option<PathBuf>,
}

/// Runs `bench ground`.
///
/// # Errors
/// Whatever ends the command; its kind is the exit code.
pub fn run(args: Args) -> Result<(), CliError> {
    let (aircraft, side_m, gaussians) = (args.aircraft, args.side_m, args.gaussians);
    let field = Field { aircraft, side_m, gaussians, limit_mib: args.host_mib, seed: args.seed };
    let scores = measure(&field, &args.out)?;
    let stages: Vec<String> = scores.stage_s.iter().map(|(name, s)| format!("{name} {s:.1} s")).collect();
    let row = |what: &str, figure: String| vec![what.to_owned(), figure];
    let joining = |which: &str, i: usize| {
        let (seconds, fits) = (scores.joined_s[i], scores.joined_fits[i]);
        let name = format!("seconds an aircraft, its fits, seconds a fit, {which} {}", scores.compared);
        row(&name, format!("{seconds:.2}, {fits:.2}, {:.3}", seconds / fits))
    };
    let table = Table {
        title: format!("A ground station of {aircraft} aircraft"),
        note: format!(
            "{:.1} × {:.1} km, {} Gaussians each, half of them before a restart. The second start: {}.",
            side_m / 1e3,
            side_m / 1e3,
            count((scores.gaussians[0] / scores.aircraft) as u64),
            stages.join(", ")
        ),
        head: ["", "figure"].map(str::to_owned).to_vec(),
        rows: vec![
            row("Gaussians handed over", count(scores.gaussians[0] as u64)),
            row("Gaussians of the global model", count(scores.gaussians[1] as u64)),
            row("pairs of neighbours", count(scores.pairs)),
            row("fitted before the restart", count(scores.fitted[0] as u64)),
            row("fitted after it", count(scores.fitted[1] as u64)),
            joining("first", 0),
            joining("last", 1),
            row(&format!("largest resident set of {} MiB", args.host_mib), format!("{:.0} MiB", scores.rss_mib)),
            row("neighbours apart as they came, RMS", format!("{:.2} m", scores.apart_m[0])),
            row("neighbours apart in the global model, RMS", format!("{:.3} m", scores.apart_m[1])),
            row("Gaussians of the emptiest region", format!("{:.1} %", 100.0 * scores.least_region)),
        ],
    };
    outln!("{}", markdown(&table));
    if let Some(path) = &args.json {
        write_json(path, &scores)?;
    }
    Ok(())
}
