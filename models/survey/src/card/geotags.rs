//! Files of positions: OpenDroneMap's `geo.txt`, Mission Planner's geotag list, our own `geotags.csv` and anything else whose
//! first line names its columns.

use std::collections::HashMap;
use std::path::Path;

use geometry::geodesy::Geodetic;
use glam::DQuat;

use super::record::{Attitude, AttitudeSource, Fix, GPS_SIGMA_M, Record, nadir_rotation};
use models::formats::{FormatError, read_bounded};
use models::picture::Orientation;

/// A hundred thousand pictures at 600 bytes each.
const LIMIT: u64 = 64 << 20;

/// What a file says of one picture.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Geotag {
    /// Position with its standard deviations.
    pub fix: Fix,
    /// Attitude, where the file has one.
    pub attitude: Option<Attitude>,
}

/// Reads a file of positions: tags by lower-case file name without its extension (a flight stores its pictures as PNG under
/// the camera's names).
///
/// # Errors
/// The file cannot be read, names no columns that are understood, or a line is no number where one must be.
pub fn read(path: &Path) -> Result<HashMap<String, Geotag>, FormatError> {
    let bytes = read_bounded(path, LIMIT)?;
    let text = std::str::from_utf8(&bytes).map_err(|_| FormatError::invalid(path, "not UTF-8 text"))?;
    let mut lines = text.lines().enumerate().filter(|(_, l)| !l.trim().is_empty());
    let Some((_, first)) = lines.next() else { return Err(FormatError::invalid(path, "is empty")) };
    let projection = Projection::parse(first.trim().trim_start_matches('\u{feff}'));
    let columns = match &projection {
        Some(Ok(_)) => Columns::of_geo_txt(),
        Some(Err(what)) => return Err(FormatError::invalid(path, what.clone())),
        None => Columns::named(first).ok_or_else(|| {
            let what = "its first line is neither a projection (EPSG:4326, WGS84 UTM 32N) nor names columns for picture, latitude, longitude and altitude";
            FormatError::invalid(path, what)
        })?,
    };
    let mut tags = HashMap::new();
    for (number, line) in lines.filter(|(_, l)| !l.trim_start().starts_with('#')) {
        let cells = split(line);
        let bad = |what: &str| FormatError::invalid(path, format!("line {}: {what}", number + 1));
        let cell = |i: Option<usize>| i.and_then(|i| cells.get(i)).map(|c| c.trim()).filter(|c| !c.is_empty());
        let value = |i: Option<usize>| -> Result<Option<f64>, FormatError> {
            let Some(c) = cell(i) else { return Ok(None) };
            match c.parse::<f64>() {
                Ok(v) if v.is_finite() => Ok(Some(v)),
                _ => Err(bad(&format!("{c:?} is not a number"))),
            }
        };
        let Some(name) = cell(Some(columns.name)) else { return Err(bad("names no picture")) };
        let (Some(x), Some(y)) = (value(Some(columns.x))?, value(Some(columns.y))?) else {
            return Err(bad("has no position"));
        };
        let alt_m = value(columns.alt)?.unwrap_or(0.0);
        let position = match &projection {
            Some(Ok(p)) => p.to_geodetic(x, y, alt_m),
            _ => Geodetic { lat_deg: y, lon_deg: x, alt_m },
        };
        if !position.is_valid() {
            return Err(bad(&format!("{y}, {x} is not a position on the earth")));
        }
        let three = |of: [Option<usize>; 3]| -> Result<Option<[f64; 3]>, FormatError> {
            Ok(match (value(of[0])?, value(of[1])?, value(of[2])?) {
                (Some(a), Some(b), Some(c)) => Some([a, b, c]),
                _ => None,
            })
        };
        let horizontal = value(columns.sigma[0])?.filter(|s| *s > 0.0).unwrap_or(GPS_SIGMA_M);
        let vertical = value(columns.sigma[1])?.filter(|s| *s > 0.0).unwrap_or(horizontal);
        let attitude = match (three([columns.q[1], columns.q[2], columns.q[3]])?, value(columns.q[0])?) {
            (Some([x, y, z]), Some(w)) => {
                let q = DQuat::from_xyzw(x, y, z, w);
                if !(0.9..1.1).contains(&q.length()) {
                    return Err(bad("qw qx qy qz is not a rotation"));
                }
                Some(Attitude { rotation: q.normalize(), source: AttitudeSource::Gimbal })
            }
            _ => three(columns.angles)?.map(|[y, p, r]| Attitude {
                rotation: nadir_rotation(y, p, r),
                source: if projection.is_some() { AttitudeSource::Gimbal } else { AttitudeSource::Airframe },
            }),
        };
        tags.insert(key(name), Geotag { fix: Fix { position, sigma_m: [horizontal, vertical] }, attitude });
    }
    Ok(tags)
}

