//! Millions of pixel-aligned samples into at most N Gaussians: samples fall into fine voxels kept in Morton order
//! (fixed room, deterministic), whose moments add up the octree; the cut through the tree that fits N keeps small
//! cells where colour varies and large ones where it does not.
//!
//! A cell's Gaussian has the samples' own spread and normal, so a flat lawn becomes a few flat discs.

use glam::{Mat3, Vec3};
use rayon::prelude::*;

use crate::morton::{BITS, morton, unmorton};

mod cell;
mod tree;

pub use cell::Cell;

/// One pixel-aligned proposal.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Sample {
    /// World position, metres.
    pub position: Vec3,
    /// Linear 0…1 as in the picture.
    pub color: Vec3,
    /// Own covariance, m²: what the sample must cover by itself.
    pub covariance: Mat3,
    /// Confidence, above 0.
    pub weight: f32,
    /// 0…1.
    pub opacity: f32,
}

/// A Gaussian before it is written as log scale, quaternion and logit.
#[derive(Clone, Copy, Debug)]
pub struct Merged {
    /// World position, metres.
    pub position: Vec3,
    /// Linear 0…1.
    pub color: Vec3,
    /// m².
    pub covariance: Mat3,
    /// 0…1.
    pub opacity: f32,
}

/// Octree levels above the finest; eight finest edges are the coarsest.
const LEVELS: usize = 4;
/// Samples collected before they are sorted into the cells, where memory is no matter.
pub const BUFFER: usize = 1 << 19;

/// The merging voxels; memory never exceeds [`VoxelMerge::planned_bytes`].
#[derive(Debug)]
pub struct VoxelMerge {
    edge: f32,
    origin: Vec3,
    cells: Vec<Cell>,
    spare: Vec<Cell>,
    buffer: Vec<(u64, Sample)>,
    capacity: usize,
    /// Samples collected before they are sorted into the cells.
    collected: usize,
    outside: usize,
    coarsened: u32,
}

impl VoxelMerge {
    /// Voxels of `edge` metres around `center`, at most `capacity` of them: when more are needed the edge doubles. Samples are sorted
    /// into them `collected` at a time.
    pub fn new(edge: f32, center: Vec3, capacity: usize, collected: usize) -> Self {
        let half = edge * (1u32 << (BITS - 1)) as f32;
        Self {
            edge,
            origin: center - Vec3::splat(half),
            cells: Vec::new(),
            spare: Vec::new(),
            buffer: Vec::with_capacity(collected),
            capacity: capacity.max(1),
            collected,
            outside: 0,
            coarsened: 0,
        }
    }

    /// Host bytes for a capacity: two cell arrays (merging writes into the second; the coarser levels of the tree later
    /// take its place), the sample buffer, and `budget` Gaussians at the end.
    pub fn planned_bytes(capacity: usize, collected: usize, budget: usize) -> u64 {
        let cells = 2 * (capacity + collected) as u64 * size_of::<Cell>() as u64;
        cells
            + collected as u64 * (size_of::<(u64, Sample)>() + size_of::<(u64, u32)>()) as u64
            + (budget * size_of::<Merged>()) as u64
    }

    /// Adds a sample; those that are not finite or without weight are dropped and counted.
    pub fn push(&mut self, sample: Sample) {
        let cell = (sample.position - self.origin) / self.edge;
        let limit = (1u32 << BITS) as f32;
        let inside = cell.min_element() >= 0.0 && cell.max_element() < limit;
        let finite = sample.weight > 0.0
            && sample.weight.is_finite()
            && sample.color.is_finite()
            && sample.covariance.is_finite();
        if !(inside && finite) {
            self.outside += 1;
            return;
        }
        self.buffer.push((morton(cell.x as u32, cell.y as u32, cell.z as u32), sample));
        if self.buffer.len() == self.collected {
            self.flush();
        }
    }

    /// Samples dropped because they were not finite or absurdly far.
    pub fn dropped(&self) -> usize {
        self.outside
    }

    /// Edge of the finest voxels now, metres.
    pub fn edge(&self) -> f32 {
        self.edge
    }

    /// Finest voxels in use.
    pub fn len(&mut self) -> usize {
        self.flush();
        self.cells.len()
    }

    fn cell_center(&self, key: u64) -> Vec3 {
        let (x, y, z) = unmorton(key);
        self.origin + (Vec3::new(x as f32, y as f32, z as f32) + 0.5) * self.edge
    }

    fn flush(&mut self) {
        if self.buffer.is_empty() {
            return;
        }
        // By key, then by arrival: the samples of one cell are always summed in the same order. Only keys are moved.
        let mut order: Vec<(u64, u32)> = self.buffer.iter().enumerate().map(|(i, s)| (s.0, i as u32)).collect();
        order.par_sort_unstable();
        let mut out = std::mem::take(&mut self.spare);
        out.clear();
        // Exactly, so that growing by doubling does not exceed the plan.
        out.reserve_exact(self.cells.len() + order.len());
        let mut old = self.cells.iter().peekable();
        let mut new = order.iter().peekable();
        loop {
            let key = match (old.peek(), new.peek()) {
                (Some(a), Some(b)) => a.key.min(b.0),
                (Some(a), None) => a.key,
                (None, Some(b)) => b.0,
                (None, None) => break,
            };
            let mut cell = match old.next_if(|c| c.key == key) {
                Some(c) => *c,
                None => Cell::empty(key),
            };
            let center = self.cell_center(key);
            while let Some((_, i)) = new.next_if(|s| s.0 == key) {
                cell.add(&self.buffer[*i as usize].1, center);
            }
            out.push(cell);
        }
        self.buffer.clear();
        self.spare = std::mem::replace(&mut self.cells, out);
        while self.cells.len() > self.capacity && self.coarsened < BITS {
            self.coarsen();
        }
    }

    /// Doubles the voxels' edge.
    fn coarsen(&mut self) {
        let fine = std::mem::take(&mut self.cells);
        let old_edge = self.edge;
        let old_origin = self.origin;
        self.edge *= 2.0;
        self.coarsened += 1;
        self.cells = tree::parents(&fine, old_origin, old_edge);
    }

    /// At most `budget` Gaussians. `spread` multiplies the spread of a cell's samples; 0 leaves only the samples' own
    /// extent (the paper's ablation without local scale).
    pub fn finish(&mut self, budget: usize, spread: f32) -> Vec<Merged> {
        self.flush();
        if budget == 0 || self.cells.is_empty() {
            return Vec::new();
        }
        (self.spare, self.buffer) = (Vec::new(), Vec::new());
        let levels = tree::Levels::build(std::mem::take(&mut self.cells), self.origin, self.edge, LEVELS);
        let cut = levels.cut(budget);
        cut.into_par_iter().map(|(level, index)| levels.gaussian(level, index, spread)).collect()
    }
}

#[cfg(test)]
mod tests;
