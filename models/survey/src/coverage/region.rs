//! The ground that is to be covered.

use geometry::polygon::{contains, signed_area};
use glam::DVec2;

use super::CoverageError;

/// A polygon, concave or not, with an area.
#[derive(Clone, Debug, PartialEq)]
pub struct CoverageRegion {
    corners: Vec<DVec2>,
    area_m2: f64,
}

impl CoverageRegion {
    /// From corners in order, metres east and north.
    ///
    /// # Errors
    /// [`CoverageError::NoArea`].
    pub fn new(corners: Vec<DVec2>) -> Result<Self, CoverageError> {
        let Some(&first) = corners.first() else { return Err(CoverageError::NoArea) };
        let area_m2 = signed_area(&corners).abs();
        let longest = corners.iter().map(|c| c.distance(first)).fold(0.0, f64::max);
        // A line's corners differ from it by rounding.
        let has_area = area_m2.is_finite() && area_m2 > 1e-9 * longest * longest && longest > 0.0;
        if has_area { Ok(Self { corners, area_m2 }) } else { Err(CoverageError::NoArea) }
    }

    /// Area, m².
    pub fn area_m2(&self) -> f64 {
        self.area_m2
    }

    /// South-west and north-east corner of the box around it.
    pub fn bounds(&self) -> (DVec2, DVec2) {
        let fold = |start, f: fn(DVec2, DVec2) -> DVec2| self.corners.iter().copied().fold(start, f);
        (fold(DVec2::INFINITY, DVec2::min), fold(DVec2::NEG_INFINITY, DVec2::max))
    }

    /// Whether a point lies inside.
    pub fn contains(&self, p: DVec2) -> bool {
        contains(&self.corners, p)
    }
}
