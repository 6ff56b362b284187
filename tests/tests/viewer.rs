//! The page of `dgtr export --to html` in a real browser. Skipped, and said so, where there is no Chromium, no Node.js or no viewer
//! (`runtime/setup.sh --viewer`). Pictures of the screen stay in `target/viewer`.
#![allow(clippy::expect_used, clippy::panic, reason = "a test fails by panicking")]

mod support;

use std::path::{Path, PathBuf};
use std::process::Command;

use glam::{DMat3, DQuat, DVec3};
use models::camera::{Intrinsics, Pose, View};
use models::cloud::{GaussianCloud, SH_C0};
use models::formats::model::{self, ModelHeader};
use serde_json::{Value, json};
use support::run;

/// Height of the camera that looks straight down, and of the tower.
const CAMERA_M: f64 = 60.0;
const TOWER_M: f32 = 10.0;

fn program(names: &[&str]) -> Option<PathBuf> {
    let path = std::env::var_os("PATH")?;
    names.iter().find_map(|n| std::env::split_paths(&path).map(|p| p.join(n)).find(|p| p.is_file()))
}

/// A grey lawn of 60 m; 20 m to the east something blue, 20 m to the north something red, to the west a green tower.
fn model(path: &Path) {
    let mut cloud = GaussianCloud::with_capacity(1, 60 * 60);
    let mut put = |mean: [f32; 3], sigma: [f32; 3], rgb: [f32; 3]| {
        let mut sh = rgb.map(|v| (v - 0.5) / SH_C0).to_vec();
        sh.extend([0.0; 9]);
        cloud.push(mean, sigma.map(f32::ln), [1.0, 0.0, 0.0, 0.0], 6.0, &sh);
    };
    let patch = |e: f32, n: f32, at: [f32; 2]| (e - at[0]).abs() < 4.0 && (n - at[1]).abs() < 4.0;
    for (e, n) in (-30..30).flat_map(|e| (-30..30).map(move |n| (e as f32 + 0.5, n as f32 + 0.5))) {
        let rgb = match () {
            () if patch(e, n, [20.0, 0.0]) => [0.0, 0.0, 1.0],
            () if patch(e, n, [0.0, 20.0]) => [1.0, 0.0, 0.0],
            () => [0.6, 0.6, 0.6],
        };
        put([e, n, 0.0], [0.7, 0.7, 0.05], rgb);
        if patch(e, n, [-20.0, 0.0]) {
            put([e, n, TOWER_M], [0.7, 0.7, 0.05], [0.0, 0.8, 0.0]);
        }
    }
    // Straight down with north on top, straight down with east on top, and level towards the north.
    let looks = [
        ("down.jpg", [DVec3::X, DVec3::NEG_Y, DVec3::NEG_Z], [0.0, 0.0, CAMERA_M]),
        ("east.jpg", [DVec3::NEG_Y, DVec3::NEG_X, DVec3::NEG_Z], [0.0, 0.0, CAMERA_M]),
        ("level.jpg", [DVec3::X, DVec3::NEG_Z, DVec3::Y], [0.0, -60.0, 8.0]),
    ];
    let intrinsics = Intrinsics { width: 640, height: 400, fx: 320.0, fy: 320.0, cx: 320.0, cy: 200.0 };
    let views = looks.map(|(name, [x, y, z], center)| {
        let rotation = DQuat::from_mat3(&DMat3::from_cols(x, y, z));
        (name.to_owned(), View { intrinsics, pose: Pose { rotation, center: DVec3::from_array(center) } })
    });
    let origin = Some(geometry::geodesy::Geodetic { lat_deg: 53.38, lon_deg: -1.47, alt_m: 80.0 });
    let header = ModelHeader { mission: "<lawn> & tower".into(), origin, views: views.into(), ..Default::default() };
    model::write(path, &header, &cloud).expect("a model");
}

/// Colour of the screen's pixel in a picture of it.
fn pixel(shot: &Path, [x, y]: [u32; 2]) -> [u8; 3] {
    let picture = models::picture::decode(shot).expect("a picture of the screen");
    picture.get_pixel(x, y).0
}

fn number(text: &str, after: &str) -> f64 {
    let rest = text.split(after).nth(1).unwrap_or_else(|| panic!("{after:?} is not in {text:?}"));
    let digits: String =
        rest.trim_start().replace('−', "-").replace('+', "").chars().take_while(|c| !c.is_whitespace()).collect();
    digits.parse().unwrap_or_else(|_| panic!("{digits:?} in {text:?}"))
}

