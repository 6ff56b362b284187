//! Heights of the ground around an area.

use std::path::Path;

use fleet::ground::Ground;
use geometry::geodesy::EnuFrame;
use glam::{DVec2, DVec3};
use measure::heights::{HeightMap, Heights, MOST_PIXELS};
use models::formats::FormatError;
use survey::ortho::crs::Crs;

use super::SurveyError;

/// Around the area as much terrain is read as this, metres: lines and ways reach beyond it.
const AROUND_M: f64 = 500.0;

/// Heights of the ground around the area.
pub struct Terrain {
    heights: Heights,
    crs: Crs,
}

impl Terrain {
    /// What the map in `path` holds around `ground` and `homes`.
    ///
    /// # Errors
    /// A map that cannot be read, says not where it lies, or holds nothing of the area.
    pub fn open(path: &Path, frame: &EnuFrame, ground: &Ground, homes: &[DVec2]) -> Result<Self, SurveyError> {
        let bad = |why: String| SurveyError::File(FormatError::invalid(path, why));
        let mut map = HeightMap::open(path)?;
        let Some(code) = map.epsg() else {
            return Err(bad(
                "names no projected reference system by its EPSG code; gdalwarp -t_srs EPSG:… gives it one".into(),
            ));
        };
        let crs = Crs::projected(code, frame.origin()).map_err(|e| bad(e.to_string()))?;
        let places = ground.bounds().into_iter().chain(homes.iter().copied());
        let (low, high) = places.fold((DVec2::INFINITY, DVec2::NEG_INFINITY), |(l, h), p| (l.min(p), h.max(p)));
        let (low, high) = (low - AROUND_M, high + AROUND_M);
        let corners = [low, DVec2::new(low.x, high.y), high, DVec2::new(high.x, low.y)];
        let mut bounds = [DVec2::INFINITY, DVec2::NEG_INFINITY];
        for corner in corners {
            let at = crs.to_map(corner.extend(0.0)).map_err(|e| bad(e.to_string()))?.truncate();
            bounds = [bounds[0].min(at), bounds[1].max(at)];
        }
        let heights = map.part(bounds, MOST_PIXELS)?.ok_or_else(|| bad("holds nothing of the area".into()))?;
        Ok(Self { heights, crs })
    }

    /// Metres above the sea; `None` where the map holds none.
    pub fn height(&self, p: DVec2) -> Option<f64> {
        let at = self.crs.to_map(DVec3::new(p.x, p.y, 0.0)).ok()?;
        self.heights.height(at.truncate())
    }
}
