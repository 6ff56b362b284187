//! Surveyed points that a map is measured against: OpenDroneMap's `gcp_list.txt` (the first line is the reference system) or
//! a table whose first line names its columns.

use std::path::Path;

use geometry::geodesy::{EnuFrame, Geodetic};
use glam::DVec3;

use crate::coordinates::{Reference, cells, number, text};
use models::formats::FormatError;

/// Far more points than anybody surveys.
const LIMIT: u64 = 16 << 20;
/// Two rows nearer than this are one point, seen in two pictures.
const SAME_M: f64 = 1e-3;

/// Reads the points' places in the model's frame; those of one place once. `origin` is the model's.
///
/// Columns of a table: `lat`, `lon`, `alt` (degrees, metres), or `x`, `y`, `z` in the model's own metres.
///
/// # Errors
/// The file cannot be read, a line of it is no point, or it says where on Earth and the model does not.
pub fn read(path: &Path, origin: Option<Geodetic>) -> Result<Vec<DVec3>, FormatError> {
    let text = text(path, LIMIT)?;
    let mut lines = text.lines().enumerate().filter(|(_, l)| !l.trim().is_empty() && !l.trim_start().starts_with('#'));
    let first = lines.next().map(|(_, l)| l.trim()).unwrap_or_default();
    let table = Columns::of(first);
    let frame = origin.map(EnuFrame::new);
    let nowhere =
        || FormatError::invalid(path, "says where on Earth its points are, and the model has no origin there");
    let survey = match (&table, &frame) {
        (None, _) => {
            let unknown = || {
                format!(
                    "{first:?} names neither columns (lat, lon, alt or x, y, z) nor a reference system (EPSG:CODE, WGS84 UTM 32N, +proj=…)"
                )
            };
            let known = Reference::named(first).unwrap_or_else(|| Err(unknown()));
            Some(known.map_err(|why| FormatError::invalid(path, format!("line 1: {why}")))?)
        }
        (Some(_), _) => None,
    };
    let mut points: Vec<DVec3> = Vec::new();
    for (i, line) in lines {
        let bad = |what: &str| FormatError::invalid(path, format!("line {}: {what}", i + 1));
        let numbers = match &table {
            Some(columns) => columns.pick(line),
            None => three(cells(line).into_iter()),
        };
        let p = numbers.ok_or_else(|| bad("three finite numbers are needed"))?;
        let place = match (&table, &survey) {
            (Some(columns), _) if !columns.geodetic => Some(p),
            (_, Some(survey)) => {
                let at = survey.geodetic(p).ok_or_else(|| bad("is outside of its reference system"))?;
                Some(frame.as_ref().ok_or_else(nowhere)?.to_enu(at))
            }
            _ => {
                let at = Geodetic { lat_deg: p.x, lon_deg: p.y, alt_m: p.z };
                let frame = frame.as_ref().ok_or_else(nowhere)?;
                at.is_valid().then(|| frame.to_enu(at))
            }
        };
        let place = place.filter(|p| p.is_finite()).ok_or_else(|| bad("is nowhere on Earth"))?;
        if !points.iter().rev().take(64).any(|p| p.distance(place) < SAME_M) {
            points.push(place);
        }
    }
    Ok(points)
}

/// Where a table has its coordinates.
struct Columns {
    at: [usize; 3],
    geodetic: bool,
}

impl Columns {
    fn of(line: &str) -> Option<Self> {
        let names: Vec<String> =
            cells(line).iter().map(|c| c.trim_start_matches('#').trim().to_ascii_lowercase()).collect();
        let find = |wanted: [&[&str]; 3]| -> Option<[usize; 3]> {
            let at = wanted.map(|known| names.iter().position(|n| known.contains(&n.as_str())));
            Some([at[0]?, at[1]?, at[2]?])
        };
        let geodetic = find([
            &["lat", "lat_deg", "latitude"],
            &["lon", "lon_deg", "longitude"],
            &["alt", "alt_m", "altitude", "height"],
        ]);
        let own = || find([&["x", "east"], &["y", "north"], &["z", "up"]]);
        let is_geodetic = geodetic.is_some();
        Some(Self { at: geodetic.or_else(own)?, geodetic: is_geodetic })
    }

    fn pick(&self, line: &str) -> Option<DVec3> {
        let cells = cells(line);
        three(self.at.iter().filter_map(|i| cells.get(*i).copied()))
    }
}

fn three<'a>(mut cells: impl Iterator<Item = &'a str>) -> Option<DVec3> {
    let mut next = || number(cells.next()?);
    Some(DVec3::new(next()?, next()?, next()?))
}

#[cfg(test)]
mod tests {
    use super::*;

    const ORIGIN: Geodetic = Geodetic { lat_deg: 28.041_587_945, lon_deg: -82.697_570_951, alt_m: -69.7 };

    fn points(text: &str, origin: Option<Geodetic>) -> Result<Vec<DVec3>, FormatError> {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("points.txt");
        std::fs::write(&path, text).unwrap();
        read(&path, origin)
    }

    #[test]
    fn a_gcp_list_gives_each_of_its_points_once() {
        for head in ["+proj=utm +zone=17 +ellps=WGS84 +datum=WGS84 +units=m +no_defs", "WGS84 UTM 17N", "EPSG:32617"] {
            let text = format!(
                "{head}\n333158.20 3102916.18 3 2699.43 1668.72 DJI_0065.JPG\n333158.20 3102916.18 3 2706.86 1960.27 \
                 DJI_0066.JPG\n\n333100 3102900 4.5 1 1 DJI_0067.JPG first\n"
            );
            let got = points(&text, Some(ORIGIN)).unwrap();
            assert_eq!(got.len(), 2, "{head}");
            // pyproj and pymap3d: EPSG:32617 → geodetic → ENU at the origin.
            let want = DVec3::new(18.026_548, -55.146_767, 72.699_735);
            assert!((got[0] - want).length() < 2e-3, "{head}: {}", got[0]);
        }
    }

    #[test]
    fn tables_name_their_columns() {
        let table = "name,lat_deg,lon_deg,alt_m\na,28.041587945,-82.697570951,-69.7\n";
        assert!(points(table, Some(ORIGIN)).unwrap()[0].length() < 1e-6);
        assert_eq!(
            points("x y z\n1 2 3\n4 5 6\n", None).unwrap(),
            [DVec3::new(1.0, 2.0, 3.0), DVec3::new(4.0, 5.0, 6.0)]
        );
    }

    #[test]
    fn what_is_no_point_is_refused_with_its_line() {
        for (text, origin, word) in [
            ("hello\n1 2 3\n", Some(ORIGIN), "line 1"),
            ("x,y,z\n1,2\n", None, "line 2"),
            ("x,y,z\n1,2,nan\n", None, "line 2"),
            ("lat,lon,alt\n95,0,0\n", Some(ORIGIN), "line 2"),
            ("lat,lon,alt\n45,0,0\n", None, "no origin"),
            ("EPSG:32617\n333158 3102916 3\n", None, "no origin"),
            ("", None, "line 1"),
        ] {
            let e = points(text, origin).unwrap_err().to_string();
            assert!(e.contains(word) && e.contains("points.txt"), "{text:?}: {e}");
        }
    }
}
