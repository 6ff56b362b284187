//! Poses from pictures alone, where none of them says where it was taken: two that see the same ground from different places are
//! the start, the others are placed one by one from the points that those before them have fixed, and the whole is adjusted as it
//! grows. What comes out is true up to a similarity; it is laid level, at a typical height above its ground, so that everything
//! that looks for overlaps with the ground's help goes on as with telemetry.

use std::collections::HashMap;
use std::time::{Duration, Instant};

use glam::{DQuat, DVec3};

use super::adjust::{Limits, adjust};
use super::linking::{LINKED_SIGMA, Pair, median};
use super::overlap::Ground;
use super::problem::{Loss, SHARED, Shared};
use super::resect::resect;
use super::tracks::{Sighting, Tracks};
use super::twoview::RelativePose;
use super::{RefineError, Refiner, agreement, joining};
use crate::camera::{Pinhole, Pose, PoseSigma};

/// The lens is not adjusted, however many pictures are placed.
const NO_LENS: usize = usize::MAX;
/// Pairs tried as a start; a flat scene has two explanations of any pair, of which one does not go on.
const SEEDS: usize = 6;
/// Starts that follow the best one in vain before no more are tried, where all that it placed agree.
const NO_BETTER: usize = 2;
/// Rays of a start that meet at more than this gain nothing more, degrees.
const WIDE_DEG: f64 = 12.0;
/// Points that a picture is placed from at least, and that must agree with its place.
const PLACED_FROM: usize = 20;
/// Neighbours from which a place is tried.
const PARTNERS: usize = 4;
/// Share by which the placed pictures grow between two adjustments of all of them.
pub(super) const GROWTH: f64 = 0.15;
/// A picture that could not be placed is tried again once this many times as many points are known.
pub(super) const RETRY: f64 = 1.5;
/// Errors of a point while poses are new, pixels.
pub(super) const COARSE_PX: f64 = 8.0;
/// Errors of a place that stands on the ground as if it were flat, pixels: relief of a fifth of the height at half a baseline.
const ROUGH_PX: f64 = 60.0;
/// Tracks of an adjustment for each picture where that is more than `[refine] max_tracks`: while places are new, many tracks are wrong.
const PER_PICTURE: usize = 250;
/// How far the poses may be wrong once all are placed: a chain of pictures bends.
pub(super) const SIGMA: PoseSigma = PoseSigma { position_m: [15.0; 3], rotation_rad: [0.15; 3] };

/// What [`Refiner::bootstrap`] made of the pictures.
#[derive(Clone, Debug, Default)]
pub struct BootstrapReport {
    /// Pictures that the points of others place; the rest has a rough place at most, for [`Refiner::relink`] to settle or give up.
    pub placed: usize,
    /// The two that were the start.
    pub start: Option<[String; 2]>,
    /// Pairs that the order of capture did not offer and likeness did.
    pub joined_by_appearance: usize,
}

/// What followed from one start.
struct Grown {
    /// Pictures that agree with each other, and all that were placed.
    worth: (usize, usize),
    poses: Vec<Option<Pose>>,
    shared: Shared,
    seed: Pair,
}

/// Which tracks a picture sees, and how many each two have in common.
pub(super) struct Web {
    seen_by: Vec<Vec<u32>>,
    common: HashMap<(u32, u32), u32>,
}

impl Web {
    pub(super) fn new(tracks: &Tracks, frames: usize) -> Self {
        let mut web = Self { seen_by: vec![Vec::new(); frames], common: HashMap::new() };
        for t in 0..tracks.len() {
            let seen = tracks.get(t);
            for (k, b) in seen.iter().enumerate() {
                web.seen_by[b.frame as usize].push(t as u32);
                for a in &seen[..k] {
                    *web.common.entry((a.frame.min(b.frame), a.frame.max(b.frame))).or_default() += 1;
                }
            }
        }
        web
    }

    fn between(&self, a: u32, b: u32) -> u32 {
        self.common.get(&(a.min(b), a.max(b))).copied().unwrap_or(0)
    }
}

