//! `dgtr aggregate MODEL… --out DIR`: merges local models without a mission.

use std::path::{Path, PathBuf};
use std::time::Instant;

use config::error::{Error, ErrorKind};
use config::ground::GroundSettings;
use ground::LocalModel;
use ground::compare::{add_to, compare, perceptual};
use ground::jobs::aggregate::{self, Outcome};
use ground::jobs::summary;
use ground::member::Member;
use job::interrupt::Interrupt;
use job::run_json::RunReport;
use pages::report::{REPORT, ReportData};
use survey::dataset::Dataset;

use crate::cli::output::outln;

use super::CliError;
use super::ending::within_bounds;

/// Arguments of `dgtr aggregate`.
#[derive(Debug, clap::Args)]
pub struct Args {
    /// The aircraft's .dgtr models.
    #[arg(required = true)]
    pub models: Vec<PathBuf>,
    /// Folder for global.dgtr, run.json and report.html.
    #[arg(long)]
    pub out: PathBuf,
    /// How to merge.
    #[command(flatten)]
    pub settings: Settings,
}

/// What `aggregate` and `serve` let one change on the command line, and what they are compared with.
#[derive(Debug, clap::Args)]
pub struct Settings {
    /// How to merge.
    #[command(flatten)]
    pub merging: Merging,
    /// Data set whose held-out pictures (split `test`) measure the models and stand beside them in the report.
    #[arg(long, value_name = "DATASET", help_heading = "Comparison")]
    pub compare: Option<PathBuf>,
    /// Size at which they are compared, above 0 and at most 1.
    #[arg(long, default_value_t = 1.0, help_heading = "Comparison")]
    pub compare_scale: f64,
    /// Also measure a perceptual distance: manifest of a network of contract `metric`.
    #[arg(long, value_name = "MANIFEST", requires = "compare", help_heading = "Comparison")]
    pub metric: Option<PathBuf>,
}

/// How to merge, over `[ground]`.
#[derive(Debug, clap::Args)]
#[command(next_help_heading = "Merging")]
pub struct Merging {
    /// Device memory, MiB.
    #[arg(long)]
    pub budget_mib: Option<u32>,
    /// Most Gaussians of the global model.
    #[arg(long)]
    pub max_gaussians: Option<usize>,
    /// Passes over the views that see a seam; 0 merges only.
    #[arg(long)]
    pub epochs: Option<u32>,
    /// Seconds for distillation at most.
    #[arg(long)]
    pub seconds: Option<f64>,
    /// Size of the distillation pictures relative to the training pictures.
    #[arg(long)]
    pub scale: Option<f32>,
    /// Width along a border where ground belongs to whoever saw it best, metres; 0 keeps to the regions.
    #[arg(long)]
    pub border_m: Option<f32>,
    /// Learning rates relative to training.
    #[arg(long)]
    pub rate: Option<f32>,
    /// Device by (part of) its name: processor, or a Vulkan device.
    #[arg(long)]
    pub device: Option<String>,
    /// Seed of the order of views.
    #[arg(long)]
    pub seed: Option<u64>,
    /// Side of a cell, the square of ground that is merged as one job, metres.
    #[arg(long, value_name = "METRES")]
    pub cell_m: Option<f32>,
}

impl Merging {
    /// Overrides what was given.
    ///
    /// # Errors
    /// A value outside its range.
    pub fn apply(&self, to: &mut GroundSettings) -> Result<(), CliError> {
        to.device_mib = self.budget_mib.unwrap_or(to.device_mib);
        to.max_gaussians = self.max_gaussians.or(to.max_gaussians);
        to.epochs = self.epochs.unwrap_or(to.epochs);
        to.seconds = self.seconds.or(to.seconds);
        to.scale = self.scale.unwrap_or(to.scale);
        to.border_m = self.border_m.unwrap_or(to.border_m);
        to.rate = self.rate.unwrap_or(to.rate);
        to.device = self.device.clone().or(to.device.take());
        to.seed = self.seed.unwrap_or(to.seed);
        to.cell_m = self.cell_m.unwrap_or(to.cell_m);
        Ok(to.check()?)
    }
}

