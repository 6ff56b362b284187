//! How many Gaussians a piece of ground gets while the flight goes on: its share of the plan, so that what is flown last finds the
//! room that what was flown first found.

use config::plan::Plan;
use geometry::polygon::{perimeter, signed_area};
use glam::DVec2;

/// Pictures of a survey show each place so often at least; where no region says how much ground there is, as many as were planned
/// for show this much less than their number.
const OVERLAP: f64 = 4.0;
/// Gaussians of a square of ground on the mean.
const IN_A_SQUARE: u32 = 32;
/// Squares with much to show get so many times as many.
const MOST: f64 = 1.5;
/// Fewer Gaussians than this are no ground.
const FEWEST: usize = 256;

/// Gaussians for one square metre: `capacity` over the region and what pictures of `width` × `height` metres show beyond its edge.
fn per_m2(capacity: usize, region: &[[f64; 2]], [width, height]: [f64; 2], views: usize) -> f64 {
    let beyond = 0.25 * (width + height);
    let corners: Vec<DVec2> = region.iter().map(|c| DVec2::from(*c)).collect();
    let area = signed_area(&corners).abs();
    let ground = match area > 0.0 {
        true => area + perimeter(&corners) * beyond + std::f64::consts::PI * beyond * beyond,
        false => views as f64 * width * height / OVERLAP,
    };
    capacity as f64 / ground.max(1e-6)
}

/// What a piece of ground gets.
#[derive(Clone, Copy, Debug)]
pub(super) struct Share {
    capacity: usize,
    per_m2: f64,
}

impl Share {
    /// All of `capacity` for so many square metres.
    pub fn over(capacity: usize, ground_m2: f64) -> Self {
        Self { capacity, per_m2: capacity as f64 / ground_m2.max(1e-6) }
    }

    /// The share of a flight over `region`, whose pictures show `footprint_m` of the ground: all of the plan before that is known.
    pub fn of_flight(plan: &Plan, region: &[[f64; 2]], footprint_m: Option<[f64; 2]>) -> Self {
        let per_m2 = footprint_m.map_or(f64::INFINITY, |f| per_m2(plan.scene, region, f, plan.views));
        Self { capacity: plan.scene, per_m2 }
    }

    /// Side of the squares that hold a few dozen Gaussians each, metres, and how many those are at most.
    pub fn square(&self) -> (f64, u32) {
        let side = (f64::from(IN_A_SQUARE) / self.per_m2).sqrt();
        if side.is_finite() && side > 0.0 { (side, (MOST * f64::from(IN_A_SQUARE)) as u32) } else { (1.0, u32::MAX) }
    }

    /// Gaussians for so many square metres.
    pub fn of(&self, ground_m2: f64) -> usize {
        match self.per_m2.is_finite() {
            true => ((self.per_m2 * ground_m2) as usize).clamp(FEWEST.min(self.capacity), self.capacity),
            false => self.capacity,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_region_gets_the_whole_plan_and_each_metre_of_it_the_same() {
        let region = [[0.0, 0.0], [600.0, 0.0], [600.0, 400.0], [0.0, 400.0]];
        let density = per_m2(150_000, &region, [48.0, 36.0], 1000);
        // 21 m beyond every edge.
        let ground = 600.0 * 400.0 + 2000.0 * 21.0 + std::f64::consts::PI * 21.0 * 21.0;
        assert!((density * ground - 150_000.0).abs() < 1.0);
        let turned: Vec<[f64; 2]> = region.iter().rev().copied().collect();
        assert_eq!(per_m2(150_000, &turned, [48.0, 36.0], 1000), density, "whichever way round it is given");
        let none = per_m2(150_000, &[], [48.0, 36.0], 1000);
        assert!((none * 1000.0 * 48.0 * 36.0 / OVERLAP - 150_000.0).abs() < 1.0);
    }
}
