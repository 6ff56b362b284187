//! The bundle adjustment's unknowns and residuals: key-frame poses, points, and the few parameters all frames
//! share; reprojection errors against telemetry priors, each with a robust loss.

use super::calibration::{Calibration, LENS};
use super::so3;
use crate::camera::{Intrinsics, Pinhole, Pose};
use glam::{DMat3, DQuat, DVec2, DVec3};

/// Shared parameters: mount misalignment (3), delay of positions, and the lens.
pub(crate) const SHARED: usize = FOCAL + LENS;
/// Index of the delay among them.
const DELAY: usize = 3;
/// Index of the first parameter of the lens among them.
pub(crate) const FOCAL: usize = 4;
/// Index of the log aspect.
pub(crate) const ASPECT: usize = FOCAL + 1;
/// Index of the principal point's shift along x; that along y follows.
pub(crate) const PRINCIPAL: usize = FOCAL + 2;
/// Index of the first radial term.
pub(crate) const RADIAL: usize = FOCAL + 4;

/// Sightings of one picture that count as independent when the lens is asked for. What no such lens holds (a rolling shutter,
/// leaves in the wind, relief under a patch) shifts whole regions of a picture together: on brighton_beach (480 sightings per
/// picture) a free focal length went 13 % off with a formal sigma of 1.3 %.
pub(crate) const INDEPENDENT: f64 = 8.0;

/// What all key frames have in common and telemetry does not know.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Shared {
    /// True camera axes in the camera axes that telemetry reports: `R = R_telemetry · mount`.
    pub mount: DQuat,
    /// True position = reported position + delay · velocity; seconds (or metres, with unit velocities).
    pub delay: f64,
    /// What the given lens lacks.
    pub lens: Calibration,
}

impl Default for Shared {
    fn default() -> Self {
        Self { mount: DQuat::IDENTITY, delay: 0.0, lens: Calibration::default() }
    }
}

/// Telemetry of one key frame. A weight is one over sigma; 0 = nothing is known.
#[derive(Clone, Copy, Debug)]
pub(crate) struct PosePrior {
    pub pose: Pose,
    /// Along-track velocity, m/s (unit vector where there are no times, zero where unknown).
    pub velocity: DVec3,
    pub position_weight: DVec3,
    pub rotation_weight: DVec3,
}

/// One sighting of a point.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Observation {
    pub camera: u32,
    /// As found in the picture, radial distortion not taken out.
    pub pixel: [f32; 2],
}

/// What is known of the place of a surveyed point.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Anchor {
    pub place: DVec3,
    /// One over sigma of each axis.
    pub weight: DVec3,
}

/// Robust loss on a squared residual in units of its sigma.
#[derive(Clone, Copy, Debug)]
pub(crate) enum Loss {
    /// Quadratic to `k` sigma, linear beyond: convex, for poses that are still far off.
    Huber(f64),
    /// Logarithmic beyond `k` sigma: wrong matches lose their pull.
    Cauchy(f64),
}

impl Loss {
    /// (cost, weight of the normal equations) at squared residual `s`.
    pub fn at(self, s: f64) -> (f64, f64) {
        match self {
            Loss::Huber(k) if s <= k * k => (s, 1.0),
            Loss::Huber(k) => (2.0 * k * s.sqrt() - k * k, k / s.sqrt()),
            Loss::Cauchy(k) => (k * k * (s / (k * k)).ln_1p(), 1.0 / (1.0 + s / (k * k))),
        }
    }
}

/// A telemetry value beyond three sigma is doubted (a GPS height that jumps, a heading turned around).
const PRIOR_LOSS: Loss = Loss::Cauchy(3.0);
/// A surveyed point beyond three sigma is doubted as telemetry is.
const ANCHOR_LOSS: Loss = Loss::Cauchy(3.0);
/// Residual charged for a point behind its camera, pixels: more than any it can cause in front.
const BEHIND_PX: f64 = 2000.0;

/// Everything the adjustment works on.
pub(crate) struct Problem {
    /// So many of the poses, the first ones, are unknown; the others stand still.
    pub moving: usize,
    pub intrinsics: Vec<Intrinsics>,
    pub poses: Vec<Pose>,
    pub priors: Vec<PosePrior>,
    pub points: Vec<DVec3>,
    /// Observations of point i: `starts[i]..starts[i + 1]`.
    pub starts: Vec<u32>,
    pub observations: Vec<Observation>,
    /// Of the last points, in their order.
    pub anchors: Vec<Anchor>,
    pub shared: Shared,
    /// One over the prior sigma of each shared parameter.
    pub shared_weight: [f64; SHARED],
    pub free: [bool; SHARED],
    pub pixel_sigma: f64,
}

/// One frame's or the shared parameters' priors, linearised: up to three robust groups of whitened residuals.
pub(crate) struct PriorRows {
    /// (residual, derivative by the frame's rotation and centre, by the shared parameters, weight).
    pub rows: [(f64, [f64; 6], [f64; SHARED], f64); 6],
    pub cost: f64,
}

