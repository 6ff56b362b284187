//! Pictures are placed one by one from the points that three pictures see (P3P), after all pairs have been compared and the lens is
//! roughly known: for cards whose pictures say nothing of how they were turned, and lenses that nobody has calibrated.

use glam::DVec3;
use rayon::prelude::*;

use super::bootstrap::{BootstrapReport, COARSE_PX, GROWTH, RETRY, SIGMA, Web, adjust_placed};
use super::keyframe::belongs;
use super::tracks::Tracks;
use super::{RefineError, Refiner, bootstrap, overview, p3p};
use crate::camera::{Pinhole, Pose};

/// Placed pictures from which the lens is adjusted with them.
const LENS_FROM: usize = 5;
/// Errors of a picture's points while its place is new, in multiples of those that are dropped in the end; and where what is known of the
/// lens does not hold up to the edges.
const NARROW: f64 = 3.0;
const WIDE: f64 = 8.0;
/// Share of the points that a picture sees that must agree on its place: as COLMAP asks for. (Of banana's, 30 of 429 agreed on one that was
/// off by twice the extent of the scene.)
const MIN_SHARE: f64 = 0.25;

/// Finds all pairs anew and places the pictures from them; those that never find a place are not [tied](Refiner::is_tied).
///
/// # Errors
/// The network failed.
pub(super) fn place_all(refiner: &mut Refiner) -> Result<BootstrapReport, RefineError> {
    for frame in &mut refiner.frames {
        frame.pose = frame.prior;
    }
    overview::overview(refiner)?;
    let mut report = BootstrapReport::default();
    let tracks = Tracks::build(&mut refiner.union, &refiner.frames, refiner.settings.max_observations);
    let web = Web::new(&tracks, refiner.frames.len());
    bootstrap::grow_from_seeds(refiner, &tracks, &web, &mut report, &|this| grow(this, &tracks));
    bootstrap::float(refiner);
    refiner.standing.by_pictures = true;
    Ok(report)
}

/// Places picture after picture until none can be; what fits only while the lens may be wrong by much comes after all others.
fn grow(refiner: &mut Refiner, tracks: &Tracks) {
    let n = refiner.frames.len();
    let (mut tried, mut tried_wide) = (vec![0usize; n], vec![0usize; n]);
    let (mut placed, mut adjusted) = (2usize, 0usize);
    let [narrow, wide] = [NARROW, WIDE].map(|times| times * refiner.settings.outlier_px);
    loop {
        if placed as f64 >= adjusted as f64 * (1.0 + GROWTH) {
            adjust_placed(refiner, tracks, COARSE_PX, LENS_FROM);
            adjusted = placed;
        }
        if let Some(next) = next_to_place(refiner, tracks, &mut tried) {
            if let Some(pose) = place(refiner, next, tracks, narrow) {
                (refiner.frames[next].pose, refiner.frames[next].unplaced) = (pose, false);
                placed += 1;
            }
            continue;
        }
        let Some(next) = next_to_place(refiner, tracks, &mut tried_wide) else { break };
        if let Some(pose) = place(refiner, next, tracks, wide) {
            let before: Vec<Pose> = refiner.frames.iter().map(|f| f.pose).collect();
            let lens = refiner.shared;
            (refiner.frames[next].pose, refiner.frames[next].unplaced) = (pose, false);
            adjust_placed(refiner, tracks, wide, LENS_FROM);
            adjust_placed(refiner, tracks, COARSE_PX, LENS_FROM);
            // Once all have settled with it, it has to be found from the others' points as closely as any.
            refiner.frames[next].unplaced = true;
            if place(refiner, next, tracks, narrow).is_some() {
                refiner.frames[next].unplaced = false;
                placed += 1;
                continue;
            }
            refiner.frames.iter_mut().zip(before).for_each(|(f, pose)| f.pose = pose);
            refiner.take_lens(lens);
        }
    }
    for max_px in [COARSE_PX, refiner.settings.outlier_px] {
        adjust_placed(refiner, tracks, max_px, LENS_FROM);
    }
}