fn key(name: &str) -> String {
    let file = name.rsplit(['/', '\\']).next().unwrap_or(name).to_lowercase();
    file.rsplit_once('.').map_or(file.clone(), |(stem, _)| stem.to_owned())
}

/// Gives the pictures their tags, which count more than what the pictures say; one line about it.
pub(super) fn apply(file: &Path, tags: &HashMap<String, Geotag>, records: &mut [Record]) -> String {
    let mut used = 0;
    for r in records.iter_mut() {
        let Some(tag) = tags.get(&key(&r.path.to_string_lossy())) else { continue };
        used += 1;
        r.fix = Some(tag.fix);
        // Heights above take-off belong to another scale than a file's.
        r.relative_alt_m = None;
        if tag.attitude.is_some() {
            r.attitude = tag.attitude;
            r.orientation = Orientation::default();
        }
    }
    format!("{}: positions of {used} of {} pictures ({} lines)", file.display(), records.len(), tags.len())
}

fn split(line: &str) -> Vec<&str> {
    let separator = [',', ';', '\t'].into_iter().find(|s| line.contains(*s));
    match separator {
        Some(s) => {
            let mut quoted = false;
            let between = |c: char| {
                quoted ^= c == '"';
                c == s && !quoted
            };
            line.split(between).map(|c| c.trim().trim_matches('"')).collect()
        }
        None => line.split_whitespace().collect(),
    }
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
        let names: Vec<String> = split(line).iter().map(|n| n.trim_start_matches('#').trim().to_lowercase()).collect();
        let starting = |of: &[&str]| of.iter().find_map(|o| names.iter().position(|n| n.starts_with(o)));
        let exactly = |of: &str| names.iter().position(|n| n == of);
        let accuracy = |axis: &[&str]| {
            let sigma =
                |n: &String| (n.contains("accuracy") || n.contains("sigma")) && axis.iter().any(|a| n.contains(a));
            names.iter().position(sigma)
        };
        Some(Self {
            name: starting(&["picture", "image", "name", "file", "photo", "label"])?,
            y: starting(&["lat"])?,
            x: starting(&["lon", "lng"])?,
            alt: starting(&["alt", "height", "elev"]),
            angles: [starting(&["yaw", "heading"]), starting(&["pitch"]), starting(&["roll"])],
            q: ["qw", "qx", "qy", "qz"].map(exactly),
            sigma: [accuracy(&["hor", "xy"]).or(exactly("sigma_m")), accuracy(&["ver", "z"])],
        })
    }
}

/// How positions are written in `geo.txt`.
#[derive(Clone, Copy, Debug, PartialEq)]
enum Projection {
    /// Longitude and latitude, degrees.
    Degrees,
    /// Universal Transverse Mercator, metres.
    Utm { zone: u8, south: bool },
}

impl Projection {
    /// `None` where the line is no projection; an error where it is one that is not understood.
    fn parse(line: &str) -> Option<Result<Self, String>> {
        let upper = line.to_uppercase();
        let utm = |zone: u8, south: bool| match (1..=60).contains(&zone) {
            true => Ok(Self::Utm { zone, south }),
            false => Err(format!("{line:?}: UTM has zones 1 to 60")),
        };
        if let Some(code) = upper.strip_prefix("EPSG:") {
            return Some(match code.trim().parse::<u32>() {
                Ok(4326 | 4979) => Ok(Self::Degrees),
                Ok(code @ 32_601..=32_660) => utm((code - 32_600) as u8, false),
                Ok(code @ 32_701..=32_760) => utm((code - 32_700) as u8, true),
                _ => Err(format!("{line}: positions can be read in EPSG:4326 and WGS84 UTM (EPSG:326xx, EPSG:327xx)")),
            });
        }
        if upper.contains("+PROJ=LONGLAT") || upper.contains("+PROJ=LATLONG") {
            return Some(Ok(Self::Degrees));
        }
        if let Some(rest) = upper.strip_prefix("WGS84 UTM ").or(upper.strip_prefix("WGS 84 UTM ")) {
            let rest = rest.trim();
            let zone = rest.trim_end_matches(['N', 'S']).trim().parse().unwrap_or(0);
            return Some(utm(zone, rest.ends_with('S')));
        }
        if upper.contains("+PROJ=UTM") {
            let zone =
                upper.split("+ZONE=").nth(1).and_then(|z| z.split_whitespace().next()?.parse().ok()).unwrap_or(0);
            return Some(utm(zone, upper.contains("+SOUTH")));
        }
        upper.starts_with("+PROJ").then(|| Err(format!("{line}: only longlat and utm can be read")))
    }

    fn to_geodetic(self, x: f64, y: f64, alt_m: f64) -> Geodetic {
        match self {
            Self::Degrees => Geodetic { lat_deg: y, lon_deg: x, alt_m },
            Self::Utm { zone, south } => from_utm(zone, south, x, y, alt_m),
        }
    }
}

