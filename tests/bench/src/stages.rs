//! Milliseconds per stage, how they grow with what a stage loops over, and tables of both.

use std::path::Path;

use pages::report::Table;
use runtime::device_report::stages::{Scene, SizeFigures, StageFigures};
use runtime::error::JobError;
use runtime::figures::short;
use serde::Serialize;
use survey::dataset::Dataset;
use tuning::slopes::{DRIVERS, Driver, Line, fit};
use vulkan::stages::{STAGE_NAMES, STAGES};

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

/// The training pictures of a data set at `scale`, with its sparse points as Gaussians.
///
/// # Errors
/// The data set cannot be read or has no sparse points.
pub fn of_dataset(root: &Path, scale: f64) -> Result<Scene, JobError> {
    let set = Dataset::open(root)?;
    let frames = set.select("train", None)?;
    let pictures = frames.iter().map(|&i| set.load(i, scale)).collect::<Result<Vec<_>, _>>()?;
    let points = set.sparse_points_of(&frames)?;
    let (positions, colours): (Vec<[f32; 3]>, Vec<[u8; 3]>) =
        points.iter().map(|p| (p.position.map(|v| v as f32), p.color)).unzip();
    let cloud = models::init::from_sfm(&positions, &colours, positions.len().max(1))?;
    let name = root.file_name().map_or_else(|| "data set".into(), |n| n.to_string_lossy().into_owned());
    Ok(Scene { name, pictures, cloud })
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