/// Places the key frames from their pairs alone, whatever their priors say; those that never find a place are not
/// [tied](Refiner::is_tied) after [`Refiner::relink`]. Call it once, after the last [`Refiner::add`] and before
/// [`Refiner::solve`]. The world is level, its ground at height 0 and the pictures 50 above it.
///
/// # Errors
/// The network failed.
pub(super) fn bootstrap(refiner: &mut Refiner) -> Result<BootstrapReport, RefineError> {
    for frame in &mut refiner.frames {
        frame.pose = frame.prior;
    }
    joining::turn_groups(refiner)?;
    let mut report =
        BootstrapReport { joined_by_appearance: joining::join_by_appearance(refiner), ..Default::default() };
    let tracks = Tracks::build(&mut refiner.union, &refiner.frames, refiner.settings.max_observations);
    let web = Web::new(&tracks, refiner.frames.len());
    grow_from_seeds(refiner, &tracks, &web, &mut report, &|this| grow(this, &tracks, &web));
    if report.start.is_some() {
        reach_out(refiner, &tracks, &web);
    }
    float(refiner);
    Ok(report)
}

/// Tries pairs as starts, places with `grow` what follows from each, and keeps what places most pictures, laid level.
pub(super) fn grow_from_seeds(
    refiner: &mut Refiner,
    tracks: &Tracks,
    web: &Web,
    report: &mut BootstrapReport,
    grow: &dyn Fn(&mut Refiner),
) {
    let largest = refiner.groups().iter().map(Vec::len).max().unwrap_or(0);
    // A wrong start goes on, too: what counts are pictures that agree with each other, then all that were placed.
    let mut best: Option<Grown> = None;
    let (lens, mut since_best) = (refiner.shared, 0);
    for seed in seeds(refiner, tracks, web) {
        refiner.take_lens(lens);
        start(refiner, &seed);
        grow(refiner);
        let placed: Vec<bool> = refiner.frames.iter().map(|f| !f.unplaced).collect();
        let count = |of: &[bool]| of.iter().filter(|x| **x).count();
        let worth = (count(&agreement::largest_part(refiner, tracks, &placed)), count(&placed));
        tracing::debug!(
            "from {} and {}: {} of {} placed, {} agree",
            refiner.frames[seed.a as usize].name,
            refiner.frames[seed.b as usize].name,
            worth.1,
            refiner.frames.len(),
            worth.0
        );
        since_best += 1;
        if worth > best.as_ref().map_or((0, 2), |b| b.worth) {
            let poses = refiner.frames.iter().map(|f| (!f.unplaced).then_some(f.pose)).collect();
            (best, since_best) = (Some(Grown { worth, poses, shared: refiner.shared, seed }), 0);
        }
        let (agree, placed) = best.as_ref().map_or((0, 2), |b| b.worth);
        if agree * 10 >= largest * 9 || (agree == placed && since_best >= NO_BETTER) {
            break;
        }
    }
    refiner.frames.iter_mut().for_each(|f| f.unplaced = true);
    if let Some(Grown { worth, poses, shared, seed }) = best {
        report.placed = worth.1;
        refiner.take_lens(shared);
        for (frame, pose) in refiner.frames.iter_mut().zip(poses) {
            frame.unplaced = pose.is_none();
            frame.pose = pose.unwrap_or(frame.pose);
        }
        report.start = Some([seed.a, seed.b].map(|i| refiner.frames[i as usize].name.clone()));
        refiner.level(tracks);
    }
}

/// Nothing but their own poses holds the pictures where they are.
pub(super) fn float(refiner: &mut Refiner) {
    for frame in &mut refiner.frames {
        (frame.prior, frame.sigma) = (frame.pose, SIGMA);
        (frame.rotation_sigma, frame.position_sigma) = (LINKED_SIGMA, f64::from(SIGMA.position_m[0]));
        if frame.unplaced {
            frame.pairs = 0;
        }
    }
    refiner.standing.floating = true;
}

/// Pairs worth a start, best first: many common points that are seen from different directions.
fn seeds(refiner: &Refiner, tracks: &Tracks, web: &Web) -> Vec<Pair> {
    let parallax = |p: &Pair| -> f64 {
        let (a, b) =
            (refiner.camera_of(&refiner.frames[p.a as usize]), refiner.camera_of(&refiner.frames[p.b as usize]));
        let mut angles = Vec::new();
        for t in &web.seen_by[p.b as usize] {
            let of = |frame| tracks.get(*t as usize).iter().find(|s| s.frame == frame);
            if let (Some(x), Some(y)) = (of(p.a), of(p.b)) {
                let ray = |s: &Sighting, camera: &Pinhole| {
                    camera.ray(refiner.frames[s.frame as usize].keypoints()[s.feature as usize])
                };
                angles.push((p.pose.rotation * ray(x, &a)).angle_between(ray(y, &b)).to_degrees());
            }
        }
        median(&mut angles)
    };
    let usable = refiner.pairs.iter().filter(|p| !p.rotation_only);
    let mut rated: Vec<(f64, Pair)> =
        usable.map(|p| (f64::from(web.between(p.a, p.b)) * parallax(p).min(WIDE_DEG), *p)).collect();
    rated.sort_by(|x, y| y.0.total_cmp(&x.0));
    rated.into_iter().take(SEEDS).map(|(_, p)| p).collect()
}