/// Inverse UTM by Krüger's series to n⁴ (Karney, "Transverse Mercator with an accuracy of a few nanometers", eqs. 12 and
/// 36): below a millimetre within a zone.
fn from_utm(zone: u8, south: bool, easting: f64, northing: f64, alt_m: f64) -> Geodetic {
    const A: f64 = 6_378_137.0;
    const F: f64 = 1.0 / 298.257_223_563;
    let n: f64 = F / (2.0 - F);
    let (n2, n3, n4) = (n * n, n.powi(3), n.powi(4));
    let radius = A / (1.0 + n) * (1.0 + n2 / 4.0 + n4 / 64.0);
    let beta = [
        n / 2.0 - 2.0 * n2 / 3.0 + 37.0 * n3 / 96.0 - n4 / 360.0,
        n2 / 48.0 + n3 / 15.0 - 437.0 * n4 / 1440.0,
        17.0 * n3 / 480.0 - 37.0 * n4 / 840.0,
        4397.0 * n4 / 161_280.0,
    ];
    let xi = (northing - if south { 1e7 } else { 0.0 }) / (0.9996 * radius);
    let eta = (easting - 500_000.0) / (0.9996 * radius);
    let (mut xi0, mut eta0) = (xi, eta);
    for (j, b) in beta.iter().enumerate() {
        let k = 2.0 * (j as f64 + 1.0);
        xi0 -= b * (k * xi).sin() * (k * eta).cosh();
        eta0 -= b * (k * xi).cos() * (k * eta).sinh();
    }
    let e = (F * (2.0 - F)).sqrt();
    let tau0 = xi0.sin() / eta0.sinh().hypot(xi0.cos());
    let mut tau = tau0;
    for _ in 0..5 {
        let sigma = (e * (e * tau / tau.hypot(1.0)).atanh()).sinh();
        let now = tau * sigma.hypot(1.0) - sigma * tau.hypot(1.0);
        let slope = (1.0 + (1.0 - e * e) * tau * tau) / ((1.0 - e * e) * now.hypot(1.0) * tau.hypot(1.0));
        tau += (tau0 - now) * slope;
    }
    let meridian = f64::from(zone) * 6.0 - 183.0;
    Geodetic { lat_deg: tau.atan().to_degrees(), lon_deg: meridian + eta0.sinh().atan2(xi0.cos()).to_degrees(), alt_m }
}

#[cfg(test)]
#[allow(clippy::unwrap_used)] // a test may
mod tests {
    use super::*;

    fn read_text(text: &str) -> Result<HashMap<String, Geotag>, FormatError> {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("geo.txt");
        std::fs::write(&path, text).unwrap();
        read(&path)
    }

    #[test]
    fn utm_positions_lie_where_meridian_arcs_and_parallels_say() {
        // On the meridian a northing is the length of the meridian's arc, integrated numerically (Simpson), times 0.9996.
        let p = from_utm(32, false, 500_000.0, 5_000_000.0, 0.0);
        assert!((p.lat_deg - 45.1534771834).abs() < 1e-9 && (p.lon_deg - 9.0).abs() < 1e-12, "{p:?}");
        // A degree of longitude off the meridian and back: forward by the length of the parallel to first order.
        let a = from_utm(17, false, 333_000.0, 3_103_000.0, 0.0);
        let b = from_utm(17, false, 333_010.0, 3_103_000.0, 0.0);
        let moved = geometry::geodesy::EnuFrame::new(a).to_enu(b);
        assert!((moved.truncate().length() - 10.0 / 0.99994).abs() < 2e-3, "{moved}");
        let s = from_utm(33, true, 500_000.0, 1e7, 0.0);
        assert!(s.lat_deg.abs() < 1e-9 && (s.lon_deg - 15.0).abs() < 1e-12, "{s:?}");
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
            let tag = read_text(text).unwrap()["img_1"];
            assert_eq!((tag.fix.position, tag.fix.sigma_m), (position, sigma), "{text}");
            assert!((tag.attitude.unwrap().rotation * glam::DVec3::Z).z < -0.999, "{text}");
        }
    }

    #[test]
    fn a_separator_within_quotation_marks_belongs_to_the_name() {
        assert_eq!(split("\"a,b.jpg\", 1,\"2\""), ["a,b.jpg", "1", "2"]);
        assert_eq!(split("\"a b.jpg\";1;2"), ["a b.jpg", "1", "2"]);
    }

    #[test]
    fn lines_that_make_no_sense_are_named_by_number() {
        for (text, expected) in [
            ("", "is empty"),
            ("hello world\n", "names columns"),
            ("EPSG:2154\na 1 2 3\n", "EPSG:4326"),
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
