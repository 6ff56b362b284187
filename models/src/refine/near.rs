//! In flight: a new key frame and those it is linked to are adjusted at once, by what they see in common, while all others stand
//! still. What that costs depends on how much the pictures overlap, never on how many there are; [`Refiner::solve`] brings the
//! whole to rest now and then.

use std::collections::{HashMap, HashSet};
use std::time::{Duration, Instant};

use super::adjust::{Limits, adjust};
use super::linking::{ADJUSTED_SIGMA, median};
use super::part::Part;
use super::problem::{Loss, SHARED};
use super::report::NearReport;
use super::solving::{COARSE_PX, FINE_PX, TIED, quantile};
use super::tracks::{Sighting, Tracks};
use super::{RefineError, Refiner};

/// Key frames linked to the new ones that move with them.
const NEIGHBOURS: usize = 6;
/// Those that stand still around them, most common points first: what six neighbours overlap with in a survey flown across.
const STANDING: usize = 32;
/// Points of an adjustment per frame that moves; from twice as many poses differ by less than a tenth of a pixel.
const POINTS_EACH: usize = 150;
/// Velocities are those of a path; so many key frames before the newest are enough of it.
const PATH: usize = 16;

impl Refiner {
    /// Places the key frames that came since the last solve, and moves those they are linked to with them; everything else stands
    /// still, and so does what all share.
    ///
    /// # Errors
    /// None at present beyond those of the type; key frames without links keep telemetry's poses.
    pub fn solve_near(&mut self) -> Result<NearReport, RefineError> {
        let start = Instant::now();
        let deadline = start + Duration::from_secs_f64(self.settings.solve_seconds);
        let (fresh, partners) = self.unsolved();
        self.place_by_telemetry(&fresh);
        (self.solved_frames, self.solved_pairs) = (self.frames.len(), self.pairs.len());
        let placed = |i: &u32| self.frames[*i as usize].pairs > 0 && !self.frames[*i as usize].unplaced;
        let linked: Vec<u32> = fresh.iter().copied().filter(placed).collect();
        let mut report = NearReport { frames: fresh.len(), ..NearReport::default() };
        let mut moving = linked.clone();
        moving.extend(partners.into_iter().filter(|i| placed(i) && !linked.contains(i)).take(NEIGHBOURS));
        if !linked.is_empty() {
            let seen = self.tracks_of(&moving);
            let part = self.part(moving.clone(), &seen);
            let chosen = seen.select(self.frames.len(), POINTS_EACH * part.moving);
            let stages = [(COARSE_PX, Loss::Huber(3.0), 8), (FINE_PX, Loss::Cauchy(2.0), 8)];
            for (i, (max_px, loss, max_steps)) in
                stages.into_iter().chain([(self.settings.outlier_px, Loss::Cauchy(2.0), 12)]).enumerate()
            {
                let mut problem = self.problem_of(&part, &seen, &chosen, max_px);
                problem.free = [false; SHARED];
                report.observations = problem.observations.len();
                report.steps += adjust(&mut problem, Limits { loss, max_steps, deadline }).steps;
                self.take_part(&part, &problem);
                if i == 0 {
                    report.replaced_frames = self.replace_strays((&part, &linked), &problem, &seen, &chosen);
                }
            }
            report.adjusted_frames = part.moving;
            self.look_at(&moving, &linked, &seen);
        }
        // Those without links are where telemetry has them, which may be known better than when they came.
        moving.extend(fresh.iter().filter(|i| !linked.contains(i)));
        report.moved = moving.iter().map(|i| self.frames[*i as usize].name.clone()).collect();
        report.solve_seconds = start.elapsed().as_secs_f64();
        Ok(report)
    }

    /// Key frames that no adjustment has placed and that came, or were first linked, since the last solve; and those that they were
    /// linked to, newest links first.
    fn unsolved(&self) -> (Vec<u32>, Vec<u32>) {
        let links = &self.pairs[self.solved_pairs.min(self.pairs.len())..];
        let mut fresh: Vec<u32> = links.iter().flat_map(|p| [p.a, p.b]).collect();
        fresh.extend(self.solved_frames as u32..self.frames.len() as u32);
        fresh.retain(|i| !self.frames[*i as usize].adjusted);
        fresh.sort_unstable();
        fresh.dedup();
        let mut partners: Vec<u32> = Vec::new();
        for p in links.iter().rev() {
            for (one, other) in [(p.a, p.b), (p.b, p.a)] {
                if fresh.binary_search(&one).is_ok()
                    && fresh.binary_search(&other).is_err()
                    && !partners.contains(&other)
                {
                    partners.push(other);
                }
            }
        }
        (fresh, partners)
    }

