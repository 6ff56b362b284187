//! One optimisation over everything held: tracks, triangulation, bundle adjustment in stages of growing trust,
//! shared parameters where the pictures can tell them, and the points and depth ranges that come out.

use super::adjust::{Limits, adjust, shared_sigma};
use super::keyframe::KeyFrame;
use super::linking::{ADJUSTED_SIGMA, median};
use super::motion::velocities;
use super::part::Part;
use super::placing::Placed;
use super::problem::{
    ASPECT, FOCAL, INDEPENDENT, Loss, Observation, PRINCIPAL, PosePrior, Problem, RADIAL, SHARED, Shared,
};
use super::resect::resect;
use super::tracks::{Sighting, Tracks};
use super::triangulate::Triangulated;
use super::{RefineError, RefineReport, RefinedPoint, Refiner, SharedEstimate};
use crate::camera::{Pinhole, Pose};
use glam::DVec3;
use std::time::{Duration, Instant};

/// Reprojection errors (pixels) a triangulation may have while poses are telemetry's, and after a first
/// adjustment; sightings beyond are left out until poses are better.
pub(super) const COARSE_PX: f64 = 60.0;
pub(super) const FINE_PX: f64 = 12.0;
/// Sightings that tie a frame to the map; with fewer, its pose is mostly telemetry's.
pub(super) const TIED: usize = 12;
/// Share of the usual doubt that a focal length may leave where pictures alone tell it: on brighton_beach without positions it left 0.043
/// and was 8 % off.
const PICTURES_SURE: f64 = 0.6;
/// Frames that shared parameters want at least, however few of them are asked for.
const LEAST_TIED: usize = 7;

impl Refiner {
    pub(super) fn solve_all(&mut self) -> Result<RefineReport, RefineError> {
        let start = Instant::now();
        let deadline = start + Duration::from_secs_f64(self.settings.solve_seconds);
        let mut report = self.counts();
        self.place_new_frames();
        self.vote();
        let tracks = Tracks::build(&mut self.union, &self.frames, self.settings.max_observations);
        report.tracks = tracks.len();
        report.observations_over_cap = tracks.over_cap;
        let most = self.settings.max_tracks.max(self.settings.tracks_per_keyframe * self.frames.len());
        let chosen = tracks.select(self.frames.len(), most);
        report.adjusted_tracks = chosen.len();
        // Frames never adjusted are still metres off: a convex loss first, and frames that most points disagree
        // with (a GPS position that jumped) are placed from the points alone.
        if self.frames.iter().any(|f| !f.adjusted) {
            let mut problem = self.problem(&tracks, &chosen, COARSE_PX);
            let limits = Limits { loss: Loss::Huber(3.0), max_steps: 12, deadline };
            report.steps += adjust(&mut problem, limits).steps;
            self.take(&problem);
            let (all, whole) = ((0..self.frames.len() as u32).collect::<Vec<_>>(), Part::whole(self.frames.len()));
            report.replaced_frames = self.replace_strays((&whole, &all), &problem, &tracks, &chosen);
        }
        if !self.standing.anchored {
            self.move_to_control();
            self.note_velocities();
        }
        let mut problem = self.problem(&tracks, &chosen, FINE_PX);
        let limits = Limits { loss: Loss::Cauchy(2.0), max_steps: 12, deadline };
        report.steps += adjust(&mut problem, limits).steps;
        self.take(&problem);
        let mut problem = self.problem(&tracks, &chosen, self.settings.outlier_px);
        problem.free = [false; SHARED];
        let sigma = self.shared_sigma(&mut problem, limits.loss);
        problem.free = self.observable(&sigma);
        // A second radial term that an earlier look took for known, and this one cannot tell, would bend what the first one has to hold.
        if self.standing.by_pictures && !problem.free[RADIAL + 1] {
            problem.shared.lens.radial.k2 = 0.0;
        }
        let last = adjust(&mut problem, Limits { max_steps: 25, ..limits });
        report.steps += last.steps;
        report.converged = last.converged;
        self.take(&problem);
        self.freed = problem.free;
        report.shared = self.shared_estimate(&problem, &sigma);
        self.harvest(&tracks, &mut report);
        report.control = self.control_residuals();
        for frame in &mut self.frames {
            frame.adjusted = frame.pairs > 0;
            if frame.adjusted {
                frame.rotation_sigma = ADJUSTED_SIGMA;
                frame.position_sigma = frame.position_sigma.min(0.3);
            }
        }
        (self.solved_frames, self.solved_pairs) = (self.frames.len(), self.pairs.len());
        self.solves += 1;
        report.solve_seconds = start.elapsed().as_secs_f64();
        Ok(report)
    }

