//! Seconds from the first picture against held-out error: one child process per point, so that every figure contains all
//! the work it took — reading, initialising, training — and nothing else.

use std::path::{Path, PathBuf};

use job::run_json::RunReport;
use pages::report::chart::{Chart, ChartPoint, Series};
use pages::report::{Table, count};
use serde::Serialize;

use super::child;
use super::front::{Group, Speedup, mark_front, speedup};
use runtime::error::JobError;
use runtime::figures::short;

/// What to measure.
#[derive(Clone, Debug)]
pub struct Request {
    /// Data sets.
    pub datasets: Vec<PathBuf>,
    /// Seconds of training.
    pub seconds: Vec<f64>,
    /// Device memory, MiB.
    pub budgets_mib: Vec<u32>,
    /// Seeds.
    pub seeds: Vec<u64>,
    /// Values of `dgtr train --init`.
    pub inits: Vec<String>,
    /// Seconds the structure-from-motion took, by data set; added to every `sfm` point.
    pub sfm_seconds: Vec<f64>,
    /// Further arguments of `dgtr train`.
    pub train: Vec<String>,
    /// Folder of the children.
    pub out: PathBuf,
    /// Whether points that are already in `out` are measured anew.
    pub again: bool,
}

/// One child's figures.
#[derive(Clone, Debug, Serialize)]
pub struct Point {
    /// Name of the data set.
    pub dataset: String,
    /// Where the first Gaussians came from.
    pub init: String,
    /// Device memory, MiB.
    pub budget_mib: u32,
    /// Seconds of training asked for.
    pub asked_s: f64,
    /// Seed.
    pub seed: u64,
    /// Seconds from the first picture to the model: structure-from-motion, reading, initialisation, training.
    pub total_s: f64,
    /// Seconds of initialisation, structure-from-motion included.
    pub init_s: f64,
    /// Seconds of training, checkpoints included.
    pub train_s: f64,
    /// Optimiser steps.
    pub steps: u64,
    /// Gaussians.
    pub gaussians: u64,
    /// Held-out PSNR, dB.
    pub psnr: f64,
    /// Held-out SSIM.
    pub ssim: f64,
    /// Held-out perceptual distance, when a network was configured.
    pub perceptual: Option<f64>,
}

/// Measures every combination, `each` after every point.
///
/// # Errors
/// No device, a child that fails, or stopped on request; the points so far lie in `out` and are not measured again.
pub fn measure(request: &Request, each: &mut dyn FnMut(&Point)) -> Result<Vec<Point>, JobError> {
    let mut points = Vec::new();
    for (i, dataset) in request.datasets.iter().enumerate() {
        let sfm = *request.sfm_seconds.get(i).or(request.sfm_seconds.last()).unwrap_or(&0.0);
        for init in &request.inits {
            for &budget_mib in &request.budgets_mib {
                for &asked_s in &request.seconds {
                    for &seed in &request.seeds {
                        let offset = if init == "sfm" { sfm } else { 0.0 };
                        let point = one(request, dataset, init, budget_mib, asked_s, seed, offset)?;
                        each(&point);
                        points.push(point);
                    }
                }
            }
        }
    }
    Ok(points)
}

fn one(
    request: &Request,
    dataset: &Path,
    init: &str,
    budget_mib: u32,
    asked_s: f64,
    seed: u64,
    offset: f64,
) -> Result<Point, JobError> {
    let name = dataset.file_name().map_or_else(|| "data".into(), |n| n.to_string_lossy().into_owned());
    let out = request.out.join(format!("{name}-{init}-{budget_mib}mib-{asked_s}s-seed{seed}"));
    let kept = if request.again { None } else { RunReport::read(&out).ok().filter(|r| r.outcome == "done") };
    let report = match kept {
        Some(report) => report,
        None => {
            let mut arguments = vec!["train".to_owned(), dataset.display().to_string()];
            for (flag, value) in [
                ("--init", init.to_owned()),
                ("--budget-mib", budget_mib.to_string()),
                ("--seconds", asked_s.to_string()),
                ("--seed", seed.to_string()),
            ] {
                arguments.extend([flag.to_owned(), value]);
            }
            arguments.push("--fresh".to_owned());
            arguments.extend(request.train.iter().cloned());
            child::run(&arguments, &out, None)?.report(&out.display().to_string())?
        }
    };
    let stage = |stage: &str| report.stage_ms.get(stage).copied().unwrap_or(0.0) * 1e-3;
    let (Some(psnr), Some(ssim)) = (report.psnr, report.ssim) else {
        return Err(JobError::Request(format!("{name}: has no held-out pictures (split `test`)")));
    };
    Ok(Point {
        dataset: name,
        init: init.to_owned(),
        budget_mib,
        asked_s,
        seed,
        total_s: report.wall_s - stage("evaluate") + offset,
        init_s: stage("init") + stage("refine") + offset,
        train_s: stage("train"),
        steps: report.steps,
        gaussians: report.gaussians,
        psnr,
        ssim,
        perceptual: perceptual(&report),
    })
}

