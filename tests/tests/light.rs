//! Cameras on auto: what exposure, white balance and a lens's fall-off do to pictures is found and taken out, and pictures in even light
//! are left as they are.
#![allow(clippy::expect_used, clippy::panic, reason = "a test fails by panicking")]

mod support;

use std::path::Path;

use image::imageops::{FilterType, resize};
use models::formats::model;
use support::run;
use survey::dataset::Dataset;

/// Half of the pictures' size: enough to see light by, and quick.
const SIZE: (u32, u32) = (320, 240);

fn noise(i: usize) -> f32 {
    let hash = (i as u32 + 1).wrapping_mul(2_654_435_761);
    ((hash ^ (hash >> 15)).wrapping_mul(2_246_822_519) >> 8) as f32 / (1u32 << 24) as f32 - 0.5
}

/// The pictures of `set` in folder `to`: as they are, or each with a gain of up to 40 %, a white of its own and cos⁴ towards the corners
/// (as stored values show it).
fn write(set: &Dataset, from: &Path, to: &Path, change: bool) {
    std::fs::create_dir_all(to.join("images")).expect("a folder");
    for (i, frame) in set.frames.iter().enumerate() {
        let loaded = set.load(i, 1.0).expect("a picture");
        let lens = loaded.view.intrinsics.resized(SIZE.0, SIZE.1);
        let mut image = resize(&loaded.image, SIZE.0, SIZE.1, FilterType::Triangle);
        let gain = [0, 1, 2].map(|c| (0.7 * noise(5 * i) + 0.2 * noise(5 * i + 1 + c)).exp());
        for (x, y, p) in image.enumerate_pixels_mut().filter(|_| change) {
            let t2 = models::light::off_axis([x as f32 + 0.5, y as f32 + 0.5], &lens);
            (0..3).for_each(|c| p.0[c] = (f32::from(p.0[c]) * gain[c] / (1.0 + t2)).round().min(255.0) as u8);
        }
        image.save(to.join("images").join(&frame.name).with_extension("png")).expect("written");
    }
    let text = std::fs::read_to_string(from.join("transforms.json")).expect("poses").replace(".jpg", ".png");
    let mut poses: serde_json::Value = serde_json::from_str(&text).expect("JSON");
    for (name, value) in [("fl_x", 192.648_11), ("fl_y", 192.317_29), ("cx", 160.0), ("cy", 120.25)] {
        poses[name] = value.into();
    }
    (poses["w"], poses["h"]) = (SIZE.0.into(), SIZE.1.into());
    std::fs::write(to.join("transforms.json"), poses.to_string()).expect("written");
    let split = std::fs::read_to_string(from.join("split.json")).expect("a split").replace(".jpg", ".png");
    std::fs::write(to.join("split.json"), split).expect("written");
}

/// Trains on `pictures`; what it says, the model's bytes, and dB on the unchanged held-out pictures with colours fitted.
fn trained(dir: &Path, pictures: &str, light: bool) -> (String, Vec<u8>, f64) {
    std::fs::write(dir.join("settings.toml"), format!("[init]\nlight = {light}\n")).expect("written");
    let arguments = ["train", pictures, "--out", "out", "--fresh", "--steps", "150", "--max-gaussians", "30000"];
    let ended = run(dir, &[&arguments[..], &["--no-eval", "--settings", "settings.toml"]].concat());
    let said = String::from_utf8_lossy(&ended.stderr).into_owned();
    assert!(ended.status.success(), "{said}");
    let path = dir.join("out/model.dgtr");
    let bytes = std::fs::read(&path).expect("a model");
    // The unchanged pictures were taken through no lens that darkens corners.
    let (mut header, cloud) = model::read(&path).expect("a model");
    header.lights.clear();
    model::write(&path, &header, &cloud).expect("written");
    let scores = run(dir, &["eval", "out/model.dgtr", "even", "--json"]);
    let scores: serde_json::Value = serde_json::from_slice(&scores.stdout).expect("JSON");
    (said, bytes, scores["psnr_colors_fitted"].as_f64().expect("a figure"))
}

#[test]
fn pictures_of_uneven_light_cost_little_and_those_of_even_light_nothing() {
    let Some(from) = needs::shared("data/sheffield_cross") else { return };
    let set = Dataset::open(&from).expect("the data set");
    let dir = tempfile::tempdir().expect("a folder");
    write(&set, &from, &dir.path().join("even"), false);
    write(&set, &from, &dir.path().join("uneven"), true);
    let (said, even, best) = trained(dir.path(), "even", true);
    assert!(said.contains("exposure correction is not needed"), "{said}");
    assert!(even == trained(dir.path(), "even", false).1, "even light is left as it is, to the byte");
    let without = trained(dir.path(), "uneven", false).2;
    let (said, _, with) = trained(dir.path(), "uneven", true);
    println!("even {best:.2} dB, uneven {without:.2} without and {with:.2} with its light taken out");
    assert!(said.contains("exposure correction: pictures"), "{said}");
    assert!(with > best - 0.2 && without < best - 0.7, "even {best}, without {without}, with {with}");
}
