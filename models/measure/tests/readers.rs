//! Polygons that people draw, against broken files.
#![allow(clippy::expect_used, clippy::panic, reason = "a test fails by panicking")]

use measure::areas;

#[path = "../../../tests/readers/driver.rs"]
mod driver;

use driver::{Read, Reader, line, survive};

/// Reads them onto a map of EPSG:32632, or one that says nothing of where it lies.
fn survive_as(name: &'static str, file: &'static str, epsg: Option<u16>, seeds: &[String]) {
    survive(&Reader {
        name,
        seeds: seeds.iter().map(|s| s.as_bytes().to_vec()).collect(),
        text: true,
        shell: None,
        memory: (96 << 10, 256),
        read: Read::File(file, &|path| {
            let is_drawn = |a: &areas::Area| a.rings().flatten().all(|p| p.is_finite()) && a.area_m2().is_finite();
            let sound = |found: areas::Areas| !found.areas.is_empty() && found.areas.iter().all(is_drawn);
            // Where a survey is to be flown.
            let to_fly = line(areas::read_degrees(path), sound);
            match line(areas::read(path, epsg), sound) {
                Ok(sound) => Ok(sound && to_fly != Ok(false)),
                Err(why) if to_fly == Ok(false) => Err(format!("{why}\nthough it is flown")),
                Err(why) => Err(why),
            }
        }),
    });
}

#[test]
fn polygons_of_geojson() {
    let feature = |name: &str, kind: &str, coordinates: &str| {
        format!(
            "{{\"type\":\"Feature\",\n\"properties\":{{\"name\":\"{name}\"}},\n\"geometry\":{{\"type\":\"{kind}\",\n\"coordinates\":{coordinates}}}}}"
        )
    };
    let collection = |system: &str, features: &[String]| {
        format!("{{\"type\":\"FeatureCollection\",\n{system}\"features\":[\n{}\n]}}\n", features.join(",\n"))
    };
    let heap = "[[\n[9.0,47.0],\n[9.01,47.0],\n[9.01,47.01],\n[9.0,47.01],\n[9.0,47.0]\n],[\n[9.002,47.002],\n[9.004,47.002],\n[9.003,47.004],\n[9.002,47.002]\n]]";
    let degrees = [
        feature("heap", "Polygon", heap),
        feature("", "MultiPolygon", &format!("[{heap}]")),
        feature("p", "Point", "[1,2]"),
    ];
    let metres = "[[\n[500000.0,5205000],\n[500100,5205000.5],\n[500000,5205100],\n[500000.0,5205000]\n]]";
    let named = "\"crs\":{\"type\":\"name\",\n\"properties\":{\"name\":\"urn:ogc:def:crs:EPSG::32632\"}},\n";
    let seeds = [collection("", &degrees), collection(named, &[feature("b", "Polygon", metres)])];
    survive_as("geojson", "areas.geojson", Some(32632), &seeds);
    let own = collection("", &[feature("b", "Polygon", metres), feature("c", "Polygon", "[[[0,0],\n[4,0],\n[4,3]]]")]);
    survive_as("geojson-metres", "areas.json", None, &[own]);
}

#[test]
fn polygons_of_kml() {
    let ring = |side: &str, corners: &str| {
        format!("<{side}>\n<LinearRing>\n<coordinates>\n{corners}\n</coordinates>\n</LinearRing>\n</{side}>\n")
    };
    let outside = ring("outerBoundaryIs", "9.0,47.0,0\n9.01,47.0,0\n9.01,47.01,0\n9.0,47.01\n9.0,47.0,0");
    let hole = ring("innerBoundaryIs", "9.002,47.002 9.004,47.002\n9.003,47.004");
    let placemark = |name: &str, rings: &str| {
        format!("<Placemark>\n<name>{name}</name>\n<Polygon>\n{rings}</Polygon>\n</Placemark>\n")
    };
    let document = |of: &str| {
        format!(
            "<?xml version=\"1.0\" encoding=\"UTF-8\"?>\n<kml xmlns=\"http://www.opengis.net/kml/2.2\">\n<Document>\n{of}</Document>\n</kml>\n"
        )
    };
    let both = [placemark("heap", &format!("{outside}{hole}")), placemark("a &amp; b", &outside)].concat();
    let folder = format!("<Folder>\n{}</Folder>\n", placemark("one", &outside));
    survive_as("kml", "areas.kml", Some(32632), &[document(&both), document(&folder)]);
}

#[test]
fn fences_of_a_plan() {
    let corners = "[\n[47.0,8.0],\n[47.0,8.01],\n[47.01,8.01],\n[47.01,8.0]\n]";
    let circle = "{\"circle\":{\"center\":[47.005,\n8.005],\n\"radius\":100\n},\n\"inclusion\":false,\n\"version\":1}";
    let plan = |polygons: &str, circles: &str| {
        format!(
            "{{\"fileType\":\"Plan\",\n\"geoFence\":{{\n\"polygons\":[{polygons}],\n\"circles\":[{circles}]}},\n\"mission\":{{\"items\":[]}}}}"
        )
    };
    let inside = format!("{{\"inclusion\":true,\n\"polygon\":{corners},\n\"version\":1}}");
    survive_as("fence", "area.plan", Some(32632), &[plan(&inside, circle), plan(&inside, "")]);
}
