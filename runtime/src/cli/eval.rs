//! `dgtr eval MODEL DATASET --split test`: PSNR and SSIM on pictures the model has not seen. `dgtr eval MODEL --heights
//! REFERENCE`: its heights against points.

use std::path::{Path, PathBuf};

use engine::device::{file_renderer, map_renderer};
use engine::evaluate::{BaselineScores, IntoModel, Scores, baselines, evaluate, heights, open_metric};
use engine::ortho::{Map, MapRequest};
use engine::tiles;
use models::formats::model::{Chunks, ModelHeader};
use serde::Serialize;
use survey::card::CardOptions;
use survey::dataset::{Dataset, picture_names};

use super::CliError;
use super::plan::largest;
use crate::cli::output::outln;
use crate::train_job::take_settled;

/// Arguments of `dgtr eval`.
#[derive(Debug, clap::Args)]
pub struct Args {
    /// The .dgtr model.
    pub model: PathBuf,
    /// Folder of posed pictures.
    #[arg(required_unless_present = "heights")]
    pub dataset: Option<PathBuf>,
    /// Instead: heights of the model's map (`dgtr ortho`) against a gcp_list.txt, a table of points (columns lat, lon, alt or
    /// x, y, z), a raster of heights (GeoTIFF in a projected reference system), or the triangulated points of a data set's folder.
    #[arg(long, value_name = "REFERENCE", conflicts_with = "dataset")]
    pub heights: Option<PathBuf>,
    /// Which pictures (a list of split.json; without that file every 8th is `test`; `all` always works).
    #[arg(long, default_value = "test")]
    pub split: String,
    /// Only the pictures of this region.
    #[arg(long)]
    pub region: Option<String>,
    /// Of a card with several bands or lenses the one of this name, as it was trained.
    #[arg(long, value_name = "NAME")]
    pub band: Option<String>,
    /// Image scale, above 0 and at most 1.
    #[arg(long, default_value_t = 1.0)]
    pub scale: f64,
    /// One JSON object on standard output.
    #[arg(long)]
    pub json: bool,
    /// Save each rendering below DIR as a PNG of the picture's name, in folders where the pictures lie in several.
    #[arg(long, value_name = "DIR")]
    pub save: Option<PathBuf>,
    /// Also score the two naive guesses: nearest training picture over flat ground, mean colour.
    #[arg(long)]
    pub baselines: bool,
    /// Also measure a perceptual distance: manifest of a network of contract `metric`.
    #[arg(long, value_name = "MANIFEST")]
    pub metric: Option<PathBuf>,
    /// Device whose name contains this: processor, or a Vulkan device.
    #[arg(long)]
    pub device: Option<String>,
}

#[derive(Serialize)]
struct Answer<'a> {
    #[serde(flatten)]
    scores: &'a Scores,
    gaussians: usize,
    steps: u64,
    split: &'a str,
    region: Option<&'a str>,
    /// Held-out poses were carried into the model's own frame (it was trained with other poses).
    poses_transferred: bool,
    #[serde(skip_serializing_if = "Option::is_none")]
    baselines: Option<&'a BaselineScores>,
}

