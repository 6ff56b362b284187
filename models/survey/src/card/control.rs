//! Surveyed points marked in pictures: OpenDroneMap's `gcp_list.txt`. Its first line is the reference system; every other line is
//! `x y z pixel-x pixel-y picture [name [sigma-horizontal sigma-vertical]]`, the standard deviations in metres being ours. A point whose
//! name begins with `CHK` measures the finished model and does not hold it; one with `VVA` in its place or behind it lies under vegetation.

use std::path::Path;

use geometry::geodesy::Geodetic;
use glam::DVec3;

use super::record::Record;
pub use super::record::UNKNOWN_HEIGHT_SIGMA_M;
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
    /// Which of the two the file says.
    pub is_sigma_stated: [bool; 2],
    /// Pictures that show it (in lower case, as the file names them), and where: pixels of the picture as it is stored, the top left corner being
    /// (0, 0).
    pub marks: Vec<(String, [f64; 2])>,
}

impl SurveyedPoint {
    /// Whether it measures the finished model instead of helping it: its name begins with `CHK`, as in `CHK-12`.
    pub fn is_check(&self) -> bool {
        is_check(&self.name)
    }

    /// Whether both lie within a millimetre of each other in the plane: their heights may be from two datums.
    pub(super) fn is_at(&self, other: &Self) -> bool {
        let (a, b) = (self.position, other.position);
        (a.lat_deg - b.lat_deg).abs() < SAME[1] && (a.lon_deg - b.lon_deg).abs() < SAME[1]
    }

    /// Takes what a row says of its standard deviations.
    fn state(&mut self, sigma: [Option<f64>; 2]) {
        for (k, sigma) in sigma.into_iter().enumerate() {
            if let Some(sigma) = sigma {
                (self.sigma_m[k], self.is_sigma_stated[k]) = (sigma.clamp(SIGMAS_M[0], SIGMAS_M[1]), true);
            }
        }
    }

    /// Whether its height is known; it is not where it contradicts the pictures'.
    pub fn has_height(&self) -> bool {
        self.sigma_m[1] < UNKNOWN_HEIGHT_SIGMA_M
    }

    /// Whether vegetation hides the ground there: its name, `CHK` aside, begins with `VVA` (vegetated vertical accuracy), as the ASPRS
    /// standard has it.
    pub fn is_vegetated(&self) -> bool {
        let name = unchecked(&self.name).unwrap_or(&self.name);
        after(name, "VVA").is_some_and(|rest| !rest.starts_with(char::is_alphabetic))
    }
}

fn is_check(name: &str) -> bool {
    unchecked(name).is_some()
}

/// The name of a check point without what makes it one.
fn unchecked(name: &str) -> Option<&str> {
    let all = after(name, "CHK")?;
    let rest = all.trim_start_matches(['-', '_', '.']);
    let is_word = all.starts_with(char::is_alphabetic) && after(rest, "VVA").is_none();
    (!is_word).then_some(rest)
}

/// Takes the points of another list among those `known`, and returns how many of them were known. Such a point has the marks of both lists,
/// and measures the model where either says so.
pub(super) fn join(known: &mut Vec<SurveyedPoint>, points: Vec<SurveyedPoint>) -> usize {
    let mut twice = 0;
    for point in points {
        let Some(there) = known.iter_mut().find(|k| k.is_at(&point)) else {
            known.push(point);
            continue;
        };
        twice += 1;
        if point.is_check() && !there.is_check() {
            there.name.clone_from(&point.name);
        }
        for mark in point.marks {
            if !there.marks.contains(&mark) {
                there.marks.push(mark);
            }
        }
    }
    twice
}

/// One line on points that may have been meant to check and hold the model: their names are words that begin with `CHK`.
pub(super) fn doubtful_names(control: &[SurveyedPoint]) -> Option<String> {
    let names: Vec<&str> =
        control.iter().map(|p| p.name.as_str()).filter(|n| after(n, "CHK").is_some() && !is_check(n)).collect();
    let first = names.first()?;
    Some(format!(
        "{} surveyed points hold the model although their names begin with CHK ({first}{}); CHK-1 would measure it",
        names.len(),
        if names.len() > 1 { ", …" } else { "" }
    ))
}

