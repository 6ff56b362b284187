//! Stages *sort*, *count* and *emit*: the visible Gaussians in depth order, and in each tile's list (`shaders/sort_*.comp`, `count.comp`,
//! `tile_*.comp`, `emit.comp`, `spans.glsl`; reference: `crate::reference::emit`).
//!
//! The work is cut into as many shares as the plan has sorting lanes, whatever the number of threads: each has a histogram of its own.

use super::Call;
use super::lanes::{F8, LANES, ramp, splat};
use super::pool::Parts;
use super::project::{Projected, UNSEEN};
use crate::constants::{TILE_HEIGHT, TILE_WIDTH};
use crate::layout::{FLAG_WHOLE_BOXES, Frame, Status};
use fearless_simd::prelude::*;
use fearless_simd::{Simd, dispatch, i32x8};

/// Values of a digit.
const DIGITS: usize = 256;

/// The range of share `lane` of `n` among `lanes`.
#[inline(always)]
fn share_of(lane: usize, n: usize, lanes: usize) -> std::ops::Range<usize> {
    let share = n.div_ceil(lanes);
    (lane * share).min(n)..((lane + 1) * share).min(n)
}

/// Keys that a pass of the sort reads.
fn sorted_by(call: &Call<'_>) -> usize {
    let n = if call.push.pass == 0 { call.frame.gaussians } else { call.memory.read::<Status>("status")[0].visible };
    n as usize
}

fn digit_of(key: u32, pass: u32) -> usize {
    (key >> (8 * pass) & 0xFF) as usize
}

/// One pass of the depth sort, first half: each share counts its digits. Pass 0 also leaves out what is not visible.
pub(super) fn sort_count(call: &Call<'_>, keys: &str) {
    let (memory, n, lanes) = (&call.memory, sorted_by(call), call.sort_lanes());
    let keys = memory.read::<u32>(keys);
    // SAFETY: the only section that this kernel writes.
    let digits = Parts::of(unsafe { memory.write::<u32>("digits") });
    call.pool.each(lanes, |lane| {
        // SAFETY: a share's own histogram.
        let own = unsafe { digits.range(lane * DIGITS, DIGITS) };
        own.fill(0);
        for key in keys[share_of(lane, n, lanes)].iter().filter(|key| **key != UNSEEN) {
            own[digit_of(*key, call.push.pass)] += 1;
        }
    });
}

/// The depth sort, middle: where each share's first key of each digit goes.
pub(super) fn sort_scan(call: &Call<'_>) {
    // SAFETY: the two sections that this kernel writes, once each.
    let (digits, status) = unsafe { (call.memory.write::<u32>("digits"), call.memory.write::<Status>("status")) };
    let mut next = 0;
    for digit in 0..DIGITS {
        for lane in 0..call.sort_lanes() {
            let count = &mut digits[lane * DIGITS + digit];
            next += std::mem::replace(count, next);
        }
    }
    if call.push.pass == 0 {
        status[0].visible = next;
    }
}

/// One pass of the depth sort, second half: each share moves its keys and rows, in order. Names of the sections: keys and rows in, out.
pub(super) fn sort_scatter(call: &Call<'_>, [keys, rows]: [&str; 2], [keys_out, rows_out]: [&str; 2]) {
    let (memory, n, lanes) = (&call.memory, sorted_by(call), call.sort_lanes());
    let (keys, rows) = (memory.read::<u32>(keys), memory.read::<u32>(rows));
    // SAFETY: the three sections that this kernel writes, once each.
    let (keys_out, rows_out, digits) = unsafe {
        (
            Parts::of(memory.write::<u32>(keys_out)),
            Parts::of(memory.write::<u32>(rows_out)),
            Parts::of(memory.write::<u32>("digits")),
        )
    };
    call.pool.each(lanes, |lane| {
        // SAFETY: a share's own histogram.
        let next = unsafe { digits.range(lane * DIGITS, DIGITS) };
        for i in share_of(lane, n, lanes).filter(|i| keys[*i] != UNSEEN) {
            let to = &mut next[digit_of(keys[i], call.push.pass)];
            let row = if call.push.pass == 0 { i as u32 } else { rows[i] };
            // SAFETY: the scan gave every key a place of its own.
            unsafe {
                keys_out.range(*to as usize, 1).fill(keys[i]);
                rows_out.range(*to as usize, 1).fill(row);
            }
            *to += 1;
        }
    });
}

