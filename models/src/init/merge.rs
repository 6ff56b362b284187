//! Millions of pixel-aligned samples into at most N Gaussians: samples add up in fine voxels (fixed room, in the order in which they
//! come), whose moments add up the octree; the cut through the tree that fits N keeps small cells where colour varies and
//! large ones where it does not.
//!
//! A cell's Gaussian has the samples' own spread and normal, so a flat lawn becomes a few flat discs.

use glam::{Mat3, Vec3};
use rayon::prelude::*;

use crate::morton::{BITS, morton, unmorton};

mod bricks;
mod cell;
mod tree;

use bricks::Bricks;
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
/// Samples whose cells are looked up together.
const AT_ONCE: usize = 32;

/// The merging voxels; memory never exceeds [`VoxelMerge::planned_bytes`].
#[derive(Debug)]
pub struct VoxelMerge {
    edge: f32,
    origin: Vec3,
    /// In the order in which they were met.
    cells: Vec<Cell>,
    /// Where each is.
    at: Bricks,
    capacity: usize,
    outside: usize,
    coarsened: u32,
}

impl VoxelMerge {
    /// Voxels of `edge` metres around `center`, at most `capacity` of them: when more are needed the edge doubles.
    pub fn new(edge: f32, center: Vec3, capacity: usize) -> Self {
        let half = edge * (1u32 << (BITS - 1)) as f32;
        let capacity = capacity.max(1);
        Self {
            edge,
            origin: center - Vec3::splat(half),
            cells: Vec::with_capacity(capacity),
            at: Bricks::for_voxels(capacity),
            capacity,
            outside: 0,
            coarsened: 0,
        }
    }

    /// Host bytes for a capacity: the cells, and as many again for the coarser levels of the tree; the table that finds them; `budget`
    /// Gaussians at the end.
    pub fn planned_bytes(capacity: usize, budget: usize) -> u64 {
        let cells = capacity as u64 * 2 * size_of::<Cell>() as u64;
        cells + Bricks::planned_bytes(capacity) + (budget * size_of::<Merged>()) as u64
    }

    /// Adds those of the samples that are `own`; those that are not finite or without weight are dropped and counted.
    pub fn push_all(&mut self, samples: &[Sample], own: impl Fn(&Sample) -> bool) {
        let (mut met, mut last) = ([None; AT_ONCE], None);
        for few in samples.chunks(AT_ONCE) {
            // Looked up side by side: each lies somewhere else in memory.
            let coarsened = self.coarsened;
            for (met, sample) in met.iter_mut().zip(few) {
                *met = self.key(sample.position).map(|key| (key, self.at.find(key, &mut last)));
            }
            for (met, sample) in met.iter().zip(few).filter(|(_, sample)| own(sample)) {
                let finite = sample.weight > 0.0
                    && sample.weight.is_finite()
                    && sample.color.is_finite()
                    && sample.covariance.is_finite();
                match met.filter(|_| finite) {
                    None => self.outside += 1,
                    Some((key, Some(at))) if self.coarsened == coarsened => self.add(at as usize, key, sample),
                    Some(_) => {
                        self.place(sample);
                        last = last.filter(|_| self.coarsened == coarsened);
                    }
                }
            }
        }
    }

    fn add(&mut self, at: usize, key: u64, sample: &Sample) {
        let center = self.cell_center(key);
        self.cells[at].add(sample, center);
    }

    fn key(&self, position: Vec3) -> Option<u64> {
        let cell = (position - self.origin) / self.edge;
        let inside = cell.min_element() >= 0.0 && cell.max_element() < (1u32 << BITS) as f32;
        inside.then(|| morton(cell.x as u32, cell.y as u32, cell.z as u32))
    }

    /// Adds a sample that may be the first of its cell; all cells get twice the edge where there is no room for it.
    fn place(&mut self, sample: &Sample) {
        while let Some(key) = self.key(sample.position) {
            if let Some(at) = self.at.find(key, &mut None) {
                return self.add(at as usize, key, sample);
            }
            let room = self.cells.len() < self.capacity && self.at.insert(key, self.cells.len() as u32);
            if room || self.coarsened >= BITS {
                self.cells.push(Cell::empty(key));
                return self.add(self.cells.len() - 1, key, sample);
            }
            self.coarsen();
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
    pub fn len(&self) -> usize {
        self.cells.len()
    }

    fn cell_center(&self, key: u64) -> Vec3 {
        let (x, y, z) = unmorton(key);
        self.origin + (Vec3::new(x as f32, y as f32, z as f32) + 0.5) * self.edge
    }

    /// Doubles the voxels' edge, until all of them are found in the memory there is for that.
    fn coarsen(&mut self) {
        self.cells.par_sort_unstable_by_key(|cell| cell.key);
        loop {
            let coarse = tree::parents(&self.cells, self.origin, self.edge);
            self.edge *= 2.0;
            self.coarsened += 1;
            self.cells.clear();
            self.cells.extend(coarse);
            self.at.clear();
            let all = self.cells.iter().enumerate().all(|(i, cell)| self.at.insert(cell.key, i as u32));
            if all || self.coarsened >= BITS {
                return;
            }
        }
    }

    /// At most `budget` Gaussians. `spread` multiplies the spread of a cell's samples; 0 leaves only the samples' own
    /// extent (the paper's ablation without local scale).
    pub fn finish(mut self, budget: usize, spread: f32) -> Vec<Merged> {
        if budget == 0 || self.cells.is_empty() {
            return Vec::new();
        }
        self.at = Bricks::for_voxels(0);
        self.cells.par_sort_unstable_by_key(|cell| cell.key);
        let levels = tree::Levels::build(self.cells, self.origin, self.edge, LEVELS);
        let cut = levels.cut(budget);
        cut.into_par_iter().map(|(level, index)| levels.gaussian(level, index, spread)).collect()
    }
}

#[cfg(test)]
mod tests;
