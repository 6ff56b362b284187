//! A made-up survey whose truth is known.
#![allow(clippy::unwrap_used, dead_code)] // a test may; each test binary uses some of it

use config::refine::RefineSettings;
use glam::{DMat3, DQuat, DVec2, DVec3};
use models::camera::{Intrinsics, Pose, PoseSigma, View};
use models::onnx::features::Features;
use models::refine::{RefineReport, Refiner};
use rand::{Rng, SeedableRng};
use rand_pcg::Pcg64Mcg;

use crate::pose_errors::{PoseErrors, pose_errors};

pub const LENS: Intrinsics = Intrinsics { width: 640, height: 480, fx: 400.0, fy: 400.0, cx: 320.0, cy: 240.0 };
pub const SIGMA: PoseSigma = PoseSigma { position_m: [1.0; 3], rotation_rad: [0.05; 3] };
pub const SPEED: f64 = 5.0;

/// A world of points with one descriptor each, and the true and reported poses of a survey over it.
pub struct Survey {
    pub points: Vec<DVec3>,
    pub descriptors: Vec<[f32; 64]>,
    pub truth: Vec<Pose>,
    pub telemetry: Vec<Pose>,
    /// The lens that takes the pictures; [`LENS`] is what is said of it.
    pub lens: Intrinsics,
    pub rng: Pcg64Mcg,
}

pub fn normal(rng: &mut Pcg64Mcg) -> f64 {
    (0..12).map(|_| rng.random_range(-0.5..0.5)).sum()
}

pub fn vector(rng: &mut Pcg64Mcg, sigma: f64) -> DVec3 {
    DVec3::new(normal(rng), normal(rng), normal(rng)) * sigma
}

/// A camera that looks down, 12° ahead of straight down, its top towards `heading`.
pub fn looking_down(center: DVec3, heading: f64) -> Pose {
    let down = DMat3::from_cols(DVec3::X, -DVec3::Y, -DVec3::Z);
    let rotation = DQuat::from_rotation_z(-heading) * DQuat::from_mat3(&down) * DQuat::from_rotation_x(0.21);
    Pose { rotation, center }
}

impl Survey {
    /// Three lines of six pictures back and forth, 12 m apart, 50 m above ground with relief of ±3 m.
    pub fn new(seed: u64) -> Self {
        let mut rng = Pcg64Mcg::seed_from_u64(seed);
        let mut truth = Vec::new();
        for line in 0..3 {
            for k in 0..6 {
                let back = line % 2 == 1;
                let x = f64::from(if back { 5 - k } else { k }) * 12.0;
                let heading = if back { -1.57 } else { 1.57 };
                let jitter = vector(&mut rng, 1.0);
                truth.push(looking_down(DVec3::new(x, f64::from(line) * 14.0, 50.0) + jitter, heading));
            }
        }
        let points: Vec<DVec3> = (0..2500)
            .map(|_| {
                let mut at = |a: f64, b: f64| rng.random_range(a..b);
                DVec3::new(at(-45.0, 105.0), at(-40.0, 70.0), at(-3.0, 3.0))
            })
            .collect();
        let descriptors = points.iter().map(|_| std::array::from_fn(|_| normal(&mut rng) as f32)).collect();
        let telemetry = truth
            .iter()
            .map(|p| Pose {
                rotation: (p.rotation * DQuat::from_scaled_axis(vector(&mut rng, 0.03))).normalize(),
                center: p.center + vector(&mut rng, 0.5),
            })
            .collect();
        Self { points, descriptors, truth, telemetry, lens: LENS, rng }
    }

    /// Three more lines, across the first ones.
    pub fn crossed(mut self) -> Self {
        let turn = DQuat::from_rotation_z(1.57);
        let middle = DVec3::new(30.0, 14.0, 0.0);
        let across = |p: &Pose| Pose { rotation: turn * p.rotation, center: middle + turn * (p.center - middle) };
        for poses in [&mut self.truth, &mut self.telemetry] {
            let more: Vec<Pose> = poses.iter().map(across).collect();
            poses.extend(more);
        }
        self
    }

    /// What a feature network finds from pose `i`: key points with half a pixel of noise, one in ten with a
    /// stranger's descriptor.
    pub fn features(&mut self, pose: &Pose) -> Features {
        let mut out = Features::default();
        for (k, p) in self.points.iter().enumerate() {
            let q = pose.rotation.conjugate() * (*p - pose.center);
            let noise = DVec2::new(normal(&mut self.rng), normal(&mut self.rng)) * 0.5;
            let [f, c] = [[self.lens.fx, self.lens.fy], [self.lens.cx, self.lens.cy]]
                .map(|v| DVec2::from_array(v.map(f64::from)));
            let at = q.truncate() / q.z * f + c + noise;
            if q.z > 1.0 && at.x > 0.0 && at.y > 0.0 && at.x < 640.0 && at.y < 480.0 {
                let stranger = self.rng.random_range(0..10) == 0;
                let of = if stranger { self.rng.random_range(0..self.points.len()) } else { k };
                out.keypoints.push(at.as_vec2().to_array());
                out.descriptors.extend(self.descriptors[of].iter().map(|d| d + 0.05 * normal(&mut self.rng) as f32));
                out.scores.push(1.0);
            }
        }
        out
    }

    pub fn fly(&mut self, settings: &RefineSettings) -> (Refiner, RefineReport) {
        let mut refiner = Refiner::without_network(settings).unwrap();
        for i in 0..self.truth.len() {
            let features = self.features(&self.truth[i].clone());
            let view = View { intrinsics: LENS, pose: self.telemetry[i] };
            refiner.add_features(&name(i), time(i), &view, &SIGMA, features).unwrap();
        }
        let report = refiner.solve().unwrap();
        (refiner, report)
    }

    pub fn errors(&self, refiner: &Refiner) -> (PoseErrors, PoseErrors) {
        let after: Vec<Pose> = (0..self.truth.len()).map(|i| refiner.pose(&name(i)).unwrap()).collect();
        let (before, after) = (pose_errors(&self.telemetry, &self.truth), pose_errors(&after, &self.truth));
        println!("before {before:?}\nafter  {after:?}");
        (before, after)
    }
}

pub fn name(i: usize) -> String {
    format!("{i:03}.jpg")
}

pub fn time(i: usize) -> u64 {
    1_000_000_000 + i as u64 * (12.0 / SPEED * 1e9) as u64
}

pub fn noise_features(seed: u64) -> Features {
    let mut rng = Pcg64Mcg::seed_from_u64(seed);
    let mut out = Features::default();
    for _ in 0..600 {
        out.keypoints.push([rng.random_range(1.0..639.0), rng.random_range(1.0..479.0)]);
        out.descriptors.extend((0..64).map(|_| normal(&mut rng) as f32));
        out.scores.push(1.0);
    }
    out
}
