//! Conflicting depths resolved by multi-view consistency: a depth is checked in the pictures that see the same place.
//! Those that agree are averaged (one surface instead of a stack of layers) and gain confidence; those that float in
//! front of what another view sees through lose it.

use rayon::prelude::*;

use crate::camera::{Projector, Unprojector};

use super::depth_frame::{DepthFrame, DepthGrid};

/// Depths in front of another view's surface by more than this many tolerances contradict it.
const CONFLICT: f32 = 2.5;
/// Confidence a sample keeps when nobody else sees it agree: coverage at the rim matters more than purity.
const ALONE: f32 = 0.5;
/// Confidence of a depth that only continues its surroundings: any real sample outweighs it.
const FILLED: f32 = 0.03;
/// Confidence at which another picture counts as knowing a place.
const KNOWS: f32 = 0.1;

/// A view that has depths.
struct Witness<'a> {
    grid: &'a DepthGrid,
    project: Projector,
    unproject: Unprojector,
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
    let witness = |n: usize, grid| {
        let view = &frames[n].view;
        Witness { grid, project: Projector::new(view), unproject: Unprojector::new(view) }
    };
    let others: Vec<Witness<'_>> = grids.iter().map(|(n, grid)| witness(*n, grid.as_ref())).collect();
    let me = witness(r, own);
    let rows: Vec<(Vec<(f32, f32)>, ConsistencyCount)> = (0..own.height)
        .into_par_iter()
        .map(|j| {
            let mut count = ConsistencyCount::default();
            let row = (0..own.width)
                .map(|i| {
                    let at = j * own.width + i;
                    let judged = if own.confidence[at] > 0.0 {
                        judge(&me, (i, j), &others, tolerance, &mut count)
                    } else {
                        (0.0, 0.0)
                    };
                    match fill {
                        Some(fill) if judged.1 < FILLED && fill[at] > 0.0 => {
                            let (x, y) = own.pixel(i, j);
                            if known_elsewhere(me.unproject.at(x, y, fill[at]), &others) {
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
fn known_elsewhere(point: glam::Vec3, others: &[Witness<'_>]) -> bool {
    others.iter().any(|o| {
        o.project
            .project(point)
            .and_then(|(u, v, _)| o.grid.index_at(u, v))
            .is_some_and(|k| o.grid.confidence[k] > KNOWS)
    })
}

fn judge(
    me: &Witness<'_>,
    (i, j): (usize, usize),
    others: &[Witness<'_>],
    tolerance: f32,
    count: &mut ConsistencyCount,
) -> (f32, f32) {
    let own = me.grid;
    let at = j * own.width + i;
    let (depth, confidence) = (own.depth[at], own.confidence[at]);
    let (x, y) = own.pixel(i, j);
    let point = me.unproject.at(x, y, depth);
    let (mut sum, mut weight) = (depth * confidence, confidence);
    let (mut support, mut against) = (0.0f32, 0.0f32);
    for other in others {
        let Some((u, v, z)) = other.project.project(point) else { continue };
        let Some(k) = other.grid.index_at(u, v) else { continue };
        let (d, c) = (other.grid.depth[k], other.grid.confidence[k]);
        if c <= 0.0 {
            continue;
        }
        let difference = (z - d) / d;
        if difference.abs() < tolerance {
            // Their surface at that pixel, seen from here.
            if let Some((_, _, mine)) = me.project.project(other.unproject.at(u, v, d)) {
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
