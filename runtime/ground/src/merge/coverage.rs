//! How much of each cell of ground each model covers: who left a hole, and who could fill it.

use std::collections::HashMap;

use super::ground;
use crate::AggregateError;
use crate::block::Block;
use crate::member::Member;
use crate::squares::SURROUNDINGS;
use glam::DVec2;

/// Cells along the longer side of a middling model's ground: coarse enough to hold many Gaussians, fine enough to find a
/// missed courtyard, and no coarser where the scene is vast.
const CELLS: f64 = 64.0;
/// A cell's side in metres at most; what a job must know of its surroundings grows with it.
const MOST_M: f64 = 1e4;
/// An owner with less than this share of another one's coverage leaves a hole.
const HOLE_SHARE: f64 = 0.1;

/// Column and row.
pub type Cell = (i32, i32);

/// Side of the cells in which holes are looked for, metres.
pub fn side_m(members: &[Member]) -> f64 {
    let mut sides: Vec<f64> = members.iter().map(|m| m.bounds().span().max_element()).collect();
    sides.sort_by(f64::total_cmp);
    (sides.get(sides.len() / 2).copied().unwrap_or(0.0) / CELLS).clamp(1e-3, MOST_M)
}

/// Only cells that somebody covers take memory.
pub struct Coverage {
    side: f64,
    /// Model and m², cell by cell, models in rising order.
    covered: Vec<(u16, f32)>,
    /// Where the entries of a cell begin and end.
    cells: HashMap<Cell, (u32, u32)>,
}

impl Coverage {
    /// Of what lies around a job's square; every piece is read once.
    pub fn of(block: &Block<'_>) -> Result<Self, AggregateError> {
        let side = block.inputs.coverage_m;
        let mut this = Self { side, covered: Vec::new(), cells: HashMap::new() };
        // Nothing is asked about cells farther out than those beside the surroundings; one more is room for rounding.
        let squares = &block.inputs.squares;
        let reach = 0.5 * squares.side_m() + SURROUNDINGS as f64 * f64::from(squares.seam_m) + 2.0 * side;
        let middle = squares.middle(block.inputs.key);
        let (low, high) = (this.cell(middle - reach), this.cell(middle + reach));
        let is_near = |(x, y): Cell| (low.0..=high.0).contains(&x) && (low.1..=high.1).contains(&y);
        let mut entries: Vec<(Cell, u16, f32)> = Vec::new();
        for m in 0..block.inputs.models.len() {
            let mut area: HashMap<Cell, f32> = HashMap::new();
            for cloud in block.pieces(m) {
                let cloud = cloud?;
                for i in 0..cloud.len() {
                    let cell = this.cell(ground(cloud.means[i]));
                    if is_near(cell) {
                        *area.entry(cell).or_default() += cloud.covered_m2(i).min(side * side) as f32;
                    }
                }
            }
            entries.reserve_exact(area.len());
            entries.extend(area.into_iter().map(|(cell, m2)| (cell, m as u16, m2)));
        }
        entries.sort_unstable_by_key(|e| (e.0, e.1));
        for of_cell in entries.chunk_by(|a, b| a.0 == b.0) {
            let from = this.covered.len() as u32;
            this.covered.extend(of_cell.iter().map(|e| (e.1, e.2)));
            this.cells.insert(of_cell[0].0, (from, this.covered.len() as u32));
        }
        Ok(this)
    }

    /// The cell under a point.
    pub fn cell(&self, p: DVec2) -> Cell {
        ((p.x / self.side).floor() as i32, (p.y / self.side).floor() as i32)
    }

    /// m² that each model covers around a cell (3 × 3, so that a border through the cell does not look like a hole), models in
    /// rising order.
    fn around(&self, (x, y): Cell) -> Vec<(u16, f64)> {
        let mut found: Vec<(u16, f64)> = Vec::new();
        for v in y.saturating_sub(1)..=y.saturating_add(1) {
            for u in x.saturating_sub(1)..=x.saturating_add(1) {
                let Some(&(from, to)) = self.cells.get(&(u, v)) else { continue };
                found.extend(self.covered[from as usize..to as usize].iter().map(|e| (e.0, f64::from(e.1))));
            }
        }
        found.sort_by_key(|e| e.0);
        found.chunk_by(|a, b| a.0 == b.0).map(|e| (e[0].0, e.iter().map(|e| e.1).sum())).collect()
    }

    /// Who fills in at a cell that `owner` answers for: `owner` itself unless it leaves a hole.
    pub fn fill_in(&self, owner: usize, cell: Cell) -> usize {
        let around = self.around(cell);
        let own = around.iter().find(|e| usize::from(e.0) == owner).map_or(0.0, |e| e.1);
        let better = |a: (usize, f64), b: &(u16, f64)| if b.1 > a.1 { (usize::from(b.0), b.1) } else { a };
        let best = around.iter().fold((owner, own), better);
        if own < HOLE_SHARE * best.1 { best.0 } else { owner }
    }
}