/// Which tiles a Gaussian touches: the one test that counting and emitting share. The ellipse is convex, so in each row of tiles the
/// touched ones are consecutive.
struct Spans {
    center: [f32; 2],
    slope: f32,
    width: f32,
    half_height: f32,
    tip: f32,
    /// Rows of tiles, counted from the window's top.
    rows: std::ops::RangeInclusive<i32>,
}

impl Spans {
    #[inline(always)]
    fn of(frame: &Frame, [center, _, edge]: &Projected) -> Self {
        let [slope, width, half_height, tip] = *edge;
        let (top, high) = (frame.region_origin[1] as f32 + 0.5, TILE_HEIGHT as f32);
        let first = ((center[1] - half_height - top - (high - 1.0)) / high).floor() + 1.0;
        let last = ((center[1] + half_height - top) / high).floor();
        let rows = first.max(0.0) as i32..=(last as i32).min(frame.window[1] as i32 - 1);
        Self { center: [center[0], center[1]], slope, width, half_height, tip, rows }
    }

    /// Calls `touched` with every row that has touched tiles, and their first and last as columns of the window, cut to the band.
    #[inline(always)]
    fn each_row<S: Simd>(&self, s: S, frame: &Frame, band: [u32; 2], mut touched: impl FnMut(usize, [usize; 2])) {
        let (first, last) = (*self.rows.start(), *self.rows.end());
        for row in (first..=last).step_by(LANES) {
            let [from, to] = self.in_rows(s, frame, row, band);
            for (i, (from, to)) in from.into_iter().zip(to).enumerate().take((last - row + 1) as usize) {
                if from <= to {
                    touched(row as usize + i, [from as usize, to as usize]);
                }
            }
        }
    }

    /// First and last touched tile of eight rows; none when the first is beyond the last, or where something is no number.
    #[inline(always)]
    fn in_rows<S: Simd>(&self, s: S, frame: &Frame, row: i32, band: [u32; 2]) -> [[i32; LANES]; 2] {
        let (zero, half) = (splat(s, 0.0), splat(s, self.half_height));
        let (wide, high) = (splat(s, 1.0 / TILE_WIDTH as f32), TILE_HEIGHT as f32);
        let across = splat(s, frame.window[0] as f32);
        let rows = ramp(s) + splat(s, row as f32);
        let inside = |v: F8<S>| -> F8<S> { v.simd_gt(-half).select(v, -half).min(half) };
        let y0 = rows * splat(s, high) + splat(s, frame.region_origin[1] as f32 + 0.5) - splat(s, self.center[1]);
        let (y0, y1) = (inside(y0), inside(y0 + splat(s, high - 1.0)));
        let whole = frame.has(FLAG_WHOLE_BOXES);
        let at = |tip: f32| if whole { splat(s, tip) } else { splat(s, tip).max(y0).min(y1) };
        let (right, left) = (at(self.tip), at(-self.tip));
        let reach = |dy: F8<S>| -> F8<S> {
            let rest = half * half - dy * dy;
            rest.simd_gt(zero).select(rest, zero).sqrt() * splat(s, self.width) + splat(s, 0.01)
        };
        let slope = splat(s, self.slope);
        let (right, left) = (slope * right + reach(right), slope * left - reach(left));
        let x = splat(s, self.center[0] - frame.region_origin[0] as f32 - 0.5);
        let from = ((x + left - splat(s, TILE_WIDTH as f32 - 1.0)) * wide).floor() + splat(s, 1.0);
        let to = ((x + right) * wide).floor();
        let from = from.simd_gt(zero).select(from, zero);
        let from = from.simd_lt(across).select(from, across);
        let to = to.simd_ge(zero).select(to, splat(s, -1.0));
        let to = to.simd_lt(across).select(to, across - splat(s, 1.0));
        // Columns of the window that the band begins and ends with in each row.
        let (from, to, rows): (i32x8<S>, i32x8<S>, i32x8<S>) = (from.to_int(), to.to_int(), rows.to_int());
        let starts = rows * frame.window[0] as i32;
        let (begin, end) = (i32x8::splat(s, band[0] as i32) - starts, i32x8::splat(s, band[1] as i32 - 1) - starts);
        let mut all = [[0; LANES]; 2];
        from.max(begin).store_slice(&mut all[0]);
        to.min(end).store_slice(&mut all[1]);
        all
    }
}

