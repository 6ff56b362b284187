//! Adam's moments of the SH coefficients as the host sees them: in 32 bits, or in the 16 of `shaders/moments.glsl`.

use half::f16;

use crate::arena::Arena;
use crate::layout::Section;

/// A second moment that holds a number where it is: its root is 1e15, gradients are below 1, and it decays by less than half of its
/// digits in 30,000 steps. Small enough that bias correction at the first step does not overflow.
pub(crate) const HEAVY: f32 = 1e30;

/// Where one of the two lies, and in how many bits.
#[derive(Clone, Copy)]
pub(crate) struct ShMoments {
    pub section: Section,
    /// vec4 per Gaussian.
    columns: usize,
    half: bool,
}

impl ShMoments {
    pub fn new(section: Section, columns: usize, half: bool) -> Self {
        Self { section, columns, half }
    }

    pub fn bytes_each(&self) -> usize {
        self.columns * if self.half { 8 } else { 16 }
    }

    pub fn forget(&self, arena: &mut Arena, index: usize) {
        let bytes = self.bytes_each();
        arena.slice_mut::<u8>(self.section)[index * bytes..(index + 1) * bytes].fill(0);
    }

    /// Makes a second moment of Gaussian `index` so large that no gradient moves it.
    pub fn fill(&self, arena: &mut Arena, index: usize) {
        let (at, columns) = (index * self.columns * 4, self.columns * 4);
        match self.half {
            true => arena.slice_mut::<u16>(self.section)[at..at + columns].fill(f16::MAX.to_bits()),
            false => arena.slice_mut::<f32>(self.section)[at..at + columns].fill(HEAVY),
        }
    }

    pub fn copy(&self, arena: &mut Arena, from: usize, to: usize) {
        let bytes = self.bytes_each();
        arena.slice_mut::<u8>(self.section).copy_within(from * bytes..(from + 1) * bytes, to * bytes);
    }

    /// Number `k` of Gaussian `index` as it is stored: in 16 bits scaled, the second moment as its root.
    fn stored(&self, arena: &Arena, index: usize, k: usize) -> f32 {
        let at = index * self.columns * 4 + k;
        match self.half {
            true => f16::from_bits(arena.slice::<u16>(self.section)[at]).to_f32(),
            false => arena.slice::<f32>(self.section)[at],
        }
    }

    /// Gives coefficients `range` of Gaussian `index` the three numbers of its coefficient 0.
    pub fn repeat_first_coefficient(&self, arena: &mut Arena, index: usize, range: std::ops::Range<usize>) {
        let bytes = if self.half { 2 } else { 4 };
        let (first, three) = (index * self.bytes_each(), 3 * bytes);
        let all = arena.slice_mut::<u8>(self.section);
        for i in range {
            all.copy_within(first..first + three, first + i * three);
        }
    }

    /// Number `k` of Gaussian `index`, of first moments; `scale` is the frame's.
    pub fn first(&self, arena: &Arena, index: usize, k: usize, scale: f32) -> f32 {
        self.stored(arena, index, k) / if self.half { scale } else { 1.0 }
    }

    /// Number `k` of Gaussian `index`, of second moments.
    pub fn second(&self, arena: &Arena, index: usize, k: usize, scale: f32) -> f32 {
        let stored = self.stored(arena, index, k);
        if self.half { (stored / scale).powi(2) } else { stored }
    }
}
