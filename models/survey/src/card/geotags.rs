//! Files of positions: OpenDroneMap's `geo.txt`, Mission Planner's geotag list, our own `geotags.csv`, Pix4D's list without names of
//! columns, and any table whose first line names its columns (exiftool's, Metashape's, a spreadsheet's), in any order and in a few
//! languages.

use std::collections::HashMap;
use std::path::Path;

use geometry::geodesy::Geodetic;
use glam::{DQuat, DVec3};

use super::record::{
    Attitude, AttitudeSource, FROM_HORIZON_DEG, Fix, GPS_SIGMA_M, Record, UNKNOWN_HEIGHT_SIGMA_M, believable,
    nadir_rotation,
};
use crate::coordinates::{self, Axis, Reference, cells, is_picture, number, picture_name};
use crate::names::PictureNames;
use models::formats::FormatError;
use models::formats::telemetry::dji_rotation;
use models::picture::Orientation;

/// A hundred thousand pictures at 600 bytes each.
const LIMIT: u64 = 64 << 20;
/// The international foot, metres; that of American surveyors differs by two millionths.
const FOOT_M: f64 = 0.3048;

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

/// What a file says.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Geotags {
    /// Tags by what the file calls the pictures, in lower case.
    pub tags: Vec<(String, Geotag)>,
    /// How it was understood, where that is not certain.
    pub doubt: Option<String>,
}

