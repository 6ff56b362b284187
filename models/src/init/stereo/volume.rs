//! Costs of all cells at all planes: one less the correlation of the windows around a cell in the reference and where the plane
//! puts them in the sources.

use super::features::{Features, Finer, PRODUCT};
use super::{PLANES, Smoothness, Source, UNIT};

/// Half the sides of the two windows whose correlations are weighed against each other, cells.
const SMALL: usize = 3;
const LARGE: usize = 10;
/// Shares of the best source and of the second: one from which the place is hidden must not veto.
const BEST: f32 = 0.65;
const SECOND: f32 = 0.35;
/// Rows of products that are kept: those of the larger window, and the one that leaves it.
const RING: usize = 2 * LARGE + 2;
/// The correlation of a source that does not see the cell.
const UNSEEN: i16 = i16::MIN;

/// Evenly spaced inverse depths.
#[derive(Clone, Copy, Debug)]
pub struct Inverse {
    pub farthest: f32,
    pub step: f32,
}

impl Inverse {
    /// Over a nearest and a farthest depth.
    pub fn over([near, far]: [f32; 2]) -> Self {
        Self { farthest: 1.0 / far, step: (1.0 / near - 1.0 / far) / (PLANES - 1) as f32 }
    }

    /// That of a plane, or between two.
    pub fn at(&self, plane: f32) -> f32 {
        self.farthest + plane * self.step
    }
}

/// Costs, plane by plane.
#[derive(Debug, Default)]
pub struct Volume {
    width: usize,
    height: usize,
    pub costs: Vec<u8>,
    /// The two best correlations of a plane's cells.
    best: Vec<i16>,
    second: Vec<i16>,
    windows: Windows,
}

/// Sums of products of features over windows that go down a picture.
#[derive(Debug, Default)]
struct Windows {
    /// Products of the last rows, by row modulo [`RING`]; the first and the last are continued by half a window on either side.
    products: Vec<i16>,
    /// Whether the source sees the cells of those rows.
    seen: Vec<u8>,
    /// Middles of a row's cells in the reference, pixels, and where they lie in the source.
    centers: Vec<f32>,
    at: [Vec<f32>; 2],
    /// Sums of columns of the smaller and of the larger window.
    columns: [Vec<i32>; 2],
    /// Of the larger window's columns, seven at a time: three of those are its 21.
    sevens: Vec<i32>,
    /// Where the cells of a row lie in the source.
    places: Vec<i32>,
    /// Share of the larger window.
    large_share: f32,
}

impl Volume {
    pub fn planned_bytes(cells: u64, across: u64) -> u64 {
        let padded = across + 2 * LARGE as u64;
        cells * (PLANES as u64 + 4) + RING as u64 * (2 * padded + across) + 28 * padded
    }

    #[cfg(test)]
    pub fn held_bytes(&self) -> u64 {
        let Windows { products, seen, columns, sevens, places, centers, at, .. } = &self.windows;
        let floats = centers.capacity() + at.iter().map(Vec::capacity).sum::<usize>();
        let words = columns.iter().map(Vec::capacity).sum::<usize>() + sevens.capacity() + places.capacity() + floats;
        let shorts = self.best.capacity() + self.second.capacity() + products.capacity();
        (self.costs.capacity() + seen.capacity() + 2 * shorts + 4 * words) as u64
    }

    /// Costs of a row, plane by plane, into a row of cells with all their planes.
    pub fn row(&self, y: usize, out: &mut [[u8; PLANES]]) {
        let n = self.width * self.height;
        for d in 0..PLANES {
            let costs = &self.costs[d * n + y * self.width..][..self.width];
            out.iter_mut().zip(costs).for_each(|(cell, cost)| cell[d] = *cost);
        }
    }

    /// Columns and rows of cells.
    pub fn size(&self) -> (usize, usize) {
        (self.width, self.height)
    }

    pub fn fill(&mut self, features: &Features, sources: &[Source<'_>], inverse: Inverse, smoothness: Smoothness) {
        self.windows.large_share = smoothness.large_window;
        let n = features.width * features.height;
        (self.width, self.height) = (features.width, features.height);
        self.costs.resize(PLANES * n, 0);
        for d in 0..PLANES {
            for correlations in [&mut self.best, &mut self.second] {
                correlations.clear();
                correlations.resize(n, UNSEEN);
            }
            for (finer, source) in features.sources.iter().zip(sources) {
                self.correlate(features, finer, &source.projection, inverse.at(d as f32));
            }
            let costs = &mut self.costs[d * n..][..n];
            for ((cost, best), second) in costs.iter_mut().zip(&self.best).zip(&self.second) {
                // Where nobody looks, chance: a correlation of nothing.
                let best = if *best == UNSEEN { 0 } else { *best };
                let second = if *second == UNSEEN { best } else { *second };
                *cost = (UNIT as f32 - BEST * f32::from(best) - SECOND * f32::from(second)).clamp(0.0, 255.0) as u8;
            }
        }
    }

    /// Adds the correlations of one source at one inverse depth.
    fn correlate(&mut self, features: &Features, source: &Finer, m: &[f32; 16], inverse: f32) {
        let (w, h) = (self.width, self.height);
        self.windows.begin(w, features.cell as f32);
        // Rows of products are made ahead of the row whose windows they complete.
        let mut made = 0;
        for y in 0..h {
            while made < (y + LARGE + 1).min(h) {
                self.windows.multiply(features, source, m, (made, inverse));
                made += 1;
            }
            self.windows.go_down(y, h);
            self.windows.best_of(y, (&mut self.best[y * w..][..w], &mut self.second[y * w..][..w]));
        }
    }
}

impl Windows {
    fn begin(&mut self, w: usize, cell: f32) {
        let padded = w + 2 * LARGE;
        self.products.resize(RING * padded, 0);
        self.seen.resize(RING * w, 0);
        self.centers.clear();
        self.centers.extend((0..w).map(|x| middle(x, cell)));
        self.at.iter_mut().for_each(|at| at.resize(w, 0.0));
        self.places.resize(w, 0);
        self.sevens.resize(padded, 0);
        for columns in &mut self.columns {
            columns.clear();
            columns.resize(padded, 0);
        }
    }

