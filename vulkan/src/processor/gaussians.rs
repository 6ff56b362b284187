//! A Gaussian's numbers on the device: geometry, SH and their moments, and what it was last moved in (`shaders/deferred.glsl`,
//! `moments.glsl`, `adam.glsl`).

use super::halves;
use super::lanes::{F8, LANES, load, splat, store};
use super::pool::Parts;
use crate::layout::{Frame, MissedSteps};
use fearless_simd::Simd;
use fearless_simd::prelude::*;

/// Four numbers that lie together.
pub(super) type Vec4 = [f32; 4];

/// Place and opacity, log scales and state, rotation; then their first moments, then their second ones.
pub(super) type Geometry = [Vec4; 9];

/// Bits of the steps that the geometry was last moved in; those of SH lie above them.
const STATE_STEPS: u32 = 0x1FFF;
/// Missed steps beyond which the table of lazy updates has no more.
const MOST_BEHIND: u32 = 511;

/// The state word: steps of the geometry and of SH, the SH degree, and a bit that makes it an ordinary float.
#[derive(Clone, Copy)]
pub(super) struct State(u32);

impl State {
    pub fn of(word: f32) -> Self {
        Self(word.to_bits())
    }

    pub fn new(geometry: u32, sh: u32, degree: u32) -> Self {
        Self((geometry & STATE_STEPS) | (sh & STATE_STEPS) << 13 | degree << 26 | 1 << 29)
    }

    pub fn word(self) -> f32 {
        f32::from_bits(self.0)
    }

    pub fn geometry(self) -> u32 {
        self.0 & STATE_STEPS
    }

    pub fn sh(self) -> u32 {
        self.0 >> 13 & STATE_STEPS
    }

    pub fn degree(self) -> u32 {
        self.0 >> 26 & 3
    }
}

/// Steps from `last` to `now`, as the state word holds them.
pub(super) fn steps_behind(last: u32, now: u32) -> usize {
    (now.wrapping_sub(last) & STATE_STEPS).min(MOST_BEHIND) as usize
}

/// Second moments up to this have no root to divide by.
const LEAST: f32 = 1.0e-37;

/// Lazy updates: k steps with a zero gradient decay the moments, and move the parameters by a sum that depends on k alone.
#[inline(always)]
pub(super) fn catch_up<const N: usize>(
    p: &mut [f32; N],
    m: &mut [f32; N],
    v: &mut [f32; N],
    step_sum: &[f32; N],
    missed: &MissedSteps,
) {
    for i in 0..N {
        let ratio = if v[i] <= LEAST { 0.0 } else { m[i] / v[i].max(LEAST).sqrt() };
        p[i] -= step_sum[i] * ratio;
        m[i] *= missed.first_decay;
        v[i] *= missed.second_decay;
    }
}

/// One step of Adam. Arrays, so that a compiler sees that they do not overlap, and makes vectors of them.
#[inline(always)]
pub(super) fn adam<const N: usize>(
    frame: &Frame,
    p: &mut [f32; N],
    m: &mut [f32; N],
    v: &mut [f32; N],
    g: &[f32; N],
    rate: &[f32; N],
) {
    let (by_first, by_second) = (1.0 - frame.beta1, 1.0 - frame.beta2);
    for i in 0..N {
        m[i] += (g[i] - m[i]) * by_first;
        v[i] += (g[i] * g[i] - v[i]) * by_second;
        p[i] -= rate[i] * (m[i] * frame.first_bias) / ((v[i] * frame.second_bias).sqrt() + frame.epsilon);
    }
}

/// Gradients that Adam can take: what is not finite, or too large to be squared, becomes zero and is told.
#[inline(always)]
pub(super) fn finite(g: Vec4, all_finite: &mut bool) -> Vec4 {
    g.map(|v| {
        // Written so that what is not a number fails.
        let good = v.abs() < 1.0e18;
        *all_finite &= good;
        if good { v } else { 0.0 }
    })
}

