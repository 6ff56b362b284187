//! What few pictures cost: every so many of a data set's training pictures, trained alike, scored on the same held-out pictures.

use std::path::{Path, PathBuf};

use ::survey::dataset::Dataset;
use job::run_json::RunReport;
use pages::report::Table;
use serde::Serialize;

use super::child;
use super::methods::data;
use super::methods::territory::divide;
use runtime::error::JobError;

/// What to measure.
#[derive(Clone, Debug)]
pub struct Request {
    /// Data sets.
    pub datasets: Vec<PathBuf>,
    /// Of how many pictures one is kept.
    pub every: Vec<usize>,
    /// Seeds.
    pub seeds: Vec<u64>,
    /// Values of `dgtr train --init`.
    pub inits: Vec<String>,
    /// The list of training pictures that is thinned.
    pub split: String,
    /// Further arguments of `dgtr train`.
    pub train: Vec<String>,
    /// Folder of the thinned sets and of the trainings.
    pub out: PathBuf,
    /// Whether what is in `out` already is done again.
    pub again: bool,
}

/// One training's figures.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Point {
    /// Name of the data set.
    pub dataset: String,
    /// Of how many pictures one was kept.
    pub every: usize,
    /// Training pictures.
    pub pictures: usize,
    /// Where the first Gaussians came from.
    pub init: String,
    /// Seed.
    pub seed: u64,
    /// Optimiser steps.
    pub steps: u64,
    /// Gaussians.
    pub gaussians: u64,
    /// Held-out PSNR, dB.
    pub psnr: f64,
    /// Held-out SSIM.
    pub ssim: f64,
}

/// Measures every combination, `each` after every training.
///
/// # Errors
/// A data set without training or held-out pictures, a training that fails, or stopped on request; what was finished lies in `out` and is
/// not done again.
pub fn measure(request: &Request, each: &mut dyn FnMut(&Point)) -> Result<Vec<Point>, JobError> {
    let mut points = Vec::new();
    for dataset in &request.datasets {
        let set = Dataset::open(dataset)?;
        let name = set.root.file_name().map_or_else(|| "data".into(), |n| n.to_string_lossy().into_owned());
        for &every in &request.every {
            let root = request.out.join(format!("{name}-{every}"));
            let (pictures, content) = thinned(&set, &request.split, every, &root.join("data"))?;
            for init in &request.inits {
                for &seed in &request.seeds {
                    let report = trained(request, &root, &content, init, seed)?;
                    let (Some(psnr), Some(ssim)) = (report.psnr, report.ssim) else {
                        return Err(JobError::Request(format!("{}: was not evaluated", root.display())));
                    };
                    let (init, steps, gaussians) = (init.clone(), report.steps, report.gaussians);
                    let point =
                        Point { dataset: name.clone(), every, pictures, init, seed, steps, gaussians, psnr, ssim };
                    each(&point);
                    points.push(point);
                }
            }
        }
    }
    Ok(points)
}

/// Writes the data set with one of every so many training pictures; how many those are, and the BLAKE3 of what was written.
///
/// # Errors
/// The data set has no such list or no held-out pictures, or fewer than two pictures stay; the folder cannot be written to.
pub fn thinned(set: &Dataset, split: &str, every: usize, root: &Path) -> Result<(usize, String), JobError> {
    let mut territories = divide(set, split, Some(1), 1)?;
    let Some(all) = territories.first_mut() else { return Ok((0, String::new())) };
    all.own = all.own.iter().copied().step_by(every.max(1)).collect();
    let pictures = all.own.len();
    if pictures < 2 {
        let what = format!(
            "{}: one of {every} leaves {pictures} training pictures of the two that are needed",
            set.root.display()
        );
        return Err(JobError::Request(what));
    }
    let seen = [all.own.clone()];
    let written = data::write(root, set, &territories, &seen, &set.sparse_points()?)?;
    Ok((pictures, written.content))
}

/// The finished training in a folder named by all that decides it, now or from before.
fn trained(request: &Request, root: &Path, content: &str, init: &str, seed: u64) -> Result<RunReport, JobError> {
    let mut arguments = vec!["train".to_owned(), root.join("data").display().to_string()];
    for (flag, value) in [("--split", data::OWN), ("--init", init), ("--seed", &seed.to_string())] {
        arguments.extend([flag.to_owned(), value.to_owned()]);
    }
    arguments.extend(request.train.iter().cloned());
    let key = blake3::hash(serde_json::json!([arguments, content]).to_string().as_bytes()).to_hex();
    let out = root.join(format!("{init}-seed{seed}-{}", &key[..12]));
    let kept = if request.again { None } else { RunReport::read(&out).ok().filter(|r| r.outcome == "done") };
    match kept {
        Some(report) => Ok(report),
        None => {
            arguments.push("--fresh".to_owned());
            child::run(&arguments, &out, None)?.report(&out.display().to_string())
        }
    }
}

