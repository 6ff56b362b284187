//! Mutual nearest neighbours between the descriptors of two key frames, each key point compared only with those
//! near its predicted place. That prunes some nine tenths of the work and most wrong matches with it.

use super::keyframe::{DESCRIPTOR, KeyFrame};
use std::ops::Range;

use glam::{DVec2, DVec3};
use rayon::prelude::*;

/// One match: key point of the first and of the second frame.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Match {
    pub a: u32,
    pub b: u32,
}

/// What may match.
#[derive(Clone, Copy, Debug)]
pub(crate) struct MatchLimits {
    pub min_cosine: f32,
    /// Advantage over the best candidate elsewhere.
    pub cosine_margin: f32,
    /// Key points of either frame that take part, best first.
    pub features: usize,
}

/// Where matches are looked for.
pub(crate) struct Guide<'a> {
    /// Where key point i of `b` should lie in `a`; `None`: it is not expected there.
    pub predicted: &'a [Option<DVec2>],
    /// How far off that may be, pixels; infinite compares everything.
    pub radius: f64,
    /// Epipolar line in `a` of key point i of `b`, as (unit normal, offset), and the distance allowed from it.
    pub lines: Option<(&'a [DVec3], f64)>,
}

/// Side of a bucket of key points, pixels.
const CELL: f32 = 32.0;
/// Descriptors closer than this overlap (the network's cells are 8 px, sampled bilinearly): a second best so near
/// to the best is no rival.
const SAME_PLACE: f32 = 12.0;

/// Key points that are worth a thread.
const LEAST_PART: usize = 128;

/// Matches `b` against `a`.
pub(crate) fn match_frames(a: &KeyFrame, b: &KeyFrame, guide: &Guide, limits: MatchLimits) -> Vec<Match> {
    let (of_a, of_b) = (a.keypoints.len().min(limits.features), b.keypoints.len().min(limits.features));
    let (described_a, described_b) = (a.descriptors(), b.descriptors());
    let grid = Buckets::new(a, of_a);
    let r2 = guide.radius * guide.radius;
    let unit = 127.0 * 127.0;
    let least = (limits.min_cosine * unit) as i32;
    let margin = (limits.cosine_margin * unit) as i32;
    // Some key points of `b` after the others: their matches, and of each of `a` the best of them and its score.
    let of_some = |some: Range<usize>| {
        let mut best_of_a = vec![(i32::MIN, u32::MAX); of_a];
        let mut found = Vec::with_capacity(some.len());
        let mut scored: Vec<(i32, u32)> = Vec::new();
        for j in some {
            let Some(Some(place)) = guide.predicted.get(j) else { continue };
            let descriptor = described_b.of(j);
            scored.clear();
            for cells in grid.rows(*place, guide.radius) {
                for &i in cells {
                    let p = a.keypoints[i as usize];
                    let p = DVec2::new(p[0].into(), p[1].into());
                    let off_line =
                        guide.lines.is_some_and(|(lines, width)| (lines[j].dot(p.extend(1.0))).abs() > width);
                    if off_line || (p - *place).length_squared() > r2 {
                        continue;
                    }
                    let score = dot(described_a.of(i as usize), descriptor);
                    scored.push((score, i));
                    let rival = &mut best_of_a[i as usize];
                    if score > rival.0 {
                        *rival = (score, j as u32);
                    }
                }
            }
            let Some(&(best, i)) = scored.iter().max_by_key(|s| (s.0, std::cmp::Reverse(s.1))) else { continue };
            let at = a.keypoints[i as usize];
            let elsewhere = |k: u32| {
                let p = a.keypoints[k as usize];
                (p[0] - at[0]).abs().max((p[1] - at[1]).abs()) > SAME_PLACE
            };
            let second = scored.iter().filter(|s| s.0 > best - margin && elsewhere(s.1)).count();
            if best >= least && second == 0 {
                found.push(Match { a: i, b: j as u32 });
            }
        }
        (found, best_of_a)
    };
    // Parts in their order, the first of equals wins: the same however many there are.
    let part = of_b.div_ceil(rayon::current_num_threads()).max(LEAST_PART);
    let starts: Vec<usize> = (0..of_b).step_by(part).collect();
    let parts: Vec<_> = starts.into_par_iter().map(|from| of_some(from..(from + part).min(of_b))).collect();
    let mut found = Vec::with_capacity(of_b);
    let mut best_of_a = vec![(i32::MIN, u32::MAX); of_a];
    for (some, best) in parts {
        found.extend(some);
        best_of_a.iter_mut().zip(best).filter(|(all, part)| part.0 > all.0).for_each(|(all, part)| *all = part);
    }
    found.retain(|m| best_of_a[m.a as usize].1 == m.b);
    found
}

fn dot(a: &[i8], b: &[i8]) -> i32 {
    // Fixed length, so that the compiler unrolls it into multiply-add pairs.
    let (Some(a), Some(b)) = (a.first_chunk::<DESCRIPTOR>(), b.first_chunk::<DESCRIPTOR>()) else { return i32::MIN };
    let mut sum = 0i32;
    for k in 0..DESCRIPTOR {
        sum += i32::from(a[k]) * i32::from(b[k]);
    }
    sum
}

/// Key points of a frame sorted into square cells, row-major.
struct Buckets {
    columns: usize,
    rows: usize,
    starts: Vec<u32>,
    order: Vec<u32>,
}

impl Buckets {
    fn new(frame: &KeyFrame, count: usize) -> Self {
        let columns = (frame.intrinsics.width as f32 / CELL).ceil().max(1.0) as usize;
        let rows = (frame.intrinsics.height as f32 / CELL).ceil().max(1.0) as usize;
        let cell = |p: &[f32; 2]| {
            let x = ((p[0] / CELL) as usize).min(columns - 1);
            let y = ((p[1] / CELL) as usize).min(rows - 1);
            y * columns + x
        };
        let mut starts = vec![0u32; columns * rows + 1];
        for p in &frame.keypoints[..count] {
            starts[cell(p) + 1] += 1;
        }
        for i in 1..starts.len() {
            starts[i] += starts[i - 1];
        }
        let mut next = starts.clone();
        let mut order = vec![0u32; count];
        for (i, p) in frame.keypoints[..count].iter().enumerate() {
            let slot = &mut next[cell(p)];
            order[*slot as usize] = i as u32;
            *slot += 1;
        }
        Self { columns, rows, starts, order }
    }

    /// Key points of the cells around `place`, one slice per row of cells.
    fn rows(&self, place: DVec2, radius: f64) -> impl Iterator<Item = &[u32]> {
        let range = |at: f64, count: usize| {
            let low = ((at - radius) / f64::from(CELL)).floor().clamp(0.0, count as f64) as usize;
            let high = ((at + radius) / f64::from(CELL)).floor().clamp(-1.0, count as f64 - 1.0) + 1.0;
            low..(high as usize).max(low)
        };
        let columns = range(place.x, self.columns);
        range(place.y, self.rows).map(move |y| {
            let from = self.starts[y * self.columns + columns.start] as usize;
            let to = self.starts[y * self.columns + columns.end] as usize;
            &self.order[from..to]
        })
    }
}
