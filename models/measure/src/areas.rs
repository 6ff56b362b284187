//! Polygons that people draw: GeoJSON, KML or the fence of a QGroundControl plan, known by their content.

use std::path::Path;

use geometry::geodesy::{EnuFrame, Geodetic};
use geometry::polygon;
use glam::{DVec2, DVec3};
use models::formats::FormatError;
use serde_json::Value;
use survey::coordinates::{self, Reference};
use survey::xml;

use crate::MeasureError;

/// Far more than anybody draws, bytes and corners.
const LIMIT: u64 = 64 << 20;
const MOST_CORNERS: usize = 100_000;
/// Lines on which an area is told once more, and the share by which that may differ from what its corners say.
const LINES: usize = 2048;
const CROSSED: f64 = 0.02;
/// A name longer than this is cut.
const MOST_LETTERS: usize = 80;
/// The system that GeoJSON has by its standard (RFC 7946) and older files name.
const DEGREES: &str = "CRS84";
/// Corners that stand for the circle of a fence, and its largest radius, metres.
const CIRCLE: usize = 64;
const WIDEST_M: f64 = 100_000.0;

/// A polygon on a map.
#[derive(Clone, Debug, PartialEq)]
pub struct Area {
    /// What its file calls it, or its number.
    pub name: String,
    /// Corners of its outside, map coordinates; the last is joined to the first.
    pub outside: Vec<DVec2>,
    /// What is cut out of it.
    pub holes: Vec<Vec<DVec2>>,
}

impl Area {
    /// Its outside, then its holes.
    pub fn rings(&self) -> impl Iterator<Item = &[DVec2]> {
        std::iter::once(&self.outside).chain(&self.holes).map(Vec::as_slice)
    }

    /// The lower and the upper corner of the box around it.
    pub fn bounds(&self) -> [DVec2; 2] {
        let corners = self.outside.iter();
        corners.fold([DVec2::INFINITY, DVec2::NEG_INFINITY], |[low, high], p| [low.min(*p), high.max(*p)])
    }

    /// Its area by lines across it, where what lies inside an odd number of rings counts.
    fn by_lines_m2(&self) -> f64 {
        let [low, high] = self.bounds();
        let step = (high.y - low.y) / LINES as f64;
        let mut crossings = Vec::new();
        let mut length = 0.0;
        for line in 0..LINES {
            let y = low.y + (line as f64 + 0.5) * step;
            crossings.clear();
            for ring in self.rings() {
                crossings.extend(polygon::crossings(ring, y));
            }
            crossings.sort_unstable_by(f64::total_cmp);
            length += crossings.as_chunks::<2>().0.iter().map(|[from, to]| to - from).sum::<f64>();
        }
        length * step
    }

    /// Its area without its holes, m².
    pub fn area_m2(&self) -> f64 {
        let holes: f64 = self.holes.iter().map(|h| polygon::signed_area(h).abs()).sum();
        polygon::signed_area(&self.outside).abs() - holes
    }
}

/// What a file holds.
#[derive(Clone, Debug, PartialEq)]
pub struct Areas {
    /// Its polygons, in the map's coordinates.
    pub areas: Vec<Area>,
    /// Features that are no polygons.
    pub others: usize,
    /// They are the fence of a plan: nobody may leave them.
    pub fence: bool,
}

/// Reads the polygons of a file for a map in `epsg`. Of a map that names no reference system, corners are in its own metres.
///
/// # Errors
/// The file cannot be read, is none of those known, holds no polygon, or names a reference system that is not known.
pub fn read(path: &Path, epsg: Option<u16>) -> Result<Areas, MeasureError> {
    let drawn = drawn(path)?;
    let bad = |what: String| MeasureError::File(FormatError::invalid(path, what));
    let place = Placing::new(drawn.system.as_deref(), epsg).map_err(bad)?;
    let areas = placed(path, drawn, &place)?;
    for area in &areas.areas {
        let (corners, lines) = (area.area_m2(), area.by_lines_m2());
        if (corners - lines).abs() > CROSSED * corners.max(lines) {
            let why = "its sides cross each other, or a hole is not inside of it";
            return Err(bad(format!("polygon {:?}: {why}", area.name)));
        }
    }
    Ok(areas)
}

