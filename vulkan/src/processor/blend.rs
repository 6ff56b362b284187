//! Stages *rasterise* and *rasterise_backward*: tiles of eight by four pixels, a vector a row (`shaders/blend.glsl`, `backward.glsl`;
//! reference: `crate::reference::rasterise`).
//!
//! Threads take rows of tiles. Within a tile the Gaussians come near to far; both passes take the same decisions from the same numbers.

use super::Call;
use super::lanes::{EXPONENTS, F8, LANES, exp2, fma, ramp, splat};
use super::pool::Parts;
use crate::constants::{ALPHA_MAX, ALPHA_MIN, TILE_HEIGHT, TILE_WIDTH, TRANSMITTANCE_MIN};
use crate::layout::{FLAG_DEPTH, FLAG_FREEZE_SHAPE, FLAG_NO_EARLY_END, Frame};
use fearless_simd::prelude::*;
use fearless_simd::{Simd, dispatch, f32x4, mask32x8};

/// Rows of a tile.
const ROWS: usize = TILE_HEIGHT as usize;
const _: () = assert!(TILE_WIDTH as usize == LANES && ROWS == 4);

/// Largest exponent by which a value grows from one row to the next. Where it reaches [`ALPHA_MIN`] in the tile at all, it changes by
/// less than 57 over it: no axis is thinner than the low pass.
const STEEPEST: f32 = 64.0;

/// What shading leaves of a Gaussian: centre, depth and log2 of its opacity; its parabola; its colour (`shaders/shade.comp`).
type Shaded = [[f32; 4]; 3];

/// What is left of a tile's gradient in a Gaussian's slot: q and its first moments and the total weight, second moments and depth, colour.
type Slot = [[f32; 4]; 3];

/// A tile's place.
#[derive(Clone, Copy)]
struct Tile {
    /// Its first pixel in the picture.
    corner: [f32; 2],
    /// Its first pixel where the region is stored, and the region's width.
    at: usize,
    stride: usize,
    /// Columns and rows inside the region.
    inside: [usize; 2],
}

impl Tile {
    fn new(frame: &Frame, row: usize, column: usize) -> Self {
        let [width, height] = frame.region.map(|n| n as usize);
        let (x, y) = (column * LANES, row * ROWS);
        let corner = [frame.region_origin[0] as usize + x, frame.region_origin[1] as usize + y];
        Self {
            corner: corner.map(|v| v as f32 + 0.5),
            at: y * width + x,
            stride: width,
            inside: [LANES.min(width.saturating_sub(x)), ROWS.min(height.saturating_sub(y))],
        }
    }

    /// One where a pixel is inside, minus one where not: the transmittance that blending begins with.
    #[inline(always)]
    fn open<S: Simd>(&self, s: S) -> [F8<S>; ROWS] {
        let (one, columns) = (splat(s, 1.0), splat(s, self.inside[0] as f32));
        let row = ramp(s).simd_lt(columns).select(one, -one);
        let mut all = [-one; ROWS];
        for open in &mut all[..self.inside[1]] {
            *open = row;
        }
        all
    }

    /// Where a row is stored.
    fn row(&self, y: usize) -> std::ops::Range<usize> {
        let first = self.at + y * self.stride;
        first..first + self.inside[0]
    }
}

/// A band's tiles of one row of the window.
struct TileRow {
    row: usize,
    columns: std::ops::Range<usize>,
}

/// The rows of tiles of the band that is asked for.
fn tile_rows(call: &Call<'_>) -> (usize, impl Fn(usize) -> TileRow) {
    let across = call.frame.window[0].max(1) as usize;
    let (first, last) = (call.push.first as usize, call.push.last as usize);
    let (top, bottom) = (first / across, last.div_ceil(across));
    let row_of = move |i: usize| {
        let row = top + i;
        let columns = first.max(row * across) - row * across..last.min((row + 1) * across) - row * across;
        TileRow { row, columns }
    };
    (bottom.saturating_sub(top), row_of)
}

/// A Gaussian's values at the pixels of a tile before they are cut: along a row the exponential of a parabola, from row to row by
/// recurrence, two exponentials instead of four.
struct Values<S: Simd> {
    /// From the Gaussian's centre to the tile's first row, pixels.
    dx: F8<S>,
    dy: f32,
    raw: [F8<S>; ROWS],
}

