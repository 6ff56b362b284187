//! What a job asks of the engine, in the order in which it asks.

use std::collections::HashMap;
use std::ops::ControlFlow;
use std::path::{Path, PathBuf};
use std::time::Instant;

use image::imageops::{FilterType, resize};
use job::run_json::RunReport;
use models::camera::{Pose, PosedImage, View};
use models::formats::model::{Chunks, ModelHeader};
use survey::dataset::scaled;
use vulkan::trainer::{RunBudget, StepReport, StopReason, Trainer};

use super::budget::Share;
use super::delivery::{Delivery, thin};
use super::energy::{EVERY_S, Meter};
use super::first_gaussians::FirstGaussians;
use super::host::{HostPlan, HostRequest};
use super::poses::{Point, Poses};
use super::resumed::Resumed;
use super::training::{Earlier, Fresh, Rebuild, Training, crops, growth};
use super::{EngineSettings, InitKind, PictureSource, model_path, waiting};
use crate::error::EngineError;

/// Fewer key frames than this say too little about the ground.
const FIRST_BUILD: usize = 3;
/// Key frames that may wait to be placed together.
const PLACED_AT_ONCE: usize = 4;
/// A model is rebuilt when the key frames have grown by this share since the last build: often enough that new ground
/// is trained on soon, seldom enough that building does not eat the time of training.
const REBUILD_GROWTH: f64 = 0.34;
/// Share of the Gaussians that is pruned where memory or time is short.
const PRUNED: f32 = 1.0 / 3.0;

/// What makes a model out of key frames: the seam at which a rehearsal stands in for networks, device and disk.
pub trait Reconstruct {
    /// Takes in a new key frame. With `more` waiting behind it, poses are solved and depths estimated with the last of them.
    ///
    /// # Errors
    /// A network or the device fails. A picture that cannot be tied to the others keeps its pose and is logged.
    fn add(&mut self, frame: PosedImage, more: bool) -> Result<(), EngineError>;
    /// Number of key frames.
    fn keyframes(&self) -> usize;
    /// Pose of a key frame as it is known now.
    fn pose(&self, name: &str) -> Option<Pose>;
    /// Whether enough key frames came since the last build; with `last`, whether any did.
    fn wants_build(&self, last: bool) -> bool;
    /// Whether key frames came that can be added to the model without building it anew.
    fn wants_growth(&self) -> bool {
        false
    }
    /// Adds the key frames that came to the model as it is trained; true when the poses of all others are known better, too.
    ///
    /// # Errors
    /// The network or the device fails.
    fn grow(&mut self) -> Result<bool, EngineError> {
        Ok(false)
    }
    /// No more key frames come.
    fn land(&mut self) {}
    /// Whether there is a model to train.
    fn has_model(&self) -> bool;
    /// (Re)builds the model from all key frames and starts its schedule; false when `cancelled` said so before it was.
    ///
    /// # Errors
    /// The network or the device fails; the pictures give no depth.
    fn build(&mut self, cancelled: &dyn Fn() -> bool) -> Result<bool, EngineError>;
    /// Has what training pictures are too small to show cut out of the key frames, once no more of them come; false when `cancelled` said
    /// so before it was.
    ///
    /// # Errors
    /// A picture that was there cannot be read any more; the file of the views cannot be written.
    fn look_closer(
        &mut self,
        _source: &mut dyn PictureSource,
        _cancelled: &dyn Fn() -> bool,
    ) -> Result<bool, EngineError> {
        Ok(true)
    }
    /// Changes how long training may take; the share of the schedule that is over changes with it.
    fn set_seconds(&mut self, seconds: Option<f64>);
    /// Whether the schedule of `budget` is over.
    fn is_done(&self, budget: &RunBudget) -> bool;
    /// Trains until the budget, the schedule, or `each` says stop.
    ///
    /// # Errors
    /// The device fails; the last checkpoint stays valid.
    fn train(
        &mut self,
        budget: &RunBudget,
        each: &mut dyn FnMut(&StepReport) -> ControlFlow<()>,
    ) -> Result<StopReason, EngineError>;
    /// Trains at half the size, or as scheduled again.
    fn halve_resolution(&mut self, on: bool);
    /// Prunes the third of the Gaussians that the loss hangs on least, or that is least opaque where not all are on the device: less
    /// memory moved, less to blend.
    ///
    /// # Errors
    /// The device fails.
    fn shrink(&mut self) -> Result<(), EngineError>;
    /// Gaussians of the model as it is now.
    fn gaussians(&self) -> usize;
    /// Writes the model as it is now; returns its path and its number of Gaussians.
    ///
    /// # Errors
    /// The device cannot be read or the disk written; the file written before stays.
    fn checkpoint(&mut self, out: &Path, finished: bool) -> Result<(PathBuf, usize), EngineError>;
}

