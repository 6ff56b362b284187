//! What the demo came to: a table on the terminal, and an HTML report with pictures.

use std::fmt;
use std::path::{Path, PathBuf};
use std::time::Instant;

use job::run_json::RunReport;
use models::formats::model;
use pages::report::ground::{Ortho, Shot};
use pages::report::{Comparison, MapRegion, ModelRow, REPORT, ReportData, Table, Timing, bytes};

use super::evaluate::Figures;
use super::processes::Process;
use super::{AIRCRAFT, DemoError, DemoOptions};

/// Views shown per aircraft.
const SHOWN: usize = 2;

/// The demo's figures, printable.
#[derive(Clone, Debug)]
pub struct Summary {
    rows: Vec<Row>,
    files: Vec<(String, PathBuf)>,
    seconds: f64,
    limit_mib: u64,
    peak_bytes: u64,
}

#[derive(Clone, Debug)]
struct Row {
    name: String,
    views: u64,
    gaussians: u64,
    steps: u64,
    local: [f64; 2],
    global: [f64; 2],
    warp: [f64; 2],
    mean: [f64; 2],
    uploaded: u64,
    pictures: u64,
}

impl fmt::Display for Summary {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        writeln!(f, "aircraft  views  gaussians  steps   held-out PSNR / SSIM of")?;
        writeln!(f, "                                    own model      global model   ground warp    mean colour")?;
        for r in &self.rows {
            let pair = |[psnr, ssim]: [f64; 2]| format!("{psnr:5.2} / {ssim:.3}");
            writeln!(
                f,
                "{:<9} {:>5}  {:>9}  {:>5}   {:<14} {:<14} {:<14} {}",
                r.name,
                r.views,
                r.gaussians,
                r.steps,
                pair(r.local),
                pair(r.global),
                pair(r.warp),
                pair(r.mean)
            )?;
        }
        for r in &self.rows {
            writeln!(f, "{}: {} uploaded instead of {} of pictures", r.name, bytes(r.uploaded), bytes(r.pictures))?;
        }
        writeln!(
            f,
            "{:.0} s in all; each process under {} MiB of data, largest resident {}",
            self.seconds,
            self.limit_mib,
            bytes(self.peak_bytes)
        )?;
        for (what, path) in &self.files {
            writeln!(f, "{what:<14} {}", path.display())?;
        }
        Ok(())
    }
}

