//! Which cells of an aircraft's model the ground wants from it: those of its own region, of all ground that no other aircraft is
//! nearer to, and a margin around them. The ground keeps the others' own models there; what it fits and distils at the border
//! looks no farther than the pictures did.

use config::mission::Mission;
use glam::DVec2;
use models::formats::model::ModelHeader;
use models::ground_cell::{CellKey, Grid};

use crate::polygon::distance;

/// The ground that one aircraft answers for, among the others of its mission.
#[derive(Clone, Debug)]
pub struct Territory {
    /// Corners of its region.
    own: Vec<DVec2>,
    others: Vec<Vec<DVec2>>,
}

impl Territory {
    /// Of an aircraft with a region; without one, everything is its own.
    pub fn of(mission: &Mission, aircraft: &str) -> Option<Self> {
        let region = |a: &config::mission::Aircraft| {
            let corners: Vec<DVec2> = mission.region(a).into_iter().map(DVec2::from).collect();
            (corners.len() >= 3).then_some(corners)
        };
        let (own, others): (Vec<_>, Vec<_>) = mission.aircraft.iter().partition(|a| a.id == aircraft);
        Some(Self { own: region(own.first()?)?, others: others.into_iter().filter_map(region).collect() })
    }

    /// Whether any place in the cell is this aircraft's, or within `margin` metres of its region.
    pub fn wants(&self, grid: Grid, key: CellKey, margin: f64) -> bool {
        let side = f64::from(grid.side_at(key.level));
        let middle = (DVec2::new(key.x.into(), key.y.into()) + 0.5) * side;
        // No distance changes by more than this from the middle to any place in the cell.
        let half = side * std::f64::consts::FRAC_1_SQRT_2;
        let own = distance(&self.own, middle) - half;
        own <= margin || !self.others.iter().any(|other| distance(other, middle) + half < own)
    }
}

/// Half of the widest picture's diagonal on the ground, metres: what a view at the border sees beyond it.
pub fn margin(header: &ModelHeader, ground: f32) -> f64 {
    let half_diagonal = |(_, view): &(String, models::camera::View)| {
        let (k, height) = (&view.intrinsics, (view.pose.center.z - f64::from(ground)).abs());
        0.5 * height * f64::from((k.width as f32 / k.fx).hypot(k.height as f32 / k.fy))
    };
    header.views.iter().map(half_diagonal).fold(0.0, f64::max)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn square(west: f64, east: f64) -> Vec<DVec2> {
        [(west, 0.0), (east, 0.0), (east, 100.0), (west, 100.0)].map(DVec2::from).to_vec()
    }

    #[test]
    fn cells_beyond_the_margin_that_another_aircraft_is_nearer_to_are_not_sent() {
        let territory = Territory { own: square(0.0, 100.0), others: vec![square(100.0, 200.0)] };
        let grid = Grid { side: 10.0 };
        let wants = |level, x, y| territory.wants(grid, CellKey { level, y, x }, 15.0);
        // Its own, the margin, and all ground on its side of the border, however far.
        for (x, y) in [(0, 0), (9, 5), (10, 5), (11, 5), (-40, 5), (5, 90), (-5, -30)] {
            assert!(wants(0, x, y), "{x} {y}");
        }
        for (x, y) in [(13, 5), (19, 9), (30, 5), (19, 12)] {
            assert!(!wants(0, x, y), "{x} {y}");
        }
        // A coarse cell reaches into it.
        assert!(wants(4, 0, 0) && wants(12, 0, 0));
        let alone = Territory { others: Vec::new(), ..territory };
        assert!(alone.wants(grid, CellKey { level: 0, y: 5, x: 300 }, 15.0));
    }
}
