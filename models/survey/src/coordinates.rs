//! Coordinates as people write them down: the text of `geo.txt`, `gcp_list.txt`, tables of positions and of check points, and the
//! name of the reference system that they are in.

use std::path::Path;

use geometry::geodesy::Geodetic;
use glam::{DVec2, DVec3};
use models::formats::{FormatError, read_bounded};
use proj4rs::Proj;
use proj4rs::transform::transform;

/// EPSG code of UTM zone 0 on WGS 84, north and south.
pub(crate) const UTM_NORTH: u16 = 32_600;
pub(crate) const UTM_SOUTH: u16 = 32_700;
pub(crate) const UTM_ZONES: std::ops::RangeInclusive<u16> = 1..=60;

/// Extensions that end a picture's name, which may hold spaces.
const PICTURES: [&str; 9] = [".jpg", ".jpeg", ".jpe", ".png", ".tif", ".tiff", ".webp", ".dng", ".heic"];

/// Reads a text of at most `limit` bytes: UTF-8 with or without a byte order mark, UTF-16 with one, else Latin-1 (which spreadsheets
/// of western Europe write).
///
/// # Errors
/// The file cannot be read or is larger.
pub fn text(path: &Path, limit: u64) -> Result<String, FormatError> {
    let bytes = read_bounded(path, limit)?;
    let wide = |bytes: &[u8], unit: fn([u8; 2]) -> u16| {
        let units = bytes.chunks_exact(2).map(|pair| unit([pair[0], pair[1]]));
        char::decode_utf16(units).map(|c| c.unwrap_or(char::REPLACEMENT_CHARACTER)).collect()
    };
    Ok(match bytes.as_slice() {
        [0xFF, 0xFE, rest @ ..] => wide(rest, u16::from_le_bytes),
        [0xFE, 0xFF, rest @ ..] => wide(rest, u16::from_be_bytes),
        [0xEF, 0xBB, 0xBF, rest @ ..] => String::from_utf8_lossy(rest).into_owned(),
        _ if bytes.contains(&0) => return Err(FormatError::invalid(path, "not a text")),
        _ => String::from_utf8(bytes).unwrap_or_else(|e| e.as_bytes().iter().map(|b| char::from(*b)).collect()),
    })
}

/// A number with a decimal point or a decimal comma; `None` where it is none or not finite.
pub(crate) fn number(cell: &str) -> Option<f64> {
    let cell = cell.trim().trim_end_matches(['°', ',']);
    let parsed = cell.parse::<f64>().or_else(|_| cell.replacen(',', ".", 1).parse());
    parsed.ok().filter(|v| v.is_finite())
}

/// Which way a coordinate counts.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Axis {
    /// Longitude or easting.
    East,
    /// Latitude or northing.
    North,
}

/// A coordinate as a number, or as degrees, minutes and seconds with or without the letter of its hemisphere (`46 deg 50' 33.36" N`).
pub(crate) fn angle(cell: &str, axis: Axis) -> Option<f64> {
    if let Some(plain) = number(cell) {
        return Some(plain);
    }
    let halves = match axis {
        Axis::East => ['E', 'W'],
        Axis::North => ['N', 'S'],
    };
    let upper = cell.trim().to_uppercase();
    let half = halves.into_iter().find(|h| upper.starts_with(*h) || upper.ends_with(*h));
    let bare = half.map_or(upper.as_str(), |h| upper.trim_matches(h)).replace("DEG", " ");
    let parts: Vec<&str> =
        bare.split(|c: char| c.is_whitespace() || "°'\"′″’”:".contains(c)).filter(|p| !p.is_empty()).collect();
    if parts.is_empty() || parts.len() > 3 || (half.is_none() && parts.len() == 1) {
        return None;
    }
    let mut value = 0.0;
    for (part, share) in parts.iter().zip([1.0, 60.0, 3600.0]) {
        let part = number(part).filter(|v| share == 1.0 || (0.0..60.0).contains(v))?;
        value += part.abs() / share;
    }
    let is_negative = half == Some(halves[1]) || parts.first().is_some_and(|p| p.starts_with('-'));
    Some(if is_negative { -value } else { value })
}

