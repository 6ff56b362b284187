//! What `auto` forecasts of a step against what the step takes, at the three sizes of `dgtr doctor --report`.

use pages::report::Table;
use serde::Serialize;
use tuning::cost::measure;
use tuning::cost::synthetic::IN_VIEW;
use tuning::loads::{Footprint, Visibility};
use tuning::model::{CostModel, load};
use vulkan::gpu::Gpu;
use vulkan::kernel_config::KernelConfig;
use vulkan::roofline::Roofline;

use runtime::device_report::SIZES;
use runtime::device_report::stages::{Scene, measure as measure_stages};
use runtime::error::JobError;
use runtime::figures::short;

/// One size.
#[derive(Clone, Debug, Serialize)]
pub struct Forecast {
    /// Gaussians.
    pub gaussians: usize,
    /// Width and height, pixels.
    pub size: (u32, u32),
    /// Milliseconds of a step by what is known beforehand: Gaussians, size, share in view.
    pub forecast_ms: f64,
    /// Milliseconds of a step by the work that was counted.
    pub by_work_ms: f64,
    /// What it took.
    pub measured_ms: f64,
    /// Instances forecast and counted.
    pub instances: [u64; 2],
}

impl Forecast {
    /// Forecast over measured.
    pub fn ratio(&self) -> f64 {
        self.forecast_ms / self.measured_ms
    }
}

/// The model as it is measured at the end, and each size by what is measured before and after it: a machine that is faster now than a minute
/// ago (others use it, its clock rises and falls) says nothing about the forecast.
///
/// # Errors
/// The device, or its memory.
pub fn measured(
    gpu: &Gpu,
    config: KernelConfig,
    sizes: usize,
    steps: u32,
) -> Result<(CostModel, Vec<Forecast>), JobError> {
    let mut model = measure::measure(gpu, config)?;
    // Nothing is held against what the device could do.
    let none = Roofline { kernel_bytes_per_s: 1.0, command_bytes_per_s: 1.0, operations_per_s: 1.0 };
    let mut all = Vec::new();
    for (gaussians, size) in SIZES.into_iter().take(sizes) {
        let pixels = u64::from(size.0) * u64::from(size.1);
        let before = Visibility { gaussians: gaussians as u64, share: IN_VIEW, pixels }.load(Footprint::SYNTHETIC);
        let taken = measure_stages(gpu, config, &none, &Scene::synthetic(gaussians, size.0, size.1, 1), steps)?;
        let counted = load(taken.gaussians, taken.visible, taken.instances, taken.evaluations, pixels);
        let after = measure::measure(gpu, config)?;
        let meanwhile = model.between(&after);
        model = after;
        all.push(Forecast {
            gaussians,
            size,
            forecast_ms: meanwhile.step_ms(&before),
            by_work_ms: meanwhile.step_ms(&counted),
            measured_ms: taken.step_ms,
            instances: [before.instances, taken.instances],
        });
    }
    Ok((model, all))
}

/// One row per size.
pub fn table(gpu: &Gpu, model: &CostModel, all: &[Forecast]) -> Table {
    let row = |f: &Forecast| {
        vec![
            format!("{} {}×{}", f.gaussians, f.size.0, f.size.1),
            short(f.forecast_ms),
            short(f.measured_ms),
            format!("{:.2}", f.ratio()),
            format!("{:.2}", f.by_work_ms / f.measured_ms),
            format!("{:.2}", f.instances[0] as f64 / f.instances[1].max(1) as f64),
        ]
    };
    let head = ["scene", "forecast, ms", "measured, ms", "ratio", "ratio by counted work", "instances, ratio"];
    Table {
        title: format!("{}: forecast of a step", gpu.info().name),
        note: format!(
            "{} threads; fixed {} ms; per Gaussian {} ns, in view {}, pixel {}, instance {}, evaluation {}.",
            gpu.info().threads(),
            short(model.fixed_ms),
            short(model.gaussian_ns),
            short(model.visible_ns),
            short(model.pixel_ns),
            short(model.instance_ns),
            short(model.evaluation_ns)
        ),
        head: head.map(String::from).to_vec(),
        rows: all.iter().map(row).collect(),
    }
}
