//! Milliseconds per stage from the device's own timestamps, beside the work counted for that stage and the least time the
//! device could do it in.

use config::budget::Memory;
use config::plan::{Plan, sh_columns};
use engine::device::DeviceRequest;
use models::camera::PosedImage;
use models::cloud::GaussianCloud;
use serde::Serialize;
use tuning::cost::measure::{Stopwatch, settings};
use tuning::cost::synthetic;
use tuning::model::{SH_DEGREE, Sample};
use tuning::slopes::Driver;
use vulkan::gpu::Gpu;
use vulkan::kernel_config::KernelConfig;
use vulkan::roofline::Roofline;
use vulkan::stages::work::{Load, work};
use vulkan::stages::{STAGE_NAMES, STAGES};

use crate::error::JobError;

/// Steps before the measured ones: the first compiles the kernels, the second finds the number of counting rounds.
const WARM_UP: u32 = 3;
/// Views of a synthetic scene, and how far apart they are in pictures.
const SHIFTS: [f64; 3] = [0.0, -0.05, 0.05];
/// Device memory a size may take, MiB; what is allocated is what its Gaussians and pixels need.
const MOST_MIB: u32 = 16 << 10;

/// One stage at one size, per step.
#[derive(Clone, Debug, Serialize)]
pub struct StageFigures {
    /// Name of the stage.
    pub stage: &'static str,
    /// Measured device time, ms.
    pub ms: f64,
    /// Bytes it must move.
    pub bytes: u64,
    /// Operations it must do.
    pub operations: u64,
    /// Time the device needs at least for both, by its measured rooflines, ms.
    pub least_ms: f64,
}

/// One size.
#[derive(Clone, Debug, Serialize)]
pub struct SizeFigures {
    /// What was trained on.
    pub scene: String,
    /// Picture width, pixels.
    pub width: u32,
    /// Picture height, pixels.
    pub height: u32,
    /// Gaussians loaded.
    pub gaussians: u64,
    /// Gaussians in view, per step.
    pub visible: u64,
    /// Instances, per step.
    pub instances: u64,
    /// Gaussian–pixel evaluations of the forward blend, per step.
    pub evaluations: u64,
    /// Steps measured.
    pub steps: u32,
    /// Share of them that needed more than one band.
    pub banded: f64,
    /// Wall clock per step, ms.
    pub step_ms: f64,
    /// The stages.
    pub stages: Vec<StageFigures>,
    /// What each stage loops over.
    #[serde(skip)]
    pub load: Load,
}

/// Pictures and Gaussians to train.
pub struct Scene {
    /// What it is called in a report.
    pub name: String,
    /// The views.
    pub pictures: Vec<PosedImage>,
    /// What is trained.
    pub cloud: GaussianCloud,
}

impl Scene {
    /// `gaussians` synthetic Gaussians under a camera of `width` × `height`.
    pub fn synthetic(gaussians: usize, width: u32, height: u32, seed: u64) -> Self {
        let pictures = SHIFTS.iter().map(|s| synthetic::picture(&synthetic::view(width, height, *s), seed)).collect();
        Self { name: "synthetic".into(), pictures, cloud: synthetic::cloud(gaussians, width, height, seed) }
    }
}

/// Trains `steps` steps of `scene` at full size without density control, and divides by them.
///
/// # Errors
/// The device, or its memory.
pub fn measure(
    gpu: &Gpu,
    config: KernelConfig,
    roofline: &Roofline,
    scene: &Scene,
    steps: u32,
) -> Result<SizeFigures, JobError> {
    let largest = scene.pictures.iter().map(|p| p.image.dimensions()).max_by_key(|(w, h)| w * h);
    let Some((width, height)) = largest else {
        return Err(JobError::Request(format!("{}: no training pictures", scene.name)));
    };
    let request = DeviceRequest {
        device: None,
        memory: Memory {
            view_slots: Some(scene.pictures.len() as u32),
            ..Memory::for_gaussians(MOST_MIB, scene.cloud.len())
        },
        size: (width, height),
        views: scene.pictures.len(),
        crops: 0,
        folder: None,
    };
    let plan = Plan::new(&request.plan_request(&settings().sh, gpu.info().lanes()))?;
    let mut watch = Stopwatch::new(gpu, config, &plan, &scene.pictures)?;
    watch.load(&scene.cloud)?;
    for _ in 0..WARM_UP {
        watch.step()?;
    }
    let timed = (0..steps).map(|_| watch.step()).collect::<Result<Vec<_>, _>>()?;
    let n = timed.len().max(1) as f64;
    let mean = |of: &dyn Fn(&Sample) -> f64| timed.iter().map(|t| of(&t.sample)).sum::<f64>() / n;
    let amount = |driver: Driver| mean(&|s| driver.amount(&s.load) as f64) as u64;
    let load = Load {
        gaussians: amount(Driver::Gaussians),
        visible: amount(Driver::Visible),
        instances: amount(Driver::Instances),
        evaluations: amount(Driver::Evaluations),
        pixels: u64::from(width) * u64::from(height),
        sh_columns: sh_columns(SH_DEGREE),
    };
    let stages = STAGES.iter().enumerate().map(|(i, stage)| {
        let w = work(*stage, &load);
        StageFigures {
            stage: STAGE_NAMES[i],
            ms: mean(&|s| s.stage_ms[i]),
            bytes: w.bytes,
            operations: w.operations,
            least_ms: 1e3 * roofline.least_seconds(w.bytes, w.operations),
        }
    });
    Ok(SizeFigures {
        scene: scene.name.clone(),
        width,
        height,
        gaussians: load.gaussians,
        visible: load.visible,
        instances: load.instances,
        evaluations: load.evaluations,
        steps,
        banded: timed.iter().filter(|t| t.bands > 1).count() as f64 / n,
        step_ms: mean(&|s| s.step_ms),
        stages: stages.collect(),
        load,
    })
}