/// A number, or an object that holds it as `mean`.
fn perceptual(report: &RunReport) -> Option<f64> {
    let value = report.more.get("perceptual")?;
    value.as_f64().or_else(|| value.get("mean")?.as_f64())
}

/// Means over the seeds, in the order of the points, with the front marked.
pub fn groups(points: &[Point]) -> Vec<Group> {
    let mut groups: Vec<Group> = Vec::new();
    let same = |p: &Point, g: &Group| {
        p.dataset == g.dataset && p.init == g.init && p.budget_mib == g.budget_mib && p.asked_s == g.asked_s
    };
    for first in points {
        if groups.iter().any(|g| same(first, g)) {
            continue;
        }
        let mut group = Group {
            dataset: first.dataset.clone(),
            init: first.init.clone(),
            budget_mib: first.budget_mib,
            asked_s: first.asked_s,
            runs: 0,
            total_s: 0.0,
            psnr: 0.0,
            psnr_range: [f64::INFINITY, f64::NEG_INFINITY],
            ssim: 0.0,
            perceptual: None,
            gaussians: 0.0,
            on_front: false,
        };
        let members: Vec<&Point> = points.iter().filter(|p| same(p, &group)).collect();
        let mean = |f: fn(&Point) -> f64| members.iter().map(|p| f(p)).sum::<f64>() / members.len() as f64;
        group.runs = members.len();
        (group.total_s, group.psnr, group.ssim) = (mean(|p| p.total_s), mean(|p| p.psnr), mean(|p| p.ssim));
        group.gaussians = mean(|p| p.gaussians as f64);
        let distances: Vec<f64> = members.iter().filter_map(|p| p.perceptual).collect();
        group.perceptual = (!distances.is_empty()).then(|| distances.iter().sum::<f64>() / distances.len() as f64);
        for p in members {
            group.psnr_range = [group.psnr_range[0].min(p.psnr), group.psnr_range[1].max(p.psnr)];
        }
        groups.push(group);
    }
    mark_front(&mut groups);
    groups
}

/// `feed-forward` against `sfm` at equal PSNR, by data set and budget.
pub fn speedups(groups: &[Group]) -> Vec<(String, u32, Speedup)> {
    let mut places: Vec<(&str, u32)> = groups.iter().map(|g| (g.dataset.as_str(), g.budget_mib)).collect();
    places.dedup();
    places.sort_unstable();
    places.dedup();
    let curve = |place: &(&str, u32), init: &str| -> Vec<(f64, f64)> {
        let of = |g: &&Group| (g.dataset.as_str(), g.budget_mib) == *place && g.init == init;
        groups.iter().filter(of).map(|g| (g.total_s, g.psnr)).collect()
    };
    let compared = |p: &(&str, u32)| Some((p.0.to_owned(), p.1, speedup(&curve(p, "feed-forward"), &curve(p, "sfm"))?));
    places.iter().filter_map(compared).collect()
}

/// One row per group.
pub fn table(groups: &[Group]) -> Table {
    let row = |g: &Group| {
        vec![
            format!("{} {}", g.dataset, g.init),
            g.budget_mib.to_string(),
            short(g.asked_s),
            short(g.total_s),
            format!("{:.2}", g.psnr),
            format!("{:.2}…{:.2}", g.psnr_range[0], g.psnr_range[1]),
            format!("{:.3}", g.ssim),
            g.perceptual.map_or("–".into(), |v| format!("{v:.4}")),
            count(g.gaussians as u64),
            g.runs.to_string(),
            if g.on_front { "yes".into() } else { String::new() },
        ]
    };
    let head = [
        "data set, start",
        "MiB",
        "trained s",
        "total s",
        "PSNR, dB",
        "over seeds",
        "SSIM",
        "perceptual",
        "Gaussians",
        "seeds",
        "on the front",
    ];
    Table {
        title: "Run time against error".into(),
        note: "Total: from the first picture to the model, initialisation included; means over seeds.".into(),
        head: head.map(String::from).to_vec(),
        rows: groups.iter().map(row).collect(),
    }
}

