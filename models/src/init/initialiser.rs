//! The order of work for posed pictures: keep them at the network's size, bound the depth, choose partners, make
//! depths, resolve conflicts, merge into the budget. Works while flying: pictures come one by one, poses may be
//! refined afterwards, and only depths whose geometry really changed are made again.

use std::collections::HashMap;
use std::fs::File;
use std::path::Path;
use std::sync::Arc;
use std::time::Instant;

use config::init::InitSettings;
use config::settings::SettingError;
use rayon::prelude::*;

use crate::camera::{DepthPrior, Pose, PosedImage, View};
use crate::frame_file::FrameFile;
use crate::light::Light;
use crate::onnx::features::{FeatureNetwork, Features};
use crate::onnx::manifest::{Contract, Poses};
use crate::onnx::network::{LazySession, Network};
use crate::onnx::picture::{center_crop, center_window, resized};
use crate::onnx::session::check_library;

use super::InitError;
use super::depth_frame::DepthFrame;
use super::pairs::{SkippedPairs, partners};
use super::posed::PosedPairs;
use super::range::DepthRange;
use super::report::{InitReport, Initialisation};
use super::unposed::{Appearance, PairNetwork};

mod assemble;
mod depths;
mod growth;
mod memory;
mod strips;
mod unposed_pairs;

pub use memory::most_frame_bytes;

/// Features per picture for the depth range.
const RANGE_FEATURES: usize = 600;
/// Longer side of the picture they are found in, pixels: to bound depths, a half of a pixel more does not matter.
const RANGE_SIDE: u32 = 320;
/// Features keep this far from what a mask leaves out, pixels: half a cell of the network's descriptors.
const MARGIN: f64 = 4.0;
/// Every how many pictures the depth range is measured again.
const RANGE_EVERY: usize = 5;
/// A depth is made again when its pictures' refined poses move it by more than this, pixels.
const STALE_PX: f32 = 0.7;
/// What a report calls the matching.
const MATCHING: &str = "semi-global-matching";
/// Finest voxels per Gaussian of the budget.
const VOXELS_PER_GAUSSIAN: usize = 4;

/// What makes depths of pictures: told the poses, or not.
#[derive(Debug)]
enum Pairs {
    Posed(PosedPairs),
    Unposed(Box<PairNetwork>),
}

impl Pairs {
    fn sources(&self) -> usize {
        match self {
            Self::Posed(n) => n.sources(),
            Self::Unposed(_) => 1,
        }
    }

    fn close(&mut self) {
        match self {
            Self::Posed(n) => n.close(),
            Self::Unposed(n) => n.close(),
        }
    }
}

/// A network at work, once it was run on blank pictures.
fn of_network(network: &Arc<Network>, settings: &InitSettings) -> Result<Pairs, InitError> {
    let size = (settings.max_side, settings.max_side * 3 / 4);
    LazySession::new(Arc::clone(network), settings.threads).check(size)?;
    Ok(match &network.manifest().pair {
        Some(pair) if pair.poses == Poses::None => {
            Pairs::Unposed(Box::new(PairNetwork::new(Arc::clone(network), pair.clone(), settings.threads)))
        }
        // The manifest was refused without its [pair] table.
        pair => {
            let views = pair.as_ref().map_or(2, |p| p.views);
            Pairs::Posed(PosedPairs::network(Arc::clone(network), views, settings.threads))
        }
    })
}

/// Posed pictures in, Gaussians out.
#[derive(Debug)]
pub struct Initialiser {
    settings: InitSettings,
    /// The user's own, where there is one.
    network: Option<Arc<Network>>,
    pairs: Pairs,
    features: Option<FeatureNetwork>,
    /// Of the last picture that was looked at, with its camera at the size that features were found in.
    last_features: Option<(usize, View, Features)>,
    frames: Vec<DepthFrame>,
    /// Where the frames are kept when not in memory.
    file: Option<Arc<FrameFile>>,
    range: DepthRange,
    /// Depth range of each picture, as [`Self::build`] found it.
    ranges: Vec<Option<[f32; 2]>>,
    /// What an unposed network says about each picture's Gaussians.
    appearance: Vec<Option<Appearance>>,
    report: InitReport,
    /// Number of each picture.
    by_name: HashMap<String, usize>,
    /// Pictures whose samples are in what was made last.
    fused: usize,
    /// The pictures' light, as measured last.
    light: Option<Light>,
}