/// A height as a number, with or without its unit and scale (`198.3 m Above Sea Level`).
pub(crate) fn height(cell: &str) -> Option<f64> {
    let lower = cell.trim().to_lowercase();
    let (value, rest) = lower.split_once(|c: char| c.is_whitespace() || c == 'm').unwrap_or((&lower, ""));
    match rest.trim().trim_start_matches('m').trim() {
        "" | "above sea level" => number(value),
        "below sea level" => number(value).map(|v| -v.abs()),
        _ => None,
    }
}

/// The cells of a line: between semicolons, tabs, commas or blanks, whichever it has first in this order. A comma between two digits
/// of a line that blanks cut into three cells or more is a decimal one.
pub(crate) fn cells(line: &str) -> Vec<&str> {
    let tidy = |cell: &str| -> std::ops::Range<usize> {
        let bare = cell.trim().trim_matches('"').trim();
        let from = bare.as_ptr() as usize - line.as_ptr() as usize;
        from..from + bare.len()
    };
    let digit = |at: Option<usize>| at.and_then(|i| line.as_bytes().get(i)).is_some_and(u8::is_ascii_digit);
    let decimal = |at: usize| digit(at.checked_sub(1)) && digit(Some(at + 1));
    let blanks: Vec<&str> = unquoted(line, char::is_whitespace).filter(|cell| !cell.is_empty()).collect();
    let separator = [';', '\t', ','].into_iter().find(|s| unquoted(line, |c| c == *s).nth(1).is_some());
    let decimal_commas = separator == Some(',')
        && blanks.len() >= 3
        && blanks.iter().all(|cell| cell.matches(',').count() <= 1)
        && line.match_indices(',').all(|(at, _)| decimal(at));
    let cells: Vec<&str> = match separator.filter(|_| !decimal_commas) {
        Some(separator) => unquoted(line, |c| c == separator).collect(),
        None => blanks,
    };
    cells.into_iter().map(|cell| &line[tidy(cell)]).collect()
}

/// The parts of `line` between what `separates`, outside of quotation marks.
fn unquoted(line: &str, separates: impl Fn(char) -> bool) -> impl Iterator<Item = &str> {
    let mut quoted = false;
    line.split(move |c: char| {
        quoted ^= c == '"';
        !quoted && separates(c)
    })
}

/// Whether a cell ends as names of pictures do.
pub(crate) fn is_picture(cell: &str) -> bool {
    PICTURES.iter().any(|e| cell.to_lowercase().ends_with(e))
}

/// A picture's name at the beginning of `cells`, and how many of them it takes: blanks may have cut it up.
pub(crate) fn picture_name(cells: &[&str]) -> Option<(String, usize)> {
    let taken = cells.iter().take(8).position(|cell| is_picture(cell)).map_or(1, |last| last + 1);
    let name = cells.get(..taken)?.join(" ");
    (!name.is_empty()).then_some((name, taken))
}

/// A reference system that places are given in: any that the library knows, degrees included.
pub struct Reference {
    geographic: Proj,
    source: Proj,
}

