//! The first Gaussians: of the feed-forward network, of sparse points, or at random. And the depths that training is held to, which the same
//! networks make.

use std::collections::HashSet;
use std::time::Instant;

use config::init::InitSettings;
use config::mission::NetworkSettings;
use config::training::TrainSettings;
use glam::DVec3;
use image::RgbImage;
use job::console::Progress;
use job::run_json::RunReport;
use models::camera::{DepthPrior, Pinhole, PoseSigma, PosedImage, View};
use models::cloud::GaussianCloud;
use models::init::{Growth, Initialisation, Initialiser, from_sfm, random};
use models::light::Light;
use models::onnx::depth::DepthNetwork;

use super::poses::{Placed, Point, Poses};
use super::training::{Fresh, Training};
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
    /// The Gaussians of a model ([`crate::Reconstruction::begin_with`]).
    Model,
}

/// What makes first Gaussians and depths.
pub(super) struct FirstGaussians {
    kind: InitKind,
    settings: InitSettings,
    seed: u64,
    /// The feed-forward network, and what it keeps of pictures.
    initialiser: Option<Initialiser>,
    /// The user's own network for the depth loss.
    depth: Option<DepthNetwork>,
    /// How many key frames the initialiser has.
    taken: usize,
    /// Points of the scene known beforehand.
    points: Vec<Point>,
}

impl FirstGaussians {
    /// Opens the networks that training needs, for so many pictures of at most `size`.
    pub fn open(
        kind: InitKind,
        init: &InitSettings,
        network: &NetworkSettings,
        training: &TrainSettings,
        (size, views): ((u32, u32), usize),
    ) -> Result<Self, EngineError> {
        let depth = network.depth.as_deref().filter(|_| training.loss.depth > 0.0);
        let depth = depth.map(|path| DepthNetwork::open(path, size, init.max_side, init.threads)).transpose()?;
        let settings = InitSettings { max_pictures: init.max_pictures.max(views), ..init.clone() };
        // Another start asks the network for depths only.
        let wants_depths = init.depth_priors && depth.is_none() && training.loss.depth > 0.0;
        let initialiser = match kind {
            InitKind::SparsePoints | InitKind::Random | InitKind::Model if !wants_depths => None,
            _ => Some(Initialiser::open(&settings, network.pair.as_deref())?),
        };
        Ok(Self { kind, settings, seed: training.seed, initialiser, depth, taken: 0, points: Vec::new() })
    }

    pub fn initialiser_mut(&mut self) -> Option<&mut Initialiser> {
        self.initialiser.as_mut()
    }

    /// The Gaussians are there already: what is left to make are depths, where training wants any and the user's network makes none.
    pub fn only_depths(&mut self, training: &TrainSettings) {
        if training.loss.depth <= 0.0 || self.depth.is_some() {
            self.initialiser = None;
        }
    }

    pub fn set_points(&mut self, points: Vec<Point>) {
        self.points = points;
    }

    /// Whether Gaussians of new key frames can be added to those of earlier ones.
    pub fn grow(&self) -> bool {
        self.initialiser.as_ref().is_some_and(Initialiser::grows)
    }

    /// Ground that the pictures show, square metres.
    pub fn ground_m2(&self) -> Option<f64> {
        self.initialiser.as_ref().map(Initialiser::ground_m2)
    }

    /// Width and height of what a picture shows of the ground, metres.
    pub fn footprint_m(&self) -> Option<[f64; 2]> {
        let initialiser = self.initialiser.as_ref()?;
        (0..self.taken).find_map(|k| initialiser.footprint_m(k))
    }

    /// The common light of all pictures, as the depths tell it by now.
    pub fn survey_light(&mut self) -> Result<Option<Light>, EngineError> {
        let Some(initialiser) = &mut self.initialiser else { return Ok(None) };
        Ok(initialiser.survey_light()?.cloned())
    }

    /// Depth of a picture by the user's own network.
    pub fn own_depth(&mut self, picture: &RgbImage) -> Result<Option<DepthPrior>, EngineError> {
        Ok(self.depth.as_mut().map(|network| network.estimate(picture)).transpose()?)
    }

    pub fn has_own_network(&self) -> bool {
        self.depth.is_some()
    }

    /// Name of the network that made the depths.
    pub fn network(&self, fresh: &Fresh) -> Option<String> {
        let own = self.depth.as_ref().map(|network| network.name().to_owned());
        own.or(fresh.report.as_ref().map(|report| report.network.clone()))
    }

    /// All depths are made: the user's network gives its memory back.
    pub fn close_own_network(&mut self) {
        if let Some(network) = &mut self.depth {
            network.close();
        }
    }

    /// Key frames of `poses` that wait to be taken.
    pub fn waiting(&self, poses: &Poses) -> usize {
        poses.len() - self.taken
    }

    /// Takes over what refinement knows.
    pub fn follow(&mut self, poses: &Poses, placed: &Placed) {
        let Some(initialiser) = &mut self.initialiser else { return };
        for &i in &placed.views {
            let (name, view) = &poses.views()[i];
            initialiser.update_pose(name, &view.pose);
        }
        initialiser.hint_points(placed.points.iter().copied());
    }

    /// Takes the newest key frame, and those before it that waited for their pose. With `at_once` the network begins: it runs on a
    /// picture once its neighbours are there, and doing it now spreads the work over the flight.
    pub fn take_newest(
        &mut self,
        mut picture: PosedImage,
        poses: &Poses,
        training: &mut Training,
        at_once: bool,
        report: &mut RunReport,
    ) -> Result<(), EngineError> {
        let Some(newest) = poses.len().checked_sub(1).filter(|_| self.initialiser.is_some()) else { return Ok(()) };
        let from = Instant::now();
        self.take_waiting(newest, poses, training)?;
        let Some(initialiser) = &mut self.initialiser else { return Ok(()) };
        picture.view.pose = poses.view(newest).pose;
        initialiser.add(&picture)?;
        self.taken = poses.len();
        if at_once {
            initialiser.advance(1)?;
        }
        report.stage("init", from);
        Ok(())
    }