impl Settings {
    /// Measures the models on the held-out pictures of `--compare`, when given; `metric` is the mission's.
    pub(super) fn compare(
        &self,
        locals: &[(String, PathBuf)],
        outcome: &Outcome,
        metric: Option<&Path>,
        (run, data): (&mut RunReport, &mut ReportData),
    ) -> Result<(), CliError> {
        let Some(root) = &self.compare else { return Ok(()) };
        let start = Instant::now();
        let set = Dataset::open(root)?;
        let metric = self.metric.as_deref().or(metric);
        let device = self.merging.device.as_deref();
        let held = compare(&set, "test", self.compare_scale, locals, &outcome.path, metric, device)?;
        let figures = held.iter().map(|h| {
            (h.name.clone(), serde_json::json!({ "local": h.local, "global": h.global, "near_border": h.near_border }))
        });
        if let Some(p) = perceptual(&held) {
            run.more.insert("perceptual".into(), serde_json::to_value(p).map_err(CliError::failed)?);
        }
        run.more.insert("held_out".into(), figures.collect::<serde_json::Map<_, _>>().into());
        add_to(data, held);
        let global = data.models.iter().find(|r| r.name == "global");
        (run.psnr, run.ssim) = (global.and_then(|r| r.psnr), global.and_then(|r| r.ssim));
        run.stage("compare", start);
        Ok(())
    }
}

/// Runs `dgtr aggregate`.
///
/// # Errors
/// Whatever ends the command; its kind is the exit code.
pub fn run(args: Args) -> Result<(), CliError> {
    let mut settings = GroundSettings::default();
    args.settings.merging.apply(&mut settings)?;
    let stop = Interrupt::install()?;
    within_bounds(&stop).map_err(CliError::failed)?;
    let members = args.models.iter().map(|p| LocalModel::read(p).map(Member::of)).collect::<Result<Vec<_>, _>>()?;
    let outcome = aggregate::run(members, &settings, None, &args.out, &|| stop.requested())?;
    let mut run = summary::run_report("aggregate", &outcome, settings.seed);
    let mut data = summary::report(&outcome);
    let names = outcome.models.iter().map(|m| m.0.clone());
    let locals: Vec<_> = names.zip(args.models.iter().cloned()).collect();
    args.settings.compare(&locals, &outcome, None, (&mut run, &mut data))?;
    for (row, path) in data.models.iter_mut().zip(&args.models) {
        row.uploaded = std::fs::metadata(path).ok().map(|m| m.len());
    }
    finish(&args.out, run, data, outcome)
}

/// Writes `run.json` and `report.html`, prints the result, and says how it went.
pub(super) fn finish(
    out: &std::path::Path,
    mut run: RunReport,
    mut data: ReportData,
    outcome: Outcome,
) -> Result<(), CliError> {
    let page = out.join(REPORT);
    data.files.push(("figures".into(), run.write(out)?));
    data.write(&page)?;
    for warning in &data.warnings {
        tracing::warn!("{warning}");
    }
    outln!("{}: {} Gaussians out of {} models", outcome.path.display(), outcome.gaussians, outcome.models.len());
    outln!("{}", page.display());
    if let Some(e) = outcome.not_distilled {
        // The input made a model, so what went wrong since is not the input's fault.
        let kind = if e.kind() == ErrorKind::Input { ErrorKind::Failed } else { e.kind() };
        return Err(CliError::new(kind, format!("{} is merged but not distilled: {e}", outcome.path.display())));
    }
    if outcome.interrupted {
        return Err(CliError::interrupted(format!("stopped on request; {} is valid", outcome.path.display())));
    }
    Ok(())
}