/// What follows `word`, in capitals or small letters, where a name begins with it.
fn after<'n>(name: &'n str, word: &str) -> Option<&'n str> {
    let (first, rest) = name.split_at_checked(word.len())?;
    first.eq_ignore_ascii_case(word).then_some(rest)
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
        let named = more.first().copied();
        let sigma = [1, 2].map(|k| number(more.get(k)?).filter(|s| *s > 0.0));
        if let Some((_, point)) = known {
            point.marks.push(mark);
            if let Some(name) = named.filter(|n| is_check(n) != point.is_check()) {
                let what = format!("{name:?} and {:?} are one place: a check point or not?", point.name);
                return Err(bad(&what));
            }
            point.state(sigma);
            continue;
        }
        if points.len() == MOST_POINTS {
            return Err(bad(&format!(
                "more than {MOST_POINTS} points; leave out those that these pictures do not show"
            )));
        }
        let position = crs.geodetic(place).ok_or_else(|| bad("is outside of its reference system"))?;
        let name = named.map_or_else(|| (points.len() + 1).to_string(), str::to_owned);
        let (sigma_m, is_sigma_stated, marks) = (SIGMA_M, [false; 2], vec![mark]);
        let mut point = SurveyedPoint { name, position, sigma_m, is_sigma_stated, marks };
        point.state(sigma);
        points.push((place, point));
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
        assert_eq!((points[1].is_sigma_stated, points[0].is_sigma_stated), ([true; 2], [false; 2]));
        assert!((points[1].position.lat_deg - 28.04).abs() < 0.01 && points[1].position.alt_m == 4.5);
        // In degrees a millimetre is not a thousandth.
        let degrees = "EPSG:4326\n7.00001 46.0 400 1 2 a.jpg\n7.00002 46.0 400 3 4 a.jpg\n";
        assert_eq!(read_text(degrees).unwrap().len(), 2);
    }

    #[test]
    fn a_points_name_says_that_it_checks_and_that_it_lies_under_vegetation() {
        let point = |name: &str| {
            let points = read_text(&format!("EPSG:4326\n7 46 400 1 2 a.jpg {name}\n")).unwrap();
            (points[0].is_check(), points[0].is_vegetated())
        };
        for name in ["CHK-1", "chk_7", "CHK12", "Chk", "CHK.a"] {
            assert_eq!(point(name), (true, false), "{name}");
        }
        for (name, expected) in [
            ("CHK-VVA-3", (true, true)),
            ("chk_vva1", (true, true)),
            ("CHKVVA1", (true, true)),
            ("VVA-2", (false, true)),
        ] {
            assert_eq!(point(name), expected, "{name}");
        }
        for name in ["gcp1", "checker", "chkalpha", "church", "vvalley", "é"] {
            assert_eq!(point(name), (false, false), "{name}");
        }
    }

    #[test]
    fn a_point_of_two_lists_is_one_and_what_its_rows_say_adds_up_or_is_refused() {
        let list = "EPSG:4326\n7 46 400 1 2 a.jpg p\n7 46 400 3 4 b.jpg p 0.01\n7.1 46 400 1 2 a.jpg q\n";
        let mut known = read_text(list).unwrap();
        assert_eq!((known[0].sigma_m, known[0].is_sigma_stated), ([0.01, SIGMA_M[1]], [true, false]));
        let other =
            read_text("EPSG:4326\n7 46 400 1 2 a.jpg x\n7 46 400 5 6 c.jpg x\n7.2 46 400 1 2 a.jpg r\n").unwrap();
        assert_eq!(join(&mut known, other), 1);
        let marks: Vec<usize> = known.iter().map(|p| p.marks.len()).collect();
        assert_eq!((known[0].name.as_str(), marks), ("p", vec![3, 1, 1]));
        // Of another height, and a check point there.
        let other = read_text("EPSG:4326\n7.1 46 447 1 2 a.jpg CHK-q\n").unwrap();
        assert_eq!((join(&mut known, other), known.len(), known[1].is_check()), (1, 3, true));
        let error = read_text("EPSG:4326\n7 46 400 1 2 a.jpg p\n7 46 400 3 4 b.jpg CHK-1\n").unwrap_err().to_string();
        assert!(error.contains("line 3") && error.contains("a check point or not?"), "{error}");
        assert!(doubtful_names(&known).is_none());
        known[0].name = "CHKPT-1".into();
        assert!(doubtful_names(&known).unwrap().contains("CHKPT-1)"));
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
