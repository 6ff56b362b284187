//! Stage *loss*: L1, SSIM and Pearson depth, and their gradient at every pixel (`shaders/ssim_*.comp`, `loss_gradient.comp`,
//! `depth_*.comp`, `exposure_sums.comp`; reference: `crate::reference::loss`).
//!
//! SSIM's window is separable: along rows, along columns, and for the gradient once more along both. Threads take [`CHUNK`] rows. The means
//! of the rows that a window reaches stay in a ring, which a core's cache holds; of the derivatives, blurred along rows, whole planes are
//! left for the last pass. Sums are of a strip of [`STRIP`] rows, so that they do not depend on the number of threads.

use super::Call;
use super::lanes::{F8, LANES, fma, load, splat, store, sum};
use super::pool::Parts;
use super::target::LEFT_OUT;
use crate::constants::{self, PEARSON_EPSILON, SSIM_C1, SSIM_C2, SSIM_RADIUS, SSIM_WINDOW};
use crate::kernels::DEPTH_LANES;
use crate::layout::{DepthMoments, FLAG_DEPTH, Frame, LossSums, Status};
use bytemuck::Zeroable;
use fearless_simd::prelude::*;
use fearless_simd::{Simd, dispatch};

/// Rows of a strip.
const STRIP: usize = constants::STRIP as usize;
/// Rows that the window of a strip's rows reaches.
const REACH: usize = STRIP + 2 * SSIM_RADIUS;
/// Strips that a thread takes at once.
const CHUNK_STRIPS: usize = 5;
/// Rows of those. The means of [`REACH`] rows of every chunk lie where those of a whole picture would.
const CHUNK: usize = CHUNK_STRIPS * STRIP;
const _: () = assert!(2 * REACH <= CHUNK + 1);
/// Pixels of a row that are blurred at once.
const BLOCK: usize = 64;
/// Those and the window's reach on either side, whole vectors.
const BLOCK_REACH: usize = BLOCK + 2 * LANES;
const _: () = assert!(SSIM_RADIUS <= LANES);
/// Means of x, y, x² + y² and xy (x rendered with exposure, y the target).
const MOMENTS: usize = 4;
/// SSIM's derivatives by the mean of x, by that of x² + y² and by that of xy.
const DERIVATIVES: usize = 3;

/// What the window reaches along a row or a column.
const TAPS: usize = 2 * SSIM_RADIUS + 1;

/// The window's sum over what lies on both sides of `v[5]`, from its rim inwards.
#[inline(always)]
fn weighted<S: Simd>(s: S, v: &[F8<S>; TAPS]) -> F8<S> {
    let tap = |offset: usize| splat(s, SSIM_WINDOW[offset]);
    let mut sum = tap(5) * (v[0] + v[10]);
    sum = fma(tap(4), v[1] + v[9], sum);
    sum = fma(tap(3), v[2] + v[8], sum);
    sum = fma(tap(2), v[3] + v[7], sum);
    sum = fma(tap(1), v[4] + v[6], sum);
    fma(tap(0), v[5], sum)
}

/// A picture's size, and its strips.
#[derive(Clone, Copy)]
struct Size {
    width: usize,
    height: usize,
}

impl Size {
    fn of(frame: &Frame) -> Self {
        let [width, height] = frame.size.map(|n| n as usize);
        Self { width, height }
    }

    fn strips(self) -> usize {
        self.height.div_ceil(STRIP)
    }

    fn chunks(self) -> usize {
        self.height.div_ceil(CHUNK)
    }

    fn strips_of(self, chunk: usize) -> std::ops::Range<usize> {
        chunk * CHUNK_STRIPS..((chunk + 1) * CHUNK_STRIPS).min(self.strips())
    }

    /// Rows of a strip.
    fn rows(self, strip: usize) -> std::ops::Range<usize> {
        strip * STRIP..((strip + 1) * STRIP).min(self.height)
    }
}