/// Reads the polygons of a file as longitude (x) and latitude (y), degrees. Whether sides cross, and whether holes lie inside, is left
/// to the caller.
///
/// # Errors
/// As [`read`].
pub fn read_degrees(path: &Path) -> Result<Areas, MeasureError> {
    let drawn = drawn(path)?;
    let bad = |what: String| MeasureError::File(FormatError::invalid(path, what));
    let place = Placing { through: Some((named(drawn.system.as_deref()).map_err(bad)?, None)) };
    placed(path, drawn, &place)
}

/// What is drawn in a file.
fn drawn(path: &Path) -> Result<Drawn, MeasureError> {
    let bad = |what: String| MeasureError::File(FormatError::invalid(path, what));
    let text = coordinates::text(path, LIMIT)?;
    let drawn = match text.trim_start() {
        text if text.starts_with('{') => from_json(text).map_err(bad)?,
        text if text.starts_with('<') => from_kml(text).map_err(bad)?,
        _ => {
            return Err(bad(
                "is neither GeoJSON, KML (of a .kmz, unpack the .kml in it) nor a .plan with a fence".into()
            ));
        }
    };
    if drawn.polygons.is_empty() {
        return Err(bad(format!("holds no polygon ({} features of other kinds)", drawn.others)));
    }
    if drawn.polygons.iter().flat_map(|(_, rings)| rings).map(Vec::len).sum::<usize>() > MOST_CORNERS {
        return Err(bad(format!("has more than {MOST_CORNERS} corners")));
    }
    Ok(drawn)
}

fn placed(path: &Path, drawn: Drawn, place: &Placing) -> Result<Areas, MeasureError> {
    let bad = |what: String| MeasureError::File(FormatError::invalid(path, what));
    let mut areas = Vec::with_capacity(drawn.polygons.len());
    for (k, (name, rings)) in drawn.polygons.into_iter().enumerate() {
        let name = tidy(&name).unwrap_or_else(|| (k + 1).to_string());
        let mut rings = rings.into_iter().map(|ring| ring.into_iter().map(|p| place.put(p)).collect());
        let wrong = |why: String| bad(format!("polygon {name:?}: {why}"));
        let outside = ring(rings.next().unwrap_or_else(|| Ok(Vec::new())).map_err(wrong)?).map_err(wrong)?;
        let holes: Result<Vec<_>, String> = rings.map(|r| ring(r?)).collect();
        areas.push(Area { holes: holes.map_err(wrong)?, outside, name: name.clone() });
    }
    Ok(Areas { areas, others: drawn.others, fence: drawn.fence })
}

/// A name as one short line.
fn tidy(name: &str) -> Option<String> {
    let line: String = name.chars().map(|c| if c.is_control() { ' ' } else { c }).take(MOST_LETTERS).collect();
    Some(line.trim().to_owned()).filter(|name| !name.is_empty())
}

/// A ring without the corner that repeats its first.
fn ring(mut corners: Vec<DVec2>) -> Result<Vec<DVec2>, String> {
    corners.dedup();
    if corners.len() > 1 && corners.first() == corners.last() {
        corners.pop();
    }
    let area = polygon::signed_area(&corners);
    if corners.len() < 3 || area == 0.0 || !area.is_finite() {
        return Err("a ring of fewer than three corners, or without an area".into());
    }
    Ok(corners)
}

/// From the file's coordinates to the map's.
struct Placing {
    /// `None`: the file's are the map's. Degrees have no reference system of their own.
    through: Option<(Option<Reference>, Option<Reference>)>,
}

impl Placing {
    /// `system` is what the file says of itself.
    fn new(system: Option<&str>, epsg: Option<u16>) -> Result<Self, String> {
        let Some(code) = epsg else {
            return match system {
                Some(name) => Err(format!("is in {name}, and the map says nowhere on Earth it lies")),
                None => Ok(Self { through: None }),
            };
        };
        let map = Reference::named(&format!("EPSG:{code}")).ok_or("EPSG:… is not known")??;
        Ok(Self { through: Some((named(system)?, Some(map))) })
    }

    fn put(&self, p: DVec2) -> Result<DVec2, String> {
        let Some((from, to)) = &self.through else { return Ok(p) };
        let place = match from {
            Some(from) => from.geodetic(p.extend(0.0)),
            None => Some(Geodetic { lat_deg: p.y, lon_deg: p.x, alt_m: 0.0 }).filter(Geodetic::is_valid),
        };
        let unit =
            if from.is_some() { "outside of its reference system" } else { "not longitude and latitude in degrees" };
        let place = place.ok_or_else(|| format!("{}, {} is {unit}", p.x, p.y))?;
        let Some(to) = to else { return Ok(DVec2::new(place.lon_deg, place.lat_deg)) };
        to.plane(place).ok_or_else(|| format!("{}, {} is outside of the map's reference system", p.x, p.y))
    }
}

