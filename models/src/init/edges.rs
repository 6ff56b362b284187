//! Depth edges put where the pictures have them. The plane sweep compares wide windows, so that a roof's depth reaches over the
//! ground beside it by half a window, and between both surfaces it answers with their mean. Near a step in depth each sample is
//! offered the depths found around it, and takes the one with which a small window looks most alike in the better of the source
//! pictures: the other one may not see the place (propagation as in Galliani et al., "Massively parallel multiview stereopsis
//! by surface normal diffusion", ICCV 2015, over depths that are there already).

use glam::{Mat3, Vec2, Vec3};

use super::depth_frame::DepthGrid;

/// How far a window of the plane sweep carries a depth, pixels: three deviations of the narrower of its Gaussians.
const REACH_PX: usize = 24;
/// A step: inverse depth bends by more than this share over [`BEND_PX`].
const STEP: f32 = 0.02;
/// Distances at which inverse depth is compared with the mean of both sides, pixels.
const BEND_PX: [usize; 2] = [8, 16];
/// Depths that differ by less than this share are one surface; a sample's own depth on it is the finer one.
const SAME: f32 = 0.01;
/// Where other depths are looked for, pixels from the sample.
const RINGS_PX: [usize; 3] = [8, 16, REACH_PX];
/// Of those that lie behind, which are tried, as shares of their number.
const OFFERED: [f32; 3] = [0.2, 0.5, 0.8];
/// Half the side of the small window and its side, pixels.
const HALF: usize = 2;
const SIDE: usize = 2 * HALF + 1;
/// Depths on all rings.
const AROUND: usize = 8 * RINGS_PX.len();

/// Pictures of a run of the network, as it was given them.
pub struct Pictures<'a> {
    width: usize,
    height: usize,
    reference: &'a [f32],
    sources: Vec<Source<'a>>,
}

/// One that the reference is compared with: a pixel (x, y) of the reference with a depth d lies at `turn`·(x, y, 1)·d + `shift`.
struct Source<'a> {
    plane: &'a [f32],
    turn: Mat3,
    shift: Vec3,
}

impl<'a> Pictures<'a> {
    /// `planes` are three of each picture, the reference first, of which green is used: sensors have most of it. `projections`
    /// are 4 × 4 of each source, row-major, pixel centres at whole numbers.
    pub fn new((width, height): (u32, u32), planes: &'a [f32], projections: &[f32]) -> Self {
        let (width, height) = (width as usize, height as usize);
        let n = width * height;
        let green = |i: usize| &planes[(3 * i + 1) * n..(3 * i + 2) * n];
        let source = |(i, m): (usize, &[f32; 16])| {
            let row = |r: usize| Vec3::new(m[4 * r], m[4 * r + 1], m[4 * r + 2]);
            let turn = Mat3::from_cols(row(0), row(1), row(2)).transpose();
            Source { plane: green(i + 1), turn, shift: Vec3::new(m[3], m[7], m[11]) }
        };
        let sources = projections.as_chunks::<16>().0.iter().enumerate().map(source).collect();
        Self { width, height, reference: green(0), sources }
    }

