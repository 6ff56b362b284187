//! Key frames and where they were taken: ties between them, and their poses and lenses as refinement knows them by now.

use std::collections::{BTreeSet, HashMap};
use std::time::Instant;

use config::refine::RefineSettings;
use job::run_json::RunReport;
use models::camera::{Pose, PosedImage, View};
use models::refine::{RefineReport, Refiner};

use crate::error::EngineError;

/// All poses are solved at once whenever the key frames have grown by this share: their errors, which pictures and GPS bound, are
/// spread evenly again, for a cost that all solves together keep in proportion to the key frames.
const WHOLE_GROWTH: f64 = 0.34;

/// A triangulated point: ENU metres, 8-bit sRGB.
pub type Point = ([f64; 3], [u8; 3]);

/// Key frames with their poses.
pub(super) struct Poses {
    /// None where poses are taken as they are.
    refiner: Option<Refiner>,
    /// Key frames with lens and pose as they are known now, in the order of the trainer's views.
    views: Vec<(String, View)>,
    /// Number of each by its name.
    index: HashMap<String, usize>,
    /// Key frames were tied to others since poses were last solved.
    unsolved: bool,
    /// Views whose pose or lens may have changed since the model last followed.
    moved: BTreeSet<usize>,
    /// Key frames when all poses were last solved.
    solved: usize,
    /// That was since the model last followed.
    whole: bool,
    /// The last solution of all.
    report: Option<RefineReport>,
}

/// What a solution changed.
#[derive(Debug, Default)]
pub(super) struct Placed {
    /// Numbers of the views that it knows.
    pub views: Vec<usize>,
    /// Points that it found near the newest key frames.
    pub points: Vec<[f32; 3]>,
    /// Key frames and observations that it adjusted, where it was one among neighbours.
    pub adjusted: (usize, usize),
    /// All poses were solved at once.
    pub whole: bool,
}

/// Views whose pose or lens changed since the model last followed.
#[derive(Debug)]
pub(super) struct Moved {
    pub views: BTreeSet<usize>,
    /// All poses were solved at once.
    pub whole: bool,
}

impl Poses {
    /// None yet, and memory for so many.
    pub fn open(refine: Option<&RefineSettings>, most: usize) -> Result<Self, EngineError> {
        let settings = |refine: &RefineSettings| RefineSettings {
            max_keyframes: refine.max_keyframes.max(most),
            ..refine.clone()
        };
        Ok(Self {
            refiner: refine.map(|refine| Refiner::open(&settings(refine))).transpose()?,
            views: Vec::with_capacity(most),
            index: HashMap::with_capacity(most),
            unsolved: false,
            moved: BTreeSet::new(),
            solved: 0,
            whole: false,
            report: None,
        })
    }

    pub fn refiner_mut(&mut self) -> Option<&mut Refiner> {
        self.refiner.as_mut()
    }

    pub fn are_refined(&self) -> bool {
        self.refiner.is_some()
    }

    /// Takes poses as they are from here on.
    pub fn keep(&mut self) {
        self.refiner = None;
    }

    pub fn len(&self) -> usize {
        self.views.len()
    }

    /// Names, lenses and poses, in the order of the trainer's views.
    pub fn views(&self) -> &[(String, View)] {
        &self.views
    }

    pub fn view(&self, i: usize) -> View {
        self.views[i].1
    }

    /// Number of a key frame.
    pub fn index_of(&self, name: &str) -> Option<usize> {
        self.index.get(name).copied()
    }

    pub fn pose(&self, name: &str) -> Option<Pose> {
        self.index_of(name).map(|i| self.views[i].1.pose)
    }

