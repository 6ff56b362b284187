//! All that a board or a card can tell in ten minutes: who it is, whether it computes what the reference does, which kernel configuration is
//! the fastest, the time of each stage at three sizes, a small survey trained, and how warm it became.

use std::path::Path;
use std::time::{Duration, Instant};

use job::health::board::Board;
use job::health::power::pmic_watts;
use serde::Serialize;
use serde_json::{Value, json};
use tuning::autotune::autotune;
use vulkan::gpu::{Gpu, GpuInfo};
use vulkan::kernel_config::KernelConfig;
use vulkan::roofline;
use vulkan::trainer::{TrainError, check_device, check_training};

use crate::child;
use crate::error::JobError;
use stages::{Scene, SizeFigures, measure as measure_stages};

mod machine;
pub mod stages;
pub mod survey;

pub use machine::Machine;

/// Form of the report.
const VERSION: u32 = 1;
/// Steps beside the reference, and steps whose stages are timed.
const CHECKED_STEPS: u32 = 20;
const TIMED_STEPS: u32 = 10;
/// Gaussians and picture sizes of the stages' table: three of the nine of `bench stages`.
pub const SIZES: [(usize, (u32, u32)); 3] = [(10_000, (270, 480)), (100_000, (640, 480)), (500_000, (1280, 720))];
/// The survey's Gaussians and MiB.
const SURVEY: [(&str, u32); 2] = [("--max-gaussians", 20_000), ("--budget-mib", 192)];

/// How much is measured.
#[derive(Clone, Debug)]
pub struct Extent {
    /// Part of the device's name.
    pub device: Option<String>,
    /// No further kernel configuration is tried after this.
    pub autotuning: Duration,
    /// How many of [`SIZES`].
    pub sizes: usize,
    /// Steps of the survey.
    pub steps: u32,
}

/// The board at one moment.
#[derive(Clone, Debug, Serialize)]
pub struct Sample {
    /// What was done just before.
    pub after: &'static str,
    /// Seconds since the beginning.
    pub seconds: f64,
    /// The hottest thermal zone.
    pub hottest_c: Option<f32>,
    /// What the board takes, where it is measured.
    pub watts: Option<f32>,
    /// The clock was limited.
    pub throttled: bool,
    /// The supply was too weak.
    pub under_voltage: bool,
}

/// The survey, trained.
#[derive(Clone, Debug, Serialize)]
pub struct Survey {
    /// Steps.
    pub steps: u64,
    /// Seconds of training.
    pub seconds: f64,
    /// Seconds of everything, with the first Gaussians.
    pub wall_s: f64,
    /// Gaussians.
    pub gaussians: u64,
    /// Held-out PSNR, dB.
    pub psnr: Option<f64>,
    /// Bytes that were planned for the device, and taken of it.
    pub device_bytes: [u64; 2],
}

/// The report.
#[derive(Clone, Debug, Serialize)]
pub struct DeviceReport {
    /// Form of the report.
    pub version: u32,
    /// Version of the program.
    pub dgtr: &'static str,
    /// The computer.
    pub machine: Machine,
    /// The Vulkan device.
    pub device: Value,
    /// Gaussians whose projection is the reference's, and the loss after whole steps, the device's and the reference's.
    pub reference: Value,
    /// Kernel configurations: the fastest, all trials in ms, those that compute something else.
    pub autotuning: Value,
    /// Measured rates.
    pub roofline: Value,
    /// Milliseconds, bytes and operations per stage.
    pub sizes: Vec<SizeFigures>,
    /// Sizes that this device has no memory for, and why.
    pub left_out: Vec<String>,
    /// The small survey.
    pub survey: Survey,
    /// The board meanwhile.
    pub board: Vec<Sample>,
    /// Seconds of everything.
    pub seconds: f64,
}

impl DeviceReport {
    /// Its row in `tests/DEVICES.md`.
    pub fn row(&self) -> Vec<String> {
        let ms = |i: usize| self.sizes.get(i).map_or_else(|| "–".to_owned(), |s| format!("{:.1}", s.step_ms));
        let most = |of: fn(&Sample) -> Option<f32>| {
            self.board.iter().filter_map(of).fold(None, |a: Option<f32>, b| Some(a.map_or(b, |a| a.max(b))))
        };
        let or_not = |value: Option<f32>| value.map_or_else(|| "–".to_owned(), |v| format!("{v:.1}"));
        vec![
            self.machine.model.clone().unwrap_or_else(|| self.machine.processor.clone().unwrap_or_default()),
            self.device["name"].as_str().unwrap_or_default().to_owned(),
            self.autotuning["configuration"].as_str().unwrap_or_default().to_owned(),
            ms(0),
            ms(1),
            ms(2),
            format!("{:.1}", self.survey.seconds),
            self.survey.psnr.map_or_else(|| "–".to_owned(), |p| format!("{p:.2}")),
            or_not(most(|s| s.watts)),
            or_not(most(|s| s.hottest_c)),
        ]
    }
}