    /// Products of the features of row `y` and of the places in `source` where `inverse` puts its cells.
    fn multiply(&mut self, features: &Features, source: &Finer, m: &[f32; 16], (y, inverse): (usize, f32)) {
        let (w, cell) = (features.width, features.cell as f32);
        let py = middle(y, cell);
        let start = |r: usize| m[4 * r + 1] * py + m[4 * r + 2] + m[4 * r + 3] * inverse;
        let (bx, by, bz) = (start(0), start(1), start(2));
        let (ax, ay, az) = (m[0], m[4], m[8]);
        let seen = &mut self.seen[y % RING * w..][..w];
        let (fw, fh, finer) = (source.width as f32, source.height as f32, 1.0 / source.pixels);
        let (columns, beyond) = (source.width as i32, (source.width * source.height) as i32);
        // Loop by loop, so that the first works on several cells at once.
        let [us, vs] = &mut self.at;
        for ((u, v), (px, seen)) in us.iter_mut().zip(vs.iter_mut()).zip(self.centers.iter().zip(seen.iter_mut())) {
            let z = az * px + bz;
            let nearness = 1.0 / z;
            let x = ((ax * px + bx) * nearness + 0.5) * finer;
            let y = ((ay * px + by) * nearness + 0.5) * finer;
            *seen = u8::from((z > 1e-6) & (x >= 0.0) & (y >= 0.0) & (x < fw) & (y < fh));
            // Within what is converted, whatever the projection; what is no number compares false.
            *u = if x >= 0.0 { x.min(fw) } else { 0.0 };
            *v = if y >= 0.0 { y.min(fh) } else { 0.0 };
        }
        for ((place, seen), (u, v)) in self.places.iter_mut().zip(seen).zip(us.iter().zip(vs.iter())) {
            let inside = (*v as i32).wrapping_mul(columns).wrapping_add(*u as i32);
            *place = if *seen > 0 { inside } else { beyond };
        }
        let padded = w + 2 * LARGE;
        let row = &mut self.products[y % RING * padded..][..padded];
        let reference = &features.reference[y * w..][..w];
        for ((product, place), own) in row[LARGE..].iter_mut().zip(&self.places).zip(reference) {
            let theirs = source.values.get(*place as u32 as usize).copied().unwrap_or(0);
            *product = own.wrapping_mul(theirs);
        }
        let (first, last) = (row[LARGE], row[LARGE + w - 1]);
        row[..LARGE].fill(first);
        row[LARGE + w..].fill(last);
    }

    /// Moves the windows to row `y` of `h`; beyond the rim the picture is continued by its last rows.
    fn go_down(&mut self, y: usize, h: usize) {
        let padded = self.sevens.len();
        let products = &self.products;
        let row = |y: isize| &products[y.clamp(0, h as isize - 1) as usize % RING * padded..][..padded];
        for (columns, half) in self.columns.iter_mut().zip([SMALL as isize, LARGE as isize]) {
            let y = y as isize;
            if y == 0 {
                for k in -half..=half {
                    columns.iter_mut().zip(row(k)).for_each(|(sum, v)| *sum = sum.wrapping_add(i32::from(*v)));
                }
            } else {
                let (new, old) = (row(y + half), row(y - half - 1));
                for ((sum, new), old) in columns.iter_mut().zip(new).zip(old) {
                    *sum = sum.wrapping_add(i32::from(*new).wrapping_sub(i32::from(*old)));
                }
            }
        }
    }

    /// Puts the correlations of row `y` among the two best.
    fn best_of(&mut self, y: usize, (bests, seconds): (&mut [i16], &mut [i16])) {
        let [small, large] = &self.columns;
        let w = bests.len();
        for (sum, c) in self.sevens.iter_mut().zip(large.windows(7)) {
            *sum = seven(c);
        }
        let (sevens, small, seen) = (&self.sevens, &small[LARGE - SMALL..], &self.seen[y % RING * w..][..w]);
        let gain = |half: usize| UNIT as f32 / (((2 * half + 1) * (2 * half + 1)) as f32 * PRODUCT);
        let gains = [(1.0 - self.large_share) * gain(SMALL), self.large_share * gain(LARGE)];
        for x in 0..w {
            let near = seven(&small[x..x + 7]);
            let wide = sevens[x].wrapping_add(sevens[x + 7]).wrapping_add(sevens[x + 14]);
            let correlation = (gains[0] * near as f32 + gains[1] * wide as f32) as i32 as i16;
            let correlation = if seen[x] > 0 { correlation } else { UNSEEN };
            seconds[x] = seconds[x].max(correlation.min(bests[x]));
            bests[x] = bests[x].max(correlation);
        }
    }
}

/// The middle of a cell from the middle of the first pixel, pixels.
fn middle(k: usize, cell: f32) -> f32 {
    k as f32 * cell + (cell - 1.0) / 2.0
}

/// Their sum; all of a window's products together stay far below the largest number.
fn seven(c: &[i32]) -> i32 {
    c[..7].iter().fold(0, |sum, v| sum.wrapping_add(*v))
}
