//! Many local clouds become one: each piece of ground is taken from the aircraft that answers for it.
//!
//! The paper filters every model by its own region and unites what is left. Two cares are taken here: ground beyond all
//! regions belongs to the nearest one ([`super::region`]), and where the aircraft that answers has (almost) nothing
//! while another one saw the place, the other one's Gaussians stay, so that the union has no holes. Nowhere are two
//! aircraft's Gaussians kept for the same cell, so nothing gets denser either.

use glam::DVec2;
use models::cloud::GaussianCloud;
use serde::Serialize;

use super::LocalModel;
use super::region::Partition;

/// Cells along the longer side of the scene, for judging coverage: coarse enough to hold many Gaussians, fine
/// enough to find a missed courtyard.
const CELLS: f64 = 64.0;
/// An owner with less than this share of another one's coverage leaves a hole.
const HOLE_SHARE: f64 = 0.1;

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

/// How much of each cell each model covers.
struct Coverage {
    low: DVec2,
    side: f64,
    columns: usize,
    rows: usize,
    /// `[model][cell]`, m².
    area: Vec<Vec<f32>>,
}

impl Coverage {
    fn new(models: &[LocalModel]) -> Self {
        // 1st…99th percentile: one stray Gaussian a kilometre off must not make the cells useless.
        let mut low = DVec2::INFINITY;
        let mut high = DVec2::NEG_INFINITY;
        for model in models.iter().filter(|m| !m.cloud.is_empty()) {
            let stride = model.cloud.len().div_ceil(8192).max(1);
            for axis in 0..2 {
                let mut v: Vec<f32> = model.cloud.means.iter().step_by(stride).map(|m| m[axis]).collect();
                v.sort_by(f32::total_cmp);
                low[axis] = low[axis].min(f64::from(v[v.len() / 100]));
                high[axis] = high[axis].max(f64::from(v[v.len() - 1 - v.len() / 100]));
            }
        }
        let span = if low.cmple(high).all() { high - low } else { DVec2::ZERO };
        let side = (span.max_element() / CELLS).max(1e-3);
        let (columns, rows) = ((span.x / side) as usize + 1, (span.y / side) as usize + 1);
        let mut this = Self { low, side, columns, rows, area: vec![vec![0.0; columns * rows]; models.len()] };
        for (m, model) in models.iter().enumerate() {
            for i in 0..model.cloud.len() {
                if let Some(cell) = this.cell(ground(model.cloud.means[i])) {
                    this.area[m][cell] += model.cloud.covered_m2(i).min(side * side) as f32;
                }
            }
        }
        this
    }

    fn cell(&self, p: DVec2) -> Option<usize> {
        let at = (p - self.low) / self.side;
        let inside = at.x >= 0.0 && at.y >= 0.0 && at.x < self.columns as f64 && at.y < self.rows as f64;
        inside.then(|| at.y as usize * self.columns + at.x as usize)
    }

    /// m² that model `m` covers around a cell (3 × 3, so that a border through the cell does not look like a hole).
    fn around(&self, m: usize, cell: usize) -> f64 {
        let (x, y) = (cell % self.columns, cell / self.columns);
        let mut sum = 0.0;
        for v in y.saturating_sub(1)..(y + 2).min(self.rows) {
            for u in x.saturating_sub(1)..(x + 2).min(self.columns) {
                sum += f64::from(self.area[m][v * self.columns + u]);
            }
        }
        sum
    }

    /// For each cell and each nominal owner: who fills in. `owner` itself unless it leaves a hole.
    fn fill_in(&self, owner: usize, cell: usize) -> usize {
        let own = self.around(owner, cell);
        let best = (0..self.area.len())
            .map(|m| (m, self.around(m, cell)))
            .fold((owner, own), |a, b| if b.1 > a.1 { b } else { a });
        if own < HOLE_SHARE * best.1 { best.0 } else { owner }
    }
}

/// Filters and unites the models, and keeps the `budget` most important Gaussians.
pub fn merge(models: &[LocalModel], partition: &Partition, budget: usize) -> Merged {
    let coverage = Coverage::new(models);
    let mut fill: Vec<Option<u16>> = vec![None; models.len() * coverage.columns * coverage.rows];
    let degree = models.iter().map(|m| m.cloud.sh_degree).max().unwrap_or(0);
    let total = models.iter().map(|m| m.cloud.len()).sum();
    let mut merged = Merged { cloud: GaussianCloud::with_capacity(degree, total), ..Default::default() };
    for (m, model) in models.iter().enumerate() {
        let mut kept = Kept { gaussians: model.cloud.len(), ..Default::default() };
        let keep: Vec<bool> = (0..model.cloud.len())
            .map(|i| {
                let p = ground(model.cloud.means[i]);
                let owner = partition.owner(p);
                let keeper = match coverage.cell(p) {
                    Some(cell) => {
                        let known = &mut fill[owner * coverage.columns * coverage.rows + cell];
                        usize::from(*known.get_or_insert_with(|| coverage.fill_in(owner, cell) as u16))
                    }
                    None => owner,
                };
                // Where somebody fills in for the owner, the little the owner has stays too: it is less than a tenth.
                match (owner == m, keeper == m) {
                    (true, _) => kept.own += 1,
                    (false, true) => kept.fill += 1,
                    (false, false) => kept.foreign += 1,
                }
                owner == m || keeper == m
            })
            .collect();
        let mut own = model.cloud.clone();
        own.retain(|i| keep[i]);
        merged.source.extend(std::iter::repeat_n(m as u16, own.len()));
        merged.cloud.extend(&own);
        merged.kept.push(kept);
    }
    merged.keep_most_important(budget);
    merged
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
