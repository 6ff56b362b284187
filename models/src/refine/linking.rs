//! A new key frame is linked to those before it: candidates by predicted overlap, guided matches, a verified
//! relative pose, and what that says about the new frame's rotation.

use super::keyframe::KeyFrame;
use super::matching::{Guide, Match, MatchLimits, match_frames};
use super::overlap::{Ground, overlap, predict, search_radius};
use super::photometric::{Side, align_patch, align_patch_at};
use super::so3;
use super::triangulate::triangulate;
use super::twoview::{ROUNDS, RayPair, RelativePose, TwoView, TwoViewLimits, verify};
use super::{AddReport, Refiner};
use crate::camera::{Pinhole, Pose};
use glam::{DQuat, DVec3};
use rayon::prelude::*;

/// A verified pair.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Pair {
    pub a: u32,
    pub b: u32,
    pub pose: RelativePose,
    pub rotation_only: bool,
}

/// What frame `a` and another one seem to have in common.
pub(super) struct Proposal {
    pub a: usize,
    /// Where the other one stood, by what they have in common.
    pub cb: Pinhole,
    /// What lies where a match is seen; where it is not a plane, the two rays of a match tell.
    pub ground: Option<Ground>,
    pub matches: Vec<Match>,
    pub found: TwoView,
}

/// Believed rotation error of a frame once it is linked to others, and once it is adjusted, radians: the drift
/// within a strip of linked frames, and what remains after bundle adjustment with a margin.
pub(crate) const LINKED_SIGMA: f64 = 0.03;
/// See [`LINKED_SIGMA`].
pub(crate) const ADJUSTED_SIGMA: f64 = 0.006;
/// Error of the rotation that one pair implies: on flat ground a tilt looks much like a shift.
const PAIR_SIGMA: f64 = 0.03;
/// Difference between telemetry and pictures that no noise explains, radians.
const CONTRADICTION: f64 = 0.35;
/// A key point that one pair has settled must fit a later pair to within this, pixels.
const SETTLED_PX: f32 = 1.5;
/// Candidates tried without any guidance when guided search links nothing.
const WIDE_TRIES: usize = 3;
/// Key points of the first pass; its cost grows with their square.
const COARSE_FEATURES: usize = 500;
/// Tilt that a wrong heading comes with at most, radians: gimbals know the vertical.
const WIDE_TILT: f64 = 0.12;
/// Pair heights kept for the first idea of the ground, until an adjustment gives a better one.
const PAIR_GROUNDS: usize = 15;

impl Refiner {
    pub(super) fn camera_of(&self, frame: &KeyFrame) -> Pinhole {
        self.shared.lens.camera(frame.pose, &frame.intrinsics)
    }

    /// Ground under `frame`, as far as known.
    pub(super) fn ground_at(&self, frame: usize) -> Ground {
        Ground(self.grounds[frame].or(self.ground))
    }

    /// Frames before number `before` that should see the same ground as the camera, best overlap first.
    pub(super) fn candidates(&self, camera: &Pinhole, lens: &crate::camera::Intrinsics, before: usize) -> Vec<u32> {
        let mut found: Vec<(f64, u32)> = self
            .frames
            .iter()
            .take(before)
            .enumerate()
            .filter(|(_, f)| !f.unplaced)
            .map(|(i, f)| (overlap((&self.camera_of(f), &f.intrinsics), (camera, lens), self.ground_at(i)), i as u32))
            .filter(|(share, _)| *share >= self.settings.min_overlap)
            .collect();
        // Among equals the newest: its pose error has most in common with the new frame's.
        found.sort_by(|x, y| y.0.total_cmp(&x.0).then(y.1.cmp(&x.1)));
        found.into_iter().map(|(_, i)| i).collect()
    }

    /// Links frame `b` to `candidates` by guided search; stops at the wanted number of pairs.
    pub(super) fn link_guided(&mut self, b: usize, candidates: &[u32], report: &mut AddReport) {
        let mut waiting = &candidates[..candidates.len().min(2 * self.settings.max_pairs)];
        while !waiting.is_empty() && report.pairs_verified < self.settings.max_pairs {
            let wanted = self.settings.max_pairs - report.pairs_verified;
            // Until an adjustment has placed the frame each pair tells where the next one is to be looked for; and what nothing but its
            // pairs holds together bends.
            let placed = self.frames[b].adjusted && !self.standing.floating;
            let at_once = if placed { wanted.min(waiting.len()) } else { 1 };
            let (now, later) = waiting.split_at(at_once);
            // Before anything is known of the ground a prediction is worthless.
            let guided = |a: u32| self.ground.is_some() || self.grounds[a as usize].is_some();
            let pairs: Vec<(usize, bool)> = now.iter().map(|a| (*a as usize, guided(*a))).collect();
            self.try_pairs(&pairs, b, false, report);
            waiting = later;
        }
    }