/// One model in the making: key frames with their poses, first Gaussians, training and delivery, one after the other.
pub struct Reconstruction {
    pub(crate) poses: Poses,
    pub(crate) first: FirstGaussians,
    pub(crate) training: Training,
    pub(crate) delivery: Delivery,
    /// The model of an earlier run, which is continued.
    resumed: Resumed,
    /// What was added to the model since it was built.
    pub(crate) grown: growth::Totals,
    /// Pictures are trained at this fraction of the size they come in.
    scale: f64,
    /// What was done and what it took.
    pub report: RunReport,
}

impl Reconstruction {
    /// Opens networks and device. What the user names is checked before anything slow begins.
    ///
    /// # Errors
    /// Anything missing that the job cannot do without: ONNX Runtime, a Vulkan device, memory.
    pub fn open(mut settings: EngineSettings, header: ModelHeader, command: &str) -> Result<Self, EngineError> {
        let _span = tracing::info_span!("open").entered();
        if let Some(rounding) = &settings.delivers {
            settings.training.loss.view_dependence_visits = 0;
            settings.training.loss.view_dependence *= rounding.view_dependence;
        }
        let (t, device) = (&settings.training, &settings.device);
        let meter = Meter::of(t)?;
        let sizes = (device.size, device.views);
        let mut first = FirstGaussians::open(settings.start, &settings.init, &settings.network, t, sizes)?;
        // What a flight builds anew, and what is rounded as a whole, is in memory.
        let in_memory = settings.incremental || settings.delivers.is_some();
        let training = Training::open(device, t, meter, settings.incremental, in_memory)?;
        let mut poses = Poses::open(settings.refine.as_ref(), device.views)?;
        let trainer = &training.trainer;
        let on_host = match trainer.device().gpu().info().is_cpu {
            true => trainer.device().bytes(),
            false => trainer.device().mirror_bytes(),
        };
        let plan = |initialiser: u64, refine_in_file: bool| {
            HostPlan::new(&HostRequest {
                plan: trainer.plan(),
                on_host,
                initialiser,
                refine: settings.refine.as_ref(),
                refine_in_file,
                camera_pixels: settings.camera_pixels,
                ahead: settings.ahead as u64,
                ahead_in_memory: settings.ahead_in_memory,
                delivers: settings.delivers.is_some(),
                from_file: training.in_pieces && settings.start == InitKind::Model,
                map: settings.map.map_or(0, |m| m.host_bytes()),
            })
        };
        let host = waiting::place(&settings, trainer.plan(), first.initialiser_mut(), poses.refiner_mut(), &plan)?;
        let mut report = RunReport::new(command);
        report.more.insert("host_bytes_planned".into(), host.total_bytes().into());
        report.device = trainer.device().gpu().info().name.clone();
        report.seed = header.seed;
        (report.memory.device_bytes_planned, report.memory.device_bytes_peak) =
            (trainer.plan().total_bytes, trainer.device().bytes());
        Ok(Self {
            poses,
            first,
            training,
            delivery: Delivery::new(settings.disk, settings.delivers, settings.map, header),
            resumed: Resumed::default(),
            grown: growth::Totals::default(),
            scale: settings.scale,
            report,
        })
    }

    /// Takes up the model of an earlier run in `out`, when there is one of the same mission and aircraft that holds
    /// Gaussians; its views.
    ///
    /// # Errors
    /// A damaged model file that cannot be set aside.
    pub fn resume(&mut self, out: &Path) -> Result<Option<&HashMap<String, View>>, EngineError> {
        let path = model_path(out);
        let Some(earlier) = self.training.earlier(&self.delivery.disk, &path)? else { return Ok(None) };
        let (header, gaussians) = (earlier.header().clone(), earlier.gaussians());
        let ours = &self.delivery.header;
        let same = header.mission == ours.mission && header.aircraft == ours.aircraft;
        if !same || gaussians == 0 {
            return Ok(None);
        }
        tracing::info!("continuing {} ({gaussians} Gaussians) after {} steps", path.display(), header.steps);
        let told = RunReport::read(out).ok().and_then(|run| run.more.get("train_seconds")?.as_f64());
        self.training.train_s = told.unwrap_or(0.0);
        self.delivery.continue_from(&header);
        self.training.begin_with(earlier);
        self.resumed = Resumed::of(header);
        if !self.training.incremental {
            // Poses are those of the last checkpoint, and Gaussians are there.
            self.poses.keep();
            self.first.only_depths(&self.training.settings);
        }
        Ok(Some(&self.resumed.views))
    }