/// Runs `dgtr eval`.
///
/// # Errors
/// Whatever ends the command; its kind is the exit code.
pub fn run(args: Args) -> Result<(), CliError> {
    if let Some(reference) = &args.heights {
        return compare_heights(&args, reference);
    }
    let dataset = args.dataset.clone().unwrap_or_default();
    let mut set = match args.band.clone() {
        None => Dataset::open(&dataset)?,
        band => Dataset::open_card(std::slice::from_ref(&dataset), &CardOptions { band, ..CardOptions::default() })?,
    };
    take_settled(&mut set, &args.model)?;
    let frames = set.select(&args.split, args.region.as_deref())?;
    if frames.is_empty() {
        return Err(CliError::input(format!("{}: split {:?} holds no pictures", dataset.display(), args.split)));
    }
    let (width, height) = largest(&set, &frames, args.scale)?;
    let mut metric = open_metric(args.metric.as_deref(), (width, height))?;
    let (header, mut trainer) = file_renderer(args.device.as_deref(), &args.model, tiles::size((width, height)))?;
    let into = IntoModel::of(&set, &header);
    let scores = evaluate(&mut trainer, &set, &frames, args.scale, &into, metric.as_mut(), args.save.as_deref())?;
    let naive = match args.baselines {
        true => Some(baselines(&set, &training_frames(&set, &header, &frames)?, &frames, args.scale)?),
        false => None,
    };
    if args.json {
        let answer = Answer {
            scores: &scores,
            gaussians: trainer.gaussians(),
            steps: header.steps,
            split: &args.split,
            region: args.region.as_deref(),
            poses_transferred: !into.transfer.is_identity(),
            baselines: naive.as_ref(),
        };
        outln!("{}", serde_json::to_string(&answer).map_err(CliError::failed)?);
        return Ok(());
    }
    for v in &scores.views {
        let distance = match (&metric, v.perceptual) {
            (Some(m), Some(d)) => format!("  {} {d:.4}", m.name()),
            _ => String::new(),
        };
        outln!("{:<28} {}{distance}", disk::escaped(&v.name), figures(v.psnr, v.psnr_colors_fitted, v.ssim));
    }
    let row = |what: &str, s: &Scores| outln!("{what:<28} {}", figures(s.psnr, s.psnr_colors_fitted, s.ssim));
    row(&format!("mean of {} views", scores.views.len()), &scores);
    if let Some(p) = &scores.perceptual {
        outln!("{:<28} {:>7.4}", format!("mean {}", p.name), p.mean);
    }
    if let Some(naive) = &naive {
        row("ground-plane warp", &naive.ground_warp);
        row("mean colour", &naive.mean_color);
    }
    outln!("{} Gaussians after {} steps", trainer.gaussians(), header.steps);
    Ok(())
}

fn figures(psnr: f64, fitted: f64, ssim: f64) -> String {
    format!("{psnr:>7.3} dB ({fitted:.3} with colours fitted)  SSIM {ssim:.4}")
}

fn compare_heights(args: &Args, reference: &Path) -> Result<(), CliError> {
    let model = Chunks::open(&args.model)?;
    let map = Map::of_file(&model, &MapRequest::default())?;
    let points = heights::reference(reference, &model.header, &map)?;
    let mut trainer = map_renderer(args.device.as_deref(), &model)?;
    let scores = heights::compare(&map, &mut trainer, &points)?;
    if args.json {
        outln!("{}", serde_json::to_string(&scores).map_err(CliError::failed)?);
        return Ok(());
    }
    outln!("{} points ({} beside the map or where it has no height)", scores.points, scores.missing);
    outln!(
        "bias {:+.3} m  RMSE {:.3} m  median {:.3} m  LE90 {:.3} m",
        scores.bias_m,
        scores.rmse_m,
        scores.median_abs_m,
        scores.le90_m
    );
    if let Some(sigmas) = &scores.sigmas {
        outln!(
            "the map's standard deviations: median {:.3} m, {:.1} % of the errors within one, {:.1} % within two",
            sigmas.median_m,
            100.0 * sigmas.within_one,
            100.0 * sigmas.within_two
        );
    }
    Ok(())
}

/// What a naive guess may use: the pictures the model was trained on, where this data set has them, else the split
/// `train`; never an evaluated one.
fn training_frames(set: &Dataset, header: &ModelHeader, held_out: &[usize]) -> Result<Vec<usize>, CliError> {
    let used = picture_names(set).pair(header.views.iter().map(|(name, _)| name.as_str()));
    let mut frames: Vec<usize> = used.into_iter().flatten().collect();
    frames.sort_unstable();
    if frames.is_empty() {
        frames = set.select("train", None)?;
    }
    frames.retain(|i| !held_out.contains(i));
    Ok(frames)
}