impl Problem {
    pub fn camera(&self, i: usize) -> Pinhole {
        self.shared.lens.camera(self.poses[i], &self.intrinsics[i])
    }

    pub fn sightings(&self, point: usize) -> &[Observation] {
        &self.observations[self.starts[point] as usize..self.starts[point + 1] as usize]
    }

    /// Whitened residual of a surveyed point against its place, the weights of its axes, and its cost and weight in the sum;
    /// `None` of any other point.
    pub fn anchor_of(&self, point: usize) -> Option<(DVec3, DVec3, (f64, f64))> {
        let anchor = self.anchors.get(point.checked_sub(self.points.len() - self.anchors.len())?)?;
        let off = (self.points[point] - anchor.place) * anchor.weight;
        Some((off, anchor.weight, ANCHOR_LOSS.at(off.length_squared())))
    }

    /// Residual in pixels, when the point is in front.
    pub fn residual(&self, camera: &Pinhole, point: DVec3, o: &Observation) -> Option<DVec2> {
        let p = camera.local(point);
        let pixel = (p.z > 1e-6).then(|| self.shared.lens.radial.pixel(camera, p))?;
        Some(pixel - DVec2::new(o.pixel[0].into(), o.pixel[1].into()))
    }

    /// Total robust cost.
    pub fn cost(&self, loss: Loss) -> f64 {
        let cameras: Vec<Pinhole> = (0..self.poses.len()).map(|i| self.camera(i)).collect();
        let mut sum = self.shared_residuals().iter().map(|r| r * r).sum::<f64>();
        for i in 0..self.moving {
            sum += self.prior_rows(i).cost;
        }
        let per_px = 1.0 / self.pixel_sigma;
        for (i, p) in self.points.iter().enumerate() {
            sum += self.anchor_of(i).map_or(0.0, |(_, _, (cost, _))| cost);
            for o in self.sightings(i) {
                let r = self.residual(&cameras[o.camera as usize], *p, o).map_or(BEHIND_PX, |r| r.length());
                sum += loss.at((r * per_px).powi(2)).0;
            }
        }
        sum
    }

    /// Whitened residuals of the shared parameters against their own priors.
    pub fn shared_residuals(&self) -> [f64; SHARED] {
        let m = so3::log(self.shared.mount);
        let Calibration { log_focal, log_aspect, shift, radial } = self.shared.lens;
        let delay = self.shared.delay;
        let v = [m.x, m.y, m.z, delay, log_focal, log_aspect, shift.x, shift.y, radial.k1, radial.k2];
        std::array::from_fn(|k| v[k] * self.shared_weight[k])
    }

    /// Telemetry residuals of frame `i`: rotation (one robust group), east and north (one), up (one), so that a
    /// bad height costs the height alone.
    pub fn prior_rows(&self, i: usize) -> PriorRows {
        let prior = &self.priors[i];
        let pose = &self.poses[i];
        let turned = (prior.pose.rotation * self.shared.mount).conjugate() * pose.rotation;
        let e = so3::log(turned);
        let jr = so3::right_jacobian_inverse(e);
        let jl = jr.transpose();
        let shift = pose.center - prior.pose.center - prior.velocity * self.shared.delay;
        let (wr, wp) = (prior.rotation_weight, prior.position_weight);
        let (re, rp) = (e * wr, shift * wp);
        let (cost_r, weight_r) = PRIOR_LOSS.at(re.length_squared());
        let (cost_h, weight_h) = PRIOR_LOSS.at(rp.x * rp.x + rp.y * rp.y);
        let (cost_v, weight_v) = PRIOR_LOSS.at(rp.z * rp.z);
        let rotation = |k: usize| {
            let (row, mount) = (row(&jr, k) * wr[k], row(&jl, k) * -wr[k]);
            let mut by_shared = [0.0; SHARED];
            by_shared[..3].copy_from_slice(&mount.to_array());
            (re[k], [row.x, row.y, row.z, 0.0, 0.0, 0.0], by_shared, weight_r)
        };
        let position = |k: usize, weight: f64| {
            let mut by_pose = [0.0; 6];
            by_pose[3 + k] = wp[k];
            let mut by_shared = [0.0; SHARED];
            by_shared[DELAY] = -prior.velocity[k] * wp[k];
            (rp[k], by_pose, by_shared, weight)
        };
        PriorRows {
            rows: [
                rotation(0),
                rotation(1),
                rotation(2),
                position(0, weight_h),
                position(1, weight_h),
                position(2, weight_v),
            ],
            cost: cost_r + cost_h + cost_v,
        }
    }
}

fn row(m: &DMat3, k: usize) -> DVec3 {
    DVec3::new(m.x_axis[k], m.y_axis[k], m.z_axis[k])
}
