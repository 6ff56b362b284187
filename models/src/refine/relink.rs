//! A second look at every pair, once all pictures are there and have poses. The first look takes pictures as they come, with
//! telemetry as the guide: one whose heading is wrong is linked to its neighbour alone, if at all, and its features are those of
//! a picture that lies on its side. On brighton_beach's card, where six of 18 are turned around, that left a line of forest hanging
//! by a few matches, one picture of it 25 m off.

use std::borrow::Cow;

use super::keyframe::KeyFrame;
use super::level::HEIGHT;
use super::linking::LINKED_SIGMA;
use super::{AddReport, RefineError, RefineReport, Refiner, bootstrap, covisible, growth, joining, overview, upright};

/// How far a chain of pictures without positions may have bent, a tenth of its height.
const BENT: f64 = 0.1 * HEIGHT;
/// Tied pictures that one which nothing ties is compared with.
const AROUND: usize = 3;
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
        if self.standing.by_pictures {
            self.look_again(&mut report);
            return Ok(report);
        }
        for frame in self.frames.iter_mut().filter(|f| f.known.apart) {
            (frame.unplaced, frame.tied) = (false, false);
        }
        // What is doubted now may go back to where telemetry had it.
        self.standing.anchored = false;
        match self.standing.floating {
            true => bootstrap::reach_untied(self),
            false => self.turn_untied(&mut report)?,
        }
        self.extract_upright(&mut report)?;
        for frame in &mut self.frames {
            doubt(frame);
            if self.standing.floating {
                frame.position_sigma = frame.position_sigma.max(BENT);
            }
        }
        self.link_anew(&mut report);
        Ok(report)
    }

    /// Links all anew where the pictures alone say where they were taken.
    fn look_again(&mut self, report: &mut AddReport) {
        self.forget_counts();
        let clock = std::time::Instant::now();
        covisible::link_covisible(self, report);
        growth::grow_again(self);
        report.match_seconds = clock.elapsed().as_secs_f64();
        self.totals.absorb(report);
    }

    /// The pairs of an earlier look are gone, and so is their part in the counts.
    fn forget_counts(&mut self) {
        let RefineReport { extract_seconds, match_seconds, frames_invalid, frames_over_cap, .. } = self.totals;
        self.totals =
            RefineReport { extract_seconds, match_seconds, frames_invalid, frames_over_cap, ..Default::default() };
    }

    /// Forgets all pairs and links every key frame to those before it that should see the same ground.
    pub(super) fn link_anew(&mut self, report: &mut AddReport) {
        overview::forget_pairs(self);
        self.forget_counts();
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

    /// What nothing ties was linked to little, and that may have been chance: it is turned as the tied pictures that telemetry has
    /// around it want it. (One of 305 without attitudes had a single pair that was wrong by a quarter turn, and no second look ever
    /// compared it otherwise.)
    fn turn_untied(&mut self, report: &mut AddReport) -> Result<(), RefineError> {
        if self.networks.is_none() {
            return Ok(());
        }
        for i in (0..self.frames.len()).filter(|i| !self.frames[*i].tied).collect::<Vec<_>>() {
            let frame = &mut self.frames[i];
            frame.pose.rotation = (frame.prior.rotation * self.shared.mount).normalize();
            let frame = &self.frames[i];
            let camera = self.shared.lens.camera(self.expect(&frame.prior), &frame.intrinsics);
            let mut around = self.candidates(&camera, &frame.intrinsics, self.frames.len());
            around.retain(|j| self.frames[*j as usize].tied);
            let around: Vec<usize> = around.into_iter().take(AROUND).map(|j| j as usize).collect();
            if around.is_empty() {
                continue;
            }
            if let Some(turn) = joining::best_turn(self, i, &|_| around.clone(), report)? {
                self.frames[i].pose.rotation = turn.rotation;
            }
        }
        Ok(())
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

#[cfg(test)]
#[allow(clippy::unwrap_used)] // a test may
mod tests {
    use config::refine::RefineSettings;
    use glam::{DQuat, DVec3};
    use image::{Rgb, RgbImage};

    use super::*;
    use crate::camera::{Intrinsics, Pose, PoseSigma, PosedImage, View};

    /// Ground of random fields a metre across, from 40 m above (x, 0), north up: a pixel is 0.1 m.
    fn picture(x: f64) -> PosedImage {
        let value = |u: i32, v: i32| {
            let mixed = u.wrapping_mul(0x27D4_EB2D) ^ v.wrapping_mul(0x1656_67B1);
            (mixed.wrapping_mul(0x2C1B_3C6D) >> 15) as u8
        };
        let field = |p: f64| (p / 10.0).floor() as i32;
        let image =
            RgbImage::from_fn(400, 300, |u, v| Rgb([value(field(f64::from(u) + 10.0 * x), field(f64::from(v))); 3]));
        PosedImage {
            name: format!("{x}.jpg"),
            time_ns: (x * 1e8) as u64,
            image,
            mask: None,
            view: View {
                intrinsics: Intrinsics { width: 400, height: 300, fx: 400.0, fy: 400.0, cx: 200.0, cy: 150.0 },
                pose: Pose { rotation: DQuat::from_xyzw(1.0, 0.0, 0.0, 0.0), center: DVec3::new(x, 0.0, 40.0) },
            },
            // Without an attitude: down, somehow.
            sigma: PoseSigma { position_m: [1.0; 3], rotation_rad: [0.2, 0.2, 2.0] },
        }
    }

    #[test]
    fn a_picture_that_chance_linked_a_quarter_turn_off_is_turned_back_and_tied() {
        if crate::onnx::session::find_library().is_err() {
            return needs::missing(needs::Need::OnnxRuntime, "no ONNX Runtime");
        }
        let mut refiner = Refiner::open(&RefineSettings { solve_seconds: 120.0, ..RefineSettings::default() }).unwrap();
        for x in 0..7 {
            refiner.add(&picture(6.0 * f64::from(x))).unwrap();
        }
        assert_eq!(refiner.solve().unwrap().frames_tied, 7);
        // As a wrong pair leaves it.
        let frame = &mut refiner.frames[3];
        let told = frame.prior.rotation;
        (frame.tied, frame.pairs) = (false, 1);
        frame.pose.rotation *= DQuat::from_rotation_z(std::f64::consts::FRAC_PI_2);
        // And what it says of itself is as wrong.
        frame.prior.rotation = frame.pose.rotation;
        refiner.extract_turned(3, 1, &mut AddReport::default()).unwrap();
        refiner.relink().unwrap();
        let report = refiner.solve().unwrap();
        let off = refiner.frames[3].pose.rotation.angle_between(told).to_degrees();
        assert!(report.frames_tied == 7 && off < 1.0, "{} tied, {off}°", report.frames_tied);
    }
}