/// Gaussians that are fetched at once: where each lies is left to chance, so that one alone would be waited for.
const FETCHED: usize = 16;

/// Calls `work` with some Gaussians in depth order and each one's place in it.
#[inline(always)]
fn each_in_order(
    (projected, order): (&[Projected], &[u32]),
    those: std::ops::Range<usize>,
    mut work: impl FnMut(usize, &Projected),
) {
    let mut fetched = [[[0.0; 4]; 3]; FETCHED];
    for first in those.clone().step_by(FETCHED) {
        let order = &order[first..(first + FETCHED).min(those.end)];
        for (to, g) in fetched.iter_mut().zip(order) {
            *to = projected[*g as usize];
        }
        for (i, projected) in fetched[..order.len()].iter().enumerate() {
            work(first + i, projected);
        }
    }
}

/// Counts instances per tile, each share in a histogram of its own. Mode 1 counts only the total inside a band. One round is enough.
pub(super) fn count(call: &Call<'_>) {
    if call.push.pass > 0 {
        return;
    }
    let (frame, memory, lanes) = (call.frame, &call.memory, call.sort_lanes());
    let (projected, order) = (memory.read::<Projected>("projected"), memory.read::<u32>("order"));
    // SAFETY: the two sections that this kernel writes, once each.
    let (tiles, status) =
        unsafe { (Parts::of(memory.write::<u32>("tiles")), &mut memory.write::<Status>("status")[0]) };
    let (visible, tile_count, band) =
        (status.visible as usize, frame.tiles() as usize, [call.push.first, call.push.last]);
    let totals = Parts::of(&mut status.lane_instances);
    call.pool.each(lanes, |lane| {
        // SAFETY: a share's own histogram and total.
        let (own, total) = unsafe { (tiles.range(lane * tile_count, tile_count), &mut totals.range(lane, 1)[0]) };
        *total = 0;
        dispatch!(call.level, s => {
            each_in_order((projected, order), share_of(lane, visible, lanes), |_, projected| {
                Spans::of(frame, projected).each_row(s, frame, band, |row, [first, last]| {
                    *total = total.wrapping_add((last - first + 1) as u32);
                    if call.push.mode == 0 {
                        let line = row * frame.window[0] as usize;
                        for n in &mut own[line + first..=line + last] {
                            *n += 1;
                        }
                    }
                });
            });
        });
    });
    status.lane_counted.fill(1);
}

