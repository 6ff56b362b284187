//! Files of positions: OpenDroneMap's `geo.txt`, Mission Planner's geotag list, our own `geotags.csv`, anything else whose first line
//! names its columns.

use std::path::Path;

use geometry::geodesy::Geodetic;
use glam::{DQuat, DVec3};

use super::record::{
    Attitude, AttitudeSource, FROM_HORIZON_DEG, Fix, GPS_SIGMA_M, Record, UNKNOWN_HEIGHT_SIGMA_M, nadir_rotation,
};
use crate::coordinates::{self, Reference, cells, number, picture_name};
use crate::names::PictureNames;
use models::formats::FormatError;
use models::formats::telemetry::dji_rotation;
use models::picture::Orientation;

/// A hundred thousand pictures at 600 bytes each.
const LIMIT: u64 = 64 << 20;

/// What a file says of one picture.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Geotag {
    /// Position with its standard deviations.
    pub fix: Fix,
    /// Whether the file says its height, too.
    pub has_height: bool,
    /// Attitude, where the file has one.
    pub attitude: Option<Attitude>,
}

/// Reads a file of positions: tags by what it calls the pictures, in lower case.
///
/// # Errors
/// The file cannot be read, names no columns that are understood, or a line is no number where one must be.
pub fn read(path: &Path) -> Result<Vec<(String, Geotag)>, FormatError> {
    let text = coordinates::text(path, LIMIT)?;
    let mut lines = text.lines().enumerate().filter(|(_, l)| !l.trim().is_empty()).peekable();
    if lines.peek().is_none() {
        return Err(FormatError::invalid(path, "is empty"));
    }
    // Metashape names the reference system in a comment before the columns.
    let (mut reference, mut columns) = (None, None);
    while let Some((number, line)) = lines.peek().copied() {
        if let Some(named) = Columns::named(line) {
            columns = Some(named);
            lines.next();
            break;
        }
        match Reference::named(line) {
            Some(Ok(known)) => reference = Some(known),
            Some(Err(why)) => return Err(FormatError::invalid(path, format!("line {}: {why}", number + 1))),
            None if line.trim_start().starts_with('#') => {}
            None => break,
        }
        lines.next();
    }
    let is_table = columns.is_some();
    let columns = match (columns, &reference) {
        (Some(columns), _) => columns,
        (None, Some(_)) => Columns::of_geo_txt(),
        (None, None) => {
            let what = "its first line is neither a projection (EPSG:4326, WGS84 UTM 32N) nor names columns for picture, latitude, longitude and altitude";
            return Err(FormatError::invalid(path, what));
        }
    };
    let mut tags = Vec::new();
    for (at, line) in lines.filter(|(_, l)| !l.trim_start().starts_with('#')) {
        let mut cells = cells(line);
        let named = if is_table { None } else { picture_name(&cells) };
        if let Some((_, taken)) = &named {
            // Blanks in a picture's name are none between columns.
            cells.drain(1..*taken);
        }
        let bad = |what: &str| FormatError::invalid(path, format!("line {}: {what}", at + 1));
        let cell = |i: Option<usize>| i.and_then(|i| cells.get(i)).map(|c| c.trim()).filter(|c| !c.is_empty());
        let value = |i: Option<usize>| -> Result<Option<f64>, FormatError> {
            let Some(c) = cell(i) else { return Ok(None) };
            number(c).map(Some).ok_or_else(|| bad(&format!("{c:?} is not a number")))
        };
        let name = named.map(|n| n.0).or_else(|| cell(Some(columns.name)).map(str::to_owned));
        let Some(name) = name else { return Err(bad("names no picture")) };
        let (Some(x), Some(y)) = (value(Some(columns.x))?, value(Some(columns.y))?) else {
            return Err(bad("has no position"));
        };
        let alt_m = value(columns.alt)?;
        let position = match &reference {
            Some(reference) => reference.geodetic(DVec3::new(x, y, alt_m.unwrap_or_default())),
            None => Some(Geodetic { lat_deg: y, lon_deg: x, alt_m: alt_m.unwrap_or_default() }),
        };
        let Some(position) = position.filter(Geodetic::is_valid) else {
            return Err(bad(&format!(
                "{y}, {x} is not a position on the earth; a table in metres needs a line EPSG:CODE before it"
            )));
        };
        let three = |of: [Option<usize>; 3]| -> Result<Option<[f64; 3]>, FormatError> {
            Ok(match (value(of[0])?, value(of[1])?, value(of[2])?) {
                (Some(a), Some(b), Some(c)) => Some([a, b, c]),
                _ => None,
            })
        };
        let horizontal = value(columns.sigma[0])?.filter(|s| *s > 0.0).unwrap_or(GPS_SIGMA_M);
        let vertical = value(columns.sigma[1])?.filter(|s| *s > 0.0).unwrap_or(horizontal);
        let vertical = if alt_m.is_some() { vertical } else { UNKNOWN_HEIGHT_SIGMA_M };
        let attitude = match (three([columns.q[1], columns.q[2], columns.q[3]])?, value(columns.q[0])?) {
            (Some([x, y, z]), Some(w)) => {
                let q = DQuat::from_xyzw(x, y, z, w);
                if !(0.9..1.1).contains(&q.length()) {
                    return Err(bad("qw qx qy qz is not a rotation"));
                }
                Some(Attitude { rotation: q.normalize(), source: AttitudeSource::Gimbal })
            }
            // No mapping camera looks back: a pitch like that is measured from the horizon, as in XMP.
            _ => three(columns.angles)?.map(|[y, p, r]| match p < FROM_HORIZON_DEG {
                true => Attitude { rotation: dji_rotation(y, p, r), source: AttitudeSource::Gimbal },
                false => Attitude {
                    rotation: nadir_rotation(y, p, r),
                    source: if is_table { AttitudeSource::Airframe } else { AttitudeSource::Gimbal },
                },
            }),
        };
        let fix = Fix { position, sigma_m: [horizontal, vertical] };
        tags.push((name.to_lowercase(), Geotag { fix, has_height: alt_m.is_some(), attitude }));
    }
    Ok(tags)
}