    /// Unlinked frames, and the positions of frames not yet adjusted, follow telemetry and what is known about
    /// its shared errors.
    fn place_new_frames(&mut self) {
        self.note_velocities();
        for frame in &mut self.frames {
            if !frame.adjusted {
                frame.pose.center = frame.prior.center + frame.velocity * self.shared.delay;
            }
            if frame.pairs == 0 {
                frame.pose.rotation = (frame.prior.rotation * self.shared.mount).normalize();
            }
        }
    }

    fn note_velocities(&mut self) {
        // Where nothing was told of the place, it tells nothing of the way either.
        let told = |f: &&mut KeyFrame| f.sigma.position_m.iter().all(|s| s.is_finite());
        let mut frames: Vec<&mut KeyFrame> = self.frames.iter_mut().filter(told).collect();
        let path: Vec<_> = frames.iter().map(|f| (f.told.time_ns, f.prior.center)).collect();
        frames.iter_mut().zip(velocities(&path)).for_each(|(frame, v)| frame.velocity = v);
    }

    /// The adjustment's problem at the present poses: chosen tracks that triangulate to below `max_px`.
    pub(super) fn problem(&self, tracks: &Tracks, chosen: &[u32], max_px: f64) -> Problem {
        self.problem_of(&Part::whole(self.frames.len()), tracks, chosen, max_px)
    }

    /// The problem of some key frames, of which some stand still.
    pub(super) fn problem_of(&self, part: &Part, tracks: &Tracks, chosen: &[u32], max_px: f64) -> Problem {
        let s = &self.settings;
        let weight = |sigma: f64| if sigma > 0.0 { 1.0 / sigma } else { 0.0 };
        let frames = || part.frames.iter().map(|i| &self.frames[*i as usize]);
        let priors = frames().map(|f| {
            let per = |v: [f32; 3]| DVec3::from_array(v.map(|x| 1.0 / f64::from(x)));
            let rotation_weight = if f.rotation_refused { DVec3::ZERO } else { per(f.sigma.rotation_rad) };
            PosePrior { pose: f.prior, velocity: f.velocity, position_weight: per(f.sigma.position_m), rotation_weight }
        });
        let mut problem = Problem {
            moving: part.moving,
            intrinsics: frames().map(|f| f.intrinsics).collect(),
            poses: frames().map(|f| f.pose).collect(),
            priors: priors.collect(),
            points: Vec::with_capacity(chosen.len()),
            starts: vec![0],
            observations: Vec::new(),
            anchors: Vec::new(),
            shared: self.shared,
            shared_weight: self.shared_sigmas().map(weight),
            free: [false; SHARED],
            pixel_sigma: s.pixel_sigma,
        };
        let within = |s: &Sighting| part.at(s.frame).is_some();
        let placed = self.placed(&self.cameras(), tracks, chosen, max_px, within);
        for (point, seen) in placed.into_iter().filter_map(|p| p.found) {
            problem.points.push(point.world);
            problem.observations.extend(seen.iter().filter_map(|s| {
                let pixel = self.frames[s.frame as usize].seen[s.feature as usize];
                Some(Observation { camera: part.at(s.frame)?, pixel })
            }));
            problem.starts.push(problem.observations.len() as u32);
        }
        self.anchor(&mut problem);
        problem
    }

    pub(super) fn cameras(&self) -> Vec<Pinhole> {
        self.frames.iter().map(|f| self.camera_of(f)).collect()
    }

    /// Writes adjusted poses and shared parameters back.
    pub(super) fn take(&mut self, problem: &Problem) {
        for (frame, pose) in self.frames.iter_mut().zip(&problem.poses) {
            if pose.center.is_finite() && pose.rotation.is_finite() {
                frame.pose = *pose;
            }
        }
        self.take_lens(problem.shared);
    }

    /// What all frames share, and their key points as that lens sees them.
    pub(super) fn take_lens(&mut self, shared: Shared) {
        self.shared = shared;
        self.frames.iter_mut().for_each(|f| f.straighten(&shared.lens));
    }

    /// Writes back the poses that moved.
    pub(super) fn take_part(&mut self, part: &Part, problem: &Problem) {
        for (i, pose) in part.frames.iter().zip(&problem.poses).take(part.moving) {
            if pose.center.is_finite() && pose.rotation.is_finite() {
                self.frames[*i as usize].pose = *pose;
            }
        }
    }