/// A channel of a pixel as rendered, with exposure, and what it is compared with: itself where it is left out.
#[inline(always)]
fn compared_in(frame: &Frame, c: usize, rendered: f32, texel: u32) -> (f32, f32) {
    let x = rendered.mul_add(frame.exposure_gain[c], frame.exposure_offset[c]);
    let y = (texel >> (8 * c) & 0xFF) as f32 * (1.0 / 255.0);
    (x, if texel >> 24 == LEFT_OUT { x } else { y })
}

/// Eight columns blurred along their row, which holds them from place `at` on.
#[inline(always)]
fn blur_along<S: Simd>(s: S, row: &[f32; BLOCK_REACH], at: usize) -> F8<S> {
    let mut v = [splat(s, 0.0); TAPS];
    for (j, v) in v.iter_mut().enumerate() {
        *v = F8::from_slice(s, &row[at + j - SSIM_RADIUS..at + j - SSIM_RADIUS + LANES]);
    }
    weighted(s, &v)
}

/// Where numbers of several maps lie: row by row, eight columns of one map after those of the other, so that a pass over a strip reads
/// each row from its beginning to its end.
#[derive(Clone, Copy)]
struct Maps {
    width: usize,
    maps: usize,
}

impl Maps {
    /// Numbers of a row.
    fn row(self) -> usize {
        self.width * self.maps
    }

    /// Columns that lie together at `x`, a multiple of [`LANES`].
    fn columns(self, x: usize) -> usize {
        LANES.min(self.width - x)
    }

    /// Where those of a map lie in a row.
    #[inline(always)]
    fn at(self, x: usize, map: usize) -> std::ops::Range<usize> {
        let first = x * self.maps + map * self.columns(x);
        first..first + self.columns(x)
    }
}

/// Where the rows begin that the window of a strip reaches; nothing outside the picture, where all is zero.
type Reached = [Option<usize>; REACH];

/// The rows that a strip reaches, where row `y` begins at `start(y)`.
fn reached(size: Size, strip: usize, start: impl Fn(usize) -> usize) -> Reached {
    let row = |j: usize| (strip * STRIP + j).checked_sub(SSIM_RADIUS).filter(|y| *y < size.height);
    std::array::from_fn(|j| row(j).map(&start))
}

/// SSIM, and its derivatives blurred along rows: all passes but the last, each thread with a ring of its own.
pub(super) fn ssim_back_rows(call: &Call<'_>) {
    let (size, memory) = (Size::of(call.frame), &call.memory);
    let pictures = (memory.read::<[f32; 4]>("image"), memory.read::<[u32; 2]>("target"));
    // SAFETY: the three sections that this kernel writes, once each.
    let (rings, derivatives, sums) = unsafe {
        (
            Parts::of(memory.write::<f32>("moments")),
            Parts::of(memory.write::<f32>("adjoint")),
            Parts::of(memory.write::<LossSums>("strip_sums")),
        )
    };
    let (ring_rows, each) = (REACH.min(size.height), 3 * DERIVATIVES * size.width);
    call.pool.each_with_slot(size.chunks(), |chunk, slot| {
        let maps = Maps { width: size.width, maps: 3 * MOMENTS };
        let numbers = ring_rows * maps.row();
        // SAFETY: a slot is one thread's at a time. There is room: REACH rows of as many chunks as there are slots are no more than the
        // picture has.
        let mut ring = Ring { means: unsafe { rings.range(slot * numbers, numbers) }, maps, rows: ring_rows };
        let strips = size.strips_of(chunk);
        let mut next = (strips.start * STRIP).saturating_sub(SSIM_RADIUS);
        for strip in strips {
            let (rows, last) = (size.rows(strip), ((strip + 1) * STRIP + SSIM_RADIUS).min(size.height));
            // SAFETY: rows of this strip, and its sums, which no other part has.
            let (out, sums) = unsafe {
                (derivatives.range(rows.start * each, rows.len() * each), sums.range(strip * size.width, size.width))
            };
            // The first is the strip's, the host adds them all.
            sums.fill(LossSums::zeroed());
            dispatch!(call.level, s => {
                for y in std::mem::replace(&mut next, last)..last {
                    ring.add_row(s, call.frame, pictures, y);
                }
                sums[0].ssim = ring.derive(s, size, strip, out);
            });
        }
    });
}

