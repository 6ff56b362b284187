//! Conflicting depths resolved by multi-view consistency: a depth is checked in the pictures that see the same place.
//! Those that agree are averaged (one surface instead of a stack of layers) and gain confidence; those that float in
//! front of what another view sees through lose it.

use glam::{DMat3, DVec3, Mat3, Vec3};
use rayon::prelude::*;

use crate::camera::{Intrinsics, View};

use super::depth_frame::{DepthFrame, DepthGrid};

/// Depths in front of another view's surface by more than this many tolerances contradict it.
const CONFLICT: f32 = 2.5;
/// Confidence a sample keeps when nobody else sees it agree: coverage at the rim matters more than purity.
const ALONE: f32 = 0.5;
/// Confidence of a depth that only continues its surroundings: any real sample outweighs it.
const FILLED: f32 = 0.03;
/// Confidence at which another picture counts as knowing a place.
const KNOWS: f32 = 0.1;

/// Another view that has depths, as the one that is checked sees it. In f64 until the two are one: what is left is small.
struct Witness<'a> {
    grid: &'a DepthGrid,
    /// A pixel (x, y) with a depth d lies at `turn`·(x, y, 1)·d + `shift` there: its pixel times its depth, and its depth.
    turn: Mat3,
    shift: Vec3,
    /// The depth of what lies at a pixel there, seen from here.
    back: Vec3,
    back_shift: f32,
}

impl<'a> Witness<'a> {
    fn new(own: &View, other: &View, grid: &'a DepthGrid) -> Self {
        let axes = |v: &View| DMat3::from_quat(v.pose.rotation.normalize());
        let (here, there) = (axes(own), axes(other));
        let to_there = matrix(&other.intrinsics) * there.transpose();
        let back = here.transpose() * there * matrix(&other.intrinsics).inverse();
        let apart: DVec3 = own.pose.center - other.pose.center;
        Self {
            grid,
            turn: (to_there * here * matrix(&own.intrinsics).inverse()).as_mat3(),
            shift: (to_there * apart).as_vec3(),
            back: back.row(2).as_vec3(),
            back_shift: -(here.transpose() * apart).z as f32,
        }
    }

    /// What this view shows at each of the `places` of a row at `y`. Loop by loop, so that all but the second work on several
    /// places at once.
    fn reproject(&self, y: f32, places: &Places, shown: &mut Reprojected) {
        let n = places.depth.len();
        shown.hold(n);
        let (xs, depths) = (&places.x[..n], &places.depth[..n]);
        let [us, vs, zs] = [&mut shown.u, &mut shown.v, &mut shown.z].map(|values| &mut values[..n]);
        let at = &mut shown.at[..n];
        let ([a, b], [c, shift]) = ([self.turn.x_axis, self.turn.y_axis * y], [self.turn.z_axis, self.shift]);
        let (stride, width, height) = (self.grid.stride as f32, self.grid.width as f32, self.grid.height as f32);
        for k in 0..n {
            let (x, depth) = (xs[k], depths[k]);
            let z = (a.z * x + b.z + c.z) * depth + shift.z;
            let u = ((a.x * x + b.x + c.x) * depth + shift.x) / z;
            let v = ((a.y * x + b.y + c.y) * depth + shift.y) / z;
            // Whole numbers divide several times slower.
            let (column, line) = (u / stride, v / stride);
            let seen = (z > 1e-6) & (u >= 0.0) & (v >= 0.0) & (column < width) & (line < height);
            (us[k], vs[k], zs[k]) = (u, v, z);
            at[k] = if seen { line as i32 * self.grid.width as i32 + column as i32 } else { -1 };
        }
        let (depth, confidence) = (&mut shown.depth[..n], &mut shown.confidence[..n]);
        for k in 0..n {
            let at = at[k] as u32 as usize;
            let known = self.grid.depth.get(at).zip(self.grid.confidence.get(at));
            (depth[k], confidence[k]) = known.map_or((0.0, 0.0), |(d, c)| (*d, *c));
        }
    }
}

/// Places that a row of a picture shows.
#[derive(Default)]
struct Places {
    /// Columns of the grid.
    i: Vec<usize>,
    /// Pixels from the left edge.
    x: Vec<f32>,
    /// Metres along the optical axis.
    depth: Vec<f32>,
}

