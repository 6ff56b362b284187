//! `FILE.georef.json`: where on Earth the coordinates of a file are that has no room for it (PLY, SPZ, SOG, glTF).

use std::path::{Path, PathBuf};

use disk::Disk;
use geometry::geodesy::Geodetic;
use glam::DVec3;
use serde::Serialize;

use super::OrthoError;
use super::crs::Crs;
use models::formats::FormatError;

/// What a height is measured from.
pub(super) const VERTICAL: &str = "metres on the vertical scale of the origin's height, as the autopilot or the pictures gave it: \
                                   above mean sea level for most, above the WGS 84 ellipsoid for RTK receivers";
/// How far from the middle of the scene the axes of the map's grid are measured, metres.
const ARM: f64 = 100.0;

/// File coordinates (x y z 1) → others: three rows of a matrix.
pub type Rows = [[f64; 4]; 3];

/// What the file beside a scene says.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Georef {
    /// The scene's file.
    pub files: [String; 1],
    /// Reference system of `to_crs`: the UTM zone of the origin; `None` for a scene that is nowhere on Earth.
    pub crs: Option<String>,
    /// WGS-84 origin of the east-north-up frame.
    pub origin: Option<Geodetic>,
    /// What heights are measured from.
    pub vertical: &'static str,
    /// File coordinates → east, north, up in metres around the origin.
    pub to_enu: Rows,
    /// File coordinates → easting, northing, height; within a centimetre up to 300 m from the middle of the scene.
    pub to_crs: Option<Rows>,
}

impl Georef {
    /// For a file whose coordinates become east, north, up by `to_enu`; the middle of the scene is at `middle` (east, north, up).
    ///
    /// # Errors
    /// A scene outside of its own UTM zone.
    pub fn new(path: &Path, origin: Option<Geodetic>, to_enu: Rows, middle: DVec3) -> Result<Self, OrthoError> {
        let name = path.file_name().map_or_else(String::new, |n| n.to_string_lossy().into_owned());
        let crs = origin.map_or_else(|| Ok(Crs::local()), Crs::utm)?;
        let to_crs = crs.epsg().map(|_| Self::to_map(&crs, &to_enu, middle)).transpose()?;
        let code = crs.epsg().map(|code| format!("EPSG:{code}"));
        Ok(Self { files: [name], crs: code, origin, vertical: VERTICAL, to_enu, to_crs })
    }

    /// The matrix that agrees with the projection at `middle` and a little way along each axis.
    fn to_map(crs: &Crs, to_enu: &Rows, middle: DVec3) -> Result<Rows, OrthoError> {
        let at = crs.to_map(middle)?;
        let axes = [DVec3::X, DVec3::Y, DVec3::Z];
        let mut turned = [DVec3::ZERO; 3];
        for (column, axis) in turned.iter_mut().zip(axes) {
            *column = (crs.to_map(middle + ARM * axis)? - crs.to_map(middle - ARM * axis)?) / (2.0 * ARM);
        }
        let column = |k: usize| turned.iter().zip(0..3).map(|(t, r)| *t * to_enu[r][k]).sum::<DVec3>();
        let start = at + (0..3).map(|r| turned[r] * (to_enu[r][3] - middle[r])).sum::<DVec3>();
        let columns = [column(0), column(1), column(2), start];
        Ok([0, 1, 2].map(|r| columns.map(|c| c[r])))
    }

    /// `scene.sog` → `scene.sog.georef.json`.
    pub fn path(scene: &Path) -> PathBuf {
        let mut name = scene.as_os_str().to_owned();
        name.push(".georef.json");
        name.into()
    }

    /// Writes it beside `scene`.
    ///
    /// # Errors
    /// The operating system's.
    pub fn write(&self, scene: &Path) -> Result<PathBuf, FormatError> {
        let path = Self::path(scene);
        let fill = |out: &mut dyn std::io::Write| Ok(serde_json::to_writer_pretty(out, self)?);
        Disk::default().replace(&path, fill).map_err(|e| FormatError::disk(&path, e))?;
        Ok(path)
    }
}

/// The identity, moved by `shift`.
pub fn shifted(shift: [f64; 3]) -> Rows {
    [[1.0, 0.0, 0.0, shift[0]], [0.0, 1.0, 0.0, shift[1]], [0.0, 0.0, 1.0, shift[2]]]
}

/// Of a file whose y points up and z south.
pub const FROM_Y_UP: Rows = [[1.0, 0.0, 0.0, 0.0], [0.0, 0.0, -1.0, 0.0], [0.0, 1.0, 0.0, 0.0]];

#[cfg(test)]
mod tests {
    use super::*;

    fn through(rows: &Rows, p: DVec3) -> DVec3 {
        DVec3::from_array(rows.map(|r| DVec3::new(r[0], r[1], r[2]).dot(p) + r[3]))
    }

    #[test]
    fn file_coordinates_reach_the_map_within_a_centimetre() {
        let origin = Geodetic { lat_deg: 53.38, lon_deg: -1.47, alt_m: 80.0 };
        let crs = Crs::utm(origin).unwrap();
        let middle = DVec3::new(120.0, -40.0, 5.0);
        for to_enu in [shifted([0.0; 3]), shifted([120.0, -40.0, 3.0]), FROM_Y_UP] {
            let georef = Georef::new(Path::new("a/scene.sog"), Some(origin), to_enu, middle).unwrap();
            assert_eq!((georef.files[0].as_str(), georef.crs.as_deref()), ("scene.sog", Some("EPSG:32630")));
            for p in [DVec3::ZERO, DVec3::new(200.0, 150.0, -30.0), DVec3::new(-100.0, 60.0, 12.0)] {
                let map = through(&georef.to_crs.unwrap(), p);
                let exact = crs.to_map(through(&to_enu, p)).unwrap();
                assert!((map - exact).length() < 0.01, "{map} for {exact}");
            }
        }
    }

    #[test]
    fn a_scene_that_is_nowhere_on_earth_says_so() {
        let georef = Georef::new(Path::new("m.ply"), None, shifted([0.0; 3]), DVec3::ZERO).unwrap();
        assert_eq!((georef.crs, georef.origin, georef.to_crs), (None, None, None));
    }
}
