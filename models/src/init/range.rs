//! How far away the scene is, measured: features matched between neighbouring pictures and triangulated with the
//! known poses. A posed network searches only between the nearest and the farthest depth it is told.

use glam::{DVec3, Vec3};

use crate::camera::View;
use crate::onnx::features::Features;

use super::frame::Projector;

/// Cosine similarity below which a mutual nearest neighbour is no match (XFeat's own matcher: 0.82).
const MIN_COSINE: f32 = 0.82;
/// Rays closer to parallel than this say nothing about depth, radians.
const MIN_ANGLE: f64 = 0.03;
/// Largest distance of a triangulated point's projections from its keypoints, pixels; refined poses stay well below.
const MAX_ERROR_PX: f32 = 3.0;
/// Points needed before a range is believed.
const MIN_POINTS: usize = 24;
/// Beyond the measured 4th and 96th percentile, to hold what no feature sat on (tree tops, ditches).
const MARGIN: [f32; 2] = [0.8, 1.2];
/// Points kept; the oldest make way.
const MAX_POINTS: usize = 20_000;

/// Sparse points of the scene, good enough to bound depths.
#[derive(Debug, Default)]
pub struct DepthRange {
    points: Vec<Vec3>,
    next: usize,
}

impl DepthRange {
    /// Adds a point known from elsewhere (refinement's tracks, a finished depth map).
    pub fn push(&mut self, point: Vec3) {
        if !point.is_finite() {
            return;
        }
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

    /// Nearest and farthest depth to search in a view, from the points it sees, or from all of them when it sees too
    /// few; `None` while hardly anything is known.
    pub fn of(&self, view: &View) -> Option<[f32; 2]> {
        if self.points.len() < MIN_POINTS {
            return None;
        }
        let projector = Projector::new(view);
        let (w, h) = (view.intrinsics.width as f32, view.intrinsics.height as f32);
        let mut seen: Vec<f32> = Vec::new();
        let mut any: Vec<f32> = Vec::new();
        for &p in &self.points {
            if let Some((x, y, z)) = projector.project(p) {
                any.push(z);
                if x >= 0.0 && y >= 0.0 && x < w && y < h {
                    seen.push(z);
                }
            }
        }
        let depths = if seen.len() >= MIN_POINTS { &mut seen } else { &mut any };
        if depths.len() < MIN_POINTS {
            return None;
        }
        depths.sort_by(f32::total_cmp);
        let at = |share: f32| depths[((depths.len() - 1) as f32 * share) as usize];
        Some([at(0.04) * MARGIN[0], at(0.96) * MARGIN[1]])
    }
}

/// Pairs of features that are each other's nearest.
pub fn mutual_matches(a: &Features, b: &Features) -> Vec<(usize, usize)> {
    let best = |from: &Features, to: &Features| -> Vec<(usize, f32)> {
        (0..from.keypoints.len())
            .map(|i| {
                let d = from.descriptor(i);
                let mut top = (usize::MAX, f32::NEG_INFINITY);
                for j in 0..to.keypoints.len() {
                    let dot: f32 = d.iter().zip(to.descriptor(j)).map(|(x, y)| x * y).sum();
                    if dot > top.1 {
                        top = (j, dot);
                    }
                }
                top
            })
            .collect()
    };
    let (forth, back) = (best(a, b), best(b, a));
    forth
        .iter()
        .enumerate()
        .filter(|(i, (j, cosine))| *cosine >= MIN_COSINE && back.get(*j).is_some_and(|t| t.0 == *i))
        .map(|(i, (j, _))| (i, *j))
        .collect()
}

/// Midpoint of the shortest connection of two viewing rays; `None` when they are near parallel or diverge.
fn triangulate(a: &View, ka: [f32; 2], b: &View, kb: [f32; 2]) -> Option<Vec3> {
    let ray = |v: &View, k: [f32; 2]| {
        let i = &v.intrinsics;
        let d = DVec3::new(f64::from((k[0] - i.cx) / i.fx), f64::from((k[1] - i.cy) / i.fy), 1.0);
        (v.pose.rotation * d).normalize()
    };
    let (da, db) = (ray(a, ka), ray(b, kb));
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
    use glam::DQuat;

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
}
