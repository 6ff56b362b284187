//! Pose refinement: telemetry says where a camera was to within metres and degrees, the pictures say it to within
//! centimetres. XFeat matches between co-visible key frames, verified relative poses, tracks, and a bundle
//! adjustment in which telemetry is the prior that fixes the gauge.
//!
//! Key frames are added one at a time while flying ([`Refiner::add`] extracts, matches and verifies) and
//! [`Refiner::solve`] may be called whenever there is time; it starts from what the last one found. Everything held
//! is bounded by [`RefineSettings`]; of pictures only grey values are kept. What telemetry gets wrong for all frames alike
//! (camera mount, delay of positions, focal length) is estimated when the pictures can tell it and left alone
//! when not.

mod adjust;
mod agreement;
mod bootstrap;
mod calibration;
mod certainty;
mod control;
mod covisible;
mod decoys;
mod discovery;
mod fivepoint;
mod gauge;
mod grey;
mod growth;
mod intake;
mod joining;
mod keyframe;
mod level;
mod linking;
mod matching;
mod motion;
mod near;
mod overlap;
mod overview;
mod p3p;
mod part;
mod photometric;
mod placing;
mod positions;
mod problem;
mod radial;
mod reduced;
mod relink;
mod report;
mod resect;
mod schur;
mod so3;
mod solving;
mod tracks;
mod triangulate;
mod twoview;
mod untied;
mod upright;

pub use bootstrap::BootstrapReport;
pub use control::ControlPoint;
pub use positions::PositionsReport;
pub use report::{
    AddReport, ControlResidual, LENS_PARAMETERS, LensPrecision, NearReport, PosePrecision, RefineReport, RefinedPoint,
    SharedEstimate,
};
pub use untied::Untied;

use crate::camera::{Intrinsics, Pose, PoseSigma, PosedImage, View};
use crate::frame_file::FrameFile;
use crate::onnx::OnnxError;
use crate::onnx::features::{FeatureNetwork, Features};
use config::error::ErrorKind;
use config::refine::RefineSettings;
use config::settings::SettingError;
use geometry::lens::Distortion;
use glam::DVec3;
use grey::Grey;
use intake::invalid;
use keyframe::{DESCRIPTOR, KeyFrame, belongs};
use linking::Pair;
use problem::{SHARED, Shared};
use std::collections::HashMap;
use std::fs::File;
use std::sync::Arc;
use std::time::Instant;
use thiserror::Error;
use tracks::Union;

