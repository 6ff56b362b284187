//! Cells of ground: squares of the mission's ENU frame, the unit in which a scene is paged and delivered.

/// Cells of the coarsest level are 2^12 times as wide as those of the finest.
pub const MOST_LEVEL: u8 = 12;
/// Most that a Gaussian reaches beyond its cell, in sides of it: what is added around every cell wherever it may show.
const MOST_REACH: f32 = 0.25;

/// A square of ground: side · 2^level metres wide, the x-th to the east and the y-th to the north.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub struct CellKey {
    /// Power of two of the side.
    pub level: u8,
    /// To the north.
    pub y: i32,
    /// To the east.
    pub x: i32,
}

impl CellKey {
    /// The cell of the next level that this one is a quarter of.
    pub fn parent(self) -> Self {
        Self { level: self.level + 1, y: self.y >> 1, x: self.x >> 1 }
    }
}

/// The squares of a scene.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Grid {
    /// Metres of a cell of level 0.
    pub side: f32,
}

impl Grid {
    /// The cell under a mean, of the finest level that is wide enough for the Gaussian's reach: what is large does not make its
    /// neighbours show in pictures that do not see them.
    pub fn key(&self, mean: [f32; 3], reach: f32) -> CellKey {
        let level = (0..MOST_LEVEL).find(|l| reach <= MOST_REACH * self.side_at(*l)).unwrap_or(MOST_LEVEL);
        // Casts saturate: what lies beyond 2³¹ cells shares the last.
        let index = |v: f32| (v / self.side_at(level)).floor() as i32;
        CellKey { level, y: index(mean[1]), x: index(mean[0]) }
    }

    /// Metres of a cell of this level.
    pub fn side_at(&self, level: u8) -> f32 {
        self.side * f32::from(1u16 << level)
    }

    /// Whether a Gaussian still counts to `key`: within half a cell around it and not twice as large as it should be, so that
    /// those on the border stay where they are.
    pub fn holds(&self, key: CellKey, mean: [f32; 3], reach: f32) -> bool {
        let side = self.side_at(key.level);
        let within = |v: f32, index: i32| {
            let from = index as f32 * side;
            v >= from - 0.5 * side && v < from + 1.5 * side
        };
        within(mean[0], key.x)
            && within(mean[1], key.y)
            && (reach <= 2.0 * MOST_REACH * side || key.level == MOST_LEVEL)
    }
}