impl Initialiser {
    /// By matching, or by a network of the user's own (a manifest of contract `pair`), which is compared with its manifest
    /// and run once on blank pictures of the largest size: a network that does not work is known before a flight.
    ///
    /// # Errors
    /// A setting, the manifest, the network's file or ONNX Runtime is bad. ONNX Runtime runs networks, and the features that bound
    /// depths where no range is given.
    pub fn open(settings: &InitSettings, manifest: Option<&Path>) -> Result<Self, InitError> {
        settings.check()?;
        if manifest.is_some() {
            check_library()?;
        }
        let network = manifest.map(|path| Network::read_as(path, Contract::Pair)).transpose()?.map(Arc::new);
        let pairs = match &network {
            None => Pairs::Posed(PosedPairs::matching(settings.threads)),
            Some(network) => of_network(network, settings)?,
        };
        let features = match settings.depth_m {
            Some(_) => None,
            None => Some(FeatureNetwork::open(None, settings.threads)?),
        };
        let report = InitReport {
            network: network.as_ref().map_or_else(|| MATCHING.to_owned(), |n| n.manifest().name.clone()),
            ..InitReport::default()
        };
        Ok(Self {
            settings: settings.clone(),
            network,
            pairs,
            features,
            last_features: None,
            frames: Vec::new(),
            file: None,
            range: DepthRange::default(),
            ranges: Vec::new(),
            appearance: Vec::new(),
            report,
            by_name: HashMap::new(),
            fused: 0,
            light: None,
        })
    }

    /// Keeps pictures and depths in `file`, which is empty, instead of in memory: bit for bit the same. Call it before the first
    /// picture; the file takes [`Self::frame_bytes_at`] for each.
    pub fn keep_frames_in(&mut self, file: File) {
        self.file = Some(FrameFile::new(file));
    }

    /// Other settings for the next [`Self::build`]; depths made so far are kept (they depend on `stride`, `depth_m` and the
    /// pairing only). For ablations and for retries with a smaller budget.
    ///
    /// # Errors
    /// A setting is out of range, or `stride` differs after depths were made.
    pub fn reconfigure(&mut self, settings: &InitSettings) -> Result<(), InitError> {
        settings.check()?;
        if settings.stride != self.settings.stride && self.frames.iter().any(DepthFrame::has_depth) {
            let wanted = "as it was when depths were made";
            return Err(SettingError::new("stride", &settings.stride, wanted).into());
        }
        self.settings = settings.clone();
        Ok(())
    }

    /// The size at which pictures of this one are compared.
    fn network_size(&self, (width, height): (u32, u32)) -> (u32, u32) {
        let shrink = (f64::from(self.settings.max_side) / f64::from(width.max(height))).min(1.0);
        let fit = |side: u32| ((f64::from(side) * shrink).round() as u32).max(1);
        let (width, height) = (fit(width), fit(height));
        self.network.as_ref().map_or((width, height), |network| network.manifest().input_size(width, height))
    }

    /// Takes a picture in; its pixels are copied at the network's size.
    ///
    /// # Errors
    /// More pictures than planned, a picture whose size is not its camera's, or features failing.
    pub fn add(&mut self, picture: &PosedImage) -> Result<(), InitError> {
        let started = Instant::now();
        if self.frames.len() >= self.settings.max_pictures {
            return Err(InitError::TooMany { limit: self.settings.max_pictures });
        }
        let k = &picture.view.intrinsics;
        if (k.width, k.height) != picture.image.dimensions() || k.width < 8 || k.height < 8 {
            return Err(InitError::Picture {
                name: picture.name.clone(),
                reason: "its size is not its camera's, or below 8 pixels",
            });
        }
        let p = &picture.view.pose;
        if !(p.center.is_finite() && p.rotation.is_finite() && p.rotation.length_squared() > 1e-12) {
            return Err(InitError::Picture { name: picture.name.clone(), reason: "its pose is not finite" });
        }
        let (w, h) = self.network_size((k.width, k.height));
        let (image, intrinsics) = match &self.pairs {
            Pairs::Posed(_) => (resized(&picture.image, w, h), k.resized(w, h)),
            // What knows no intrinsics was trained on square pixels: crop to its shape, never stretch.
            Pairs::Unposed(_) => center_crop(&picture.image, k, w, h),
        };
        let mask = picture.mask.as_ref().map(|mask| match &self.pairs {
            Pairs::Posed(_) => mask.resized(w, h),
            Pairs::Unposed(_) => {
                let (x, y, width, height) = center_window(mask.dimensions(), (w, h));
                mask.window(x, y, width, height).resized(w, h)
            }
        });
        let view = View { intrinsics, pose: picture.view.pose };
        self.by_name.insert(picture.name.clone(), self.frames.len());
        self.frames.push(DepthFrame::new(picture.name.clone(), image, view, self.file.as_ref())?.masked(mask));
        self.report.pictures = self.frames.len();
        self.report.times.add_ms += started.elapsed().as_secs_f64() * 1e3;
        self.measure_range()
    }

    /// Replaces the pose of a picture after refinement; unknown names are ignored (their picture was no key frame).
    pub fn update_pose(&mut self, name: &str, pose: &Pose) {
        if let Some(i) = self.by_name.get(name) {
            self.frames[*i].view.pose = *pose;
        }
    }

    /// Adds points of the scene known from elsewhere (refinement's tracks) to bound the depths.
    pub fn hint_points(&mut self, points: impl IntoIterator<Item = [f32; 3]>) {
        points.into_iter().for_each(|p| self.range.push(p.into()));
    }

