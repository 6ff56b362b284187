//! Bad input: one line that says what, where and how to mend it, and the documented exit code.
#![allow(clippy::expect_used, clippy::panic, reason = "a test fails by panicking")]

mod support;

use support::{refused, run, small_mission};

#[test]
fn missing_and_wrong_files_are_named_in_one_line_with_exit_code_2() {
    let dir = tempfile::tempdir().expect("tempdir");
    let at = dir.path();
    small_mission(at);
    std::fs::write(at.join("bad.toml"), "name = \"x\"\nthis is no toml\n").expect("write");
    std::fs::write(at.join("noise.dgtr"), [7u8; 4096]).expect("write");
    std::fs::create_dir(at.join("empty")).expect("mkdir");
    refused(at, &["train", "nowhere", "--out", "o"], 2, &["nowhere"]);
    refused(at, &["train", "empty", "--out", "o"], 2, &["empty"]);
    refused(at, &["eval", "noise.dgtr", "empty"], 2, &["empty"]);
    refused(at, &["export", "noise.dgtr", "--to", "ply", "--out", "x.ply"], 2, &["noise.dgtr"]);
    refused(at, &["fly", "--mission", "nowhere.toml", "--out", "o"], 2, &["nowhere.toml"]);
    refused(at, &["fly", "--mission", "bad.toml", "--out", "o"], 2, &["bad.toml", "line 2"]);
    refused(at, &["fly", "--mission", "mission.toml", "--aircraft", "two", "--out", "o"], 2, &["two", "one"]);
    refused(at, &["fly", "--mission", "mission.toml", "--out", "o", "--link", "carrier:pigeon"], 2, &["carrier"]);
    refused(at, &["serve", "--mission", "nowhere.toml", "--out", "o"], 2, &["nowhere.toml"]);
    refused(at, &["replay", "empty", "--link", "pty"], 2, &["empty"]);
    refused(at, &["sim", "--mission", "mission.toml", "--link", "pty", "--height=-3"], 2, &["height"]);
    std::fs::write(at.join("bad.plan"), "{ \"fileType\": \"Plan\" }").expect("write");
    refused(at, &["sim", "--mission", "mission.toml", "--link", "pty", "--plan", "bad.plan"], 2, &["bad.plan"]);
}

#[test]
fn a_truncated_log_is_reported_and_played_as_far_as_it_goes() {
    let log = std::path::Path::new(env!("CARGO_MANIFEST_DIR")).join("data/run8_trimmed.tlog");
    let bytes = std::fs::read(&log).expect("our own recording");
    let dir = tempfile::tempdir().expect("tempdir");
    std::fs::write(dir.path().join("cut.tlog"), &bytes[..bytes.len() / 2 + 7]).expect("write");
    let output = run(dir.path(), &["replay", "cut.tlog", "--link", "pty", "--speed", "200", "--linger", "0"]);
    let text = String::from_utf8_lossy(&output.stderr);
    assert!(output.status.success(), "{text}");
    assert!(text.contains("cut short"), "{text}");
}

#[test]
fn a_device_that_is_not_there_is_exit_code_3() {
    let dir = tempfile::tempdir().expect("tempdir");
    small_mission(dir.path());
    let output = run(dir.path(), &["doctor"]);
    assert!(!String::from_utf8_lossy(&output.stdout).is_empty(), "doctor says what there is");
    let text = std::fs::read_to_string(dir.path().join("mission.toml")).expect("mission");
    let other = text.replace("id = \"one\"", "id = \"one\"\ndevice = \"no such device\"");
    std::fs::write(dir.path().join("mission.toml"), other).expect("write");
    refused(
        dir.path(),
        &["fly", "--mission", "mission.toml", "--out", "o", "--link", "udpin:127.0.0.1:0"],
        3,
        &["no such device"],
    );
}
