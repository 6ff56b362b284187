//! How far away the scene is, measured: features matched between neighbouring pictures and triangulated with the
//! known poses. A posed network searches only between the nearest and the farthest depth it is told.

use std::sync::OnceLock;

use glam::Vec3;

use crate::camera::{Pinhole, Projector, View};
use crate::onnx::features::Features;

use super::ground::Ground;

/// Cosine similarity below which a mutual nearest neighbour is no match (XFeat's own matcher: 0.82).
const MIN_COSINE: f32 = 0.82;
/// Rays closer to parallel than this say nothing about depth, radians.
const MIN_ANGLE: f64 = 0.03;
/// Largest distance of a triangulated point's projections from its keypoints, pixels of the picture that the features
/// were found in; refined poses stay well below.
const MAX_ERROR_PX: f32 = 2.0;
/// Points needed before a range is believed.
const MIN_POINTS: usize = 24;
/// Cells of the picture in which neighbours are looked for.
const COLUMNS: usize = 8;
const ROWS: usize = 6;
/// Points whose median tells the depth of a place.
const ENOUGH: usize = 8;
/// Inverse depths this share away from their surroundings' are wrong matches: roofs and tree tops stay well within, seen
/// from where aircraft fly.
const ODD: f32 = 0.35;
/// Share of the points beyond the bounds, at either end.
const QUANTILE: f32 = 0.04;
/// Beyond those percentiles, to hold what no feature sat on (tree tops, ditches).
const MARGIN: [f32; 2] = [0.8, 1.2];
/// Margin where the ground says how far the picture's corners are.
const GROUND_MARGIN: [f32; 2] = [0.9, 1.08];
/// Points kept; the oldest make way.
pub const MAX_POINTS: usize = 20_000;

/// Sparse points of the scene, good enough to bound depths.
#[derive(Debug, Default)]
pub struct DepthRange {
    points: Vec<Vec3>,
    next: usize,
    /// Found when it is first asked for after the points changed.
    ground: OnceLock<Option<Ground>>,
}

impl DepthRange {
    /// Adds a point known from elsewhere (refinement's tracks, a finished depth map).
    pub fn push(&mut self, point: Vec3) {
        if !point.is_finite() {
            return;
        }
        self.ground.take();
        if self.points.len() < MAX_POINTS {
            self.points.push(point);
        } else {
            self.points[self.next] = point;
            self.next = (self.next + 1) % MAX_POINTS;
        }
    }

    /// Points so far.
    pub fn len(&self) -> usize {
        self.points.len()
    }

    /// Matches and triangulates two pictures; returns how many points that gave.
    pub fn measure(&mut self, a: (&View, &Features), b: (&View, &Features)) -> usize {
        let mut count = 0;
        let (pa, pb) = (Projector::new(a.0), Projector::new(b.0));
        for (i, j) in mutual_matches(a.1, b.1) {
            let (ka, kb) = (a.1.keypoints[i], b.1.keypoints[j]);
            let Some(p) = triangulate(a.0, ka, b.0, kb) else { continue };
            let near = |projector: &Projector, k: [f32; 2]| {
                projector.project(p).is_some_and(|(x, y, _)| (x - k[0]).hypot(y - k[1]) < MAX_ERROR_PX)
            };
            if near(&pa, ka) && near(&pb, kb) {
                self.push(p);
                count += 1;
            }
        }
        count
    }

    /// Nearest and farthest depth to search in a view, from the ground below it and the points it sees, or from all
    /// points when it sees too few and there is no ground; `None` while hardly anything is known.
    pub fn of(&self, view: &View) -> Option<[f32; 2]> {
        if self.points.len() < MIN_POINTS {
            return None;
        }
        let projector = Projector::new(view);
        let (w, h) = (view.intrinsics.width as f32, view.intrinsics.height as f32);
        let mut seen: Vec<(f32, f32, f32)> = Vec::new();
        let mut any: Vec<f32> = Vec::new();
        for &p in &self.points {
            if let Some((x, y, z)) = projector.project(p) {
                any.push(z);
                if x >= 0.0 && y >= 0.0 && x < w && y < h {
                    seen.push((x, y, z));
                }
            }
        }
        let mut typical = without_odd_ones(&seen, (w, h));
        if let Some([near, far]) =
            self.ground.get_or_init(|| Ground::fit(&self.points)).as_ref().and_then(|g| g.depths(view))
        {
            typical.sort_by(f32::total_cmp);
            let at = |share: f32| typical.get((typical.len().saturating_sub(1) as f32 * share) as usize).copied();
            // What this picture sees of towers and pits counts, where it sees enough to tell.
            let known = typical.len() >= MIN_POINTS;
            let near = at(QUANTILE).filter(|_| known).map_or(near, |z| z.min(near));
            let far = at(1.0 - QUANTILE).filter(|_| known).map_or(far, |z| z.max(far));
            return Some([near * GROUND_MARGIN[0], far * GROUND_MARGIN[1]]);
        }
        let depths = if typical.len() >= MIN_POINTS { &mut typical } else { &mut any };
        if depths.len() < MIN_POINTS {
            return None;
        }
        depths.sort_by(f32::total_cmp);
        let at = |share: f32| depths[((depths.len() - 1) as f32 * share) as usize];
        Some([at(QUANTILE) * MARGIN[0], at(1.0 - QUANTILE) * MARGIN[1]])
    }
}

