//! Cards made up by seed: a lens that nobody has calibrated, a way of flying, positions of some kind, and key points as a network would
//! find them, with noise, strangers, and descriptors that change with the direction from which a point is seen.
#![allow(clippy::unwrap_used)] // a test may

use std::collections::HashMap;
use std::fmt;

use config::refine::RefineSettings;
use glam::{DMat3, DQuat, DVec2, DVec3};
use models::camera::{Intrinsics, Pose, PoseSigma, View};
use models::onnx::features::Features;
use models::refine::{RefineReport, Refiner};
use rand::{Rng, SeedableRng};
use rand_pcg::Pcg64Mcg;

/// A picture in which key points are found, and about how many there are in it, at the size at which they are found in flight.
const SIZE: (u32, u32) = (640, 480);
const SEEN: f64 = 650.0;
/// Noise of a key point along each axis, pixels.
const NOISE: f64 = 0.7;

/// How pictures were taken.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Kind {
    Nadir,
    Oblique,
    Orbit,
    Street,
}

/// What they say of their places.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Gps {
    None,
    /// Of somewhere else, each.
    Wrong,
    Noisy,
    /// Every other picture has none.
    Half,
}

struct Point {
    place: DVec3,
    /// Side from which it is seen; zero: from anywhere.
    normal: DVec3,
    looks: [f64; 64],
    /// How its looks change with the direction.
    turns: [[f64; 64]; 3],
}

/// A card and its truth.
pub struct SimulatedCard {
    pub kind: Kind,
    pub gps: Gps,
    pub truth: Vec<Pose>,
    pub k1: f64,
    /// True over stated focal length.
    pub focal_off: f64,
    overlap: f64,
    /// How many times as large as [`SIZE`] its pictures are when key points are found, with as many times as many of them.
    times: u32,
    lens: Intrinsics,
    told: Vec<(Pose, PoseSigma)>,
    features: Vec<Features>,
    /// Of every key point the point it shows.
    of: Vec<Vec<usize>>,
    /// Of every picture the directions in which its points are seen.
    directions: Vec<HashMap<usize, DVec3>>,
}

impl fmt::Display for SimulatedCard {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(
            f,
            "{:?}, GPS {:?}, {} pictures, overlap {:.2}, k1 {:.2}, focal x {:.2}",
            self.kind,
            self.gps,
            self.truth.len(),
            self.overlap,
            self.k1,
            self.focal_off
        )
    }
}

pub fn name(i: usize) -> String {
    format!("{i:03}.jpg")
}

fn normal(rng: &mut Pcg64Mcg) -> f64 {
    (0..12).map(|_| rng.random_range(-0.5..0.5)).sum()
}

fn vector(rng: &mut Pcg64Mcg, sigma: f64) -> DVec3 {
    DVec3::new(normal(rng), normal(rng), normal(rng)) * sigma
}

/// A camera at `center` that looks to `at`, held level.
fn looking(center: DVec3, at: DVec3) -> Pose {
    let forward = (at - center).normalize();
    let right = forward.cross(DVec3::Z).try_normalize().unwrap_or(DVec3::X);
    Pose { rotation: DQuat::from_mat3(&DMat3::from_cols(right, forward.cross(right), forward)).normalize(), center }
}

impl SimulatedCard {
    /// Its key points are found in pictures `times` as large as in flight: twice where pictures have 12 megapixels and nobody waits.
    pub fn new(seed: u64, times: u32) -> Self {
        let mut rng = Pcg64Mcg::seed_from_u64(seed ^ 0xCA2D);
        let kind = [Kind::Nadir, Kind::Oblique, Kind::Orbit, Kind::Street][(seed % 4) as usize];
        let gps = [Gps::None, Gps::Noisy, Gps::Half, Gps::Wrong][rng.random_range(0..4)];
        let (k1, focal_off) = (rng.random_range(-0.3..0.1), rng.random_range(0.8..1.2));
        let (width, height) = (times * SIZE.0, times * SIZE.1);
        let focal = f64::from(width) * rng.random_range(0.65..1.1);
        let stated = (focal / focal_off) as f32;
        let (cx, cy) = (width as f32 / 2.0, height as f32 / 2.0);
        let lens = Intrinsics { width, height, fx: stated, fy: stated, cx, cy };
        let count = rng.random_range(12..=60usize);
        let overlap = rng.random_range(0.3..0.85);
        let (mut truth, points) = match kind {
            Kind::Nadir | Kind::Oblique => survey(&mut rng, kind, count, overlap, (focal, times)),
            Kind::Orbit => orbit(&mut rng, count, times),
            Kind::Street => street(&mut rng, count, times),
        };
        for pose in &mut truth {
            pose.rotation = (pose.rotation * DQuat::from_scaled_axis(vector(&mut rng, 0.03))).normalize();
        }
        let told = truth.iter().enumerate().map(|(i, p)| told(&mut rng, gps, i, p)).collect();
        let mut card = Self {
            kind,
            gps,
            truth,
            k1,
            focal_off,
            overlap,
            times,
            lens,
            told,
            features: Vec::new(),
            of: Vec::new(),
            directions: Vec::new(),
        };
        for i in 0..card.truth.len() {
            card.take(&mut rng, i, &points, focal);
        }
        card
    }