/// Means over the seeds and how far these are apart, a row for each number of pictures and each start.
pub fn table(points: &[Point]) -> Table {
    let head = ["data set", "pictures", "of", "start", "runs", "PSNR, dB", "least", "most", "SSIM"];
    let mut rows: Vec<Vec<String>> = Vec::new();
    let mut done: Vec<(&str, usize, &str)> = Vec::new();
    for first in points {
        let key = (first.dataset.as_str(), first.every, first.init.as_str());
        if done.contains(&key) {
            continue;
        }
        done.push(key);
        let same = || points.iter().filter(|p| (p.dataset.as_str(), p.every, p.init.as_str()) == key);
        let runs = same().count();
        let mean = |of: fn(&Point) -> f64| same().map(of).sum::<f64>() / runs as f64;
        let least = same().map(|p| p.psnr).fold(f64::INFINITY, f64::min);
        let most = same().map(|p| p.psnr).fold(f64::NEG_INFINITY, f64::max);
        let [psnr, least, most] = [mean(|p| p.psnr), least, most].map(|v| format!("{v:.2}"));
        let of = match first.every {
            1 => "all".to_owned(),
            every => format!("1/{every}"),
        };
        let words = [first.dataset.clone(), first.pictures.to_string(), of, first.init.clone(), runs.to_string()];
        rows.push([words.to_vec(), vec![psnr, least, most, format!("{:.3}", mean(|p| p.ssim))]].concat());
    }
    Table {
        title: "Few pictures".into(),
        note: "Held-out pictures are the same in every row of a data set.".into(),
        head: head.map(String::from).to_vec(),
        rows,
    }
}

#[cfg(test)]
mod tests {
    use runtime::device_report::survey::write_data_set;

    use super::*;

    #[test]
    fn a_thinned_set_keeps_every_so_many_training_pictures_and_all_held_out_ones() {
        let dir = tempfile::tempdir().expect("temp dir");
        let world = dir.path().join("world");
        write_data_set(&world, 3, 0.1).expect("written");
        let set = Dataset::open(&world).expect("a data set");
        let (training, held_out) = (set.select("train", None).expect("train"), set.select("test", None).expect("test"));
        let mut contents = Vec::new();
        for every in [1, 3] {
            let root = dir.path().join(format!("{every}"));
            let (pictures, content) = thinned(&set, "train", every, &root).expect("written");
            let back = Dataset::open(&root).expect("a data set");
            let own: Vec<usize> = training.iter().copied().filter(|i| !held_out.contains(i)).step_by(every).collect();
            assert_eq!((back.select("train", None).expect("train"), pictures), (own.clone(), own.len()));
            assert_eq!(back.select("test", None).expect("test"), held_out);
            contents.push(content);
        }
        assert_ne!(contents[0], contents[1], "another list is another training");
        let few = thinned(&set, "train", 1000, &dir.path().join("few")).expect_err("too few").to_string();
        assert!(few.contains("one of 1000 leaves 1 training pictures"), "{few}");
    }

    #[test]
    fn seeds_become_a_mean_with_its_least_and_most_and_starts_stay_apart() {
        let point = |every: usize, init: &str, seed: u64, psnr: f64| Point {
            dataset: "d".into(),
            every,
            pictures: 12 / every,
            init: init.into(),
            seed,
            steps: 10,
            gaussians: 100,
            psnr,
            ssim: psnr / 100.0,
        };
        let points =
            [point(1, "sfm", 1, 24.0), point(3, "sfm", 1, 20.0), point(3, "sfm", 2, 21.0), point(3, "x", 1, 9.0)];
        let rows = table(&points).rows;
        assert_eq!(rows.len(), 3);
        assert_eq!(rows[0], ["d", "12", "all", "sfm", "1", "24.00", "24.00", "24.00", "0.240"]);
        assert_eq!(rows[1], ["d", "4", "1/3", "sfm", "2", "20.50", "20.00", "21.00", "0.205"]);
        assert_eq!(rows[2][3..6], ["x", "1", "9.00"]);
    }
}
