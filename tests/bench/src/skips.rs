//! Every skip switched off and on, alone and all together: work avoided, seconds saved, error added.

use std::path::Path;

use config::mission::KeyframeSettings;
use flight::capture::KeyframeSelector;
use models::camera::Pose;
use pages::report::Table;
use serde::Serialize;
use toml::{Table as Toml, Value};

use super::child;
use runtime::error::JobError;
use runtime::figures::{short, write_text};

/// A skip that saves less than this share of the time …
pub const LEAST_SAVING: f64 = 0.02;
/// … or costs more than this, dB, should be off by default.
pub const MOST_COST_DB: f64 = 0.05;

/// A field of the settings file: where it is, and its value.
type Setting = (&'static str, fn() -> Value);

/// One kind of work that can be left out.
pub struct Skip {
    /// Name in the table.
    pub name: &'static str,
    /// Settings that leave the work out.
    on: &'static [Setting],
    /// Settings that do it all.
    off: &'static [Setting],
    /// Whether it only acts when the feed-forward network initialises.
    pub feed_forward: bool,
}

macro_rules! skip {
    ($name:literal, $forward:literal, $($path:literal: $on:expr => $off:expr),+) => {
        Skip {
            name: $name,
            on: &[$(($path, || Value::from($on))),+],
            off: &[$(($path, || Value::from($off))),+],
            feed_forward: $forward,
        }
    };
}

/// The skips with a switch in `[training]` or `[init]`.
pub const SKIPS: &[Skip] = &[
    skip!("culling at the picture's edges", false, "training.skips.frustum": true => false),
    skip!("culling by opacity", false, "training.skips.opacity": true => false),
    skip!("exact tile-ellipse lists", false, "training.skips.exact_tiles": true => false),
    skip!("early end of opaque tiles", false, "training.skips.early_end": true => false),
    skip!("lazy Adam outside the view", false, "training.skips.deferred_moments": true => false),
    skip!(
        "SH degree raised late", false,
        "training.sh.raise_at": vec![0.033, 0.067, 0.1] => vec![0.0, 0.0, 0.0]
    ),
    skip!("SH degree by residual", false, "training.sh.raise_share": 0.25 => 1.0),
    skip!("half resolution at first", false, "training.resolution.half_until": 0.5 => 0.0),
    skip!("views by residual", false, "training.views.residual_share": 0.5 => 0.0),
    skip!("stop when the loss stops falling", false, "training.stop.enabled": true => false),
    skip!("no depth loss where confidence is low", true, "training.loss.depth_confidence": 0.1 => 0.0),
    skip!(
        "pairs without baseline or overlap", true,
        "init.min_overlap": 0.35 => 0.0,
        "init.baseline": vec![0.03, 0.9] => vec![0.0, 10.0],
        "init.max_angle_deg": 45.0 => 120.0
    ),
];

/// Skips of the design that this benchmark cannot switch, and why.
pub const NOT_SWITCHED: [(&str, &str); 4] = [
    (
        "subgroup or sub-tile rejection",
        "a lane blends a whole tile of 8×4 pixels in registers: there is nothing smaller to reject",
    ),
    (
        "networks not loaded when not needed",
        "nothing asks for them then: a model that continues without depth loss, or starts from points",
    ),
    (
        "distillation only where regions meet",
        "the ground's: elsewhere the union is the teacher itself; run.json counts views and cells",
    ),
    (
        "converged views rested",
        "built as the other half of views by residual: extra visits go to the worst, none to the rest",
    ),
];

/// What one configuration did.
#[derive(Clone, Debug, Serialize)]
pub struct Run {
    /// Which skips were on.
    pub name: String,
    /// Seconds from the first picture to the model, evaluation left out.
    pub seconds: f64,
    /// Steps taken.
    pub steps: u64,
    /// Gaussian–tile instances of all steps.
    pub instances: u64,
    /// Gaussian–pixel evaluations of all steps.
    pub evaluations: u64,
    /// Pairs that were not sent to the network.
    pub pairs: u64,
    /// SH coefficients of all steps that no Gaussian had.
    pub sh_coefficients: u64,
    /// Held-out PSNR, dB.
    pub psnr: f64,
}

/// Trains once with the skips for which `on` holds; the others are off. `arguments` are those of `dgtr train`.
///
/// # Errors
/// The child failed, found no device, or was stopped.
pub fn train(
    name: &str,
    base: &Toml,
    on: impl Fn(usize) -> bool,
    arguments: &[String],
    out: &Path,
) -> Result<Run, JobError> {
    let mut settings = base.clone();
    for (i, skip) in SKIPS.iter().enumerate() {
        for (path, value) in if on(i) { skip.on } else { skip.off } {
            put(&mut settings, path, value())?;
        }
    }
    let file = out.join("settings.toml");
    write_text(&file, &settings.to_string())?;
    let mut all = vec!["train".to_owned()];
    all.extend(arguments.iter().cloned());
    all.extend(["--settings".to_owned(), file.display().to_string(), "--fresh".to_owned()]);
    let ended = child::run(&all, out, None)?;
    let report = ended.report(name)?;
    let work = |what: &str| report.more.get("work").and_then(|w| w.get(what)?.as_u64()).unwrap_or(0);
    let psnr =
        report.psnr.ok_or_else(|| JobError::Request("the data set has no held-out pictures (split `test`)".into()))?;
    Ok(Run {
        name: name.to_owned(),
        seconds: report.wall_s - report.stage_ms.get("evaluate").copied().unwrap_or(0.0) * 1e-3,
        steps: report.steps,
        instances: work("instances"),
        evaluations: work("evaluations"),
        pairs: report.skipped.get("pairs").copied().unwrap_or(0),
        sh_coefficients: report.skipped.get("sh_coefficients").copied().unwrap_or(0),
        psnr,
    })
}

/// Sets `path` (names joined by dots), making the tables on the way.
fn put(settings: &mut Toml, path: &str, value: Value) -> Result<(), JobError> {
    let mut names: Vec<&str> = path.split('.').collect();
    let last = names.pop().unwrap_or_default();
    let mut at = settings;
    for name in names {
        let below = at.entry(name).or_insert_with(|| Value::Table(Toml::new()));
        at = below.as_table_mut().ok_or_else(|| JobError::Request(format!("settings: {name} is not a table")))?;
    }
    at.insert(last.to_owned(), value);
    Ok(())
}

/// The fastest of runs that are the same to the bit: what else the machine did can only have slowed them down.
pub fn fastest(runs: &[Run]) -> Option<Run> {
    runs.iter().min_by(|a, b| a.seconds.total_cmp(&b.seconds)).cloned()
}

/// The mean of runs that differ only in their seed.
pub fn mean(runs: &[Run]) -> Option<Run> {
    let n = runs.len() as f64;
    let mut first = runs.first()?.clone();
    let sum = |f: fn(&Run) -> f64| runs.iter().map(f).sum::<f64>() / n;
    (first.seconds, first.psnr) = (sum(|r| r.seconds), sum(|r| r.psnr));
    first.steps = sum(|r| r.steps as f64) as u64;
    first.instances = sum(|r| r.instances as f64) as u64;
    first.evaluations = sum(|r| r.evaluations as f64) as u64;
    first.pairs = sum(|r| r.pairs as f64) as u64;
    first.sh_coefficients = sum(|r| r.sh_coefficients as f64) as u64;
    Some(first)
}

/// What the rule says about a skip: `saved` is a share of the time, `cost_db` the PSNR lost.
pub fn verdict(saved: f64, cost_db: f64) -> String {
    match (saved < LEAST_SAVING, cost_db > MOST_COST_DB) {
        (false, false) => "keep on".into(),
        (true, false) => format!("off: saves {:.1} %", 100.0 * saved),
        (false, true) => format!("off: costs {cost_db:.2} dB"),
        (true, true) => format!("off: saves {:.1} %, costs {cost_db:.2} dB", 100.0 * saved),
    }
}

/// One row per run against `none`, in which no skip is on.
pub fn table(none: &Run, runs: &[Run]) -> Table {
    let less = |now: u64, before: u64| match before {
        0 => "–".to_owned(),
        _ => format!("{:+.1} %", 100.0 * (now as f64 / before as f64 - 1.0)),
    };
    let row = |r: &Run| {
        let (saved, cost) = (1.0 - r.seconds / none.seconds, none.psnr - r.psnr);
        vec![
            r.name.clone(),
            r.steps.to_string(),
            less(r.instances, none.instances),
            less(r.evaluations, none.evaluations),
            r.pairs.to_string(),
            format!("{:.1}", r.sh_coefficients as f64 * 1e-6),
            short(r.seconds),
            short(none.seconds - r.seconds),
            format!("{:+.1} %", 100.0 * saved),
            format!("{:.2}", r.psnr),
            format!("{:+.3}", 0.0 - cost),
            verdict(saved, cost),
        ]
    };
    let mut rows = vec![row(none)];
    rows[0][11] = "what the others are held against".into();
    rows.extend(runs.iter().map(row));
    if let Some(last) = rows.last_mut().filter(|_| !runs.is_empty()) {
        last[11] = "all of them".into();
    }
    let head = [
        "skips on",
        "steps",
        "instances",
        "evaluations",
        "pairs left out",
        "M SH coefficients left out",
        "s",
        "saved s",
        "saved",
        "PSNR, dB",
        "change, dB",
        "by the rule",
    ];
    Table {
        title: "Skips".into(),
        note: format!(
            "Each alone, then all together. The rule: what saves less than {:.0} % or costs more than {MOST_COST_DB} dB \
             should be off by default.",
            100.0 * LEAST_SAVING
        ),
        head: head.map(String::from).to_vec(),
        rows,
    }
}

/// How many of the pictures become key frames, with and without leaving covered places out.
pub fn captured(poses: &[Pose]) -> [u32; 2] {
    [true, false].map(|skip_covered| {
        let settings = KeyframeSettings { skip_covered, max: poses.len().max(2) as u32, ..Default::default() };
        let mut selector = KeyframeSelector::new(settings);
        for pose in poses {
            selector.consider(pose);
        }
        selector.counters().key
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use config::init::InitSettings;
    use config::training::TrainSettings;

    #[test]
    fn the_rule_is_two_percent_and_a_twentieth_of_a_decibel() {
        assert_eq!(verdict(0.10, 0.0), "keep on");
        assert_eq!(verdict(0.10, -0.3), "keep on");
        assert!(verdict(0.01, 0.0).starts_with("off: saves"));
        assert!(verdict(0.10, 0.06).starts_with("off: costs"));
    }

    /// A renamed field would make a row that measures nothing.
    #[test]
    fn every_switch_is_a_field_of_the_settings_and_both_positions_are_valid() {
        #[derive(serde::Deserialize)]
        #[serde(default, deny_unknown_fields)]
        #[derive(Default)]
        struct Settings {
            training: TrainSettings,
            init: InitSettings,
        }
        let of = |switches: &[Setting]| {
            let mut all = Toml::new();
            for (path, value) in switches {
                put(&mut all, path, value()).unwrap();
            }
            let settings: Settings = toml::from_str(&all.to_string()).unwrap();
            settings.training.check().unwrap();
            settings.init.check().unwrap();
            (settings.training, settings.init)
        };
        for skip in SKIPS {
            assert_ne!(of(skip.on), of(skip.off), "{}", skip.name);
        }
    }

    #[test]
    fn a_second_pass_is_captured_again_only_without_the_skip() {
        let at = |x: f64| Pose { rotation: glam::DQuat::IDENTITY, center: glam::DVec3::new(x, 0.0, 40.0) };
        assert_eq!(captured(&[at(0.0), at(9.0), at(18.0), at(9.0)]), [3, 4]);
    }
}
