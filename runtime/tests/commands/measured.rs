//! What is measured on maps: volumes of polygons, and what changed between two dates.

use std::path::{Path, PathBuf};

use disk::Disk;
use glam::{DQuat, DVec2, DVec3};
use models::camera::{Intrinsics, Pose, View};
use models::cloud::GaussianCloud;
use models::formats::model::{self, ModelHeader};
use serde_json::Value;
use survey::ortho::crs::Crs;
use survey::ortho::files::{MapFiles, Pixels};
use survey::ortho::grid::Grid;

use super::{dgtr, error_line, has_device};

/// A map of 60 m by 60 m at 0.2 m in its own metres.
fn map(folder: &Path, height: impl Fn(DVec2) -> f64) -> PathBuf {
    map_of(folder, 30.0, height)
}

/// One of another half side, metres.
fn map_of(folder: &Path, half: f64, height: impl Fn(DVec2) -> f64) -> PathBuf {
    let grid = Grid::new(Crs::local(), [DVec2::splat(-half), DVec2::splat(half)], 0.2).unwrap();
    let mut files = MapFiles::begin(folder, &grid).unwrap();
    for block in files.blocks().to_vec() {
        let pixels = || (0..block.height).flat_map(|y| (0..block.width).map(move |x| (x, y)));
        let place =
            |(x, y): (u32, u32)| grid.place(DVec2::new(f64::from(block.x + x) + 0.5, f64::from(block.y + y) + 0.5));
        // Noise of a few centimetres, the same everywhere but nowhere alike.
        let rough = |p: DVec2| 0.03 * ((p.x * 91.7).sin() + (p.y * 73.3).cos() + (p.x * p.y * 17.9).sin());
        let heights: Vec<f32> = pixels().map(place).map(|p| (height(p) + rough(p)) as f32).collect();
        let mut rgba: Vec<u8> = pixels().flat_map(|_| [120, 130, 140, 255]).collect();
        let sigmas = vec![0.03; heights.len()];
        let pixels = Pixels { rgba: &mut rgba, heights: &heights, height_sigmas: &sigmas, plane_sigmas: &sigmas };
        files.write(block, pixels).unwrap();
    }
    files.finish(&Disk::default(), None).unwrap();
    folder.to_owned()
}

/// 3 m high over a circle of 6 m: 36π m³.
fn cone(p: DVec2) -> f64 {
    (3.0 * (1.0 - p.length() / 6.0)).max(0.0)
}

const CONE_M3: f64 = 36.0 * std::f64::consts::PI;

fn hills(p: DVec2) -> f64 {
    2.0 * (p.x / 9.0).sin() + (p.y / 6.0).cos()
}

fn json(path: &Path) -> Value {
    serde_json::from_slice(&std::fs::read(path).unwrap()).unwrap()
}

const SQUARE: &str = r#"{"type":"Feature","properties":{"name":"heap"},"geometry":{"type":"Polygon",
    "coordinates":[[[-8,-8],[8,-8],[8,8],[-8,8],[-8,-8]]]}}"#;

#[test]
fn a_heap_has_its_volume_over_its_rim_and_over_an_earlier_map() {
    let folder = tempfile::tempdir().unwrap();
    let [old, new] = ["old", "new"].map(|name| folder.path().join(name));
    map(&old, |p| 0.1 * p.x + 40.0);
    map(&new, |p| 0.1 * p.x + 40.6 + cone(p));
    let areas = folder.path().join("areas.geojson");
    std::fs::write(&areas, SQUARE).unwrap();
    let earlier = old.to_str().unwrap();
    for base in ["plane", "triangulated", earlier] {
        let out = folder.path().join("volumes");
        let [heights, areas, to] = [&new, &areas, &out].map(|p| p.to_str().unwrap());
        let output = dgtr(&["volume", heights, areas, "--base", base, "--out", to]);
        assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
        let answer = json(&out.join("volumes.json"));
        let volume = &answer["volumes"][0];
        let [value, sigma] = ["value", "sigma"].map(|key| volume["net_m3"][key].as_f64().unwrap());
        assert!((value - CONE_M3).abs() < 2.0 * sigma && sigma < 0.1 * CONE_M3, "{base}: {answer}");
        if base == earlier {
            assert!((answer["apart"]["offset_m"].as_f64().unwrap() - 0.6).abs() < 0.01, "{answer}");
        }
        let table = std::fs::read_to_string(out.join("volumes.csv")).unwrap();
        assert!(table.lines().nth(1).unwrap().starts_with("heap,256.000,"), "{table}");
        assert!(String::from_utf8_lossy(&output.stdout).contains(" ± "));
    }
}