    /// Takes the first `until` key frames, with the pixels that training keeps of them.
    pub fn take_waiting(&mut self, until: usize, poses: &Poses, training: &mut Training) -> Result<(), EngineError> {
        let Some(initialiser) = &mut self.initialiser else { return Ok(()) };
        for i in self.taken..until {
            if let Some((view, image, mask)) = training.picture(i)? {
                let (name, View { pose, .. }) = poses.views()[i].clone();
                let view = View { pose, ..view };
                let sigma = PoseSigma { position_m: [0.0; 3], rotation_rad: [0.0; 3] };
                initialiser.add(&PosedImage { name, time_ns: 0, image, mask, view, sigma })?;
            }
        }
        self.taken = self.taken.max(until);
        Ok(())
    }

    /// Takes all key frames, and the points that refinement triangulated, which bound the depths.
    pub fn take_all(&mut self, poses: &Poses, training: &mut Training) -> Result<(), EngineError> {
        if let Some(points) = poses.points() {
            self.points = points;
            if let Some(initialiser) = &mut self.initialiser {
                initialiser.hint_points(self.points.iter().map(|p| p.0.map(|v| v as f32)));
            }
        }
        self.take_waiting(poses.len(), poses, training)
    }

    /// Gaussians of all key frames, at most `capacity` of them for the ground that they show, and their depths, which training takes;
    /// `None` when `cancelled` said so. Where a model is `continued`, its Gaussians are the first.
    pub fn make(
        &mut self,
        poses: &Poses,
        training: &mut Training,
        capacity: &dyn Fn(f64) -> usize,
        continued: bool,
        cancelled: &dyn Fn() -> bool,
    ) -> Result<Option<Fresh>, EngineError> {
        let Some(initialiser) = &mut self.initialiser else {
            return Ok(Some(self.without_network(poses, capacity(0.0), continued)?.into()));
        };
        let capacity = capacity(initialiser.ground_m2());
        let (own_network, mut failed) = (self.depth.is_some(), Ok(()));
        let at_once = !training.is_incremental();
        let mut prior = |name: &str, depth: DepthPrior| {
            if let (Some(i), Ok(()), false) = (poses.index_of(name), &failed, own_network) {
                failed = training.set_prior(i, Some(&depth));
            }
        };
        let made = feed_forward(initialiser, poses.len(), capacity, at_once, &mut prior, cancelled)?;
        failed?;
        // Another start wants of them the depths alone: neither the Gaussians nor the light.
        Ok(match made {
            Some(made) if self.kind != InitKind::FeedForward => {
                Some(Fresh { cloud: self.without_network(poses, capacity, continued)?, light: None, ..made })
            }
            made => made,
        })
    }

    /// Depths and Gaussians of the new key frames, `share` of them for so many square metres; training takes the depths.
    pub fn make_new(
        &mut self,
        poses: &Poses,
        training: &mut Training,
        share: &dyn Fn(f64) -> usize,
        report: &mut RunReport,
    ) -> Result<Option<(Initialisation, Growth)>, EngineError> {
        let Some(initialiser) = &mut self.initialiser else { return Ok(None) };
        let from = Instant::now();
        let (own_network, mut failed) = (self.depth.is_some(), Ok(()));
        let mut prior = |name: &str, depth: DepthPrior| {
            if let (Some(i), Ok(()), false) = (poses.index_of(name), &failed, own_network) {
                failed = training.set_prior(i, Some(&depth));
            }
        };
        let made = initialiser.grow(share, &mut prior);
        failed?;
        report.stage("init", from);
        Ok(made?)
    }

    /// The Gaussians of a start that is not the network's: at most `capacity`, none where a model is continued.
    fn without_network(&self, poses: &Poses, capacity: usize, continued: bool) -> Result<GaussianCloud, EngineError> {
        match self.kind {
            _ if continued => Ok(GaussianCloud::default()),
            InitKind::Model => Ok(GaussianCloud::default()),
            InitKind::Random => {
                let views: Vec<View> = poses.views().iter().map(|v| v.1).collect();
                at_random(&views, &self.points, self.settings.depth_m, capacity, self.seed)
            }
            InitKind::FeedForward | InitKind::SparsePoints => sparse(&self.points, capacity),
        }
    }
}

/// All pictures of `initialiser` into at most `capacity` Gaussians; `None` when `cancelled` said so. With `at_once` no picture
/// is still to come, and every depth is made once, from its best partners, on all threads. `prior` takes the depths one by one.
fn feed_forward(
    initialiser: &mut Initialiser,
    pictures: usize,
    capacity: usize,
    at_once: bool,
    prior: &mut dyn FnMut(&str, DepthPrior),
    cancelled: &dyn Fn() -> bool,
) -> Result<Option<Fresh>, EngineError> {
    let mut progress = Progress::new("initialising", pictures as u64);
    let (mut done, mut more) = (0, usize::from(at_once));
    while more > 0 {
        more = initialiser.advance(DEPTHS_BETWEEN_STOPS)?;
        done += more;
        progress.set(done as u64, || "depth".to_owned());
        if more > 0 && cancelled() {
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
    Ok(Some(Fresh { cloud: made.cloud, with_depth, light: made.light, report: Some(made.report) }))
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
