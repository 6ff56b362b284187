//! The switches of the paper's two ablations act through `dgtr train --settings`.
#![allow(clippy::expect_used, clippy::panic, reason = "a test fails by panicking")]

mod support;

use std::path::Path;

use models::cloud::GaussianCloud;
use models::formats::model;
use support::plane::plane_dataset;
use support::run;

/// The model after a few steps on the plane in `at` with the settings given.
fn trained(at: &Path, out: &str, settings: &str) -> GaussianCloud {
    let file = format!("{out}.toml");
    std::fs::write(at.join(&file), settings).expect("settings");
    let budget = ["--steps", "5", "--max-gaussians", "6000", "--budget-mib", "64", "--no-eval"];
    let output = run(at, &[&["train", "set", "--out", out, "--settings", &file], &budget[..]].concat());
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    model::read(&at.join(out).join("model.dgtr")).expect("model").1
}

fn median_extent(cloud: &GaussianCloud) -> f32 {
    let mut longest: Vec<f32> = cloud.log_scales.iter().map(|s| s[0].max(s[1]).max(s[2]).exp()).collect();
    longest.sort_by(f32::total_cmp);
    longest[longest.len() / 2]
}

#[test]
fn global_and_local_scale_set_the_extent_of_the_gaussians() {
    let dir = tempfile::tempdir().expect("tempdir");
    let at = dir.path();
    plane_dataset(&at.join("set"), 1);
    let neither = median_extent(&trained(at, "none", "[init]\nglobal_scale = false\nlocal_scale = false\n"));
    let global = median_extent(&trained(at, "global", "[init]\nlocal_scale = false\n"));
    let both = median_extent(&trained(at, "both", ""));
    // At 50 m; the local scale also closes the gaps that merging into 6,000 leaves.
    assert!(global / neither > 30.0 && global / neither < 80.0, "{neither} {global} {both}");
    assert!(both > 1.2 * global, "{neither} {global} {both}");
}

#[test]
fn depth_loss_and_shape_freezing_act_and_freezing_needs_the_loss() {
    let dir = tempfile::tempdir().expect("tempdir");
    let at = dir.path();
    plane_dataset(&at.join("set"), 1);
    let loss = |depth: &str, freeze: bool| format!("[training.loss]\ndepth = {depth}\nfreeze_shape = {freeze}\n");
    let off = trained(at, "off", &loss("0.0", true));
    let off_free = trained(at, "off_free", &loss("0.0", false));
    let free = trained(at, "free", &loss("0.05", false));
    let frozen = trained(at, "frozen", &loss("0.05", true));
    assert_eq!(off, off_free, "without the depth loss there is nothing to freeze");
    assert_ne!(off.means, frozen.means, "the depth loss moves centres");
    assert_ne!(free.log_scales, frozen.log_scales, "freezing keeps it from the shapes");
    assert_eq!(frozen, trained(at, "default", ""), "the default is on and on");
}

#[test]
fn a_random_start_takes_depths_for_its_loss_when_it_is_told_to_and_only_then() {
    let dir = tempfile::tempdir().expect("tempdir");
    let at = dir.path();
    plane_dataset(&at.join("set"), 1);
    let from_random = |out: &str, settings: &str| {
        let file = format!("{out}.toml");
        std::fs::write(at.join(&file), settings).expect("settings");
        let budget = ["--steps", "5", "--max-gaussians", "3000", "--budget-mib", "64", "--no-eval"];
        let start = ["train", "set", "--init", "random", "--out", out, "--settings", &file];
        let output = run(at, &[&start[..], &budget].concat());
        assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
        let report = std::fs::read_to_string(at.join(out).join("run.json")).expect("run.json");
        (model::read(&at.join(out).join("model.dgtr")).expect("model").1, report.contains("\"depth_prior\""))
    };
    let (plain, told) = from_random("plain", "");
    assert!(!told, "nothing asks for depths");
    let (with_depths, told) = from_random("depths", "[init]\ndepth_priors = true\n");
    assert!(told, "run.json says which network gave them");
    assert_eq!(plain.len(), with_depths.len(), "the start is the same");
    assert_ne!(plain.means, with_depths.means, "the loss moves centres");
    let (no_loss, told) = from_random("no_loss", "[init]\ndepth_priors = true\n[training.loss]\ndepth = 0.0\n");
    assert_eq!((no_loss == plain, told), (true, false), "without the loss nobody asks");
}