    /// Ties a picture to those before it; one that cannot be keeps its pose and is counted.
    pub fn tie(&mut self, picture: &PosedImage, report: &mut RunReport) {
        let Some(refiner) = &mut self.refiner else { return };
        let from = Instant::now();
        match refiner.add(picture) {
            Ok(tied) => {
                self.unsolved = true;
                tracing::debug!("{}: {} features, {} pairs", picture.name, tied.features, tied.pairs_verified);
            }
            Err(e) => {
                tracing::warn!("pose refinement: {e}");
                report.skip("pictures_not_refined", 1);
            }
        }
        report.stage("refine", from);
    }

    /// Counts a key frame in, with the lens that it is trained with.
    pub fn push(&mut self, name: &str, view: View) {
        self.index.insert(name.to_owned(), self.views.len());
        self.views.push((name.to_owned(), view));
    }

    /// Whether key frames were tied whose poses are not solved.
    pub fn wait(&self) -> bool {
        self.unsolved
    }

    /// Solves all poses and lenses.
    pub fn solve(&mut self, report: &mut RunReport) -> Result<Placed, EngineError> {
        let Some(refiner) = &mut self.refiner else { return Ok(Placed::default()) };
        let _span = tracing::info_span!("refine").entered();
        let from = Instant::now();
        let solved = refiner.solve()?;
        for (name, view) in &mut self.views {
            take_refined(refiner, name, view);
        }
        self.report = Some(solved);
        (self.solved, self.whole) = (self.views.len(), true);
        self.moved.extend(0..self.views.len());
        report.stage("refine", from);
        Ok(Placed { views: (0..self.views.len()).collect(), whole: true, ..Placed::default() })
    }

    /// Places the newest key frames, if any wait: at once among their neighbours, or with all others where it is time.
    pub fn place(&mut self, report: &mut RunReport) -> Result<Placed, EngineError> {
        if !std::mem::take(&mut self.unsolved) {
            return Ok(Placed::default());
        }
        if self.views.len() as f64 >= self.solved as f64 * (1.0 + WHOLE_GROWTH) {
            return self.solve(report);
        }
        let Some(refiner) = &mut self.refiner else { return Ok(Placed::default()) };
        let _span = tracing::info_span!("place").entered();
        let from = Instant::now();
        let near = refiner.solve_near()?;
        let views: Vec<usize> = near.moved.iter().filter_map(|name| self.index.get(name).copied()).collect();
        for &i in &views {
            let (name, view) = &mut self.views[i];
            take_refined(refiner, name, view);
            self.moved.insert(i);
        }
        let points = refiner.recent_points().iter().map(|p| p.position.map(|v| v as f32)).collect();
        report.stage("refine", from);
        Ok(Placed { views, points, adjusted: (near.adjusted_frames, near.observations), whole: false })
    }

    /// What changed since the model last followed, with all views from number `first` on: it follows now.
    pub fn follow(&mut self, first: usize) -> Moved {
        self.moved.extend(first..self.views.len());
        Moved { views: std::mem::take(&mut self.moved), whole: std::mem::take(&mut self.whole) }
    }

    /// Points of the scene that refinement triangulated; `None` where poses are taken as they are.
    pub fn points(&self) -> Option<Vec<Point>> {
        let refiner = self.refiner.as_ref()?;
        Some(refiner.sparse_points().iter().map(|p| (p.position, p.color)).collect())
    }

    /// Says how well the poses fit.
    pub fn note(&self, report: &mut RunReport) -> Result<(), EngineError> {
        if let Some(refined) = &self.report {
            report.more.insert("reprojection_rms_px".into(), refined.reprojection_rms_px.into());
            report.more.insert("refine".into(), serde_json::to_value(refined)?);
        }
        Ok(())
    }
}

/// What refinement knows of a view by now.
fn take_refined(refiner: &Refiner, name: &str, view: &mut View) {
    if let Some(pose) = refiner.pose(name) {
        view.pose = pose;
    }
    if let Some(lens) = refiner.intrinsics(name) {
        view.intrinsics = lens.resized(view.intrinsics.width, view.intrinsics.height);
    }
}