/// What lies between the passes: of the last rows, the window's means along the row, three channels of [`MOMENTS`] each.
struct Ring<'a> {
    means: &'a mut [f32],
    maps: Maps,
    rows: usize,
}

impl Ring<'_> {
    /// Where a row begins.
    fn start(&self, y: usize) -> usize {
        y % self.rows * self.maps.row()
    }

    /// First pass: along a row, the window's means of what SSIM needs.
    #[inline(always)]
    fn add_row<S: Simd>(&mut self, s: S, frame: &Frame, (image, target): (&[[f32; 4]], &[[u32; 2]]), y: usize) {
        let width = self.maps.width;
        let (image, target) = (&image[y * width..(y + 1) * width], &target[y * width..(y + 1) * width]);
        let start = self.start(y);
        let row = &mut self.means[start..start + self.maps.row()];
        for x0 in (0..width).step_by(BLOCK) {
            // Zero outside the picture: x and y of each channel, then the four maps of one.
            let mut shown = [[[0.0; BLOCK_REACH]; 2]; 3];
            let (first, last) = (x0.saturating_sub(LANES), (x0 + BLOCK + LANES).min(width));
            compare(frame, (&image[first..last], &target[first..last]), &mut shown, first + LANES - x0);
            for (c, [a, b]) in shown.iter().enumerate() {
                let (mut squares, mut products) = ([0.0; BLOCK_REACH], [0.0; BLOCK_REACH]);
                for x in (0..BLOCK_REACH).step_by(LANES) {
                    let (a, b) = (F8::from_slice(s, &a[x..x + LANES]), F8::from_slice(s, &b[x..x + LANES]));
                    fma(a, a, b * b).store_slice(&mut squares[x..x + LANES]);
                    (a * b).store_slice(&mut products[x..x + LANES]);
                }
                for (k, values) in [a, b, &squares, &products].into_iter().enumerate() {
                    for x in (x0..(x0 + BLOCK).min(width)).step_by(LANES) {
                        store(blur_along(s, values, x - x0 + LANES), &mut row[self.maps.at(x, MOMENTS * c + k)]);
                    }
                }
            }
        }
    }

    /// Second and third pass: along columns, then a strip's SSIM and its derivatives, which are blurred along rows; returns the sum of
    /// SSIM.
    #[inline(always)]
    fn derive<S: Simd>(&self, s: S, size: Size, strip: usize, out: &mut [f32]) -> f32 {
        let (width, rows) = (size.width, reached(size, strip, |y| self.start(y)));
        let maps = Maps { width, maps: 3 * DERIVATIVES };
        let mut total = Total::new(s);
        // Derivatives of a block, and of the columns before it; zero outside the picture.
        let mut found = [[[0.0; BLOCK_REACH]; 3 * DERIVATIVES]; STRIP];
        for x0 in (0..width + LANES).step_by(BLOCK) {
            for x in (x0..x0 + BLOCK).step_by(LANES) {
                if x < width {
                    let columns = Columns { x, count: maps.columns(x) };
                    for c in 0..3 {
                        self.derive_columns(s, c, &rows, columns, (&mut found, x - x0), &mut total);
                    }
                } else {
                    for row in found.iter_mut().flatten() {
                        row[2 * LANES + x - x0..][..LANES].fill(0.0);
                    }
                }
            }
            for (out, found) in out.chunks_exact_mut(maps.row()).zip(&mut found) {
                for x in (0..BLOCK).step_by(LANES) {
                    let Some(at) = (x0 + x).checked_sub(LANES).filter(|at| *at < width) else { continue };
                    for (map, found) in found.iter().enumerate() {
                        store(blur_along(s, found, LANES + x), &mut out[maps.at(at, map)]);
                    }
                }
                for found in found {
                    found.copy_within(BLOCK.., 0);
                }
            }
        }
        total.sum()
    }

    /// The derivatives of a channel in some columns of a strip, kept from place `at` on behind those of the columns before the block.
    #[inline(always)]
    fn derive_columns<S: Simd>(
        &self,
        s: S,
        c: usize,
        rows: &Reached,
        Columns { x, count }: Columns,
        (found, at): (&mut [[[f32; BLOCK_REACH]; 3 * DERIVATIVES]; STRIP], usize),
        total: &mut Total<S>,
    ) {
        let mut blurred = [[splat(s, 0.0); STRIP]; MOMENTS];
        for (k, blurred) in blurred.iter_mut().enumerate() {
            *blurred = blur_down(s, self.means, rows, self.maps.at(x, MOMENTS * c + k));
        }
        // As many as the strip has in the picture.
        let inside = rows[SSIM_RADIUS..SSIM_RADIUS + STRIP].iter().flatten().count();
        for (o, found) in found[..inside].iter_mut().enumerate() {
            let (value, by) = ssim_of(s, [blurred[0][o], blurred[1][o], blurred[2][o], blurred[3][o]]);
            total.add(value, count);
            for (k, by) in by.into_iter().enumerate() {
                let to = &mut found[DERIVATIVES * c + k][2 * LANES + at..3 * LANES + at];
                by.store_slice(to);
                to[count..].fill(0.0);
            }
        }
    }
}

