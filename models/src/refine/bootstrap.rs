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
use super::problem::{Loss, SHARED};
use super::resect::resect;
use super::tracks::{Sighting, Tracks};
use super::twoview::RelativePose;
use super::{RefineError, Refiner};
use crate::camera::{Pinhole, Pose, PoseSigma};

/// Pairs tried as a start; a flat scene has two explanations of any pair, of which one does not go on.
const SEEDS: usize = 6;
/// Rays of a start that meet at more than this gain nothing more, degrees.
const WIDE_DEG: f64 = 12.0;
/// Points that a picture is placed from at least, and that must agree with its place.
const PLACED_FROM: usize = 20;
/// Neighbours from which a place is tried.
const PARTNERS: usize = 4;
/// Share by which the placed pictures grow between two adjustments of all of them.
const GROWTH: f64 = 0.15;
/// A picture that could not be placed is tried again once this many times as many points are known.
const RETRY: f64 = 1.5;
/// Errors of a point while poses are new, pixels.
const COARSE_PX: f64 = 8.0;
/// Errors of a place that stands on the ground as if it were flat, pixels: relief of a fifth of the height at half a baseline.
const ROUGH_PX: f64 = 60.0;
/// How far the poses may be wrong once all are placed: a chain of pictures bends.
const SIGMA: PoseSigma = PoseSigma { position_m: [15.0; 3], rotation_rad: [0.15; 3] };

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

/// Which tracks a picture sees, and how many each two have in common.
struct Web {
    seen_by: Vec<Vec<u32>>,
    common: HashMap<(u32, u32), u32>,
}

