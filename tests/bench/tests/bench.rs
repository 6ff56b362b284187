//! Promises of `bench`: every subcommand ends with figures that can be trusted, on the smallest scenes there are.
//! Seconds are never asserted.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic)] // a test may

use std::path::Path;
use std::process::{Command, Output};

use runtime::device_report::survey::write_data_set;
use serde_json::Value;

fn bench(arguments: &[&str]) -> Output {
    let mut command = Command::new(env!("CARGO_BIN_EXE_bench"));
    // Nothing is measured beforehand, and nothing is written to the user's cache folder.
    command.env(config::kernels::VARIABLE, "default").args(arguments).output().unwrap()
}

fn held(output: &Output) -> String {
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    String::from_utf8_lossy(&output.stdout).into_owned()
}

fn json(path: &Path) -> Value {
    serde_json::from_slice(&std::fs::read(path).unwrap()).unwrap()
}

fn has_device() -> bool {
    let found = vulkan::gpu::Gpu::list().is_ok();
    if !found {
        needs::missing(needs::Need::Vulkan, "no Vulkan device (install mesa-vulkan-drivers)");
    }
    found
}

#[test]
fn stages_have_time_work_and_a_roofline() {
    if !has_device() {
        return;
    }
    let dir = tempfile::tempdir().unwrap();
    let file = dir.path().join("stages.json");
    let path = file.to_string_lossy().into_owned();
    let arguments = ["stages", "--gaussians", "300,600", "--sizes", "64x48", "--steps", "2", "--json", &path];
    let text = held(&bench(&arguments));
    assert!(text.contains("How cost grows") && text.contains("rasterise_backward"), "{text}");
    let all = json(&file);
    assert!(all["operations_per_s"].as_f64().unwrap() > 0.0);
    let sizes = all["sizes"].as_array().unwrap();
    assert_eq!(sizes.len(), 2);
    for size in sizes {
        let stages = size["stages"].as_array().unwrap();
        assert_eq!(stages.len(), vulkan::stages::STAGES.len());
        assert!(stages.iter().all(|s| s["bytes"].as_u64().unwrap() > 0 && s["least_ms"].as_f64().unwrap() > 0.0));
        assert!(size["instances"].as_u64().unwrap() > size["visible"].as_u64().unwrap() / 2);
    }
}

#[test]
fn a_forecast_stands_beside_what_was_measured() {
    if !has_device() {
        return;
    }
    let dir = tempfile::tempdir().unwrap();
    let file = dir.path().join("forecast.json");
    let text = held(&bench(&["forecast", "--sizes", "1", "--steps", "1", "--json", &file.to_string_lossy()]));
    assert!(text.contains("10000 270×480") && text.contains("ratio"), "{text}");
    let sizes = json(&file)["sizes"].as_array().unwrap().clone();
    assert!(sizes.len() == 1 && sizes[0]["forecast_ms"].as_f64().unwrap() > 0.0, "{sizes:?}");
}

#[test]
#[ignore = "ratios of times, on a quiet machine only: LP_NUM_THREADS=1 and 2"]
fn a_forecast_is_within_a_quarter_of_what_is_measured_at_every_size() {
    let dir = tempfile::tempdir().unwrap();
    let file = dir.path().join("forecast.json");
    let text = held(&bench(&["forecast", "--json", &file.to_string_lossy()]));
    for size in json(&file)["sizes"].as_array().unwrap() {
        let ratio = size["forecast_ms"].as_f64().unwrap() / size["measured_ms"].as_f64().unwrap();
        assert!((0.75..=1.25).contains(&ratio), "{text}");
    }
}

#[test]
fn a_budget_is_what_is_allocated_and_one_too_small_is_a_row_that_says_so() {
    if !has_device() {
        return;
    }
    let dir = tempfile::tempdir().unwrap();
    let file = dir.path().join("memory.json");
    let path = file.to_string_lossy().into_owned();
    let arguments = ["memory", "--budgets", "16,40", "--steps", "2", "--scale", "0.5", "--init", "random"];
    let text = held(&bench(&[&arguments[..], &["--json", &path]].concat()));
    assert!(text.contains("as planned"), "{text}");
    let budgets = json(&file)["budgets"].as_array().unwrap().clone();
    let measured: Vec<&Value> = budgets.iter().filter(|b| b["failed"].is_null()).collect();
    assert!(!measured.is_empty());
    for b in measured {
        assert_eq!(b["planned_bytes"], b["allocated_bytes"]);
        assert!(b["resident_bytes"].as_u64().unwrap() <= b["limit_mib"].as_u64().unwrap() << 20, "{b}");
    }
    let refused = bench(&["memory", "--budgets", "1", "--steps", "2", "--init", "random"]);
    assert!(held(&refused).contains("too few"), "a refused budget is a row");
}