/// Every point, unrounded.
pub fn points_table(points: &[Point]) -> Table {
    let row = |p: &Point| {
        let mut cells = vec![p.dataset.clone(), p.init.clone()];
        let numbers = [p.asked_s, p.total_s, p.init_s, p.train_s, p.psnr, p.ssim];
        cells.extend([p.budget_mib.to_string(), p.seed.to_string(), p.steps.to_string(), p.gaussians.to_string()]);
        cells.extend(numbers.map(|v| v.to_string()));
        cells.push(p.perceptual.map_or(String::new(), |v| v.to_string()));
        cells
    };
    let head = [
        "dataset",
        "init",
        "budget_mib",
        "seed",
        "steps",
        "gaussians",
        "asked_s",
        "total_s",
        "init_s",
        "train_s",
        "psnr",
        "ssim",
        "perceptual",
    ];
    Table { head: head.map(String::from).to_vec(), rows: points.iter().map(row).collect(), ..Table::default() }
}

/// The picture of one data set: a curve per start and budget with the seeds' spread, and the front.
pub fn chart(dataset: &str, groups: &[Group]) -> Chart {
    let of_set = || groups.iter().filter(|g| g.dataset == dataset);
    let point = |g: &Group| ChartPoint { x: g.total_s, y: g.psnr, low: g.psnr_range[0], high: g.psnr_range[1] };
    let mut names: Vec<(&str, u32)> = of_set().map(|g| (g.init.as_str(), g.budget_mib)).collect();
    names.sort_unstable();
    names.dedup();
    let sorted = |mut points: Vec<ChartPoint>| {
        points.sort_by(|a, b| a.x.total_cmp(&b.x));
        points
    };
    let mut series: Vec<Series> = names
        .iter()
        .map(|(init, mib)| Series {
            name: format!("{init}, {mib} MiB"),
            points: sorted(of_set().filter(|g| (g.init.as_str(), g.budget_mib) == (*init, *mib)).map(point).collect()),
            dashed: false,
        })
        .collect();
    let front = sorted(of_set().filter(|g| g.on_front).map(point).collect());
    series.push(Series { name: "Pareto front".into(), points: front, dashed: true });
    Chart {
        title: format!("{dataset}: held-out PSNR against seconds from the first picture"),
        x_label: "seconds, initialisation included".into(),
        y_label: "PSNR, dB".into(),
        series,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn point(init: &str, seed: u64, total_s: f64, psnr: f64) -> Point {
        Point {
            dataset: "d".into(),
            init: init.into(),
            budget_mib: 64,
            asked_s: total_s.floor(),
            seed,
            total_s,
            init_s: 1.0,
            train_s: 1.0,
            steps: 10,
            gaussians: 100,
            psnr,
            ssim: 0.5,
            perceptual: None,
        }
    }

    #[test]
    fn seeds_make_one_group_with_their_spread_and_starts_are_compared_at_equal_quality() {
        let points = [
            point("sfm", 1, 40.2, 20.0),
            point("sfm", 2, 40.4, 22.0),
            point("sfm", 1, 80.0, 25.0),
            point("feed-forward", 1, 20.0, 21.0),
        ];
        let groups = groups(&points);
        assert_eq!(groups.len(), 3);
        assert_eq!((groups[0].runs, groups[0].psnr, groups[0].psnr_range), (2, 21.0, [20.0, 22.0]));
        assert_eq!(groups.iter().map(|g| g.on_front).collect::<Vec<_>>(), [false, true, true]);
        let all = speedups(&groups);
        assert_eq!(all.len(), 1);
        assert!((all[0].2.ratio() - 40.3 / 20.0).abs() < 1e-9, "{all:?}");
        assert_eq!(chart("d", &groups).series.len(), 3);
    }

    #[test]
    fn a_perceptual_figure_is_read_as_a_number_or_as_a_mean() {
        let mut report = RunReport::default();
        assert_eq!(perceptual(&report), None);
        report.more.insert("perceptual".into(), 0.25.into());
        assert_eq!(perceptual(&report), Some(0.25));
        report.more.insert("perceptual".into(), serde_json::json!({ "name": "m", "mean": 0.5 }));
        assert_eq!(perceptual(&report), Some(0.5));
    }
}
