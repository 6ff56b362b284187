//! What training starts from: refined poses, first Gaussians, depth priors.

use std::collections::HashMap;
use std::time::Instant;

use models::camera::{DepthPrior, Pose, View};
use models::cloud::GaussianCloud;
use models::dataset::{Dataset, PoseSource};
use models::init::{Initialiser, from_sfm, random};
use models::refine::Refiner;

use super::resume::Resumed;
use super::{InitKind, TrainJob};
use crate::cli::CliError;
use crate::console::Progress;
use crate::interrupt::Interrupt;
use crate::run_json::RunReport;

/// Points of a random start (3DGS: 100,000).
const RANDOM_POINTS: usize = 100_000;

/// Depths made between two looks at whether somebody asked to stop.
const DEPTHS_BETWEEN_STOPS: usize = 16;

/// Gaussians and depth priors.
pub(super) struct Start {
    pub cloud: GaussianCloud,
    pub priors: HashMap<String, DepthPrior>,
    /// Name of the network that the priors come from; empty when there are none.
    pub priors_by: String,
}

/// Where the pictures were taken from.
#[derive(Default)]
pub(super) struct Posed {
    /// The pose to train each picture with, by name.
    pub poses: HashMap<String, Pose>,
    /// Positions and colours of the points that the pose refinement triangulated.
    pub points: Vec<([f32; 3], [u8; 3])>,
}

/// Poses of the training pictures; `None` when asked to stop.
pub(super) fn refined_poses(
    job: &TrainJob,
    set: &Dataset,
    frames: &[usize],
    stop: &Interrupt,
    report: &mut RunReport,
) -> Result<Option<Posed>, CliError> {
    let mut poses = HashMap::with_capacity(frames.len());
    if job.poses == PoseSource::Dataset {
        poses.extend(frames.iter().map(|&i| (set.frames[i].name.clone(), set.frames[i].view.pose)));
        return Ok(Some(Posed { poses, ..Default::default() }));
    }
    let from = Instant::now();
    let mut refiner = match job.refine {
        true => Some(Refiner::open(&job.refine_settings)?),
        false => None,
    };
    let mut progress = Progress::new("poses", frames.len() as u64);
    for (done, &i) in frames.iter().enumerate() {
        if stop.requested() {
            return Ok(None);
        }
        let picture = set.load_posed(i, 1.0, PoseSource::Telemetry)?;
        poses.insert(picture.name.clone(), picture.view.pose);
        if let Some(refiner) = &mut refiner
            && let Err(e) = refiner.add(&picture)
        {
            tracing::warn!("{e}");
            report.skip("pictures_not_refined", 1);
        }
        progress.set(done as u64 + 1, || set.frames[i].name.clone());
    }
    let Some(mut refiner) = refiner else { return Ok(Some(Posed { poses, ..Default::default() })) };
    let solved = refiner.solve()?;
    for (name, pose) in &mut poses {
        *pose = refiner.pose(name).unwrap_or(*pose);
    }
    progress.finish(&format!(
        "{} of {} pictures tied together, reprojection {:.2} px",
        solved.frames_tied,
        frames.len(),
        solved.reprojection_rms_px
    ));
    report.more.insert("refine".to_owned(), serde_json::to_value(&solved).map_err(CliError::failed)?);
    report.stage("refine", from);
    let points = refiner.sparse_points().iter().map(|p| (p.position.map(|v| v as f32), p.color)).collect();
    Ok(Some(Posed { poses, points }))
}

/// Gaussians and priors for training, or those of a model to continue (its priors are made again: they are not
/// stored); `None` when asked to stop.
#[allow(clippy::too_many_arguments)] // each is one thing the stage needs; a struct would only rename them
pub(super) fn start(
    job: &TrainJob,
    set: &Dataset,
    frames: &[usize],
    posed: &Posed,
    capacity: usize,
    resumed: Option<&Resumed>,
    stop: &Interrupt,
    report: &mut RunReport,
) -> Result<Option<Start>, CliError> {
    let from = Instant::now();
    let needs_priors = job.training.loss.depth > 0.0 && job.network.depth.is_none();
    let started = match (job.init, resumed) {
        (InitKind::FeedForward, Some(r)) if !needs_priors => Some(plain(r.cloud.clone())),
        (InitKind::FeedForward, r) => {
            let mut made = feed_forward(job, set, frames, posed, capacity, stop, report)?;
            if let (Some(made), Some(r)) = (&mut made, r) {
                made.cloud = r.cloud.clone();
            }
            made
        }
        (_, Some(r)) => Some(plain(r.cloud.clone())),
        (InitKind::SparsePoints, None) => Some(plain(sparse(job, set, frames, posed, capacity)?)),
        (InitKind::Random, None) => Some(plain(at_random(job, set, frames, &posed.poses, capacity)?)),
    };
    report.stage("init", from);
    Ok(started)
}