/// The points that have the depth of their surroundings. A wrong match that happens to lie on the epipolar line gets any
/// depth; its neighbours in the picture, on the same ground, roof or crown, do not share it.
fn without_odd_ones(seen: &[(f32, f32, f32)], size: (f32, f32)) -> Vec<f32> {
    let cell = |x: f32, y: f32| {
        let i = (x / size.0 * COLUMNS as f32) as usize;
        let j = (y / size.1 * ROWS as f32) as usize;
        (i.min(COLUMNS - 1), j.min(ROWS - 1))
    };
    let mut cells = vec![Vec::new(); COLUMNS * ROWS];
    for &(x, y, z) in seen {
        let (i, j) = cell(x, y);
        cells[j * COLUMNS + i].push(1.0 / z);
    }
    let typical: Vec<f32> = (0..COLUMNS * ROWS).map(|c| surroundings(&cells, c % COLUMNS, c / COLUMNS)).collect();
    seen.iter()
        .filter(|&&(x, y, z)| {
            let (i, j) = cell(x, y);
            (1.0 / z / typical[j * COLUMNS + i] - 1.0).abs() < ODD
        })
        .map(|p| p.2)
        .collect()
}

/// Median inverse depth of the smallest square of cells around one that holds enough points.
fn surroundings(cells: &[Vec<f32>], i: usize, j: usize) -> f32 {
    let mut near = Vec::new();
    for radius in 1..COLUMNS {
        near.clear();
        for row in j.saturating_sub(radius)..(j + radius + 1).min(ROWS) {
            for column in i.saturating_sub(radius)..(i + radius + 1).min(COLUMNS) {
                near.extend_from_slice(&cells[row * COLUMNS + column]);
            }
        }
        if near.len() >= ENOUGH {
            break;
        }
    }
    let middle = near.len() / 2;
    if near.is_empty() { f32::NAN } else { *near.select_nth_unstable_by(middle, f32::total_cmp).1 }
}

/// Pairs of features that are each other's nearest.
pub fn mutual_matches(a: &Features, b: &Features) -> Vec<(usize, usize)> {
    let none = (usize::MAX, f32::NEG_INFINITY);
    let mut forth = vec![none; a.keypoints.len()];
    let mut back = vec![none; b.keypoints.len()];
    for (i, best) in forth.iter_mut().enumerate() {
        for (j, best_back) in back.iter_mut().enumerate() {
            let cosine = dot(a.descriptor(i), b.descriptor(j));
            if cosine > best.1 {
                *best = (j, cosine);
            }
            if cosine > best_back.1 {
                *best_back = (i, cosine);
            }
        }
    }
    forth
        .iter()
        .enumerate()
        .filter(|(i, (j, cosine))| *cosine >= MIN_COSINE && back.get(*j).is_some_and(|t| t.0 == *i))
        .map(|(i, (j, _))| (i, *j))
        .collect()
}

/// Eight sums side by side, which the processor adds up at once.
fn dot(a: &[f32], b: &[f32]) -> f32 {
    let mut sums = [0.0f32; 8];
    for (x, y) in a.chunks_exact(8).zip(b.chunks_exact(8)) {
        for k in 0..8 {
            sums[k] += x[k] * y[k];
        }
    }
    sums.iter().sum()
}