    /// Links the newest frame without trusting any pose: for telemetry that is badly wrong.
    pub(super) fn link_wide(&mut self, candidates: &[u32], report: &mut AddReport) {
        let b = self.frames.len() - 1;
        for a in candidates.iter().take(WIDE_TRIES) {
            self.try_pairs(&[(*a as usize, false)], b, true, report);
        }
    }

    /// Frame `b` against others, each guided by what is known or not. All are compared at once, and what they propose is taken in
    /// their order, so that it does not matter how many processors there are.
    pub(super) fn try_pairs(&mut self, pairs: &[(usize, bool)], b: usize, any_heading: bool, report: &mut AddReport) {
        let this = &*self;
        let proposals: Vec<_> = pairs.par_iter().map(|(a, guided)| this.propose(*a, b, *guided, any_heading)).collect();
        for (matches, proposal) in proposals {
            report.pairs_tried += 1;
            report.matches += matches;
            if let Some(proposal) = proposal {
                let (a, matches, found) = self.settle(b, proposal);
                report.unsettled += matches.len() - found.inliers.len();
                if found.inliers.len() >= self.settings.min_inliers / 2 {
                    self.accept(a, b, &matches, &found, report);
                }
            }
        }
    }

    /// How many key points match, and a relative pose that enough of them agree on, if any. Two passes: the best key points, guided by
    /// telemetry, give a relative pose; that pose then guides all of them along their epipolar lines.
    fn propose(&self, a: usize, b: usize, guided: bool, any_heading: bool) -> (usize, Option<Proposal>) {
        let (matches, coarse) = self.coarse(a, b, guided, any_heading);
        let Some(coarse) = coarse else { return (matches, None) };
        let (fa, fb) = (&self.frames[a], &self.frames[b]);
        let ca = self.camera_of(fa);
        let ground = self.ground_at(a);
        let baseline = (fa.pose.center - fb.pose.center).length();
        let (first, limits) = self.limits(a, b, any_heading);
        // Where b must have stood for that relative pose, at the length of the GPS baseline.
        let length = if coarse.rotation_only { 0.0 } else { baseline };
        let rotation = (fa.pose.rotation * coarse.pose.rotation.conjugate()).normalize();
        let center = fa.pose.center - rotation * coarse.pose.translation * length;
        let cb = self.shared.lens.camera(Pose { rotation, center }, &fb.intrinsics);
        let predicted: Vec<_> = fb.keypoints().iter().map(|p| predict(&cb, &ca, ground, *p)).collect();
        let unguided = vec![Some(ca.c); fb.keypoints().len()];
        let known = ground.0.is_some() && !any_heading;
        let radius = if known { search_radius(&ca, &cb, ADJUSTED_SIGMA, 0.1 * length, ground) } else { f64::INFINITY };
        let lines = epipolar_lines(&coarse.pose, &ca, &cb, fb.keypoints());
        let guide = Guide {
            predicted: if known { &predicted } else { &unguided },
            radius,
            lines: (!coarse.rotation_only).then_some((&lines, 2.0 * self.settings.epipolar_px)),
        };
        let matches = match_frames(fa, fb, &guide, MatchLimits { features: usize::MAX, ..first });
        let limits = TwoViewLimits { any_heading: false, rounds: 0, ..limits };
        // The telemetry's weight is in the coarse pose already; its own error is what matters now.
        let fine = TwoViewLimits { rotation_sigma: 0.05, direction_sigma: 0.3, ..limits };
        let found = verify(&rays(&self.frames, (a, &ca), (b, &cb), &matches), coarse.pose, fine);
        (matches.len(), found.map(|found| Proposal { a, cb, ground: Some(ground), matches, found }))
    }

