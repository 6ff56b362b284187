//! Training from a folder: poses, initialisation, optimisation, evaluation — with a valid model on disc at every moment,
//! so that Ctrl-C, a power cut or a crash costs at most the time since the last checkpoint.

use std::collections::HashMap;
use std::ops::ControlFlow;
use std::path::PathBuf;
use std::time::{Duration, Instant};

use config::init::InitSettings;
use config::mission::NetworkSettings;
use config::plan::{Plan, PlanRequest};
use config::refine::RefineSettings;
use config::training::{ShSettings, TrainSettings};
use models::camera::{Pose, PosedImage};
use models::cloud::GaussianCloud;
use models::dataset::{Dataset, PoseSource, scaled};
use models::formats::model::{self, ModelHeader};
use models::onnx::depth::DepthNetwork;
use models::onnx::metric::PerceptualMetric;
use vulkan::gpu::Gpu;
use vulkan::trainer::{RunBudget, StopReason, Trainer};

use crate::cli::CliError;
use crate::console::Progress;
use crate::evaluate;
use crate::interrupt::Interrupt;
use crate::kernels;
use crate::run_json::RunReport;
use crate::transfer::PoseTransfer;

mod resume;
mod start;

use start::Start;

/// Where the first Gaussians come from.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum InitKind {
    /// The feed-forward network.
    FeedForward,
    /// Sparse points: the data set's, or those of the pose refinement.
    SparsePoints,
    /// Points at random in what the cameras see.
    Random,
}

/// Everything a training needs to know; see `dgtr train --help`.
#[derive(Clone, Debug)]
pub struct TrainJob {
    /// Folder of posed pictures.
    pub dataset: PathBuf,
    /// Folder of the results.
    pub out: PathBuf,
    /// Name of the list of training pictures.
    pub split: String,
    /// Restricts the split.
    pub region: Option<String>,
    /// First Gaussians.
    pub init: InitKind,
    /// Poses.
    pub poses: PoseSource,
    /// Whether telemetry poses are refined from the pictures.
    pub refine: bool,
    /// Steps, over all continuations.
    pub steps: Option<u32>,
    /// Seconds, over all continuations.
    pub seconds: Option<f64>,
    /// Device memory, MiB.
    pub budget_mib: u32,
    /// Cap below what the budget holds.
    pub max_gaussians: Option<usize>,
    /// Image scale.
    pub scale: f64,
    /// Part of the Vulkan device's name.
    pub device: Option<String>,
    /// `[network]`: manifests of the user's own networks.
    pub network: NetworkSettings,
    /// Seconds between checkpoints.
    pub checkpoint_seconds: f64,
    /// Whether a model in `out` is ignored.
    pub fresh: bool,
    /// Whether the split `test` is scored at the end.
    pub evaluate: bool,
    /// `[training]`.
    pub training: TrainSettings,
    /// `[init]`.
    pub init_settings: InitSettings,
    /// `[refine]`.
    pub refine_settings: RefineSettings,
}

/// The user's networks that training itself asks, checked before it begins.
struct Networks {
    depth: Option<DepthNetwork>,
    metric: Option<PerceptualMetric>,
}

/// How a job ended.
#[derive(Clone, Debug)]
pub struct Outcome {
    /// Whether the goal was reached; else somebody asked it to stop, and the model on disc can be continued.
    pub finished: bool,
    /// Steps over all continuations.
    pub steps: u64,
    /// What `run.json` says.
    pub report: RunReport,
}

impl TrainJob {
    /// The model file, written from the start on.
    pub fn model_path(&self) -> PathBuf {
        self.out.join("model.dgtr")
    }

