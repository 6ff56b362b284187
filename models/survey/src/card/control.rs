//! Surveyed points marked in pictures: OpenDroneMap's `gcp_list.txt`. Its first line is the reference system; every other line is
//! `x y z pixel-x pixel-y picture [name [sigma-horizontal sigma-vertical]]`, the standard deviations in metres being ours.

use std::path::Path;

use geometry::geodesy::Geodetic;
use glam::DVec3;

use super::record::Record;
use crate::coordinates::{Reference, cells, number, picture_name, text};
use crate::names::PictureNames;
use models::formats::FormatError;

/// A hundred thousand marks at 160 bytes each.
const LIMIT: u64 = 16 << 20;
/// No survey marks more points: each row is compared with all points before it.
const MOST_POINTS: usize = 4096;
/// What a point measured with RTK is worth where the file does not say, horizontally and vertically, metres.
const SIGMA_M: [f64; 2] = [0.03, 0.05];
/// No survey is better than this or of use beyond that, metres.
const SIGMAS_M: [f64; 2] = [0.001, 100.0];
/// Two rows nearer than this are one point, in the reference system's own unit: a millimetre, or its like in degrees.
const SAME: [f64; 2] = [1e-3, 1e-8];

/// A surveyed point.
#[derive(Clone, Debug, PartialEq)]
pub struct SurveyedPoint {
    /// Its name in the file, else its number there.
    pub name: String,
    /// Where it is, height on the scale of the pictures' heights.
    pub position: Geodetic,
    /// Standard deviation, horizontal and vertical, metres.
    pub sigma_m: [f64; 2],
    /// Pictures that show it (in lower case, as the file names them), and where: pixels of the picture as it is stored, the top left corner being
    /// (0, 0).
    pub marks: Vec<(String, [f64; 2])>,
}

/// Reads a `gcp_list.txt`; rows of one place are one point.
///
/// # Errors
/// The file cannot be read, its first line names no known reference system, or a line is no mark of a point.
pub fn read(path: &Path) -> Result<Vec<SurveyedPoint>, FormatError> {
    let text = text(path, LIMIT)?;
    let mut lines = text.lines().enumerate().filter(|(_, l)| !l.trim().is_empty() && !l.trim_start().starts_with('#'));
    let first = lines.next().map(|(_, l)| l.trim()).unwrap_or_default();
    let unknown = || format!("{first:?} names no known reference system (EPSG:CODE, WGS84 UTM 32N, +proj=…)");
    let crs = Reference::named(first).unwrap_or_else(|| Err(unknown()));
    let crs = crs.map_err(|why| FormatError::invalid(path, format!("line 1: {why}")))?;
    let same = SAME[usize::from(crs.is_in_degrees())];
    let mut points: Vec<(DVec3, SurveyedPoint)> = Vec::new();
    for (i, line) in lines {
        let bad = |what: &str| FormatError::invalid(path, format!("line {}: {what}", i + 1));
        let cells: Vec<&str> = cells(line).into_iter().filter(|c| !c.is_empty()).collect();
        let numbers: Vec<f64> = cells.iter().take(5).map_while(|cell| number(cell)).collect();
        if points.is_empty()
            && numbers.is_empty()
            && cells.len() >= 6
            && cells[0].chars().all(|c| c.is_alphabetic() || c == '_')
        {
            // The names of the columns.
            continue;
        }
        let (&[x, y, z, u, v], Some((picture, taken))) =
            (numbers.as_slice(), picture_name(cells.get(5..).unwrap_or_default()))
        else {
            return Err(bad("x, y, z, the pixel's x and y and a picture's name are needed"));
        };
        let more = &cells[5 + taken..];
        let mark = (picture.to_lowercase(), [u, v]);
        let place = DVec3::new(x, y, z);
        let known = points.iter_mut().find(|(at, _)| (*at - place).abs().max_element() < same);
        if let Some((_, point)) = known {
            point.marks.push(mark);
            continue;
        }
        if points.len() == MOST_POINTS {
            return Err(bad(&format!(
                "more than {MOST_POINTS} points; leave out those that these pictures do not show"
            )));
        }
        let position = crs.geodetic(place).ok_or_else(|| bad("is outside of its reference system"))?;
        let name = more.first().map_or_else(|| (points.len() + 1).to_string(), |name| (*name).to_owned());
        let sigma_m = [1, 2].map(|k| number(more.get(k)?).filter(|s| *s > 0.0));
        let sigma_m = [0, 1].map(|k| sigma_m[k].unwrap_or(SIGMA_M[k]).clamp(SIGMAS_M[0], SIGMAS_M[1]));
        points.push((place, SurveyedPoint { name, position, sigma_m, marks: vec![mark] }));
    }
    Ok(points.into_iter().map(|(_, point)| point).collect())
}