/// Gives the pictures their tags, which count more than what the pictures say; one line about it, and whether every picture has one.
///
/// # Errors
/// The file's positions are nowhere near those of the pictures themselves.
pub(super) fn apply(
    file: &Path,
    tags: &[(String, Geotag)],
    records: &mut [Record],
) -> Result<(String, bool), FormatError> {
    let paths: Vec<String> = records.iter().map(|r| r.path.to_string_lossy().to_lowercase()).collect();
    let names = PictureNames::of(paths.iter().map(String::as_str));
    let found = names.pair(tags.iter().map(|(name, _)| name.as_str()));
    let pairs: Vec<(usize, &Geotag)> =
        found.into_iter().zip(tags).filter_map(|(i, (_, tag))| Some((i?, tag))).collect();
    let stated = pairs.iter().filter_map(|(i, tag)| Some((records[*i].fix?.position, tag.fix.position)));
    super::sources::near_what_pictures_say(file, &stated.collect::<Vec<_>>())?;
    for (i, tag) in &pairs {
        let r = &mut records[*i];
        match (tag.has_height, &mut r.fix) {
            // The picture's own height is better than none.
            (false, Some(fix)) => {
                let alt_m = fix.position.alt_m;
                fix.position = Geodetic { alt_m, ..tag.fix.position };
                fix.sigma_m[0] = tag.fix.sigma_m[0];
            }
            _ => {
                r.fix = Some(tag.fix);
                // Heights above take-off belong to another scale than a file's.
                r.relative_alt_m = None;
            }
        }
        if tag.attitude.is_some() {
            r.attitude = tag.attitude;
            r.orientation = Orientation::default();
        }
    }
    let line = format!(
        "{}: positions of {} of {} pictures ({} lines)",
        file.display(),
        pairs.len(),
        records.len(),
        tags.len()
    );
    Ok((line, pairs.len() == records.len()))
}