    /// Key points of picture `i`.
    fn take(&mut self, rng: &mut Pcg64Mcg, i: usize, points: &[Point], focal: f64) {
        let pose = self.truth[i];
        let size = DVec2::new(self.lens.width.into(), self.lens.height.into());
        let mut seen = Vec::new();
        for (k, p) in points.iter().enumerate() {
            let away = p.place - pose.center;
            if p.normal != DVec3::ZERO && p.normal.dot(away) > -0.2 * away.length() {
                continue;
            }
            let q = pose.rotation.conjugate() * away;
            let n = q.truncate() / q.z;
            let r2 = n.length_squared();
            let bent = 1.0 + self.k1 * r2;
            // Beyond where the polynomial turns back nothing is seen.
            if q.z < 0.5 || 1.0 + 3.0 * self.k1 * r2 < 0.2 {
                continue;
            }
            let at = n * bent * focal + size / 2.0;
            if at.min_element() > 2.0 && (size - at).min_element() > 2.0 {
                seen.push((k, at, away.normalize(), q.z));
            }
        }
        // Near things first, as they are larger; then chance.
        let share = (f64::from(self.times) * SEEN / seen.len().max(1) as f64).min(0.7);
        let (mut features, mut of, mut directions) = (Features::default(), Vec::new(), HashMap::new());
        for (k, at, direction, _) in seen {
            // The same points are found again in most pictures.
            let liked = points[k].looks[0].abs() / (1.0 / 8.0) < share * 1.2;
            if !(liked && rng.random_bool(0.8)) {
                continue;
            }
            let at = at + DVec2::new(normal(rng), normal(rng)) * NOISE;
            let stranger = rng.random_bool(0.15);
            let point = &points[if stranger { rng.random_range(0..points.len()) } else { k }];
            let d: [f64; 64] = std::array::from_fn(|j| {
                let turned: f64 = (0..3).map(|a| point.turns[a][j] * direction[a]).sum();
                point.looks[j] + turned + 0.04 * normal(rng)
            });
            features.keypoints.push(at.as_vec2().to_array());
            features.descriptors.extend(d.iter().map(|x| *x as f32));
            features.scores.push(1.0);
            of.push(if stranger { usize::MAX } else { k });
            directions.insert(k, direction);
        }
        self.features.push(features);
        self.of.push(of);
        self.directions.push(directions);
    }

    /// Pictures that anybody could place: of the largest group whose members each see 25 points and more that two others of it see, from
    /// directions no more than 40° apart.
    pub fn overlapping(&self) -> Vec<usize> {
        let n = self.truth.len();
        let common = |a: usize, b: usize| -> Vec<usize> {
            let near = |k: &&usize| self.directions[b].get(k).is_some_and(|d| d.dot(self.directions[a][*k]) > 0.77);
            self.of[a].iter().filter(|k| **k != usize::MAX && self.of[b].contains(k)).filter(near).copied().collect()
        };
        let table: Vec<Vec<Vec<usize>>> =
            (0..n).map(|a| (0..n).map(|b| if a == b { vec![] } else { common(a, b) }).collect()).collect();
        let mut best: Vec<usize> = Vec::new();
        for start in 0..n {
            let Some(second) = (0..n).max_by_key(|b| table[start][*b].len()).filter(|b| table[start][*b].len() >= 60)
            else {
                continue;
            };
            let mut group = vec![start, second];
            loop {
                let joins = |i: &usize| {
                    let mut count: HashMap<usize, usize> = HashMap::new();
                    group
                        .iter()
                        .filter(|g| table[*i][**g].len() >= 30)
                        .flat_map(|g| &table[*i][*g])
                        .for_each(|k| *count.entry(*k).or_default() += 1);
                    count.values().filter(|c| **c >= 2).count() >= 25
                };
                let Some(next) = (0..n).filter(|i| !group.contains(i)).find(joins) else { break };
                group.push(next);
            }
            if group.len() > best.len() {
                best = group;
            }
            if best.len() * 2 > n {
                break;
            }
        }
        if best.len() > 2 { best } else { Vec::new() }
    }

