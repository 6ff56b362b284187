//! Many local clouds become one: each piece of ground is taken from the aircraft that answers for it.
//!
//! The paper filters every model by its own region and unites what is left. Two cares are taken here: ground beyond all
//! regions belongs to the nearest one ([`super::region`]), and where the aircraft that answers has (almost) nothing
//! while another one saw the place, the other one's Gaussians stay, so that the union has no holes. Nowhere are two
//! aircraft's Gaussians kept for the same cell, so nothing gets denser either.

use std::collections::HashMap;

use glam::DVec2;
use models::cloud::GaussianCloud;
use serde::{Deserialize, Serialize};

use super::AggregateError;
use super::block::Block;
use super::region::{Partition, Region};
use coverage::{Cell, Coverage};

pub use coverage::side_m;

mod coverage;

/// What became of one model's Gaussians.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct Kept {
    /// Before.
    pub gaussians: usize,
    /// Kept because its own aircraft answers for the place.
    pub own: usize,
    /// Kept to close holes in a neighbour's region.
    pub fill: usize,
    /// Left out: a neighbour answers for the place.
    pub foreign: usize,
    /// Left out to stay within the Gaussian budget.
    pub over_budget: usize,
    /// Left out: so far from all others of its model that it shows no ground.
    pub stray: usize,
}

impl Kept {
    /// Adds what became of others.
    pub fn add(&mut self, other: &Self) {
        self.gaussians += other.gaussians;
        self.own += other.own;
        self.fill += other.fill;
        self.foreign += other.foreign;
        self.over_budget += other.over_budget;
        self.stray += other.stray;
    }
}

/// One cloud out of many: a square of ground and its surroundings.
#[derive(Clone, Debug, Default)]
pub struct Merged {
    /// The union.
    pub cloud: GaussianCloud,
    /// Which of the job's models each Gaussian came from.
    pub source: Vec<u16>,
    /// Whether it lies in the square, or in its surroundings.
    pub inside: Vec<bool>,
    /// Per model of the job, of those in the square.
    pub kept: Vec<Kept>,
}

/// Opacity from its logit.
pub fn opacity(logit: f32) -> f32 {
    1.0 / (1.0 + (-logit).exp())
}

fn ground(mean: [f32; 3]) -> DVec2 {
    DVec2::new(f64::from(mean[0]), f64::from(mean[1]))
}

/// Filters and unites the models in a square and its surroundings, one piece at a time. Of those in the square the `most` important
/// ones are kept; the surroundings, which are only looked at, are not thinned out.
///
/// # Errors
/// A piece cannot be read.
pub fn merge(block: &Block<'_>) -> Result<Merged, AggregateError> {
    let inputs = block.inputs;
    let coverage = Coverage::of(block)?;
    let regions: Vec<Option<Region>> = inputs.regions.iter().map(|r| Some(r.1.clone())).collect();
    let partition = Partition::of(regions, inputs.border_m);
    let mut owners = partition.owners();
    // An owner that is not among the models around here shows nothing here.
    let nobody = usize::MAX;
    let mut owner = |p: DVec2| match inputs.regions.get(owners.owner(p)) {
        Some((model, _)) => model.map_or(nobody, usize::from),
        None => inputs.owner_of_all.map_or(nobody, usize::from),
    };
    let mut fill: HashMap<(usize, Cell), usize> = HashMap::new();
    let mut merged = Merged { cloud: GaussianCloud::with_capacity(inputs.sh_degree, 0), ..Default::default() };
    for m in 0..inputs.models.len() {
        let mut kept = Kept::default();
        for piece in block.pieces(m) {
            let mut own = piece?;
            let (mut rows, mut inside) = (Vec::new(), Vec::new());
            for (i, mean) in own.means.iter().enumerate() {
                let seam = inputs.squares.seam(mean);
                if !inputs.squares.surrounds(inputs.key, seam) {
                    continue;
                }
                let p = ground(*mean);
                let (owner, cell) = (owner(p), coverage.cell(p));
                let keeper = *fill.entry((owner, cell)).or_insert_with(|| coverage.fill_in(owner, cell));
                let is_inside = inputs.squares.key_of(seam) == inputs.key;
                if is_inside {
                    kept.gaussians += 1;
                    // Where somebody fills in for the owner, the little the owner has stays too: it is less than a tenth.
                    match (owner == m, keeper == m) {
                        (true, _) => kept.own += 1,
                        (false, true) => kept.fill += 1,
                        (false, false) => kept.foreign += 1,
                    }
                }
                if owner == m || keeper == m {
                    rows.push(i as u32);
                    inside.push(is_inside);
                }
            }
            if rows.len() < own.len() {
                own = own.rows(&rows);
            }
            merged.source.extend(std::iter::repeat_n(m as u16, own.len()));
            merged.inside.append(&mut inside);
            merged.cloud.reserve_exact(own.len());
            merged.cloud.extend(&own);
        }
        merged.kept.push(kept);
    }
    if let Some(most) = inputs.most {
        merged.keep_most_important(usize::try_from(most).unwrap_or(usize::MAX));
    }
    Ok(merged)
}

impl Merged {
    /// Drops the Gaussians of the square that cover least until `budget` are left; returns how many.
    fn keep_most_important(&mut self, budget: usize) -> usize {
        let rows: Vec<u32> = (0..self.cloud.len() as u32).filter(|i| self.inside[*i as usize]).collect();
        let mut keep = vec![true; self.cloud.len()];
        for row in self.cloud.least_covering(rows, budget) {
            keep[row as usize] = false;
            self.kept[usize::from(self.source[row as usize])].over_budget += 1;
        }
        self.retain(|i| keep[i])
    }

    /// Keeps the rows for which `keep` holds, in all columns alike.
    pub fn retain(&mut self, keep: impl Fn(usize) -> bool) -> usize {
        let mut row = 0;
        self.source.retain(|_| {
            row += 1;
            keep(row - 1)
        });
        row = 0;
        self.inside.retain(|_| {
            row += 1;
            keep(row - 1)
        });
        self.cloud.retain(keep)
    }
}

#[cfg(test)]
mod tests;