fn plain(cloud: GaussianCloud) -> Start {
    Start { cloud, priors: HashMap::new(), priors_by: String::new() }
}

fn feed_forward(
    job: &TrainJob,
    set: &Dataset,
    frames: &[usize],
    posed: &Posed,
    capacity: usize,
    stop: &Interrupt,
    report: &mut RunReport,
) -> Result<Option<Start>, CliError> {
    let mut settings = job.init_settings.clone();
    settings.max_pictures = settings.max_pictures.max(frames.len());
    let mut initialiser = Initialiser::open(&settings, job.network.pair.as_deref())?;
    initialiser.hint_points(posed.points.iter().map(|p| p.0));
    let mut progress = Progress::new("initialising", 2 * frames.len() as u64);
    for (done, &i) in frames.iter().enumerate() {
        if stop.requested() {
            return Ok(None);
        }
        let decoding = Instant::now();
        let picture = job.posed(set, i, &posed.poses)?;
        report.stage("decode", decoding);
        initialiser.add(&picture)?;
        progress.set(done as u64 + 1, || set.frames[i].name.clone());
    }
    // With all pictures there, every depth is made once, from its best partners, on all threads.
    let mut done = frames.len();
    loop {
        let more = initialiser.advance(DEPTHS_BETWEEN_STOPS)?;
        done += more;
        progress.set(done as u64, || "depth".to_owned());
        if more == 0 {
            break;
        }
        if stop.requested() {
            return Ok(None);
        }
    }
    let made = initialiser.build(capacity)?;
    progress.finish(&format!(
        "{} Gaussians of {} depth maps by {}",
        made.cloud.len(),
        made.depth_priors.len(),
        made.report.network
    ));
    report.skip("pairs", made.report.skipped.total() as u64);
    report.skip("depth_samples_inconsistent", made.report.removed as u64);
    report.more.insert("init".to_owned(), serde_json::to_value(&made.report).map_err(CliError::failed)?);
    let priors_by = made.report.network;
    Ok(Some(Start { cloud: made.cloud, priors: made.depth_priors.into_iter().collect(), priors_by }))
}

fn sparse(
    job: &TrainJob,
    set: &Dataset,
    frames: &[usize],
    posed: &Posed,
    capacity: usize,
) -> Result<GaussianCloud, CliError> {
    // The file's points lie in the frame of the data set's poses, refined telemetry in its own.
    let (positions, colors): (Vec<[f32; 3]>, Vec<[u8; 3]>) = match job.poses == PoseSource::Telemetry && job.refine {
        true => posed.points.iter().copied().unzip(),
        false => set.sparse_points_of(frames)?.iter().map(|p| (p.position.map(|v| v as f32), p.color)).unzip(),
    };
    if positions.is_empty() {
        let what = "no sparse points that two of the training pictures saw; use --init feed-forward or random";
        return Err(CliError::input(format!("{}: {what}", set.root.display())));
    }
    Ok(from_sfm(&positions, &colors, capacity)?)
}

fn at_random(
    job: &TrainJob,
    set: &Dataset,
    frames: &[usize],
    poses: &HashMap<String, Pose>,
    capacity: usize,
) -> Result<GaussianCloud, CliError> {
    let views: Vec<View> = frames
        .iter()
        .map(|&i| {
            let view = set.frames[i].view;
            View { pose: poses.get(&set.frames[i].name).copied().unwrap_or(view.pose), ..view }
        })
        .collect();
    let depth = match job.init_settings.depth_m {
        Some(range) => range,
        None => depth_range(set, frames, &views)?,
    };
    Ok(random(&views, depth, RANDOM_POINTS.min(capacity), job.training.seed)?)
}

/// Depths between which the scene lies: of the sparse points when there are any, else around the cameras' height
/// above the ground plane.
fn depth_range(set: &Dataset, frames: &[usize], views: &[View]) -> Result<[f32; 2], CliError> {
    let points = set.sparse_points_of(frames)?;
    let mut depths: Vec<f32> = Vec::new();
    for view in views {
        let forward = view.pose.forward();
        let step = points.len().div_ceil(512).max(1);
        depths.extend(
            points
                .iter()
                .step_by(step)
                .map(|p| (glam::DVec3::from_array(p.position) - view.pose.center).dot(forward) as f32),
        );
    }
    depths.retain(|d| *d > 0.0 && d.is_finite());
    if depths.is_empty() {
        depths.extend(views.iter().flat_map(|v| [0.7, 1.3].map(|f| (f * v.pose.center.z) as f32)).filter(|d| *d > 0.0));
    }
    depths.sort_by(f32::total_cmp);
    let at = |share: f64| depths.get(((depths.len().max(1) - 1) as f64 * share) as usize).copied();
    match (at(0.02), at(0.98)) {
        (Some(near), Some(far)) if far > near => Ok([near, far]),
        _ => Err(CliError::input(
            "a random start needs to know how far the scene is; give depth_m = [near, far] in [init] of --settings",
        )),
    }
}