    /// Sum of absolute differences over the window around a pixel, in the source in which it is least, where that is below `most`
    /// and the whole window is seen.
    fn difference(&self, [x, y]: [usize; 2], depth: f32, most: f32) -> Option<f32> {
        let (w, h) = (self.width, self.height);
        if x < HALF || y < HALF || x + HALF >= w || y + HALF >= h {
            return None;
        }
        let mut least = None;
        for s in &self.sources {
            let at = s.turn * Vec3::new(x as f32, y as f32, 1.0) * depth + s.shift;
            if at.z <= 0.0 {
                continue;
            }
            let middle = at.truncate() / at.z;
            // What a pixel of the reference is in the source; over so small a window a plane's picture is affine.
            let per = |column: Vec3| (column.truncate() - middle * column.z) * (depth / at.z);
            let (right, down) = (per(s.turn.x_axis), per(s.turn.y_axis));
            let reach = (right.abs() + down.abs()) * HALF as f32;
            let (low, high) = (middle - reach, middle + reach);
            if !(low.min_element() >= 0.0 && high.x < (w - 1) as f32 && high.y < (h - 1) as f32) {
                continue;
            }
            let most = least.unwrap_or(most);
            // In 65,536ths of a pixel (pictures have 16,384 a side at most), rounded to the nearest one by cutting off.
            let fixed = |v: Vec2| (v * 65_536.0).as_ivec2();
            let (right, down) = (fixed(right), fixed(down));
            let mut start = fixed(middle + 0.5) - (right + down) * HALF as i32;
            let mut sum = 0.0;
            for dy in 0..SIDE {
                let row = &self.reference[(y + dy - HALF) * w + x - HALF..][..SIDE];
                let mut at = start;
                for value in row {
                    // Within the picture, as was seen above: not checked for overflow again.
                    let [column, line] = [at.x >> 16, at.y >> 16].map(|c| c as usize);
                    sum += (value - s.plane[line.wrapping_mul(w).wrapping_add(column)]).abs();
                    at = at.wrapping_add(right);
                }
                start = start.wrapping_add(down);
                if sum >= most {
                    break;
                }
            }
            if sum < most {
                least = Some(sum);
            }
        }
        least
    }
}

/// Moves depths near steps back onto the surface that the pictures show there; returns how many moved. It is always the nearer
/// surface that reaches too far (offered nearer depths, too, sheffield_cross lost 0.4 dB).
pub fn follow_the_pictures(grid: &mut DepthGrid, pictures: &Pictures<'_>) -> usize {
    let near_step = dilated(&steps(grid), grid, (REACH_PX / grid.stride).max(1));
    let known: Vec<f32> =
        grid.depth.iter().zip(&grid.confidence).map(|(d, c)| if *c > 0.0 { *d } else { 0.0 }).collect();
    let rings = Rings::new(grid);
    let mut room = [0.0; AROUND + 1];
    let mut moved = Vec::new();
    for at in (0..grid.depth.len()).filter(|at| near_step[*at] && grid.confidence[*at] > 0.0) {
        let (i, j) = (at % grid.width, at / grid.width);
        let pixel = [i, j].map(|k| k * grid.stride + grid.stride / 2);
        let around = rings.behind(&known, [i, j], &mut room);
        if around.is_empty() {
            continue;
        }
        let Some(mut least) = pictures.difference(pixel, grid.depth[at], f32::INFINITY) else { continue };
        let (mut best, mut last) = (None, 0.0);
        for share in OFFERED {
            let depth = around[(share * around.len() as f32) as usize];
            if depth < last * (1.0 + SAME) {
                continue;
            }
            last = depth;
            if let Some(difference) = pictures.difference(pixel, depth, least) {
                (least, best) = (difference, Some(depth));
            }
        }
        moved.extend(best.map(|depth| (at, depth)));
    }
    for (at, depth) in &moved {
        grid.depth[*at] = *depth;
    }
    moved.len()
}

/// Where other depths are looked for.
struct Rings {
    width: usize,
    height: usize,
    /// Steps from a sample, across and down, and the place of what is there beside its own.
    steps: [([isize; 2], isize); AROUND],
    /// No step is longer.
    reach: usize,
}

impl Rings {
    fn new(grid: &DepthGrid) -> Self {
        const WAYS: [[isize; 2]; 8] = [[-1, -1], [0, -1], [1, -1], [-1, 0], [1, 0], [-1, 1], [0, 1], [1, 1]];
        let width = grid.width as isize;
        let steps = std::array::from_fn(|k| {
            let ring = (RINGS_PX[k / WAYS.len()] / grid.stride).max(1) as isize;
            let [x, y] = WAYS[k % WAYS.len()].map(|way| way * ring);
            ([x, y], y * width + x)
        });
        Self { width: grid.width, height: grid.height, steps, reach: (REACH_PX / grid.stride).max(1) }
    }

