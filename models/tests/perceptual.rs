//! Contracts `metric` and `depth` on pictures: exact values of a known network, and ST-LPIPS where its file is at hand.

use std::path::{Path, PathBuf};

use image::{Rgb, RgbImage};
use models::onnx::depth::DepthNetwork;
use models::onnx::metric::PerceptualMetric;
use models::onnx::session::find_library;

use needs::shared;

fn no_runtime() -> bool {
    let missing = find_library().is_err();
    if missing {
        needs::missing(needs::Need::OnnxRuntime, "no ONNX Runtime");
    }
    missing
}

fn shipped(name: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("networks").join(name)
}

fn picture(seed: u32) -> RgbImage {
    RgbImage::from_fn(96, 64, |x, y| {
        let v = ((x / 6 + seed).wrapping_mul(2_654_435_761) ^ (y / 6).wrapping_mul(40_503)).wrapping_mul(2_246_822_519);
        Rgb([(v >> 24) as u8, (v >> 16) as u8, 100])
    })
}

#[test]
fn a_known_metric_gives_its_exact_value_under_the_contracts_names() {
    if no_runtime() {
        return;
    }
    let mut metric = PerceptualMetric::open(&shipped("mean_square.toml"), (96, 64), 1).unwrap();
    assert_eq!(metric.name(), "mean-square");
    let (a, b) = (RgbImage::from_pixel(96, 64, Rgb([255; 3])), RgbImage::from_pixel(96, 64, Rgb([204; 3])));
    assert!((metric.distance(&a, &b).unwrap() - 0.04).abs() < 1e-6);
    assert_eq!(metric.distance(&a, &a).unwrap(), 0.0);
    // Another size opens another session; the value does not depend on it.
    let (a, b) = (RgbImage::from_pixel(33, 17, Rgb([255; 3])), RgbImage::from_pixel(33, 17, Rgb([204; 3])));
    assert!((metric.distance(&a, &b).unwrap() - 0.04).abs() < 1e-6);
}

#[test]
fn names_of_no_tensor_of_the_contract_are_refused() {
    if no_runtime() {
        return;
    }
    let dir = tempfile::tempdir().unwrap();
    let text = std::fs::read_to_string(shipped("mean_square.toml")).unwrap();
    let file = format!("file = {:?}", shipped("mean_square.onnx"));
    let write = |text: String| {
        let path = dir.path().join("m.toml");
        std::fs::write(&path, text.replace("file = \"mean_square.onnx\"", &file)).unwrap();
        PerceptualMetric::open(&path, (96, 64), 1)
    };
    assert!(write(text.clone()).is_ok());
    let e = write(text.replace("image1 =", "imgae1 =")).unwrap_err().to_string();
    assert!(e.contains("names") && e.contains("has no `imgae1` (it has: image0, image1, distance)"), "{e}");
    let e = write(text.replace("\"dist\"", "\"distance\"")).unwrap_err().to_string();
    assert!(e.contains("output `distance` is missing (there are: dist)"), "{e}");
}

#[test]
fn inverse_depth_turns_its_sign_and_a_network_of_any_size_keeps_the_pictures_shape() {
    if no_runtime() {
        return;
    }
    let dir = tempfile::tempdir().unwrap();
    let text = std::fs::read_to_string(shipped("random_depth.toml")).unwrap();
    let text = text.replace("\"random_depth.onnx\"", &format!("{:?}", shipped("random_depth.onnx")));
    let path = dir.path().join("far.toml");
    std::fs::write(&path, text.replace("inverse = true", "inverse = false")).unwrap();
    let open = |path: &Path| DepthNetwork::open(path, (96, 64), 48, 1).unwrap();
    let near = open(&shipped("random_depth.toml")).estimate(&picture(1)).unwrap();
    let far = open(&path).estimate(&picture(1)).unwrap();
    assert_eq!((near.width, near.height), (48, 32));
    assert!(far.depth.iter().all(|d| *d > 0.0) && far.confidence.iter().all(|c| *c == 1.0));
    assert!(near.depth.iter().zip(&far.depth).all(|(n, f)| *n == -*f));
    let varies = far.depth.iter().any(|d| (d - far.depth[0]).abs() > 1e-3);
    assert!(varies, "a constant map correlates with nothing");
}

#[test]
fn st_lpips_grows_with_damage_and_forgives_a_shift_of_one_pixel() {
    let Some(file) = shared("models/stlpips_alex.onnx").filter(|_| !no_runtime()) else { return };
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("st-lpips.toml");
    let text = format!(
        "name = 'st-lpips'\ncontract = 'metric'\nfile = {file:?}\nlicence = 'BSD-2-Clause'\n[input]\nrange = [0.0, 1.0]\n\
         [names]\nimage0 = 'a'\nimage1 = 'b'\ndistance = 'dist'\n"
    );
    std::fs::write(&path, text).unwrap();
    let mut metric = PerceptualMetric::open(&path, (96, 64), 1).unwrap();
    assert_eq!(metric.name(), "st-lpips");
    let truth = picture(1);
    let shifted = RgbImage::from_fn(96, 64, |x, y| *truth.get_pixel((x + 1).min(95), y));
    let blurred = image::imageops::blur(&truth, 3.0);
    let same = metric.distance(&truth, &truth).unwrap();
    let shift = metric.distance(&truth, &shifted).unwrap();
    let blur = metric.distance(&truth, &blurred).unwrap();
    let other = metric.distance(&truth, &picture(977)).unwrap();
    println!("same {same:.4}, shifted {shift:.4}, blurred {blur:.4}, another picture {other:.4}");
    assert!(same.abs() < 1e-4 && shift < blur && blur < 2.0, "{same} {shift} {blur} {other}");
    assert!(other > shift);
}
