//! The reference system of a map: a projection of the Earth, or the scene's own metres where it is nowhere on Earth.

use geometry::geodesy::{EnuFrame, Geodetic};
use glam::DVec3;
use proj4rs::Proj;
use proj4rs::transform::transform;

use super::OrthoError;
use crate::coordinates::{UTM_NORTH, UTM_SOUTH, definition, geographic};

/// Northern and southern limit of the UTM zones, degrees.
const UTM_LATITUDES: std::ops::Range<f64> = -80.0..84.0;
/// Model coordinates (east, north, up in metres around the origin) ↔ map coordinates (easting and northing in the
/// projection's metres, height on the origin's own vertical scale).
pub struct Crs {
    epsg: Option<u16>,
    earth: Option<Earth>,
}

struct Earth {
    frame: EnuFrame,
    geographic: Proj,
    projected: Proj,
}

impl Crs {
    /// The scene's own metres: x east, y north where the scene knows where that is.
    pub fn local() -> Self {
        Self { epsg: None, earth: None }
    }

    /// The UTM zone of the origin on WGS 84; [`Crs::local`] beyond the zones.
    ///
    /// # Errors
    /// None in practice: the library knows UTM.
    pub fn utm(origin: Geodetic) -> Result<Self, OrthoError> {
        if !origin.is_valid() || !UTM_LATITUDES.contains(&origin.lat_deg) {
            return Ok(Self::local());
        }
        let zone = ((origin.lon_deg + 180.0) / 6.0).floor().rem_euclid(60.0) as u16 + 1;
        Self::projected(if origin.lat_deg < 0.0 { UTM_SOUTH } else { UTM_NORTH } + zone, origin)
    }

    /// A projected reference system in metres by its EPSG code.
    ///
    /// # Errors
    /// [`OrthoError::Epsg`] for a code that is not known, that is in degrees or not in metres.
    pub fn projected(code: u16, origin: Geodetic) -> Result<Self, OrthoError> {
        let refused = |why| OrthoError::Epsg { code, why };
        let projected = definition(code).map_err(refused)?;
        if projected.is_latlong() || projected.is_geocent() {
            return Err(refused("is in degrees or geocentric; maps are drawn in projected metres"));
        }
        if projected.to_meter() != 1.0 {
            return Err(refused("is not in metres"));
        }
        let geographic = geographic().ok_or_else(|| refused("cannot be reached from WGS 84"))?;
        let crs = Self { epsg: Some(code), earth: Some(Earth { frame: EnuFrame::new(origin), geographic, projected }) };
        crs.to_map(DVec3::ZERO).map_err(|_| refused("does not hold where the model is"))?;
        Ok(crs)
    }

    /// Its code; `None` for the scene's own metres.
    pub fn epsg(&self) -> Option<u16> {
        self.epsg
    }

    /// Model → map.
    ///
    /// # Errors
    /// [`OrthoError::Outside`] where the projection has no answer.
    pub fn to_map(&self, enu: DVec3) -> Result<DVec3, OrthoError> {
        let Some(earth) = &self.earth else { return Ok(enu) };
        let place = earth.frame.to_geodetic(enu);
        let mut p = (place.lon_deg.to_radians(), place.lat_deg.to_radians(), 0.0);
        let outside = || OrthoError::Outside { east_m: enu.x, north_m: enu.y };
        transform(&earth.geographic, &earth.projected, &mut p).map_err(|_| outside())?;
        let map = DVec3::new(p.0, p.1, place.alt_m);
        if map.is_finite() { Ok(map) } else { Err(outside()) }
    }

    /// Map → model.
    ///
    /// # Errors
    /// [`OrthoError::Outside`] where the projection has no answer.
    pub fn to_enu(&self, map: DVec3) -> Result<DVec3, OrthoError> {
        let Some(earth) = &self.earth else { return Ok(map) };
        let mut p = (map.x, map.y, 0.0);
        let outside = || OrthoError::Outside { east_m: map.x, north_m: map.y };
        transform(&earth.projected, &earth.geographic, &mut p).map_err(|_| outside())?;
        let place = Geodetic { lat_deg: p.1.to_degrees(), lon_deg: p.0.to_degrees(), alt_m: map.z };
        let enu = earth.frame.to_enu(place);
        if enu.is_finite() { Ok(enu) } else { Err(outside()) }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// What PROJ 9.5 gives (pyproj, EPSG:4326 → EPSG:326xx/327xx).
    const PROJ: [(f64, f64, u16, f64, f64); 3] = [
        (53.38, -1.47, 32_630, 601_771.608_032_64, 5_915_634.473_550_58),
        (28.04, -82.7, 32_617, 332_899.692_094_37, 3_102_798.949_505_23),
        (-37.84, 144.95, 32_755, 319_615.521_262_50, 5_809_956.954_686_53),
    ];

    #[test]
    fn the_scenes_own_zone_is_taken_and_agrees_with_proj_to_a_tenth_of_a_millimetre() {
        for (lat_deg, lon_deg, code, east, north) in PROJ {
            let crs = Crs::utm(Geodetic { lat_deg, lon_deg, alt_m: 12.0 }).unwrap();
            assert_eq!(crs.epsg(), Some(code));
            let p = crs.to_map(DVec3::ZERO).unwrap();
            assert!((p - DVec3::new(east, north, 12.0)).length() < 1e-4, "{p} for {code}");
        }
    }

    #[test]
    fn map_and_model_are_each_others_inverse() {
        for (lat_deg, lon_deg, ..) in PROJ {
            let crs = Crs::utm(Geodetic { lat_deg, lon_deg, alt_m: -3.0 }).unwrap();
            for p in [DVec3::new(300.0, -1200.0, 40.0), DVec3::new(-5000.0, 20.0, -9.0)] {
                let back = crs.to_enu(crs.to_map(p).unwrap()).unwrap();
                assert!((back - p).length() < 1e-5, "{back}");
            }
        }
    }

    #[test]
    fn a_scene_that_is_nowhere_on_earth_is_drawn_in_its_own_metres() {
        let crs = Crs::utm(Geodetic { lat_deg: 89.0, lon_deg: 0.0, alt_m: 0.0 }).unwrap();
        assert_eq!(crs.epsg(), None);
        let p = DVec3::new(1.0, 2.0, 3.0);
        assert_eq!((crs.to_map(p).unwrap(), crs.to_enu(p).unwrap()), (p, p));
    }

    #[test]
    fn codes_that_make_no_map_are_refused_in_one_line() {
        let origin = Geodetic { lat_deg: 53.38, lon_deg: -1.47, alt_m: 0.0 };
        for code in [0, 4326, 32_600, u16::MAX] {
            let Err(e) = Crs::projected(code, origin) else { panic!("{code} is taken") };
            assert!(e.to_string().starts_with(&format!("EPSG:{code}: ")), "{e}");
        }
    }
}