/// Columns that lie together.
#[derive(Clone, Copy)]
struct Columns {
    x: usize,
    count: usize,
}

/// What is compared of some pixels, channel by channel, from place `at` on.
#[inline(always)]
fn compare<const N: usize>(
    frame: &Frame,
    (image, target): (&[[f32; 4]], &[[u32; 2]]),
    out: &mut [[[f32; N]; 2]; 3],
    at: usize,
) {
    for (c, [shown, wanted]) in out.iter_mut().enumerate() {
        let pixels = shown[at..].iter_mut().zip(&mut wanted[at..]).zip(image.iter().zip(target));
        for ((shown, wanted), (rendered, texel)) in pixels {
            (*shown, *wanted) = compared_in(frame, c, rendered[c], texel[0]);
        }
    }
}

/// Eight columns blurred down a strip: `rows` tells where each row begins, and `at` where its columns are.
#[inline(always)]
fn blur_down<S: Simd>(s: S, all: &[f32], rows: &Reached, at: std::ops::Range<usize>) -> [F8<S>; STRIP] {
    let mut sums = [splat(s, 0.0); STRIP];
    macro_rules! add_rows {
        ($($j:literal)*) => { $(
            if let Some(start) = rows[$j] {
                let v = load(s, &all[start + at.start..start + at.end]);
                add_row::<_, $j>(s, v, &mut sums);
            }
        )* };
    }
    add_rows!(0 1 2 3 4 5 6 7 8 9 10 11 12 13 14 15 16 17);
    sums
}

/// Adds row `J` of those that a strip reaches to the rows of the strip that reach it.
#[inline(always)]
fn add_row<S: Simd, const J: usize>(s: S, v: F8<S>, sums: &mut [F8<S>; STRIP]) {
    const { assert!(J < REACH && REACH == 18) };
    for (o, sum) in sums.iter_mut().enumerate() {
        if let Some(tap) = SSIM_WINDOW.get((J + STRIP - o).abs_diff(SSIM_RADIUS + STRIP)) {
            *sum = fma(splat(s, *tap), v, *sum);
        }
    }
}

/// Adds what lanes hold to a strip's sum: of whole vectors lane by lane, of the last one those that lie in the picture.
struct Total<S: Simd> {
    whole: F8<S>,
    rest: f32,
}

impl<S: Simd> Total<S> {
    #[inline(always)]
    fn new(s: S) -> Self {
        Self { whole: splat(s, 0.0), rest: 0.0 }
    }