/// Midpoint of the shortest connection of two viewing rays; `None` when they are near parallel or diverge.
fn triangulate(a: &View, ka: [f32; 2], b: &View, kb: [f32; 2]) -> Option<Vec3> {
    let (da, db) = (Pinhole::from(a).world_ray(ka).normalize(), Pinhole::from(b).world_ray(kb).normalize());
    let cross = da.cross(db);
    let sine2 = cross.length_squared();
    if sine2.is_nan() || sine2 <= MIN_ANGLE * MIN_ANGLE {
        return None;
    }
    let between = b.pose.center - a.pose.center;
    let s = between.cross(db).dot(cross) / sine2;
    let t = between.cross(da).dot(cross) / sine2;
    (s > 0.0 && t > 0.0).then(|| (0.5 * (a.pose.center + da * s + b.pose.center + db * t)).as_vec3())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::camera::{Intrinsics, Pose};
    use glam::{DQuat, DVec3};

    fn view(x: f64) -> View {
        let intrinsics = Intrinsics { width: 640, height: 480, fx: 400.0, fy: 400.0, cx: 320.0, cy: 240.0 };
        let rotation = DQuat::from_rotation_x(std::f64::consts::PI);
        View { intrinsics, pose: Pose { rotation, center: DVec3::new(x, 0.0, 60.0) } }
    }

    #[test]
    fn triangulation_inverts_projection_and_refuses_parallel_rays() {
        let p = Vec3::new(3.0, -4.0, 5.0);
        let (a, b) = (view(0.0), view(10.0));
        let px = |v: &View| Projector::new(v).project(p).map(|(x, y, _)| [x, y]).unwrap();
        assert!(triangulate(&a, px(&a), &b, px(&b)).unwrap().distance(p) < 1e-3);
        assert!(triangulate(&a, px(&a), &a, px(&a)).is_none());
    }

    #[test]
    fn the_range_holds_the_points_with_a_margin() {
        let mut range = DepthRange::default();
        assert!(range.of(&view(0.0)).is_none());
        for i in 0..100 {
            range.push(Vec3::new((i % 10) as f32, (i / 10) as f32, 0.1 * (i % 100) as f32));
        }
        range.push(Vec3::NAN);
        assert_eq!(range.len(), 100);
        let [near, far] = range.of(&view(0.0)).unwrap();
        assert!(near < 50.2 && near > 35.0 && far > 60.0 && far < 75.0, "{near} {far}");
    }

    #[test]
    fn wrong_matches_do_not_widen_the_range_and_a_tower_stays_in_it() {
        let mut range = DepthRange::default();
        for i in 0..400 {
            range.push(Vec3::new((i % 20) as f32 * 4.0 - 40.0, (i / 20) as f32 * 3.0 - 30.0, 0.0));
        }
        let clean = range.of(&view(0.0)).unwrap();
        // A tenth of wrong matches, scattered: far below the ground and close to the camera.
        for i in 0..44u32 {
            let (x, y) = ((i * 37 % 80) as f32 - 40.0, (i * 53 % 60) as f32 - 30.0);
            let z = if i % 2 == 0 { -90.0 } else { 35.0 };
            let toward = (60.0 - z) / 60.0;
            range.push(Vec3::new(x * toward, y * toward, z));
        }
        let spoilt = range.of(&view(0.0)).unwrap();
        assert!((spoilt[0] / clean[0] - 1.0).abs() < 0.02 && (spoilt[1] / clean[1] - 1.0).abs() < 0.02, "{spoilt:?}");
        // Points that belong together are no wrong matches, however far from the ground: 15 m of tower.
        for i in 0..60 {
            range.push(Vec3::new(10.0 + (i % 6) as f32, 5.0 + (i / 6 % 5) as f32, 10.0 + (i % 3) as f32 * 2.5));
        }
        assert!(range.of(&view(0.0)).unwrap()[0] < 45.0);
    }

    #[test]
    fn mutual_matches_are_the_same_both_ways_round() {
        let features = |seed: u32| {
            let mut f = Features::default();
            for i in 0..50u32 {
                let d: Vec<f32> =
                    (0..64u32).map(|c| ((i * 64 + c) * 31 % 97) as f32 - 48.0 + ((c * seed + i) % 5) as f32).collect();
                let norm = d.iter().map(|v| v * v).sum::<f32>().sqrt();
                f.descriptors.extend(d.iter().map(|v| v / norm));
                f.keypoints.push([i as f32, seed as f32]);
                f.scores.push(1.0);
            }
            f
        };
        let (a, b) = (features(1), features(3));
        let mut forth = mutual_matches(&a, &b);
        let mut back: Vec<_> = mutual_matches(&b, &a).into_iter().map(|(j, i)| (i, j)).collect();
        forth.sort_unstable();
        back.sort_unstable();
        assert_eq!(forth, back);
        assert!(forth.len() > 25, "{}", forth.len());
    }
}
