//! Milliseconds per stage from the device's own timestamps, beside the work counted for that stage and the least time the
//! device could do it in.

use std::path::Path;

use config::plan::{Plan, sh_columns};
use engine::cost::measure::{Stopwatch, settings};
use engine::cost::model::{SH_DEGREE, Sample};
use engine::cost::slopes::{DRIVERS, Driver, Line, fit};
use engine::cost::synthetic;
use engine::device::DeviceRequest;
use models::camera::PosedImage;
use models::cloud::GaussianCloud;
use pages::report::Table;
use serde::Serialize;
use survey::dataset::Dataset;
use vulkan::gpu::Gpu;
use vulkan::kernel_config::KernelConfig;
use vulkan::roofline::Roofline;
use vulkan::stages::work::{Load, work};
use vulkan::stages::{STAGE_NAMES, STAGES};

use super::figures::short;
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
    #[serde(skip)]
    load: Load,
}

/// How one stage grows.
#[derive(Clone, Debug, Serialize)]
pub struct Growth {
    /// Name of the stage.
    pub stage: &'static str,
    /// What it loops over.
    pub driver: Driver,
    /// Milliseconds against the driver's amount.
    pub line: Line,
    /// Why.
    pub because: &'static str,
}

/// Pictures and Gaussians to train.
pub struct Scene {
    name: String,
    pictures: Vec<PosedImage>,
    cloud: GaussianCloud,
}

impl Scene {
    /// `gaussians` synthetic Gaussians under a camera of `width` × `height`.
    pub fn synthetic(gaussians: usize, width: u32, height: u32, seed: u64) -> Self {
        let pictures = SHIFTS.iter().map(|s| synthetic::picture(&synthetic::view(width, height, *s), seed)).collect();
        Self { name: "synthetic".into(), pictures, cloud: synthetic::cloud(gaussians, width, height, seed) }
    }

    /// The training pictures of a data set at `scale`, with its sparse points as Gaussians.
    ///
    /// # Errors
    /// The data set cannot be read or has no sparse points.
    pub fn of_dataset(root: &Path, scale: f64) -> Result<Self, JobError> {
        let set = Dataset::open(root)?;
        let frames = set.select("train", None)?;
        let pictures = frames.iter().map(|&i| set.load(i, scale)).collect::<Result<Vec<_>, _>>()?;
        let points = set.sparse_points_of(&frames)?;
        let (positions, colours): (Vec<[f32; 3]>, Vec<[u8; 3]>) =
            points.iter().map(|p| (p.position.map(|v| v as f32), p.color)).unzip();
        let cloud = models::init::from_sfm(&positions, &colours, positions.len().max(1))?;
        let name = root.file_name().map_or_else(|| "data set".into(), |n| n.to_string_lossy().into_owned());
        Ok(Self { name, pictures, cloud })
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
        device_mib: MOST_MIB,
        size: (width, height),
        views: scene.pictures.len(),
        crops: 0,
        view_slots: Some(scene.pictures.len() as u32),
        folder: None,
        max_gaussians: Some(scene.cloud.len()),
        scene_gaussians: None,
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

/// A line per stage through all sizes.
pub fn growth(sizes: &[SizeFigures]) -> Vec<Growth> {
    let line = |i: usize| {
        let (driver, because) = Driver::of(STAGES[i]);
        let points: Vec<_> = sizes.iter().map(|s| (driver.amount(&s.load) as f64, s.stages[i].ms)).collect();
        fit(&points).map(|line| Growth { stage: STAGE_NAMES[i], driver, line, because })
    };
    (0..STAGES.len()).filter_map(line).collect()
}

/// One table per size.
pub fn size_table(size: &SizeFigures) -> Table {
    let share = |least: f64, ms: f64| match ms > 0.0 {
        true => format!("{:.0} %", 100.0 * least / ms),
        false => "–".into(),
    };
    let row = |name: &str, ms: f64, bytes: f64, operations: f64, least: f64| {
        vec![name.into(), short(ms), short(bytes * 1e-6), short(operations * 1e-6), short(least), share(least, ms)]
    };
    let mut rows: Vec<Vec<String>> =
        size.stages.iter().map(|s| row(s.stage, s.ms, s.bytes as f64, s.operations as f64, s.least_ms)).collect();
    let sum = |f: fn(&StageFigures) -> f64| size.stages.iter().map(f).sum::<f64>();
    rows.push(row("sum", sum(|s| s.ms), sum(|s| s.bytes as f64), sum(|s| s.operations as f64), sum(|s| s.least_ms)));
    rows.push(vec!["wall clock".into(), short(size.step_ms)]);
    Table {
        title: format!("{}: {} Gaussians, {}×{}", size.scene, size.gaussians, size.width, size.height),
        note: format!(
            "Per step: {} visible, {} instances, {:.2} M evaluations{}; mean of {} steps.",
            size.visible,
            size.instances,
            size.evaluations as f64 * 1e-6,
            if size.banded > 0.0 {
                format!(", {:.0} % of the steps in bands", 100.0 * size.banded)
            } else {
                String::new()
            },
            size.steps
        ),
        head: ["stage", "ms", "MB moved", "M operations", "least ms", "of the roofline"].map(String::from).to_vec(),
        rows,
    }
}

/// One row per size: what a step took in all.
pub fn overview_table(sizes: &[SizeFigures]) -> Table {
    let row = |s: &SizeFigures| {
        let device: f64 = s.stages.iter().map(|x| x.ms).sum();
        let least: f64 = s.stages.iter().map(|x| x.least_ms).sum();
        vec![
            format!("{} {}×{}", s.scene, s.width, s.height),
            s.gaussians.to_string(),
            s.visible.to_string(),
            s.instances.to_string(),
            short(s.evaluations as f64 * 1e-6),
            short(s.step_ms),
            short(device),
            if device > 0.0 { format!("{:.0} %", 100.0 * least / device) } else { "–".into() },
        ]
    };
    let head =
        ["scene", "Gaussians", "visible", "instances", "M evaluations", "ms per step", "device ms", "of the roofline"];
    Table {
        title: "Whole steps".into(),
        note: String::new(),
        head: head.map(String::from).to_vec(),
        rows: sizes.iter().map(row).collect(),
    }
}

/// The slopes, stage by stage, then added up by what they grow with.
pub fn growth_table(growth: &[Growth]) -> Table {
    let mut rows: Vec<Vec<String>> = growth
        .iter()
        .map(|g| {
            vec![
                g.stage.into(),
                format!("per {}", g.driver.name()),
                short(1e6 * g.line.per_unit),
                short(g.line.fixed),
                g.line.r_squared.map_or("–".into(), |r| format!("{r:.2}")),
                g.because.into(),
            ]
        })
        .collect();
    for driver in DRIVERS {
        let ns: f64 = growth.iter().filter(|g| g.driver == driver).map(|g| 1e6 * g.line.per_unit).sum();
        rows.push(vec!["all stages".into(), format!("per {}", driver.name()), short(ns)]);
    }
    Table {
        title: "How cost grows".into(),
        note: "A straight line through every size: time = fixed + slope × amount.".into(),
        head: ["stage", "grows", "slope, ns", "fixed, ms", "R²", "because"].map(String::from).to_vec(),
        rows,
    }
}