/// As [`apply`] for a film's subtitles; `None` where no picture is a frame of the film.
pub(super) fn apply_to_some(file: &Path, tags: &[(String, Geotag)], records: &mut [Record]) -> Option<String> {
    let names: Vec<String> = records.iter().map(|r| r.name.to_lowercase()).collect();
    let names = PictureNames::of(names.iter().map(String::as_str));
    let is_any = tags.iter().any(|(name, _)| names.find(name).is_some());
    is_any.then(|| apply(file, tags, records).map_or_else(|e| e.to_string(), |(line, _)| line))
}

/// Where what stands.
#[derive(Debug, Default)]
struct Columns {
    name: usize,
    x: usize,
    y: usize,
    alt: Option<usize>,
    /// Yaw, pitch, roll.
    angles: [Option<usize>; 3],
    /// w, x, y, z.
    q: [Option<usize>; 4],
    sigma: [Option<usize>; 2],
}

impl Columns {
    /// `name x y [z] [yaw pitch roll] [horizontal vertical accuracy]`.
    fn of_geo_txt() -> Self {
        Self {
            name: 0,
            x: 1,
            y: 2,
            alt: Some(3),
            angles: [Some(4), Some(5), Some(6)],
            q: [None; 4],
            sigma: [Some(7), Some(8)],
        }
    }

    fn named(line: &str) -> Option<Self> {
        let names: Vec<String> = cells(line).iter().map(|n| n.trim_start_matches('#').trim().to_lowercase()).collect();
        let starting = |of: &[&str]| of.iter().find_map(|o| names.iter().position(|n| n.starts_with(o)));
        let exactly = |of: &str| names.iter().position(|n| n == of);
        let holding = |of: &str| names.iter().position(|n| n.contains(of) && !n.contains("accuracy"));
        let accuracy = |axis: &[&str]| {
            let sigma =
                |n: &String| (n.contains("accuracy") || n.contains("sigma")) && axis.iter().any(|a| n.contains(a));
            names.iter().position(sigma)
        };
        // Metashape writes "X/Longitude", RealityCapture x and y.
        let x = starting(&["lon", "lng", "east"]).or_else(|| holding("longitude")).or_else(|| exactly("x"));
        let y = starting(&["lat", "north"]).or_else(|| holding("latitude")).or_else(|| exactly("y"));
        Some(Self {
            name: starting(&["picture", "image", "name", "file", "photo", "label", "source"])?,
            y: y?,
            x: x?,
            alt: starting(&["alt", "height", "elev"]).or_else(|| holding("altitude")).or_else(|| exactly("z")),
            angles: [starting(&["yaw", "heading"]), starting(&["pitch"]), starting(&["roll"])],
            q: ["qw", "qx", "qy", "qz"].map(exactly),
            sigma: [accuracy(&["hor", "xy"]).or(exactly("sigma_m")), accuracy(&["ver", "z"])],
        })
    }
}

#[cfg(test)]
#[allow(clippy::unwrap_used)] // a test may
mod tests {
    use super::*;

    fn read_text(text: &str) -> Result<Vec<(String, Geotag)>, FormatError> {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("geo.txt");
        std::fs::write(&path, text).unwrap();
        read(&path)
    }

    #[test]
    fn geo_txt_mission_planner_and_our_own_csv_say_the_same() {
        let position = Geodetic { lat_deg: 46.8426, lon_deg: -91.9945, alt_m: 198.3 };
        let ours = "picture,sequence,lat_deg,lon_deg,alt_m,east_m,north_m,up_m,qw,qx,qy,qz,sigma_m,sigma_deg,speed_m_s,key_frame\n\
                    IMG_1.png,1,46.8426,-91.9945,198.3,0,0,0,0,1,0,0,0.8,2,5,1\n";
        let planner =
            "#name latitude/Y longitude/X height/Z yaw pitch roll SAlt\nIMG_1.JPG 46.8426 -91.9945 198.3 90 0 0 0\n";
        let odm = "EPSG:4326\nIMG_1.JPG -91.9945 46.8426 198.3 90 0 0 0.8 1.5\n";
        for (text, sigma) in [(ours, [0.8, 0.8]), (planner, [3.0, 3.0]), (odm, [0.8, 1.5])] {
            let (name, tag) = read_text(text).unwrap().remove(0);
            assert!(name.starts_with("img_1."), "{name}");
            assert_eq!((tag.fix.position, tag.fix.sigma_m), (position, sigma), "{text}");
            assert!((tag.attitude.unwrap().rotation * glam::DVec3::Z).z < -0.999, "{text}");
        }
    }