    /// What may match between two frames, and what a relative pose of them must keep to.
    fn limits(&self, a: usize, b: usize, any_heading: bool) -> (MatchLimits, TwoViewLimits) {
        let (fa, fb) = (&self.frames[a], &self.frames[b]);
        let (ca, cb) = (self.camera_of(fa), self.camera_of(fb));
        let position_sigma = fa.position_sigma.hypot(fb.position_sigma);
        let baseline = (fa.pose.center - fb.pose.center).length();
        let matches = MatchLimits {
            min_cosine: self.settings.min_cosine,
            cosine_margin: self.settings.cosine_margin,
            features: COARSE_FEATURES,
        };
        let pose = TwoViewLimits {
            threshold: self.settings.epipolar_px / ca.f.min_element().min(cb.f.min_element()),
            min_inliers: self.settings.min_inliers * if any_heading { 2 } else { 1 },
            any_heading,
            rotation_sigma: if any_heading { WIDE_TILT } else { fa.rotation_sigma.hypot(fb.rotation_sigma) },
            direction_sigma: if any_heading { 2.0 } else { (position_sigma / baseline.max(1e-6)).min(2.0) },
            rounds: ROUNDS,
        };
        (matches, pose)
    }

    /// The first pass: how many of the best key points match, and what relative pose they agree on, if any.
    pub(super) fn coarse(&self, a: usize, b: usize, guided: bool, any_heading: bool) -> (usize, Option<TwoView>) {
        let (fa, fb) = (&self.frames[a], &self.frames[b]);
        let (ca, cb) = (self.camera_of(fa), self.camera_of(fb));
        let ground = self.ground_at(a);
        let rotation_sigma = fa.rotation_sigma.hypot(fb.rotation_sigma);
        let position_sigma = fa.position_sigma.hypot(fb.position_sigma);
        let predicted: Vec<_> = match guided {
            true => fb.keypoints().iter().map(|p| predict(&cb, &ca, ground, *p)).collect(),
            false => vec![Some(ca.c); fb.keypoints().len()],
        };
        let radius =
            if guided { search_radius(&ca, &cb, rotation_sigma, position_sigma, ground) } else { f64::INFINITY };
        let (first, limits) = self.limits(a, b, any_heading);
        let matches = match_frames(fa, fb, &Guide { predicted: &predicted, radius, lines: None }, first);
        let to_b = fb.pose.rotation.conjugate();
        let prior =
            RelativePose { rotation: to_b * fa.pose.rotation, translation: to_b * (fa.pose.center - fb.pose.center) };
        (matches.len(), verify(&rays(&self.frames, (a, &ca), (b, &cb), &matches), prior, limits))
    }

    /// Drops inliers whose surroundings differ and moves the others' key points in `b` to where the pictures agree.
    /// A key point that an earlier pair has moved stays, so that a track has one place in every picture.
    pub(super) fn settle(&mut self, b: usize, proposal: Proposal) -> (usize, Vec<Match>, TwoView) {
        let Proposal { a, cb, ground, matches, mut found } = proposal;
        let (fa, fb) = (&self.frames[a], &self.frames[b]);
        let (Some(ga), Some(gb)) = (fa.grey(), fb.grey()) else { return (a, matches, found) };
        let ca = self.camera_of(fa);
        let places: Vec<Option<[f32; 2]>> = found
            .inliers
            .par_iter()
            .with_min_len(32)
            .map(|i| {
                let m = matches[*i as usize];
                let from = Side { grey: &ga, camera: &ca, at: fa.seen[m.a as usize] };
                let to = Side { grey: &gb, camera: &cb, at: fb.seen[m.b as usize] };
                let Some(ground) = ground else {
                    let views = [(ca, fa.keypoints()[m.a as usize]), (cb, fb.keypoints()[m.b as usize])];
                    return align_patch_at(&from, &to, triangulate(&views, 0.0)?.world);
                };
                align_patch(&from, &to, ground)
            })
            .collect();
        let inliers = std::mem::take(&mut found.inliers);
        let (lens, radial) = (self.camera_of(fb), self.shared.lens.radial);
        let frame = &mut self.frames[b];
        for (i, place) in inliers.into_iter().zip(places) {
            let Some(place) = place else { continue };
            let k = matches[i as usize].b as usize;
            let apart = (place[0] - frame.seen[k][0]).hypot(place[1] - frame.seen[k][1]);
            if frame.settled[k] && apart > SETTLED_PX {
                continue;
            }
            if !frame.settled[k] {
                frame.seen[k] = place;
                if let Some(straight) = frame.straight.get_mut(k) {
                    *straight = radial.undistorted(&lens, place);
                }
                frame.settled[k] = true;
            }
            found.inliers.push(i);
        }
        (a, matches, found)
    }