impl Places {
    fn clear(&mut self) {
        self.i.clear();
        self.x.clear();
        self.depth.clear();
    }

    fn push(&mut self, i: usize, x: f32, depth: f32) {
        self.i.push(i);
        self.x.push(x);
        self.depth.push(depth);
    }
}

/// What another view shows at places.
#[derive(Default)]
struct Reprojected {
    /// Pixel there, and depth there.
    u: Vec<f32>,
    v: Vec<f32>,
    z: Vec<f32>,
    /// Its sample; negative where it does not see the place.
    at: Vec<i32>,
    /// What it knows there; confidence 0: nothing.
    depth: Vec<f32>,
    confidence: Vec<f32>,
}

impl Reprojected {
    fn hold(&mut self, n: usize) {
        for values in [&mut self.u, &mut self.v, &mut self.z, &mut self.depth, &mut self.confidence] {
            values.resize(n, 0.0);
        }
        self.at.resize(n, 0);
    }
}

/// What all views say of the places of a row, and the room to find out.
#[derive(Default)]
struct Row {
    known: Places,
    /// Places nobody knows, at depths that continue their surroundings.
    unknown: Places,
    shown: Reprojected,
    /// Σ confidence·depth and Σ confidence of those that agree; confidence of the others that do and that look through.
    sum: Vec<f32>,
    weight: Vec<f32>,
    support: Vec<f32>,
    against: Vec<f32>,
}

/// K.
fn matrix(k: &Intrinsics) -> DMat3 {
    DMat3::from_cols(
        DVec3::new(f64::from(k.fx), 0.0, 0.0),
        DVec3::new(0.0, f64::from(k.fy), 0.0),
        DVec3::new(f64::from(k.cx), f64::from(k.cy), 1.0),
    )
}

/// What the check found, in samples.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct ConsistencyCount {
    /// Supported by at least one other view.
    pub supported: usize,
    /// Seen by nobody else, or hidden there.
    pub alone: usize,
    /// Contradicted more than supported: removed.
    pub removed: usize,
    /// Continued from the surroundings because nobody knows.
    pub filled: usize,
}

impl ConsistencyCount {
    fn and(self, other: Self) -> Self {
        Self {
            supported: self.supported + other.supported,
            alone: self.alone + other.alone,
            removed: self.removed + other.removed,
            filled: self.filled + other.filled,
        }
    }
}

/// The depth grid of `frames[r]` after comparison with `others`; `None` when it has no depth.
///
/// # Errors
/// Reading the frames' file fails.
///
/// `tolerance` is a share of the depth; `fill` holds depths for places that nobody knows (0 = none).
pub fn resolve(
    frames: &[DepthFrame],
    r: usize,
    others: &[usize],
    tolerance: f32,
    fill: Option<&[f32]>,
) -> std::io::Result<Option<(DepthGrid, ConsistencyCount)>> {
    let Some(own) = frames[r].depth()? else { return Ok(None) };
    let own = own.as_ref();
    let mut grids = Vec::with_capacity(others.len());
    for &n in others {
        grids.extend(frames[n].depth()?.map(|grid| (n, grid)));
    }
    let others: Vec<Witness<'_>> =
        grids.iter().map(|(n, grid)| Witness::new(&frames[r].view, &frames[*n].view, grid.as_ref())).collect();
    let mut grid = DepthGrid { depth: vec![0.0; own.depth.len()], confidence: vec![0.0; own.depth.len()], ..*own };
    let width = own.width.max(1);
    let total = (grid.depth.par_chunks_mut(width), grid.confidence.par_chunks_mut(width))
        .into_par_iter()
        .enumerate()
        .map_init(Row::default, |row, (j, (depth, confidence))| {
            let mut count = row.judge(own, j, &others, tolerance, (depth, confidence));
            if let Some(fill) = fill {
                count.filled = row.fill(own, j, &others, fill, (depth, confidence));
            }
            count
        })
        .reduce(ConsistencyCount::default, ConsistencyCount::and);
    Ok(Some((grid, total)))
}

