//! How a key frame is taken in: what is refused, its features, and its first links.

use super::grey::Grey;
use super::keyframe::{Descriptors, KeyFrame, Known, Told};
use super::{AddReport, RefineError, Refiner, upright};
use crate::camera::{Pose, PoseSigma, PosedImage, View};
use crate::frame_file::Kept;
use crate::onnx::features::Features;
use glam::DVec3;
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

    /// Key points in pixels of a picture of `size`, of which `image` may be a smaller copy; those that `grey` leaves out are none.
    pub(super) fn extract(
        &mut self,
        image: &RgbImage,
        size: (u32, u32),
        turns: u8,
        grey: Option<&Grey>,
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
        if let Some(grey) = grey {
            features.retain(|p| grey.keeps(p));
        }
        report.extractions += 1;
        report.extract_seconds += clock.elapsed().as_secs_f64();
        Ok(features)
    }

    pub(super) fn insert(&mut self, name: &str, time_ns: u64, view: &View, sigma: &PoseSigma) {
        self.by_name.insert(name.to_owned(), self.frames.len() as u32);
        self.grounds.push(None);
        let mut frame = arrived(name, time_ns, view, sigma);
        frame.pose = self.expect(&frame.prior);
        frame.first_node = self.union.grow(0, 0);
        self.frames.push(frame);
    }

    /// Gives the newest frame its features (again, when a turn of the picture did not match).
    pub(super) fn set_features(
        &mut self,
        features: Features,
        turns: u8,
        picture: Option<&PosedImage>,
        report: &mut AddReport,
    ) {
        let newest = self.frames.len().saturating_sub(1) as u32;
        let lens = self.shared.lens;
        let Some(frame) = self.frames.last_mut() else { return };
        frame.describe(features, turns, self.settings.max_features, &lens, self.file.as_ref());
        let (first, count) = (frame.first_node, frame.seen.len());
        report.features = count;
        frame.colors = frame
            .seen
            .iter()
            .map(|p| match picture {
                Some(PosedImage { image, .. }) => {
                    image.get_pixel((p[0] as u32).min(image.width() - 1), (p[1] as u32).min(image.height() - 1)).0
                }
                None => [128; 3],
            })
            .collect();
        let grey = |p: &PosedImage| Grey::new(&p.image, p.mask.as_ref(), self.settings.feature_side);
        match (&mut frame.grey, picture) {
            // The same picture with other features.
            (Some(_), Some(_)) => {}
            (none, picture) => *none = picture.map(|p| Kept::at_best(grey(p), self.file.as_ref())),
        }
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

/// A key frame as it came, without key points; `view` as told, with one standard deviation.
pub(super) fn arrived(name: &str, time_ns: u64, view: &View, sigma: &PoseSigma) -> KeyFrame {
    let prior = Pose { rotation: view.pose.rotation.normalize(), ..view.pose };
    let largest = |v: [f32; 3], cap: f64| f64::from(v.iter().fold(0.0f32, |a, b| a.max(*b))).min(cap);
    KeyFrame {
        name: name.to_owned(),
        intrinsics: view.intrinsics,
        prior,
        told: Told { time_ns, pose: prior, sigma: *sigma },
        velocity: DVec3::ZERO,
        sigma: *sigma,
        pose: prior,
        // Beyond these, guided search is no guide any more.
        rotation_sigma: largest(sigma.rotation_rad, 0.5),
        position_sigma: largest(sigma.position_m, 30.0),
        rotation_refused: false,
        unplaced: false,
        adjusted: false,
        tied: false,
        turns: 0,
        pairs: 0,
        known: Known::default(),
        straight: Vec::new(),
        seen: Vec::new(),
        colors: Vec::new(),
        settled: Vec::new(),
        grey: None,
        descriptors: Kept::Memory(Descriptors::default()),
        first_node: 0,
    }
}

pub(super) fn invalid(name: &str, what: &'static str) -> RefineError {
    RefineError::Invalid { name: name.to_owned(), what }
}

#[cfg(test)]
#[allow(clippy::unwrap_used)] // a test may
mod tests {
    use config::refine::RefineSettings;
    use glam::DQuat;

    use super::*;
    use crate::camera::Intrinsics;
    use crate::mask::Mask;

    #[test]
    fn no_key_point_is_taken_from_what_a_mask_leaves_out() {
        if crate::onnx::session::find_library().is_err() {
            return needs::missing(needs::Need::OnnxRuntime, "no ONNX Runtime");
        }
        let cell = |x: u32, y: u32| (x / 9).wrapping_mul(0x9E37_79B9) ^ (y / 9).wrapping_mul(0x85EB_CA6B);
        let image =
            RgbImage::from_fn(320, 240, |x, y| image::Rgb([(cell(x, y).wrapping_mul(0xC2B2_AE35) >> 24) as u8; 3]));
        let mask = Mask::from_fn(320, 240, |x, y| x < 200 && y > 30);
        let view = View {
            intrinsics: Intrinsics { width: 320, height: 240, fx: 250.0, fy: 250.0, cx: 160.0, cy: 120.0 },
            pose: Pose { rotation: DQuat::from_xyzw(1.0, 0.0, 0.0, 0.0), center: DVec3::new(0.0, 0.0, 40.0) },
        };
        let sigma = PoseSigma { position_m: [3.0; 3], rotation_rad: [0.1; 3] };
        let found = |mask: Option<&Mask>| {
            let mut refiner = Refiner::open(&RefineSettings::default()).unwrap();
            let name = "a.jpg".to_owned();
            let image = image.clone();
            refiner.add(&PosedImage { name, time_ns: 0, image, mask: mask.cloned(), view, sigma }).unwrap();
            refiner.frames[0].seen.clone()
        };
        let outside = |p: &&[f32; 2]| !mask.keeps(p[0] as u32, p[1] as u32);
        let (all, kept) = (found(None), found(Some(&mask)));
        assert!(all.iter().filter(outside).count() > 50 && kept.len() > 50, "{} {}", all.len(), kept.len());
        assert_eq!(kept.iter().filter(outside).count(), 0);
    }
}