#[test]
fn a_scene_larger_than_the_device_is_trained_saved_and_drawn_as_one_that_fits() {
    if !has_device() {
        return;
    }
    let dir = tempfile::tempdir().unwrap();
    let path = |name: &str| dir.path().join(name).to_string_lossy().into_owned();
    // The first is in cells, the second on the device as a whole.
    for (gaussians, in_cells) in [(30_000, true), (15_000, false)] {
        let (out, file, number) = (path("out"), path("scene.json"), gaussians.to_string());
        let arguments = ["scene", "--gaussians", &number, "--device-mib", "128", "--steps", "5", "--out", &out];
        let text = held(&bench(&[&arguments[..], &["--json", &file]].concat()));
        assert!(text.contains("the unpaged one to the bit") && !text.contains("NOT"), "{text}");
        let all = json(&dir.path().join("scene.json"));
        assert_eq!(all["gaussians"][0], gaussians);
        assert_eq!(all["cells"][1].as_u64().unwrap() > 0, in_cells, "{all}");
        assert_eq!(all["device_bytes"][0], all["device_bytes"][1]);
        assert!([0, 1].iter().all(|i| all["drawn"][*i]["same"] == true), "{all}");
        assert_eq!(all["drawn"][1]["seen"], gaussians);
        let model = models::formats::model::Chunks::open(&dir.path().join("out/model.dgtr")).unwrap();
        assert_eq!((model.count, model.sh_degree, model.header.steps), (gaussians, 3, 5));
        assert!(["near.png", "whole.png"].iter().all(|name| dir.path().join("out").join(name).is_file()));
    }
}

#[test]
fn time_against_error_leaves_figures_a_picture_and_a_page_and_keeps_what_it_measured() {
    if !has_device() {
        return;
    }
    let dir = tempfile::tempdir().unwrap();
    let path = |name: &str| dir.path().join(name).to_string_lossy().into_owned();
    write_data_set(&dir.path().join("world"), 2, 1.0).unwrap();
    let (set, out) = (path("world"), path("out"));
    let arguments = [
        "time-error",
        &set,
        "--out",
        &out,
        "--seconds",
        "0.5,1",
        "--seeds",
        "1",
        "--init",
        "random",
        "--scale",
        "0.25",
        "--max-gaussians",
        "2000",
    ];
    let text = held(&bench(&arguments));
    assert!(text.contains("world random"), "{text}");
    let first = json(&dir.path().join("out/result.json"));
    assert_eq!(first["points"].as_array().unwrap().len(), 2);
    assert!(first["groups"].as_array().unwrap().iter().any(|g| g["on_front"] == true));
    let svg = std::fs::read_to_string(dir.path().join("out/world.svg")).unwrap();
    assert!(svg.contains("<circle"), "{svg}");
    assert!(std::fs::read_to_string(dir.path().join("out/report.html")).unwrap().contains("data:image/svg+xml"));
    held(&bench(&arguments));
    assert_eq!(json(&dir.path().join("out/result.json")), first, "points that are there were measured again");
}

#[test]
fn few_pictures_are_a_row_for_each_share_and_what_was_trained_is_kept() {
    if !has_device() {
        return;
    }
    let dir = tempfile::tempdir().unwrap();
    let path = |name: &str| dir.path().join(name).to_string_lossy().into_owned();
    write_data_set(&dir.path().join("world"), 3, 1.0).unwrap();
    let (set, out) = (path("world"), path("out"));
    let how = ["--every", "1,2", "--seeds", "1", "--init", "random", "--steps", "2", "--scale", "0.25"];
    let arguments = [&["sparse", &set, "--out", &out, "--max-gaussians", "2000"], &how[..]].concat();
    let text = held(&bench(&arguments));
    assert!(text.contains("1/2") && text.contains("all"), "{text}");
    let first = json(&dir.path().join("out/result.json"));
    let pictures: Vec<u64> = first.as_array().unwrap().iter().map(|p| p["pictures"].as_u64().unwrap()).collect();
    assert_eq!(pictures.len(), 2);
    assert_eq!(pictures[1], pictures[0].div_ceil(2));
    held(&bench(&arguments));
    assert_eq!(json(&dir.path().join("out/result.json")), first, "what is there was trained again");
}