/// The reference system that a file names, unless it is in degrees.
fn named(system: Option<&str>) -> Result<Option<Reference>, String> {
    let Some(name) = system.filter(|name| !name.ends_with(DEGREES)) else { return Ok(None) };
    let spelled = name.rsplit_once("EPSG:").map_or(name, |(_, code)| code.trim_start_matches(':'));
    let spelled = if spelled == name { name.to_owned() } else { format!("EPSG:{spelled}") };
    Reference::named(&spelled)
        .ok_or_else(|| format!("names a reference system ({name:?}) that is not known"))?
        .map(Some)
}

/// Polygons as they are written: names, rings (the outside first).
#[derive(Default)]
struct Drawn {
    system: Option<String>,
    polygons: Vec<(String, Vec<Vec<DVec2>>)>,
    /// Features that are no polygons.
    others: usize,
    fence: bool,
}

fn from_json(text: &str) -> Result<Drawn, String> {
    let file: Value = serde_json::from_str(text).map_err(|e| format!("no GeoJSON ({e})"))?;
    match file["fileType"].as_str() {
        Some("Plan") => from_fence(&file["geoFence"]),
        _ => from_geojson(&file),
    }
}

/// The fence of a plan ("Plan File Format" of QGroundControl's developer guide): what must not be flown over is cut out of each polygon
/// that must not be left.
fn from_fence(fence: &Value) -> Result<Drawn, String> {
    let list = |name: &str| fence[name].as_array().map_or(&[][..], Vec::as_slice).iter();
    let inclusion = |shape: &Value| shape["inclusion"].as_bool().ok_or("its fence does not say what is inside");
    let (mut inside, mut cut) = (Vec::new(), Vec::new());
    for shape in list("polygons") {
        let corners = shape["polygon"].as_array().ok_or("a polygon of its fence has no corners")?;
        let ring: Result<Vec<DVec2>, String> =
            corners.iter().map(|p| corner(p).map(|p| DVec2::new(p.y, p.x))).collect();
        if inclusion(shape)? { &mut inside } else { &mut cut }.push(ring?);
    }
    for shape in list("circles") {
        let (center, radius) = (corner(&shape["circle"]["center"])?, shape["circle"]["radius"].as_f64());
        let center = Geodetic { lat_deg: center.x, lon_deg: center.y, alt_m: 0.0 };
        let radius = radius.filter(|r| *r > 0.0 && *r <= WIDEST_M && center.is_valid());
        let radius = radius.ok_or("a circle of its fence has no place or radius")?;
        let frame = EnuFrame::new(center);
        let ring = (0..CIRCLE).map(|k| {
            let way = DVec2::from_angle(std::f64::consts::TAU * k as f64 / CIRCLE as f64) * radius;
            let at = frame.to_geodetic(DVec3::new(way.x, way.y, 0.0));
            DVec2::new(at.lon_deg, at.lat_deg)
        });
        if inclusion(shape)? { &mut inside } else { &mut cut }.push(ring.collect());
    }
    if inside.is_empty() {
        return Err("its fence holds no polygon or circle that must not be left; draw one in QGroundControl".into());
    }
    let corners = |rings: &[Vec<DVec2>]| rings.iter().map(|ring| ring.len() + 1).sum::<usize>();
    if inside.len().saturating_mul(corners(&cut)).saturating_add(corners(&inside)) > MOST_CORNERS {
        return Err(format!("has more than {MOST_CORNERS} corners"));
    }
    let polygon = |outside| (String::new(), std::iter::once(outside).chain(cut.iter().cloned()).collect());
    let polygons: Vec<(String, Vec<Vec<DVec2>>)> = inside.into_iter().map(polygon).collect();
    Ok(Drawn { system: Some(DEGREES.into()), polygons, others: 0, fence: true })
}

