//! A second look at every pair, once all pictures are there and have poses. The first look takes pictures as they come, with
//! telemetry as the guide: one whose heading is wrong is linked to its neighbour alone, if at all, and its features are those of
//! a picture that lies on its side. On brighton_beach's card, where six of 18 are turned around, that left a line of forest hanging
//! by a few matches, one picture of it 25 m off.

use std::borrow::Cow;

use super::keyframe::KeyFrame;
use super::level::HEIGHT;
use super::linking::LINKED_SIGMA;
use super::tracks::Union;
use super::{AddReport, RefineError, RefineReport, Refiner, upright};

/// How far a chain of pictures without positions may have bent, a tenth of its height.
const BENT: f64 = 0.1 * HEIGHT;
/// Positions that the adjustment moved further than this from telemetry's are searched for as if they were not known,
/// standard deviations.
const DOUBT: f64 = 3.0;

impl Refiner {
    /// Links all key frames anew from the poses of the last [`Refiner::solve`], every picture upright by those poses. For use
    /// between two solves, when no more pictures come; takes as long as matching did, and features are extracted again where
    /// a picture was turned.
    ///
    /// # Errors
    /// The network failed.
    pub fn relink(&mut self) -> Result<AddReport, RefineError> {
        let mut report = AddReport::default();
        if self.solves == 0 {
            return Ok(report);
        }
        // What is doubted now may go back to where telemetry had it.
        self.anchored = false;
        if self.floating {
            self.reach_untied();
        }
        self.extract_upright(&mut report)?;
        for frame in &mut self.frames {
            doubt(frame);
            if self.floating {
                frame.position_sigma = frame.position_sigma.max(BENT);
            }
        }
        self.link_anew(&mut report);
        Ok(report)
    }

    /// Forgets all pairs and links every key frame to those before it that should see the same ground.
    pub(super) fn link_anew(&mut self, report: &mut AddReport) {
        self.union = Union::with_capacity(self.settings.max_keyframes * self.settings.max_features);
        self.pairs.clear();
        self.solved_pairs = 0;
        for (i, frame) in self.frames.iter_mut().enumerate() {
            frame.first_node = self.union.grow(i as u32, frame.seen.len());
            frame.pairs = 0;
            frame.settled.fill(false);
        }
        // The pairs of the first look are gone, and so is their part in the counts.
        let RefineReport { extract_seconds, match_seconds, frames_invalid, frames_over_cap, .. } = self.totals;
        self.totals =
            RefineReport { extract_seconds, match_seconds, frames_invalid, frames_over_cap, ..Default::default() };
        let clock = std::time::Instant::now();
        let unplaced: Vec<bool> = self.frames.iter().map(|f| f.unplaced).collect();
        for b in (1..self.frames.len()).filter(|b| !unplaced[*b]) {
            let verified = report.pairs_verified;
            let candidates = self.candidates(&self.camera_of(&self.frames[b]), &self.frames[b].intrinsics, b);
            report.pairs_verified = 0;
            self.link_guided(b, &candidates, report);
            report.pairs_verified += verified;
        }
        report.match_seconds = clock.elapsed().as_secs_f64();
        self.totals.absorb(report);
    }

    /// Extracts features anew where a picture was not turned as the others are.
    fn extract_upright(&mut self, report: &mut AddReport) -> Result<(), RefineError> {
        if self.networks.is_none() {
            return Ok(());
        }
        let Some(first) = self.frames.iter().position(|f| f.tied) else { return Ok(()) };
        let reference = (self.camera_of(&self.frames[first]), self.frames[first].turns);
        for i in 0..self.frames.len() {
            let frame = &self.frames[i];
            let camera = self.camera_of(frame);
            let turns =
                upright::turns_like(&reference.0, reference.1, &camera, &frame.intrinsics, self.ground_at(first));
            if turns != frame.turns {
                self.extract_turned(i, turns, report)?;
            }
        }
        Ok(())
    }

    /// Extracts the features of a frame anew, its picture turned, where it was kept.
    pub(super) fn extract_turned(&mut self, i: usize, turns: u8, report: &mut AddReport) -> Result<(), RefineError> {
        let size = (self.frames[i].intrinsics.width, self.frames[i].intrinsics.height);
        let Some(grey) = self.frames[i].grey().map(Cow::into_owned) else { return Ok(()) };
        let features = self.extract(&grey.picture(), size, turns, Some(&grey), report)?;
        let file = self.file.clone();
        let (lens, max) = (self.shared.lens, self.settings.max_features);
        let frame = &mut self.frames[i];
        let (before, colors) = (std::mem::take(&mut frame.seen), std::mem::take(&mut frame.colors));
        frame.describe(features, turns, max, &lens, file.as_ref());
        // Colours are no longer there; that of the nearest key point is.
        let nearest = |p: &[f32; 2]| {
            let apart = |q: &[f32; 2]| (q[0] - p[0]).hypot(q[1] - p[1]);
            let place = (0..before.len()).min_by(|a, b| apart(&before[*a]).total_cmp(&apart(&before[*b])));
            place.map_or([128; 3], |k| colors[k])
        };
        frame.colors = frame.seen.iter().map(nearest).collect();
        Ok(())
    }
}

/// How far off the frame may be: where pictures and telemetry disagree, either may be wrong.
fn doubt(frame: &mut KeyFrame) {
    let away = (frame.pose.center - frame.prior.center).abs();
    let sigma = frame.sigma.position_m.map(f64::from);
    let disagree = (0..3).any(|k| away[k] > DOUBT * sigma[k]);
    frame.rotation_sigma = LINKED_SIGMA;
    if !frame.tied || disagree {
        let widest = sigma.iter().fold(0.0f64, |a, b| a.max(*b));
        frame.position_sigma = widest.max(away.length() / 2.0).min(30.0);
        frame.pose.center = frame.prior.center;
        frame.adjusted = false;
    }
}
