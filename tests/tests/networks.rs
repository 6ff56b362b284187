//! The user's own networks, named in a settings file, the mission file or on the command line.
#![allow(clippy::expect_used, clippy::panic, reason = "a test fails by panicking")]

mod support;

use std::path::{Path, PathBuf};

use serde_json::Value;
use support::plane::plane_dataset;
use support::{dgtr, refused, run};

use needs::shared;

fn network(name: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("../models/networks").join(name)
}

/// Trains a few steps on the plane in `at`; `settings` is the text of `--settings`. Returns `run.json`.
fn train(at: &Path, out: &str, settings: &str) -> Value {
    let file = format!("{out}.toml");
    std::fs::write(at.join(&file), settings).expect("settings");
    let budget = ["--steps", "6", "--max-gaussians", "6000", "--budget-mib", "64"];
    let output = run(at, &[&["train", "set", "--out", out, "--settings", &file], &budget[..]].concat());
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    read_json(&at.join(out).join("run.json"))
}

fn read_json(path: &Path) -> Value {
    serde_json::from_str(&std::fs::read_to_string(path).expect("run.json")).expect("JSON")
}

#[test]
fn a_metric_of_the_users_is_reported_under_its_own_name_per_view_and_in_run_json() {
    let dir = tempfile::tempdir().expect("tempdir");
    let at = dir.path();
    plane_dataset(&at.join("set"), 2);
    let metric = network("mean_square.toml");
    let trained = train(at, "out", &format!("[network]\nmetric = {metric:?}\n"));
    assert_eq!(trained["perceptual"]["name"], "mean-square", "{trained}");
    let metric = metric.display().to_string();
    let output = run(at, &["eval", "out/model.dgtr", "set", "--json", "--metric", &metric]);
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    let scores: Value = serde_json::from_slice(&output.stdout).expect("JSON");
    assert_eq!(scores["perceptual"]["name"], "mean-square");
    let views = scores["views"].as_array().expect("views");
    assert!(views.len() >= 2, "{scores}");
    let mut sum = 0.0;
    for view in views {
        // PSNR of the same two pictures is −10 log₁₀ of exactly this metric: no other pictures were compared.
        let (distance, psnr) = (view["perceptual"].as_f64().expect("distance"), view["psnr"].as_f64().expect("psnr"));
        assert!((-10.0 * distance.log10() - psnr).abs() < 1e-3, "{view}");
        sum += distance;
    }
    let mean = scores["perceptual"]["mean"].as_f64().expect("mean");
    assert!((mean - sum / views.len() as f64).abs() < 1e-9);
    assert!((trained["perceptual"]["mean"].as_f64().expect("mean") - mean).abs() < 1e-9);
    // Without a metric there is no such figure, rather than a zero.
    let output = run(at, &["eval", "out/model.dgtr", "set", "--json"]);
    assert!(!String::from_utf8_lossy(&output.stdout).contains("perceptual"));
}

#[test]
fn the_depth_loss_listens_to_the_users_depth_network_else_to_the_pair_network() {
    let dir = tempfile::tempdir().expect("tempdir");
    let at = dir.path();
    plane_dataset(&at.join("set"), 1);
    let depth = network("random_depth.toml");
    let by_pairs = train(at, "pairs", "");
    let by_depth = train(at, "depth", &format!("[network]\ndepth = {depth:?}\n"));
    let off = train(at, "off", &format!("[network]\ndepth = {depth:?}\n[training.loss]\ndepth = 0.0\n"));
    let prior = |run: &Value| run["depth_prior"]["name"].as_str().map(str::to_owned);
    assert_eq!(prior(&by_pairs).as_deref(), Some("semi-global-matching"), "{by_pairs}");
    assert_eq!(prior(&by_depth).as_deref(), Some("random-depth"));
    assert_eq!(by_depth["depth_prior"]["views"], by_depth["views"]);
    // A random network's depth says nothing about the ground: its correlation costs more than the pair network's.
    let loss = |run: &Value| run["loss"].as_f64().expect("loss");
    assert!(loss(&by_depth) > loss(&by_pairs) + 0.005, "{} {}", loss(&by_depth), loss(&by_pairs));
    assert!(loss(&off) < loss(&by_pairs), "{} {}", loss(&off), loss(&by_pairs));
}

#[test]
fn where_the_depth_range_is_given_nothing_needs_onnx_runtime() {
    let dir = tempfile::tempdir().expect("tempdir");
    let at = dir.path();
    plane_dataset(&at.join("set"), 1);
    std::fs::write(at.join("s.toml"), "[init]\ndepth_m = [40.0, 60.0]\n").expect("settings");
    let arguments = ["train", "set", "--out", "o", "--settings", "s.toml", "--steps", "1", "--max-gaussians", "6000"];
    let output = dgtr(at, &arguments).env("ORT_DYLIB_PATH", "/nowhere/libonnxruntime.so").output().expect("starts");
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    assert_eq!(read_json(&at.join("o/run.json"))["init"]["network"], "semi-global-matching");
}