    /// Runs the job to its goal, or until asked to stop.
    ///
    /// # Errors
    /// Bad input, no device, or a full disc.
    pub fn run(&self) -> Result<Outcome, CliError> {
        let began = Instant::now();
        let stop = Interrupt::install().map_err(CliError::failed)?;
        let mut report = RunReport::new("train");
        let set = Dataset::open(&self.dataset)?;
        let frames = set.select(&self.split, self.region.as_deref())?;
        if frames.is_empty() {
            return Err(CliError::input(format!("{}: split {:?} holds no pictures", set.root.display(), self.split)));
        }
        let mut settings = self.training.clone();
        settings.steps = self.steps.unwrap_or(settings.steps);
        settings.seconds = self.seconds.or(settings.seconds);
        // What the user names is looked at before anything slow begins.
        let largest = self.largest(&set, &frames)?;
        let mut networks = self.open_networks(largest)?;
        let gpu = Gpu::open(self.device.as_deref())?;
        let plan = self.plan(&gpu, &frames, largest, &settings.sh)?;
        let mut trainer = Trainer::with_shape(&gpu, &plan, &settings, kernels::shape_of(&gpu))?;
        report.device = gpu.info().name.clone();
        report.seed = settings.seed;
        report.views = frames.len() as u64;
        report.device_bytes_planned = plan.total_bytes;
        report.device_bytes_peak = trainer.device_bytes();

        let mut header = ModelHeader {
            origin: set.origin,
            region: self.region.as_deref().and_then(|r| set.region(r)).map(|r| r.polygon.clone()).unwrap_or_default(),
            seed: settings.seed,
            ..Default::default()
        };
        let resumed = self.resume(&set, &frames)?;
        let posed = match &resumed {
            Some(r) => Some(r.posed()),
            None => {
                // A valid file from the first second on: no Gaussians yet, so a continuation starts with them.
                model::write(&self.model_path(), &header, &GaussianCloud::default())?;
                start::refined_poses(self, &set, &frames, &stop, &mut report)?
            }
        };
        let Some(posed) = posed else { return self.end(began, false, 0, report) };
        let Some(start) =
            start::start(self, &set, &frames, &posed, plan.gaussians, resumed.as_ref(), &stop, &mut report)?
        else {
            return self.end(began, false, resumed.map_or(0, |r| r.header.steps), report);
        };
        let loaded = trainer.load(&start.cloud)?;
        report.skip("gaussians_not_finite", loaded.dropped_unsound as u64);
        report.skip("gaussians_over_capacity", loaded.dropped_over_capacity as u64);
        self.add_views(&mut trainer, &set, &frames, &posed.poses, &start, networks.depth.take(), &mut report)?;
        if let Some(r) = &resumed {
            (header.steps, header.train_seconds) = (r.header.steps, r.header.train_seconds);
        }
        let steps_before = header.steps;
        let cloud = start.cloud;
        let done = self.optimise(&mut trainer, &settings, header, cloud, &set, &frames, &stop, &mut report)?;
        if let Some(header) = &done
            && self.evaluate
        {
            self.score(&mut trainer, &set, &frames, header, networks.metric.as_mut(), &mut report)?;
        }
        self.end(began, done.is_some(), steps_before + report.steps, report)
    }

    fn end(&self, began: Instant, finished: bool, steps: u64, mut report: RunReport) -> Result<Outcome, CliError> {
        report.outcome = if finished { "done" } else { "interrupted" }.to_owned();
        report.wall_s = began.elapsed().as_secs_f64();
        report.more.insert("steps_total".to_owned(), steps.into());
        report.write(&self.out)?;
        Ok(Outcome { finished, steps, report })
    }

    /// Size of the largest picture by area.
    fn largest(&self, set: &Dataset, frames: &[usize]) -> Result<(u32, u32), CliError> {
        let sizes = frames.iter().map(|&i| scaled(&set.frames[i].view.intrinsics, self.scale));
        let sizes = sizes.collect::<Result<Vec<_>, _>>()?;
        Ok(sizes.iter().max_by_key(|k| k.pixels()).map_or((1, 1), |k| (k.width, k.height)))
    }

    fn open_networks(&self, size: (u32, u32)) -> Result<Networks, CliError> {
        let init = &self.init_settings;
        let depth = self.network.depth.as_deref().filter(|_| self.training.loss.depth > 0.0);
        let depth = depth.map(|path| DepthNetwork::open(path, size, init.max_side, init.threads)).transpose()?;
        let metric = self.network.metric.as_deref().filter(|_| self.evaluate);
        Ok(Networks { depth, metric: evaluate::open_metric(metric, size)? })
    }

    /// The largest picture decides; the trainer fits the others in.
    fn plan(
        &self,
        gpu: &Gpu,
        frames: &[usize],
        (width, height): (u32, u32),
        sh: &ShSettings,
    ) -> Result<Plan, CliError> {
        Ok(Plan::new(&PlanRequest {
            device_mib: self.budget_mib,
            width,
            height,
            views: frames.len() as u32,
            sh_degree: sh.degree,
            max_gaussians: self.max_gaussians,
            half_moments: sh.half_moments,
            sort_lanes: gpu.info().sort_lanes(),
        })?)
    }

    /// Picture `i` with the pose that is trained with.
    fn posed(&self, set: &Dataset, i: usize, poses: &HashMap<String, Pose>) -> Result<PosedImage, CliError> {
        let mut picture = set.load_posed(i, self.scale, PoseSource::Dataset)?;
        if let Some(pose) = poses.get(&picture.name) {
            picture.view.pose = *pose;
        }
        Ok(picture)
    }

    #[allow(clippy::too_many_arguments)] // each is one thing the views need; a struct would only rename them
    fn add_views(
        &self,
        trainer: &mut Trainer,
        set: &Dataset,
        frames: &[usize],
        poses: &HashMap<String, Pose>,
        start: &Start,
        mut depth: Option<DepthNetwork>,
        report: &mut RunReport,
    ) -> Result<(), CliError> {
        let mut with_prior = 0;
        for &i in frames {
            let picture = self.posed(set, i, poses)?;
            // One at a time: the trainer keeps the priors in the device's memory.
            let estimated = depth.as_mut().map(|network| network.estimate(&picture.image)).transpose()?;
            let prior = estimated.as_ref().or_else(|| start.priors.get(&picture.name));
            with_prior += u64::from(prior.is_some());
            trainer.add_view(&picture, prior)?;
        }
        if with_prior > 0 {
            let by = depth.as_ref().map_or(start.priors_by.as_str(), DepthNetwork::name);
            report.more.insert("depth_prior".to_owned(), serde_json::json!({ "name": by, "views": with_prior }));
        }
        Ok(())
    }