    /// Frames `of` a part that hold few of the sightings they should have had are placed from the points around them.
    pub(super) fn replace_strays(
        &mut self,
        (part, of): (&Part, &[u32]),
        problem: &Problem,
        tracks: &Tracks,
        chosen: &[u32],
    ) -> usize {
        let mut wanted = vec![0usize; self.frames.len()];
        let mut held = vec![0usize; self.frames.len()];
        chosen.iter().flat_map(|t| self.sightings(tracks, *t)).for_each(|s| wanted[s.frame as usize] += 1);
        problem.observations.iter().for_each(|o| held[part.frames[o.camera as usize] as usize] += 1);
        let strays: Vec<usize> =
            of.iter().map(|i| *i as usize).filter(|i| wanted[*i] >= TIED && held[*i] * 2 < wanted[*i]).collect();
        if strays.is_empty() || strays.len() * 2 > part.frames.len() {
            return 0;
        }
        let cameras = self.cameras();
        let mut seen_by = vec![Vec::new(); self.frames.len()];
        let mut views = Vec::new();
        for t in chosen {
            let (own, mut others): (Vec<Sighting>, Vec<Sighting>) =
                self.sightings(tracks, *t).iter().partition(|s| strays.contains(&(s.frame as usize)));
            if own.is_empty() {
                continue;
            }
            if let Some(p) = self.robust_point(&cameras, &mut others, FINE_PX, &mut views) {
                for s in own {
                    seen_by[s.frame as usize]
                        .push((p.world, self.frames[s.frame as usize].keypoints()[s.feature as usize]));
                }
            }
        }
        let mut replaced = 0;
        for i in strays {
            if seen_by[i].len() >= TIED
                && let Some(pose) = resect(cameras[i], &seen_by[i], self.settings.outlier_px * 3.0)
            {
                self.frames[i].pose = pose;
                replaced += 1;
            }
        }
        replaced
    }

    /// Standard deviation of every shared parameter if it were free. Of the lens as if few sightings of a picture said something of
    /// their own, beside priors that count in full.
    pub(super) fn shared_sigma(&self, problem: &mut Problem, loss: Loss) -> [f64; SHARED] {
        let mut sigma = shared_sigma(problem, loss);
        let per_frame = problem.observations.len() as f64 / self.frames.len().max(1) as f64;
        let own = problem.pixel_sigma;
        problem.pixel_sigma *= (per_frame / INDEPENDENT).sqrt().max(1.0);
        sigma[FOCAL..].copy_from_slice(&shared_sigma(problem, loss)[FOCAL..]);
        problem.pixel_sigma = own;
        sigma
    }

    /// Prior sigma of every shared parameter; 0: it is known.
    fn shared_sigmas(&self) -> [f64; SHARED] {
        let s = &self.settings;
        let (mount, principal, radial) = (s.mount_sigma_deg.to_radians(), s.principal_sigma, s.radial_sigma);
        let lens = [s.focal_sigma, s.aspect_sigma, principal, principal, radial, radial];
        [mount, mount, mount, s.delay_sigma_s, lens[0], lens[1], lens[2], lens[3], lens[4], lens[5]]
    }

    /// Shared parameters whose sigma the pictures cut below the wanted fraction of its prior.
    pub(super) fn observable(&self, sigma: &[f64; SHARED]) -> [bool; SHARED] {
        let prior = self.shared_sigmas();
        let tied = self.frames.iter().filter(|f| f.pairs > 0).count();
        // Fewer frames than shared parameters cannot tell them from their own errors, whatever the formula says.
        let least = prior.iter().filter(|s| **s > 0.0).count().max(LEAST_TIED);
        // Where nothing but the pictures says how large things are, a focal length that is off takes the whole scene with it.
        let sure = |k: usize| if k == FOCAL && self.standing.by_pictures { PICTURES_SURE } else { 1.0 };
        let wanted = |k: usize| self.settings.observable_ratio * sure(k) * prior[k];
        let tells = |k: usize| tied > least && prior[k] > 0.0 && sigma[k] < wanted(k);
        // A focal length that is free answers for an aspect that is not, many times over.
        std::array::from_fn(|k| if k == ASPECT { prior[k] > 0.0 && tells(FOCAL) } else { tells(k) })
    }