impl Reference {
    /// By its name: `EPSG:32615` in any spelling, `EPSG:32615+5703` (heights are taken as they are), `WGS84`, `WGS 84 / UTM zone 15N`,
    /// a PROJ string, or WKT with an EPSG code.
    ///
    /// `None` where `line` names none; an error where it does, and the system is not known.
    pub fn named(line: &str) -> Option<Result<Self, String>> {
        let line = line
            .trim()
            .trim_start_matches('\u{feff}')
            .trim_start_matches('#')
            .trim()
            .trim_matches(['"', ';', ','])
            .trim();
        // Metashape writes what it is before it: `CoordinateSystem: GEOGCS[…`.
        let line = match line.split_once(':') {
            Some((before, after)) if before.chars().all(char::is_alphabetic) && before.len() > 5 => after.trim(),
            _ => line,
        };
        let upper = line.to_uppercase();
        let of = |source: Result<Proj, String>| {
            let geographic = geographic().ok_or_else(|| "WGS 84 is not known".to_owned());
            Some(source.and_then(|source| Ok(Self { geographic: geographic?, source })))
        };
        let by_code = |code: u32| {
            let known = u16::try_from(code).ok().and_then(|code| match code {
                4326 | 4979 => geographic(),
                code => definition(code).ok(),
            });
            of(known.ok_or_else(|| format!("EPSG:{code} is not known to this build")))
        };
        let may_hold_a_code = upper.contains("+INIT=EPSG:") || !(upper.starts_with('+') || is_wkt(&upper));
        if let Some(code) = epsg_code(&upper).filter(|_| may_hold_a_code) {
            return by_code(code);
        }
        if upper.starts_with("+PROJ") {
            let words = line.split_whitespace().filter(|word| !word.to_lowercase().starts_with("+type="));
            let text = words.collect::<Vec<_>>().join(" ");
            return of(Proj::from_proj_string(&text).map_err(|e| format!("{line:?} cannot be read ({e})")));
        }
        if is_wkt(&upper) {
            // Without a code, a name of its own may be one that is known.
            let name = line.split('"').nth(1).filter(|name| !is_wkt(&name.to_uppercase()));
            return match (wkt_code(&upper), name.and_then(Self::named)) {
                (Some(code), _) => by_code(code),
                (None, Some(Ok(known))) => Some(Ok(known)),
                (None, _) => Some(Err("is WKT without an EPSG code of its own; write EPSG:CODE".to_owned())),
            };
        }
        let plain: String = upper.chars().map(|c| if "/()_".contains(c) { ' ' } else { c }).collect();
        let words: Vec<&str> =
            plain.split_whitespace().filter(|word| !["ZONE", "LONGLAT", "LATLONG", "-"].contains(word)).collect();
        let (datum, rest) = match words.as_slice() {
            ["WGS84" | "WGS1984", rest @ ..] | ["WGS", "84" | "1984", rest @ ..] => ("WGS84", rest),
            ["ETRS89", rest @ ..] | ["ETRS", "89", rest @ ..] => ("ETRS89", rest),
            ["NAD83", rest @ ..] | ["NAD", "83", rest @ ..] => ("NAD83", rest),
            rest @ ["UTM", ..] => ("WGS84", rest),
            _ => return None,
        };
        match (datum, rest) {
            (_, []) => of(geographic().ok_or_else(|| "WGS 84 is not known".to_owned())),
            (datum, ["UTM", zone @ ..]) => {
                let zone = zone.concat();
                let digits: String = zone.chars().take_while(char::is_ascii_digit).collect();
                let south = match &zone[digits.len()..] {
                    "" | "N" | "NORTH" => Some(false),
                    "S" | "SOUTH" => Some(true),
                    // A band of the military grid: C to M lie in the south.
                    band if band.len() == 1 => ('C'..='X').contains(&band.chars().next()?).then(|| band < "N"),
                    _ => None,
                };
                let number = digits.parse::<u16>().ok().filter(|n| UTM_ZONES.contains(n)).zip(south);
                match (datum, number) {
                    ("ETRS89", Some((number @ 28..=38, false))) => by_code(25_800 + u32::from(number)),
                    ("NAD83", Some((number @ 1..=23, false))) => by_code(26_900 + u32::from(number)),
                    ("WGS84", Some((number, south))) => {
                        by_code(u32::from(number + if south { UTM_SOUTH } else { UTM_NORTH }))
                    }
                    _ => Some(Err(format!("{line:?}: UTM has zones 1 to 60, north or south"))),
                }
            }
            _ => None,
        }
    }