impl Web {
    fn new(tracks: &Tracks, frames: usize) -> Self {
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

impl Refiner {
    /// Places the key frames from their pairs alone, whatever their priors say; those that never find a place are not
    /// [tied](Refiner::is_tied) after [`Refiner::relink`]. Call it once, after the last [`Refiner::add`] and before
    /// [`Refiner::solve`]. The world is level, its ground at height 0 and the pictures 50 above it.
    ///
    /// # Errors
    /// The network failed.
    pub fn bootstrap(&mut self) -> Result<BootstrapReport, RefineError> {
        for frame in &mut self.frames {
            frame.pose = frame.prior;
        }
        self.turn_groups()?;
        let mut report = BootstrapReport { joined_by_appearance: self.join_by_appearance(), ..Default::default() };
        let tracks = Tracks::build(&mut self.union, &self.frames, self.settings.max_observations);
        let web = Web::new(&tracks, self.frames.len());
        let largest = self.groups().iter().map(Vec::len).max().unwrap_or(0);
        let mut best: Option<(Vec<Option<Pose>>, Pair)> = None;
        for seed in self.seeds(&tracks, &web) {
            self.start(&seed);
            self.grow(&tracks, &web);
            let poses: Vec<_> = self.frames.iter().map(|f| (!f.unplaced).then_some(f.pose)).collect();
            let placed = poses.iter().flatten().count();
            tracing::debug!(
                "from {} and {}: {placed} of {} placed",
                self.frames[seed.a as usize].name,
                self.frames[seed.b as usize].name,
                self.frames.len()
            );
            if placed > best.as_ref().map_or(2, |(poses, _)| poses.iter().flatten().count()) {
                report.placed = placed;
                best = Some((poses, seed));
            }
            if placed * 10 >= largest * 9 {
                break;
            }
        }
        self.frames.iter_mut().for_each(|f| f.unplaced = true);
        if let Some((poses, seed)) = best {
            for (frame, pose) in self.frames.iter_mut().zip(poses) {
                frame.unplaced = pose.is_none();
                frame.pose = pose.unwrap_or(frame.pose);
            }
            report.start = Some([seed.a, seed.b].map(|i| self.frames[i as usize].name.clone()));
            self.level(&tracks);
            self.reach_out(&tracks, &web);
        }
        for frame in &mut self.frames {
            (frame.prior, frame.sigma) = (frame.pose, SIGMA);
            (frame.rotation_sigma, frame.position_sigma) = (LINKED_SIGMA, f64::from(SIGMA.position_m[0]));
            if frame.unplaced {
                frame.pairs = 0;
            }
        }
        self.floating = true;
        Ok(report)
    }

    /// Sightings of a track by key frames that have a place.
    pub(super) fn sightings(&self, tracks: &Tracks, track: u32) -> Vec<Sighting> {
        let placed = |s: &&Sighting| !self.frames[s.frame as usize].unplaced;
        tracks.get(track as usize).iter().filter(placed).copied().collect()
    }

    /// Pairs worth a start, best first: many common points that are seen from different directions.
    fn seeds(&self, tracks: &Tracks, web: &Web) -> Vec<Pair> {
        let parallax = |p: &Pair| -> f64 {
            let (a, b) = (self.camera_of(&self.frames[p.a as usize]), self.camera_of(&self.frames[p.b as usize]));
            let mut angles = Vec::new();
            for t in &web.seen_by[p.b as usize] {
                let of = |frame| tracks.get(*t as usize).iter().find(|s| s.frame == frame);
                if let (Some(x), Some(y)) = (of(p.a), of(p.b)) {
                    let ray = |s: &Sighting, camera: &Pinhole| {
                        camera.ray(self.frames[s.frame as usize].keypoints()[s.feature as usize])
                    };
                    angles.push((p.pose.rotation * ray(x, &a)).angle_between(ray(y, &b)).to_degrees());
                }
            }
            median(&mut angles)
        };
        let usable = self.pairs.iter().filter(|p| !p.rotation_only);
        let mut rated: Vec<(f64, Pair)> =
            usable.map(|p| (f64::from(web.between(p.a, p.b)) * parallax(p).min(WIDE_DEG), *p)).collect();
        rated.sort_by(|x, y| y.0.total_cmp(&x.0));
        rated.into_iter().take(SEEDS).map(|(_, p)| p).collect()
    }

    /// Only the two pictures of `seed` have a place, a distance of 1 apart.
    fn start(&mut self, seed: &Pair) {
        self.frames.iter_mut().for_each(|f| f.unplaced = true);
        let back = seed.pose.rotation.conjugate();
        let poses = [
            Pose { rotation: DQuat::IDENTITY, center: DVec3::ZERO },
            Pose { rotation: back, center: -(back * seed.pose.translation) },
        ];
        for (i, pose) in [seed.a, seed.b].into_iter().zip(poses) {
            (self.frames[i as usize].pose, self.frames[i as usize].unplaced) = (pose, false);
        }
    }

    /// Places picture after picture until none can be.
    fn grow(&mut self, tracks: &Tracks, web: &Web) {
        let n = self.frames.len();
        let mut tried = vec![0usize; n];
        let (mut placed, mut adjusted) = (2usize, 0usize);
        loop {
            if placed as f64 >= adjusted as f64 * (1.0 + GROWTH) {
                self.adjust_placed(tracks, COARSE_PX);
                adjusted = placed;
            }
            // A point is known when two placed pictures see it.
            let mut known = vec![0usize; n];
            for t in 0..tracks.len() {
                let seen = tracks.get(t);
                if seen.iter().filter(|s| !self.frames[s.frame as usize].unplaced).count() >= 2 {
                    seen.iter().for_each(|s| known[s.frame as usize] += 1);
                }
            }
            let worth = |i: &usize| {
                let again = known[*i] as f64 >= RETRY * tried[*i] as f64;
                self.frames[*i].unplaced && known[*i] >= PLACED_FROM && again
            };
            let Some(next) = (0..n).filter(worth).max_by_key(|i| (known[*i], std::cmp::Reverse(*i))) else { break };
            tried[next] = known[next];
            let (cameras, limit) = (self.cameras(), 3.0 * self.settings.outlier_px);
            let pose = self.place(next, tracks, web, limit, &|t| self.triangulated(tracks, &cameras, t));
            if let Some(pose) = pose {
                (self.frames[next].pose, self.frames[next].unplaced) = (pose, false);
                placed += 1;
            }
        }
        for max_px in [COARSE_PX, self.settings.outlier_px] {
            self.adjust_placed(tracks, max_px);
        }
    }

    /// Gives pictures that too few known points reach a rough place, good enough to look for what they see: from the ground under a
    /// picture they are paired with, else where the aircraft would have been had it flown on.
    fn reach_out(&mut self, tracks: &Tracks, web: &Web) {
        loop {
            let waiting: Vec<usize> = (0..self.frames.len()).filter(|i| self.frames[*i].unplaced).collect();
            let found = waiting.iter().find_map(|b| {
                let ground = |t: u32| {
                    let seen = self.sightings(tracks, t).first().copied()?;
                    let frame = &self.frames[seen.frame as usize];
                    Some(Ground(self.ground).meet(&self.camera_of(frame), frame.keypoints()[seen.feature as usize]))
                };
                Some((*b, self.place(*b, tracks, web, ROUGH_PX, &ground)?))
            });
            if let Some((b, pose)) = found {
                (self.frames[b].pose, self.frames[b].unplaced) = (pose, false);
                continue;
            }
            // All at once, so that one that is flown on from nothing but guesses is the last.
            let placed = |i: Option<usize>| Some(&self.frames.get(i?).filter(|f| !f.unplaced)?.pose);
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
                (self.frames[b].pose, self.frames[b].unplaced) = (pose, false);
            }
        }
    }

    /// Gives the pictures that nothing ties another rough place, now that more is known of the others.
    pub(super) fn reach_untied(&mut self) {
        let untied: Vec<usize> = (0..self.frames.len()).filter(|i| !self.frames[*i].tied).collect();
        if untied.len() == self.frames.len() {
            return;
        }
        untied.iter().for_each(|i| self.frames[*i].unplaced = true);
        let tracks = Tracks::build(&mut self.union, &self.frames, self.settings.max_observations);
        let web = Web::new(&tracks, self.frames.len());
        self.reach_out(&tracks, &web);
        for i in untied {
            self.frames[i].prior = self.frames[i].pose;
        }
    }

    /// Where a point of a track lies that two placed pictures see.
    fn triangulated(&self, tracks: &Tracks, cameras: &[Pinhole], track: u32) -> Option<DVec3> {
        let mut seen = self.sightings(tracks, track);
        if seen.len() < 2 {
            return None;
        }
        self.robust_point(cameras, &mut seen, COARSE_PX, &mut Vec::new()).map(|p| p.world)
    }

    /// Where picture `b` was taken: turned as a placed neighbour says, at the distance at which the points lie that `known` tells of,
    /// then settled on those points to `limit` pixels.
    fn place(
        &self,
        b: usize,
        tracks: &Tracks,
        web: &Web,
        limit: f64,
        known: &dyn Fn(u32) -> Option<DVec3>,
    ) -> Option<Pose> {
        let own = self.camera_of(&self.frames[b]);
        let mut points = Vec::new();
        for t in &web.seen_by[b] {
            let sighting = tracks.get(*t as usize).iter().find(|s| s.frame as usize == b)?;
            points.extend(known(*t).map(|world| (world, self.frames[b].keypoints()[sighting.feature as usize])));
        }
        if points.len() < PLACED_FROM {
            return None;
        }
        let mut partners: Vec<(u32, usize, RelativePose, bool)> = Vec::new();
        for p in &self.pairs {
            let back = p.pose.rotation.conjugate();
            let (a, pose) = match (p.a as usize == b, p.b as usize == b) {
                (false, true) => (p.a as usize, p.pose),
                (true, false) => {
                    (p.b as usize, RelativePose { rotation: back, translation: -(back * p.pose.translation) })
                }
                _ => continue,
            };
            if !self.frames[a].unplaced {
                partners.push((web.between(p.a, p.b), a, pose, p.rotation_only));
            }
        }
        partners.sort_by_key(|p| std::cmp::Reverse(p.0));
        let agree = |pose: &Pose| {
            let camera = self.shared.lens.camera(*pose, &self.frames[b].intrinsics);
            let near = |(world, pixel): &&(DVec3, [f32; 2])| {
                let pixel = glam::DVec2::new(pixel[0].into(), pixel[1].into());
                camera.project(*world).is_some_and(|q| q.distance(pixel) < limit)
            };
            points.iter().filter(near).count()
        };
        let settled = partners.iter().take(PARTNERS).filter_map(|(_, a, relative, rotation_only)| {
            let from = &self.frames[*a].pose;
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

    /// Bundle adjustment of what is placed; its own poses hold it together weakly, for nothing else says where it is.
    fn adjust_placed(&mut self, tracks: &Tracks, max_px: f64) {
        let placed: Vec<DVec3> = self.frames.iter().filter(|f| !f.unplaced).map(|f| f.pose.center).collect();
        let middle = placed.iter().sum::<DVec3>() / placed.len().max(1) as f64;
        let extent = placed.iter().map(|c| c.distance(middle)).fold(1e-3, f64::max) as f32;
        for frame in &mut self.frames {
            frame.prior = frame.pose;
            frame.sigma = PoseSigma { position_m: [extent; 3], rotation_rad: [0.5; 3] };
        }
        let known = |t: &u32| self.sightings(tracks, *t).len() >= 2;
        let chosen: Vec<u32> = (0..tracks.len() as u32).filter(known).take(self.settings.max_tracks).collect();
        let deadline = Instant::now() + Duration::from_secs_f64(self.settings.solve_seconds);
        for (loss, max_steps) in [(Loss::Huber(3.0), 10), (Loss::Cauchy(2.0), 6)] {
            let mut problem = self.problem(tracks, &chosen, max_px);
            problem.free = [false; SHARED];
            adjust(&mut problem, Limits { loss, max_steps, deadline });
            self.take(&problem);
        }
    }
}