impl<S: Simd> Values<S> {
    #[inline(always)]
    fn of(s: S, [center, parabola, _]: &Shaded, corner: [f32; 2]) -> Self {
        let [across, mixed, down, bend] = *parabola;
        let (dx, dy) = (ramp(s) + splat(s, corner[0] - center[0]), corner[1] - center[1]);
        let most = splat(s, center[3]);
        let rest = (down * dy).mul_add(dy, center[3]);
        let exponent = fma(dx, fma(splat(s, across), dx, splat(s, mixed * dy)), splat(s, rest));
        let change = fma(splat(s, mixed), dx, splat(s, down * (dy + (dy + 1.0))));
        let mut ratio = exp2(change.min(splat(s, STEEPEST)));
        let bend = splat(s, bend);
        // Nothing is nothing in every row, however steep: the least number that is not zero would grow.
        let is_something = exponent.simd_ge(splat(s, EXPONENTS[0]));
        let first = is_something.select(exp2(exponent.min(most)), splat(s, 0.0));
        let second = first * ratio;
        ratio *= bend;
        let third = second * ratio;
        ratio *= bend;
        Self { dx, dy, raw: [first, second, third, third * ratio] }
    }

    /// Whether it is seen at all.
    #[inline(always)]
    fn shows(&self, s: S) -> bool {
        let [a, b, c, d] = self.raw;
        a.max(b).max(c.max(d)).simd_ge(splat(s, ALPHA_MIN)).any_true()
    }
}

/// A Gaussian in a row of a tile: alpha, weight, and the transmittance behind it.
struct Blended<S: Simd> {
    alpha: F8<S>,
    weight: F8<S>,
    /// Where its light is taken: the pixel was not finished before, nor by it.
    taken: mask32x8<S>,
    /// What would be left behind it, also where that is too little to be taken.
    next: F8<S>,
    behind: F8<S>,
}

/// Blends a value into a transmittance, which is negative where a pixel is finished.
#[inline(always)]
fn blend_row<S: Simd>(s: S, raw: F8<S>, transmittance: F8<S>) -> Blended<S> {
    let zero = splat(s, 0.0);
    let alpha = raw.min(splat(s, ALPHA_MAX));
    let alpha = alpha.simd_ge(splat(s, ALPHA_MIN)).select(alpha, zero);
    let weight = alpha * transmittance;
    let next = transmittance - weight;
    let taken = next.simd_ge(splat(s, TRANSMITTANCE_MIN));
    Blended { alpha, weight: taken.select(weight, zero), taken, next, behind: taken.select(next, -transmittance.abs()) }
}

/// Whether any pixel is unfinished.
#[inline(always)]
fn any_open<S: Simd>(s: S, transmittance: &[F8<S>; ROWS]) -> bool {
    let [a, b, c, d] = *transmittance;
    a.max(b).max(c.max(d)).simd_gt(splat(s, 0.0)).any_true()
}

/// Instances of a tile, in the lists of its band.
#[inline(always)]
fn list_of(starts: &[u32], base: u32, tile: usize) -> std::ops::Range<usize> {
    starts[tile].wrapping_sub(base) as usize..starts[tile + 1].wrapping_sub(base) as usize
}

/// Blends colour and depth front to back.
pub(super) fn rasterise(call: &Call<'_>) {
    rasterise_as::<false>(call);
}

/// Blends with the depth of the Gaussian that takes the second half of the light.
pub(super) fn rasterise_median(call: &Call<'_>) {
    rasterise_as::<true>(call);
}

/// What the blend of a row of tiles reads and writes.
struct Picture<'a> {
    shaded: &'a [Shaded],
    instances: &'a [[u32; 2]],
    starts: &'a [u32],
    blended: Parts<'a, u32>,
    image: Parts<'a, [f32; 4]>,
    transmittance: Parts<'a, f32>,
}

fn rasterise_as<const MEDIAN: bool>(call: &Call<'_>) {
    let (frame, memory) = (call.frame, &call.memory);
    let tiles = frame.tiles() as usize;
    // SAFETY: the three sections that this kernel writes, once each.
    let (starts, image, transmittance) = unsafe {
        (memory.write::<u32>("tile_starts"), memory.write::<[f32; 4]>("image"), memory.write::<f32>("transmittance"))
    };
    let (starts, blended) = starts.split_at_mut(tiles + 1);
    let picture = Picture {
        shaded: memory.read("shaded"),
        instances: memory.read("instances"),
        starts,
        blended: Parts::of(blended),
        image: Parts::of(image),
        transmittance: Parts::of(transmittance),
    };
    let (rows, row_of) = tile_rows(call);
    call.pool.each(rows, |i| {
        dispatch!(call.level, s => rasterise_row::<_, MEDIAN>(s, call, &picture, &row_of(i)));
    });
}