    fn shared_estimate(&self, problem: &Problem, sigma: &[f64; SHARED]) -> SharedEstimate {
        let (m, lens) = (super::so3::log(problem.shared.mount), problem.shared.lens);
        SharedEstimate {
            mount_deg: [m.x, m.y, m.z].map(f64::to_degrees),
            mount_sigma_deg: [sigma[0], sigma[1], sigma[2]].map(f64::to_degrees),
            mount_estimated: [problem.free[0], problem.free[1], problem.free[2]],
            delay_s: problem.shared.delay,
            delay_sigma_s: sigma[3],
            delay_estimated: problem.free[3],
            focal_scale: lens.log_focal.exp(),
            focal_sigma: sigma[FOCAL],
            focal_estimated: problem.free[FOCAL],
            aspect: lens.log_aspect.exp(),
            aspect_sigma: sigma[ASPECT],
            aspect_estimated: problem.free[ASPECT],
            principal: lens.shift.to_array(),
            principal_sigma: [sigma[PRINCIPAL], sigma[PRINCIPAL + 1]],
            principal_estimated: [problem.free[PRINCIPAL], problem.free[PRINCIPAL + 1]],
            radial: [lens.radial.k1, lens.radial.k2],
            radial_sigma: [sigma[RADIAL], sigma[RADIAL + 1]],
            radial_estimated: [problem.free[RADIAL], problem.free[RADIAL + 1]],
        }
    }

    pub(super) fn refined_point(&self, p: &Triangulated, seen: &[Sighting]) -> RefinedPoint {
        let mut color = [0u32; 3];
        for s in seen {
            let c = self.frames[s.frame as usize].colors[s.feature as usize];
            (0..3).for_each(|k| color[k] += u32::from(c[k]));
        }
        RefinedPoint {
            position: p.world.to_array(),
            color: color.map(|c| (c / seen.len().max(1) as u32) as u8),
            views: seen.len() as u32,
            error_px: p.rms_px as f32,
            angle_deg: p.angle.to_degrees() as f32,
        }
    }

    /// All tracks at the final poses: points, depth ranges, ground heights and the errors that remain.
    fn harvest(&mut self, tracks: &Tracks, report: &mut RefineReport) {
        let cameras = self.cameras();
        let mut depths: Vec<Vec<f32>> = vec![Vec::new(); self.frames.len()];
        let mut heights: Vec<Vec<f64>> = vec![Vec::new(); self.frames.len()];
        let mut errors = Vec::new();
        self.points.clear();
        let every: Vec<u32> = (0..tracks.len() as u32).collect();
        for Placed { all, found } in self.placed(&cameras, tracks, &every, self.settings.outlier_px, |_| true) {
            let Some((p, seen)) = found else {
                report.outlier_observations += all;
                continue;
            };
            report.outlier_observations += all - seen.len();
            for s in &seen {
                let frame = s.frame as usize;
                let (camera, pixel) = (&cameras[frame], self.frames[frame].keypoints()[s.feature as usize]);
                depths[frame].push(camera.local(p.world).z as f32);
                heights[frame].push(p.world.z);
                if let Some(q) = camera.project(p.world) {
                    errors.push((q - glam::DVec2::new(pixel[0].into(), pixel[1].into())).length());
                }
            }
            self.points.push(self.refined_point(&p, &seen));
        }
        self.recent.clear();
        report.points = self.points.len();
        report.observations = errors.len();
        report.reprojection_rms_px = (errors.iter().map(|e| e * e).sum::<f64>() / errors.len().max(1) as f64).sqrt();
        report.reprojection_median_px = median(&mut errors);
        for (i, frame) in self.frames.iter_mut().enumerate() {
            frame.tied = depths[i].len() >= TIED;
            frame.known.loose = false;
            // What was left out for it is no longer asked.
            frame.known.apart &= frame.unplaced;
            frame.known.depths = frame.tied.then(|| (quantile(&mut depths[i], 0.01), quantile(&mut depths[i], 0.99)));
            self.grounds[i] = frame.tied.then(|| median(&mut heights[i]));
        }
        let mut grounds: Vec<f64> = self.grounds.iter().flatten().copied().collect();
        if !grounds.is_empty() {
            self.ground = Some(median(&mut grounds));
        }
        report.frames_tied = self.frames.iter().filter(|f| f.tied).count();
        report.rotations_refused = self.frames.iter().filter(|f| f.rotation_refused).count();
        report.ground_m = self.ground;
    }
}

pub(super) fn quantile(values: &mut [f32], q: f64) -> f32 {
    let k = ((values.len() - 1) as f64 * q).round() as usize;
    *values.select_nth_unstable_by(k, f32::total_cmp).1
}

/// Telemetry pose with the shared errors taken out.
pub(super) fn corrected(pose: &Pose, velocity: DVec3, shared: &super::problem::Shared) -> Pose {
    Pose { rotation: (pose.rotation * shared.mount).normalize(), center: pose.center + velocity * shared.delay }
}