#[test]
fn every_skip_is_a_row_with_a_verdict() {
    if !has_device() {
        return;
    }
    let dir = tempfile::tempdir().unwrap();
    let file = dir.path().join("skips.json");
    let path = file.to_string_lossy().into_owned();
    let arguments = ["skips", "--steps", "2", "--scale", "0.25", "--init", "random", "--max-gaussians", "500"];
    let text = held(&bench(&[&arguments[..], &["--json", &path]].concat()));
    let runs = json(&file)["runs"].as_array().unwrap().clone();
    let switched = bench::skips::SKIPS.iter().filter(|s| !s.feed_forward).count();
    assert_eq!(runs.len(), switched + 1, "{text}");
    assert!(text.contains("by the rule") && text.contains("key frames of 24 pictures"), "{text}");
}

#[test]
fn the_reference_keeps_every_promise_without_a_device() {
    let dir = tempfile::tempdir().unwrap();
    let file = dir.path().join("stress.json");
    let text = held(&bench(&["stress", "--reference-only", "--json", &file.to_string_lossy()]));
    assert!(text.contains("held") && !text.contains("BROKEN"), "{text}");
    let all = json(&file).as_array().unwrap().clone();
    assert!(all.len() > 10 && all.iter().all(|t| t["path"] == "reference" && t["held"] == true), "{all:?}");
}

#[test]
fn detail_that_training_pictures_cannot_show_is_learnt_from_crops_and_the_same_seed_gives_the_same_bytes() {
    if !has_device() {
        return;
    }
    let dir = tempfile::tempdir().unwrap();
    let path = |name: &str| dir.path().join(name).to_string_lossy().into_owned();
    write_data_set(&dir.path().join("world"), 2, 1.0).unwrap();
    let (set, figures) = (path("world"), path("figures.json"));
    let run = |out: &str, crops: &str| {
        let out = path(out);
        let of_training = ["--scale", "0.25", "--steps", "150", "--max-gaussians", "4000", "--crops", crops];
        held(&bench(&[&["detail", &set, "--out", &out, "--json", &figures][..], &of_training].concat()));
        json(Path::new(&figures)).as_array().unwrap().clone()
    };
    let both = run("first", "0,512");
    assert_eq!([0, 1].map(|i| both[i]["taken"].as_u64().unwrap()), [0, 21 * 16]);
    let [whole, crops] = [0, 1].map(|i| both[i]["full"]["psnr"].as_f64().unwrap());
    println!("{whole:.2} dB at full size from whole pictures, {crops:.2} dB with crops");
    assert!(crops > whole + 0.3, "{whole} dB, {crops} dB");
    // A third of the room: of each picture the five with the most detail.
    assert_eq!(run("second", "105,512")[0]["taken"], 21 * 4, "all crops of half the size find room");
    let model = |out: &str| std::fs::read(dir.path().join(out).join("crops-512/model.dgtr")).unwrap();
    assert!(model("first") == model("second"), "another model from the same seed");
}