fn from_geojson(file: &Value) -> Result<Drawn, String> {
    let system = file.pointer("/crs/properties/name").and_then(Value::as_str).map(str::to_owned);
    let mut drawn = Drawn { system, ..Drawn::default() };
    let mut others = 0;
    let alone = std::slice::from_ref(file);
    let features = file["features"].as_array().map_or(alone, Vec::as_slice);
    for feature in features {
        let geometry = if feature["geometry"].is_object() { &feature["geometry"] } else { feature };
        let properties = &feature["properties"];
        let name = ["name", "Name", "NAME", "id", "fid"].iter().find_map(|key| match &properties[*key] {
            Value::String(name) => Some(name.clone()),
            Value::Number(number) => Some(number.to_string()),
            _ => None,
        });
        let name = name.unwrap_or_default();
        let coordinates = &geometry["coordinates"];
        match geometry["type"].as_str() {
            Some("Polygon") => drawn.polygons.push((name, rings(coordinates)?)),
            Some("MultiPolygon") => {
                let parts = coordinates.as_array().ok_or("a MultiPolygon without polygons")?;
                for (k, part) in parts.iter().enumerate() {
                    let name = if parts.len() > 1 { format!("{name} ({})", k + 1) } else { name.clone() };
                    drawn.polygons.push((name, rings(part)?));
                }
            }
            _ => others += 1,
        }
    }
    drawn.others = others;
    Ok(drawn)
}

fn corner(p: &Value) -> Result<DVec2, String> {
    match (p[0].as_f64(), p[1].as_f64()) {
        (Some(x), Some(y)) => Ok(DVec2::new(x, y)),
        _ => Err(format!("{p} is no corner")),
    }
}

fn rings(polygon: &Value) -> Result<Vec<Vec<DVec2>>, String> {
    let rings = polygon.as_array().ok_or("a polygon without rings")?;
    rings.iter().map(|ring| ring.as_array().ok_or("a ring without corners")?.iter().map(corner).collect()).collect()
}

fn from_kml(text: &str) -> Result<Drawn, String> {
    let document = xml::parse(text).map_err(|e| format!("no KML ({e})"))?;
    let mut drawn = Drawn { system: Some(DEGREES.into()), ..Drawn::default() };
    let mut others = 0;
    for placemark in document.descendants().filter(|n| is_called(n, "Placemark")) {
        let name = placemark.children().find(|n| is_called(n, "name")).and_then(|n| n.text()).unwrap_or_default();
        let polygons: Vec<_> = placemark.descendants().filter(|n| is_called(n, "Polygon")).collect();
        others += usize::from(polygons.is_empty());
        for (k, polygon) in polygons.iter().enumerate() {
            let of = |kind: &'static str| {
                let boundaries = polygon.children().filter(move |n| is_called(n, kind));
                boundaries.flat_map(|boundary| boundary.descendants().filter(|n| is_called(n, "coordinates")))
            };
            if of("outerBoundaryIs").count() != 1 {
                return Err(format!("a polygon of {name:?} has {} outer boundaries", of("outerBoundaryIs").count()));
            }
            // Some programs write several rings into one innerBoundaryIs.
            let rings: Result<Vec<_>, String> = of("outerBoundaryIs")
                .chain(of("innerBoundaryIs"))
                .map(|corners| corners.text().unwrap_or_default().split_whitespace().map(kml_corner).collect())
                .collect();
            let name = if polygons.len() > 1 { format!("{name} ({})", k + 1) } else { name.to_owned() };
            drawn.polygons.push((name, rings?));
        }
    }
    drawn.others = others;
    Ok(drawn)
}

/// `longitude,latitude[,height]`.
fn kml_corner(text: &str) -> Result<DVec2, String> {
    let mut numbers = text.split(',').map(|n| n.parse::<f64>().ok().filter(|v| v.is_finite()));
    match (numbers.next().flatten(), numbers.next().flatten()) {
        (Some(lon), Some(lat)) => Ok(DVec2::new(lon, lat)),
        _ => {
            Err(format!("{:?} is no corner (longitude,latitude)", text.chars().take(MOST_LETTERS).collect::<String>()))
        }
    }
}

/// Whether an element has this name, whatever version of KML's namespace it is in.
fn is_called(node: &roxmltree::Node<'_, '_>, name: &str) -> bool {
    node.is_element() && node.tag_name().name() == name
}

#[cfg(test)]
#[allow(clippy::unwrap_used, reason = "a test fails by panicking")]
mod tests {
    use super::*;

    fn read_text(text: &str, epsg: Option<u16>) -> Result<Areas, String> {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("areas");
        std::fs::write(&path, text).unwrap();
        read(&path, epsg).map_err(|e| e.to_string())
    }

