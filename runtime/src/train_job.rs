//! Training from a folder: the engine over a data set, with a valid model on disc at every moment, so that Ctrl-C, a power
//! cut or a crash costs at most the time since the last checkpoint.

use std::collections::HashSet;
use std::path::PathBuf;
use std::time::{Duration, Instant};

use config::budget::{Budget, Memory};
use config::coverage::CoverageSettings;
use config::failsafe::FailsafeSettings;
use config::init::InitSettings;
use config::mission::{KeyframeSettings, NetworkSettings};
use config::refine::RefineSettings;
use config::training::TrainSettings;
use disk::Disk;
use engine::device::DeviceRequest;
use engine::evaluate::{self, IntoModel};
use engine::failsafe::Failsafe;
use engine::preset::Choice;
use engine::source::Folder;
use engine::{EngineSettings, InitKind, PictureSource, Point, Reconstruct, Reconstruction, model_path};
use flight::capture::{self, KeyframeCounters};
use hal::time::MonotonicClock;
use job::console::Progress;
use job::health::Health;
use job::interrupt::Interrupt;
use job::run_json::RunReport;
use models::formats::delivery::Rounding;
use models::formats::model::ModelHeader;
use models::onnx::metric::PerceptualMetric;
use serde::Deserialize;
use survey::card::CardOptions;
use survey::dataset::{Dataset, PoseSource};
use vulkan::trainer::RunBudget;

use crate::error::JobError;
pub use card::take_settled;
use identity::Identity;
pub use scale::PictureScale;
use scale::{large_enough, largest};
use slices::{REST, Slices};

mod card;
mod cause;
mod choose;
mod first;
mod ground;
mod identity;
pub mod log;
mod scale;
mod slices;
mod surveyed;

/// Means that the heights of the ground are told by at most, where the scene is larger than the memory.
const MOST_MEANS: usize = 1 << 20;

/// The recipe tables of a mission file.
#[derive(Clone, Debug, Default, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Recipe {
    /// `[training]`.
    pub training: TrainSettings,
    /// `[init]`.
    pub init: InitSettings,
    /// `[refine]`.
    pub refine: RefineSettings,
    /// `[network]`: manifests of the user's own networks.
    pub network: NetworkSettings,
    /// `[keyframes]`: the rule by which a flight chooses them.
    pub keyframes: KeyframeSettings,
    /// `[failsafe]`: the thresholds by which a flight spares its computer.
    pub failsafe: FailsafeSettings,
    /// `[coverage]`.
    pub coverage: CoverageSettings,
}

/// Which pictures are trained on, and how large.
#[derive(Clone, Debug)]
pub struct Chosen {
    /// Name of the list of training pictures.
    pub split: String,
    /// Restricts the split.
    pub region: Option<String>,
    /// Whether a flight's rule chooses key frames among them.
    pub by_rule: bool,
    /// Image scale.
    pub scale: PictureScale,
}

impl Chosen {
    /// The region's corners; none where there is no region.
    fn polygon(&self, set: &Dataset) -> Vec<[f64; 2]> {
        let region = self.region.as_deref().and_then(|name| set.region(name));
        region.map(|region| region.polygon.clone()).unwrap_or_default()
    }
}

/// Where poses come from.
#[derive(Clone, Copy, Debug)]
pub struct PoseOrigin {
    /// The data set's reconstruction, or telemetry.
    pub source: PoseSource,
    /// Whether telemetry poses are refined from the pictures.
    pub refine: bool,
}

/// Where the results go.
#[derive(Clone, Debug)]
pub struct Output {
    /// Folder of the model and its report.
    pub folder: PathBuf,
    /// Whether a model in it is ignored.
    pub fresh: bool,
    /// Seconds between checkpoints.
    pub checkpoint_seconds: f64,
}

/// The number of Gaussians of a scene, of which a plan wants one at least.
fn at_least_one(gaussians: usize) -> u32 {
    u32::try_from(gaussians.max(1)).unwrap_or(u32::MAX)
}

