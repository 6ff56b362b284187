//! An aircraft whose radio falls silent while it flies, and is heard again: the ground says both at once, in its log, on its page and in
//! its report.
#![allow(clippy::expect_used, clippy::panic, reason = "a test fails by panicking")]

mod support;

use std::io::{BufRead, BufReader, Write};
use std::net::TcpStream;
use std::time::Duration;

use support::radio::Radio;
use support::{Running, change_mission, free_port, small_mission, wait_until};

const PATIENCE: Duration = Duration::from_secs(120);

/// What the page at `address` says of its first aircraft now.
fn state(address: &str) -> Option<String> {
    let mut stream = TcpStream::connect(address).ok()?;
    stream.set_read_timeout(Some(Duration::from_secs(5))).ok()?;
    stream.write_all(format!("GET /events HTTP/1.1\r\nHost: {address}\r\n\r\n").as_bytes()).ok()?;
    let line = BufReader::new(stream).lines().map_while(Result::ok).find(|line| line.starts_with("data: "))?;
    let page: serde_json::Value = serde_json::from_str(&line["data: ".len()..]).ok()?;
    page["aircraft"][0]["state"].as_str().map(str::to_owned)
}

#[test]
fn a_silent_aircraft_is_named_in_flight_on_the_page_in_the_log_and_in_the_report_and_so_is_its_return() {
    let dir = tempfile::tempdir().expect("tempdir");
    let at = dir.path();
    small_mission(at);
    let port = free_port();
    let radio = Radio::to(port);
    let upload = format!(
        "upload = {{ listen = [\"tcp/127.0.0.1:{port}\"], connect = [\"tcp/127.0.0.1:{}\"], poll_s = 0.3, retry_min_s = 0.1, \
         retry_max_s = 0.5, checkpoint_s = 0.0 }}\nground = {{ epochs = 0, silence_s = 5.0 }}\nlink = {{ battery_swap_s = 0.0 }}",
        radio.port
    );
    change_mission(at, &[("upload = { folder = \"upload\" }", &upload), ("seconds = 600.0", "seconds = 2.0")]);
    let log = at.join("serve.log");
    let serve = ["serve", "--mission", "mission.toml", "--out", "ground", "--http", "127.0.0.1:0"];
    let mut ground = Running::start(at, &serve, &log);
    let said = || std::fs::read_to_string(&log).unwrap_or_default();
    let says = |words: &str| said().contains(words);
    wait_until("the page", &log, PATIENCE, || says("live page: http://"));
    let address = said()
        .split_once("live page: http://")
        .and_then(|(_, rest)| rest.split_once('/'))
        .expect("an address")
        .0
        .to_owned();

    let sim_log = at.join("sim.log");
    let sim = ["sim", "--mission", "mission.toml", "--link", "pty:port", "--speed", "1", "--linger", "1"];
    let _sim = Running::start(at, &sim, &sim_log);
    wait_until("the port", &sim_log, PATIENCE, || at.join("port").exists());
    let fly_log = at.join("fly.log");
    let mut fly = Running::start(at, &["fly", "--mission", "mission.toml", "--out", "out", "--silence", "8"], &fly_log);
    wait_until("the first key frame", &fly_log, PATIENCE, || {
        std::fs::read_to_string(&fly_log).is_ok_and(|said| said.contains("key frame 1"))
    });
    wait_until("the aircraft being heard", &log, PATIENCE, || {
        state(&address).as_deref() == Some("no model is here yet")
    });
    assert!(!says("has not been heard of"), "{}", said());

    radio.silence(true);
    wait_until("the silence being named", &log, PATIENCE, || says("one has not been heard of for"));
    wait_until("the page", &log, PATIENCE, || state(&address).as_deref() == Some("silent"));
    radio.silence(false);
    wait_until("the return being named", &log, PATIENCE, || says("one is heard of again"));
    wait_until("the page", &log, PATIENCE, || state(&address).is_some_and(|state| state != "silent"));
    let first = said().matches("has not been heard of for").count();
    assert_eq!(first, 1, "once: {}", said());

    assert_eq!(fly.code(PATIENCE), Some(0), "{}", std::fs::read_to_string(&fly_log).unwrap_or_default());
    assert_eq!(ground.code(PATIENCE), Some(0), "{}", said());
    let report = std::fs::read_to_string(at.join("ground/report.html")).expect("a report");
    assert!(report.contains("one has not been heard of for") && report.contains("one is heard of again"), "{report}");
}