    /// Training begins with the Gaussians of this model, as they are.
    pub fn begin_with(&mut self, model: Chunks) {
        self.training.begin_with(Earlier::Pieces(model));
    }

    /// Points of the scene that came with the pictures.
    pub fn hint_points(&mut self, points: Vec<Point>) {
        self.first.set_points(points);
    }

    /// The trainer, for its counters and for rendering.
    pub fn trainer(&mut self) -> &mut Trainer {
        &mut self.training.trainer
    }

    /// What the model file says of itself, as of the last checkpoint.
    pub fn header(&self) -> &ModelHeader {
        &self.delivery.header
    }

    /// Seconds of training over all continuations.
    pub fn train_seconds(&self) -> f64 {
        self.training.train_s
    }

    /// Means of the model as of the last checkpoint; of one that the host's memory does not hold, every so many, at most `most`.
    ///
    /// # Errors
    /// The device cannot be read, or the file of the cells.
    pub fn means(&mut self, most: usize) -> Result<Vec<[f32; 3]>, EngineError> {
        self.training.means(most)
    }

    /// Whether new key frames can be added to the model as it is.
    fn can_grow(&self) -> bool {
        self.training.flying && self.first.grow()
    }

    /// How ground is shared out while pictures still come.
    fn share(&self) -> Share {
        Share::of_flight(self.training.trainer.plan(), &self.delivery.header.region, self.first.footprint_m())
    }

    /// Says where the depths came from, how well poses fit, and what initialisation left out.
    fn note_built(&mut self, fresh: &Fresh, with_prior: usize) -> Result<(), EngineError> {
        if with_prior > 0 {
            let prior = serde_json::json!({ "name": self.first.network(fresh), "views": with_prior });
            self.report.more.insert("depth_prior".into(), prior);
        }
        self.poses.note(&mut self.report)?;
        if let Some(made) = &fresh.report {
            self.report.skipped.insert("pairs".into(), made.skipped.total() as u64);
            self.report.skipped.insert("depth_samples_inconsistent".into(), made.merge.removed as u64);
            self.report.more.insert("init".into(), serde_json::to_value(made)?);
        }
        self.report.views = self.poses.len() as u64;
        self.report.more.insert("builds".into(), self.training.built.times.into());
        Ok(())
    }
}

impl Reconstruct for Reconstruction {
    fn add(&mut self, mut picture: PosedImage, more: bool) -> Result<(), EngineError> {
        let incremental = self.training.incremental;
        if let Some(view) = self.resumed.views.get(&picture.name).filter(|_| !incremental) {
            picture.view.pose = view.pose;
        }
        // 1. Features of the whole picture tie it to those before it.
        self.poses.tie(&picture, &mut self.report);
        // 2. Training keeps it in its own size, with a depth by the user's network.
        let lens = scaled(&picture.view.intrinsics, self.scale)?;
        if (lens.width, lens.height) != picture.image.dimensions() {
            picture.image = resize(&picture.image, lens.width, lens.height, FilterType::Lanczos3);
            picture.mask = picture.mask.map(|mask| mask.resized(lens.width, lens.height));
        }
        picture.view.intrinsics = lens;
        let prior = self.first.own_depth(&picture.image)?;
        self.training.add(&picture, prior.as_ref())?;
        self.poses.push(&picture.name, picture.view);
        if incremental && more && self.first.waiting(&self.poses) < PLACED_AT_ONCE {
            return Ok(());
        }
        // 3. While pictures come, it is placed among its neighbours.
        if incremental {
            let placed = self.poses.place(&mut self.report)?;
            self.grown.count_placed(&placed);
            self.first.follow(&self.poses, &placed);
        }
        // 4. Depths are made of it once its pose is as good as it will be for now.
        if incremental || !self.poses.are_refined() {
            let at_once = incremental && !self.has_model();
            self.first.take_newest(picture, &self.poses, &mut self.training, at_once, &mut self.report)?;
        }
        Ok(())
    }

    fn keyframes(&self) -> usize {
        self.poses.len()
    }

    fn pose(&self, name: &str) -> Option<Pose> {
        self.poses.pose(name)
    }