#[inline(always)]
fn rasterise_row<S: Simd, const MEDIAN: bool>(s: S, call: &Call<'_>, picture: &Picture<'_>, tiles: &TileRow) {
    let (frame, across) = (call.frame, call.frame.window[0] as usize);
    let to_the_end = frame.has(FLAG_NO_EARLY_END);
    let base = picture.starts[call.push.first as usize];
    for column in tiles.columns.clone() {
        let (t, tile) = (tiles.row * across + column, Tile::new(frame, tiles.row, column));
        let mut transmittance = tile.open(s);
        let mut sums = [[splat(s, 0.0); 4]; ROWS];
        let list = list_of(picture.starts, base, t);
        let mut met = list.len();
        for (i, [gaussian, _]) in picture.instances[list].iter().enumerate() {
            let shaded = &picture.shaded[*gaussian as usize];
            let values = Values::of(s, shaded, tile.corner);
            if !values.shows(s) {
                continue;
            }
            let [center, _, color] = shaded;
            let carried = [splat(s, color[0]), splat(s, color[1]), splat(s, color[2]), splat(s, center[2])];
            for y in 0..ROWS {
                let Blended { weight, next, behind, .. } = blend_row(s, values.raw[y], transmittance[y]);
                let counted = if MEDIAN { 3 } else { 4 };
                for c in 0..counted {
                    sums[y][c] = fma(weight, carried[c], sums[y][c]);
                }
                if MEDIAN {
                    let half = splat(s, 0.5);
                    let passes = transmittance[y].simd_gt(half) & next.simd_le(half);
                    sums[y][3] = passes.select(carried[3], sums[y][3]);
                }
                transmittance[y] = behind;
            }
            if !to_the_end && !any_open(s, &transmittance) {
                met = i + 1;
                break;
            }
        }
        // SAFETY: a tile of this row of tiles, and its pixels, which no other part has.
        unsafe {
            // Counted work: how many Gaussians were met before the tile was opaque.
            picture.blended.range(t, 1).fill(met as u32);
            for y in 0..tile.inside[1] {
                let mut lanes = [[0.0; LANES]; 5];
                let left = transmittance[y].abs();
                for c in 0..4 {
                    let behind = if c < 3 { left * splat(s, frame.background[c]) } else { splat(s, 0.0) };
                    (sums[y][c] + behind).store_slice(&mut lanes[c]);
                }
                left.store_slice(&mut lanes[4]);
                let row = tile.row(y);
                for (x, pixel) in picture.image.range(row.start, row.len()).iter_mut().enumerate() {
                    *pixel = std::array::from_fn(|c| lanes[c][x]);
                }
                picture.transmittance.range(row.start, row.len()).copy_from_slice(&lanes[4][..row.len()]);
            }
        }
    }
}

/// Gradient of the blend for colour alone, front to back: what lies behind a Gaussian is the finished pixel minus what was blended so far.
pub(super) fn rasterise_backward(call: &Call<'_>) {
    backward_as::<false>(call);
}

/// Gradient of the blend for colour and depth, which are carried apart, so that the shape can be frozen against the depth loss.
pub(super) fn rasterise_backward_depth(call: &Call<'_>) {
    backward_as::<true>(call);
}

/// What the blend's gradient in a row of tiles reads and writes.
struct Gradients<'a> {
    shaded: &'a [Shaded],
    instances: &'a [[u32; 2]],
    starts: &'a [u32],
    image: &'a [[f32; 4]],
    gradient: &'a [[f32; 4]],
    slots: Parts<'a, Slot>,
}

fn backward_as<const DEPTH: bool>(call: &Call<'_>) {
    let memory = &call.memory;
    debug_assert_eq!(DEPTH, call.frame.has(FLAG_DEPTH));
    // SAFETY: the only section that this kernel writes.
    let slots = Parts::of(unsafe { memory.write::<Slot>("slots") });
    let gradients = Gradients {
        shaded: memory.read("shaded"),
        instances: memory.read("instances"),
        starts: memory.read("tile_starts"),
        image: memory.read("image"),
        gradient: memory.read("image_gradient"),
        slots,
    };
    let (rows, row_of) = tile_rows(call);
    call.pool.each(rows, |i| {
        dispatch!(call.level, s => backward_row::<_, DEPTH>(s, call, &gradients, &row_of(i)));
    });
}

/// Of the pixels of a tile: the loss's gradient, and its product with what is still to come.
struct Behind<S: Simd> {
    gradient: [[F8<S>; 4]; ROWS],
    color: [F8<S>; ROWS],
    depth: [F8<S>; ROWS],
}