    /// While pictures still come: makes the depths of up to `most` pictures that have neighbours on both sides; returns
    /// how many those were.
    ///
    /// # Errors
    /// The network fails.
    pub fn advance(&mut self, most: usize) -> Result<usize, InitError> {
        if matches!(self.pairs, Pairs::Unposed(_)) {
            return Ok(0);
        }
        // Ranges of an earlier build know less than what has been measured since.
        self.ranges.clear();
        let next = (0..self.frames.len().saturating_sub(1)).filter(|&i| self.frames[i].made_as.is_none());
        let ready: Vec<usize> = next.take_while(|&i| self.depth_range(i).is_some()).take(most).collect();
        self.make_depths(&ready)?;
        Ok(ready.len())
    }

    /// All pictures so far into at most `max_gaussians` Gaussians; `prior` takes D_est of each picture that has a depth (depth ×
    /// confidence of the same network pass), at the grid's resolution. May be called again after more pictures.
    ///
    /// # Errors
    /// The network or the frames' file fails; no depth range can be found; no picture has a partner.
    pub fn build(
        &mut self,
        max_gaussians: usize,
        prior: &mut dyn FnMut(&str, DepthPrior),
    ) -> Result<Initialisation, InitError> {
        let started = Instant::now();
        if let Some(features) = &mut self.features {
            features.close();
        }
        let views: Vec<View> = self.frames.iter().map(|f| f.view).collect();
        self.ranges = views.par_iter().map(|v| self.settings.depth_m.or_else(|| self.range.of(v))).collect();
        let this = &*self;
        let skipped = (0..views.len()).into_par_iter().map(|i| {
            let mut skipped = SkippedPairs::default();
            if let Some(depth) = this.typical_depth(i) {
                partners((i, &views[i]), &views, depth, &this.settings, &mut skipped);
            }
            skipped
        });
        self.report.skipped = skipped.reduce(SkippedPairs::default, SkippedPairs::plus);
        match self.pairs {
            Pairs::Posed(_) => {
                let this = &*self;
                let stale: Vec<usize> = (0..views.len()).into_par_iter().filter(|&i| this.is_stale(i)).collect();
                self.make_depths(&stale)?;
            }
            Pairs::Unposed(_) => self.align_pairs(&views)?,
        }
        self.pairs.close();
        self.report.times.depth_ms += started.elapsed().as_secs_f64() * 1e3;
        if !self.frames.iter().any(DepthFrame::has_depth) {
            return Err(InitError::NoDepth { pictures: self.frames.len(), skipped: self.report.skipped.total() });
        }
        self.light = match self.settings.light {
            true => self.measure_light()?,
            false => None,
        };
        self.fused = self.frames.len();
        let all: Vec<usize> = (0..self.frames.len()).collect();
        self.assemble(&all, max_gaussians, prior)
    }

    fn measure_range(&mut self) -> Result<(), InitError> {
        let started = Instant::now();
        let i = self.frames.len() - 1;
        // Two pictures in a row out of every few; all until there are enough.
        let wanted = i % RANGE_EVERY < 2 || self.range.of(&self.frames[i].view).is_none();
        let Some(network) = self.features.as_mut().filter(|_| wanted) else { return Ok(()) };
        let (frame, image) = (&self.frames[i], self.frames[i].image()?);
        let (w, h) = image.dimensions();
        let shrink = (f64::from(RANGE_SIDE) / f64::from(w.max(h))).min(1.0);
        let fit = |side: u32| ((f64::from(side) * shrink).round() as u32).max(1);
        let view = View { intrinsics: frame.view.intrinsics.resized(fit(w), fit(h)), pose: frame.view.pose };
        let mut found = network.extract(&resized(&image, fit(w), fit(h)), RANGE_FEATURES)?;
        if let Some(mask) = frame.mask() {
            let larger = f64::from(w) / f64::from(fit(w));
            found.retain(|p| mask.keeps_around(p.map(|v| f64::from(v) * larger), MARGIN * larger));
        }
        if let Some((j, previous_view, previous)) = &self.last_features
            && j + 1 == i
        {
            self.range.measure((previous_view, previous), (&view, &found));
        }
        self.last_features = Some((i, view, found));
        self.report.times.features_ms += started.elapsed().as_secs_f64() * 1e3;
        Ok(())
    }

    fn depth_range(&self, i: usize) -> Option<[f32; 2]> {
        self.settings.depth_m.or_else(|| self.range.of(&self.frames[i].view))
    }

    /// As [`Self::build`] found it; before the first build, as it is now.
    fn known_range(&self, i: usize) -> Option<[f32; 2]> {
        self.ranges.get(i).copied().unwrap_or_else(|| self.depth_range(i))
    }

    fn typical_depth(&self, i: usize) -> Option<f64> {
        self.known_range(i).map(middle)
    }

    fn sources_of(&self, i: usize, depth: f64) -> Vec<(usize, f64)> {
        let mut best = partners(
            (i, &self.frames[i].view),
            self.frames.iter().map(|f| &f.view),
            depth,
            &self.settings,
            &mut SkippedPairs::default(),
        );
        best.truncate(self.pairs.sources());
        best
    }
}

/// The harmonic mean of a depth range: what half-way means in disparity.
fn middle([near, far]: [f32; 2]) -> f64 {
    2.0 / (1.0 / f64::from(near) + 1.0 / f64::from(far))
}