#[test]
fn networks_that_do_not_fit_are_refused_in_one_line_before_anything_begins() {
    let dir = tempfile::tempdir().expect("tempdir");
    let at = dir.path();
    plane_dataset(&at.join("set"), 1);
    let train = |settings: String, words: &[&str]| {
        std::fs::write(at.join("s.toml"), settings).expect("settings");
        refused(at, &["train", "set", "--out", "o", "--settings", "s.toml", "--max-gaussians", "6000"], 2, words);
        assert!(!at.join("o").exists(), "nothing is written before the networks are known to fit");
    };
    let (metric, depth) = (network("mean_square.toml"), network("random_depth.toml"));
    train(format!("[network]\ndepth = {metric:?}\n"), &["mean_square.toml", "is `metric`, needed is `depth`"]);
    train(format!("[network]\nmetric = {depth:?}\n"), &["random_depth.toml", "is `depth`, needed is `metric`"]);
    train("[network]\ndepth = \"nowhere.toml\"\n".to_owned(), &["nowhere.toml"]);
    // The right contract around the wrong network: a relative path is relative to the file that names it.
    let wrong = |name: &str, contract: &str, file: &str| {
        let file = network(file);
        let text = format!(
            "name='w'\ncontract='{contract}'\nfile={file:?}\nlicence='x'\n[input]\nrange=[0,1]\nmultiple=4\n[depth]\ninverse=false\n"
        );
        std::fs::write(at.join(name), text).expect("manifest");
    };
    wrong("wrong_depth.toml", "depth", "mean_square.onnx");
    train("[network]\ndepth = \"wrong_depth.toml\"\n".to_owned(), &["input `image` is missing (there are: a, b)"]);
    wrong("wrong_metric.toml", "metric", "random_depth.onnx");
    train("[network]\nmetric = \"wrong_metric.toml\"\n".to_owned(), &["input `image0` is missing"]);
}

/// Five pictures of a real survey and a held-out one, as a data set of its own; `None` without the shared data.
fn six_photographs(at: &Path) -> Option<()> {
    let from = shared("data/sheffield_cross")?;
    let (train, test) = (["0054", "0058", "0064", "0068", "0072"], ["0062"]);
    let name = |n: &&str| format!("DJI_{n}.jpg");
    let mut world = read_json(&from.join("transforms.json"));
    let frames = world["frames"].as_array_mut().expect("frames");
    frames
        .retain(|f| train.iter().chain(&test).any(|n| f["file_path"].as_str().is_some_and(|p| p.ends_with(&name(n)))));
    assert_eq!(frames.len(), 6);
    std::fs::create_dir_all(at.join("photos/images")).expect("mkdir");
    for frame in frames {
        let path = frame["file_path"].as_str().expect("path");
        std::fs::copy(from.join(path), at.join("photos").join(path)).expect("copy");
    }
    std::fs::write(at.join("photos/transforms.json"), world.to_string()).expect("write");
    let split = serde_json::json!({ "train": train.iter().map(name).collect::<Vec<_>>(), "test": test.iter().map(name).collect::<Vec<_>>() });
    std::fs::write(at.join("photos/split.json"), split.to_string()).expect("write");
    Some(())
}

/// IterMVS (MIT) is no part of this project: it stands for any network a user brings.
#[test]
fn a_trained_network_of_the_users_is_one_line_and_initialises_real_photographs() {
    let dir = tempfile::tempdir().expect("tempdir");
    let at = dir.path();
    let Some(()) = six_photographs(at) else { return };
    let Some(file) = shared("models/itermvs_blendedmvs_v3_352x640.onnx") else { return };
    let manifest = format!(
        "name = 'itermvs'\ncontract = 'pair'\nfile = {file:?}\nlicence = 'MIT'\n[input]\nwidth = 640\nheight = 352\n\
         range = [-1.0, 1.0]\n[pair]\nposes = 'given'\nviews = 3\n"
    );
    std::fs::write(at.join("itermvs.toml"), manifest).expect("manifest");
    let start = |out: &str, settings: &str| {
        std::fs::write(at.join("s.toml"), settings).expect("settings");
        let budget = ["--steps", "1", "--max-gaussians", "60000", "--budget-mib", "256"];
        let output = run(at, &[&["train", "photos", "--out", out, "--settings", "s.toml"], &budget[..]].concat());
        assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
        read_json(&at.join(out).join("run.json"))
    };
    let own = start("own", "[network]\npair = 'itermvs.toml'\n");
    let matched = start("matched", "");
    println!("before training: the user's {} dB, by matching {} dB", own["psnr"], matched["psnr"]);
    assert_eq!(own["init"]["network"], "itermvs");
    assert_eq!(matched["init"]["network"], "semi-global-matching");
    assert_eq!(own["init"]["runs"], 5);
    let psnr = |run: &Value| run["psnr"].as_f64().expect("psnr");
    assert!(psnr(&own) > 17.0, "{own}");
    assert!((psnr(&own) - psnr(&matched)).abs() < 1.0, "{} against {}", psnr(&own), psnr(&matched));
}