impl<S: Simd> Behind<S> {
    #[inline(always)]
    fn load(s: S, tile: &Tile, image: &[[f32; 4]], gradient: &[[f32; 4]]) -> Self {
        let zero = splat(s, 0.0);
        let mut all = Self { gradient: [[zero; 4]; ROWS], color: [zero; ROWS], depth: [zero; ROWS] };
        for y in 0..tile.inside[1] {
            let (mut g, mut color, mut depth) = ([[0.0; LANES]; 4], [0.0; LANES], [0.0; LANES]);
            for (x, (by, shown)) in gradient[tile.row(y)].iter().zip(&image[tile.row(y)]).enumerate() {
                for c in 0..4 {
                    g[c][x] = by[c];
                }
                color[x] = by[0] * shown[0] + by[1] * shown[1] + by[2] * shown[2];
                depth[x] = by[3] * shown[3];
            }
            for c in 0..4 {
                all.gradient[y][c] = F8::from_slice(s, &g[c]);
            }
            (all.color[y], all.depth[y]) = (F8::from_slice(s, &color), F8::from_slice(s, &depth));
        }
        all
    }
}

/// Sums over the rows of a tile of q, and of q times the row and its square; of weight, colour and depth.
struct Sums<S: Simd> {
    /// Of q times 1 and the row.
    line: [F8<S>; 2],
    /// Of q without what the depth says of the shape, times 1, the row and its square.
    shape: [F8<S>; 3],
    weight: F8<S>,
    color: [F8<S>; 3],
    depth: F8<S>,
}

#[inline(always)]
fn backward_row<S: Simd, const DEPTH: bool>(s: S, call: &Call<'_>, all: &Gradients<'_>, tiles: &TileRow) {
    let (frame, across) = (call.frame, call.frame.window[0] as usize);
    let to_the_end = frame.has(FLAG_NO_EARLY_END);
    let thaw = if frame.has(FLAG_FREEZE_SHAPE) { 0.0 } else { 1.0 };
    let base = all.starts[call.push.first as usize];
    for column in tiles.columns.clone() {
        let (t, tile) = (tiles.row * across + column, Tile::new(frame, tiles.row, column));
        let mut transmittance = tile.open(s);
        let mut behind = Behind::load(s, &tile, all.image, all.gradient);
        let list = &all.instances[list_of(all.starts, base, t)];
        let mut open = true;
        for [gaussian, slot] in list {
            let mut found = [[0.0; 4]; 3];
            if open {
                let shaded = &all.shaded[*gaussian as usize];
                let values = Values::of(s, shaded, tile.corner);
                if values.shows(s) {
                    let sums = backward_tile::<_, DEPTH>(s, shaded, &values, &mut transmittance, &mut behind, thaw);
                    found = slot_of(s, &values, &sums);
                    open = to_the_end || any_open(s, &transmittance);
                }
            }
            // SAFETY: every instance has a slot of its own.
            unsafe { all.slots.range(*slot as usize, 1) }.fill(found);
        }
    }
}

#[inline(always)]
fn backward_tile<S: Simd, const DEPTH: bool>(
    s: S,
    [center, _, color]: &Shaded,
    values: &Values<S>,
    transmittance: &mut [F8<S>; ROWS],
    behind: &mut Behind<S>,
    thaw: f32,
) -> Sums<S> {
    let (zero, one) = (splat(s, 0.0), splat(s, 1.0));
    let color = [splat(s, color[0]), splat(s, color[1]), splat(s, color[2])];
    let depth = splat(s, center[2]);
    let mut sums = Sums { line: [zero; 2], shape: [zero; 3], weight: zero, color: [zero; 3], depth: zero };
    for y in 0..ROWS {
        let Blended { alpha, weight, taken, behind: next, .. } = blend_row(s, values.raw[y], transmittance[y]);
        // alpha / (1 - alpha), only where alpha itself follows the parameters.
        let follows = values.raw[y].simd_le(splat(s, ALPHA_MAX));
        let odds = (taken & follows).select(alpha / (one - alpha), zero);
        let own = follows.select(weight, zero);
        transmittance[y] = next;
        let g = &behind.gradient[y];
        let value = fma(color[2], g[2], fma(color[1], g[1], color[0] * g[0]));
        let left = fma(-weight, value, behind.color[y]);
        behind.color[y] = left;
        let mut term = fma(own, value, -(odds * left));
        let mut shape = term;
        for c in 0..3 {
            sums.color[c] = fma(weight, g[c], sums.color[c]);
        }
        if DEPTH {
            let value = depth * g[3];
            let left = fma(-weight, value, behind.depth[y]);
            behind.depth[y] = left;
            let by_depth = fma(own, value, -(odds * left));
            sums.depth = fma(weight, g[3], sums.depth);
            shape = fma(splat(s, thaw), by_depth, term);
            term += by_depth;
        }
        sums.weight += weight;
        let row = y as f32;
        sums.line[0] += term;
        sums.line[1] = fma(term, splat(s, row), sums.line[1]);
        sums.shape[0] += shape;
        sums.shape[1] = fma(shape, splat(s, row), sums.shape[1]);
        sums.shape[2] = fma(shape, splat(s, row * row), sums.shape[2]);
    }
    sums
}