    /// Whether its first two coordinates are angles.
    pub fn is_in_degrees(&self) -> bool {
        self.source.is_latlong()
    }

    /// Easting, northing (or longitude and latitude in degrees) and height → WGS 84; `None` outside of the projection.
    pub fn geodetic(&self, p: DVec3) -> Option<Geodetic> {
        let unit = |v: f64| if self.source.is_latlong() { v.to_radians() } else { v };
        let mut at = (unit(p.x), unit(p.y), 0.0);
        transform(&self.source, &self.geographic, &mut at).ok()?;
        let place = Geodetic { lat_deg: at.1.to_degrees(), lon_deg: at.0.to_degrees(), alt_m: p.z };
        place.is_valid().then_some(place)
    }

    /// WGS 84 → easting and northing (or longitude and latitude in degrees); `None` outside of the projection.
    pub fn plane(&self, place: Geodetic) -> Option<DVec2> {
        let mut at = (place.lon_deg.to_radians(), place.lat_deg.to_radians(), 0.0);
        transform(&self.geographic, &self.source, &mut at).ok()?;
        let unit = |v: f64| if self.source.is_latlong() { v.to_degrees() } else { v };
        Some(DVec2::new(unit(at.0), unit(at.1))).filter(|p| p.is_finite())
    }
}

/// Well-known text of either edition.
fn is_wkt(upper: &str) -> bool {
    let kinds = ["PROJCS[", "GEOGCS[", "COMPD_CS[", "PROJCRS[", "GEOGCRS[", "GEODCRS[", "COMPOUNDCRS[", "BOUNDCRS["];
    kinds.iter().any(|kind| upper.starts_with(kind))
}

/// `EPSG:32615`, `EPSG 32615`, `EPSG::32615`, `…/EPSG/0/32615`, `32615`, `…(EPSG::4326)`: the first code after the word, or a line that is
/// a number.
fn epsg_code(upper: &str) -> Option<u32> {
    let Some((_, after)) = upper.split_once("EPSG") else {
        return upper.parse().ok().filter(|n| (1024..=u32::from(u16::MAX)).contains(n));
    };
    // An authority's version may stand before the code.
    let after = after.strip_prefix("/0").unwrap_or(after).trim_start_matches([':', '/', ' ', '"', ',', '=']);
    let digits: String = after.chars().take_while(char::is_ascii_digit).collect();
    digits.parse().ok()
}

/// The code of the outermost reference system of a well-known text; of its horizontal part, where it has a vertical one, too.
fn wkt_code(upper: &str) -> Option<u32> {
    let horizontal =
        ["PROJCS[", "PROJCRS[", "GEOGCS[", "GEOGCRS[", "GEODCRS["].iter().filter_map(|kind| upper.find(kind)).min()?;
    let text = &upper[horizontal..];
    let (mut depth, mut end) = (0usize, text.len());
    let mut own = None;
    for (at, c) in text.char_indices() {
        match c {
            '[' => depth += 1,
            ']' => {
                depth = depth.saturating_sub(1);
                if depth == 0 {
                    end = at;
                    break;
                }
            }
            'A' | 'I' if depth == 1 && (text[at..].starts_with("AUTHORITY[") || text[at..].starts_with("ID[")) => {
                own = Some(at)
            }
            _ => {}
        }
    }
    let own = text.get(own?..end)?;
    own.contains("EPSG").then(|| epsg_code(own))?
}

/// Longitude and latitude on WGS 84.
pub(crate) fn geographic() -> Option<Proj> {
    Proj::from_proj_string("+proj=longlat +datum=WGS84 +no_defs").ok()
}

/// A reference system by its EPSG code, or why there is none.
#[cfg(feature = "epsg")]
pub(crate) fn definition(code: u16) -> Result<Proj, &'static str> {
    Proj::from_epsg_code(code).map_err(|_| "is not known")
}