    /// As a card whose pictures say nothing of how they were turned is settled; true where nothing says where the scene is.
    pub fn settle(&self) -> (Refiner, RefineReport, bool) {
        let settings = RefineSettings {
            solve_seconds: 600.0,
            feature_side: self.times * RefineSettings::default().feature_side,
            max_features: self.times as usize * RefineSettings::default().max_features,
            mount_sigma_deg: 0.0,
            delay_sigma_s: 0.0,
            focal_sigma: 0.1,
            radial_sigma: 0.05,
            principal_sigma: 0.02,
            aspect_sigma: 0.005,
            ..Default::default()
        };
        let mut refiner = Refiner::without_network(&settings).unwrap();
        for (i, features) in self.features.iter().enumerate() {
            let (pose, sigma) = self.told[i];
            let view = View { intrinsics: self.lens, pose };
            refiner.collect_features(&name(i), i as u64 * 2_000_000_000, &view, &sigma, features.clone()).unwrap();
        }
        let placed = refiner.place_all().unwrap();
        let floats = self.gps == Gps::None || placed.placed < 3 || refiner.take_positions().is_none();
        let look = |refiner: &mut Refiner| {
            let report = refiner.solve().unwrap();
            refiner.judge();
            if !refiner.leave_out_apart() {
                return report;
            }
            let report = refiner.solve().unwrap();
            refiner.judge();
            report
        };
        let mut report = look(&mut refiner);
        for _ in 0..2 {
            refiner.relink().unwrap();
            report = look(&mut refiner);
        }
        (refiner, report, floats)
    }
}

fn told(rng: &mut Pcg64Mcg, gps: Gps, i: usize, truth: &Pose) -> (Pose, PoseSigma) {
    let unknown = PoseSigma { position_m: [f32::INFINITY; 3], rotation_rad: [f32::INFINITY; 3] };
    let down = Pose { rotation: DQuat::from_xyzw(1.0, 0.0, 0.0, 0.0), center: DVec3::new(0.0, 0.0, 50.0) };
    let noise = DVec3::new(normal(rng) * 1.5, normal(rng) * 1.5, normal(rng) * 2.5);
    let known = PoseSigma { position_m: [1.5, 1.5, 2.5], rotation_rad: [0.5, 0.5, 3.0] };
    match gps {
        Gps::None => (down, unknown),
        Gps::Half if i % 2 == 1 => (down, unknown),
        Gps::Noisy | Gps::Half => (Pose { center: truth.center + noise, ..down }, known),
        Gps::Wrong => (Pose { center: vector(rng, 200.0), ..down }, known),
    }
}

fn point(rng: &mut Pcg64Mcg, place: DVec3, normal_: DVec3) -> Point {
    let mut of = || std::array::from_fn(|_| normal(rng) / 8.0);
    Point { place, normal: normal_, looks: of(), turns: std::array::from_fn(|_| of()) }
}