    #[inline(always)]
    fn add(&mut self, v: F8<S>, count: usize) {
        if count == LANES {
            self.whole += v;
        } else {
            let mut some = [0.0; LANES];
            v.store_slice(&mut some);
            self.rest += some[..count].iter().sum::<f32>();
        }
    }

    #[inline(always)]
    fn sum(self) -> f32 {
        sum(self.whole) + self.rest
    }
}

/// SSIM at a pixel, and its derivatives by the means of x, of x² + y² and of xy (`reference::loss::ssim`).
#[inline(always)]
fn ssim_of<S: Simd>(s: S, [ma, mb, squares, product]: [F8<S>; MOMENTS]) -> (F8<S>, [F8<S>; DERIVATIVES]) {
    let two = splat(s, 2.0);
    let cross2 = two * ma * mb;
    let square = fma(ma, ma, mb * mb);
    // Rounding may make a variance negative, or the covariance larger than both: far beyond colours of 1 the denominator would otherwise
    // reach zero.
    let variances = (squares - square).max(splat(s, 0.0));
    let covariance2 = (two * product - cross2).max(-variances).min(variances);
    let (a1, a2) = (cross2 + splat(s, SSIM_C1), covariance2 + splat(s, SSIM_C2));
    let (r1, r2) = (splat(s, 1.0) / (square + splat(s, SSIM_C1)), splat(s, 1.0) / (variances + splat(s, SSIM_C2)));
    let both = r1 * r2;
    let value = a1 * a2 * both;
    let by_mean = fma(two * mb * (a2 - a1), both, two * ma * value * (r2 - r1));
    (value, [by_mean, -(value * r2), two * a1 * both])
}

/// Last pass: along columns, with what L1 and the depth add.
pub(super) fn loss_gradient(call: &Call<'_>) {
    let (size, memory) = (Size::of(call.frame), &call.memory);
    let (image, target) = (memory.read::<[f32; 4]>("image"), memory.read::<[u32; 2]>("target"));
    let (blurred, status) = (memory.read::<f32>("adjoint"), &memory.read::<Status>("status")[0]);
    // SAFETY: the two sections that this kernel writes, once each.
    let (gradients, sums) = unsafe {
        (Parts::of(memory.write::<[f32; 4]>("image_gradient")), Parts::of(memory.write::<LossSums>("strip_sums")))
    };
    call.pool.each(size.chunks(), |chunk| {
        let pictures = (image, target, blurred);
        let strips = size.strips_of(chunk);
        dispatch!(call.level, s => {
            let mut l1 = [const { None }; CHUNK_STRIPS];
            for x0 in (0..size.width).step_by(BLOCK) {
                for (strip, l1) in strips.clone().zip(&mut l1) {
                    let l1 = l1.get_or_insert_with(|| Total::new(s));
                    gradient_of_block(s, call.frame, status, pictures, &gradients, (size, strip, x0), l1);
                }
            }
            for (strip, l1) in strips.zip(l1) {
                // SAFETY: a strip's sums, which no other part has.
                if let (Some(own), Some(l1)) = (unsafe { sums.range(strip * size.width, 1) }.first_mut(), l1) {
                    own.l1 = l1.sum();
                }
            }
        });
    });
}

