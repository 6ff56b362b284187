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

    /// Pixel there and depth of a pixel here at a depth; `None` behind the camera.
    fn project(&self, pixel: Vec3, depth: f32) -> Option<(f32, f32, f32)> {
        let p = self.turn * pixel * depth + self.shift;
        (p.z > 1e-6).then(|| (p.x / p.z, p.y / p.z, p.z))
    }

    /// Depth here of what lies at a pixel there; `None` behind the camera.
    fn depth_here(&self, (x, y): (f32, f32), depth: f32) -> Option<f32> {
        let z = self.back.dot(Vec3::new(x, y, 1.0)) * depth + self.back_shift;
        (z > 1e-6).then_some(z)
    }
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
    let rows: Vec<(Vec<(f32, f32)>, ConsistencyCount)> = (0..own.height)
        .into_par_iter()
        .map(|j| {
            let mut count = ConsistencyCount::default();
            let row = (0..own.width)
                .map(|i| {
                    let at = j * own.width + i;
                    let judged = if own.confidence[at] > 0.0 {
                        judge(own, (i, j), &others, tolerance, &mut count)
                    } else {
                        (0.0, 0.0)
                    };
                    match fill {
                        Some(fill) if judged.1 < FILLED && fill[at] > 0.0 => {
                            let (x, y) = own.pixel(i, j);
                            if known_elsewhere(Vec3::new(x, y, 1.0), fill[at], &others) {
                                return judged;
                            }
                            count.filled += 1;
                            (fill[at], FILLED)
                        }
                        _ => judged,
                    }
                })
                .collect();
            (row, count)
        })
        .collect();
    let mut total = ConsistencyCount::default();
    let mut grid = DepthGrid {
        depth: Vec::with_capacity(own.depth.len()),
        confidence: Vec::with_capacity(own.depth.len()),
        ..*own
    };
    for (row, count) in rows {
        for (d, c) in row {
            grid.depth.push(d);
            grid.confidence.push(c);
        }
        total.supported += count.supported;
        total.alone += count.alone;
        total.removed += count.removed;
        total.filled += count.filled;
    }
    Ok(Some((grid, total)))
}

/// Whether another picture that sees a place has a depth for it.
fn known_elsewhere(pixel: Vec3, depth: f32, others: &[Witness<'_>]) -> bool {
    others.iter().any(|o| {
        o.project(pixel, depth)
            .and_then(|(u, v, _)| o.grid.index_at(u, v))
            .is_some_and(|k| o.grid.confidence[k] > KNOWS)
    })
}

fn judge(
    own: &DepthGrid,
    (i, j): (usize, usize),
    others: &[Witness<'_>],
    tolerance: f32,
    count: &mut ConsistencyCount,
) -> (f32, f32) {
    let at = j * own.width + i;
    let (depth, confidence) = (own.depth[at], own.confidence[at]);
    let (x, y) = own.pixel(i, j);
    let pixel = Vec3::new(x, y, 1.0);
    let (mut sum, mut weight) = (depth * confidence, confidence);
    let (mut support, mut against) = (0.0f32, 0.0f32);
    for other in others {
        let Some((u, v, z)) = other.project(pixel, depth) else { continue };
        let Some(k) = other.grid.index_at(u, v) else { continue };
        let (d, c) = (other.grid.depth[k], other.grid.confidence[k]);
        if c <= 0.0 {
            continue;
        }
        let difference = (z - d) / d;
        if difference.abs() < tolerance {
            // Their surface at that pixel, seen from here.
            if let Some(mine) = other.depth_here((u, v), d) {
                sum += mine * c;
                weight += c;
                support += c;
            }
        } else if difference < -CONFLICT * tolerance {
            against += c;
        }
    }
    if against > support + confidence {
        count.removed += 1;
        return (0.0, 0.0);
    }
    if support > 0.0 {
        count.supported += 1;
        // Independent opinions: the chance that all are wrong.
        let doubt = (1.0 - confidence) * (1.0 - support.min(1.0));
        (sum / weight, (1.0 - doubt) * (1.0 + support) / (1.0 + support + against))
    } else {
        count.alone += 1;
        (depth, confidence * ALONE * confidence / (confidence + against))
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
    fn a_view_without_partners_keeps_its_depth_at_half_the_confidence() {
        let frames = [frame(0.0, |_| 50.0)];
        let (grid, count) = resolve(&frames, 0, &[], 0.01, None).unwrap().unwrap();
        assert_eq!(count.alone, 64 * 48);
        assert!(grid.depth.iter().all(|&d| d == 50.0) && grid.confidence.iter().all(|&c| (c - 0.3).abs() < 1e-6));
    }
}
