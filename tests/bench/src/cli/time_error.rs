//! `bench time-error DATASET…`.

use std::path::PathBuf;

use pages::report::{ReportData, Table};

use super::Init;
use super::recipe::Recipe;
use crate::csv::csv;
use crate::time_error::{Request, chart, groups, measure, points_table, speedups, table};
use runtime::cli::CliError;
use runtime::cli::output::outln;
use runtime::figures::{markdown, short, write_json, write_text};

/// Arguments of `bench time-error`.
#[derive(Debug, clap::Args)]
pub struct Args {
    /// Folders of posed pictures.
    #[arg(required = true)]
    pub datasets: Vec<PathBuf>,
    /// Folder for points.csv, result.json, a picture per data set and report.html; points already there are kept.
    #[arg(long)]
    pub out: PathBuf,
    /// Seconds of training, separated by commas.
    #[arg(long, value_delimiter = ',', default_value = "20,40,80,160")]
    pub seconds: Vec<f64>,
    /// Device memory, MiB, separated by commas.
    #[arg(long, value_delimiter = ',', default_value = "512")]
    pub budgets_mib: Vec<u32>,
    /// Seeds, separated by commas.
    #[arg(long, value_delimiter = ',', default_value = "1,2")]
    pub seeds: Vec<u64>,
    /// Where the first Gaussians come from, separated by commas.
    #[arg(long, value_enum, value_delimiter = ',', default_value = "feed-forward,sfm")]
    init: Vec<Init>,
    /// Seconds the structure-from-motion itself took, one per data set or one for all; counted in every sfm point.
    #[arg(long, value_delimiter = ',')]
    pub sfm_seconds: Vec<f64>,
    /// What every training has alike.
    #[command(flatten)]
    pub recipe: Recipe,
    /// Measure points anew that are already in --out.
    #[arg(long)]
    pub again: bool,
}

/// Runs `bench time-error`.
///
/// # Errors
/// Whatever ends the command; its kind is the exit code.
pub fn run(args: Args) -> Result<(), CliError> {
    if args.seconds.iter().chain(&args.sfm_seconds).any(|s| !(*s >= 0.0 && s.is_finite())) {
        return Err(CliError::input("--seconds and --sfm-seconds must be numbers of seconds"));
    }
    let request = Request {
        datasets: args.datasets,
        seconds: args.seconds,
        budgets_mib: args.budgets_mib,
        seeds: args.seeds,
        inits: args.init.iter().map(|i| i.flag()).collect(),
        sfm_seconds: args.sfm_seconds,
        train: args.recipe.arguments(),
        out: args.out.clone(),
        again: args.again,
    };
    let points = measure(&request, &mut |p| {
        tracing::info!(
            "{} {} {} MiB seed {}: {:.1} s, {:.2} dB",
            p.dataset,
            p.init,
            p.budget_mib,
            p.seed,
            p.total_s,
            p.psnr
        );
    })?;
    let groups = groups(&points);
    let speedups = speedups(&groups);
    let curves = table(&groups);
    let compared = Table {
        title: "Feed-forward against structure-from-motion at equal PSNR".into(),
        note: "Straight lines between the measured points; at the highest PSNR that both reach.".into(),
        head: ["data set", "MiB", "PSNR, dB", "feed-forward s", "sfm s", "times faster"].map(String::from).to_vec(),
        rows: speedups
            .iter()
            .map(|(set, mib, s)| {
                let figures = [short(s.seconds), short(s.other_seconds), format!("{:.2}", s.ratio())];
                [vec![set.clone(), mib.to_string(), format!("{:.2}", s.psnr)], figures.to_vec()].concat()
            })
            .collect(),
    };
    outln!("{}", markdown(&curves));
    write_text(&args.out.join("points.csv"), &csv(&points_table(&points)))?;
    let all = serde_json::json!({ "points": points, "groups": groups, "speedups": speedups });
    write_json(&args.out.join("result.json"), &all)?;
    let mut page = ReportData { title: "Run time against error".into(), ..ReportData::default() };
    let mut sets: Vec<&str> = groups.iter().map(|g| g.dataset.as_str()).collect();
    sets.dedup();
    for set in sets {
        let chart = chart(set, &groups);
        if let Some(svg) = chart.svg(true) {
            let path = args.out.join(format!("{set}.svg"));
            write_text(&path, &svg)?;
            page.files.push((format!("picture of {set}"), path));
        }
        page.charts.push(chart);
    }
    page.tables.push(curves);
    if !speedups.is_empty() {
        outln!("{}", markdown(&compared));
        page.tables.push(compared);
    }
    let path = args.out.join("report.html");
    page.write(&path)?;
    outln!("{}", path.display());
    Ok(())
}