/// Reads a file of positions.
///
/// # Errors
/// The file cannot be read, lacks what a position needs, or a line is no number where one must be.
pub fn read(path: &Path) -> Result<Geotags, FormatError> {
    let text = coordinates::text(path, LIMIT)?;
    let mut lines = text.lines().enumerate().filter(|(_, l)| !l.trim().is_empty()).peekable();
    let Some((_, first)) = lines.peek().copied() else {
        return Err(FormatError::invalid(path, "is empty"));
    };
    // Metashape names the reference system in a comment before the columns.
    let (mut reference, mut columns) = (None, None);
    while let Some((number, line)) = lines.peek().copied() {
        if let Ok(named) = Columns::named(line) {
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
    let unnamed = lines.peek().and_then(|(_, line)| Columns::of_pix4d(line));
    let mut doubts = Vec::new();
    let columns = match (columns, &reference, unnamed) {
        (Some(columns), ..) => columns,
        (None, Some(_), _) => Columns::of_geo_txt(),
        (None, None, Some(columns)) => {
            doubts
                .push("its columns have no names; read as Pix4D writes them: latitude, longitude, altitude".to_owned());
            columns
        }
        (None, None, None) => {
            let lacks = Columns::named(first).err().unwrap_or_default();
            let what = format!(
                "its first line is neither a projection (EPSG:4326, WGS84 UTM 32N) nor names columns for picture, latitude, longitude and altitude ({lacks})"
            );
            return Err(FormatError::invalid(path, what));
        }
    };
    if let Some(what) = columns.contradicts(reference.as_ref()) {
        return Err(FormatError::invalid(path, what));
    }
    if columns.unit == Unit::Unsaid && reference.is_none() && columns.zone.is_none() {
        doubts.push("its x and y are read as longitude and latitude".to_owned());
    }
    let mut rows = Rows { columns, reference, zone: None, is_table, all_whole: true, doubt: None };
    let mut tags = Vec::new();
    for (at, line) in lines.filter(|(_, l)| !l.trim_start().starts_with('#')) {
        let row = rows.read(line).map_err(|what| FormatError::invalid(path, format!("line {}: {what}", at + 1)))?;
        tags.extend(row);
    }
    if is_table && rows.all_whole && !tags.is_empty() {
        let what =
            "its latitudes and longitudes are all whole degrees; write decimal points, or semicolons between cells";
        return Err(FormatError::invalid(path, what));
    }
    doubts.extend(rows.doubt);
    let (tags, contradicted) = once(tags);
    if let Some(name) = contradicted.first() {
        let n = contradicted.len();
        doubts.push(format!(
            "{n} named twice, at different places, and not used ({name}{})",
            if n > 1 { ", …" } else { "" }
        ));
    }
    Ok(Geotags { tags, doubt: (!doubts.is_empty()).then(|| doubts.join("; ")) })
}

/// Each picture once where its lines give it one place; and the names of those whose lines contradict each other.
fn once(tags: Vec<(String, Geotag)>) -> (Vec<(String, Geotag)>, Vec<String>) {
    let mut first: HashMap<String, usize> = HashMap::new();
    let mut all: Vec<(String, Option<Geotag>)> = Vec::with_capacity(tags.len());
    for (name, tag) in tags {
        match first.get(&name) {
            Some(&i) if all[i].1.is_some_and(|t| t.fix.position != tag.fix.position) => all[i].1 = None,
            Some(_) => {}
            None => {
                first.insert(name.clone(), all.len());
                all.push((name, Some(tag)));
            }
        }
    }
    let contradicted = all.iter().filter(|t| t.1.is_none()).map(|t| t.0.clone()).collect();
    (all.into_iter().filter_map(|(name, tag)| Some((name, tag?))).collect(), contradicted)
}

/// What lines of a file are read by.
struct Rows {
    columns: Columns,
    reference: Option<Reference>,
    /// The zone of the last line, where a column names it.
    zone: Option<(String, Reference)>,
    is_table: bool,
    /// Whether every position so far is one of whole degrees: decimal commas between commas become that.
    all_whole: bool,
    /// How a line was understood, where that is not certain.
    doubt: Option<String>,
}

impl Rows {
    /// A picture's name and tag; `None` where the line has no position of it.
    fn read(&mut self, line: &str) -> Result<Option<(String, Geotag)>, String> {
        let mut cells = cells(line);
        let columns = &self.columns;
        let named = if self.is_table && cells.len() <= columns.count { None } else { picture_name(&cells) };
        if let Some((_, taken)) = &named {
            // Blanks in a picture's name are none between columns.
            cells.drain(1..*taken);
        }
        if cells.len() > columns.count && cells[columns.count..].iter().any(|c| !c.is_empty()) {
            return Err(format!(
                "has {} cells where {} are named; write decimal points, or semicolons between cells",
                cells.len(),
                columns.count
            ));
        }
        let cell = |i: Option<usize>| i.and_then(|i| cells.get(i)).map(|c| c.trim()).filter(|c| !c.is_empty());
        let read = |i: Option<usize>, of: &dyn Fn(&str) -> Option<f64>| -> Result<Option<f64>, String> {
            let Some(c) = cell(i) else { return Ok(None) };
            of(c).map(Some).ok_or_else(|| format!("{c:?} is not a number"))
        };
        let value = |i: Option<usize>| read(i, &number);
        let name = named.map(|n| n.0).or_else(|| cell(Some(columns.name)).map(str::to_owned));
        let Some(name) = name else { return Err("names no picture".to_owned()) };
        let angle = |i: usize, half: Option<usize>, axis: Axis| {
            let of = read(Some(i), &|c| coordinates::angle(c, axis));
            // exiftool writes the hemisphere into a column of its own, others into the next one.
            let beside =
                || cell(Some(i + 1)).filter(|c| self.is_table && c.len() == 1 && is_negative(c, axis).is_some());
            let Some(half) = cell(half).or_else(beside) else { return of };
            let Some(v) = of? else { return Ok(None) };
            let negative = is_negative(half, axis).ok_or_else(|| format!("{half:?} is no hemisphere"))?;
            Ok(Some(if negative { -v.abs() } else { v }))
        };
        let (x, y) = (angle(columns.x, columns.half[0], Axis::East)?, angle(columns.y, columns.half[1], Axis::North)?);
        let (x, y) = match (x, y) {
            (Some(x), Some(y)) => (x, y),
            // exiftool lists pictures without GPS, too.
            (None, None) if self.is_table => return Ok(None),
            _ => return Err("has no position".to_owned()),
        };
        if (x, y) == (0.0, 0.0) {
            return Ok(None);
        }
        let alt_m = read(columns.alt, &coordinates::height)?.map(|alt| alt * columns.alt_unit_m);
        if let Some(zone) = cell(columns.zone).filter(|zone| self.zone.as_ref().is_none_or(|z| z.0 != *zone)) {
            match Reference::named(&format!("UTM {zone}")) {
                Some(Ok(reference)) => {
                    if zone.ends_with(['S', 's']) {
                        let what =
                            format!("zone {zone} is read as south of the equator, not as band S of the military grid");
                        self.doubt = Some(what);
                    }
                    self.zone = Some((zone.to_owned(), reference));
                }
                _ => return Err(format!("{zone:?} is no UTM zone (15N)")),
            }
        }
        let zone = self.zone.as_ref().filter(|_| columns.zone.is_some()).map(|z| &z.1);
        let reference = zone.or(self.reference.as_ref());
        self.all_whole &= x.fract() == 0.0 && y.fract() == 0.0 && reference.is_none_or(Reference::is_in_degrees);
        let position = match reference {
            Some(reference) => reference.geodetic(DVec3::new(x, y, alt_m.unwrap_or_default())),
            None => Some(Geodetic { lat_deg: y, lon_deg: x, alt_m: alt_m.unwrap_or_default() }),
        };
        let Some(position) = position.filter(Geodetic::is_valid) else {
            return Err(format!(
                "{y}, {x} is not a position on the earth; a table in metres needs a line EPSG:CODE before it, or a column for the UTM zone"
            ));
        };
        let three = |of: [Option<usize>; 3]| -> Result<Option<[f64; 3]>, String> {
            Ok(match (value(of[0])?, value(of[1])?, value(of[2])?) {
                (Some(a), Some(b), Some(c)) => Some([a, b, c]),
                _ => None,
            })
        };
        let horizontal = value(columns.sigma[0])?.filter(|s| *s > 0.0).map_or(GPS_SIGMA_M, believable);
        let vertical = value(columns.sigma[1])?.filter(|s| *s > 0.0).map_or(horizontal, believable);
        let vertical = if alt_m.is_some() { vertical } else { UNKNOWN_HEIGHT_SIGMA_M };
        let attitude = match (three([columns.q[1], columns.q[2], columns.q[3]])?, value(columns.q[0])?) {
            (Some([x, y, z]), Some(w)) => {
                let q = DQuat::from_xyzw(x, y, z, w);
                if !(0.9..1.1).contains(&q.length()) {
                    return Err("qw qx qy qz is not a rotation".to_owned());
                }
                Some(Attitude { rotation: q.normalize(), source: AttitudeSource::Gimbal })
            }
            // No mapping camera looks back: a pitch like that is measured from the horizon, as in XMP.
            _ => three(columns.angles)?.map(|[y, p, r]| match p < FROM_HORIZON_DEG {
                true => Attitude { rotation: dji_rotation(y, p, r), source: AttitudeSource::Gimbal },
                false => Attitude {
                    rotation: nadir_rotation(y, p, r),
                    source: if self.is_table { AttitudeSource::Airframe } else { AttitudeSource::Gimbal },
                },
            }),
        };
        let fix = Fix { position, sigma_m: [horizontal, vertical] };
        Ok(Some((name.to_lowercase(), Geotag { fix, has_height: alt_m.is_some(), attitude })))
    }
}

/// Gives the pictures their tags, which count more than what the pictures say; one line about it, and whether every picture has one.
///
/// # Errors
/// The file's positions are nowhere near those of the pictures themselves.
pub(super) fn apply(
    file: &Path,
    Geotags { tags, doubt }: &Geotags,
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
        "{}: positions of {} of {} pictures ({} lines){}",
        file.display(),
        pairs.len(),
        records.len(),
        tags.len(),
        doubt.as_ref().map_or(String::new(), |doubt| format!("; {doubt}"))
    );
    Ok((line, pairs.len() == records.len() && doubt.is_none()))
}

/// As [`apply`] for a film's subtitles; `None` where no picture is a frame of the film.
pub(super) fn apply_to_some(file: &Path, tags: &Geotags, records: &mut [Record]) -> Option<String> {
    let names: Vec<String> = records.iter().map(|r| r.name.to_lowercase()).collect();
    let names = PictureNames::of(names.iter().map(String::as_str));
    let is_any = tags.tags.iter().any(|(name, _)| names.find(name).is_some());
    is_any.then(|| apply(file, tags, records).map_or_else(|e| e.to_string(), |(line, _)| line))
}

/// Whether a hemisphere is the one that counts below zero; `None` where `cell` is none of this axis.
fn is_negative(cell: &str, axis: Axis) -> Option<bool> {
    match (axis, cell.chars().next()?.to_ascii_uppercase()) {
        (Axis::East, 'E') | (Axis::North, 'N') => Some(false),
        (Axis::East, 'W') | (Axis::North, 'S') => Some(true),
        _ => None,
    }
}

/// What the two coordinates are by their columns' names.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
enum Unit {
    /// x and y: degrees, unless a reference system says otherwise.
    #[default]
    Unsaid,
    /// Longitude and latitude.
    Degrees,
    /// Easting and northing.
    Metres,
}

/// Where what stands.
#[derive(Debug)]
struct Columns {
    count: usize,
    name: usize,
    x: usize,
    y: usize,
    unit: Unit,
    /// Hemispheres of x and y, where columns of their own name them.
    half: [Option<usize>; 2],
    zone: Option<usize>,
    alt: Option<usize>,
    /// What a height is in, metres.
    alt_unit_m: f64,
    /// Yaw, pitch, roll.
    angles: [Option<usize>; 3],
    /// w, x, y, z.
    q: [Option<usize>; 4],
    sigma: [Option<usize>; 2],
}

/// What people call the columns, each list with what is preferred first.
const PICTURE: &[&str] = &[
    "sourcefile",
    "filename",
    "picture",
    "image",
    "imagename",
    "img",
    "photo",
    "file",
    "label",
    "name",
    "source",
    "bild",
    "bildname",
    "foto",
    "datei",
    "dateiname",
    "imagen",
    "immagine",
    "fichier",
    "archivo",
    "photoid",
    "imageid",
];
const LONGITUDE: &[&str] = &[
    "longitude",
    "lon",
    "lng",
    "long",
    "gpslongitude",
    "gpslon",
    "gpslng",
    "longitud",
    "longitudine",
    "länge",
    "laenge",
    "längengrad",
    "laengengrad",
];
const LATITUDE: &[&str] =
    &["latitude", "lat", "gpslatitude", "gpslat", "latitud", "latitudine", "breite", "breitengrad"];
const EASTING: &[&str] = &["easting", "east", "eastings", "utmeasting", "ostwert", "rechtswert", "ost", "este"];
const NORTHING: &[&str] = &["northing", "north", "northings", "utmnorthing", "nordwert", "hochwert", "nord", "norte"];
const ALTITUDE: &[&str] = &[
    "altitude",
    "alt",
    "gpsaltitude",
    "gpsalt",
    "height",
    "elevation",
    "elev",
    "höhe",
    "hoehe",
    "altitud",
    "altura",
    "quota",
    "altezza",
    "absolutealtitude",
    "z",
];
/// Words beside those that make something else of a column.
const OTHERWISE: &[&str] = &[
    "ref",
    "hemisphere",
    "accuracy",
    "sigma",
    "std",
    "error",
    "relative",
    "rel",
    "agl",
    "ground",
    "terrain",
    "takeoff",
    "home",
    "width",
    "size",
    "type",
    "date",
    "time",
];
const FEET: &[&str] = &["ft", "feet", "foot"];

impl Default for Columns {
    fn default() -> Self {
        Self {
            count: 0,
            name: 0,
            x: 0,
            y: 0,
            unit: Unit::Unsaid,
            half: [None; 2],
            zone: None,
            alt: None,
            alt_unit_m: 1.0,
            angles: [None; 3],
            q: [None; 4],
            sigma: [None; 2],
        }
    }
}

impl Columns {
    /// `name x y [z] [yaw pitch roll] [horizontal vertical accuracy]`.
    fn of_geo_txt() -> Self {
        Self {
            count: usize::MAX,
            name: 0,
            x: 1,
            y: 2,
            alt: Some(3),
            angles: [Some(4), Some(5), Some(6)],
            sigma: [Some(7), Some(8)],
            ..Self::default()
        }
    }

    /// `name,latitude,longitude[,altitude[,omega,phi,kappa][,horizontal,vertical accuracy]]`, by a first line of this form.
    fn of_pix4d(line: &str) -> Option<Self> {
        let cells = cells(line);
        let is_cut = line.contains([',', ';', '\t']) && cells.first().is_some_and(|name| is_picture(name));
        let numbers = cells.iter().skip(1).all(|cell| number(cell).is_some());
        // No other columns than these: what else there is would be guessed.
        let sigma = match cells.len() {
            3 | 4 | 7 => [None; 2],
            6 => [Some(4), Some(5)],
            9 => [Some(7), Some(8)],
            _ => return None,
        };
        let alt = (cells.len() > 3).then_some(3);
        let all = Self { count: cells.len(), y: 1, x: 2, unit: Unit::Degrees, alt, sigma, ..Self::default() };
        (is_cut && numbers).then_some(all)
    }

    /// By what the line names, or what it lacks.
    fn named(line: &str) -> Result<Self, String> {
        let words = |name: &&str| -> Vec<String> {
            let word = |w: &str| w.to_lowercase();
            name.split(|c: char| !c.is_alphanumeric()).filter(|w| !w.is_empty()).map(word).collect()
        };
        let names: Vec<Vec<String>> = cells(line).iter().map(words).collect();
        let plain = |name: &Vec<String>| !name.iter().any(|w| OTHERWISE.contains(&w.as_str()));
        let column = |of: &[&str]| {
            of.iter().find_map(|o| names.iter().position(|name| plain(name) && name.iter().any(|w| w == o)))
        };
        let exactly = |of: &str| names.iter().position(|name| name.join("_") == of || name.concat() == of);
        let accuracy = |axis: &[&str]| {
            let sigma = |name: &Vec<String>| {
                let of = name.iter().any(|w| w == "accuracy" || w == "sigma");
                of && name.iter().any(|w| axis.iter().any(|a| w.starts_with(a)))
            };
            names.iter().position(sigma)
        };
        // GPSLatitudeRef, lat_ref, "N/S".
        let half = |axis: &[&str], letters: &str| {
            let of = |all: &str, end: &str| all.strip_suffix(end).is_some_and(|axis_name| axis.contains(&axis_name));
            names
                .iter()
                .map(|name| name.concat())
                .position(|all| all == letters || of(&all, "ref") || of(&all, "hemisphere"))
        };
        let alt = column(ALTITUDE);
        let in_feet = alt.is_some_and(|i| names[i].iter().any(|w| FEET.contains(&w.as_str())));
        let angle =
            |of: &[&str]| names.iter().position(|name| plain(name) && name.iter().any(|w| of.iter().any(|o| w == o)));
        let (name, degrees, metres) =
            (column(PICTURE), [column(LONGITUDE), column(LATITUDE)], [column(EASTING), column(NORTHING)]);
        let (at, unit) = match (degrees, metres) {
            ([Some(x), Some(y)], _) => ([Some(x), Some(y)], Unit::Degrees),
            (_, [Some(x), Some(y)]) => ([Some(x), Some(y)], Unit::Metres),
            ([None, None], [None, None]) => ([exactly("x"), exactly("y")], Unit::Unsaid),
            (degrees, metres) => ([degrees[0].or(metres[0]), degrees[1].or(metres[1])], Unit::Unsaid),
        };
        let lacks = |what: &[(&str, Option<usize>)]| {
            let names = what.iter().filter(|w| w.1.is_none()).map(|w| w.0);
            format!("it names no {}", names.collect::<Vec<_>>().join(", no "))
        };
        let (Some(name), [Some(x), Some(y)]) = (name, at) else {
            return Err(lacks(&[("picture", name), ("longitude", at[0]), ("latitude", at[1])]));
        };
        if x == y || x == name || y == name {
            return Err("it names two in one cell".to_owned());
        }
        Ok(Self {
            count: names.len(),
            name,
            x,
            y,
            unit,
            half: [half(LONGITUDE, "ew"), half(LATITUDE, "ns")],
            zone: column(&["zone", "utmzone"]),
            alt,
            alt_unit_m: if in_feet { FOOT_M } else { 1.0 },
            angles: [
                angle(&["yaw", "heading", "gimbalyawdegree"]),
                angle(&["pitch", "gimbalpitchdegree"]),
                angle(&["roll", "gimbalrolldegree"]),
            ],
            q: ["qw", "qx", "qy", "qz"].map(exactly),
            sigma: [accuracy(&["hor", "xy"]).or(exactly("sigma_m")), accuracy(&["ver", "z"])],
        })
    }

    /// What the names of the columns and a reference system do not say together.
    fn contradicts(&self, reference: Option<&Reference>) -> Option<&'static str> {
        match (self.unit, reference.map(Reference::is_in_degrees)) {
            (Unit::Metres, None) if self.zone.is_none() => Some(
                "has easting and northing, but names no zone: write a line EPSG:CODE (or UTM 32N) before it, or add a column zone",
            ),
            (Unit::Metres, Some(true)) => Some("has easting and northing, but its reference system is in degrees"),
            (Unit::Degrees, Some(false)) => Some("has longitude and latitude, but its reference system is in metres"),
            _ => None,
        }
    }
}

#[cfg(test)]
#[allow(clippy::unwrap_used)] // a test may
mod tests;