/// Only the two pictures of `seed` have a place, a distance of 1 apart.
fn start(refiner: &mut Refiner, seed: &Pair) {
    refiner.frames.iter_mut().for_each(|f| f.unplaced = true);
    let back = seed.pose.rotation.conjugate();
    let poses = [
        Pose { rotation: DQuat::IDENTITY, center: DVec3::ZERO },
        Pose { rotation: back, center: -(back * seed.pose.translation) },
    ];
    for (i, pose) in [seed.a, seed.b].into_iter().zip(poses) {
        (refiner.frames[i as usize].pose, refiner.frames[i as usize].unplaced) = (pose, false);
    }
}

/// Places picture after picture until none can be.
fn grow(refiner: &mut Refiner, tracks: &Tracks, web: &Web) {
    let n = refiner.frames.len();
    let mut tried = vec![0usize; n];
    let (mut placed, mut adjusted) = (2usize, 0usize);
    loop {
        if placed as f64 >= adjusted as f64 * (1.0 + GROWTH) {
            adjust_placed(refiner, tracks, COARSE_PX, NO_LENS);
            adjusted = placed;
        }
        // A point is known when two placed pictures see it.
        let mut known = vec![0usize; n];
        for t in 0..tracks.len() {
            let seen = tracks.get(t);
            if seen.iter().filter(|s| !refiner.frames[s.frame as usize].unplaced).count() >= 2 {
                seen.iter().for_each(|s| known[s.frame as usize] += 1);
            }
        }
        let worth = |i: &usize| {
            let again = known[*i] as f64 >= RETRY * tried[*i] as f64;
            refiner.frames[*i].unplaced && known[*i] >= PLACED_FROM && again
        };
        let Some(next) = (0..n).filter(worth).max_by_key(|i| (known[*i], std::cmp::Reverse(*i))) else { break };
        tried[next] = known[next];
        let (cameras, limit) = (refiner.cameras(), 3.0 * refiner.settings.outlier_px);
        let pose = place(refiner, next, tracks, web, limit, &|t| triangulated(refiner, tracks, &cameras, t));
        if let Some(pose) = pose {
            (refiner.frames[next].pose, refiner.frames[next].unplaced) = (pose, false);
            placed += 1;
        }
    }
    for max_px in [COARSE_PX, refiner.settings.outlier_px] {
        adjust_placed(refiner, tracks, max_px, NO_LENS);
    }
}

/// Gives pictures that too few known points reach a rough place, good enough to look for what they see: from the ground under a
/// picture they are paired with, else where the aircraft would have been had it flown on.
fn reach_out(refiner: &mut Refiner, tracks: &Tracks, web: &Web) {
    loop {
        let waiting: Vec<usize> = (0..refiner.frames.len()).filter(|i| refiner.frames[*i].unplaced).collect();
        let found = waiting.iter().find_map(|b| {
            let ground = |t: u32| {
                let seen = refiner.sightings(tracks, t).first().copied()?;
                let frame = &refiner.frames[seen.frame as usize];
                Some(Ground(refiner.ground).meet(&refiner.camera_of(frame), frame.keypoints()[seen.feature as usize]))
            };
            Some((*b, place(refiner, *b, tracks, web, ROUGH_PX, &ground)?))
        });
        if let Some((b, pose)) = found {
            (refiner.frames[b].pose, refiner.frames[b].unplaced) = (pose, false);
            continue;
        }
        // All at once, so that one that is flown on from nothing but guesses is the last.
        let placed = |i: Option<usize>| Some(&refiner.frames.get(i?).filter(|f| !f.unplaced)?.pose);
        let after = |one: Option<usize>, two: Option<usize>| {
            let last = placed(one)?;
            let step = placed(two).map_or(DVec3::ZERO, |before| last.center - before.center);
            Some(Pose { rotation: last.rotation, center: last.center + step })
        };
        let back = |i: usize, n: usize| i.checked_sub(n);
        let flown_on = waiting.iter().filter_map(|&b| {
            let forward = after(back(b, 1), back(b, 2));
            Some((b, forward.or_else(|| after(Some(b + 1), Some(b + 2)))?))
        });
        let flown_on: Vec<(usize, Pose)> = flown_on.collect();
        if flown_on.is_empty() {
            break;
        }
        for (b, pose) in flown_on {
            (refiner.frames[b].pose, refiner.frames[b].unplaced) = (pose, false);
        }
    }
}

