//! The ground that is to be covered.

use glam::DVec2;

use super::CoverageError;

/// A polygon, concave or not, with an area.
#[derive(Clone, Debug, PartialEq)]
pub struct Region {
    corners: Vec<DVec2>,
    area_m2: f64,
}

impl Region {
    /// From corners in order, metres east and north.
    ///
    /// # Errors
    /// [`CoverageError::NoArea`].
    pub fn new(corners: Vec<DVec2>) -> Result<Self, CoverageError> {
        let Some(&first) = corners.first() else { return Err(CoverageError::NoArea) };
        // Relative to a corner: coordinates of UTM's size would leave no digits for the area.
        let next = corners.iter().cycle().skip(1);
        let area_m2 = corners.iter().zip(next).map(|(p, q)| (*p - first).perp_dot(*q - first)).sum::<f64>().abs() * 0.5;
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

    /// Whether a point lies inside (even-odd rule).
    pub fn contains(&self, p: DVec2) -> bool {
        let next = self.corners.iter().cycle().skip(1);
        let crossings = self
            .corners
            .iter()
            .zip(next)
            .filter(|(a, b)| (a.y > p.y) != (b.y > p.y) && p.x < a.x + (p.y - a.y) / (b.y - a.y) * (b.x - a.x));
        crossings.count() % 2 == 1
    }
}

/// Convex hull (Andrew's monotone chain), counter-clockwise; points that are no numbers are left out.
pub fn hull(mut points: Vec<DVec2>) -> Vec<DVec2> {
    points.retain(|p| p.is_finite());
    points.sort_by(|a, b| a.x.total_cmp(&b.x).then(a.y.total_cmp(&b.y)));
    points.dedup();
    if points.len() < 3 {
        return points;
    }
    let mut hull: Vec<DVec2> = Vec::with_capacity(2 * points.len());
    let chain = |hull: &mut Vec<DVec2>, points: &mut dyn Iterator<Item = &DVec2>| {
        let start = hull.len();
        for &p in points {
            while hull.len() >= start + 2 {
                let (a, b) = (hull[hull.len() - 2], hull[hull.len() - 1]);
                if (b - a).perp_dot(p - b) > 0.0 {
                    break;
                }
                hull.pop();
            }
            hull.push(p);
        }
        hull.pop();
    };
    chain(&mut hull, &mut points.iter());
    chain(&mut hull, &mut points.iter().rev());
    hull
}
