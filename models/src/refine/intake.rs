//! How a key frame is taken in: what is refused, its features, and its first links.

use super::grey::Grey;
use super::keyframe::KeyFrame;
use super::{AddReport, RefineError, Refiner, upright};
use crate::camera::{Pose, PoseSigma, View};
use crate::onnx::features::Features;
use image::RgbImage;
use std::time::Instant;

impl Refiner {
    pub(super) fn check(&mut self, name: &str, view: &View, sigma: &PoseSigma) -> Result<(), RefineError> {
        let k = &view.intrinsics;
        let q = view.pose.rotation;
        let what = if !(view.pose.center.is_finite() && q.is_finite()) {
            "pose is not a number"
        } else if (q.length() - 1.0).abs() > 1e-3 {
            "rotation is not a unit quaternion"
        } else if !sigma.position_m.iter().chain(&sigma.rotation_rad).all(|s| *s > 0.0) {
            "sigma is not positive"
        } else if !(k.fx > 0.0
            && k.fy > 0.0
            && k.fx.is_finite()
            && k.fy.is_finite()
            && k.cx.is_finite()
            && k.cy.is_finite())
        {
            "lens is not a number"
        } else {
            ""
        };
        if !what.is_empty() {
            self.totals.frames_invalid += 1;
            return Err(invalid(name, what));
        }
        if self.by_name.contains_key(name) {
            return Err(RefineError::Duplicate(name.to_owned()));
        }
        if self.frames.len() >= self.settings.max_keyframes {
            self.totals.frames_over_cap += 1;
            return Err(RefineError::Full { name: name.to_owned(), max: self.settings.max_keyframes });
        }
        Ok(())
    }

    /// Key points in pixels of a picture of `size`, of which `image` may be a smaller copy.
    pub(super) fn extract(
        &mut self,
        image: &RgbImage,
        size: (u32, u32),
        turns: u8,
        report: &mut AddReport,
    ) -> Result<Features, RefineError> {
        let clock = Instant::now();
        let [level, sideways] = self.networks.as_mut().ok_or(RefineError::NoNetwork)?;
        let network = if turns.is_multiple_of(2) { level } else { sideways };
        let seen = upright::prepare(image, self.settings.feature_side, turns);
        let mut features = network.extract(&seen, 2 * self.settings.max_features)?;
        for p in &mut features.keypoints {
            *p = upright::restore(*p, seen.width(), seen.height(), turns, size);
        }
        report.extractions += 1;
        report.extract_seconds += clock.elapsed().as_secs_f64();
        Ok(features)
    }

    pub(super) fn insert(&mut self, name: &str, time_ns: u64, view: &View, sigma: &PoseSigma) {
        let prior = Pose { rotation: view.pose.rotation.normalize(), ..view.pose };
        let largest = |v: [f32; 3], cap: f64| f64::from(v.iter().fold(0.0f32, |a, b| a.max(*b))).min(cap);
        self.by_name.insert(name.to_owned(), self.frames.len() as u32);
        self.grounds.push(None);
        self.frames.push(KeyFrame {
            name: name.to_owned(),
            time_ns,
            intrinsics: view.intrinsics,
            prior,
            sigma: *sigma,
            pose: self.expect(&prior),
            // Beyond these, guided search is no guide any more.
            rotation_sigma: largest(sigma.rotation_rad, 0.5),
            position_sigma: largest(sigma.position_m, 30.0),
            rotation_refused: false,
            adjusted: false,
            tied: false,
            turns: 0,
            pairs: 0,
            depths: None,
            keypoints: Vec::new(),
            seen: Vec::new(),
            colors: Vec::new(),
            settled: Vec::new(),
            grey: None,
            descriptors: Vec::new(),
            first_node: self.union.grow(0, 0),
        });
    }

    /// Gives the newest frame its features (again, when a turn of the picture did not match).
    pub(super) fn set_features(
        &mut self,
        features: Features,
        turns: u8,
        image: Option<&RgbImage>,
        report: &mut AddReport,
    ) {
        let newest = self.frames.len().saturating_sub(1) as u32;
        let (focal, radial) = (self.shared.log_focal.exp(), self.shared.radial);
        let Some(frame) = self.frames.last_mut() else { return };
        frame.describe(features, turns, self.settings.max_features, (focal, &radial));
        let (first, count) = (frame.first_node, frame.seen.len());
        report.features = count;
        frame.colors = frame
            .seen
            .iter()
            .map(|p| match image {
                Some(image) => {
                    image.get_pixel((p[0] as u32).min(image.width() - 1), (p[1] as u32).min(image.height() - 1)).0
                }
                None => [128; 3],
            })
            .collect();
        frame.grey = image.map(|image| Grey::new(image, self.settings.feature_side));
        self.union.shrink(first);
        self.union.grow(newest, count);
    }

    pub(super) fn link(&mut self, candidates: &[u32], report: &mut AddReport) {
        let clock = Instant::now();
        let newest = self.frames.len() - 1;
        self.link_guided(newest, candidates, report);
        if report.pairs_verified == 0 && self.frames.len() > 1 {
            // No overlap predicted may be a wrong prediction: the frames just before are worth a look.
            let newest = self.frames.len() as u32 - 1;
            let recent: Vec<u32> = (0..newest).rev().take(2).collect();
            self.link_wide(if candidates.is_empty() { &recent } else { candidates }, report);
        }
        report.match_seconds += clock.elapsed().as_secs_f64();
    }

    pub(super) fn finish(&mut self, report: AddReport) -> Result<AddReport, RefineError> {
        if report.contradicted {
            // Whose heading is wrong is settled at once, so that the next frame is guided by the majority.
            self.vote();
        }
        self.totals.absorb(&report);
        if let Some(f) = self.frames.last() {
            tracing::debug!(frame = %f.name, features = report.features, pairs = report.pairs_verified, "key frame linked");
        }
        Ok(report)
    }
}

pub(super) fn invalid(name: &str, what: &'static str) -> RefineError {
    RefineError::Invalid { name: name.to_owned(), what }
}