#[test]
fn the_page_opens_offline_without_webgpu_north_is_north_and_measures_are_right() {
    let (Some(chromium), Some(node)) =
        (program(&["chromium", "chromium-browser", "google-chrome"]), program(&["node"]))
    else {
        needs::missing(needs::Need::Chromium, "chromium and node are needed (apt-get install chromium nodejs)");
        return;
    };
    let out = PathBuf::from(env!("CARGO_TARGET_TMPDIR")).join("../viewer");
    std::fs::create_dir_all(&out).expect("a folder");
    let out = out.canonicalize().expect("a folder");
    model(&out.join("lawn.dgtr"));
    let export = run(&out, &["export", "lawn.dgtr", "--to", "html"]);
    let said = String::from_utf8_lossy(&export.stderr);
    if export.status.code() == Some(3) {
        needs::missing(needs::Need::Viewer, said);
        return;
    }
    assert!(export.status.success(), "{said}");

    // The window is 1280 × 800; a camera's 640 × 400 fill it. 20 m at a height of 60 m are a third of half its width.
    let (middle, metre) = ([640.0, 400.0], 640.0 / CAMERA_M);
    let at = |e: f64, n: f64| [middle[0] + e * metre, middle[1] - n * metre];
    let tower = at(-20.0 * CAMERA_M / (CAMERA_M - f64::from(TOWER_M)), 0.0);
    let steps = json!([
        { "shot": "overview" },
        { "camera": 0, "shot": "down" },
        { "measure": true, "click": at(20.0, 0.0) },
        { "click": at(0.0, 20.0), "shot": "measured" },
        { "click": at(0.0, 0.0) },
        { "click": tower, "shot": "tower" },
        { "measure": true, "camera": 1, "shot": "east" },
        { "camera": 2, "shot": "level" },
    ]);
    std::fs::write(out.join("steps.json"), steps.to_string()).expect("steps");
    let driver = concat!(env!("CARGO_MANIFEST_DIR"), "/viewer.mjs");
    let seen = Command::new(node)
        .args([Path::new(driver), &chromium, &out.join("lawn.html"), &out, &out.join("steps.json")])
        .output()
        .expect("node runs");
    let seen: Value = serde_json::from_slice(&seen.stdout)
        .unwrap_or_else(|e| panic!("{e}: {}", String::from_utf8_lossy(&seen.stderr)));
    println!("pictures of the screen: {}; {seen:#}", out.display());
    assert!(seen["failed"].is_null(), "{}", seen["failed"]);
    assert_eq!((&seen["errors"], &seen["webgpu"]), (&json!([]), &json!(false)), "no errors, no WebGPU");
    let local =
        |url: &Value| url.as_str().is_some_and(|u| ["file:", "data:", "blob:"].iter().any(|s| u.starts_with(s)));
    assert!(seen["requests"].as_array().is_some_and(|r| r.iter().all(local)), "nothing from a network: {seen}");

    let note = |i: usize| &seen["notes"][i];
    assert_eq!(note(0)["cameras"], 3);
    // Straight down: the compass is the map's, its arrows 38 pixels long.
    let near = |v: &Value, to: [f64; 2]| (0..2).all(|k| v[k].as_f64().is_some_and(|v| (v - to[k]).abs() < 1.0));
    assert!(near(&note(1)["north"], [0.0, -38.0]) && near(&note(1)["east"], [38.0, 0.0]), "{}", note(1));
    assert!(near(&note(6)["east"], [0.0, -38.0]) && near(&note(6)["north"], [-38.0, 0.0]), "{}", note(6));
    assert!(near(&note(7)["up"], [0.0, -38.0]) && near(&note(7)["east"], [38.0, 0.0]), "{}", note(7));
    // What is red lies to the north, what is blue to the east.
    let looks_like = |shot: &str, [x, y]: [f64; 2], channel: usize| {
        let rgb = pixel(&out.join(format!("{shot}.png")), [x as u32, y as u32]);
        let others = (0..3).filter(|c| *c != channel).map(|c| rgb[c]).max().unwrap_or(0);
        assert!(rgb[channel] > 150 && others < 90, "{shot} at {x},{y}: {rgb:?}");
    };
    looks_like("down", at(1.5, 20.0), 0);
    looks_like("down", at(20.0, 1.5), 2);
    looks_like("down", [tower[0], tower[1] + 12.0], 1);
    looks_like("east", [middle[0] + 12.0, middle[1] - 20.0 * metre], 2);
    // From the east to the north, and from the lawn onto the tower.
    let text = |i: usize| note(i)["measured"].as_str().unwrap_or_default();
    assert!((number(text(3), "Distance") - 20.0 * 2.0f64.sqrt()).abs() < 0.2, "{}", text(3));
    assert!(number(text(3), "Height").abs() < 0.1, "{}", text(3));
    assert!((number(text(3), "A:") - 20.0).abs() < 0.15, "{}", text(3));
    assert!((number(text(5), "Height") - f64::from(TOWER_M)).abs() < 0.15, "{}", text(5));
    assert_eq!(text(6), "", "measuring is over");
    // The scale bar is as long as it says.
    let scale = &note(1)["scale"];
    let says: f64 = scale[0].as_str().and_then(|s| s.strip_suffix(" m")).and_then(|s| s.parse().ok()).expect("metres");
    let is = scale[1].as_f64().expect("pixels") / metre;
    assert!((is / says - 1.0).abs() < 0.03, "{says} m are {is} m");
}