    /// Depths of surfaces behind a sample's own around it, the nearest first, or one that stands for all; of `known` ones, 0 where
    /// none is.
    fn behind<'a>(&self, known: &[f32], [i, j]: [usize; 2], room: &'a mut [f32; AROUND + 1]) -> &'a [f32] {
        let at = j * self.width + i;
        let behind = known[at] * (1.0 + SAME);
        let mut found = 0;
        let mut take = |depth: f32| {
            // Written over where it does not count: faster than to ask.
            room[found] = depth;
            found += usize::from(depth > behind);
        };
        let within = |at: usize, side: usize| at >= self.reach && at + self.reach < side;
        if within(i, self.width) && within(j, self.height) {
            self.steps.iter().for_each(|(_, step)| take(known[at.wrapping_add_signed(*step)]));
        } else {
            for ([x, y], step) in &self.steps {
                if i.wrapping_add_signed(*x) < self.width && j.wrapping_add_signed(*y) < self.height {
                    take(known[at.wrapping_add_signed(*step)]);
                }
            }
        }
        let (nearest, farthest) =
            room[..found].iter().fold((f32::INFINITY, 0.0f32), |(n, f), d| (n.min(*d), f.max(*d)));
        if farthest < nearest * (1.0 + SAME) {
            // One surface, or none.
            return &room[..found.min(1)];
        }
        room[..found].sort_unstable_by(f32::total_cmp);
        &room[..found]
    }
}

/// Where inverse depth, which is linear on a plane, bends.
fn steps(grid: &DepthGrid) -> Vec<bool> {
    let (w, h) = (grid.width, grid.height);
    let inverse: Vec<f32> =
        grid.depth.iter().zip(&grid.confidence).map(|(d, c)| if *c > 0.0 { 1.0 / d } else { 0.0 }).collect();
    let bends = |at: usize, before: usize, after: usize| {
        let [a, b, c] = [inverse[before], inverse[at], inverse[after]];
        a > 0.0 && b > 0.0 && c > 0.0 && (a + c - 2.0 * b).abs() > STEP * b
    };
    (0..w * h)
        .map(|at| {
            let (i, j) = (at % w, at / w);
            BEND_PX.iter().map(|px| (px / grid.stride).max(1)).any(|k| {
                (i >= k && i + k < w && bends(at, at - k, at + k))
                    || (j >= k && j + k < h && bends(at, at - k * w, at + k * w))
            })
        })
        .collect()
}

/// Whatever lies within `reach` of what is set, along rows, then columns.
fn dilated(set: &[bool], grid: &DepthGrid, reach: usize) -> Vec<bool> {
    let (w, h) = (grid.width, grid.height);
    let mut rows = vec![false; set.len()];
    for at in (0..set.len()).filter(|at| set[*at]) {
        let (i, row) = (at % w, at / w * w);
        rows[row + i.saturating_sub(reach)..=row + (i + reach).min(w - 1)].fill(true);
    }
    let mut all = vec![false; set.len()];
    for at in (0..set.len()).filter(|at| rows[*at]) {
        let (i, j) = (at % w, at / w);
        for k in j.saturating_sub(reach)..=(j + reach).min(h - 1) {
            all[k * w + i] = true;
        }
    }
    all
}

#[cfg(test)]
mod tests {
    use super::*;

    const W: usize = 320;
    const H: usize = 240;
    const STRIDE: usize = 2;
    const GROUND_M: f32 = 40.0;
    const ROOF_M: f32 = 35.0;
    /// Pixels times metres that a place moves by between two pictures.
    const BASE: f32 = 1400.0;

    /// Texture of the ground and of the roof.
    fn texture(x: i32, y: i32, kind: i32) -> f32 {
        let mixed = (x * 7919 + y * 104_729 + kind * 611_953).wrapping_mul(0x2C1B_3C6D) >> 16;
        (mixed & 255) as f32 / 255.0
    }

    fn is_roof(x: i32, y: i32) -> bool {
        (100..220).contains(&x) && (80..160).contains(&y)
    }