/// Three methods on 32 pictures of 80×60: the first two share their trainings.
#[test]
fn methods_end_in_one_table_and_what_is_there_is_continued_and_not_done_again() {
    if !has_device() {
        return;
    }
    let dir = tempfile::tempdir().unwrap();
    let out = dir.path().join("out");
    let path = out.to_string_lossy().into_owned();
    let compare_in = |steps: &str, more: &[&str]| {
        let small = ["--scale", "0.25", "--steps", steps, "--max-gaussians", "900", "--budget-mib", "64"];
        held(&bench(&[&["methods", "--simulated", "2", "--out", &path][..], &small, more].concat()))
    };
    let compare = |more: &[&str]| compare_in("6", more);
    let three = ["--methods", "distributed-3dgs,fed-3dgs,vastgaussian"];
    let text = compare(&three);
    assert!(text.contains("| fed-3dgs") && text.contains("near seams") && text.contains("By region"), "{text}");
    assert_eq!(std::fs::read_to_string(out.join("methods.md")).unwrap(), text);
    let first = json(&out.join("methods.json"));
    let rows = first["methods"].as_array().unwrap();
    assert_eq!(rows.len(), 3);
    for row in rows {
        let name = row["method"].as_str().unwrap();
        assert_eq!((row["quality"]["all"]["views"].as_u64(), row["steps"].as_u64()), (Some(5), Some(12)), "{name}");
        assert!(row["quality"]["all"]["psnr"].as_f64().unwrap() > 5.0, "{row}");
        assert_eq!(row["onboard_s"].as_array().unwrap().len(), 2, "{name}");
        let [sent, delivered] = ["sent_bytes", "delivery_bytes"].map(|b| row[b].as_u64().unwrap());
        assert!(delivered > 0 && delivered < sent, "{name}");
    }
    let sent = |i: usize| rows[i]["pictures_sent"].as_u64().unwrap();
    assert!(sent(0) == 0 && sent(1) == 0 && sent(2) > 0 && sent(2) < 27, "neighbours' pictures alone leave");
    let trainings = || std::fs::read_dir(out.join("models")).unwrap().map(|e| e.unwrap().path()).collect::<Vec<_>>();
    assert_eq!(trainings().len(), 4, "two of the methods are trained alike");
    // Without one result, with all trainings: that one is made again, and nothing else.
    let when = |path: &Path| std::fs::metadata(path).unwrap().modified().unwrap();
    let made = |name: &str| when(&out.join(name).join("result.json"));
    let trained: Vec<_> = trainings().iter().map(|p| (p.clone(), when(&p.join("model.dgtr")))).collect();
    let before = ["distributed-3dgs", "vastgaussian"].map(made);
    std::fs::remove_file(out.join("fed-3dgs/result.json")).unwrap();
    let answer: Value = serde_json::from_str(&compare(&[&three[..], &["--json"]].concat())).unwrap();
    assert_eq!(["distributed-3dgs", "vastgaussian"].map(made), before);
    assert!(trained.iter().all(|(path, then)| when(&path.join("model.dgtr")) == *then), "trained again");
    let quality = |all: &Value| (0..3).map(|i| all["methods"][i]["quality"].clone()).collect::<Vec<_>>();
    assert_eq!(quality(&answer), quality(&first), "the same seed, the same figures");
    // Other steps are another comparison.
    compare_in("7", &["--methods", "distributed-3dgs"]);
    assert_eq!(trainings().len(), 6);
}

#[test]
fn methods_that_cannot_be_compared_are_refused_in_one_line() {
    let dir = tempfile::tempdir().unwrap();
    let path = |name: &str| dir.path().join(name).to_string_lossy().into_owned();
    write_data_set(&dir.path().join("world"), 2, 0.1).unwrap();
    let (set, out) = (path("world"), path("out"));
    let refused = |arguments: &[&str], line: &str| {
        let output = bench(&[&["methods", "--out", &out], arguments].concat());
        let text = String::from_utf8_lossy(&output.stderr).into_owned();
        assert_eq!(output.status.code(), Some(2), "{arguments:?}: {text}");
        assert!(text.contains(line), "{arguments:?}: {text}");
    };
    refused(&[&set, "--methods", "dgtr,central-3dgs"], "has no sparse points");
    refused(&[&set, "--methods", "nerf"], "nerf");
    refused(&[&set, "--methods", "dgtr", "--regions", "12"], "21 training pictures are too few for 12 regions");
    refused(&[&set, "--methods", "dgtr", "--split", "dense"], "dense");
    refused(&[&set, "--scale", "0"], "--scale 0 must be above 0");
    refused(&[&set, "--seconds=-1"], "--seconds");
    refused(&["--simulated", "1"], "must be 2 to 24 aircraft");
    refused(&[&path("nowhere"), "--methods", "dgtr"], "nowhere");
    refused(&[], "DATASET");
    assert!(!dir.path().join("out/models").exists(), "nothing was trained");
}