    fn wants_build(&self, last: bool) -> bool {
        let (now, then) = (self.poses.len(), self.training.built.key_frames);
        match last {
            _ if now < FIRST_BUILD => false,
            true => now > then,
            false if then > 0 && self.can_grow() => false,
            false => then == 0 || now as f64 >= then as f64 * (1.0 + REBUILD_GROWTH),
        }
    }

    fn wants_growth(&self) -> bool {
        self.has_model() && self.can_grow() && !self.poses.wait() && self.poses.len() > self.training.built.views.len()
    }

    fn grow(&mut self) -> Result<bool, EngineError> {
        let _span = tracing::info_span!("grow").entered();
        let (clock, first_new) = (Instant::now(), self.training.built.views.len());
        // 1. Pictures that waited for their pose.
        self.first.take_waiting(self.poses.len(), &self.poses, &mut self.training)?;
        let moved = self.poses.follow(first_new);
        // 2. Where all poses were solved, the light of all pictures is compared anew.
        if moved.whole {
            let light = self.first.survey_light()?;
            self.training.even_light(&self.poses, light.as_ref(), &self.resumed, 0)?;
        }
        // 3. Depths and Gaussians of the new pictures.
        let share = self.share();
        let of = |m2| share.of(m2);
        let made = self.first.make_new(&self.poses, &mut self.training, &of, &mut self.report)?;
        if let Some((made, _)) = &made {
            self.training.built.depth_m = 0.5 * (made.report.depth_m[0] + made.report.depth_m[1]);
        }
        // 4. What is trained moves with its key frames.
        let followed = growth::follow(&mut self.training, &self.poses, &moved.views, &mut self.report)?;
        // 5. New Gaussians where none stand.
        let mut new = 0;
        if let Some((made, growth)) = &made {
            self.training.even_light(&self.poses, made.light.as_ref(), &self.resumed, first_new)?;
            let (edge_m, share) = (2.0 * made.report.merge.voxel_m, self.share());
            new = growth::take_in(&mut self.training, &made.cloud, edge_m, &share, &mut self.grown)?;
            self.grown.depths += growth.depths as u64;
            self.grown.compared += growth.compared as u64;
            self.grown.gaussians += new as u64;
        }
        // 6. The schedule goes on with the new views.
        self.training.renew_moved(&self.poses, &moved.views, first_new)?;
        self.grown.growths += 1;
        self.grown.pictures += (self.poses.len() - first_new) as u64;
        self.report.views = self.poses.len() as u64;
        self.report.more.insert("growth".into(), serde_json::to_value(&self.grown)?);
        self.report.stage("grow", clock);
        tracing::info!(
            "grown to {} key frames: {new} Gaussians more, {followed} moved along, {} in all, {:.2} s",
            self.poses.len(),
            self.training.gaussians(),
            clock.elapsed().as_secs_f64()
        );
        Ok(moved.whole)
    }

    fn land(&mut self) {
        self.training.flying = false;
    }

    fn has_model(&self) -> bool {
        self.training.has_model()
    }

    fn build(&mut self, cancelled: &dyn Fn() -> bool) -> Result<bool, EngineError> {
        let clock = Instant::now();
        // 1. Poses and lenses of all key frames.
        let placed = self.poses.solve(&mut self.report)?;
        self.grown.count_placed(&placed);
        self.first.follow(&self.poses, &placed);
        // 2. Depths and first Gaussians of all key frames. Where a model's Gaussians are the first, those that come with the depths are
        // thrown away.
        let from = Instant::now();
        self.first.take_all(&self.poses, &mut self.training)?;
        let plan = self.training.trainer.plan();
        let most = if self.training.first.is_some() { plan.gaussians } else { plan.scene };
        let share = self.can_grow().then(|| self.share());
        let capacity = |ground_m2: f64| share.map_or(most, |share| share.of(ground_m2));
        let continued = self.training.is_continued(&self.resumed, &self.poses);
        let made = self.first.make(&self.poses, &mut self.training, &capacity, continued, cancelled)?;
        let Some(mut fresh) = made else { return Ok(false) };
        self.report.stage("init", from);
        // 3. All pictures in one light.
        let light = fresh.light.take();
        self.training.even_light(&self.poses, light.as_ref(), &self.resumed, 0)?;
        // 4. What is trained already, and fresh Gaussians where it is not, go to the device.
        let (steps, ground_m2) = (self.delivery.header.steps, self.first.ground_m2());
        let rebuild = Rebuild { poses: &self.poses, resumed: &self.resumed, steps, ground_m2 };
        let new = self.training.take_over(&fresh, &rebuild, &mut self.report)?;
        let loaded = self.training.load_first(&mut self.report)?;
        // 5. The schedule begins.
        self.delivery.begin(continued, &mut self.training)?;
        if self.can_grow() {
            // The newest pictures are trained on first, and their Gaussians are the only new ones.
            self.training.trainer.while_views_come();
        }
        self.training.begin_after_landing(loaded, new);
        let own_depths = self.first.has_own_network();
        let with_prior = self.training.renew_views(&self.poses, &fresh, own_depths)?;
        self.poses.follow(0);
        if continued && !self.training.incremental {
            let steps = u32::try_from(steps).unwrap_or(u32::MAX);
            self.training.trainer.schedule_mut().continue_from(steps, self.training.train_s);
        }
        self.training.set_built(&self.poses, &fresh);
        self.note_built(&fresh, with_prior)?;
        self.first.close_own_network();
        self.report.more.insert("gaussians_kept".into(), loaded.saturating_sub(new).into());
        tracing::info!(
            "built from {} key frames: {loaded} Gaussians ({new} of them new) in {:.1} s",
            self.poses.len(),
            clock.elapsed().as_secs_f64()
        );
        Ok(true)
    }