/// Gathers the figures and writes `out/report.html`.
///
/// # Errors
/// The folder cannot be written to.
pub fn write(
    out: &Path,
    options: &DemoOptions,
    figures: &[Figures],
    processes: &[Process],
    flown_s: f64,
    started: Instant,
) -> Result<Summary, DemoError> {
    let report = |e: &dyn fmt::Display| DemoError::Report(e.to_string());
    let mut rows = Vec::new();
    let mut data = ReportData {
        title: "dgtr demo".into(),
        subtitle: format!("two simulated aircraft over a ray-cast town, seed {}", options.seed),
        ..ReportData::default()
    };
    let mut peak_bytes = 0;
    for figure in figures {
        let folder = out.join(figure.name);
        let run = RunReport::read(&folder.join("out")).map_err(|e| report(&e))?;
        peak_bytes = peak_bytes.max(run.memory.host_rss_peak);
        let model = folder.join("out/model.dgtr");
        let naive = figure.local.baselines.as_ref();
        let uploaded = run.more.get("bytes_sent").and_then(|n| n.as_u64()).unwrap_or(0);
        let row = Row {
            name: figure.name.into(),
            views: run.views,
            gaussians: figure.local.gaussians,
            steps: figure.local.steps,
            local: [figure.local.psnr, figure.local.ssim],
            global: [figure.global.psnr, figure.global.ssim],
            warp: naive.map_or([f64::NAN; 2], |n| [n.ground_warp.psnr, n.ground_warp.ssim]),
            mean: naive.map_or([f64::NAN; 2], |n| [n.mean_color.psnr, n.mean_color.ssim]),
            uploaded,
            pictures: folder_bytes(&folder.join("camera")),
        };
        data.models.push(ModelRow {
            name: row.name.clone(),
            views: Some(row.views),
            gaussians: Some(row.gaussians),
            steps: Some(row.steps),
            seconds: run.stage_ms.get("train").map(|ms| ms * 1e-3),
            psnr: Some(row.local[0]),
            ssim: Some(row.local[1]),
            uploaded: Some(row.uploaded),
            pictures: Some(row.pictures),
        });
        for (name, ms) in &run.stage_ms {
            let stage = Timing { name: name.clone(), of: row.name.clone(), seconds: ms * 1e-3 };
            if ["refine", "init", "train"].contains(&name.as_str()) {
                data.timings.push(stage);
            }
        }
        for (what, count) in &run.skipped {
            data.skipped.push((format!("{}: {}", row.name, what.replace('_', " ")), *count));
        }
        let (header, _) = model::read_header(&model).map_err(|e| report(&e))?;
        let of = data.map.len();
        header.views.iter().for_each(|(_, view)| data.ground.add(Shot::of(of, view, 0.0)));
        let cameras = header.views.iter().map(|(_, v)| [v.pose.center.x, v.pose.center.y]).collect();
        data.map.push(MapRegion { name: figure.name.into(), corners: header.region, cameras });
        data.comparisons.extend(comparisons(figure));
        rows.push(row);
    }
    let ground = RunReport::read(&out.join("ground/out")).map_err(|e| report(&e))?;
    peak_bytes = peak_bytes.max(ground.memory.host_rss_peak);
    let mean = |pick: fn(&Row) -> f64| rows.iter().map(pick).sum::<f64>() / rows.len().max(1) as f64;
    data.models.push(ModelRow {
        name: "global".into(),
        gaussians: figures.first().map(|f| f.global.gaussians),
        psnr: Some(mean(|r| r.global[0])),
        ssim: Some(mean(|r| r.global[1])),
        ..ModelRow::default()
    });
    data.timings.push(Timing { name: "flight, training and merging".into(), of: String::new(), seconds: flown_s });
    for p in processes {
        let seconds = p.seconds.unwrap_or(0.0);
        data.timings.push(Timing { name: format!("process {}", p.name), of: String::new(), seconds });
    }
    data.tables.push(Table {
        title: "Against naive guesses".into(),
        note: "Held-out PSNR in dB; the views were never flown.".into(),
        head: ["aircraft", "own model", "global model", "ground warp", "mean colour"].map(String::from).to_vec(),
        rows: rows
            .iter()
            .map(|r| {
                let db = |v: f64| format!("{v:.2}");
                vec![r.name.clone(), db(r.local[0]), db(r.global[0]), db(r.warp[0]), db(r.mean[0])]
            })
            .collect(),
    });
    let drawn = model::read_header(&out.join("ground/out/global.dgtr")).map_err(|e| report(&e))?;
    data.ground.ortho = Ortho::read(&out.join("ground/out/map"), drawn.0.origin, None);
    data.headline = vec![
        ("global model, held out".into(), format!("{:.2} dB", mean(|r| r.global[0]))),
        ("aircraft".into(), AIRCRAFT.len().to_string()),
        ("from take-off to global model".into(), format!("{flown_s:.0} s")),
        ("largest process".into(), bytes(peak_bytes)),
    ];
    let html = out.join(REPORT);
    let mut files: Vec<(String, PathBuf)> = vec![("report".into(), html.clone())];
    files.push(("global model".into(), out.join("ground/out/global.dgtr")));
    files.extend(AIRCRAFT.map(|a| (format!("{a}'s model"), out.join(a).join("out/model.dgtr"))));
    files.push(("mission file".into(), out.join("mission.toml")));
    data.files = files.clone();
    data.write(&html).map_err(|e| report(&e))?;
    let (seconds, limit_mib) = (started.elapsed().as_secs_f64(), options.limit_mib);
    Ok(Summary { rows, files, seconds, limit_mib, peak_bytes })
}

/// Truth, own model and global model, for the best and the worst view.
fn comparisons(figure: &Figures) -> Vec<Comparison> {
    let mut views: Vec<_> = figure.local.views.iter().collect();
    views.sort_by(|a, b| b.psnr.total_cmp(&a.psnr));
    let worst = views.len().saturating_sub(1);
    let shown: Vec<usize> = if worst == 0 { vec![0] } else { vec![0, worst] };
    let open = |path: PathBuf| image::open(path).ok().map(image::DynamicImage::into_rgb8);
    let mut out = Vec::with_capacity(SHOWN);
    for (view, word) in shown.iter().filter_map(|i| views.get(*i)).zip(["best", "worst"]) {
        let png = Path::new(&view.name).with_extension("png");
        let pictures = [
            ("ray-cast truth", open(figure.truth.join("images").join(&view.name))),
            ("own model", open(figure.renderings[0].join(&png))),
            ("global model", open(figure.renderings[1].join(&png))),
        ];
        let panels: Vec<_> = pictures.into_iter().filter_map(|(l, p)| Some((l.to_owned(), p?))).collect();
        if !panels.is_empty() {
            let title = format!("{}: {} held-out view", figure.name, word);
            out.push(Comparison { title, note: format!("{:.2} dB", view.psnr), panels });
        }
    }
    out
}

fn folder_bytes(folder: &Path) -> u64 {
    std::fs::read_dir(folder).into_iter().flatten().flatten().filter_map(|e| e.metadata().ok()).map(|m| m.len()).sum()
}