/// A slot from the sums over a tile's rows: moved from its first row to the Gaussian's centre, and added along the row.
#[inline(always)]
fn slot_of<S: Simd>(s: S, Values { dx, dy, .. }: &Values<S>, sums: &Sums<S>) -> Slot {
    let (dx, dy) = (*dx, splat(s, *dy));
    let [q, q_row] = sums.line;
    let [p, p_row, p_square] = sums.shape;
    let moved = fma(dy, p, p_row);
    let p_yy = fma(dy, moved + p_row, p_square);
    let p_x = p * dx;
    let [a, b, c, d] = totals(s, [q, q * dx, fma(dy, q, q_row), sums.weight]);
    let [e, f, g, h] = totals(s, [p_x * dx, moved * dx, p_yy, sums.depth]);
    let [i, j, k, _] = totals(s, [sums.color[0], sums.color[1], sums.color[2], splat(s, 0.0)]);
    [[a, b, c, d], [e, f, g, h], [i, j, k, 0.0]]
}

/// The sums of four vectors: halves first, then pairs of what is left, in one order whatever the processor's vectors are.
#[inline(always)]
fn totals<S: Simd>(s: S, all: [F8<S>; 4]) -> [f32; 4] {
    let mut halves = [f32x4::splat(s, 0.0); 4];
    for (half, v) in halves.iter_mut().zip(all) {
        let (low, high) = s.split_f32x8(v);
        *half = low + high;
    }
    let [a, b, c, d] = halves;
    // Rows to columns, so that the last additions are those of whole vectors.
    let (ab, cd) = (a.zip_low(b) + a.zip_high(b), c.zip_low(d) + c.zip_high(d));
    let mut out = [0.0; 8];
    ab.store_slice(&mut out[..4]);
    cd.store_slice(&mut out[4..]);
    [out[0] + out[2], out[1] + out[3], out[4] + out[6], out[5] + out[7]]
}

#[cfg(test)]
mod tests {
    use super::*;
    use fearless_simd::Level;

    /// A round Gaussian of the low pass alone, at the origin, nearly opaque.
    const SPECK: Shaded = {
        let down = -0.5 * std::f32::consts::LOG2_E / 0.3;
        [[0.0, 0.0, 1.0, -0.01], [down, 0.0, down, 0.035_674], [1.0, 1.0, 1.0, 0.0]]
    };

    fn values(corner: [f32; 2]) -> [[f32; LANES]; ROWS] {
        #[inline(always)]
        fn of<S: Simd>(s: S, corner: [f32; 2]) -> [[f32; LANES]; ROWS] {
            let values = Values::of(s, &SPECK, corner);
            let mut all = [[0.0; LANES]; ROWS];
            for (row, raw) in all.iter_mut().zip(&values.raw) {
                raw.store_slice(row);
            }
            all
        }
        dispatch!(Level::new(), s => of(s, corner))
    }

    #[test]
    fn values_are_those_of_the_parabola_and_nothing_far_from_it_wherever_a_tile_lies() {
        for (x, y) in (-60..60).flat_map(|x| (-60..60).map(move |y| (x, y))) {
            let corner = [x as f32 + 0.37, y as f32 + 0.81];
            for (j, row) in values(corner).iter().enumerate() {
                for (i, found) in row.iter().enumerate() {
                    let [dx, dy] = [corner[0] + i as f32, corner[1] + j as f32].map(f64::from);
                    let exact = (f64::from(SPECK[1][0]) * (dx * dx + dy * dy) + f64::from(SPECK[0][3])).exp2();
                    let wrong = (f64::from(*found) - exact).abs();
                    assert!(wrong <= 1e-3 * exact + 1e-9, "{found} instead of {exact} at ({dx}, {dy})");
                }
            }
        }
    }
}