/// Gives the pictures that nothing ties another rough place, now that more is known of the others.
pub(super) fn reach_untied(refiner: &mut Refiner) {
    let untied: Vec<usize> = (0..refiner.frames.len()).filter(|i| !refiner.frames[*i].tied).collect();
    if untied.len() == refiner.frames.len() {
        return;
    }
    untied.iter().for_each(|i| refiner.frames[*i].unplaced = true);
    let tracks = Tracks::build(&mut refiner.union, &refiner.frames, refiner.settings.max_observations);
    let web = Web::new(&tracks, refiner.frames.len());
    reach_out(refiner, &tracks, &web);
    for i in untied {
        refiner.frames[i].prior = refiner.frames[i].pose;
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

/// Where picture `b` was taken: turned as a placed neighbour says, at the distance at which the points lie that `known` tells of,
/// then settled on those points to `limit` pixels.
fn place(
    refiner: &Refiner,
    b: usize,
    tracks: &Tracks,
    web: &Web,
    limit: f64,
    known: &dyn Fn(u32) -> Option<DVec3>,
) -> Option<Pose> {
    let own = refiner.camera_of(&refiner.frames[b]);
    let mut points = Vec::new();
    for t in &web.seen_by[b] {
        let sighting = tracks.get(*t as usize).iter().find(|s| s.frame as usize == b)?;
        points.extend(known(*t).map(|world| (world, refiner.frames[b].keypoints()[sighting.feature as usize])));
    }
    if points.len() < PLACED_FROM {
        return None;
    }
    let mut partners: Vec<(u32, usize, RelativePose, bool)> = Vec::new();
    for p in &refiner.pairs {
        let back = p.pose.rotation.conjugate();
        let (a, pose) = match (p.a as usize == b, p.b as usize == b) {
            (false, true) => (p.a as usize, p.pose),
            (true, false) => (p.b as usize, RelativePose { rotation: back, translation: -(back * p.pose.translation) }),
            _ => continue,
        };
        if !refiner.frames[a].unplaced {
            partners.push((web.between(p.a, p.b), a, pose, p.rotation_only));
        }
    }
    partners.sort_by_key(|p| std::cmp::Reverse(p.0));
    let agree = |pose: &Pose| {
        let camera = refiner.shared.lens.camera(*pose, &refiner.frames[b].intrinsics);
        let near = |(world, pixel): &&(DVec3, [f32; 2])| {
            let pixel = glam::DVec2::new(pixel[0].into(), pixel[1].into());
            camera.project(*world).is_some_and(|q| q.distance(pixel) < limit)
        };
        points.iter().filter(near).count()
    };
    let settled = partners.iter().take(PARTNERS).filter_map(|(_, a, relative, rotation_only)| {
        let from = &refiner.frames[*a].pose;
        let rotation = (from.rotation * relative.rotation.conjugate()).normalize();
        let camera = Pinhole { pose: Pose { rotation, center: from.center }, ..own };
        // Seen from b a point lies at y + t·s on its ray, y being where it would lie were b at a's place.
        let t = if *rotation_only { DVec3::ZERO } else { relative.translation };
        let mut lengths: Vec<f64> = points
            .iter()
            .filter_map(|(world, pixel)| {
                let (y, ray) = (camera.local(*world), camera.ray(*pixel));
                let across = t.cross(ray);
                (across.length() > 1e-3).then(|| -y.cross(ray).dot(across) / across.length_squared())
            })
            .collect();
        let center = from.center - rotation * t * median(&mut lengths);
        resect(Pinhole { pose: Pose { rotation, center }, ..own }, &points, limit)
    });
    let best = settled.map(|pose| (agree(&pose), pose)).max_by_key(|(n, _)| *n)?;
    (best.0 >= PLACED_FROM).then_some(best.1)
}

/// Tracks that two placed pictures see, some of every picture.
fn chosen_of_placed(refiner: &Refiner, tracks: &Tracks) -> Vec<u32> {
    let placed = refiner.frames.iter().filter(|f| !f.unplaced).count();
    let known = |t: &u32| refiner.sightings(tracks, *t).len() >= 2;
    let known: Vec<u32> = (0..tracks.len() as u32).filter(known).collect();
    tracks.select_of(known, refiner.frames.len(), refiner.settings.max_tracks.max(PER_PICTURE * placed))
}

/// Bundle adjustment of what is placed; its own poses hold it together weakly, for nothing else says where it is.
/// From `lens_from` placed pictures on the lens is adjusted with them, as far as they tell it.
pub(super) fn adjust_placed(refiner: &mut Refiner, tracks: &Tracks, max_px: f64, lens_from: usize) {
    let placed: Vec<DVec3> = refiner.frames.iter().filter(|f| !f.unplaced).map(|f| f.pose.center).collect();
    let middle = placed.iter().sum::<DVec3>() / placed.len().max(1) as f64;
    let extent = placed.iter().map(|c| c.distance(middle)).fold(1e-3, f64::max) as f32;
    for frame in &mut refiner.frames {
        frame.prior = frame.pose;
        frame.sigma = PoseSigma { position_m: [extent; 3], rotation_rad: [0.5; 3] };
    }
    let chosen = chosen_of_placed(refiner, tracks);
    let deadline = Instant::now() + Duration::from_secs_f64(refiner.settings.solve_seconds);
    for (loss, max_steps) in [(Loss::Huber(3.0), 10), (Loss::Cauchy(2.0), 6)] {
        let mut problem = refiner.problem(tracks, &chosen, max_px);
        problem.free = [false; SHARED];
        if placed.len() >= lens_from {
            let sigma = refiner.shared_sigma(&mut problem, loss);
            problem.free = refiner.observable(&sigma);
        }
        adjust(&mut problem, Limits { loss, max_steps, deadline });
        refiner.take(&problem);
    }
}

#[cfg(test)]
mod tests {
    use std::cell::Cell;

    use super::super::agreement::tests::{chance, flown};
    use super::super::twoview::SplitMix;
    use super::*;

    #[test]
    fn a_start_whose_pictures_agree_is_kept_though_another_one_placed_more() {
        let (mut refiner, tracks) = flown(8, 0.0);
        let right: Vec<Pose> = refiner.frames.iter().map(|f| f.pose).collect();
        for a in 0..7 {
            let pose = RelativePose { rotation: DQuat::IDENTITY, translation: -DVec3::X };
            refiner.pairs.push(Pair { a, b: a + 1, pose, rotation_only: false });
        }
        let (tried, mut report) = (Cell::new(0), BootstrapReport::default());
        let grow = |this: &mut Refiner| {
            let (mut random, places) = (SplitMix::default(), if tried.get() == 0 { 8 } else { 6 });
            let is_wrong = tried.get() == 0;
            for (frame, pose) in this.frames.iter_mut().zip(&right).take(places) {
                let off = if is_wrong { 9.0 * DVec3::splat(chance(&mut random)) } else { DVec3::ZERO };
                (frame.unplaced, frame.pose) = (false, Pose { center: pose.center + off, ..*pose });
            }
            // What a start makes of the lens is no part of the next one.
            assert_eq!(this.shared.lens.log_focal, 0.0);
            this.shared.lens.log_focal = if is_wrong { 0.3 } else { 0.0 };
            tried.set(tried.get() + 1);
        };
        let web = Web::new(&tracks, 8);
        grow_from_seeds(&mut refiner, &tracks, &web, &mut report, &grow);
        let placed: Vec<bool> = refiner.frames.iter().map(|f| !f.unplaced).collect();
        assert_eq!(placed, [true, true, true, true, true, true, false, false]);
        assert_eq!((report.placed, refiner.shared.lens.log_focal), (6, 0.0));
        // The best one, and two after it in vain.
        assert_eq!(tried.get(), 4);
    }

    #[test]
    fn every_placed_picture_has_tracks_in_an_adjustment_of_few_of_them() {
        let (mut refiner, _) = flown(6, 0.0);
        refiner.settings.max_tracks = 100;
        // Many long tracks of the first pictures, few short ones of the last.
        let seen_by = |frames: std::ops::Range<u32>, t: u32| {
            frames.map(|frame| Sighting { frame, feature: t % 80 }).collect::<Vec<_>>()
        };
        let tracks = Tracks::of((0..2000).map(|t| seen_by(0..4, t)).chain((0..80).map(|t| seen_by(4..6, t))).collect());
        let of_last =
            |chosen: &[u32]| chosen.iter().filter(|t| tracks.get(**t as usize).iter().any(|s| s.frame == 5)).count();
        let chosen = chosen_of_placed(&refiner, &tracks);
        assert_eq!((chosen.len(), of_last(&chosen)), (6 * PER_PICTURE, 80));
        // Of a picture without a place nothing is known.
        refiner.frames[5].unplaced = true;
        let chosen = chosen_of_placed(&refiner, &tracks);
        assert_eq!((chosen.len(), of_last(&chosen)), (5 * PER_PICTURE, 0));
    }
}
