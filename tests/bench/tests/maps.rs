//! Maps from the command line: as true as the simulated survey lets them be, and refused in one line where there is none.
#![allow(clippy::expect_used, clippy::panic, reason = "a test fails by panicking")]

use std::path::Path;
use std::process::{Command, Output};

use serde_json::Value;

fn called(folder: &Path, arguments: &[&str]) -> Output {
    let mut command = Command::new(env!("CARGO_BIN_EXE_bench"));
    command.args(arguments).current_dir(folder).env(config::kernels::VARIABLE, "default").output().expect("starts")
}

/// `dgtr ARGUMENTS`.
fn run(folder: &Path, arguments: &[&str]) -> Output {
    called(folder, &[&[bench::child::PROGRAM], arguments].concat())
}

/// What a refused command says: its exit code 2, and one line that contains `word`.
fn refused(folder: &Path, arguments: &[&str], word: &str) {
    let output = run(folder, arguments);
    let text = String::from_utf8_lossy(&output.stderr);
    assert_eq!(output.status.code(), Some(2), "{arguments:?}: {text}");
    let lines: Vec<&str> = text.lines().filter(|l| l.starts_with("dgtr: ")).collect();
    assert!(lines.len() == 1 && lines[0].contains(word), "{arguments:?}: {word:?} is not in {text}");
    assert!(!text.contains("panicked"), "{text}");
}

fn json(path: &std::path::Path) -> Value {
    serde_json::from_slice(&std::fs::read(path).expect("readable")).expect("JSON")
}

#[test]
fn the_map_of_a_simulated_survey_is_true_and_better_than_its_depth_maps() {
    let dir = tempfile::tempdir().expect("tempdir");
    let training = ["--steps", "240", "--max-gaussians", "40000", "--min-views", "4"];
    let output = called(dir.path(), &[&["map", "--out", "survey", "--json", "map.json"][..], &training].concat());
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    println!("{}", String::from_utf8_lossy(&output.stdout));
    let scores = json(&dir.path().join("map.json"));
    let figure = |name: &str| scores[name].as_f64().expect(name);
    let height = |from: &str, name: &str| scores[from][name].as_f64().expect(name);
    assert!(figure("psnr") > 26.5 && figure("shift_px") < 0.5 && scores["squares"].as_u64() > Some(10), "{scores}");
    assert!(figure("covered") > 0.97, "{scores}");
    let gsd = figure("gsd_m");
    assert!(height("heights", "rmse_m") < 1.5 * gsd && height("heights", "bias_m").abs() < 0.4 * gsd, "{scores}");
    assert!(height("heights", "rmse_m") < height("fused_depth", "rmse_m"), "{scores}");
    assert!(
        height("heights", "median_abs_m") < 0.5 * gsd && height("fused_depth", "median_abs_m") < 0.5 * gsd,
        "{scores}"
    );

    // Two of three errors are within what the map says of them, and nearly all within twice that.
    let sigmas = &scores["all_heights"]["sigmas"];
    let share = |name: &str| sigmas[name].as_f64().expect(name);
    assert!((0.60..=0.82).contains(&share("within_one")) && share("within_two") > 0.9, "{scores}");
    assert!(share("median_m") < 2.5 * height("all_heights", "median_abs_m"), "{scores}");

    // The same model by `dgtr ortho`, and by `dgtr eval` against points that lie on the plane z = 0 but for one.
    let model = "survey/trained/model.dgtr";
    let output = run(dir.path(), &["ortho", model, "--out", "map", "--gsd", "25", "--min-views", "4"]);
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    let georef = json(&dir.path().join("map/map.georef.json"));
    assert_eq!((georef["crs"].as_str(), georef["gsd_m"].as_f64()), (Some("EPSG:32632"), Some(0.25)));
    let covered = georef["covered_pixels"].as_u64().expect("a count");
    assert!(covered > 10_000, "{georef}");
    let sigma = georef["height_sigma_m"].as_f64().expect("a median");
    assert!((0.01..0.3).contains(&sigma) && georef["plane_sigma_m"].as_f64() < Some(sigma), "{georef}");
    // What is worth less than the median is about half of it.
    let most = (100.0 * sigma).to_string();
    let cut = ["ortho", model, "--out", "cut", "--gsd", "25", "--min-views", "4", "--max-sigma", &most];
    let output = run(dir.path(), &cut);
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    let left = json(&dir.path().join("cut/map.georef.json"))["covered_pixels"].as_u64().expect("a count");
    assert!(left.abs_diff(covered / 2) < covered / 10, "{left} of {covered}");
    std::fs::write(dir.path().join("points.csv"), "x,y,z\n0,0,0\n5,5,0\n5,5,0\n9000,0,0\n").expect("written");
    let output = run(dir.path(), &["eval", model, "--heights", "points.csv", "--json"]);
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    let heights: Value = serde_json::from_slice(&output.stdout).expect("JSON");
    assert_eq!((heights["points"].as_u64(), heights["missing"].as_u64()), (Some(2), Some(1)));
    // And against its own raster of heights: what other pixels and the other number of views leave between them.
    let output = run(dir.path(), &["eval", model, "--heights", "map/dsm.tif", "--json"]);
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    let heights: Value = serde_json::from_slice(&output.stdout).expect("JSON");
    assert!(heights["points"].as_u64() > Some(10_000), "{heights}");
    assert!(
        heights["median_abs_m"].as_f64() < Some(0.1) && heights["bias_m"].as_f64().is_some_and(|b| b.abs() < 0.1),
        "{heights}"
    );

    for (more, words) in [
        (&["--gsd", "0"][..], "must be positive"),
        (&["--epsg", "4326"], "EPSG:4326"),
        (&["--bounds", "0,0,10,10"], "outside"),
        (&["--gsd", "0.0001"], "larger pixels"),
    ] {
        refused(dir.path(), &[&["ortho", model, "--out", "none"], more].concat(), words);
    }
    refused(dir.path(), &["eval", model, "--heights", "missing.csv"], "missing.csv");
}
