//! The squares of ground that are merged as jobs of their own. They are made of whole cells of seams, so that no seam is shared, and
//! the origin lies in the middle of one, so that a small mission is one job.

use config::ground::GroundSettings;
use glam::DVec2;
use models::ground_cell::CellKey;
use serde::{Deserialize, Serialize};

/// Column and row of a cell of seams.
pub type Seam = (i64, i64);

/// Cells of seams around those that are trained whose Gaussians are drawn with them: what stands there may stand in the way.
pub const HALO: i64 = 2;
/// Cells of seams from a border to the last that is trained: aircraft photograph their neighbours' ground, and the neighbour's model does
/// not know it from there. 1, 3, 6 and 12 on sheffield_cross, views of all three aircraft: 25.28, 25.57, 25.67 and 25.64 dB.
pub const REACH: i64 = 6;
/// Cells of seams around a square whose Gaussians are merged with it: those that are drawn, and those that say where a seam is.
pub const SURROUNDINGS: i64 = HALO + REACH;
/// Cells of seams along a square, at most.
const MOST_SEAMS: f64 = (1 << 20) as f64;

/// The squares of a scene.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Squares {
    /// Side of a cell of seams, metres.
    pub seam_m: f32,
    /// So many along a side; even.
    pub seams: u32,
}

impl Squares {
    /// Squares of at least `ground.cell_m`, and so large that what a job must know of its surroundings (`coverage_m`: side of the cells
    /// in which holes are looked for) lies in its own square and the eight around it.
    pub fn new(settings: &GroundSettings, coverage_m: f64) -> Self {
        let seam_m = f64::from(settings.seam_m);
        let least = (SURROUNDINGS as f64 * seam_m + 2.0 * coverage_m).max(f64::from(settings.cell_m));
        let half = (0.5 * least / seam_m).ceil().clamp(1.0, 0.5 * MOST_SEAMS);
        Self { seam_m: settings.seam_m, seams: 2 * half as u32 }
    }

    /// Whether a plan may have them.
    pub fn is_usable(&self) -> bool {
        let seams = f64::from(self.seams);
        self.seam_m.is_finite()
            && self.seam_m > 0.0
            && self.seams.is_multiple_of(2)
            && (2.0..=MOST_SEAMS).contains(&seams)
    }

    /// Side of a square, metres.
    pub fn side_m(&self) -> f64 {
        f64::from(self.seam_m) * f64::from(self.seams)
    }

    /// The middle of a square.
    pub fn middle(&self, key: CellKey) -> DVec2 {
        self.side_m() * DVec2::new(f64::from(key.x), f64::from(key.y))
    }

    /// The cell of seams under a mean.
    pub fn seam(&self, mean: &[f32; 3]) -> Seam {
        seam(mean, self.seam_m)
    }

    /// The square that a cell of seams is part of.
    pub fn key_of(&self, (x, y): Seam) -> CellKey {
        let (side, half) = (i64::from(self.seams), i64::from(self.seams / 2));
        // What lies beyond 2³¹ squares shares the last.
        let index = |v: i64| v.saturating_add(half).div_euclid(side).clamp(i32::MIN.into(), i32::MAX.into()) as i32;
        CellKey { level: 0, y: index(y), x: index(x) }
    }

    /// The square under a mean.
    pub fn key(&self, mean: &[f32; 3]) -> CellKey {
        self.key_of(self.seam(mean))
    }

    /// Whether a cell of seams is no farther from a square than [`SURROUNDINGS`].
    pub fn surrounds(&self, key: CellKey, (x, y): Seam) -> bool {
        let (side, half) = (i64::from(self.seams), i64::from(self.seams / 2));
        let near = |v: i64, index: i32| {
            let from = i64::from(index) * side - half;
            v >= from.saturating_sub(SURROUNDINGS) && v < from.saturating_add(side + SURROUNDINGS)
        };
        near(x, key.x) && near(y, key.y)
    }
}

/// The cell of side `seam_m` under a mean.
pub fn seam(mean: &[f32; 3], seam_m: f32) -> Seam {
    ((mean[0] / seam_m).floor() as i64, (mean[1] / seam_m).floor() as i64)
}

/// Whether a square is another one or touches it.
pub fn is_beside(a: CellKey, b: CellKey) -> bool {
    a.x.abs_diff(b.x) <= 1 && a.y.abs_diff(b.y) <= 1
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_small_mission_lies_in_the_square_around_the_origin_and_no_seam_in_two() {
        let squares = Squares::new(&GroundSettings { seam_m: 2.7, cell_m: 50.0, ..Default::default() }, 1.0);
        assert!(squares.is_usable() && squares.side_m() >= 50.0 && squares.side_m() < 56.0, "{squares:?}");
        for i in -4000..4000 {
            let mean = [0.031 * i as f32, -0.017 * i as f32, 0.0];
            let (key, seam) = (squares.key(&mean), squares.seam(&mean));
            assert_eq!(key, squares.key_of(seam));
            assert!(squares.surrounds(key, seam));
            let away = DVec2::new(f64::from(mean[0]), f64::from(mean[1])) - squares.middle(key);
            assert!(away.abs().max_element() <= 0.5 * squares.side_m() + 1e-4, "{mean:?} in {key}");
        }
        assert_eq!(squares.key(&[24.0, -24.0, 0.0]), CellKey { level: 0, y: 0, x: 0 });
        // The last cell of 2.7 m beyond the border that is surroundings, and the next.
        let home = CellKey { level: 0, y: 0, x: 0 };
        let edge = i64::from(squares.seams / 2);
        assert_eq!(
            [edge, edge + SURROUNDINGS - 1, edge + SURROUNDINGS].map(|x| squares.surrounds(home, (x, 0))),
            [true, true, false]
        );
    }

    #[test]
    fn squares_grow_with_what_must_be_known_around_them() {
        let settings = GroundSettings { cell_m: 20.0, seam_m: 8.0, ..Default::default() };
        assert!(Squares::new(&settings, 0.5).side_m() >= 25.0);
        assert!(Squares::new(&settings, 100.0).side_m() >= 224.0);
    }
}