/// Why a key frame was not taken, or the refiner not opened.
#[derive(Debug, Error)]
pub enum RefineError {
    /// A setting is out of range.
    #[error("[refine] {0}")]
    Settings(#[from] SettingError),
    /// The feature network cannot be opened or run.
    #[error(transparent)]
    Network(#[from] OnnxError),
    /// A picture was given to a refiner without a network.
    #[error("this refiner was opened without a feature network; give it features instead of pictures")]
    NoNetwork,
    /// The cap on key frames is reached.
    #[error("key frame {name} is beyond the {max} that [refine] max_keyframes allows; it keeps its telemetry pose")]
    Full {
        /// The key frame.
        name: String,
        /// The cap.
        max: usize,
    },
    /// A name was used before.
    #[error("key frame {0} was added before; names must be unique")]
    Duplicate(String),
    /// NaN, an infinite number or a zero quaternion in a pose; a sigma that is not positive.
    #[error("key frame {name}: its {what}; it was left out")]
    Invalid {
        /// The key frame.
        name: String,
        /// What is wrong.
        what: &'static str,
    },
}

impl config::error::Error for RefineError {
    /// A refinement needs a library only where its network does.
    fn kind(&self) -> ErrorKind {
        match self {
            Self::Network(e) => e.kind(),
            Self::NoNetwork => ErrorKind::Failed,
            Self::Settings(_) | Self::Full { .. } | Self::Duplicate(_) | Self::Invalid { .. } => ErrorKind::Input,
        }
    }
}

/// What holds the scene where it is.
#[derive(Clone, Copy, Debug, Default)]
struct Standing {
    /// The poses are pictures' alone: nothing says where, how large and which way the scene is.
    floating: bool,
    /// The pictures alone said how they lie to each other.
    by_pictures: bool,
    /// The poses have been brought to surveyed points.
    anchored: bool,
    /// Those alone say where the scene is.
    fixed: bool,
}

/// Refines the poses of key frames; see the module's text.
pub struct Refiner {
    settings: RefineSettings,
    /// One for pictures as they are, one for pictures on their side: a session is tied to one size.
    networks: Option<[FeatureNetwork; 2]>,
    frames: Vec<KeyFrame>,
    by_name: HashMap<String, u32>,
    /// Where descriptors and grey values of the key frames are kept when not in memory.
    file: Option<Arc<FrameFile>>,
    union: Union,
    pairs: Vec<Pair>,
    shared: Shared,
    /// Which of them the last solve estimated.
    freed: [bool; SHARED],
    /// Height of the ground, world metres, overall and under each frame.
    ground: Option<f64>,
    grounds: Vec<Option<f64>>,
    pair_grounds: Vec<f64>,
    points: Vec<RefinedPoint>,
    /// Those that the last look at what was new gave.
    recent: Vec<RefinedPoint>,
    /// Key frames and pairs that there were at the last solve.
    solved_frames: usize,
    solved_pairs: usize,
    solves: u32,
    /// Surveyed points.
    control: Vec<ControlPoint>,
    standing: Standing,
    totals: RefineReport,
}

impl Refiner {
    /// Opens the feature network (the embedded one) and reserves for the caps of `settings`.
    ///
    /// # Errors
    /// A setting is out of range, or ONNX Runtime is missing.
    pub fn open(settings: &RefineSettings) -> Result<Self, RefineError> {
        let mut refiner = Self::without_network(settings)?;
        let open = || FeatureNetwork::open(None, settings.threads);
        refiner.networks = Some([open()?, open()?]);
        Ok(refiner)
    }

    /// A refiner that is given features ([`Refiner::add_features`]) rather than pictures.
    ///
    /// # Errors
    /// A setting is out of range.
    pub fn without_network(settings: &RefineSettings) -> Result<Self, RefineError> {
        settings.check()?;
        Ok(Self {
            settings: settings.clone(),
            networks: None,
            frames: Vec::with_capacity(settings.max_keyframes),
            file: None,
            by_name: HashMap::with_capacity(settings.max_keyframes),
            union: Union::with_capacity(settings.max_keyframes * settings.max_features),
            pairs: Vec::new(),
            shared: Shared::default(),
            freed: [false; SHARED],
            ground: None,
            grounds: Vec::with_capacity(settings.max_keyframes),
            pair_grounds: Vec::new(),
            points: Vec::new(),
            recent: Vec::new(),
            solved_frames: 0,
            solved_pairs: 0,
            solves: 0,
            control: Vec::new(),
            standing: Standing::default(),
            totals: RefineReport::default(),
        })
    }

    /// Keeps what is large of the key frames in `file`, which is empty, instead of in memory: bit for bit the same. Call it before
    /// the first of them; the file takes [`RefineSettings::kept_bytes`] for each.
    pub fn keep_frames_in(&mut self, file: File) {
        self.file = Some(FrameFile::new(file));
    }

    /// Takes a key frame: extracts features and links it to the frames before it. Of the picture only the grey
    /// values are kept, at the size the network saw.
    ///
    /// # Errors
    /// The pose or sigma is not usable, the name is taken, the cap is reached, or the network failed. The refiner
    /// is as before then.
    pub fn add(&mut self, image: &PosedImage) -> Result<AddReport, RefineError> {
        self.check(&image.name, &image.view, &image.sigma)?;
        let lens = image.view.intrinsics;
        if (image.image.width(), image.image.height()) != (lens.width, lens.height) {
            return Err(invalid(&image.name, "picture and intrinsics differ in size"));
        }
        let camera = self.shared.lens.camera(self.expect(&image.view.pose), &lens);
        let candidates = self.candidates(&camera, &lens, self.frames.len());
        let turns = candidates.first().map_or(0, |a| {
            let frame = &self.frames[*a as usize];
            upright::turns_like(&self.camera_of(frame), frame.turns, &camera, &lens, self.ground_at(*a as usize))
        });
        let mut report = AddReport::default();
        let size = image.image.dimensions();
        let grey = image.mask.as_ref().map(|mask| Grey::new(&image.image, Some(mask), self.settings.feature_side));
        let features = self.extract(&image.image, size, turns, grey.as_ref(), &mut report)?;
        let as_told = features.clone();
        self.insert(&image.name, image.time_ns, &image.view, &image.sigma);
        self.set_features(features, turns, Some(image), &mut report);
        self.link(&candidates, &mut report);
        // A heading that is wrong by a quarter or half turn: descriptors do not match unless the picture is
        // turned accordingly. Only for frames that should overlap and do not.
        for more in [2, 1, 3] {
            if report.pairs_verified > 0 || candidates.is_empty() || report.features == 0 {
                break;
            }
            let turns = (turns + more) % 4;
            let features = self.extract(&image.image, size, turns, grey.as_ref(), &mut report)?;
            self.set_features(features, turns, Some(image), &mut report);
            let clock = Instant::now();
            self.link_wide(&candidates[..candidates.len().min(2)], &mut report);
            report.match_seconds += clock.elapsed().as_secs_f64();
        }
        if report.extractions > 1 && report.pairs_verified == 0 {
            // No direction links it: the next frames should find it in the likeliest.
            self.set_features(as_told, turns, Some(image), &mut report);
        }
        self.finish(report)
    }

    /// Takes a key frame without linking it to any: for pictures whose priors are no guide, which [`Refiner::place_all`] then places.
    ///
    /// # Errors
    /// As [`Refiner::add`].
    pub fn collect(&mut self, image: &PosedImage) -> Result<AddReport, RefineError> {
        self.check(&image.name, &image.view, &image.sigma)?;
        let lens = image.view.intrinsics;
        if (image.image.width(), image.image.height()) != (lens.width, lens.height) {
            return Err(invalid(&image.name, "picture and intrinsics differ in size"));
        }
        let mut report = AddReport::default();
        let grey = image.mask.as_ref().map(|mask| Grey::new(&image.image, Some(mask), self.settings.feature_side));
        let features = self.extract(&image.image, image.image.dimensions(), 0, grey.as_ref(), &mut report)?;
        self.insert(&image.name, image.time_ns, &image.view, &image.sigma);
        self.set_features(features, 0, Some(image), &mut report);
        self.finish(report)
    }

    /// As [`Refiner::add`], with features found elsewhere (64 floats per descriptor, best first).
    ///
    /// # Errors
    /// As [`Refiner::add`]; the lengths of `features` do not agree.
    pub fn add_features(
        &mut self,
        name: &str,
        time_ns: u64,
        view: &View,
        sigma: &PoseSigma,
        features: Features,
    ) -> Result<AddReport, RefineError> {
        self.check(name, view, sigma)?;
        if features.descriptors.len() != features.keypoints.len() * DESCRIPTOR {
            return Err(invalid(name, "features do not hold 64 values per key point"));
        }
        let camera = self.shared.lens.camera(self.expect(&view.pose), &view.intrinsics);
        let candidates = self.candidates(&camera, &view.intrinsics, self.frames.len());
        let mut report = AddReport::default();
        self.insert(name, time_ns, view, sigma);
        self.set_features(features, 0, None, &mut report);
        self.link(&candidates, &mut report);
        self.finish(report)
    }

    /// As [`Refiner::collect`], with features found elsewhere.
    ///
    /// # Errors
    /// As [`Refiner::add_features`].
    pub fn collect_features(
        &mut self,
        name: &str,
        time_ns: u64,
        view: &View,
        sigma: &PoseSigma,
        features: Features,
    ) -> Result<AddReport, RefineError> {
        self.check(name, view, sigma)?;
        if features.descriptors.len() != features.keypoints.len() * DESCRIPTOR {
            return Err(invalid(name, "features do not hold 64 values per key point"));
        }
        let mut report = AddReport::default();
        self.insert(name, time_ns, view, sigma);
        self.set_features(features, 0, None, &mut report);
        self.finish(report)
    }

    /// Optimises all poses from where they are, within the time that the settings allow.
    ///
    /// # Errors
    /// None at present beyond those of the type; a problem without enough links returns telemetry's poses.
    pub fn solve(&mut self) -> Result<RefineReport, RefineError> {
        self.solve_all()
    }

    /// Places the key frames from their pairs alone, whatever their priors say; those that never find a place are not
    /// [tied](Refiner::is_tied) after [`Refiner::relink`]. Call it once, after the last [`Refiner::add`] and before
    /// [`Refiner::solve`]. The world is level, its ground at height 0 and the pictures 50 above it.
    ///
    /// # Errors
    /// The network failed.
    pub fn bootstrap(&mut self) -> Result<BootstrapReport, RefineError> {
        bootstrap::bootstrap(self)
    }

    /// Finds the pairs of all key frames anew and places them from these alone, whatever their priors say: for key frames that were
    /// [collected](Refiner::collect). Otherwise as [`Refiner::bootstrap`].
    ///
    /// # Errors
    /// The network failed.
    pub fn place_all(&mut self) -> Result<BootstrapReport, RefineError> {
        growth::place_all(self)
    }

    /// Brings a scene that pictures alone have placed to the positions that its pictures came with, which are its priors from
    /// then on. `None`, and nothing changed, where more than half of them contradict it, or fewer than three do not.
    pub fn take_positions(&mut self) -> Option<PositionsReport> {
        positions::take_positions(self)
    }

    /// Tied pictures that lie further from the positions that they came with than these may be wrong, and how far, metres: either the scene
    /// is bent, or they are wrong.
    pub fn places_off(&self) -> Vec<(String, f64)> {
        positions::places_off(self)
    }

    /// How far the solved heights of tied pictures are from those that they came with in the median, and the standard deviation that
    /// these came with, metres; `None` of fewer than three.
    pub fn height_off_m(&self) -> Option<(f64, f64)> {
        positions::height_off_m(self)
    }

    /// Tells of every tied key frame how well its place is known. No longer takes those for tied that do not agree with the largest part of
    /// the scene, or whose place is known to a tenth of the distance to what they show or worse. Call it after a [`Refiner::solve`].
    /// Returns how well the lens is known: `None` of more pictures than the equations are inverted of, or where they tell nothing.
    pub fn judge(&mut self) -> Option<LensPrecision> {
        certainty::judge(self)
    }

    /// Takes their places from key frames that do not agree with the scene, so that the next [`Refiner::solve`] is not bent by them; false
    /// where there are none.
    pub fn leave_out_apart(&mut self) -> bool {
        let mut any = false;
        for frame in self.frames.iter_mut().filter(|f| f.known.apart && !f.unplaced) {
            (frame.unplaced, any) = (true, true);
        }
        any
    }

    /// How well the key frame's pose is known, as [`Refiner::judge`] left it.
    pub fn precision(&self, name: &str) -> Option<PosePrecision> {
        self.by_name.get(name).and_then(|i| self.frames[*i as usize].known.precision)
    }

    /// The key frames that are not part of the scene: those that nothing ties, and those that no chain of verified pairs joins to its
    /// largest part. In the order they were added.
    pub fn untied(&self) -> Vec<(&str, Untied)> {
        untied::untied(self)
    }

    /// Best pose of a key frame so far: telemetry's (with the shared errors taken out) until it is linked.
    pub fn pose(&self, name: &str) -> Option<Pose> {
        self.by_name.get(name).map(|i| self.frames[*i as usize].pose)
    }

    /// True when pictures, not only telemetry, hold the key frame in place.
    pub fn is_tied(&self, name: &str) -> bool {
        self.by_name.get(name).is_some_and(|i| belongs(&self.frames[*i as usize]))
    }

    /// The key frame's lens with what was estimated of focal lengths and principal point.
    pub fn intrinsics(&self, name: &str) -> Option<Intrinsics> {
        let k = self.frames[*self.by_name.get(name)? as usize].intrinsics;
        Some(self.shared.lens.intrinsics(&k))
    }

    /// What the pictures say that the given lens lacks, in its normalised coordinates: none where it is calibrated, or where they
    /// cannot tell.
    pub fn distortion(&self) -> Distortion {
        self.shared.lens.radial.distortion()
    }

    /// Depths between which 98 % of the key frame's points lie, widened by 15 %, metres along the optical axis;
    /// `None` with too few points.
    pub fn depth_range(&self, name: &str) -> Option<(f32, f32)> {
        let (near, far) = self.frames[*self.by_name.get(name)? as usize].known.depths?;
        Some((near / 1.15, far * 1.15))
    }

    /// Points of the last [`Refiner::solve`].
    pub fn sparse_points(&self) -> &[RefinedPoint] {
        &self.points
    }

    /// Points of the key frames that the last [`Refiner::solve_near`] placed; none after a [`Refiner::solve`].
    pub fn recent_points(&self) -> &[RefinedPoint] {
        &self.recent
    }

    /// Telemetry pose of any other picture of the same flight, with the shared errors taken out; `velocity` in
    /// m/s, zero when unknown.
    pub fn correct(&self, telemetry: &Pose, velocity: DVec3) -> Pose {
        solving::corrected(telemetry, velocity, &self.shared)
    }

    /// Bytes held for key frames, tracks and points.
    pub fn bytes(&self) -> usize {
        let frames: usize = self.frames.iter().map(KeyFrame::bytes).sum();
        frames
            + self.union.bytes()
            + std::mem::size_of_val(self.points.as_slice())
            + std::mem::size_of_val(self.pairs.as_slice())
    }

    fn expect(&self, telemetry: &Pose) -> Pose {
        self.correct(telemetry, DVec3::ZERO)
    }

    fn counts(&self) -> RefineReport {
        let linked = self.frames.iter().filter(|f| f.pairs > 0).count();
        RefineReport { frames: self.frames.len(), frames_linked: linked, ..self.totals.clone() }
    }
}
