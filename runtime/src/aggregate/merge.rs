//! Many local clouds become one: each piece of ground is taken from the aircraft that answers for it.
//!
//! The paper filters every model by its own region and unites what is left. Two cares are taken here: ground beyond all
//! regions belongs to the nearest one ([`super::region`]), and where the aircraft that answers has (almost) nothing
//! while another one saw the place, the other one's Gaussians stay, so that the union has no holes. Nowhere are two
//! aircraft's Gaussians kept for the same cell, so nothing gets denser either.

use std::collections::HashMap;

use glam::DVec2;
use models::cloud::GaussianCloud;
use serde::Serialize;

use super::AggregateError;
use super::member::Member;
use super::region::Partition;
use coverage::{Cell, Coverage};

mod coverage;

/// What became of one model's Gaussians.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize)]
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
}

/// One cloud out of many.
#[derive(Clone, Debug, Default)]
pub struct Merged {
    /// The union.
    pub cloud: GaussianCloud,
    /// Which model each Gaussian came from.
    pub source: Vec<u16>,
    /// Per model.
    pub kept: Vec<Kept>,
}

/// Opacity from its logit.
pub fn opacity(logit: f32) -> f32 {
    1.0 / (1.0 + (-logit).exp())
}

fn ground(mean: [f32; 3]) -> DVec2 {
    DVec2::new(f64::from(mean[0]), f64::from(mean[1]))
}

/// Filters and unites the models, one at a time, and keeps the `budget` most important Gaussians.
///
/// # Errors
/// A model's file cannot be read any more.
pub fn merge(members: &[Member], partition: &Partition, budget: usize) -> Result<Merged, AggregateError> {
    let coverage = Coverage::of(members)?;
    let mut owners = partition.owners();
    let mut fill: HashMap<(usize, Cell), usize> = HashMap::new();
    let degree = members.iter().map(|m| m.sh_degree).max().unwrap_or(0);
    let mut merged = Merged { cloud: GaussianCloud::with_capacity(degree, 0), ..Default::default() };
    for (m, member) in members.iter().enumerate() {
        let mut own = member.cloud()?;
        let mut kept = Kept { gaussians: own.len(), ..Default::default() };
        let keep: Vec<bool> = (0..own.len())
            .map(|i| {
                let p = ground(own.means[i]);
                let owner = owners.owner(p);
                let cell = coverage.cell(p);
                let keeper = *fill.entry((owner, cell)).or_insert_with(|| coverage.fill_in(owner, cell));
                // Where somebody fills in for the owner, the little the owner has stays too: it is less than a tenth.
                match (owner == m, keeper == m) {
                    (true, _) => kept.own += 1,
                    (false, true) => kept.fill += 1,
                    (false, false) => kept.foreign += 1,
                }
                owner == m || keeper == m
            })
            .collect();
        own.retain(|i| keep[i]);
        merged.source.reserve_exact(own.len());
        merged.source.extend(std::iter::repeat_n(m as u16, own.len()));
        merged.cloud.reserve_exact(own.len());
        merged.cloud.extend(&own);
        merged.kept.push(kept);
    }
    merged.keep_most_important(budget);
    Ok(merged)
}

impl Merged {
    /// Drops the Gaussians that cover least until `budget` are left; returns how many.
    pub fn keep_most_important(&mut self, budget: usize) -> usize {
        let n = self.cloud.len();
        if n <= budget {
            return 0;
        }
        let keep = self.cloud.most_covering(budget);
        for (_, source) in keep.iter().zip(&self.source).filter(|(keep, _)| !**keep) {
            self.kept[usize::from(*source)].over_budget += 1;
        }
        self.retain(|i| keep[i])
    }

    /// Keeps the rows for which `keep` holds, in cloud and sources alike.
    pub fn retain(&mut self, keep: impl Fn(usize) -> bool) -> usize {
        let mut row = 0;
        self.source.retain(|_| {
            row += 1;
            keep(row - 1)
        });
        self.cloud.retain(keep)
    }
}

#[cfg(test)]
mod tests;
