//! Where the ground is not covered: squares that hang together, by edges or corners.

use glam::DVec2;

use super::{CoverageMap, State};

/// Gaps of a small region count from this share of it on.
const SHARE_OF_REGION: f64 = 0.1;

/// What is missing.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum GapKind {
    /// Some of it is in fewer pictures than wanted.
    Hole,
    /// All of it is in enough pictures, but they look from too alike directions.
    Thin,
}

impl GapKind {
    /// In a word, for files.
    pub fn name(self) -> &'static str {
        match self {
            Self::Hole => "hole",
            Self::Thin => "thin",
        }
    }
}

/// One piece of ground that is not covered.
#[derive(Clone, Debug, PartialEq)]
pub struct Gap {
    /// What is missing.
    pub kind: GapKind,
    /// Its squares: row times columns plus column.
    pub squares: Vec<u32>,
    /// Mean of their middles, metres east and north.
    pub middle: DVec2,
    /// Its area, m².
    pub area_m2: f64,
    /// The part of it that is in no picture, m².
    pub unseen_m2: f64,
    /// Pictures that see the least seen square.
    pub pictures: u16,
    /// Widest angle at the square with the narrowest, degrees.
    pub angle_deg: f64,
    /// Expected standard deviation of a height at the worst square, metres; `None` where one has none.
    pub sigma_z_m: Option<f64>,
}

/// All gaps of a map, the largest first; those below `least_m2` of its settings are left out.
pub fn find(map: &CoverageMap) -> Vec<Gap> {
    let least_m2 = f64::from(map.rules().least_m2).min(SHARE_OF_REGION * map.area_m2());
    let grid = *map.grid();
    let open = |i: usize| map.cell_at(i).is_some_and(|c| c.state != State::Covered);
    let mut taken = vec![false; grid.columns * grid.rows];
    let mut found = Vec::new();
    for first in 0..taken.len() {
        if taken[first] || !open(first) {
            continue;
        }
        taken[first] = true;
        let mut squares = vec![first as u32];
        let mut next = 0;
        while let Some(&at) = squares.get(next) {
            next += 1;
            let (column, row) = grid.place(at as usize);
            for r in row.saturating_sub(1)..(row + 2).min(grid.rows) {
                for c in column.saturating_sub(1)..(column + 2).min(grid.columns) {
                    let i = r * grid.columns + c;
                    if !taken[i] && open(i) {
                        taken[i] = true;
                        squares.push(i as u32);
                    }
                }
            }
        }
        found.push(gap(map, squares));
    }
    found.retain(|g| g.area_m2 >= least_m2);
    found.sort_by(|a, b| b.area_m2.total_cmp(&a.area_m2));
    found
}

fn gap(map: &CoverageMap, mut squares: Vec<u32>) -> Gap {
    squares.sort_unstable();
    let (grid, count) = (map.grid(), squares.len() as f64);
    let reports: Vec<_> = squares.iter().filter_map(|&i| map.cell_at(i as usize)).collect();
    let pictures = reports.iter().map(|r| r.pictures).min().unwrap_or(0);
    let unseen = reports.iter().filter(|r| r.state == State::Unseen).count();
    // Relative to the corner: sums of UTM's size lose digits.
    let place = |&i: &u32| {
        let (column, row) = grid.place(i as usize);
        grid.middle(column, row) - grid.corner
    };
    let sigmas: Option<Vec<f64>> = reports.iter().map(|r| r.sigma_z_m).collect();
    Gap {
        kind: if u32::from(pictures) < map.rules().pictures { GapKind::Hole } else { GapKind::Thin },
        middle: grid.corner + squares.iter().map(place).sum::<DVec2>() / count,
        area_m2: count * grid.cell_m2(),
        unseen_m2: unseen as f64 * grid.cell_m2(),
        pictures,
        angle_deg: reports.iter().map(|r| r.angle_deg).fold(f64::INFINITY, f64::min),
        sigma_z_m: sigmas.map(|s| s.into_iter().fold(0.0, f64::max)),
        squares,
    }
}