impl Row {
    /// The depths of row `j` after comparison, and their confidence.
    fn judge(
        &mut self,
        own: &DepthGrid,
        j: usize,
        others: &[Witness<'_>],
        tolerance: f32,
        (depth, confidence): (&mut [f32], &mut [f32]),
    ) -> ConsistencyCount {
        let row = j * own.width;
        self.known.clear();
        for i in (0..own.width).filter(|i| own.confidence[row + i] > 0.0) {
            self.known.push(i, own.pixel(i, j).0, own.depth[row + i]);
        }
        let n = self.known.i.len();
        let confidences = self.known.i.iter().map(|i| own.confidence[row + i]);
        self.weight.clear();
        self.weight.extend(confidences);
        self.sum.clear();
        self.sum.extend(self.known.depth.iter().zip(&self.weight).map(|(d, c)| d * c));
        for values in [&mut self.support, &mut self.against] {
            values.clear();
            values.resize(n, 0.0);
        }
        for other in others {
            other.reproject(own.pixel(0, j).1, &self.known, &mut self.shown);
            self.accumulate(other, tolerance);
        }
        let mut count = ConsistencyCount::default();
        for k in 0..n {
            let (i, own_depth) = (self.known.i[k], self.known.depth[k]);
            let own = own.confidence[row + i];
            let (support, against) = (self.support[k], self.against[k]);
            (depth[i], confidence[i]) = if against > support + own {
                count.removed += 1;
                (0.0, 0.0)
            } else if support > 0.0 {
                count.supported += 1;
                // Independent opinions: the chance that all are wrong.
                let doubt = (1.0 - own) * (1.0 - support.min(1.0));
                (self.sum[k] / self.weight[k], (1.0 - doubt) * (1.0 + support) / (1.0 + support + against))
            } else {
                count.alone += 1;
                (own_depth, own * ALONE * own / (own + against))
            };
        }
        count
    }

    /// Adds what a view shows at the places to what the views before it said.
    fn accumulate(&mut self, other: &Witness<'_>, tolerance: f32) {
        let n = self.known.depth.len();
        let shown = &self.shown;
        let [us, vs, zs] = [&shown.u, &shown.v, &shown.z].map(|values| &values[..n]);
        let [depths, confidences] = [&shown.depth, &shown.confidence].map(|values| &values[..n]);
        let [sum, weight] = [&mut self.sum, &mut self.weight].map(|values| &mut values[..n]);
        let [support, against] = [&mut self.support, &mut self.against].map(|values| &mut values[..n]);
        for k in 0..n {
            let (d, c) = (depths[k], confidences[k]);
            let difference = (zs[k] - d) / d;
            // Their surface at that pixel, seen from here.
            let mine = (other.back.x * us[k] + other.back.y * vs[k] + other.back.z) * d + other.back_shift;
            let agrees = (c > 0.0) & (difference.abs() < tolerance) & (mine > 1e-6);
            let contradicts = (c > 0.0) & (difference < -CONFLICT * tolerance);
            sum[k] += if agrees { mine * c } else { 0.0 };
            weight[k] += if agrees { c } else { 0.0 };
            support[k] += if agrees { c } else { 0.0 };
            against[k] += if contradicts { c } else { 0.0 };
        }
    }

    /// Continues row `j` with the depths of `fill` where neither this picture nor another one knows; returns in how many places.
    fn fill(
        &mut self,
        own: &DepthGrid,
        j: usize,
        others: &[Witness<'_>],
        fill: &[f32],
        (depth, confidence): (&mut [f32], &mut [f32]),
    ) -> usize {
        let fill = &fill[j * own.width..][..own.width];
        self.unknown.clear();
        for i in (0..own.width).filter(|i| confidence[*i] < FILLED && fill[*i] > 0.0) {
            self.unknown.push(i, own.pixel(i, j).0, fill[i]);
        }
        let n = self.unknown.i.len();
        self.weight.clear();
        self.weight.resize(n, 0.0);
        for other in others {
            other.reproject(own.pixel(0, j).1, &self.unknown, &mut self.shown);
            self.weight.iter_mut().zip(&self.shown.confidence).for_each(|(most, c)| *most = most.max(*c));
        }
        let mut filled = 0;
        for (k, i) in self.unknown.i.iter().enumerate().filter(|(k, _)| self.weight[*k] <= KNOWS) {
            (depth[*i], confidence[*i]) = (self.unknown.depth[k], FILLED);
            filled += 1;
        }
        filled
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::camera::{Intrinsics, Pose, View};
    use glam::{DQuat, DVec3};
    use image::RgbImage;

    fn frame(x: f64, depth: impl Fn(usize) -> f32) -> DepthFrame {
        let intrinsics = Intrinsics { width: 64, height: 48, fx: 50.0, fy: 50.0, cx: 32.0, cy: 24.0 };
        let rotation = DQuat::from_rotation_x(std::f64::consts::PI);
        let depths: Vec<f32> = (0..64 * 48).map(&depth).collect();
        let grid = DepthGrid { width: 64, height: 48, stride: 1, depth: depths, confidence: vec![0.6; 64 * 48] };
        let view = View { intrinsics, pose: Pose { rotation, center: DVec3::new(x, 0.0, 50.0) } };
        let mut frame = DepthFrame::new(x.to_string(), RgbImage::new(64, 48), view, None).unwrap();
        frame.set_depth(Some(grid)).unwrap();
        frame
    }

    #[test]
    fn agreeing_views_average_and_floaters_go() {
        // A plane at 50 m; one view 0.4 % too far, with one floater at 30 m.
        let floater = 24 * 64 + 32;
        let frames =
            [frame(0.0, |i| if i == floater { 30.0 } else { 50.2 }), frame(5.0, |_| 50.0), frame(-5.0, |_| 50.0)];
        let (grid, count) = resolve(&frames, 0, &[1, 2], 0.01, None).unwrap().unwrap();
        assert_eq!(grid.confidence[floater], 0.0);
        assert_eq!(count.removed, 1);
        let middle = 20 * 64 + 30;
        assert!((grid.depth[middle] - 50.067).abs() < 1e-2, "{}", grid.depth[middle]);
        assert!(grid.confidence[middle] > 0.9);
        // The plane is not hurt by the floater hiding it in the first view.
        let (grid, count) = resolve(&frames, 1, &[0], 0.01, None).unwrap().unwrap();
        assert_eq!(count.removed, 0);
        assert!(grid.confidence.iter().all(|&c| c > 0.2));
    }

    #[test]
    fn a_view_that_looks_away_or_whose_pose_is_no_number_says_nothing() {
        let away = |rotation: DQuat, x: f64| {
            let mut frame = frame(x, |_| 50.0);
            frame.view.pose.rotation = rotation;
            frame
        };
        let frames = [frame(0.0, |_| 50.0), away(DQuat::IDENTITY, 5.0), frame(f64::NAN, |_| 50.0)];
        let fill = vec![49.0; 64 * 48];
        let (grid, count) = resolve(&frames, 0, &[1, 2], 0.01, Some(&fill)).unwrap().unwrap();
        assert_eq!((count.alone, count.filled), (64 * 48, 0));
        assert!(grid.depth.iter().all(|&d| d == 50.0));
        // Nor does it keep a place from being continued.
        let mut frames = frames;
        let nothing = DepthGrid { confidence: vec![0.0; 64 * 48], ..frames[0].depth().unwrap().unwrap().into_owned() };
        frames[0].set_depth(Some(nothing)).unwrap();
        let (grid, count) = resolve(&frames, 0, &[1, 2], 0.01, Some(&fill)).unwrap().unwrap();
        assert_eq!((count, grid.depth), (ConsistencyCount { filled: 64 * 48, ..Default::default() }, fill));
    }

    #[test]
    fn a_view_without_partners_keeps_its_depth_at_half_the_confidence() {
        let frames = [frame(0.0, |_| 50.0)];
        let (grid, count) = resolve(&frames, 0, &[], 0.01, None).unwrap().unwrap();
        assert_eq!(count.alone, 64 * 48);
        assert!(grid.depth.iter().all(|&d| d == 50.0) && grid.confidence.iter().all(|&c| (c - 0.3).abs() < 1e-6));
    }
}
