//! What programs and people who look on are told: results, log lines as JSON, a trace, and who may see the live page.

use std::process::Stdio;

use super::{data_set, dgtr, error_line, has_device, program, supervised};

#[test]
fn with_log_json_every_line_is_an_object_the_error_included() {
    let output = dgtr(&["--log", "json", "eval", "nowhere.dgtr", "nowhere"]);
    assert_eq!(output.status.code(), Some(2));
    let text = String::from_utf8(output.stderr).unwrap();
    let lines: Vec<serde_json::Value> =
        text.lines().map(|l| serde_json::from_str(l).unwrap_or_else(|e| panic!("{e}: {l}"))).collect();
    let last = lines.last().expect("the error");
    assert_eq!((&last["level"], last["message"].as_str().unwrap().contains("nowhere")), (&"ERROR".into(), true));
    assert!(last["timestamp"].as_str().is_some_and(|t| t.starts_with("20")), "{last}");
}

#[test]
fn a_trace_holds_stages_steps_and_the_kernels_by_the_devices_clock() {
    if !has_device() {
        return;
    }
    let dir = tempfile::tempdir().unwrap();
    data_set(&dir.path().join("set"));
    let path = |name: &str| dir.path().join(name).to_string_lossy().into_owned();
    let (set, out, trace) = (path("set"), path("out"), path("trace.json"));
    let short = ["--init", "random", "--max-gaussians", "500", "--steps", "40", "--budget-mib", "64", "--no-eval"];
    let output = dgtr(&[&["--log", "json", "--trace", &trace, "train", &set, "--out", &out][..], &short].concat());
    let text = String::from_utf8(output.stderr).unwrap();
    assert!(output.status.success(), "{text}");
    text.lines().for_each(|l| assert!(serde_json::from_str::<serde_json::Value>(l).is_ok(), "{l}"));
    let events: Vec<serde_json::Value> = serde_json::from_str(&std::fs::read_to_string(&trace).unwrap()).unwrap();
    let of = |name: &str| events.iter().filter(|e| e["ph"] == "X" && e["name"] == name).collect::<Vec<_>>();
    assert_eq!(of("step").len(), 40, "every step");
    for name in ["open", "train", "checkpoint"] {
        assert!(!of(name).is_empty(), "no {name}");
    }
    let blended = of("rasterise");
    // Every step is timed, not one in sixteen; a device without timestamps tells none.
    assert!(blended.len() >= 40 && blended.iter().all(|e| e["tid"] == 0), "{} on the device", blended.len());
    let total_us = |name: &str| of(name).iter().filter_map(|e| e["dur"].as_f64()).sum::<f64>();
    assert!(total_us("rasterise") > 0.0 && total_us("rasterise") < total_us("train"), "the clocks have one unit");
    assert_eq!(dgtr(&["--trace", "/nonexistent/t.json", "plan"]).status.code(), Some(2));
}

#[test]
fn a_live_page_that_others_could_see_is_refused_before_anything_begins() {
    let dir = tempfile::tempdir().unwrap();
    let mission = supervised::mission(dir.path());
    let out = dir.path().join("out").to_string_lossy().into_owned();
    let token = dir.path().join("token").to_string_lossy().into_owned();
    std::fs::write(&token, "short").unwrap();
    std::fs::set_permissions(&token, std::os::unix::fs::PermissionsExt::from_mode(0o600)).expect("its own");
    for command in ["fly", "serve"] {
        let refused = |more: &[&str]| {
            let output = dgtr(&[&[command, "--mission", &mission, "--out", &out], more].concat());
            assert_eq!(output.status.code(), Some(2), "{command} {more:?}");
            assert!(!dir.path().join("out").exists(), "{command} {more:?} began");
            error_line(&output)
        };
        assert!(refused(&["--http", "0.0.0.0:0"]).contains("--http-token-file"));
        assert!(refused(&["--http", "8080"]).contains("127.0.0.1:8080"));
        assert!(refused(&["--http", "0.0.0.0:0", "--http-token-file", &token]).contains("16 to 256"));
        assert!(refused(&["--http", "0.0.0.0:0", "--http-token-file", "/nonexistent"]).contains("/nonexistent"));
    }
}

#[test]
fn whoever_reads_the_results_may_stop_reading() {
    let mut child =
        program().args(["plan", "--views", "4"]).stdout(Stdio::piped()).stderr(Stdio::piped()).spawn().unwrap();
    drop(child.stdout.take());
    let ended = child.wait_with_output().unwrap();
    assert_eq!(ended.status.code(), Some(0), "{}", String::from_utf8_lossy(&ended.stderr));
    assert!(ended.stderr.is_empty(), "{}", String::from_utf8_lossy(&ended.stderr));
    // A disk without room is another matter.
    let full = std::fs::OpenOptions::new().write(true).open("/dev/full").unwrap();
    let ended = program().args(["plan", "--views", "4"]).stdout(full).stderr(Stdio::piped()).output().unwrap();
    let said = String::from_utf8_lossy(&ended.stderr);
    assert!(ended.status.code() == Some(1) && said.contains("standard output") && said.lines().count() == 1, "{said}");
}