/// Places what has no place yet from the points of the others, and takes from those that nothing ties the place they had.
pub(super) fn grow_again(refiner: &mut Refiner) {
    if !refiner.frames.iter().any(|f| f.tied) {
        return;
    }
    let waiting: Vec<usize> = (0..refiner.frames.len()).filter(|i| !belongs(&refiner.frames[*i])).collect();
    waiting.iter().for_each(|i| refiner.frames[*i].unplaced = true);
    let tracks = Tracks::build(&mut refiner.union, &refiner.frames, refiner.settings.max_observations);
    let mut tried = vec![0; refiner.frames.len()];
    while let Some(next) = next_to_place(refiner, &tracks, &mut tried) {
        if let Some(pose) = place(refiner, next, &tracks, NARROW * refiner.settings.outlier_px) {
            let (sigma, floating) =
                (refiner.frames.iter().find(|f| f.tied).map_or(SIGMA, |f| f.sigma), refiner.standing.floating);
            let frame = &mut refiner.frames[next];
            (frame.pose, frame.prior, frame.sigma, frame.unplaced) = (pose, pose, sigma, false);
            if !floating {
                (frame.prior.center, frame.sigma.position_m) = (frame.told.pose.center, frame.told.sigma.position_m);
                frame.adjusted = true;
            }
        }
    }
    for frame in refiner.frames.iter_mut().filter(|f| f.unplaced) {
        frame.pairs = 0;
    }
}

/// Where a point of a track lies that two placed pictures see.
fn triangulated(refiner: &Refiner, tracks: &Tracks, cameras: &[Pinhole], track: u32) -> Option<DVec3> {
    let mut seen = refiner.sightings(tracks, track);
    if seen.len() < 2 {
        return None;
    }
    refiner.robust_point(cameras, &mut seen, COARSE_PX, &mut Vec::new()).map(|p| p.world)
}

/// Where picture `b` was taken, by the points of placed pictures that it sees and that agree to within `limit` pixels.
fn place(refiner: &Refiner, b: usize, tracks: &Tracks, limit: f64) -> Option<Pose> {
    let cameras = refiner.cameras();
    let sees = |t: u32| {
        let own = tracks.get(t as usize).iter().find(|s| s.frame as usize == b)?;
        let world = triangulated(refiner, tracks, &cameras, t)?;
        Some((world, refiner.frames[b].keypoints()[own.feature as usize]))
    };
    let points: Vec<_> = (0..tracks.len() as u32).into_par_iter().filter_map(sees).collect();
    let least = refiner.settings.min_inliers.max((MIN_SHARE * points.len() as f64).ceil() as usize);
    let found = p3p::find(cameras[b], &points, limit, least);
    tracing::debug!("{}: {} points known, {} agree", refiner.frames[b].name, points.len(), found.map_or(0, |f| f.1));
    found.map(|(pose, _)| pose)
}

/// The picture without a place that sees most points of those with one; `tried` says how many each saw when it could not be placed.
fn next_to_place(refiner: &Refiner, tracks: &Tracks, tried: &mut [usize]) -> Option<usize> {
    // A point is known when two placed pictures see it.
    let mut known = vec![0usize; refiner.frames.len()];
    for t in 0..tracks.len() {
        let seen = tracks.get(t);
        if seen.iter().filter(|s| !refiner.frames[s.frame as usize].unplaced).count() >= 2 {
            seen.iter().for_each(|s| known[s.frame as usize] += 1);
        }
    }
    let worth = |i: &usize| {
        let again = known[*i] as f64 >= RETRY * tried[*i] as f64;
        refiner.frames[*i].unplaced && known[*i] >= refiner.settings.min_inliers && again
    };
    let next = (0..refiner.frames.len()).filter(worth).max_by_key(|i| (known[*i], std::cmp::Reverse(*i)))?;
    tried[next] = known[next];
    Some(next)
}
