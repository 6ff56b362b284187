//! A second look at a scene that the pictures alone have placed: which pictures see the same points decides what is compared, their
//! poses where each match has to lie, and the pictures themselves where exactly. Nothing here takes the scene for a plane.

use std::collections::HashMap;

use glam::DVec3;
use rayon::prelude::*;

use super::linking::{Pair, Proposal, epipolar_lines, rays};
use super::matching::{Guide, MatchLimits, match_frames};
use super::tracks::Tracks;
use super::twoview::{RelativePose, TwoViewLimits, verify};
use super::{AddReport, Refiner, decoys, overview};
use crate::camera::{Pinhole, Pose};

/// Points of a picture that say which others see the same.
const ASKED: usize = 300;
/// Share of them that another must show to be compared with it.
const SHOWN: f64 = 0.1;
/// How far the relative pose of two adjusted pictures may be off: rotation, and direction of the baseline, radians.
const ADJUSTED: (f64, f64) = (0.03, 0.3);

/// Forgets all matches and finds them anew from the poses as they are: between pictures that see the same points, and those that
/// matched before.
pub(super) fn link_covisible(refiner: &mut Refiner, report: &mut AddReport) {
    let tracks = Tracks::build(&mut refiner.union, &refiner.frames, refiner.settings.max_observations);
    let wanted = covisible(refiner, &tracks);
    let before: HashMap<(u32, u32), Pair> =
        std::mem::take(&mut refiner.pairs).into_iter().map(|p| ((p.a.min(p.b), p.a.max(p.b)), p)).collect();
    overview::forget_pairs(refiner);
    for b in 1..refiner.frames.len() as u32 {
        let mut others: Vec<(usize, u32)> = (0..b)
            .filter_map(|a| {
                let share = wanted.get(&(a, b)).copied().unwrap_or(0);
                (share > 0 || before.contains_key(&(a, b))).then_some((share, a))
            })
            .collect();
        others.sort_by_key(|(share, a)| (std::cmp::Reverse(*share), *a));
        others.truncate(2 * refiner.settings.max_pairs);
        let this = &*refiner;
        let proposals: Vec<_> =
            others.par_iter().map(|(_, a)| propose_again(this, *a, b, before.get(&(*a, b)))).collect();
        report.pairs_tried += proposals.len();
        for (matches, proposal) in proposals {
            report.matches += matches;
            let Some(proposal) = proposal else { continue };
            let (a, matches, found) = refiner.settle(b as usize, proposal);
            report.unsettled += matches.len() - found.inliers.len();
            if found.inliers.len() < refiner.settings.min_inliers / 2 {
                continue;
            }
            let joined = found.inliers.iter().map(|i| matches[*i as usize]);
            overview::join(
                refiner,
                Pair { a: a as u32, b, pose: found.pose, rotation_only: found.rotation_only },
                joined,
                report,
            );
        }
    }
}

/// How many points of one picture the other shows, of each two placed ones where that is a fair share.
fn covisible(refiner: &Refiner, tracks: &Tracks) -> HashMap<(u32, u32), usize> {
    let cameras = refiner.cameras();
    let every: Vec<u32> = (0..tracks.len() as u32).collect();
    let mut points: Vec<Vec<DVec3>> = vec![Vec::new(); refiner.frames.len()];
    for (point, seen) in refiner
        .placed(&cameras, tracks, &every, refiner.settings.outlier_px, |_| true)
        .into_iter()
        .filter_map(|p| p.found)
    {
        seen.iter().for_each(|s| points[s.frame as usize].push(point.world));
    }
    let shown = |from: usize, to: usize| -> f64 {
        let own = &points[from];
        let step = own.len().div_ceil(ASKED).max(1);
        let lens = &refiner.frames[to].intrinsics;
        let asked = own.iter().step_by(step);
        let inside = asked.clone().filter(|p| cameras[to].project(**p).is_some_and(|q| lens.contains(q))).count();
        inside as f64 / asked.count().max(1) as f64
    };
    let n = refiner.frames.len();
    let of = |b: usize| {
        let shares = (0..b).map(move |a| ((a as u32, b as u32), shown(a, b).min(shown(b, a))));
        let fair = shares.filter(|(_, share)| *share >= SHOWN);
        fair.map(|(pair, share)| (pair, (share * 1000.0) as usize)).collect::<Vec<_>>()
    };
    (0..n).into_par_iter().flat_map_iter(of).collect()
}

/// How many key points of two pictures match along the epipolar lines of their relative pose, and what most of them agree on: the
/// pose of the adjustment where both have one, else that of an earlier comparison.
fn propose_again(refiner: &Refiner, a: u32, b: u32, before: Option<&Pair>) -> (usize, Option<Proposal>) {
    let (a, b) = (a as usize, b as usize);
    let (fa, fb) = (&refiner.frames[a], &refiner.frames[b]);
    let ca = refiner.camera_of(fa);
    let settled = fa.tied && fb.tied && !fa.unplaced && !fb.unplaced;
    let (relative, no_baseline, cb) = if settled {
        let to_b = fb.pose.rotation.conjugate();
        let away = to_b * (fa.pose.center - fb.pose.center);
        let pose = RelativePose {
            rotation: (to_b * fa.pose.rotation).normalize(),
            translation: away.try_normalize().unwrap_or(DVec3::X),
        };
        (pose, before.is_some_and(|p| p.rotation_only), refiner.camera_of(fb))
    } else {
        let Some(p) = before else { return (0, None) };
        let back = p.pose.rotation.conjugate();
        let pose = match p.a as usize == a {
            true => p.pose,
            false => RelativePose { rotation: back, translation: -(back * p.pose.translation) },
        };
        let rotation = (fa.pose.rotation * pose.rotation.conjugate()).normalize();
        let length = if p.rotation_only { 0.0 } else { 1.0 };
        let center = fa.pose.center - rotation * pose.translation * length;
        (pose, p.rotation_only, Pinhole { pose: Pose { rotation, center }, ..refiner.camera_of(fb) })
    };
    let limits = MatchLimits {
        min_cosine: refiner.settings.min_cosine,
        cosine_margin: refiner.settings.cosine_margin,
        features: usize::MAX,
    };
    let matches = if no_baseline {
        let anywhere = vec![Some(ca.c); fb.keypoints().len()];
        match_frames(fa, fb, &Guide { predicted: &anywhere, radius: f64::INFINITY, lines: None }, limits)
    } else {
        let lines = epipolar_lines(&relative, &ca, &cb, fb.keypoints());
        let share = if settled { decoys::FEW_WRONG } else { decoys::SOME_WRONG };
        decoys::match_along((fa, fb), (&lines, 3.0 * refiner.settings.epipolar_px), limits, share)
    };
    let limits = TwoViewLimits {
        threshold: refiner.settings.epipolar_px / ca.f.min_element().min(cb.f.min_element()),
        min_inliers: refiner.settings.min_inliers,
        any_heading: false,
        rotation_sigma: ADJUSTED.0,
        direction_sigma: ADJUSTED.1,
        rounds: 0,
    };
    let found = verify(&rays(&refiner.frames, (a, &ca), (b, &cb), &matches), relative, limits);
    (matches.len(), found.map(|found| Proposal { a, cb, ground: None, matches, found }))
}