/// The gradient in a block of a strip's pixels.
#[inline(always)]
fn gradient_of_block<S: Simd>(
    s: S,
    frame: &Frame,
    status: &Status,
    (image, target, blurred): (&[[f32; 4]], &[[u32; 2]], &[f32]),
    gradients: &Parts<'_, [f32; 4]>,
    (size, strip, x0): (Size, usize, usize),
    l1: &mut Total<S>,
) {
    let (width, has_depth, count) = (size.width, frame.has(FLAG_DEPTH), BLOCK.min(size.width - x0));
    // Of each row and channel: what is compared, then in place of the first the gradient.
    let mut pixels = [[[[0.0; BLOCK]; 2]; 3]; STRIP];
    for (y, pixels) in size.rows(strip).zip(&mut pixels) {
        let at = y * width + x0;
        compare(frame, (&image[at..at + count], &target[at..at + count]), pixels, 0);
    }
    let (zero, one, two) = (splat(s, 0.0), splat(s, 1.0), splat(s, 2.0));
    let (by_l1, by_ssim) = (splat(s, frame.l1_weight), splat(s, -frame.ssim_weight));
    let maps = Maps { width, maps: 3 * DERIVATIVES };
    let rows = reached(size, strip, |y| y * maps.row());
    for x in (0..count).step_by(LANES) {
        let some = maps.columns(x0 + x);
        for c in 0..3 {
            let gain = splat(s, frame.exposure_gain[c]);
            let mut sums = [[zero; STRIP]; DERIVATIVES];
            for (k, sums) in sums.iter_mut().enumerate() {
                *sums = blur_down(s, blurred, &rows, maps.at(x0 + x, DERIVATIVES * c + k));
            }
            for (o, pixels) in pixels[..size.rows(strip).len()].iter_mut().enumerate() {
                let [shown_row, wanted_row] = &mut pixels[c];
                let shown = F8::from_slice(s, &shown_row[x..x + LANES]);
                let wanted = F8::from_slice(s, &wanted_row[x..x + LANES]);
                let difference = shown - wanted;
                l1.add(difference.abs(), some);
                let sign = difference.simd_gt(zero).select(one, zero) - difference.simd_lt(zero).select(one, zero);
                let similarity = fma(wanted, sums[2][o], fma(two * shown, sums[1][o], sums[0][o]));
                (fma(by_l1, sign, by_ssim * similarity) * gain).store_slice(&mut shown_row[x..x + LANES]);
            }
        }
    }
    for (y, found) in size.rows(strip).zip(&pixels) {
        let at = y * width + x0;
        // SAFETY: pixels of this strip, which no other part has.
        let out = unsafe { gradients.range(at, count) };
        let texels = out.iter_mut().zip(image[at..at + count].iter().zip(&target[at..at + count]));
        for (i, (out, (shown, wanted))) in texels.enumerate() {
            *out = if wanted[0] >> 24 == LEFT_OUT {
                [0.0; 4]
            } else {
                let depth = if has_depth { by_depth(frame, status, *wanted, shown[3]) } else { 0.0 };
                [found[0][0][i], found[1][0][i], found[2][0][i], depth]
            };
        }
    }
}

/// What the depth loss says of a pixel's depth; nothing where the prior is not confident.
fn by_depth(frame: &Frame, status: &Status, wanted: [u32; 2], depth: f32) -> f32 {
    match confident(frame, wanted) {
        Some(prior) => status.depth_by_prior * prior + status.depth_by_rendered * depth + status.depth_constant,
        None => 0.0,
    }
}

/// The prior's depth of a pixel, where it is confident and compared.
fn confident(frame: &Frame, [texel, depth]: [u32; 2]) -> Option<f32> {
    let confidence = (texel >> 24) as f32 * (1.0 / 255.0);
    let counts = confidence > 0.0 && confidence >= frame.min_confidence && texel >> 24 != LEFT_OUT;
    counts.then(|| depth as f32 * (1.0 / 65535.0))
}

