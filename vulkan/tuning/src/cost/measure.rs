//! Steps measured on the device, one by one: a few of small synthetic scenes that are large in one driver and small in another.

use std::ops::ControlFlow;

use config::plan::{Plan, PlanRequest};
use config::training::{Strategy, TrainSettings};
use models::camera::PosedImage;
use vulkan::gpu::Gpu;
use vulkan::kernel_config::KernelConfig;
use vulkan::stages::STAGES;
use vulkan::trainer::{Counters, PictureStore, RunBudget, TrainError, Trainer};

use super::synthetic;
use crate::model::{CostModel, SH_DEGREE, Sample, load};

/// Gaussians of the scenes, and pictures that each is rendered with: so that neither grows with the other. The largest of both takes
/// 110 MiB of the device.
const CLOUDS: [usize; 2] = [6000, 48_000];
const PICTURES: [(u32, u32); 3] = [(128, 96), (256, 192), (480, 360)];
/// Instances per pixel of the largest picture that are planned for; those scenes have half as many.
const INSTANCES_PER_PIXEL: usize = 3;
/// Rounds over all pictures before the measured ones (the first step compiles the kernels), and those.
const WARM_UP: usize = 1;
const ROUNDS: usize = 4;

/// Steps that nobody takes: the most that a schedule may have.
const ENDLESS: u32 = 1_000_000_000;

/// The recipe by which steps are measured: whole pictures, no density control, no end.
pub fn settings() -> TrainSettings {
    let mut settings = TrainSettings { steps: ENDLESS, ..TrainSettings::default() };
    settings.density.strategy = Strategy::None;
    (settings.resolution.quarter_until, settings.resolution.half_until) = (0.0, 0.0);
    settings.stop.enabled = false;
    settings
}

/// A step and where it looked.
#[derive(Clone, Copy, Debug)]
pub struct Timed {
    /// The view.
    pub view: usize,
    /// What it took.
    pub sample: Sample,
    /// Bands it was blended in.
    pub bands: usize,
}

/// A trainer whose every step is timed.
#[derive(Debug)]
pub struct Stopwatch {
    trainer: Trainer,
    pictures: PictureStore,
    counters: Counters,
    stage_ms: [f64; STAGES.len()],
}

impl Stopwatch {
    /// One for pictures of these sizes, which become its views.
    ///
    /// # Errors
    /// The device, or its memory.
    pub fn new(gpu: &Gpu, config: KernelConfig, plan: &Plan, pictures: &[PosedImage]) -> Result<Self, TrainError> {
        let mut trainer = Trainer::with_config(gpu, plan, &settings(), config)?;
        trainer.device_mut().time_every_step();
        let mut store = PictureStore::new(plan);
        for picture in pictures {
            store.add(trainer.device_mut(), picture, None)?;
        }
        Ok(Self { trainer, pictures: store, counters: Counters::default(), stage_ms: [0.0; STAGES.len()] })
    }

    /// Takes these Gaussians from here on.
    ///
    /// # Errors
    /// The device.
    pub fn load(&mut self, cloud: &models::cloud::GaussianCloud) -> Result<(), TrainError> {
        self.trainer.load(cloud)?;
        (self.counters, self.stage_ms) = (Counters::default(), [0.0; STAGES.len()]);
        Ok(())
    }

    /// One step.
    ///
    /// # Errors
    /// The device.
    pub fn step(&mut self) -> Result<Timed, TrainError> {
        let mut report = None;
        let summary = self.trainer.run(&mut self.pictures, &RunBudget::default(), &mut |r| {
            report = Some(*r);
            ControlFlow::Break(())
        })?;
        let Some(report) = report else { return Err(TrainError::NoViews) };
        let stage_ms = self.trainer.device().stage_ms().map(|s| s.1);
        let before = std::mem::replace(&mut self.stage_ms, stage_ms);
        let evaluations = summary.counters.evaluations - self.counters.evaluations;
        self.counters = summary.counters;
        let pixels = self.pictures.view(report.view).map_or(0, |v| v.intrinsics.pixels() as u64);
        let gaussians = self.trainer.gaussians() as u64;
        Ok(Timed {
            view: report.view,
            sample: Sample {
                load: load(gaussians, report.visible as u64, report.instances, evaluations, pixels),
                stage_ms: std::array::from_fn(|i| stage_ms[i] - before[i]),
                step_ms: 1e3 * summary.seconds,
            },
            bands: report.bands,
        })
    }
}

/// What steps cost on `gpu` with kernels of `config`.
///
/// # Errors
/// The device, or its memory.
pub fn measure(gpu: &Gpu, config: KernelConfig) -> Result<CostModel, TrainError> {
    let views = PICTURES.map(|(w, h)| synthetic::view(w, h, 0.0));
    let pictures: Vec<PosedImage> = views.iter().map(|v| synthetic::picture(v, 1)).collect();
    let ((width, height), gaussians) = (PICTURES[PICTURES.len() - 1], CLOUDS[CLOUDS.len() - 1]);
    let request = PlanRequest {
        device_mib: u32::MAX,
        width,
        height,
        views: PICTURES.len() as u32,
        sh_degree: SH_DEGREE,
        max_gaussians: Some(gaussians),
        lanes: gpu.info().lanes(),
        ..PlanRequest::default()
    };
    let pixels = width as usize * height as usize;
    let plan = Plan::with_capacities(&request, gaussians, INSTANCES_PER_PIXEL * pixels);
    let mut watch = Stopwatch::new(gpu, config, &plan, &pictures)?;
    let mut samples = Vec::with_capacity(CLOUDS.len() * PICTURES.len());
    for gaussians in CLOUDS {
        watch.load(&synthetic::cloud(gaussians, width, height, 1))?;
        for _ in 0..WARM_UP * PICTURES.len() {
            watch.step()?;
        }
        let timed = (0..ROUNDS * PICTURES.len()).map(|_| watch.step()).collect::<Result<Vec<_>, _>>()?;
        for view in 0..PICTURES.len() {
            samples.extend(middle(timed.iter().filter(|t| t.view == view).map(|t| t.sample)));
        }
    }
    Ok(CostModel::fitted(&samples))
}

/// The median of every time; the work is the first's, for it hardly changes.
fn middle(samples: impl Iterator<Item = Sample>) -> Option<Sample> {
    let all: Vec<Sample> = samples.collect();
    let median = |of: &dyn Fn(&Sample) -> f64| {
        let mut sorted: Vec<f64> = all.iter().map(of).collect();
        sorted.sort_by(f64::total_cmp);
        sorted[sorted.len() / 2]
    };
    all.first().map(|first| Sample {
        load: first.load,
        stage_ms: std::array::from_fn(|i| median(&|s| s.stage_ms[i])),
        step_ms: median(&|s| s.step_ms),
    })
}
