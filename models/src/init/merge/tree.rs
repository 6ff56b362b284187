//! The octree over Morton-ordered cells, and the cut through it that spends a budget where it helps most.

use glam::Vec3;
use rayon::prelude::*;

use super::Merged;
use super::cell::Cell;
use crate::morton::unmorton;

/// Cells of doubled edge: runs of eight neighbours in Morton order.
pub fn parents(fine: &[Cell], origin: Vec3, edge: f32) -> Vec<Cell> {
    let mut out: Vec<Cell> = Vec::with_capacity(fine.len() / 2 + 1);
    for child in fine {
        let key = child.key >> 3;
        if out.last().is_none_or(|p| p.key != key) {
            out.push(Cell::empty(key));
        }
        let offset = center(child.key, origin, edge) - center(key, origin, 2.0 * edge);
        if let Some(parent) = out.last_mut() {
            parent.add_child(child, offset);
        }
    }
    out
}

fn center(key: u64, origin: Vec3, edge: f32) -> Vec3 {
    let (x, y, z) = unmorton(key);
    origin + (Vec3::new(x as f32, y as f32, z as f32) + 0.5) * edge
}

/// All levels, finest first.
pub struct Levels {
    levels: Vec<Vec<Cell>>,
    /// First child (index in the next finer level) of each cell; one more at the end.
    first_child: Vec<Vec<u32>>,
    errors: Vec<Vec<f32>>,
    origin: Vec3,
    edge: f32,
}

impl Levels {
    /// Adds `above` coarser levels to the finest.
    pub fn build(finest: Vec<Cell>, origin: Vec3, edge: f32, above: usize) -> Self {
        let mut levels = vec![finest];
        let mut first_child = vec![Vec::new()];
        for l in 0..above {
            let fine = &levels[l];
            let coarse = parents(fine, origin, edge * (1 << l) as f32);
            let mut first = Vec::with_capacity(coarse.len() + 1);
            let mut at = 0;
            for cell in &coarse {
                first.push(at as u32);
                while at < fine.len() && fine[at].key >> 3 == cell.key {
                    at += 1;
                }
            }
            first.push(at as u32);
            levels.push(coarse);
            first_child.push(first);
        }
        // A parent's error is never below what its children cost together, so that the cut is monotone in the threshold.
        let mut errors: Vec<Vec<f32>> = vec![vec![0.0; levels[0].len()]];
        for l in 1..=above {
            let e = (0..levels[l].len())
                .into_par_iter()
                .map(|i| {
                    let children = first_child[l][i] as usize..first_child[l][i + 1] as usize;
                    levels[l][i].error().max(errors[l - 1][children].iter().copied().fold(0.0, f32::max))
                })
                .collect();
            errors.push(e);
        }
        Self { levels, first_child, errors, origin, edge }
    }

    /// Cells (level, index) of the finest cut with at most `budget` cells; when even the coarsest level has more, its
    /// heaviest cells.
    pub fn cut(&self, budget: usize) -> Vec<(usize, usize)> {
        let top = self.levels.len() - 1;
        if self.levels[top].len() >= budget {
            let mut order: Vec<usize> = (0..self.levels[top].len()).collect();
            let e = &self.errors[top];
            order.sort_by(|&a, &b| e[b].total_cmp(&e[a]).then(a.cmp(&b)));
            order.truncate(budget);
            order.sort_unstable();
            return order.into_iter().map(|i| (top, i)).collect();
        }
        // Splitting a cell adds its children minus one; parents come before their children in this order.
        let mut splits: Vec<(f32, u32)> = Vec::new();
        for l in 1..=top {
            let first = &self.first_child[l];
            splits.extend((0..self.levels[l].len()).map(|i| (self.errors[l][i], first[i + 1] - first[i] - 1)));
        }
        splits.par_sort_unstable_by(|a, b| b.0.total_cmp(&a.0).then(b.1.cmp(&a.1)));
        let mut leaves = self.levels[top].len();
        let mut threshold = -1.0;
        for group in splits.chunk_by(|a, b| a.0 == b.0) {
            leaves += group.iter().map(|s| s.1 as usize).sum::<usize>();
            if leaves > budget {
                threshold = group[0].0;
                break;
            }
        }
        let mut out = Vec::with_capacity(budget);
        for i in 0..self.levels[top].len() {
            self.collect(top, i, threshold, &mut |level, index| out.push((level, index)));
        }
        out
    }

    fn collect(&self, level: usize, index: usize, threshold: f32, take: &mut impl FnMut(usize, usize)) {
        if level == 0 || self.errors[level][index] <= threshold {
            take(level, index);
            return;
        }
        for child in self.first_child[level][index]..self.first_child[level][index + 1] {
            self.collect(level - 1, child as usize, threshold, take);
        }
    }

    /// The Gaussian of a cell.
    pub fn gaussian(&self, level: usize, index: usize, spread: f32) -> Merged {
        let cell = &self.levels[level][index];
        cell.gaussian(center(cell.key, self.origin, self.edge * (1 << level) as f32), spread)
    }
}