/// PCG hash (Jarzynski & Olano 2020).
pub(super) fn pcg(v: u32) -> u32 {
    let s = v.wrapping_mul(747_796_405).wrapping_add(2_891_336_453);
    let w = ((s >> ((s >> 28) + 4)) ^ s).wrapping_mul(277_803_737);
    (w >> 22) ^ w
}

/// Uniform in [0, 1), a function of the seed, the step, a Gaussian and a channel only.
pub(super) fn uniform_hash(frame: &Frame, gaussian: u32, channel: u32) -> f32 {
    let seed = pcg(frame.seed.wrapping_add(channel.wrapping_mul(0x9E37_79B9)));
    let h = pcg(gaussian.wrapping_add(pcg(frame.step.wrapping_add(seed))));
    (h >> 8) as f32 * (1.0 / 16_777_216.0)
}

/// The logistic function.
pub(super) fn sigmoid(x: f32) -> f32 {
    1.0 / (1.0 + (-x).exp())
}

/// Columns (four numbers each) that hold the coefficients up to a degree.
pub(super) fn columns_up_to(degree: u32) -> usize {
    match degree {
        0 => 1,
        1 => 3,
        2 => 7,
        _ => 12,
    }
}

/// Most numbers of SH that a Gaussian has.
pub(super) const MOST: usize = 48;

/// A Gaussian's SH, or what belongs to them number by number: three channels of one basis function after the other.
pub(super) type Numbers = [f32; MOST];

/// SH and their moments, as kernels that move Gaussians write them: each part those of its own Gaussians.
pub(super) struct Harmonics<'a> {
    pub sh: Parts<'a, f32>,
    pub moments: Moments<'a>,
    /// Numbers of a Gaussian, at most [`MOST`].
    pub stride: usize,
}

/// First and second moments of SH.
pub(super) enum Moments<'a> {
    /// As they are.
    Whole(Parts<'a, f32>, Parts<'a, f32>),
    /// In 16 bits: the first, and the root of the second, both times `Frame::moment_scale`.
    Half(Parts<'a, u16>, Parts<'a, u16>),
}

impl Moments<'_> {
    /// `count` moments, at most eight, from number `at` on: zeros beyond.
    ///
    /// # Safety
    /// Nobody else has these moments meanwhile.
    #[inline(always)]
    pub unsafe fn fetch<S: Simd>(&self, s: S, frame: &Frame, at: usize, count: usize) -> [F8<S>; 2] {
        // SAFETY: by contract.
        unsafe {
            match self {
                Self::Whole(first, second) => [load(s, first.range(at, count)), load(s, second.range(at, count))],
                Self::Half(first, second) => {
                    let mut all = [[0.0; LANES]; 2];
                    for (all, halves) in all.iter_mut().zip([first.range(at, count), second.range(at, count)]) {
                        for (wide, half) in all.iter_mut().zip(halves) {
                            *wide = halves::widen(*half);
                        }
                    }
                    let scale = splat(s, frame.moment_scale);
                    let (m, root) = (F8::from_slice(s, &all[0]) / scale, F8::from_slice(s, &all[1]) / scale);
                    [m, root * root]
                }
            }
        }
    }

    /// Keeps `count` moments from number `at` on: four or eight.
    ///
    /// # Safety
    /// As [`Self::fetch`].
    #[inline(always)]
    pub unsafe fn store<S: Simd>(&self, frame: &Frame, at: usize, count: usize, [m, v]: [F8<S>; 2]) {
        // SAFETY: by contract.
        unsafe {
            match self {
                Self::Whole(first, second) => {
                    store(m, first.range(at, count));
                    store(v, second.range(at, count));
                }
                Self::Half(first, second) => {
                    let mut all = [[0.0; LANES]; 2];
                    m.store_slice(&mut all[0]);
                    v.store_slice(&mut all[1]);
                    let [m, v] = &mut all;
                    for column in 0..count / 4 {
                        round(frame, (at / 4 + column) as u32, &mut m[4 * column..][..4], &mut v[4 * column..][..4]);
                    }
                    let (first, second) = (first.range(at, count), second.range(at, count));
                    for i in 0..count {
                        (first[i], second[i]) = (halves::narrow(m[i]), halves::narrow(v[i]));
                    }
                }
            }
        }
    }
}