    #[test]
    fn what_the_parser_quotes_of_a_file_begins_no_line_of_its_own() {
        for text in ["<kml/\n>", "<kml a='b'\u{1b}[2J/>", "{\"type\":\"a\\nb\"}"] {
            let said = read_text(text, None).unwrap_err();
            assert!(!said.contains(char::is_control), "{said:?}");
        }
    }

    #[test]
    fn degrees_a_named_system_and_the_maps_own_metres_meet_in_one_place() {
        let geojson = |crs: &str, at: [[f64; 2]; 3]| {
            let ring: Vec<_> = at.iter().chain(&at[..1]).collect();
            format!(
                r#"{{"type":"FeatureCollection",{crs}"features":[{{"type":"Feature","properties":{{"name":"heap\n1"}},
                "geometry":{{"type":"Polygon","coordinates":[{ring:?}]}}}},{{"geometry":{{"type":"Point","coordinates":[1,2]}}}}]}}"#
            )
        };
        // EPSG:32632, near 9° E, 47° N.
        let metres = [[500_000.0, 5_205_000.0], [500_100.0, 5_205_000.0], [500_000.0, 5_205_100.0]];
        let named = r#""crs":{"type":"name","properties":{"name":"urn:ogc:def:crs:EPSG::32632"}},"#;
        let by_name = read_text(&geojson(named, metres), Some(32632)).unwrap();
        let own = read_text(&geojson("", metres), None).unwrap();
        assert_eq!((by_name.areas.len(), by_name.others, by_name.areas[0].name.as_str()), (1, 1, "heap 1"));
        assert_eq!(own.areas[0].outside.len(), 3);
        assert!((own.areas[0].area_m2() - 5000.0).abs() < 1e-6);
        let apart = |a: &Areas, b: &Areas| {
            a.areas[0].outside.iter().zip(&b.areas[0].outside).map(|(a, b)| a.distance(*b)).fold(0.0, f64::max)
        };
        assert!(apart(&by_name, &own) < 1e-3);
        let map = Reference::named("EPSG:32632").unwrap().unwrap();
        let degrees = metres.map(|[x, y]| {
            let place = map.geodetic(DVec2::new(x, y).extend(0.0)).unwrap();
            [place.lon_deg, place.lat_deg]
        });
        assert!(apart(&read_text(&geojson("", degrees), Some(32632)).unwrap(), &own) < 1e-3);
        let corners: Vec<String> = degrees.iter().map(|[lon, lat]| format!("{lon},{lat},0")).collect();
        let kml = format!(
            "<?xml version='1.0'?><kml xmlns='http://www.opengis.net/kml/2.2'><Placemark><name>heap 1</name><Polygon>\
             <outerBoundaryIs><LinearRing><coordinates>{}</coordinates></LinearRing></outerBoundaryIs></Polygon></Placemark></kml>",
            corners.join("\n ")
        );
        let from_kml = read_text(&kml, Some(32632)).unwrap();
        assert!(apart(&from_kml, &own) < 1e-3);
        assert_eq!(from_kml.areas[0].name, "heap 1");
        let refused = read_text(&geojson("", metres), Some(32632)).unwrap_err();
        assert!(refused.contains("not longitude and latitude in degrees"), "{refused}");
        let refused = read_text(&kml, None).unwrap_err();
        assert!(refused.contains("nowhere on Earth"), "{refused}");
    }

    #[test]
    fn what_is_no_polygon_is_refused_in_one_line() {
        let nested = format!("<kml>{}</kml>", "<a>".repeat(9000));
        for (text, word) in [
            ("", "neither GeoJSON, KML"),
            ("{", "no GeoJSON"),
            (r#"{"type":"FeatureCollection","features":[]}"#, "no polygon"),
            (r#"{"type":"Polygon","coordinates":[[[0,0],[1,1],[0,0]]]}"#, "fewer than three corners"),
            (r#"{"type":"Polygon","coordinates":[[[0,0],[1,"a"],[0,0]]]}"#, "no corner"),
            (r#"{"type":"Polygon","coordinates":7}"#, "without rings"),
            (r#"{"type":"Polygon","coordinates":[[[0,0],[4,4],[4,0],[0,3],[0,0]]]}"#, "cross each other"),
            (
                r#"{"type":"Polygon","coordinates":[[[0,0],[4,0],[4,4],[0,0]],[[9,9],[11,9],[9,11],[9,9]]]}"#,
                "a hole is not inside",
            ),
            (nested.as_str(), "nested"),
            (
                "<kml><Placemark><Polygon><innerBoundaryIs><coordinates>0,0 4,0 4,4</coordinates></innerBoundaryIs></Polygon></Placemark></kml>",
                "0 outer boundaries",
            ),
            (
                "<kml><Placemark><Polygon><outerBoundaryIs><coordinates>1 2</coordinates></outerBoundaryIs></Polygon></Placemark></kml>",
                "no corner",
            ),
        ] {
            let said = read_text(text, None).unwrap_err();
            assert!(said.contains(word) && !said.contains('\n'), "{said}");
        }
    }

    #[test]
    fn the_fence_of_a_plan_is_an_area_in_degrees_and_circles_are_polygons() {
        let read_degrees = |text: &str| {
            let folder = tempfile::tempdir().unwrap();
            let path = folder.path().join("fence.plan");
            std::fs::write(&path, text).unwrap();
            super::read_degrees(&path).map_err(|e| e.to_string())
        };
        let plan = |fence: &str| format!(r#"{{"fileType":"Plan","geoFence":{fence},"mission":{{"items":[]}}}}"#);
        let square = r#"{"inclusion":true,"polygon":[[47.0,8.0],[47.0,8.01],[47.01,8.01],[47.01,8.0]],"version":1}"#;
        let circle = |inclusion: bool, radius: &str| {
            format!(r#"{{"circle":{{"center":[47.005,8.005],"radius":{radius}}},"inclusion":{inclusion},"version":1}}"#)
        };
        let both = plan(&format!(r#"{{"polygons":[{square}],"circles":[{}],"version":2}}"#, circle(false, "100")));
        let areas = read_degrees(&both).unwrap().areas;
        assert_eq!((areas.len(), areas[0].outside[1], areas[0].holes[0].len()), (1, DVec2::new(8.01, 47.0), CIRCLE));
        // In metres the circle has its area.
        let metres = read_text(&both, Some(32632)).unwrap().areas;
        let hole = polygon::signed_area(&metres[0].holes[0]).abs();
        assert!((hole / (std::f64::consts::PI * 1e4) - 1.0).abs() < 3e-3, "{hole}");
        for (fence, word) in [
            (r#"{"polygons":[],"circles":[]}"#.to_owned(), "holds no polygon or circle"),
            (format!(r#"{{"circles":[{}]}}"#, circle(true, "-3")), "no place or radius"),
            (r#"{"polygons":[{"polygon":[[1,2]]}]}"#.into(), "does not say what is inside"),
            (r#"{"polygons":[{"inclusion":true,"polygon":[[1,2],["a"]]}]}"#.into(), "no corner"),
        ] {
            let said = read_degrees(&plan(&fence)).unwrap_err();
            assert!(said.contains(word), "{said}");
        }
    }

    #[test]
    fn holes_are_cut_out_and_parts_of_one_feature_have_numbers() {
        let text = r#"{"type":"Feature","properties":{"id":7},"geometry":{"type":"MultiPolygon","coordinates":[
            [[[0,0],[4,0],[4,4],[0,4],[0,0]],[[1,1],[2,1],[2,2],[1,2],[1,1]]], [[[9,9],[10,9],[10,10],[9,9]]]]}}"#;
        let areas = read_text(text, None).unwrap().areas;
        assert_eq!(
            areas.iter().map(|a| (a.name.as_str(), a.area_m2())).collect::<Vec<_>>(),
            [("7 (1)", 15.0), ("7 (2)", 0.5)]
        );
        assert_eq!(areas[0].bounds(), [DVec2::ZERO, DVec2::splat(4.0)]);
    }

    #[test]
    fn all_rings_of_an_inner_boundary_are_holes() {
        let ring = |x: u32| format!("<LinearRing><coordinates>{x},1 {},1 {x},2</coordinates></LinearRing>", x + 1);
        let kml = format!(
            "<kml><Placemark><Polygon><outerBoundaryIs><coordinates>0,0 9,0 9,9 0,9</coordinates></outerBoundaryIs><innerBoundaryIs>{}{}\
             </innerBoundaryIs></Polygon></Placemark></kml>",
            ring(1),
            ring(5)
        );
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("two.kml");
        std::fs::write(&path, kml).unwrap();
        assert_eq!(super::read_degrees(&path).unwrap().areas[0].holes.len(), 2);
    }
}