    #[test]
    fn tables_of_other_programs_are_read_whatever_they_call_their_columns() {
        let position = Geodetic { lat_deg: 46.8426, lon_deg: -91.9945, alt_m: 198.3 };
        for text in [
            "#Label,X/Longitude,Y/Latitude,Z/Altitude,Yaw,Pitch,Roll\nDJI 1.JPG,-91.9945,46.8426,198.3,+45.00,0,0\n",
            "# CoordinateSystem: WGS 84 (EPSG::4326)\n#Label,X/Longitude,Y/Latitude,Z/Altitude\nDJI 1.JPG,-91.9945,46.8426,198.3\n",
            "#name,x,y,alt,yaw,pitch,roll\nDJI 1.JPG,-91.9945,46.8426,198.3,+45.00,0,0\n",
            "\u{feff}imagename;latitude;longitude;altitude\r\nDJI 1.JPG;46,8426;-91,9945;198,3\r\n",
            "EPSG: 4326\nDJI 1.JPG -91.9945 46.8426 198.3\n",
            "WGS84\nDJI 1.JPG\t-91.9945\t46.8426\t198.3\n",
        ] {
            let tags = read_text(text).unwrap();
            assert_eq!((tags[0].0.as_str(), tags[0].1.fix.position, tags.len()), ("dji 1.jpg", position, 1), "{text}");
        }
        if cfg!(not(feature = "epsg")) {
            return;
        }
        let polish = read_text("EPSG:2180\na.jpg 340607 548220 100\n").unwrap()[0].1.fix.position;
        assert!((52.0..54.0).contains(&polish.lat_deg) && (16.0..18.0).contains(&polish.lon_deg), "{polish:?}");
    }

    #[test]
    fn a_pitch_of_minus_ninety_looks_down_and_a_missing_height_is_not_zero() {
        for pitch in ["-90", "0"] {
            let tag = read_text(&format!("EPSG:4326\na.jpg 7 46 400 45 {pitch} 0\n")).unwrap()[0].1;
            assert!((tag.attitude.unwrap().rotation * glam::DVec3::Z).z < -0.999, "{pitch}");
        }
        let tag = read_text("EPSG:4326\na.jpg 7 46\n").unwrap()[0].1;
        assert!(!tag.has_height && tag.fix.sigma_m[1] >= UNKNOWN_HEIGHT_SIGMA_M);
    }

    #[test]
    fn lines_that_make_no_sense_are_named_by_number() {
        for (text, expected) in [
            ("", "is empty"),
            ("hello world\n", "names columns"),
            ("EPSG:1\na 1 2 3\n", "EPSG:1 is not known"),
            ("a.jpg 7.5 46.2 400\n", "names columns"),
            ("name,x,y,z\na.jpg,576700,5188100,198\n", "EPSG:CODE"),
            ("EPSG:4326\na.jpg 200 95 3\n", "line 2"),
            ("EPSG:4326\na.jpg x 95 3\n", "\"x\" is not a number"),
            ("name,lat,lon\na.jpg,1\n", "line 2: has no position"),
            ("name,lat,lon,qw,qx,qy,qz\na.jpg,1,2,0,0,0,0\n", "not a rotation"),
        ] {
            let error = read_text(text).unwrap_err().to_string();
            assert!(error.contains(expected) && !error.contains('\n'), "{text:?}: {error}");
        }
    }
}
