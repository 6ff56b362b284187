//! Nothing that was saved is lost: Ctrl-C, a second start, a port that goes away, a picture that is none.
#![allow(clippy::expect_used, clippy::panic, reason = "a test fails by panicking")]

mod support;

use std::time::Duration;

use models::formats::model;
use support::{Running, small_mission, wait_until};

const PATIENCE: Duration = Duration::from_secs(120);

#[test]
fn ctrl_c_in_flight_leaves_a_valid_checkpoint_and_the_same_command_continues() {
    let dir = tempfile::tempdir().expect("tempdir");
    let at = dir.path();
    small_mission(at);
    // A picture that is none must be named and left out, not end the flight.
    std::fs::write(at.join("camera/broken.jpg"), b"not a picture").expect("write");
    let sim = [
        "sim",
        "--mission",
        "mission.toml",
        "--link",
        "pty:port",
        "--speed",
        "6",
        "--linger",
        "0",
        "--side-overlap",
        "0.4",
    ];
    let _sim = Running::start(at, &sim, &at.join("sim.log"));
    wait_until("the port", &at.join("sim.log"), PATIENCE, || at.join("port").exists());
    let fly = ["fly", "--mission", "mission.toml", "--out", "out", "--silence", "6"];
    let mut job = Running::start(at, &fly, &at.join("fly.log"));
    let checkpoint = at.join("out/model.dgtr");
    wait_until("the first checkpoint", &at.join("fly.log"), PATIENCE, || checkpoint.is_file());
    job.interrupt();
    assert_eq!(job.code(PATIENCE), Some(4), "{}", std::fs::read_to_string(at.join("fly.log")).unwrap_or_default());
    let (header, cloud) = model::read(&checkpoint).expect("a valid model");
    assert!(!header.finished && cloud.len() > 1000 && header.views.len() >= 3);

    // The aircraft is gone by now or goes on; either way the second run starts from what the first one saved.
    let mut job = Running::start(at, &fly, &at.join("fly2.log"));
    wait_until("continuing", &at.join("fly2.log"), PATIENCE, || {
        std::fs::read_to_string(at.join("fly2.log")).is_ok_and(|t| t.contains("continuing out/model.dgtr"))
    });
    std::thread::sleep(Duration::from_secs(1));
    job.interrupt();
    assert_eq!(job.code(PATIENCE), Some(4), "{}", std::fs::read_to_string(at.join("fly2.log")).unwrap_or_default());
    let (again, _) = model::read(&checkpoint).expect("still valid");
    assert!(again.views.len() >= header.views.len() && again.steps >= header.steps);
}