/// Lines flown back and forth, 50 m above ground with relief.
fn survey(
    rng: &mut Pcg64Mcg,
    kind: Kind,
    count: usize,
    overlap: f64,
    (focal, times): (f64, u32),
) -> (Vec<Pose>, Vec<Point>) {
    let [wide, long] = [SIZE.0, SIZE.1].map(|side| f64::from(times * side) / focal * 50.0);
    // Three pictures must see a point somewhere.
    let (along, across) = (long * (1.0 - overlap.max(0.6)), wide * (1.0 - overlap));
    let lines = ((count as f64).sqrt() * 0.8).ceil() as usize;
    let each = count.div_ceil(lines);
    let mut poses = Vec::new();
    for i in 0..count {
        let (line, k) = (i / each, i % each);
        let back = line % 2 == 1;
        let y = (if back { each - 1 - k } else { k }) as f64 * along;
        let center = DVec3::new(line as f64 * across, y, 50.0) + vector(rng, 1.0);
        let ahead = if kind == Kind::Oblique { 40.0 } else { 0.01 };
        poses.push(looking(center, DVec3::new(center.x, center.y + ahead, 0.0)));
    }
    let reach = if kind == Kind::Oblique { 140.0 } else { 0.0 };
    let (width, length) = (lines as f64 * across + 2.0 * wide, each as f64 * along + 2.0 * long + reach);
    // Detection keeps about a third of what is there.
    let dense = 3.0 * f64::from(times) * SEEN / (wide * long);
    let total = ((width * length * dense) as usize).min(60_000 * times as usize);
    let phase = rng.random_range(0.0..6.0);
    let points = (0..total)
        .map(|_| {
            let (x, y) = (rng.random_range(0.0..width) - wide, rng.random_range(0.0..length) - long);
            let hill = 2.5 * (x * 0.05 + phase).sin() * (y * 0.04).cos();
            let roof = if rng.random_bool(0.15) { rng.random_range(2.0..9.0) } else { 0.0 };
            point(rng, DVec3::new(x, y, hill + roof), DVec3::ZERO)
        })
        .collect();
    (poses, points)
}

/// Around a building, 25 m away.
fn orbit(rng: &mut Pcg64Mcg, count: usize, times: u32) -> (Vec<Pose>, Vec<Point>) {
    let pose = |i: usize, rng: &mut Pcg64Mcg| {
        let angle = std::f64::consts::TAU * i as f64 / count as f64;
        let center = DVec3::new(angle.cos() * 25.0, angle.sin() * 25.0, 12.0) + vector(rng, 0.6);
        looking(center, DVec3::new(0.0, 0.0, 4.0) + vector(rng, 0.7))
    };
    let poses = (0..count).map(|i| pose(i, rng)).collect();
    let mut points = Vec::new();
    for _ in 0..5000 * times {
        let (u, v) = (rng.random_range(-7.0..7.0), rng.random_range(0.0..9.0));
        let side = rng.random_range(0..4);
        let turn = DQuat::from_rotation_z(std::f64::consts::FRAC_PI_2 * f64::from(side));
        let depth = 7.0 + rng.random_range(-0.5..0.5);
        points.push(point(rng, turn * DVec3::new(depth, u, v), turn * DVec3::X));
    }
    for _ in 0..3500 * times {
        let place =
            DVec3::new(rng.random_range(-25.0..25.0), rng.random_range(-25.0..25.0), rng.random_range(-0.3..0.3));
        points.push(point(rng, place, DVec3::Z));
    }
    (poses, points)
}

/// Along a street of houses, looking askew at one side.
fn street(rng: &mut Pcg64Mcg, count: usize, times: u32) -> (Vec<Pose>, Vec<Point>) {
    let step = rng.random_range(1.0..2.2);
    let pose = |i: usize, rng: &mut Pcg64Mcg| {
        let center = DVec3::new(i as f64 * step, 0.0, 1.7) + vector(rng, 0.15);
        looking(center, center + DVec3::new(0.8, 1.0, 0.1) + vector(rng, 0.06))
    };
    let poses: Vec<Pose> = (0..count).map(|i| pose(i, rng)).collect();
    let length = count as f64 * step + 40.0;
    let mut points = Vec::new();
    for _ in 0..(f64::from(times) * length * 120.0) as usize {
        let x = rng.random_range(-5.0..length);
        let setback = 8.0 + 1.5 * (x * 0.3).sin() + rng.random_range(-0.4..0.4);
        let place = DVec3::new(x, setback, rng.random_range(0.0..9.0));
        points.push(point(rng, place, -DVec3::Y));
    }
    for _ in 0..(f64::from(times) * length * 25.0) as usize {
        let place = DVec3::new(rng.random_range(-5.0..length), rng.random_range(1.0..8.0), 0.0);
        points.push(point(rng, place, DVec3::Z));
    }
    (poses, points)
}