    /// As a solve of all does: positions not yet adjusted, and rotations not yet linked, follow telemetry and what is known of its
    /// shared errors; a rotation that the pictures contradict has no say.
    fn place_by_telemetry(&mut self, fresh: &[u32]) {
        let Some(first) = fresh.first() else { return };
        let from = (*first as usize).saturating_sub(PATH);
        let path: Vec<_> = self.frames[from..].iter().map(|f| (f.told.time_ns, f.prior.center)).collect();
        let velocity = super::motion::velocities(&path);
        for i in fresh.iter().map(|i| *i as usize) {
            let frame = &mut self.frames[i];
            frame.velocity = velocity[i - from];
            frame.pose.center = frame.prior.center + frame.velocity * self.shared.delay;
            if frame.pairs == 0 {
                frame.pose.rotation = (frame.prior.rotation * self.shared.mount).normalize();
            }
            self.doubt_rotation(i);
        }
    }

    /// All tracks with a sighting in one of `frames`.
    fn tracks_of(&mut self, frames: &[u32]) -> Tracks {
        let (mut known, mut found) = (HashSet::new(), Vec::new());
        for f in frames {
            let (first, count) = (self.frames[*f as usize].first_node, self.frames[*f as usize].seen.len() as u32);
            for node in first..first + count {
                if self.union.is_single(node) || !known.insert(self.union.find(node)) {
                    continue;
                }
                let member = |(frame, node): (u32, u32)| Sighting {
                    frame,
                    feature: node - self.frames[frame as usize].first_node,
                };
                let mut track: Vec<Sighting> = self.union.members(node).map(member).collect();
                track.sort_unstable_by_key(|s| s.frame);
                found.push(track);
            }
        }
        Tracks::of(found)
    }

    /// `moving`, and around them the frames that see most of what they see.
    fn part(&self, moving: Vec<u32>, seen: &Tracks) -> Part {
        let mut common: HashMap<u32, u32> = HashMap::new();
        (0..seen.len()).flat_map(|t| seen.get(t)).for_each(|s| *common.entry(s.frame).or_default() += 1);
        let mut around: Vec<(u32, u32)> = common.into_iter().filter(|(f, _)| !moving.contains(f)).collect();
        around.retain(|(f, _)| self.frames[*f as usize].adjusted);
        around.sort_unstable_by_key(|(f, n)| (std::cmp::Reverse(*n), *f));
        let (count, mut frames) = (moving.len(), moving);
        frames.extend(around.into_iter().take(STANDING).map(|(f, _)| f));
        Part::new(frames, count)
    }

    /// What the new poses say of the points: depth ranges and ground of `moving`, and the points that `fresh` see.
    fn look_at(&mut self, moving: &[u32], fresh: &[u32], seen: &Tracks) {
        let cameras = self.cameras();
        let mut depths: HashMap<u32, (Vec<f32>, Vec<f64>)> =
            moving.iter().map(|f| (*f, (Vec::new(), Vec::new()))).collect();
        let (mut views, mut points) = (Vec::new(), Vec::new());
        for t in 0..seen.len() as u32 {
            let mut track = self.sightings(seen, t);
            let Some(p) = self.robust_point(&cameras, &mut track, self.settings.outlier_px, &mut views) else {
                continue;
            };
            for s in &track {
                if let Some((depths, heights)) = depths.get_mut(&s.frame) {
                    depths.push(cameras[s.frame as usize].local(p.world).z as f32);
                    heights.push(p.world.z);
                }
            }
            if track.iter().any(|s| fresh.contains(&s.frame)) {
                points.push(self.refined_point(&p, &track));
            }
        }
        for (f, (mut depths, mut heights)) in depths {
            let frame = &mut self.frames[f as usize];
            (frame.adjusted, frame.rotation_sigma) = (true, ADJUSTED_SIGMA);
            frame.position_sigma = frame.position_sigma.min(0.3);
            frame.tied = depths.len() >= TIED;
            frame.known.depths = frame.tied.then(|| (quantile(&mut depths, 0.01), quantile(&mut depths, 0.99)));
            self.grounds[f as usize] = frame.tied.then(|| median(&mut heights));
        }
        self.recent = points;
    }
}