/// Everything a training needs to know; see `dgtr train --help`.
#[derive(Clone, Debug)]
pub struct TrainJob {
    /// Folder of posed pictures, or folders of a card.
    pub folders: Vec<PathBuf>,
    /// What a card is read with.
    pub card: CardOptions,
    /// Where the results go.
    pub output: Output,
    /// Which pictures.
    pub pictures: Chosen,
    /// Where their poses come from.
    pub poses: PoseOrigin,
    /// First Gaussians.
    pub init: InitKind,
    /// The model that they are taken from, where `init` says so.
    pub from: Option<PathBuf>,
    /// Over all continuations.
    pub budget: Budget,
    /// Of device and scene.
    pub memory: Memory,
    /// What is not given of memory, Gaussians, scale and seconds is chosen by what a step costs on the device.
    pub auto: bool,
    /// Whether the computer is spared as in a flight.
    pub spares: bool,
    /// Part of the device's name.
    pub device: Option<String>,
    /// As what encoding rounds them the last share of training has values.
    pub for_delivery: Option<Rounding>,
    /// Whether the split `test` is scored at the end.
    pub evaluate: bool,
    /// How it is trained.
    pub recipe: Recipe,
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
    /// Pictures of a card that hold together, and those that it has, where they are fewer than half.
    pub few: Option<(usize, usize)>,
}

impl TrainJob {
    /// The model file, written from the start on.
    pub fn model_path(&self) -> PathBuf {
        model_path(&self.output.folder)
    }

    /// Runs the job to its goal, or until asked to stop.
    ///
    /// # Errors
    /// Bad input, no device, or a full disc.
    pub fn run(&self) -> Result<Outcome, JobError> {
        let began = Instant::now();
        let stop = Interrupt::install()?;
        let _held = identity::hold(&self.output.folder)?;
        let set = match self.folders.as_slice() {
            [folder] if self.card == CardOptions::default() => Dataset::open(folder)?,
            folders => Dataset::open_card(folders, &self.card)?,
        };
        let Some(chosen) = self.chosen(&set)? else { return self.run_on(set, began, &stop, None) };
        let mut job = self.clone();
        job.fill(&chosen);
        job.run_on(set, began, &stop, Some(chosen))
    }