/// Lazy updates of eight numbers, as [`catch_up`].
pub(super) struct Lazy<S: Simd> {
    first_decay: F8<S>,
    second_decay: F8<S>,
}

impl<S: Simd> Lazy<S> {
    #[inline(always)]
    pub fn of(s: S, missed: &MissedSteps) -> Self {
        Self { first_decay: splat(s, missed.first_decay), second_decay: splat(s, missed.second_decay) }
    }

    /// What numbers and moments become.
    #[inline(always)]
    pub fn catch_up(&self, p: F8<S>, [m, v]: [F8<S>; 2], step_sum: F8<S>) -> (F8<S>, [F8<S>; 2]) {
        let s = p.token();
        let least = splat(s, LEAST);
        let ratio = v.simd_gt(least).select(m / v.max(least).sqrt(), splat(s, 0.0));
        (p - step_sum * ratio, [m * self.first_decay, v * self.second_decay])
    }
}

/// One step of Adam on eight numbers at a time.
pub(super) struct Adam<S: Simd> {
    by_first: F8<S>,
    by_second: F8<S>,
    first_bias: F8<S>,
    second_bias: F8<S>,
    epsilon: F8<S>,
}

impl<S: Simd> Adam<S> {
    #[inline(always)]
    pub fn of(s: S, frame: &Frame) -> Self {
        Self {
            by_first: splat(s, 1.0 - frame.beta1),
            by_second: splat(s, 1.0 - frame.beta2),
            first_bias: splat(s, frame.first_bias),
            second_bias: splat(s, frame.second_bias),
            epsilon: splat(s, frame.epsilon),
        }
    }

    /// What numbers and moments become by a gradient.
    #[inline(always)]
    pub fn step(&self, p: F8<S>, [m, v]: [F8<S>; 2], g: F8<S>, rate: F8<S>) -> (F8<S>, [F8<S>; 2]) {
        let m = m + (g - m) * self.by_first;
        let v = v + (g * g - v) * self.by_second;
        (p - rate * (m * self.first_bias) / ((v * self.second_bias).sqrt() + self.epsilon), [m, v])
    }
}

/// Moments as 16 bits take them, those of column `at` (`reference::adam::half_moments`). The root is rounded by chance: to the nearest, the
/// thousandth by which a step changes a second moment would be lost or doubled.
#[inline(always)]
fn round(frame: &Frame, at: u32, m: &mut [f32], v: &mut [f32]) {
    /// Of f32's mantissa, those that 16 bits have not.
    const DROPPED_BITS: u32 = 0x1FFF;
    const LARGEST: f32 = 65504.0;
    /// Without a second moment a first one would be divided by nothing.
    const LEAST: f32 = 6.0e-8;
    // Columns of one Gaussian have different chances, and so have the steps.
    let a = pcg(at.wrapping_add(pcg(frame.step.wrapping_add(pcg(frame.seed)))));
    let b = pcg(a);
    for ((m, v), chance) in m.iter_mut().zip(v).zip([a, a >> 13, b, b >> 13]) {
        let root = (v.sqrt() * frame.moment_scale).min(LARGEST);
        let root = f32::from_bits(root.to_bits().wrapping_add(chance & DROPPED_BITS) & !DROPPED_BITS).min(LARGEST);
        let held = root >= LEAST;
        *m = if held { (*m * frame.moment_scale).clamp(-LARGEST, LARGEST) } else { 0.0 };
        *v = if held { root } else { 0.0 };
    }
}