    fn look_closer(
        &mut self,
        source: &mut dyn PictureSource,
        cancelled: &dyn Fn() -> bool,
    ) -> Result<bool, EngineError> {
        crops::cut(&mut self.training, self.poses.views(), source, cancelled, &mut self.report)
    }

    fn set_seconds(&mut self, seconds: Option<f64>) {
        self.training.set_seconds(seconds);
    }

    fn is_done(&self, budget: &RunBudget) -> bool {
        self.training.is_done(budget)
    }

    fn train(
        &mut self,
        budget: &RunBudget,
        each: &mut dyn FnMut(&StepReport) -> ControlFlow<()>,
    ) -> Result<StopReason, EngineError> {
        let _span = tracing::info_span!("train").entered();
        let (training, delivery, report) = (&mut self.training, &mut self.delivery, &mut self.report);
        let from = Instant::now();
        let mut last = None;
        let summary = loop {
            // 1. The seconds that energy leaves.
            training.read_power(report);
            let (due, average) = (delivery.due(training), training.average_due(delivery.is_rounded()));
            let before = training.trainer.schedule().elapsed_s();
            let read_s = if training.meter.is_some() { before + EVERY_S } else { f64::INFINITY };
            let (mut next, mut asked_to_stop, mut reads, mut counts) = (None, false, false, false);
            // 2. Steps, until something else is due.
            let summary = training.trainer.run(&mut training.pictures.store, budget, &mut |step| {
                next = due.after(step);
                reads = step.elapsed_s >= read_s;
                counts = average.is_some_and(|due| due.after(step));
                asked_to_stop = each(step).is_break();
                let goes_on = next.is_none() && !reads && !counts && !asked_to_stop;
                if goes_on { ControlFlow::Continue(()) } else { ControlFlow::Break(()) }
            })?;
            last = summary.last.or(last);
            delivery.count_steps(summary.steps);
            report.steps += u64::from(summary.steps);
            training.train_s += training.trainer.schedule().elapsed_s() - before;
            // 3. The end of an epoch counts in the mean of the last ones.
            if counts {
                training.end_epoch()?;
            }
            // 4. What the model goes through before it is delivered.
            if let Some(next) = next {
                delivery.prepare(next, training, report)?;
            }
            if (next.is_none() && !reads && !counts) || asked_to_stop {
                break summary;
            }
        };
        training.read_power(report);
        report.stage("train", from);
        training.note_trained(&summary, last, report);
        // 5. A schedule that is over ends with the mean.
        if summary.reason != StopReason::Caller {
            training.settle_average(report)?;
        }
        Ok(summary.reason)
    }

    fn halve_resolution(&mut self, on: bool) {
        self.training.trainer.set_least_divisor(if on { 2 } else { 1 });
    }

    fn shrink(&mut self) -> Result<(), EngineError> {
        let gone = thin(&mut self.training, PRUNED, f32::INFINITY)?;
        self.training.trainer.keep_number();
        tracing::warn!("pruned {gone} Gaussians, {} remain", self.training.trainer.gaussians());
        Ok(())
    }

    fn gaussians(&self) -> usize {
        self.training.gaussians()
    }

    fn checkpoint(&mut self, out: &Path, finished: bool) -> Result<(PathBuf, usize), EngineError> {
        self.delivery.write(&self.poses, &mut self.training, (out, finished), &mut self.report)
    }
}

#[cfg(test)]
mod tests;