    /// Runs the job once its sizes are chosen.
    fn run_on(
        &self,
        mut set: Dataset,
        began: Instant,
        stop: &Interrupt,
        chosen: Option<Choice>,
    ) -> Result<Outcome, JobError> {
        let cancelled = || stop.requested();
        let from =
            self.from.as_deref().map(|path| first::open(path, &self.output.folder, self.output.fresh)).transpose()?;
        from.as_ref().map_or(Ok(()), |model| first::check(model, &set))?;
        let identity = Identity::of(self, &set)?;
        let is_new = identity.is_new_in(&self.output.folder, &self.model_path(), self.output.fresh)?;
        let is_card = set.card.is_some();
        // Over a model that is replaced, the record follows when the new model is there: whoever stops the job before must not find the old
        // model taken for one of these pictures.
        let replaces = self.model_path().is_file();
        if is_card && is_new && !replaces {
            identity.write(&self.output.folder)?;
        }
        // A card's poses are settled by its pictures, held-out ones too, before anything is built of them.
        let poses = if is_card { PoseSource::Dataset } else { self.poses.source };
        let picture_scale = self.picture_scale(&set, is_card)?;
        let settings = self.poses.refine.then_some(&self.recipe.refine);
        let notes = set.card.clone();
        surveyed::forget(&self.output.folder)?;
        let opened = began.elapsed();
        let Some(card) = card::settle(&mut set, &self.output.folder, self.output.fresh, settings, &cancelled)? else {
            return Ok(Outcome { finished: false, steps: 0, report: RunReport::new("train"), few: None });
        };
        let settled = began.elapsed() - opened;
        let few = card.used.filter(|(used, of)| 2 * used < *of);
        let frames = set.select(&self.pictures.split, self.pictures.region.as_deref())?;
        // Matching sees telemetry's pictures whole; where nothing is matched they come at the size they are trained at.
        let refine = self.poses.refine && poses == PoseSource::Telemetry;
        let (load_scale, scale) = if refine { (1.0, picture_scale) } else { (picture_scale, 1.0) };
        let (frames, chosen_by_rule) = match self.pictures.by_rule.then_some(self.recipe.keyframes) {
            Some(rule) => capture::choose(&set, frames, poses, rule)?,
            None => (frames, KeyframeCounters::default()),
        };
        if frames.is_empty() {
            return Err(JobError::Request(format!(
                "{}: split {:?} holds no pictures",
                set.root.display(),
                self.pictures.split
            )));
        }
        let frames = large_enough(&set, frames, picture_scale)?;
        let mut source = Folder::new(&set, frames.clone(), load_scale, poses);
        let size = largest(&set, &frames, picture_scale)?;
        let crops = self.crops(&set, &frames, picture_scale)?;
        let metric = self.recipe.network.metric.as_deref().filter(|_| self.evaluate);
        let mut metric = evaluate::open_metric(metric, size)?;
        let of_model = from.as_ref().map(|model| at_least_one(model.count));
        let settings = EngineSettings {
            disk: Disk::default(),
            device: DeviceRequest {
                device: self.device.clone(),
                memory: Memory { scene_gaussians: self.memory.scene_gaussians.or(of_model), ..self.memory },
                size,
                views: frames.len(),
                crops,
                folder: Some(self.output.folder.clone()),
            },
            camera_pixels: frames.iter().map(|&i| set.frames[i].view.intrinsics.pixels() as u64).max().unwrap_or(0),
            ahead: 0,
            ahead_in_memory: false,
            delivers: self.for_delivery,
            map: None,
            scale,
            network: self.recipe.network.clone(),
            training: self.settings(frames.len()),
            init: self.recipe.init.clone(),
            refine: refine.then(|| self.recipe.refine.clone()),
            start: self.init,
            incremental: false,
        };
        let header = ModelHeader {
            origin: set.origin,
            local: set.local,
            region: self.pictures.polygon(&set),
            seed: self.recipe.training.seed,
            ..Default::default()
        };
        let mut engine = Reconstruction::open(settings, header, "train")?;
        // What is written of a data set comes after all that can be refused.
        if !is_card && is_new && !replaces {
            identity.write(&self.output.folder)?;
        }
        engine.report.views = frames.len() as u64;
        if is_card {
            engine.report.stage_ms.insert("poses".into(), settled.as_secs_f64() * 1e3);
        }
        engine.report.more.extend(card.remarks.into_iter().map(|(name, value)| (name.to_owned(), value)));
        if !self.resume(&mut engine, &set, &frames)? {
            if let Some(model) = from {
                engine.begin_with(model);
            } else if self.init != InitKind::FeedForward && !(self.init == InitKind::SparsePoints && refine) {
                engine.hint_points(self.sparse_points(&set, &frames)?);
            }
            // A valid file from the first second on: no Gaussians yet, so a continuation starts with them.
            engine.checkpoint(&self.output.folder, false)?;
        }
        if is_new && replaces {
            identity.write(&self.output.folder)?;
        }
        let built = self.take(&mut engine, &mut source, &cancelled)?
            && engine.build(&cancelled).map_err(|e| cause::of(e, &set, &frames))?;
        let ready = built && engine.look_closer(&mut source, &cancelled)?;
        let finished = ready && self.optimise(&mut engine, frames.len(), stop)?;
        if finished && self.evaluate {
            self.score(&mut engine, &set, &frames, picture_scale, metric.as_mut())?;
        }
        if finished && let Some(notes) = &notes {
            let inputs = surveyed::Inputs { set: &set, notes, is_refined: self.poses.refine, scale: picture_scale };
            surveyed::measure(&mut engine, &inputs, &self.output.folder, &cancelled)?;
        }
        let steps = engine.header().steps;
        let covered = match finished {
            true => {
                let means = engine.means(MOST_MEANS)?;
                ground::coverage(engine.header(), &means, self.recipe.coverage)
            }
            false => None,
        };
        let mut report = engine.report;
        if let Some(covered) = covered {
            covered.write(&Disk::default(), &self.output.folder)?;
            covered.note(&mut report);
            tracing::info!("covered {} %, {} holes", covered.percent(), covered.gaps.len());
        }
        report.more.insert("steps_total".to_owned(), steps.into());
        report.outcome = if finished { "done" } else { "interrupted" }.to_owned();
        report.wall_s = began.elapsed().as_secs_f64();
        report.more.insert("pictures_decoded".to_owned(), source.decoded().into());
        let k = chosen_by_rule;
        for (name, count) in [("too_close", k.too_close), ("covered", k.covered), ("over_plan", k.full)] {
            if self.pictures.by_rule {
                report.skip(&format!("pictures_{name}"), count.into());
            }
        }
        if let Some(chosen) = chosen {
            chosen.note(&mut report);
        }
        report.write(&self.output.folder)?;
        Ok(Outcome { finished, steps, report, few })
    }

    /// The schedule for so many pictures.
    fn settings(&self, views: usize) -> TrainSettings {
        let training = &self.recipe.training;
        let Budget { steps, seconds, energy_wh } = self.budget.or(training);
        let is_timed = seconds.is_some() || energy_wh.is_some();
        let unasked = if is_timed { training.steps } else { training.steps_for(views) };
        TrainSettings { steps: steps.unwrap_or(unasked), seconds, energy_wh, ..training.clone() }
    }

