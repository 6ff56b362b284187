//! The first Gaussians: of the feed-forward network, of sparse points, or at random.

use std::collections::HashSet;

use glam::DVec3;
use job::console::Progress;
use models::camera::{DepthPrior, Pinhole, View};
use models::cloud::GaussianCloud;
use models::init::{InitReport, Initialiser, from_sfm, random};
use models::light::Light;

use super::Reconstruction;
use crate::error::EngineError;

/// Points of a random start (3DGS: 100,000).
const RANDOM_POINTS: usize = 100_000;
/// Depths made between two looks at whether somebody asked to stop.
const DEPTHS_BETWEEN_STOPS: usize = 16;

/// Where the first Gaussians come from.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum InitKind {
    /// The feed-forward network.
    FeedForward,
    /// Sparse points: the data set's, or those of the pose refinement.
    SparsePoints,
    /// Points at random in what the cameras see.
    Random,
    /// Those of a model ([`Reconstruction::begin_with`]).
    Model,
}

/// A triangulated point: ENU metres, 8-bit sRGB.
pub type Point = ([f64; 3], [u8; 3]);

/// What training starts from.
pub(super) struct FirstGaussians {
    pub cloud: GaussianCloud,
    /// Pictures that have a depth.
    pub with_depth: HashSet<String>,
    /// The pictures' light, where it is uneven.
    pub light: Option<Light>,
    /// Of the feed-forward network.
    pub report: Option<InitReport>,
}

impl From<GaussianCloud> for FirstGaussians {
    fn from(cloud: GaussianCloud) -> Self {
        Self { cloud, with_depth: HashSet::new(), light: None, report: None }
    }
}

impl Reconstruction {
    /// The Gaussians of a start that is not the network's: at most `capacity`, none where a model is continued.
    pub(super) fn other_start(&self, capacity: usize) -> Result<GaussianCloud, EngineError> {
        let views: Vec<View> = self.views.iter().map(|v| v.1).collect();
        match self.settings.start {
            _ if self.is_continued() => Ok(GaussianCloud::default()),
            InitKind::Model => Ok(GaussianCloud::default()),
            InitKind::Random => {
                at_random(&views, &self.points, self.settings.init.depth_m, capacity, self.settings.training.seed)
            }
            InitKind::FeedForward | InitKind::SparsePoints => sparse(&self.points, capacity),
        }
    }
}

/// All pictures of `initialiser` into at most `capacity` Gaussians; `None` when `go_on` said no. With `at_once` no picture
/// is still to come, and every depth is made once, from its best partners, on all threads. `prior` takes the depths one by one.
pub(super) fn feed_forward(
    initialiser: &mut Initialiser,
    pictures: usize,
    capacity: usize,
    at_once: bool,
    prior: &mut dyn FnMut(&str, DepthPrior),
    go_on: &dyn Fn() -> bool,
) -> Result<Option<FirstGaussians>, EngineError> {
    let mut progress = Progress::new("initialising", pictures as u64);
    let (mut done, mut more) = (0, usize::from(at_once));
    while more > 0 {
        more = initialiser.advance(DEPTHS_BETWEEN_STOPS)?;
        done += more;
        progress.set(done as u64, || "depth".to_owned());
        if more > 0 && !go_on() {
            return Ok(None);
        }
    }
    let mut with_depth = HashSet::with_capacity(pictures);
    let made = initialiser.build(capacity, &mut |name, depth| {
        with_depth.insert(name.to_owned());
        prior(name, depth);
    })?;
    let (gaussians, maps) = (made.cloud.len(), with_depth.len());
    progress.finish(&format!("{gaussians} Gaussians of {maps} depth maps by {}", made.report.network));
    Ok(Some(FirstGaussians { cloud: made.cloud, with_depth, light: made.light, report: Some(made.report) }))
}

/// The points themselves.
fn sparse(points: &[Point], capacity: usize) -> Result<GaussianCloud, EngineError> {
    if points.is_empty() {
        let what = "no sparse points that two of the training pictures saw; use --init feed-forward or random";
        return Err(EngineError::Request(what.into()));
    }
    let (positions, colors): (Vec<[f32; 3]>, Vec<[u8; 3]>) =
        points.iter().map(|(position, color)| (position.map(|v| v as f32), *color)).unzip();
    Ok(from_sfm(&positions, &colors, capacity)?)
}

/// Anywhere in what `views` see between the depths `range`, or those of `points`.
fn at_random(
    views: &[View],
    points: &[Point],
    range: Option<[f32; 2]>,
    capacity: usize,
    seed: u64,
) -> Result<GaussianCloud, EngineError> {
    let range = match range {
        Some(range) => range,
        None => depth_range(views, points)?,
    };
    Ok(random(views, range, RANDOM_POINTS.min(capacity), seed)?)
}

/// Depths between which the scene lies: of the sparse points that each view shows when there are any (those beside a slanting view lie at
/// any depth), else around the cameras' height above the ground plane.
fn depth_range(views: &[View], points: &[Point]) -> Result<[f32; 2], EngineError> {
    let mut depths: Vec<f32> = Vec::new();
    let step = points.len().div_ceil(512).max(1);
    for view in views {
        let (camera, forward) = (Pinhole::from(view), view.pose.forward());
        let points = points.iter().step_by(step).map(|p| DVec3::from_array(p.0));
        let shown = points.filter(|p| camera.project(*p).is_some_and(|pixel| view.intrinsics.contains(pixel)));
        depths.extend(shown.map(|p| (p - view.pose.center).dot(forward) as f32));
    }
    depths.retain(|d| *d > 0.0 && d.is_finite());
    if depths.is_empty() {
        depths.extend(views.iter().flat_map(|v| [0.7, 1.3].map(|f| (f * v.pose.center.z) as f32)).filter(|d| *d > 0.0));
    }
    depths.sort_by(f32::total_cmp);
    let at = |share: f64| depths.get(((depths.len().max(1) - 1) as f64 * share).round() as usize).copied();
    match (at(0.02), at(0.98)) {
        (Some(near), Some(far)) if far > near => Ok([near, far]),
        _ => Err(EngineError::Request(
            "a random start needs to know how far the scene is; give depth_m = [near, far] in [init] of --settings"
                .into(),
        )),
    }
}

#[cfg(test)]
mod tests {
    use glam::DQuat;
    use models::camera::{Intrinsics, Pose};

    use super::*;

    #[test]
    fn a_random_start_lies_where_the_views_show_points_not_where_others_lie() {
        let intrinsics = Intrinsics { width: 64, height: 48, fx: 60.0, fy: 60.0, cx: 32.0, cy: 24.0 };
        let pose = Pose { rotation: DQuat::from_xyzw(1.0, 0.0, 0.0, 0.0), center: DVec3::new(0.0, 0.0, 50.0) };
        let view = View { intrinsics, pose };
        let shown = (0..100).map(|i| ([f64::from(i % 10) - 5.0, f64::from(i / 10) - 5.0, f64::from(i % 3)], [0; 3]));
        let beside = (0..400).map(|i| ([900.0 + f64::from(i), 0.0, -400.0], [0; 3]));
        let points: Vec<Point> = shown.chain(beside).collect();
        assert_eq!(depth_range(&[view], &points).expect("a range"), [48.0, 50.0]);
        let [near, far] = depth_range(&[view], &[]).expect("from the cameras' height");
        assert!((near - 35.0).abs() < 1e-3 && (far - 65.0).abs() < 1e-3, "{near} {far}");
    }
}