/// Per tile: where each share's instances begin, and how many there are in all.
pub(super) fn tile_prefix(call: &Call<'_>) {
    /// Tiles of a part.
    const AT_ONCE: usize = 256;
    let (memory, tile_count) = (&call.memory, call.frame.tiles() as usize);
    // SAFETY: the two sections that this kernel writes, once each.
    let (tiles, starts) =
        unsafe { (Parts::of(memory.write::<u32>("tiles")), Parts::of(memory.write::<u32>("tile_starts"))) };
    call.pool.each(tile_count.div_ceil(AT_ONCE), |part| {
        let (first, count) = (part * AT_ONCE, AT_ONCE.min(tile_count - part * AT_ONCE));
        let mut sums = [0; AT_ONCE];
        for lane in 0..call.sort_lanes() {
            // SAFETY: tiles of this part, of one share after the other.
            let counts = unsafe { tiles.range(lane * tile_count + first, count) };
            for (count, sum) in counts.iter_mut().zip(&mut sums) {
                *sum += std::mem::replace(count, *sum);
            }
        }
        // SAFETY: tiles of this part.
        unsafe { starts.range(first, count) }.copy_from_slice(&sums[..count]);
    });
}

/// First instance of every tile, modulo 2³² (a band's instances are a difference of two starts and fit). The total saturates, so that more
/// than 2³² instances are not taken for few.
pub(super) fn tile_scan(call: &Call<'_>) {
    let tile_count = call.frame.tiles() as usize;
    // SAFETY: the two sections that this kernel writes, once each.
    let (starts, status) =
        unsafe { (call.memory.write::<u32>("tile_starts"), &mut call.memory.write::<Status>("status")[0]) };
    let (mut next, mut all) = (0u32, 0u32);
    for start in &mut starts[..tile_count] {
        all = all.saturating_add(*start);
        next = next.wrapping_add(std::mem::replace(start, next));
    }
    starts[tile_count] = next;
    status.instances = all;
}

/// Writes every (Gaussian, tile) instance of the band to its place in the tile's list, in depth order, and gives it a gradient slot; a
/// Gaussian's slots are consecutive and in tile order. One round is enough.
pub(super) fn emit(call: &Call<'_>) {
    if call.push.pass > 0 {
        return;
    }
    let (frame, memory, lanes) = (call.frame, &call.memory, call.sort_lanes());
    let (projected, order) = (memory.read::<Projected>("projected"), memory.read::<u32>("order"));
    let (starts, status) = (memory.read::<u32>("tile_starts"), &memory.read::<Status>("status")[0]);
    // SAFETY: the three sections that this kernel writes, once each.
    let (tiles, instances, ranges) = unsafe {
        (
            Parts::of(memory.write::<u32>("tiles")),
            Parts::of(memory.write::<[u32; 2]>("instances")),
            Parts::of(memory.write::<[u32; 2]>("slot_ranges")),
        )
    };
    let (visible, tile_count, band) =
        (status.visible as usize, frame.tiles() as usize, [call.push.first, call.push.last]);
    let origin = starts[call.push.first as usize];
    call.pool.each(lanes, |lane| {
        // SAFETY: a share's own histogram.
        let ranks = unsafe { tiles.range(lane * tile_count, tile_count) };
        let mut slot = status.lane_instances[..lane].iter().fold(0u32, |sum, n| sum.wrapping_add(*n));
        dispatch!(call.level, s => {
            each_in_order((projected, order), share_of(lane, visible, lanes), |r, projected| {
                let begin = slot;
                Spans::of(frame, projected).each_row(s, frame, band, |row, [first, last]| {
                    let line = row * frame.window[0] as usize;
                    let tiles = line + first..=line + last;
                    for (start, rank) in starts[tiles.clone()].iter().zip(&mut ranks[tiles]) {
                        let at = start.wrapping_sub(origin).wrapping_add(*rank);
                        *rank += 1;
                        // SAFETY: the scan gave every instance a place of its own.
                        unsafe { instances.range(at as usize, 1) }.fill([r as u32, slot]);
                        slot = slot.wrapping_add(1);
                    }
                });
                // SAFETY: a Gaussian of this share.
                unsafe { ranges.range(r, 1) }.fill([begin, slot.wrapping_sub(begin)]);
            });
        });
    });
}
