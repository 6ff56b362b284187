//! Stage *loss*: L1, SSIM and Pearson depth, and their gradient at every pixel (`shaders/ssim_*.comp`, `loss_gradient.comp`,
//! `depth_*.comp`, `exposure_sums.comp`; reference: `crate::reference::loss`).
//!
//! SSIM's window is separable: along rows, along columns, and for the gradient once more along both. What lies between the four passes are
//! planes of the picture's size, three channels of four or three maps, in the sections of the plan. Strips of [`STRIP`] rows are the parts
//! that threads take; sums are of a strip, so that they do not depend on the number of threads.

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

    fn pixels(self) -> usize {
        self.width * self.height
    }

    fn strips(self) -> usize {
        self.height.div_ceil(STRIP)
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

/// Part of a row blurred along itself: `values` begins [`LANES`] before it, and is zero outside the picture.
#[inline(always)]
fn blur_block<S: Simd>(s: S, values: &[f32; BLOCK_REACH], out: &mut [f32]) {
    const FIRST: usize = LANES - SSIM_RADIUS;
    for (x, out) in (0..BLOCK).step_by(LANES).zip(out.chunks_mut(LANES)) {
        let mut v = [splat(s, 0.0); TAPS];
        for (j, v) in v.iter_mut().enumerate() {
            *v = F8::from_slice(s, &values[x + FIRST + j..x + FIRST + j + LANES]);
        }
        store(weighted(s, &v), out);
    }
}

/// First pass: along rows, the window's means of what SSIM needs.
pub(super) fn ssim_rows(call: &Call<'_>) {
    let (size, memory) = (Size::of(call.frame), &call.memory);
    let (image, target) = (memory.read::<[f32; 4]>("image"), memory.read::<[u32; 2]>("target"));
    // SAFETY: the only section that this kernel writes.
    let planes = Parts::of(unsafe { memory.write::<f32>("moments") });
    call.pool.each(size.strips(), |strip| {
        dispatch!(call.level, s => rows_of_strip(s, call.frame, (image, target), &planes, size, strip));
    });
}

#[inline(always)]
fn rows_of_strip<S: Simd>(
    s: S,
    frame: &Frame,
    (image, target): (&[[f32; 4]], &[[u32; 2]]),
    planes: &Parts<'_, f32>,
    size: Size,
    strip: usize,
) {
    let Size { width, .. } = size;
    for y in size.rows(strip) {
        let (image, target) = (&image[y * width..(y + 1) * width], &target[y * width..(y + 1) * width]);
        for x0 in (0..width).step_by(BLOCK) {
            // Zero outside the picture: x and y of each channel, then the four maps of one.
            let mut shown = [[[0.0; BLOCK_REACH]; 2]; 3];
            let (first, last) = (x0.saturating_sub(LANES), (x0 + BLOCK + LANES).min(width));
            let places = first + LANES - x0..last + LANES - x0;
            for (at, (rendered, wanted)) in places.zip(image[first..last].iter().zip(&target[first..last])) {
                for c in 0..3 {
                    (shown[c][0][at], shown[c][1][at]) = compared_in(frame, c, rendered[c], wanted[0]);
                }
            }
            let count = BLOCK.min(width - x0);
            for (c, [a, b]) in shown.iter().enumerate() {
                let (mut squares, mut products) = ([0.0; BLOCK_REACH], [0.0; BLOCK_REACH]);
                for x in (0..BLOCK_REACH).step_by(LANES) {
                    let (a, b) = (F8::from_slice(s, &a[x..x + LANES]), F8::from_slice(s, &b[x..x + LANES]));
                    fma(a, a, b * b).store_slice(&mut squares[x..x + LANES]);
                    (a * b).store_slice(&mut products[x..x + LANES]);
                }
                for (k, values) in [a, b, &squares, &products].into_iter().enumerate() {
                    let plane = MOMENTS * c + k;
                    // SAFETY: rows of this strip, which no other part has.
                    blur_block(s, values, unsafe { planes.range(plane * size.pixels() + y * width + x0, count) });
                }
            }
        }
    }
}

/// Eight columns of a plane blurred down a strip.
#[inline(always)]
fn blur_down<S: Simd>(s: S, plane: &[f32], size: Size, strip: usize, x: usize) -> [F8<S>; STRIP] {
    // Zero outside the picture.
    let mut v = [splat(s, 0.0); REACH];
    let count = LANES.min(size.width - x);
    for (j, v) in v.iter_mut().enumerate() {
        if let Some(y) = (strip * STRIP + j).checked_sub(SSIM_RADIUS).filter(|y| *y < size.height) {
            let at = y * size.width + x;
            *v = load(s, &plane[at..at + count]);
        }
    }
    let mut sums = [splat(s, 0.0); STRIP];
    for (o, sum) in sums.iter_mut().enumerate() {
        if let Some(v) = v[o..].first_chunk() {
            *sum = weighted(s, v);
        }
    }
    sums
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

/// Second pass: along columns, then SSIM and its derivatives.
pub(super) fn ssim_columns(call: &Call<'_>) {
    let (size, memory) = (Size::of(call.frame), &call.memory);
    let moments = memory.read::<f32>("moments");
    // SAFETY: the two sections that this kernel writes, once each.
    let (planes, sums) =
        unsafe { (Parts::of(memory.write::<f32>("adjoint")), Parts::of(memory.write::<LossSums>("strip_sums"))) };
    call.pool.each(size.strips(), |strip| {
        let total = dispatch!(call.level, s => columns_of_strip(s, moments, &planes, size, strip));
        // SAFETY: a strip's sums, which no other part has. The first is the strip's, the host adds them all.
        let own = unsafe { sums.range(strip * size.width, size.width) };
        own.fill(LossSums::zeroed());
        own[0].ssim = total;
    });
}

#[inline(always)]
fn columns_of_strip<S: Simd>(s: S, moments: &[f32], planes: &Parts<'_, f32>, size: Size, strip: usize) -> f32 {
    let (Size { width, .. }, pixels) = (size, size.pixels());
    let mut total = Total::new(s);
    for c in 0..3 {
        for x in (0..width).step_by(LANES) {
            let count = LANES.min(width - x);
            let mut blurred = [[splat(s, 0.0); STRIP]; MOMENTS];
            for (k, blurred) in blurred.iter_mut().enumerate() {
                *blurred = blur_down(s, &moments[(MOMENTS * c + k) * pixels..], size, strip, x);
            }
            for (o, y) in size.rows(strip).enumerate() {
                let (value, by) = ssim_of(s, [blurred[0][o], blurred[1][o], blurred[2][o], blurred[3][o]]);
                total.add(value, count);
                for k in 0..DERIVATIVES {
                    // SAFETY: rows of this strip, which no other part has.
                    store(by[k], unsafe { planes.range((DERIVATIVES * c + k) * pixels + y * width + x, count) });
                }
            }
        }
    }
    total.sum()
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

/// Third pass: the window over the derivatives, along rows.
pub(super) fn ssim_back_rows(call: &Call<'_>) {
    let (size, memory) = (Size::of(call.frame), &call.memory);
    let adjoint = memory.read::<f32>("adjoint");
    // SAFETY: the only section that this kernel writes.
    let planes = Parts::of(unsafe { memory.write::<f32>("moments") });
    call.pool.each(size.strips(), |strip| {
        dispatch!(call.level, s => back_rows_of_strip(s, adjoint, &planes, size, strip));
    });
}

#[inline(always)]
fn back_rows_of_strip<S: Simd>(s: S, adjoint: &[f32], planes: &Parts<'_, f32>, size: Size, strip: usize) {
    let Size { width, .. } = size;
    for plane in 0..3 * DERIVATIVES {
        for y in size.rows(strip) {
            let row = plane * size.pixels() + y * width;
            for x0 in (0..width).step_by(BLOCK) {
                let mut values = [0.0; BLOCK_REACH];
                let (first, last) = (x0.saturating_sub(LANES), (x0 + BLOCK + LANES).min(width));
                values[first + LANES - x0..last + LANES - x0].copy_from_slice(&adjoint[row + first..row + last]);
                // SAFETY: rows of this strip, which no other part has.
                blur_block(s, &values, unsafe { planes.range(row + x0, BLOCK.min(width - x0)) });
            }
        }
    }
}

/// Fourth pass: along columns, with what L1 and the depth add.
pub(super) fn loss_gradient(call: &Call<'_>) {
    let (size, memory) = (Size::of(call.frame), &call.memory);
    let (image, target) = (memory.read::<[f32; 4]>("image"), memory.read::<[u32; 2]>("target"));
    let (blurred, status) = (memory.read::<f32>("moments"), &memory.read::<Status>("status")[0]);
    // SAFETY: the two sections that this kernel writes, once each.
    let (gradients, sums) = unsafe {
        (Parts::of(memory.write::<[f32; 4]>("image_gradient")), Parts::of(memory.write::<LossSums>("strip_sums")))
    };
    call.pool.each(size.strips(), |strip| {
        let pictures = (image, target, blurred);
        let l1 =
            dispatch!(call.level, s => gradient_of_strip(s, call.frame, status, pictures, &gradients, size, strip));
        // SAFETY: a strip's sums, which no other part has.
        if let Some(own) = unsafe { sums.range(strip * size.width, 1) }.first_mut() {
            own.l1 = l1;
        }
    });
}

#[inline(always)]
fn gradient_of_strip<S: Simd>(
    s: S,
    frame: &Frame,
    status: &Status,
    (image, target, blurred): (&[[f32; 4]], &[[u32; 2]], &[f32]),
    gradients: &Parts<'_, [f32; 4]>,
    size: Size,
    strip: usize,
) -> f32 {
    let (width, has_depth) = (size.width, frame.has(FLAG_DEPTH));
    let mut l1 = Total::new(s);
    for x0 in (0..width).step_by(BLOCK) {
        let count = BLOCK.min(width - x0);
        let mut found = [[[0.0; BLOCK]; STRIP]; 3];
        for (c, found) in found.iter_mut().enumerate() {
            gradient_of_block(s, frame, c, (image, target, blurred), (size, strip, x0), found, &mut l1);
        }
        for (o, y) in size.rows(strip).enumerate() {
            let at = y * width + x0;
            // SAFETY: pixels of this strip, which no other part has.
            let out = unsafe { gradients.range(at, count) };
            let pixels = out.iter_mut().zip(image[at..at + count].iter().zip(&target[at..at + count]));
            for (i, (out, (shown, wanted))) in pixels.enumerate() {
                *out = if wanted[0] >> 24 == LEFT_OUT {
                    [0.0; 4]
                } else {
                    let depth = if has_depth { by_depth(frame, status, *wanted, shown[3]) } else { 0.0 };
                    [found[0][o][i], found[1][o][i], found[2][o][i], depth]
                };
            }
        }
    }
    l1.sum()
}

/// The gradient of one channel in a block of a strip's pixels, row by row.
#[inline(always)]
fn gradient_of_block<S: Simd>(
    s: S,
    frame: &Frame,
    c: usize,
    (image, target, blurred): (&[[f32; 4]], &[[u32; 2]], &[f32]),
    (size, strip, x0): (Size, usize, usize),
    found: &mut [[f32; BLOCK]; STRIP],
    l1: &mut Total<S>,
) {
    let (zero, one, two) = (splat(s, 0.0), splat(s, 1.0), splat(s, 2.0));
    let (by_l1, by_ssim, gain) =
        (splat(s, frame.l1_weight), splat(s, -frame.ssim_weight), splat(s, frame.exposure_gain[c]));
    for x in (x0..(x0 + BLOCK).min(size.width)).step_by(LANES) {
        let count = LANES.min(size.width - x);
        let mut sums = [[zero; STRIP]; DERIVATIVES];
        for (k, sums) in sums.iter_mut().enumerate() {
            *sums = blur_down(s, &blurred[(DERIVATIVES * c + k) * size.pixels()..], size, strip, x);
        }
        for (o, y) in size.rows(strip).enumerate() {
            let at = y * size.width + x;
            let (mut shown, mut wanted) = ([0.0; LANES], [0.0; LANES]);
            let pixels = shown.iter_mut().zip(&mut wanted);
            for ((shown, wanted), (rendered, texel)) in pixels.zip(image[at..at + count].iter().zip(&target[at..])) {
                (*shown, *wanted) = compared_in(frame, c, rendered[c], texel[0]);
            }
            let (shown, wanted) = (F8::from_slice(s, &shown), F8::from_slice(s, &wanted));
            let difference = shown - wanted;
            l1.add(difference.abs(), count);
            let sign = difference.simd_gt(zero).select(one, zero) - difference.simd_lt(zero).select(one, zero);
            let similarity = fma(wanted, sums[2][o], fma(two * shown, sums[1][o], sums[0][o]));
            let g = fma(by_l1, sign, by_ssim * similarity);
            (g * gain).store_slice(&mut found[o][x - x0..x - x0 + LANES]);
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
    let (frame, memory, pixels) = (call.frame, &call.memory, Size::of(call.frame).pixels());
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