/// Without the table of all codes: UTM on WGS 84.
#[cfg(not(feature = "epsg"))]
pub(crate) fn definition(code: u16) -> Result<Proj, &'static str> {
    const UNKNOWN: &str = "is not one of UTM on WGS 84, all that this build knows";
    let (zone, south) =
        if code > UTM_SOUTH { (code - UTM_SOUTH, " +south") } else { (code.saturating_sub(UTM_NORTH), "") };
    if !UTM_ZONES.contains(&zone) {
        return Err(UNKNOWN);
    }
    Proj::from_proj_string(&format!("+proj=utm +zone={zone}{south} +datum=WGS84 +units=m +no_defs"))
        .map_err(|_| UNKNOWN)
}

#[cfg(test)]
mod tests {
    use super::*;

    const DEGREES: [&str; 13] = [
        "WGS84",
        "wgs 84",
        "WGS84 longlat",
        "EPSG:4326",
        "epsg: 4326",
        "EPSG 4326",
        "EPSG::4326",
        "urn:ogc:def:crs:EPSG::4326",
        "+proj=longlat +datum=WGS84 +no_defs +type=crs",
        "#CoordinateSystem: WGS 84 (EPSG::4326)",
        "\u{feff}EPSG:4326",
        r#"# CoordinateSystem: GEOGCS["WGS 84",DATUM["World Geodetic System 1984",AUTHORITY["EPSG","6326"]],AUTHORITY["EPSG","4326"]]"#,
        r#"GEOGCS["WGS 84",DATUM["World Geodetic System 1984"]]"#,
    ];
    const UTM: [&str; 13] = [
        "WGS84 UTM 15N",
        "WGS84 UTM 15 N",
        "WGS 84 / UTM zone 15N",
        "UTM 15T",
        "WGS84 UTM 15",
        "EPSG:32615",
        "EPSG:32615+5703",
        "32615",
        "http://www.opengis.net/def/crs/EPSG/0/32615",
        "+proj=utm +zone=15 +datum=WGS84 +units=m +no_defs",
        "+init=epsg:32615",
        r#"PROJCS["WGS 84 / UTM zone 15N",GEOGCS["WGS 84",AUTHORITY["EPSG","4326"]]]"#,
        r#"COMPD_CS["a + b",PROJCS["WGS 84 / UTM zone 15N",GEOGCS["WGS 84",AUTHORITY["EPSG","4326"]],AUTHORITY["EPSG","32615"]],VERT_CS["b",AUTHORITY["EPSG","5703"]]]"#,
    ];

    #[test]
    fn a_reference_system_is_known_in_every_spelling_people_use() {
        let of =
            |line: &str| Reference::named(line).and_then(Result::ok).unwrap_or_else(|| panic!("{line} is not known"));
        for line in DEGREES {
            let place = of(line).geodetic(DVec3::new(-91.9943, 46.8425, 158.9));
            assert!(place.is_some_and(|p| (p.lat_deg - 46.8425).abs() < 1e-9 && p.alt_m == 158.9), "{line}: {place:?}");
        }
        for line in UTM {
            let place = of(line).geodetic(DVec3::new(576_689.183, 5_188_174.180, 158.509));
            let near =
                |p: Geodetic| (p.lat_deg - 46.842_690_67).abs() < 1e-7 && (p.lon_deg + 91.994_216_22).abs() < 1e-7;
            assert!(place.is_some_and(near), "{line}: {place:?}");
        }
        let south = of("WGS84 UTM 23S").geodetic(DVec3::new(316_675.449, 7_405_032.799, 939.968));
        assert!(south.is_some_and(|p| (-24.0..-23.0).contains(&p.lat_deg)), "{south:?}");
    }

