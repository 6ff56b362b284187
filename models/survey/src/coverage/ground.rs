//! Heights of the ground from what was reconstructed of it.

use glam::{DVec2, Vec3};

use super::Grid;

/// Squares along a block's side: wide enough to hold the ground beside a house, narrow enough to follow a hillside.
const BLOCK: usize = 8;
/// Points sampled, evenly spread over the list.
const MOST_POINTS: usize = 1 << 18;
/// Fewer in a block say nothing.
const LEAST_POINTS: usize = 8;
/// Of the heights in a block this share lies below the ground: the lowest are wrong matches, most of the rest stands on it.
const SHARE: f64 = 0.3;

/// Height by block; blocks without points have that of their neighbours.
#[derive(Clone, Debug)]
pub struct Heights {
    corner: DVec2,
    side_m: f64,
    columns: usize,
    rows: usize,
    heights: Vec<f32>,
}

impl Heights {
    /// Of points on whatever stands on the ground; `None` when no block of the grid has enough of them.
    pub fn of(points: &[Vec3], grid: &Grid) -> Option<Self> {
        let (columns, rows) = (grid.columns.div_ceil(BLOCK), grid.rows.div_ceil(BLOCK));
        let side_m = grid.side_m * BLOCK as f64;
        let mut placed: Vec<(u32, f32)> = Vec::with_capacity(points.len().min(MOST_POINTS));
        for p in points.iter().step_by(points.len().div_ceil(MOST_POINTS).max(1)) {
            let at = (p.as_dvec3().truncate() - grid.corner) / side_m;
            let inside = at.cmpge(DVec2::ZERO).all() && at.x < columns as f64 && at.y < rows as f64;
            if inside && p.z.is_finite() {
                placed.push(((at.y as usize * columns + at.x as usize) as u32, p.z));
            }
        }
        placed.sort_by(|a, b| a.0.cmp(&b.0).then(a.1.total_cmp(&b.1)));
        let mut heights = vec![f32::NAN; columns * rows];
        for block in placed.chunk_by(|a, b| a.0 == b.0).filter(|b| b.len() >= LEAST_POINTS) {
            heights[block[0].0 as usize] = block[((block.len() - 1) as f64 * SHARE) as usize].1;
        }
        let mut this = Self { corner: grid.corner, side_m, columns, rows, heights };
        this.fill().then_some(this)
    }

    /// Grows what is known into what is not, ring by ring; false when nothing is known.
    fn fill(&mut self) -> bool {
        loop {
            let before = self.heights.clone();
            let mut grown = false;
            for i in (0..before.len()).filter(|&i| before[i].is_nan()) {
                let (column, row) = (i % self.columns, i / self.columns);
                let columns = column.saturating_sub(1)..(column + 2).min(self.columns);
                let rows = row.saturating_sub(1)..(row + 2).min(self.rows);
                let around = rows.flat_map(|r| columns.clone().map(move |c| (c, r)));
                let known = around.map(|(c, r)| before[r * self.columns + c]).filter(|h| !h.is_nan());
                let (sum, count) = known.fold((0.0, 0.0), |(s, n), h| (s + h, n + 1.0));
                if count > 0.0 {
                    self.heights[i] = sum / count;
                    grown = true;
                }
            }
            if !grown {
                return self.heights.iter().all(|h| !h.is_nan());
            }
        }
    }

    /// Height at (east, north); that of the nearest block outside.
    pub fn at(&self, p: DVec2) -> f64 {
        let at = (p - self.corner) / self.side_m;
        let index = |v: f64, count: usize| (v.max(0.0) as usize).min(count - 1);
        self.heights[index(at.y, self.rows) * self.columns + index(at.x, self.columns)].into()
    }
}