/// One line: how many points are marked in how many of the card's pictures; and whether all of these are here.
pub(super) fn summary(path: &Path, points: &[SurveyedPoint], records: &[Record]) -> (String, bool) {
    let names: Vec<String> = records.iter().map(|r| r.name.to_lowercase()).collect();
    let names = PictureNames::of(names.iter().map(String::as_str));
    let marks = points.iter().flat_map(|p| &p.marks);
    let (here, elsewhere): (Vec<_>, Vec<_>) = marks.partition(|(picture, _)| names.find(picture).is_some());
    let others = match elsewhere.first() {
        Some((picture, _)) => format!("; {} marks are in pictures that are not here ({picture}, …)", elsewhere.len()),
        None => String::new(),
    };
    let line = format!("{}: {} surveyed points with {} marks{others}", path.display(), points.len(), here.len());
    (line, elsewhere.is_empty())
}

#[cfg(test)]
#[allow(clippy::unwrap_used)] // a test may
mod tests {
    use super::*;

    fn read_text(text: &str) -> Result<Vec<SurveyedPoint>, FormatError> {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("gcp_list.txt");
        std::fs::write(&path, text).unwrap();
        read(&path)
    }

    #[test]
    fn rows_of_one_place_are_one_point_with_its_name_and_standard_deviations() {
        let text = "WGS84 UTM 17N\n\n333158.20\t3102916.18\t3\t2699.43\t1668.72\tDJI_0065.JPG\n\
            333158.20 3102916.18 3 2706.86 1960.27 DJI_0066.JPG\n# a note\n\
            333187.62 3102954.46 4.5 1434.68 704.34 DJI_0065.JPG church 0.01 0.02\n";
        let points = read_text(text).unwrap();
        assert_eq!(points.len(), 2);
        assert_eq!((points[0].name.as_str(), points[0].marks.len()), ("1", 2));
        assert_eq!(points[0].marks[1], ("dji_0066.jpg".to_owned(), [2706.86, 1960.27]));
        assert_eq!((points[1].name.as_str(), points[1].sigma_m, points[0].sigma_m), ("church", [0.01, 0.02], SIGMA_M));
        assert!((points[1].position.lat_deg - 28.04).abs() < 0.01 && points[1].position.alt_m == 4.5);
        // In degrees a millimetre is not a thousandth.
        let degrees = "EPSG:4326\n7.00001 46.0 400 1 2 a.jpg\n7.00002 46.0 400 3 4 a.jpg\n";
        assert_eq!(read_text(degrees).unwrap().len(), 2);
    }

    #[test]
    fn bad_lines_are_named_by_number() {
        for (text, expected) in [
            ("hello\n1 2 3 4 5 a.jpg\n", "line 1"),
            ("EPSG:4326\n7 46 400 1 2\n", "line 2"),
            ("EPSG:4326\n7 46 400 1 2 a.jpg\n7 46 nan 1 2 a.jpg\n", "line 3"),
            ("EPSG:4326\n7 146 400 1 2 a.jpg\n", "line 2: is outside"),
        ] {
            let error = read_text(text).unwrap_err().to_string();
            assert!(error.contains(expected) && !error.contains('\n'), "{text:?}: {error}");
        }
    }

    #[test]
    fn a_list_of_more_points_than_any_survey_has_is_refused_in_one_line() {
        let rows = |n: usize| (0..n).map(|i| format!("{} 46.0 400 1 2 a.jpg\n", i as f64 * 1e-3)).collect::<String>();
        assert_eq!(read_text(&format!("EPSG:4326\n{}", rows(MOST_POINTS))).unwrap().len(), MOST_POINTS);
        let error = read_text(&format!("EPSG:4326\n{}", rows(MOST_POINTS + 1))).unwrap_err().to_string();
        assert!(error.contains("line 4098: more than 4096 points") && !error.contains('\n'), "{error}");
    }
}