    /// Trains in slices between checkpoints; the header of the finished model, or `None` when asked to stop.
    #[allow(clippy::too_many_arguments)] // each is one thing the loop needs; a struct would only rename them
    fn optimise(
        &self,
        trainer: &mut Trainer,
        settings: &TrainSettings,
        mut header: ModelHeader,
        mut cloud: GaussianCloud,
        set: &Dataset,
        frames: &[usize],
        stop: &Interrupt,
        report: &mut RunReport,
    ) -> Result<Option<ModelHeader>, CliError> {
        let (steps_before, seconds_before) = (header.steps, header.train_seconds);
        let names: Vec<&str> = frames.iter().map(|&i| set.frames[i].name.as_str()).collect();
        let mut save = |trainer: &mut Trainer,
                        report: &mut RunReport,
                        finished: bool|
         -> Result<ModelHeader, CliError> {
            let from = Instant::now();
            trainer.snapshot(&mut cloud)?;
            header.views =
                names.iter().enumerate().filter_map(|(i, n)| Some(((*n).to_owned(), trainer.view_pose(i)?))).collect();
            header.steps = steps_before + u64::from(trainer.steps());
            header.train_seconds = seconds_before + trainer.elapsed_s();
            header.finished = finished;
            model::write(&self.model_path(), &header, &cloud)?;
            report.stage("checkpoint", from);
            Ok(header.clone())
        };
        save(trainer, report, false)?;
        trainer.continue_from(u32::try_from(steps_before).unwrap_or(u32::MAX), seconds_before);
        let budget = RunBudget {
            steps: self.steps.or(if self.seconds.is_none() { Some(settings.steps) } else { None }),
            seconds: settings.seconds,
        };
        let mut progress = Progress::new("training", u64::from(budget.steps.unwrap_or(100)));
        let (mut last, mut loss) = (Instant::now(), f32::NAN);
        let every = Duration::from_secs_f64(self.checkpoint_seconds);
        let from = Instant::now();
        let outcome = loop {
            let summary = trainer.run(&budget, &mut |step| {
                loss = step.loss;
                let at = budget.steps.map_or((step.progress * 100.0) as u64, |_| steps_before + u64::from(step.step));
                progress.set(at, || format!("loss {:.4}, {} Gaussians", step.loss, step.gaussians));
                // Only where saving leaves no trace: the same seed gives the same bytes however slow the machine is.
                if stop.requested() || (step.settled && last.elapsed() >= every) {
                    ControlFlow::Break(())
                } else {
                    ControlFlow::Continue(())
                }
            })?;
            let c = summary.counters;
            for (name, count) in [
                ("culled", c.culled),
                ("behind_opaque", c.behind_opaque),
                ("gradients_not_finite", c.unsound_gradients),
                ("sh_coefficients", c.sh_missing),
            ] {
                // The counters run on since `load`.
                report.skipped.insert(name.to_owned(), count);
            }
            let work = serde_json::json!({ "instances": c.instances, "evaluations": c.evaluations });
            report.more.insert("work".to_owned(), work);
            let over = summary.reason != StopReason::Caller;
            if over {
                break Some(save(trainer, report, true)?);
            }
            save(trainer, report, false)?;
            if stop.requested() {
                break None;
            }
            last = Instant::now();
        };
        report.stage("train", from);
        for (name, ms) in trainer.stage_ms() {
            report.stage_ms.insert(format!("device_{name}"), ms);
        }
        report.steps = u64::from(trainer.steps());
        report.gaussians = trainer.gaussians() as u64;
        if loss.is_finite() {
            report.more.insert("loss".to_owned(), f64::from(loss).into());
        }
        progress.finish(&format!(
            "{} steps, loss {loss:.4}, {} Gaussians",
            steps_before + report.steps,
            report.gaussians
        ));
        Ok(outcome)
    }

    fn score(
        &self,
        trainer: &mut Trainer,
        set: &Dataset,
        frames: &[usize],
        header: &ModelHeader,
        metric: Option<&mut PerceptualMetric>,
        report: &mut RunReport,
    ) -> Result<(), CliError> {
        let Ok(held_out) = set.select("test", self.region.as_deref()) else { return Ok(()) };
        let held_out: Vec<usize> = held_out.into_iter().filter(|i| !frames.contains(i)).collect();
        if held_out.is_empty() {
            return Ok(());
        }
        let from = Instant::now();
        let transfer = PoseTransfer::between(set, &header.views);
        let scores = evaluate::evaluate(trainer, set, &held_out, self.scale, &transfer, metric, None)?;
        (report.psnr, report.ssim) = (Some(scores.psnr), Some(scores.ssim));
        if let Some(p) = &scores.perceptual {
            report.more.insert("perceptual".to_owned(), serde_json::to_value(p).map_err(CliError::failed)?);
        }
        report.stage("evaluate", from);
        Ok(())
    }
}