#[test]
fn what_cannot_be_measured_is_refused_in_one_line() {
    let folder = tempfile::tempdir().unwrap();
    let new = map(&folder.path().join("new"), hills);
    let areas = folder.path().join("areas.geojson");
    let [heights, path] = [&new, &areas].map(|p| p.to_str().unwrap());
    let refused = |arguments: &[&str], word: &str| {
        let output = dgtr(arguments);
        assert_eq!(output.status.code(), Some(2), "{arguments:?}");
        let line = error_line(&output);
        assert!(line.contains(word), "{line}");
    };
    std::fs::write(&areas, SQUARE).unwrap();
    refused(&["volume", heights, path, "--base", "sea"], "none of lowest, plane, triangulated");
    std::fs::write(&areas, SQUARE.replace("8", "900")).unwrap();
    refused(&["volume", heights, path], "of its rim");
    std::fs::write(&areas, SQUARE.replace("Polygon", "LineString")).unwrap();
    refused(&["volume", heights, path], "no polygon");
    let out = folder.path().join("c");
    refused(&["change", path, heights, "--out", out.to_str().unwrap()], "areas.geojson");
    // The standard deviations of another map.
    let small = folder.path().join("small");
    map_of(&small, 20.0, hills);
    std::fs::copy(small.join("dsm_sigma.tif"), new.join("dsm_sigma.tif")).unwrap();
    refused(&["change", heights, heights, "--out", out.to_str().unwrap()], "dsm_sigma.tif: its pixels are not those");
}

#[test]
fn what_came_between_two_dates_is_found_and_the_same_place_twice_shows_nothing() {
    let folder = tempfile::tempdir().unwrap();
    let old = map(&folder.path().join("old"), hills);
    let new =
        map(&folder.path().join("new"), |p| hills(p - DVec2::new(1.2, -0.8)) + 1.5 + cone(p - DVec2::splat(10.0)));
    let out = folder.path().join("changes");
    for (later, changes) in [(&new, 1), (&old, 0)] {
        let [a, b, to] = [&old, later, &out].map(|p| p.to_str().unwrap());
        let output = dgtr(&["change", a, b, "--out", to]);
        assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
        let features = json(&out.join("change.geojson"));
        assert_eq!(features["features"].as_array().unwrap().len(), changes, "{features}");
        assert_eq!(json(&out.join("change.json"))["changes"], changes);
        assert!(out.join("change.tif").is_file() && out.join("change.csv").is_file());
        if changes == 1 {
            let spot = &features["features"][0]["properties"];
            let [value, sigma] = ["volume_m3", "volume_sigma_m3"].map(|key| spot[key].as_f64().unwrap());
            assert!((value - CONE_M3).abs() < 3.0 * sigma && (value / CONE_M3 - 1.0).abs() < 0.1, "{spot}");
        }
    }
}

/// A carpet of Gaussians with a heap on it, seen by three pictures from above.
fn write_model(path: &Path) {
    let mut cloud = GaussianCloud::with_capacity(0, 160 * 160);
    for n in 0..160 * 160 {
        let p = DVec2::new(f64::from(n % 160), f64::from(n / 160)) * 0.25 - 20.0;
        let height = cone(p) + 0.02 * (p.x * 37.3).sin() * (p.y * 41.9).cos();
        let mean = [p.x as f32, p.y as f32, height as f32];
        cloud.push(mean, [0.12f32.ln(), 0.12f32.ln(), 0.02f32.ln()], [1.0, 0.0, 0.0, 0.0], 6.0, &[0.3; 3]);
    }
    let intrinsics = Intrinsics { width: 400, height: 400, fx: 400.0, fy: 400.0, cx: 200.0, cy: 200.0 };
    let view = |east: f64| {
        let pose = Pose { rotation: DQuat::from_xyzw(1.0, 0.0, 0.0, 0.0), center: DVec3::new(east, 0.0, 40.0) };
        (format!("{east}.jpg"), View { intrinsics, pose })
    };
    let views = [-2.0, 0.0, 2.0].map(view).to_vec();
    model::write(path, &ModelHeader { views, ..Default::default() }, &cloud).unwrap();
}

#[test]
fn a_models_map_is_drawn_before_it_is_measured_and_its_contours_go_around_the_heap() {
    if !has_device() {
        return;
    }
    let folder = tempfile::tempdir().unwrap();
    let [path, areas, out, drawn] = ["m.dgtr", "areas.json", "out", "map"].map(|name| folder.path().join(name));
    write_model(&path);
    std::fs::write(&areas, SQUARE).unwrap();
    let [path, areas, to, drawn_to] = [&path, &areas, &out, &drawn].map(|p| p.to_str().unwrap());
    let refused = dgtr(&["volume", path, areas]);
    assert_eq!(refused.status.code(), Some(2));
    assert!(error_line(&refused).contains("give --out"));
    let output = dgtr(&["volume", path, areas, "--out", to]);
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    let volume = &json(&out.join("volumes.json"))["volumes"][0];
    let [value, sigma] = ["value", "sigma"].map(|key| volume["net_m3"][key].as_f64().unwrap());
    assert!((value / CONE_M3 - 1.0).abs() < 0.1 && sigma < 0.1 * CONE_M3, "{volume}");
    assert!(out.join("map/dsm.tif").is_file());

    let output = dgtr(&["ortho", path, "--out", drawn_to, "--contours", "0.5"]);
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    let contours = json(&drawn.join("contours.geojson"));
    let at = |height: f64| {
        contours["features"].as_array().unwrap().iter().filter(|f| f["properties"]["height_m"] == height).count()
    };
    assert!((1..5).all(|k| at(0.5 * f64::from(k)) == 1), "{contours}");
    let dxf = std::fs::read_to_string(drawn.join("contours.dxf")).unwrap();
    assert!(dxf.starts_with("0\nSECTION") && dxf.ends_with("0\nEOF\n"));
}
