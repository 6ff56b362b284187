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
    let (of_a, of_b) = (a.keypoints().len().min(limits.features), b.keypoints().len().min(limits.features));
    let (described_a, described_b) = (a.descriptors(), b.descriptors());
    let grid = Buckets::of(&a.keypoints()[..of_a], (a.intrinsics.width, a.intrinsics.height));
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
            let line = guide.lines.map(|(lines, width)| (lines[j], width));
            scored.clear();
            for cells in grid.rows(*place, guide.radius, line) {
                for &i in cells {
                    let p = a.keypoints()[i as usize];
                    let p = DVec2::new(p[0].into(), p[1].into());
                    let off_line = line.is_some_and(|(line, width)| line.dot(p.extend(1.0)).abs() > width);
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
            let at = a.keypoints()[i as usize];
            let elsewhere = |k: u32| {
                let p = a.keypoints()[k as usize];
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

/// How much the key points of each match look alike.
pub(crate) fn likenesses(a: &KeyFrame, b: &KeyFrame, matches: &[Match]) -> Vec<i32> {
    let (of_a, of_b) = (a.descriptors(), b.descriptors());
    matches.iter().map(|m| dot(of_a.of(m.a as usize), of_b.of(m.b as usize))).collect()
}

/// Sorts matches by how much their key points look alike, most first.
pub(crate) fn likeliest_first(a: &KeyFrame, b: &KeyFrame, matches: &mut [Match]) {
    let (of_a, of_b) = (a.descriptors(), b.descriptors());
    matches.sort_by_cached_key(|m| std::cmp::Reverse(dot(of_a.of(m.a as usize), of_b.of(m.b as usize))));
}

fn dot(a: &[i8], b: &[i8]) -> i32 {
    // Fixed length and no check for overflow (64 · 127² is a million), so that the compiler makes multiply-add pairs of it.
    let (Some(a), Some(b)) = (a.first_chunk::<DESCRIPTOR>(), b.first_chunk::<DESCRIPTOR>()) else { return i32::MIN };
    let mut sum = 0i32;
    for k in 0..DESCRIPTOR {
        sum = sum.wrapping_add(i32::from(a[k]).wrapping_mul(i32::from(b[k])));
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
    fn of(places: &[[f32; 2]], (width, height): (u32, u32)) -> Self {
        let columns = (width as f32 / CELL).ceil().max(1.0) as usize;
        let rows = (height as f32 / CELL).ceil().max(1.0) as usize;
        let cell = |p: &[f32; 2]| {
            let x = ((p[0] / CELL) as usize).min(columns - 1);
            let y = ((p[1] / CELL) as usize).min(rows - 1);
            y * columns + x
        };
        let mut starts = vec![0u32; columns * rows + 1];
        for p in places {
            starts[cell(p) + 1] += 1;
        }
        for i in 1..starts.len() {
            starts[i] += starts[i - 1];
        }
        let mut next = starts.clone();
        let mut order = vec![0u32; places.len()];
        for (i, p) in places.iter().enumerate() {
            let slot = &mut next[cell(p)];
            order[*slot as usize] = i as u32;
            *slot += 1;
        }
        Self { columns, rows, starts, order }
    }

    /// Key points of the cells around `place`, one slice per row of cells: all within `radius` of it and, where there is a line, all
    /// within its width of that.
    fn rows(&self, place: DVec2, radius: f64, line: Option<(DVec3, f64)>) -> impl Iterator<Item = &[u32]> {
        let range = |at: f64, count: usize| {
            let low = ((at - radius) / f64::from(CELL)).floor().clamp(0.0, count as f64) as usize;
            let high = ((at + radius) / f64::from(CELL)).floor().clamp(-1.0, count as f64 - 1.0) + 1.0;
            low..(high as usize).max(low)
        };
        let columns = range(place.x, self.columns);
        range(place.y, self.rows).map(move |y| {
            let near = line.map_or(0..self.columns, |line| self.columns_of(line, y));
            let low = columns.start.max(near.start);
            let from = self.starts[y * self.columns + low] as usize;
            let to = self.starts[y * self.columns + columns.end.min(near.end).max(low)] as usize;
            &self.order[from..to]
        })
    }

    /// Columns in which row `y` of cells comes within `width` of `line`. The outermost cells hold what lies beyond them, too.
    fn columns_of(&self, (line, width): (DVec3, f64), y: usize) -> Range<usize> {
        let edge = |row: usize| row as f64 * f64::from(CELL);
        let low = if y == 0 { f64::NEG_INFINITY } else { edge(y) };
        let high = if y + 1 == self.rows { f64::INFINITY } else { edge(y + 1) };
        // line.x · x lies between these.
        let sides = [-line.y * low - line.z, -line.y * high - line.z];
        let (least, most) = (sides[0].min(sides[1]) - width, sides[0].max(sides[1]) + width);
        let ends = [least / line.x, most / line.x];
        if !ends.iter().all(|x| x.is_finite()) {
            return 0..self.columns;
        }
        let column = |x: f64| (x / f64::from(CELL)).floor().clamp(0.0, self.columns as f64 - 1.0) as usize;
        column(ends[0].min(ends[1]))..column(ends[0].max(ends[1])) + 1
    }
}

#[cfg(test)]
#[allow(clippy::unwrap_used)] // a test may
mod tests {
    use super::*;

    #[test]
    fn cells_along_a_line_hold_every_key_point_within_its_width() {
        // Points all over a picture of 1200 × 800 and beyond its edges, sorted into cells as key points are.
        let spread = |i: i32, step: i32, size: i32| (i * step % (10 * (size + 60))) as f32 / 10.0 - 30.0;
        let places: Vec<[f32; 2]> = (0..4000).map(|i| [spread(i, 7919, 1200), spread(i, 104_729, 800)]).collect();
        let grid = Buckets::of(&places, (1200, 800));
        for k in 0..360 {
            let angle = f64::from(k).to_radians();
            let normal = DVec2::new(angle.cos(), angle.sin());
            let through = DVec2::new(600.0 + f64::from(k % 50) * 12.0, 400.0 - f64::from(k % 31) * 20.0);
            let line = (normal.extend(-normal.dot(through)), 3.0);
            let (place, radius) = (through, [40.0, 100.0, f64::INFINITY][k as usize % 3]);
            let is_near = |i: &&u32| {
                let p = DVec2::from(places[**i as usize].map(f64::from));
                line.0.dot(p.extend(1.0)).abs() <= line.1
            };
            let sorted = |rows: Vec<&[u32]>| {
                let mut near: Vec<u32> = rows.into_iter().flatten().filter(is_near).copied().collect();
                near.sort_unstable();
                near
            };
            let clipped: Vec<&[u32]> = grid.rows(place, radius, Some(line)).collect();
            let looked_at: usize = clipped.iter().map(|r| r.len()).sum();
            let all: Vec<&[u32]> = grid.rows(place, radius, None).collect();
            let of_all: usize = all.iter().map(|r| r.len()).sum();
            assert_eq!(sorted(clipped), sorted(all), "{k}");
            assert!(radius.is_finite() || 2 * looked_at < of_all, "{k}: {looked_at} of {of_all}");
        }
    }
}