    /// A picture from `step` bases to the right: what is seen at (x, y).
    fn seen(step: i32, x: i32, y: i32) -> f32 {
        let [ground, roof] = [GROUND_M, ROOF_M].map(|depth| step * (BASE / depth).round() as i32);
        if is_roof(x + roof, y) { texture(x + roof, y, 1) } else { texture(x + ground, y, 0) }
    }

    fn planes() -> Vec<f32> {
        let picture = |step| (0..H * W).map(move |k| seen(step, (k % W) as i32, (k / W) as i32));
        [0, 1, -1].into_iter().flat_map(|step| (0..3).flat_map(move |_| picture(step))).collect()
    }

    fn projections() -> Vec<f32> {
        let moved = |by: f32| [1.0, 0.0, 0.0, by, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0];
        [moved(-BASE), moved(BASE)].concat()
    }

    fn grid(depth: impl Fn(usize, usize) -> f32) -> DepthGrid {
        let (width, height) = (W / STRIDE, H / STRIDE);
        let depth = (0..width * height).map(|k| depth(k % width, k / width)).collect();
        DepthGrid { width, height, stride: STRIDE, depth, confidence: vec![0.6; width * height] }
    }

    /// The roof's depth, carried over its edge by `samples`.
    fn carried(samples: usize) -> impl Fn(usize, usize) -> f32 {
        move |i, j| {
            let roof = (50 - samples..110 + samples).contains(&i) && (40 - samples..80 + samples).contains(&j);
            if roof { ROOF_M } else { GROUND_M }
        }
    }

    fn followed(grid: &mut DepthGrid) -> usize {
        let (planes, projections) = (planes(), projections());
        follow_the_pictures(grid, &Pictures::new((W as u32, H as u32), &planes, &projections))
    }

    #[test]
    fn a_roof_that_reaches_over_the_ground_ends_where_the_pictures_show_it() {
        let mut grid = grid(carried(5));
        let truth = carried(0);
        let wrong =
            |g: &DepthGrid| g.depth.iter().enumerate().filter(|(k, d)| **d != truth(k % g.width, k / g.width)).count();
        assert_eq!(wrong(&grid), 70 * 50 - 60 * 40);
        let moved = followed(&mut grid);
        assert!(moved > 1000 && wrong(&grid) < 60, "{moved} moved, {} are wrong", wrong(&grid));
    }

    #[test]
    fn right_edges_and_slopes_stay_as_they_are() {
        let mut right = grid(carried(0));
        let moved = followed(&mut right);
        assert!(moved < 60, "{moved} of 200 samples at the roof's rim were taken for ground");
        let mut slope = grid(|i, j| 1.0 / (0.02 + 1e-5 * i as f32 + 5e-5 * j as f32));
        assert_eq!(followed(&mut slope), 0);
    }

    #[test]
    fn samples_without_depth_neither_count_nor_move() {
        let mut holes = grid(carried(5));
        for k in (0..holes.depth.len()).step_by(5) {
            (holes.depth[k], holes.confidence[k]) = (0.0, 0.0);
        }
        assert!(followed(&mut holes) > 500);
        assert!((0..holes.depth.len()).all(|k| (k % 5 == 0) == (holes.depth[k] == 0.0)));
        holes.confidence.fill(0.0);
        assert_eq!(followed(&mut holes), 0);
    }

    #[test]
    fn pictures_of_one_grey_or_of_no_number_move_nothing() {
        for value in [0.5, f32::NAN] {
            let (planes, projections) = (vec![value; 9 * W * H], projections());
            let mut grid = grid(carried(5));
            assert_eq!(follow_the_pictures(&mut grid, &Pictures::new((W as u32, H as u32), &planes, &projections)), 0);
        }
        let (planes, nowhere) = (planes(), vec![f32::NAN; 32]);
        let mut grid = grid(carried(5));
        assert_eq!(follow_the_pictures(&mut grid, &Pictures::new((W as u32, H as u32), &planes, &nowhere)), 0);
    }
}