    /// Takes up the model in `out` when it is of the same pictures and holds Gaussians; a model of other pictures is an
    /// error rather than overwritten.
    fn resume(&self, engine: &mut Reconstruction, set: &Dataset, frames: &[usize]) -> Result<bool, JobError> {
        if self.output.fresh {
            return Ok(false);
        }
        let Some(views) = engine.resume(&self.output.folder)? else { return Ok(false) };
        let wanted: HashSet<&str> = frames.iter().map(|&i| set.frames[i].name.as_str()).collect();
        if views.len() == wanted.len() && wanted.iter().all(|name| views.contains_key(*name)) {
            return Ok(true);
        }
        Err(JobError::Request(format!(
            "{}: was trained on other pictures; give another --out, or --fresh to replace it",
            self.model_path().display()
        )))
    }

    /// The data set's points that two of the pictures saw. They lie in the frame of the data set's poses.
    fn sparse_points(&self, set: &Dataset, frames: &[usize]) -> Result<Vec<Point>, JobError> {
        let points: Vec<Point> = set.sparse_points_of(frames)?.iter().map(|p| (p.position, p.color)).collect();
        if points.is_empty() && self.init == InitKind::SparsePoints {
            let what = "no sparse points that two of the training pictures saw; use --init feed-forward or random";
            return Err(JobError::Request(format!("{}: {what}", set.root.display())));
        }
        Ok(points)
    }

    /// All pictures into the engine; false when asked to stop.
    fn take(
        &self,
        engine: &mut Reconstruction,
        source: &mut Folder<'_>,
        cancelled: &dyn Fn() -> bool,
    ) -> Result<bool, JobError> {
        let total = source.waiting();
        let mut progress = Progress::new("pictures", total as u64);
        loop {
            let decoding = Instant::now();
            let Some(picture) = source.next(Duration::ZERO)? else { break };
            engine.report.stage("decode", decoding);
            progress.set((total - source.waiting()) as u64, || picture.name.clone());
            engine.add(picture, source.waiting() > 0)?;
            if cancelled() {
                return Ok(false);
            }
        }
        Ok(true)
    }

    /// Trains to the goal; false when asked to stop before it.
    fn optimise(&self, engine: &mut Reconstruction, views: usize, stop: &Interrupt) -> Result<bool, JobError> {
        self.save(engine, false)?;
        let settings = self.settings(views);
        let failsafe = self.spares.then_some(&self.recipe.failsafe).map(|limits| {
            // Nothing bounds the host's memory here.
            Failsafe::new(Health::new(*limits, u32::MAX, &self.output.folder), limits)
        });
        let slices = Slices {
            budget: RunBudget {
                steps: self.budget.steps.or(if self.budget.seconds.is_none() { Some(settings.steps) } else { None }),
                seconds: settings.seconds,
            },
            checkpoint_every: Duration::from_secs_f64(self.output.checkpoint_seconds),
            steps_before: engine.header().steps,
            failsafe,
            clock: MonotonicClock::default(),
            rest: REST,
        };
        slices.run(engine, stop, &mut |engine, over| self.save(engine, over))
    }

    /// The model, and beside it what a continuation needs to know and the model does not say: the same seed gives the same
    /// file, but not the same seconds.
    fn save(&self, engine: &mut Reconstruction, finished: bool) -> Result<(), JobError> {
        engine.checkpoint(&self.output.folder, finished)?;
        let (steps, train_s) = (engine.header().steps, engine.train_seconds());
        engine.report.outcome = "interrupted".to_owned();
        engine.report.more.insert("steps_total".to_owned(), steps.into());
        engine.report.more.insert("train_seconds".to_owned(), train_s.into());
        engine.report.write(&self.output.folder)?;
        Ok(())
    }

    fn score(
        &self,
        engine: &mut Reconstruction,
        set: &Dataset,
        frames: &[usize],
        scale: f64,
        metric: Option<&mut PerceptualMetric>,
    ) -> Result<(), JobError> {
        let Ok(held_out) = set.select("test", self.pictures.region.as_deref()) else { return Ok(()) };
        let held_out: Vec<usize> = held_out.into_iter().filter(|i| !frames.contains(i)).collect();
        if held_out.is_empty() {
            return Ok(());
        }
        let from = Instant::now();
        let into = IntoModel::of(set, engine.header());
        let scores = evaluate::evaluate(engine.trainer(), set, &held_out, scale, &into, metric, None)?;
        (engine.report.psnr, engine.report.ssim) = (Some(scores.psnr), Some(scores.ssim));
        engine.report.more.insert("psnr_colors_fitted".to_owned(), scores.psnr_colors_fitted.into());
        if let Some(p) = &scores.perceptual {
            engine.report.more.insert("perceptual".to_owned(), serde_json::to_value(p)?);
        }
        engine.report.stage("evaluate", from);
        Ok(())
    }
}
