//! Promises of `dgtr export` to viewers: each format with its georeference, and one line where something is missing.

use geometry::geodesy::Geodetic;
use models::cloud::GaussianCloud;
use models::formats::model::{self, ModelHeader};
use models::formats::{ply, spz};
use serde_json::Value;

use super::{dgtr, error_line, program};

fn model(path: &std::path::Path) -> GaussianCloud {
    let mut cloud = GaussianCloud::with_capacity(2, 8);
    for i in 0..8u8 {
        let v = f32::from(i);
        let sh: Vec<f32> = (0..27).map(|k| (v + k as f32).sin() * 0.3).collect();
        cloud.push([100.0 + 3.0 * v, -7.0 * v, v], [-1.0; 3], [1.0, 0.1 * v, 0.0, 0.0], 0.5, &sh);
    }
    let origin = Some(Geodetic { lat_deg: 46.5, lon_deg: 7.25, alt_m: 500.0 });
    model::write(path, &ModelHeader { origin, ..Default::default() }, &cloud).unwrap();
    cloud
}

#[test]
fn every_format_for_viewers_says_where_on_earth_it_is() {
    let dir = tempfile::tempdir().unwrap();
    let file = |name: &str| dir.path().join(name);
    let cloud = model(&file("m.dgtr"));
    for (format, name) in [("ply", "m.ply"), ("spz", "m.spz"), ("sog", "m.sog"), ("gltf", "m.glb")] {
        let output = dgtr(&["export", &file("m.dgtr").to_string_lossy(), "--to", format]);
        assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
        assert!(file(name).is_file(), "{name}");
        let text = std::fs::read_to_string(file(&format!("{name}.georef.json"))).unwrap();
        let georef: Value = serde_json::from_str(&text).unwrap();
        assert_eq!((&georef["files"][0], &georef["crs"]), (&Value::from(name), &Value::from("EPSG:32632")));
        let row = |k: &str, i: usize| georef[k][i].as_array().unwrap().iter().map(|v| v.as_f64().unwrap()).collect();
        let (to_enu, to_crs): (Vec<f64>, Vec<f64>) = (row("to_enu", 2), row("to_crs", 2));
        // Up is the third coordinate of all but glTF, whose second it is, and 500 m above the map's zero.
        let up = if format == "gltf" { 1 } else { 2 };
        // SPZ's third axis points back, which is down for a scene whose third axis is up.
        let sign = if format == "spz" { -1.0 } else { 1.0 };
        assert_eq!((to_enu[up], to_enu[3 - up]), (sign, 0.0), "{format}");
        assert!((to_crs[3] - to_enu[3] - 500.0).abs() < 0.01, "{format}: {to_crs:?}");
        let east: Vec<f64> = row("to_enu", 0);
        assert_eq!(east[3] != 0.0, format == "sog", "only SOG is moved: {east:?}");
    }
    assert_eq!(ply::read(&file("m.ply")).unwrap().cloud, cloud);
}

#[test]
fn a_lower_degree_of_colours_is_written_where_it_is_asked_for() {
    let dir = tempfile::tempdir().unwrap();
    let file = |name: &str| dir.path().join(name);
    let mut cloud = model(&file("m.dgtr"));
    let (from, to) = (file("m.dgtr").to_string_lossy().into_owned(), file("low").to_string_lossy().into_owned());
    assert!(dgtr(&["export", &from, "--to", "ply", "--sh-degree", "1", "--out", &to]).status.success());
    cloud.lower_sh_degree(1);
    assert_eq!(ply::read(&file("low")).unwrap().cloud, cloud);
    assert!(dgtr(&["export", &from, "--to", "spz", "--sh-degree", "0", "--out", &to]).status.success());
    assert_eq!(spz::read(&file("low"), spz::Axes::Rub).unwrap().cloud.sh_degree, 0);
    assert!(dgtr(&["export", &from, "--to", "ply", "--sh-degree", "3", "--out", &to]).status.success());
    assert_eq!(ply::read(&file("low")).unwrap().cloud.sh_degree, 2, "nothing is made up");
}

#[test]
fn without_its_viewer_or_with_another_one_no_page_is_written() {
    let dir = tempfile::tempdir().unwrap();
    let file = |name: &str| dir.path().join(name);
    model(&file("m.dgtr"));
    let viewer = file("viewer");
    let export = || {
        let model = file("m.dgtr");
        let output =
            program().env("DGTR_VIEWER", &viewer).args(["export", "--to", "html"]).arg(model).output().unwrap();
        assert_eq!(output.status.code(), Some(3), "a library is missing");
        assert!(!file("m.html").exists() && !file("m.html.georef.json").exists());
        error_line(&output)
    };
    let line = export();
    assert!(line.contains("viewer") && line.contains("setup.sh --viewer"), "{line}");
    std::fs::create_dir_all(viewer.join("public")).unwrap();
    std::fs::write(viewer.join("public/index.js"), "alert('not the pinned one')").unwrap();
    let line = export();
    assert!(line.contains("public/index.js") && line.contains("supersplat-viewer"), "{line}");
}

#[test]
fn options_of_another_format_are_refused() {
    let dir = tempfile::tempdir().unwrap();
    model(&dir.path().join("m.dgtr"));
    let model = dir.path().join("m.dgtr").to_string_lossy().into_owned();
    let cases = [
        (["--to", "delivery", "--sh-degree", "1"], "--sh-degree"),
        (["--to", "sog", "--thumbnails", "3"], "--thumbnails"),
        (["--to", "ply", "--device", "x"], "--device"),
        (["--to", "html", "--thumbnails", "49"], "thumbnails"),
        (["--to", "ply", "--sh-degree", "4"], "sh-degree"),
    ];
    for (options, name) in cases {
        let output = dgtr(&[&["export", model.as_str()], &options[..]].concat());
        assert_eq!(output.status.code(), Some(2), "{options:?}");
        assert!(String::from_utf8_lossy(&output.stderr).contains(name), "{options:?}");
    }
    assert_eq!(std::fs::read_dir(dir.path()).unwrap().count(), 1, "nothing is written");
}