/// Measures a device; what it writes goes into `folder`.
///
/// # Errors
/// No device, one that computes something else, or a folder that cannot be written to.
pub fn measure(extent: &Extent, folder: &Path) -> Result<DeviceReport, JobError> {
    let start = Instant::now();
    let sensors = Board::find(Path::new("/sys"));
    let mut board = Vec::new();
    let mut look = |after: &'static str| {
        let state = sensors.read();
        board.push(Sample {
            after,
            seconds: start.elapsed().as_secs_f64(),
            hottest_c: state.hottest_c,
            watts: state.watts.or_else(pmic_watts),
            throttled: state.throttled,
            under_voltage: state.under_voltage,
        });
    };
    look("nothing");
    let gpu = Gpu::open(extent.device.as_deref())?;
    let agreed = check_device(&gpu)?;
    let standard = check_training(&gpu, KernelConfig::standard(gpu.info()), CHECKED_STEPS)?;
    let found = autotune(&gpu, Some(extent.autotuning))?;
    let fastest = check_training(&gpu, found.config, CHECKED_STEPS)?;
    look("autotuning");
    let rates = roofline::measure(&gpu)?;
    let (mut sizes, mut left_out) = (Vec::new(), Vec::new());
    for (gaussians, (width, height)) in SIZES.into_iter().take(extent.sizes) {
        let scene = Scene::synthetic(gaussians, width, height, 1);
        match measure_stages(&gpu, found.config, &rates, &scene, TIMED_STEPS) {
            Ok(figures) => sizes.push(figures),
            // What a small board has no memory for says something, too.
            Err(JobError::Train(TrainError::Gpu(e))) => {
                left_out.push(format!("{gaussians} Gaussians in {width}x{height}: {e}"));
            }
            Err(e) => return Err(e),
        }
        look("stages");
    }
    let survey = train_survey(gpu.info(), extent.steps, folder)?;
    look("training");
    Ok(DeviceReport {
        version: VERSION,
        dgtr: env!("CARGO_PKG_VERSION"),
        machine: Machine::here(),
        device: device(gpu.info()),
        reference: json!({
            "projected": agreed, "steps": CHECKED_STEPS,
            "loss": fastest.loss, "standard_loss": standard.loss, "reference_loss": fastest.reference_loss,
        }),
        autotuning: json!({
            "configuration": found.config.to_string(),
            "seconds": found.seconds,
            "trials": found.trials.iter().map(|t| json!({ "configuration": t.config.to_string(), "ms": t.ms })).collect::<Vec<_>>(),
            "refused": found.refused.iter().map(ToString::to_string).collect::<Vec<_>>(),
        }),
        roofline: json!({
            "kernel_bytes_per_s": rates.kernel_bytes_per_s,
            "command_bytes_per_s": rates.command_bytes_per_s,
            "operations_per_s": rates.operations_per_s,
        }),
        sizes,
        left_out,
        survey,
        board,
        seconds: start.elapsed().as_secs_f64(),
    })
}

fn device(info: &GpuInfo) -> Value {
    json!({
        "name": info.name,
        "vulkan": info.has_driver().then(|| format!("{}.{}", info.version.0, info.version.1)),
        "driver_version": info.driver_version,
        "vendor": info.ids.0,
        "device": info.ids.1,
        "software": info.is_cpu,
        "integrated": info.is_integrated,
        "subgroup_size": info.subgroup_size,
        "shuffles": info.shuffles,
        "heap_mib": info.heap_bytes >> 20,
        "workgroup_lanes": info.limits.workgroup_lanes,
        "texel_elements": info.limits.texel_elements,
        "storage_buffers": info.limits.storage_buffers,
    })
}

/// A simulated survey of 24 pictures of 320 × 240, from the first picture on, in a process of its own.
fn train_survey(info: &GpuInfo, steps: u32, folder: &Path) -> Result<Survey, JobError> {
    let data = folder.join("survey");
    survey::write_data_set(&data, 1, 1.0)?;
    let mut arguments = vec!["train".to_owned(), data.display().to_string(), "--fresh".into()];
    arguments.extend(["--device".to_owned(), info.name.clone(), "--steps".into(), steps.to_string()]);
    arguments.extend(SURVEY.iter().flat_map(|(flag, n)| [(*flag).to_owned(), n.to_string()]));
    let report = child::run(&[], &arguments, &folder.join("model"), None)?.report("training")?;
    Ok(Survey {
        steps: report.steps,
        seconds: report.more.get("train_seconds").and_then(Value::as_f64).unwrap_or(0.0),
        wall_s: report.wall_s,
        gaussians: report.gaussians,
        psnr: report.psnr,
        device_bytes: [report.memory.device_bytes_planned, report.memory.device_bytes_peak],
    })
}
