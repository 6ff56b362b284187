//! Cells of ground: squares of the mission's ENU frame, the unit in which a scene is paged, delivered and merged.

use std::fmt;
use std::str::FromStr;

use serde::{Deserialize, Serialize};

/// Cells of the coarsest level are 2^12 times as wide as those of the finest.
pub const MOST_LEVEL: u8 = 12;
/// Most that a Gaussian reaches beyond its cell, in sides of it: what is added around every cell wherever it may show.
const MOST_REACH: f32 = 0.25;

/// A square of ground: side · 2^level metres wide, the x-th to the east and the y-th to the north.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
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

/// `level/x/y`.
impl fmt::Display for CellKey {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}/{}/{}", self.level, self.x, self.y)
    }
}

impl FromStr for CellKey {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let wrong = || format!("{text:?}: must be LEVEL/X/Y, as in 0/-1/2");
        let mut parts = text.split('/');
        let mut part = || parts.next().ok_or_else(wrong);
        let (level, x, y) = (part()?, part()?, part()?);
        let level = level.parse().ok().filter(|l| *l <= MOST_LEVEL).ok_or_else(wrong)?;
        let key = Self { level, x: x.parse().map_err(|_| wrong())?, y: y.parse().map_err(|_| wrong())? };
        if parts.next().is_none() { Ok(key) } else { Err(wrong()) }
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

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_key_is_read_as_it_is_written() {
        let key = CellKey { level: 0, y: 2, x: -1 };
        assert_eq!(key.to_string(), "0/-1/2");
        assert_eq!("0/-1/2".parse(), Ok(key));
        for bad in ["", "0/1", "0/1/2/3", "13/0/0", "0/1.5/2", "0/99999999999/0"] {
            assert!(bad.parse::<CellKey>().is_err_and(|e| e.contains("LEVEL/X/Y")), "{bad}");
        }
    }
}