/// Count, means and centred second moments of rendered depth and prior over each lane's pixels; first the means, so that no large sums
/// cancel.
pub(super) fn depth_sums(call: &Call<'_>) {
    let (frame, memory, pixels) = (call.frame, &call.memory, call.frame.pixels());
    let (image, target) = (memory.read::<[f32; 4]>("image"), memory.read::<[u32; 2]>("target"));
    // SAFETY: the only section that this kernel writes.
    let sums = Parts::of(unsafe { memory.write::<DepthMoments>("lane_sums") });
    let (lanes, share) = (DEPTH_LANES as usize, pixels.div_ceil(DEPTH_LANES as usize));
    call.pool.each(lanes, |lane| {
        let range = (lane * share).min(pixels)..((lane + 1) * share).min(pixels);
        let usable = || range.clone().filter_map(|i| Some((image[i][3], confident(frame, target[i])?)));
        let mut own = DepthMoments::zeroed();
        for (d, e) in usable() {
            own.count += 1.0;
            own.mean_d += d;
            own.mean_e += e;
        }
        own.mean_d /= own.count.max(1.0);
        own.mean_e /= own.count.max(1.0);
        for (d, e) in usable() {
            let (d, e) = (d - own.mean_d, e - own.mean_e);
            own.square_d += d * d;
            own.square_e += e * e;
            own.product += d * e;
        }
        // SAFETY: a lane's own sum.
        unsafe { sums.range(lane, 1) }.fill(own);
    });
}

/// Merges the lanes' moments in order (Chan et al. 1979) and leaves the correlation and the line on which its gradient lies.
pub(super) fn depth_finish(call: &Call<'_>) {
    let memory = &call.memory;
    // SAFETY: the only section that this kernel writes.
    let status = unsafe { memory.write::<Status>("status") };
    let mut all = DepthMoments::zeroed();
    for own in memory.read::<DepthMoments>("lane_sums").iter().take(DEPTH_LANES as usize).filter(|own| own.count > 0.0)
    {
        let both = all.count + own.count;
        let share = own.count / both;
        let (by_d, by_e) = (own.mean_d - all.mean_d, own.mean_e - all.mean_e);
        all.mean_d += by_d * share;
        all.mean_e += by_e * share;
        let weight = all.count * share;
        all.square_d += own.square_d + by_d * by_d * weight;
        all.square_e += own.square_e + by_e * by_e * weight;
        all.product += own.product + by_d * by_e * weight;
        all.count = both;
    }
    let DepthMoments { count: n, mean_d, mean_e, square_d: dd, square_e: ee, product: de, .. } = all;
    // Written so that what is not a number is not useful.
    let useful = n >= 3.0 && dd > PEARSON_EPSILON * (n * mean_d * mean_d + 1.0e-12) && ee > PEARSON_EPSILON * n;
    let (mut line, mut correlation) = ([0.0; 3], 0.0);
    if useful {
        let both = 1.0 / (dd.sqrt() * ee.sqrt());
        correlation = de * both;
        let weight = call.frame.depth_weight;
        // The loss is one minus the correlation.
        let (by_prior, by_rendered) = (-weight * both, weight * correlation / dd);
        line = [by_prior, by_rendered, -(by_prior * mean_e + by_rendered * mean_d)];
    }
    let status = &mut status[0];
    [status.depth_by_prior, status.depth_by_rendered, status.depth_constant] = line;
    (status.correlation, status.correlates) = (correlation, u32::from(useful));
}

/// The exposure's gradient: by the rendered colour, before gain and offset.
pub(super) fn exposure_sums(call: &Call<'_>) {
    let (size, memory) = (Size::of(call.frame), &call.memory);
    let (image, gradient) = (memory.read::<[f32; 4]>("image"), memory.read::<[f32; 4]>("image_gradient"));
    // SAFETY: the only section that this kernel writes.
    let sums = Parts::of(unsafe { memory.write::<LossSums>("strip_sums") });
    call.pool.each(size.strips(), |strip| {
        let (mut by_gain, mut by_color) = ([0.0; 3], [0.0; 3]);
        let rows = size.rows(strip);
        for i in rows.start * size.width..rows.end * size.width {
            for c in 0..3 {
                by_gain[c] += gradient[i][c] * image[i][c]; // by the logarithm of the gain
                by_color[c] += gradient[i][c];
            }
        }
        // SAFETY: a strip's sums, which no other part has.
        if let Some(own) = unsafe { sums.range(strip * size.width, 1) }.first_mut() {
            own.gain = by_gain;
            own.offset = std::array::from_fn(|c| by_color[c] / call.frame.exposure_gain[c]);
        }
    });
}
