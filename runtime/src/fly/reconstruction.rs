//! Pictures in, a trained model out, while the pictures are still coming: refine poses, initialise, train, save.
//!
//! All memory is planned when it is opened. Key frames are read back from the store when the trainer needs their
//! pixels again, so that the host holds one picture at a time.

use std::ops::ControlFlow;
use std::path::{Path, PathBuf};
use std::time::Instant;

use config::mission::{Aircraft, Mission};
use config::plan::{Plan, PlanRequest};
use models::camera::{Intrinsics, PosedImage, View};
use models::cloud::GaussianCloud;
use models::formats::model::{self, ModelHeader};
use models::init::{InitReport, Initialiser};
use models::onnx::depth::DepthNetwork;
use models::refine::{RefineReport, Refiner};
use vulkan::gpu::Gpu;
use vulkan::trainer::{RunBudget, StepReport, Trainer};

use super::FlyError;
use super::carry::carry_over;
use crate::kernels;
use crate::keyframe_store::KeyframeStore;

/// Fewer key frames than this say too little about the ground.
const FIRST_BUILD: usize = 3;
/// A model is rebuilt when the key frames have grown by this share since the last build: often enough that new ground
/// is trained on soon, seldom enough that building does not eat the time of training.
const REBUILD_GROWTH: f64 = 0.34;
/// Trained Gaussians are kept over a rebuild only when refinement moved no earlier key frame further than this,
/// in pixels at the ground.
const CARRY_LIMIT_PX: f64 = 1.5;

/// What has been done so far.
#[derive(Clone, Debug, Default)]
pub struct Progress {
    /// Optimiser steps over all builds.
    pub steps: u64,
    /// Seconds spent in training.
    pub train_s: f64,
    /// Seconds spent refining poses and initialising.
    pub init_s: f64,
    /// Times the model was (re)built.
    pub builds: u32,
    /// Gaussians kept from training over rebuilds.
    pub carried: u64,
    /// The last refinement.
    pub refined: Option<RefineReport>,
    /// The last initialisation.
    pub initialised: Option<InitReport>,
}

/// One aircraft's model in the making.
pub struct Reconstruction {
    header: ModelHeader,
    store: KeyframeStore,
    refiner: Refiner,
    initialiser: Initialiser,
    /// The user's own network for the depth loss.
    depth: Option<DepthNetwork>,
    trainer: Trainer,
    cloud: GaussianCloud,
    names: Vec<String>,
    /// Views as they were at the last build, in the order of `names`.
    built: Vec<View>,
    voxel_m: f32,
    progress: Progress,
}

impl Reconstruction {
    /// Opens networks, device and store; takes up the key frames and the model of an earlier run in `out`.
    ///
    /// # Errors
    /// Anything missing that the job cannot do without: ONNX Runtime, a Vulkan device, memory, a writable folder.
    pub fn open(mission: &Mission, aircraft: &Aircraft, intrinsics: &Intrinsics, out: &Path) -> Result<Self, FlyError> {
        let max = mission.keyframes.max as usize;
        let mut init = mission.init.clone();
        init.max_pictures = init.max_pictures.max(max);
        let mut refine = mission.refine.clone();
        refine.max_keyframes = refine.max_keyframes.max(max);
        let refiner = Refiner::open(&refine)?;
        let initialiser = Initialiser::open(&init, mission.network.pair.as_deref())?;
        let size = (intrinsics.width, intrinsics.height);
        let depth = mission.network.depth.as_deref().filter(|_| mission.training.loss.depth > 0.0);
        let depth = depth.map(|path| DepthNetwork::open(path, size, init.max_side, init.threads)).transpose();
        let depth = depth.map_err(models::init::InitError::Network)?;
        let gpu = Gpu::open(aircraft.device.as_deref())?;
        let plan = Plan::new(&PlanRequest {
            device_mib: mission.memory.device_mib,
            width: intrinsics.width,
            height: intrinsics.height,
            views: mission.keyframes.max,
            sh_degree: mission.training.sh.degree,
            max_gaussians: mission.memory.max_gaussians.map(|n| n as usize),
            half_moments: mission.training.sh.half_moments,
            sort_lanes: gpu.info().sort_lanes(),
        })?;
        // Before capture begins: measuring takes a second or two.
        let trainer = Trainer::with_shape(&gpu, &plan, &mission.training, kernels::shape_of(&gpu))?;
        let store = KeyframeStore::open(&out.join("keyframes"), intrinsics, mission.origin)?;
        let header = ModelHeader {
            mission: mission.name.clone(),
            aircraft: aircraft.id.clone(),
            origin: Some(mission.origin),
            region: mission.region(aircraft),
            seed: mission.training.seed,
            ..ModelHeader::default()
        };
        let mut this = Self {
            header,
            store,
            refiner,
            initialiser,
            depth,
            trainer,
            cloud: GaussianCloud::with_capacity(mission.training.sh.degree, plan.gaussians),
            names: Vec::with_capacity(max),
            built: Vec::with_capacity(max),
            voxel_m: 0.0,
            progress: Progress::default(),
        };
        this.resume(out)?;
        Ok(this)
    }