    #[test]
    fn what_names_no_reference_system_is_told_from_one_that_is_not_known() {
        for line in ["576700 5188100 158.9 312.2 187.6 a.jpg", "image,lat,lon,alt", "hello", "", "1 2 3"] {
            assert!(Reference::named(line).is_none(), "{line}");
        }
        for line in ["EPSG:1", "EPSG:102100", "WGS84 UTM 61N", "+proj=nonsense", r#"PROJCS["mine",UNIT["m",1]]"#] {
            let Some(Err(why)) = Reference::named(line) else { panic!("{line} is taken") };
            assert!(!why.contains('\n'), "{why}");
        }
    }

    #[test]
    fn cells_are_cut_where_people_mean_it() {
        assert_eq!(cells("576700,12 5188100,45 158,9 312 187 a.jpg").len(), 6);
        assert_eq!(cells("a.jpg, -91.5, 46.8,198"), ["a.jpg", "-91.5", "46.8", "198"]);
        assert_eq!(cells("\"a b.jpg\";7,5;46,25;"), ["a b.jpg", "7,5", "46,25", ""]);
        assert_eq!(cells("a.jpg,7.5,,400"), ["a.jpg", "7.5", "", "400"]);
        assert_eq!(cells("a\t7.5\t46"), ["a", "7.5", "46"]);
        assert_eq!(cells("\"a,b.jpg\", 1,\"2\""), ["a,b.jpg", "1", "2"]);
        assert_eq!(cells("\"a, b; c.jpg\" 1 2"), ["a, b; c.jpg", "1", "2"]);
        assert_eq!(
            [number("7,5"), number("+45.00"), number("nan"), number("1,2,3")],
            [Some(7.5), Some(45.0), None, None]
        );
        assert_eq!(picture_name(&["DJI", "0018.JPG", "gcp1"]), Some(("DJI 0018.JPG".to_owned(), 2)));
        assert_eq!(picture_name(&["DJI_0018", "gcp1"]), Some(("DJI_0018".to_owned(), 1)));
    }

    #[test]
    fn angles_and_heights_are_read_with_their_units() {
        for (cell, axis, expected) in [
            ("46 deg 50' 33.36\" N", Axis::North, 46.8426),
            ("91 deg 59' 40.20\"\" W", Axis::East, -91.9945),
            ("S 33\u{b0}30\u{2032}", Axis::North, -33.5),
            ("-33 30 0", Axis::North, -33.5),
            ("7.5 E", Axis::East, 7.5),
            ("7,5\u{b0}", Axis::East, 7.5),
        ] {
            assert!(angle(cell, axis).is_some_and(|v| (v - expected).abs() < 1e-9), "{cell}: {:?}", angle(cell, axis));
        }
        for cell in ["7.5 N", "7 60 0 E", "7 1 1 1 E", "x", "E", "7 -1 0"] {
            assert_eq!(angle(cell, Axis::East), None, "{cell}");
        }
        let heights = ["198.3", "198,3 m", "198.3m", "198.3 m Above Sea Level", "2 m Below Sea Level", "3 ft", "high"]
            .map(height);
        assert_eq!(heights, [Some(198.3), Some(198.3), Some(198.3), Some(198.3), Some(-2.0), None, None]);
    }

    #[test]
    fn a_text_is_read_in_the_encodings_that_spreadsheets_write() {
        let dir = tempfile::tempdir().expect("a folder");
        let path = dir.path().join("gcp_list.txt");
        let of = |bytes: &[u8]| {
            std::fs::write(&path, bytes).expect("written");
            text(&path, 1 << 10)
        };
        let wide = |order: fn(u16) -> [u8; 2]| "\u{feff}Gebäude".encode_utf16().flat_map(order).collect::<Vec<u8>>();
        for bytes in [
            wide(u16::to_le_bytes),
            wide(u16::to_be_bytes),
            "\u{feff}Gebäude".into(),
            "Gebäude".into(),
            b"Geb\xe4ude".to_vec(),
        ] {
            assert_eq!(of(&bytes).expect("a text"), "Gebäude", "{bytes:?}");
        }
        assert!(of(b"\x00\x01\x02").is_err());
    }
}
