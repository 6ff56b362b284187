//! What the processor itself can do: bytes copied and multiply-adds by its threads and vectors.

use super::lanes::{F8, LANES, fma, splat};
use super::pool::{Parts, Pool};
use crate::gpu::Gpu;
use fearless_simd::prelude::*;
use fearless_simd::{Level, Simd, dispatch};
use std::hint::black_box;

/// Bytes that a thread copies at once: a page's worth of pages.
const AT_ONCE: usize = 256 << 10;
/// Chains of multiply-adds that go on beside each other: more than a core has in flight.
const CHAINS: usize = 12;
/// Turns of a part.
const TURNS: usize = 4096;

/// Two buffers and the threads that copy one into the other.
pub(crate) struct Rates {
    pool: Pool,
    level: Level,
    source: Vec<f32>,
    into: Vec<f32>,
}

impl Rates {
    /// Buffers of `bytes` each.
    pub fn new(gpu: &Gpu, bytes: usize) -> Self {
        let (threads, level) = gpu.powers();
        let numbers = bytes / size_of::<f32>();
        Self { pool: Pool::new(threads), level, source: vec![1.0; numbers], into: vec![0.0; numbers] }
    }

    /// Copies one buffer into the other, by the library's function or vector by vector.
    pub fn copy(&mut self, by_library: bool) {
        const NUMBERS: usize = AT_ONCE / size_of::<f32>();
        let (source, into) = (&self.source, Parts::of(&mut self.into));
        self.pool.each(source.len().div_ceil(NUMBERS), |part| {
            // SAFETY: a part of the buffer for each.
            let to = unsafe { into.range(part * NUMBERS, NUMBERS) };
            let from = &source[part * NUMBERS..part * NUMBERS + to.len()];
            if by_library {
                to.copy_from_slice(from);
            } else {
                dispatch!(self.level, s => {
                    for (to, from) in to.chunks_exact_mut(LANES).zip(from.chunks_exact(LANES)) {
                        F8::from_slice(s, from).store_slice(to);
                    }
                });
            }
        });
        black_box(&self.into);
    }

    /// Computes at least so many operations, a multiply-add counted as two.
    pub fn multiply_add(&mut self, operations: u64) {
        let each = (2 * LANES * CHAINS * TURNS) as u64;
        let level = self.level;
        self.pool.each(operations.div_ceil(each) as usize, |part| {
            black_box(dispatch!(level, s => chains(s, part as f32)));
        });
    }
}

#[inline(always)]
fn chains<S: Simd>(s: S, start: f32) -> f32 {
    let (factor, summand) = (splat(s, black_box(0.999)), splat(s, black_box(0.001)));
    let mut all = [splat(s, start); CHAINS];
    for _ in 0..TURNS {
        for v in &mut all {
            *v = fma(*v, factor, summand);
        }
    }
    let mut sum = all[0];
    for v in &all[1..] {
        sum += *v;
    }
    super::lanes::sum(sum)
}