    /// Takes up the key frames and the model of an earlier run.
    ///
    /// # Errors
    /// A stored picture or model that cannot be read.
    fn resume(&mut self, out: &Path) -> Result<(), FlyError> {
        for i in 0..self.store.len() {
            let frame = self.store.load(i)?;
            self.link(&frame)?;
        }
        let path = Self::model_path(out);
        if path.is_file() {
            let (header, cloud) = model::read(&path)?;
            if header.mission == self.header.mission && header.aircraft == self.header.aircraft {
                tracing::info!(
                    "continuing with {} key frames and {} Gaussians after {} steps",
                    self.names.len(),
                    cloud.len(),
                    header.steps
                );
                self.header.steps = header.steps;
                self.header.train_seconds = header.train_seconds;
                self.cloud = cloud;
            }
        }
        Ok(())
    }

    /// Where the model lies in an output folder.
    pub fn model_path(out: &Path) -> PathBuf {
        out.join("model.dgtr")
    }

    /// Takes in a new key frame: stores it and ties it to the others.
    ///
    /// # Errors
    /// The store cannot be written. A picture that cannot be tied keeps its telemetry pose and is logged.
    pub fn add(&mut self, frame: &PosedImage) -> Result<(), FlyError> {
        self.store.add(frame)?;
        self.link(frame)
    }

    fn link(&mut self, frame: &PosedImage) -> Result<(), FlyError> {
        let clock = Instant::now();
        let mut posed = frame.clone();
        match self.refiner.add(frame) {
            Ok(report) => {
                tracing::debug!("{}: {} features, {} pairs", frame.name, report.features, report.pairs_verified);
                self.solve()?;
                if let Some(pose) = self.refiner.pose(&frame.name) {
                    posed.view.pose = pose;
                }
            }
            Err(e) => tracing::warn!("pose refinement: {e}"),
        }
        self.initialiser.add(&posed)?;
        // The network runs on a picture once its neighbours are there; doing it now spreads the work over the flight.
        self.initialiser.advance(1)?;
        self.names.push(frame.name.clone());
        self.progress.init_s += clock.elapsed().as_secs_f64();
        Ok(())
    }

    fn solve(&mut self) -> Result<(), FlyError> {
        self.progress.refined = Some(self.refiner.solve()?);
        for name in &self.names {
            if let Some(pose) = self.refiner.pose(name) {
                self.initialiser.update_pose(name, &pose);
            }
        }
        Ok(())
    }

    /// Number of key frames.
    pub fn keyframes(&self) -> usize {
        self.names.len()
    }

    /// Key frames of this run and earlier ones, with their poses as captured.
    pub fn store(&self) -> &KeyframeStore {
        &self.store
    }

    /// What has been done so far.
    pub fn progress(&self) -> &Progress {
        &self.progress
    }

    /// The trainer, for its counters and its plan.
    pub fn trainer(&self) -> &Trainer {
        &self.trainer
    }

    /// Whether enough key frames came since the last build; with `last`, whether any did.
    pub fn wants_build(&self, last: bool) -> bool {
        let (now, then) = (self.names.len(), self.built.len());
        if now < FIRST_BUILD {
            return false;
        }
        if last { now > then } else { then == 0 || now as f64 >= then as f64 * (1.0 + REBUILD_GROWTH) }
    }

    /// Whether there is a model to train.
    pub fn has_model(&self) -> bool {
        !self.built.is_empty()
    }