    fn accept(&mut self, a: usize, b: usize, matches: &[Match], found: &TwoView, report: &mut AddReport) {
        report.pairs_verified += 1;
        report.inliers += found.inliers.len();
        report.pairs_without_baseline += usize::from(found.rotation_only);
        let (first_a, first_b) = (self.frames[a].first_node, self.frames[b].first_node);
        for i in &found.inliers {
            let m = matches[*i as usize];
            report.conflicting += usize::from(!self.union.join(first_a + m.a, first_b + m.b));
        }
        // Bounded by the caps on key frames and on pairs (guided and wide) per key frame.
        self.pairs.push(Pair { a: a as u32, b: b as u32, pose: found.pose, rotation_only: found.rotation_only });
        // The new frame's rotation: telemetry and what its pairs say, each with its weight; but a heading that the
        // pictures contradict has no say.
        let implied = (self.frames[a].pose.rotation * found.pose.rotation.conjugate()).normalize();
        let frame = &mut self.frames[b];
        let away = so3::log(frame.pose.rotation.conjugate() * implied);
        let (own, pair) = (frame.rotation_sigma.powi(-2), PAIR_SIGMA.powi(-2));
        let contradicted = frame.pairs == 0 && away.length() > CONTRADICTION;
        report.contradicted |= contradicted;
        let gain = match contradicted {
            true => 1.0,
            // The adjustment knows better than any single pair.
            false if frame.adjusted => 0.0,
            false => pair / (pair + own),
        };
        frame.pose.rotation = (frame.pose.rotation * so3::exp(away * gain)).normalize();
        frame.pairs += 1;
        frame.rotation_sigma = frame.rotation_sigma.min(LINKED_SIGMA);
        let other = &mut self.frames[a];
        other.pairs += 1;
        other.rotation_sigma = other.rotation_sigma.min(LINKED_SIGMA);
        if self.solves == 0 && !found.rotation_only {
            self.ground_from_pair(a, b, matches, found);
        }
    }

    /// Until the first adjustment the ground is the median height seen by the pairs so far, each at the length of
    /// its GPS baseline.
    fn ground_from_pair(&mut self, a: usize, b: usize, matches: &[Match], found: &TwoView) {
        let (fa, fb) = (&self.frames[a], &self.frames[b]);
        let baseline = (fa.pose.center - fb.pose.center).length();
        if baseline < fa.position_sigma.min(5.0) || self.pair_grounds.len() >= PAIR_GROUNDS {
            return;
        }
        let ca = self.camera_of(fa);
        let rotation: DQuat = (fa.pose.rotation * found.pose.rotation.conjugate()).normalize();
        let center = fa.pose.center - rotation * found.pose.translation * baseline;
        let cb = self.shared.lens.camera(Pose { rotation, center }, &fb.intrinsics);
        let mut heights: Vec<f64> = found
            .inliers
            .iter()
            .filter_map(|i| {
                let m = matches[*i as usize];
                let views = [(ca, fa.keypoints()[m.a as usize]), (cb, fb.keypoints()[m.b as usize])];
                triangulate(&views, self.settings.min_angle_deg.to_radians()).map(|t| t.world.z)
            })
            .collect();
        if heights.len() >= self.settings.min_inliers / 2 {
            self.pair_grounds.push(median(&mut heights));
            self.ground = Some(median(&mut self.pair_grounds.clone()));
        }
    }
}

pub(super) fn rays(frames: &[KeyFrame], a: (usize, &Pinhole), b: (usize, &Pinhole), matches: &[Match]) -> Vec<RayPair> {
    let ray = |(i, camera): (usize, &Pinhole), k: u32| camera.ray(frames[i].keypoints()[k as usize]);
    matches.iter().map(|m| RayPair { a: ray(a, m.a), b: ray(b, m.b) }).collect()
}

/// Lines in `a` on which the key points of `b` must lie: unit normal and offset, pixels.
pub(super) fn epipolar_lines(pose: &RelativePose, a: &Pinhole, b: &Pinhole, keypoints: &[[f32; 2]]) -> Vec<DVec3> {
    keypoints
        .iter()
        .map(|p| {
            // xᵦᵀ [t]× R xₐ = 0: the line of xₐ is Rᵀ (xᵦ × t), in ray units; pixels are c + f·ray.
            let n = pose.rotation.conjugate() * b.ray(*p).cross(pose.translation);
            let normal = n.truncate() / a.f;
            let line = normal.extend(n.z - normal.dot(a.c));
            line / normal.length().max(1e-300)
        })
        .collect()
}

/// Middle value; 0 of nothing. Reorders its argument.
pub(crate) fn median(values: &mut [f64]) -> f64 {
    if values.is_empty() {
        return 0.0;
    }
    let middle = values.len() / 2;
    *values.select_nth_unstable_by(middle, f64::total_cmp).1
}