    /// Refines all poses, initialises from all key frames, keeps what training has made of known ground, and loads
    /// the trainer; its schedule starts anew.
    ///
    /// # Errors
    /// The network or the device fails; no pair of pictures gives any depth.
    pub fn build(&mut self) -> Result<(), FlyError> {
        let clock = Instant::now();
        self.solve()?;
        let hints: Vec<[f32; 3]> = self.refiner.sparse_points().iter().map(|p| p.position.map(|v| v as f32)).collect();
        self.initialiser.hint_points(hints);
        let capacity = self.trainer.plan().gaussians;
        let fresh = self.initialiser.build(capacity)?;
        if self.progress.builds > 0 {
            self.trainer.snapshot(&mut self.cloud)?;
        }
        let moved_px = self.moved_px(0.5 * (fresh.report.depth_m[0] + fresh.report.depth_m[1]));
        if moved_px > CARRY_LIMIT_PX {
            tracing::info!("refinement moved earlier key frames by {moved_px:.1} px: starting from a fresh cloud");
            self.cloud.clone_from(&fresh.cloud);
        } else {
            self.voxel_m = fresh.report.voxel_m;
            let before = self.cloud.len();
            carry_over(&mut self.cloud, &fresh.cloud, 2.0 * self.voxel_m, capacity);
            self.progress.carried += before as u64;
        }
        let loaded = self.trainer.load(&self.cloud)?;
        self.trainer.clear_views();
        self.built.clear();
        self.header.views.clear();
        for i in 0..self.store.len() {
            let mut picture = self.store.load(i)?;
            if let Some(pose) = self.refiner.pose(&picture.name) {
                picture.view.pose = pose;
            }
            if let Some(lens) = self.refiner.intrinsics(&picture.name) {
                picture.view.intrinsics = lens;
            }
            let estimated = self.depth.as_mut().map(|network| network.estimate(&picture.image)).transpose();
            let estimated = estimated.map_err(models::init::InitError::Network)?;
            let by_pairs = || fresh.depth_priors.iter().find(|(name, _)| *name == picture.name).map(|(_, prior)| prior);
            self.trainer.add_view(&picture, estimated.as_ref().or_else(by_pairs))?;
            self.built.push(picture.view);
            self.header.views.push((picture.name, picture.view));
        }
        if let Some(network) = &mut self.depth {
            network.close();
        }
        let refiner = &self.refiner;
        self.store.refine(|name| refiner.pose(name))?;
        self.progress.builds += 1;
        self.progress.init_s += clock.elapsed().as_secs_f64();
        tracing::info!(
            "built from {} key frames: {} Gaussians ({} from the pictures, voxel {:.2} m) in {:.1} s",
            self.names.len(),
            loaded.loaded,
            fresh.cloud.len(),
            fresh.report.voxel_m,
            clock.elapsed().as_secs_f64()
        );
        self.progress.initialised = Some(fresh.report);
        Ok(())
    }

    /// How far refinement moved the key frames of the last build since then: the largest, in pixels at `depth_m`.
    fn moved_px(&self, depth_m: f32) -> f64 {
        let depth = f64::from(depth_m).max(1e-3);
        let moved = |(view, name): (&View, &String)| {
            let now = self.refiner.pose(name)?;
            let shift = now.center.distance(view.pose.center) / depth;
            let turn = 2.0 * now.rotation.dot(view.pose.rotation).abs().min(1.0).acos();
            Some((shift + turn) * f64::from(view.intrinsics.fx))
        };
        self.built.iter().zip(&self.names).filter_map(moved).fold(0.0, f64::max)
    }

    /// Whether the schedule of `budget` is over.
    pub fn is_done(&self, budget: &RunBudget) -> bool {
        let by_steps = budget.steps.is_some_and(|s| self.trainer.steps() >= s);
        let by_time = budget.seconds.is_some_and(|s| self.trainer.elapsed_s() >= s);
        by_steps || by_time
    }

    /// Trains until the budget, the schedule, or `each` says stop.
    ///
    /// # Errors
    /// The device fails; the last checkpoint stays valid.
    pub fn train(
        &mut self,
        budget: &RunBudget,
        each: &mut dyn FnMut(&StepReport) -> ControlFlow<()>,
    ) -> Result<(), FlyError> {
        let summary = self.trainer.run(budget, each)?;
        self.progress.steps += u64::from(summary.steps);
        self.progress.train_s += summary.seconds;
        self.header.steps += u64::from(summary.steps);
        self.header.train_seconds += summary.seconds;
        Ok(())
    }

    /// Trains at half the size, or as scheduled again.
    pub fn halve_resolution(&mut self, on: bool) {
        self.trainer.set_least_divisor(if on { 2 } else { 1 });
    }

    /// Gives up the least opaque third of the Gaussians: less memory moved, less to blend.
    ///
    /// # Errors
    /// The device fails.
    pub fn shrink(&mut self) -> Result<(), FlyError> {
        self.trainer.snapshot(&mut self.cloud)?;
        let mut by_opacity = self.cloud.opacity_logits.clone();
        by_opacity.sort_by(f32::total_cmp);
        let Some(&least) = by_opacity.get(by_opacity.len() / 3) else { return Ok(()) };
        let logits = self.cloud.opacity_logits.clone();
        let removed = self.cloud.retain(|i| logits[i] >= least);
        self.trainer.load(&self.cloud)?;
        tracing::warn!("gave up {removed} Gaussians, {} remain", self.cloud.len());
        Ok(())
    }

    /// Writes the model as it is now; returns its path and its number of Gaussians.
    ///
    /// # Errors
    /// The device cannot be read or the disk written; the file written before stays.
    pub fn checkpoint(&mut self, out: &Path, finished: bool) -> Result<(PathBuf, usize), FlyError> {
        self.trainer.snapshot(&mut self.cloud)?;
        self.header.finished = finished;
        for (i, (_, view)) in self.header.views.iter_mut().enumerate() {
            if let Some(refined) = self.trainer.view_pose(i) {
                *view = refined;
            }
        }
        let path = Self::model_path(out);
        model::write(&path, &self.header, &self.cloud)?;
        Ok((path, self.cloud.len()))
    }
}
