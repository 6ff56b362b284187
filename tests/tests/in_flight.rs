//! What happens to a flight must not end it: a port that is unplugged, pictures that never come. Both are counted and warned
//! about, and the mission carries on to its model.
#![allow(clippy::expect_used, clippy::panic, reason = "a test fails by panicking")]

mod support;

use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

use hal::link::{PtyLink, TcpLink};
use hal::traits::Link;
use serde_json::Value;
use support::{Running, change_mission, small_mission, wait_until};

const PATIENCE: Duration = Duration::from_secs(120);
/// Simulated seconds per second: a flight of half a minute in five seconds.
const SPEED: &str = "6";

/// A small region, the least training, and little patience with what does not come.
fn quick_mission(at: &Path, faults: &str) {
    small_mission(at);
    change_mission(
        at,
        &[
            ("-20.0", "-12.0"),
            ("20.0]", "12.0]"),
            ("[20.0", "[12.0"),
            ("seconds = 600.0", "seconds = 1.0"),
            (
                "upload = { folder = \"upload\" }",
                &format!("link = {{ patience_s = 2.0, battery_swap_s = 0.0 }}\n{faults}"),
            ),
        ],
    );
}

fn sim(at: &Path, link: &str) -> Running {
    let arguments = ["sim", "--mission", "mission.toml", "--link", link, "--speed", SPEED, "--linger", "0"];
    Running::start(at, &arguments, &at.join("sim.log"))
}

/// `dgtr fly` to its end: its log and its run.json.
fn fly(at: &Path, during: impl FnOnce(&Path)) -> (String, Value) {
    let log = at.join("fly.log");
    let mut job = Running::start(at, &["fly", "--mission", "mission.toml", "--out", "out", "--silence", "8"], &log);
    during(&log);
    let code = job.code(PATIENCE);
    let said = std::fs::read_to_string(&log).unwrap_or_default();
    assert_eq!(code, Some(0), "{said}");
    let run = std::fs::read(at.join("out/run.json")).expect("run.json");
    let run: Value = serde_json::from_slice(&run).expect("JSON");
    let covered = std::fs::read(at.join("out/coverage.geojson")).expect("what the flight covered");
    let covered: Value = serde_json::from_slice(&covered).expect("JSON");
    assert!(run["coverage"]["percent"].is_u64() && covered["covered_share"].is_number(), "{run}");
    let again = run["coverage"]["more_pictures"].as_u64().expect("a number") > 0;
    assert_eq!(at.join("out/reflight.plan").is_file(), again, "a flight is written when one is needed");
    (said, run)
}

/// A serial cable between the simulator's socket and a port called `alias`: pulled while `pulled` is set.
fn cable(socket: &str, alias: PathBuf, pulled: &AtomicBool, over: &AtomicBool) {
    let mut buffer = [0; 4096];
    let (mut far, mut near) = (None, None);
    while !over.load(Ordering::Relaxed) {
        let Some(socket) = &mut far else {
            far = TcpLink::connect(socket).ok();
            std::thread::sleep(Duration::from_millis(20));
            continue;
        };
        if pulled.load(Ordering::Relaxed) {
            near = None;
        } else if near.is_none() {
            near = PtyLink::create(Some(&alias)).ok();
        }
        let wait = Duration::from_millis(2);
        match socket.read(&mut buffer, wait) {
            // What comes while the cable is out is lost; so is what a full line does not take.
            Ok(got) => drop(near.as_mut().map(|port| port.write(&buffer[..got.bytes]))),
            // The simulator is gone, or never was there: the port was free a moment ago, and whoever starts a process beside us holds its
            // old listener until that process runs.
            Err(_) => {
                (far, near) = (None, None);
                continue;
            }
        }
        if let Some(Ok(got)) = near.as_mut().map(|port| port.read(&mut buffer, wait))
            && got.bytes > 0
        {
            let _ = socket.write(&buffer[..got.bytes]);
        }
    }
}

#[test]
fn an_unplugged_port_is_counted_and_the_mission_carries_on_when_it_is_back() {
    let dir = tempfile::tempdir().expect("tempdir");
    let at = dir.path();
    quick_mission(at, "");
    let free = std::net::TcpListener::bind("127.0.0.1:0").and_then(|l| l.local_addr()).expect("a port");
    let socket = free.to_string();
    let (pulled, over) = (AtomicBool::new(false), AtomicBool::new(false));
    std::thread::scope(|scope| {
        let _sim = sim(at, &format!("tcpin:{socket}"));
        scope.spawn(|| cable(&socket, at.join("port"), &pulled, &over));
        wait_until("the port", &at.join("sim.log"), PATIENCE, || at.join("port").exists());
        let (said, run) = fly(at, |log| {
            let says = |what: &str| std::fs::read_to_string(log).is_ok_and(|t| t.contains(what));
            wait_until("the first key frame", log, PATIENCE, || says("key frame 1"));
            pulled.store(true, Ordering::Relaxed);
            wait_until("the loss being noticed", log, PATIENCE, || says("link to the autopilot lost"));
            // The job looks at its failsafe ladder a few times a second; a cable put back at once would go unseen there.
            wait_until("the failsafe ladder's warning", log, PATIENCE, || says("autopilot silent"));
            pulled.store(false, Ordering::Relaxed);
            wait_until("the autopilot being heard again", log, PATIENCE, || says("is back"));
        });
        over.store(true, Ordering::Relaxed);
        assert_eq!(run["outcome"], "done", "{said}");
        assert!(run["hal"]["link_losses"].as_u64() >= Some(1) && run["links_lost"].as_u64() >= Some(1), "{run}");
        assert!(run["views"].as_u64() >= Some(3) && run["gaussians"].as_u64() > Some(500), "{run}\n{said}");
    });
}

#[test]
fn missing_and_black_pictures_are_counted_and_left_out_of_a_model_that_is_made_all_the_same() {
    let dir = tempfile::tempdir().expect("tempdir");
    let at = dir.path();
    quick_mission(at, "faults = { picture_loss_pct = 20.0, picture_black_pct = 20.0 }");
    let _sim = sim(at, "pty:port");
    wait_until("the port", &at.join("sim.log"), PATIENCE, || at.join("port").exists());
    let (said, run) = fly(at, |_| {});
    assert_eq!(run["outcome"], "done", "{said}");
    let count = |name: &str| run["hal"][name].as_u64().unwrap_or(0);
    let announced = count("triggers");
    assert!(count("triggers_unmatched") > 0 && count("pictures_black") > 0, "{run}");
    assert!(announced > count("pictures"), "{run}");
    assert!(said.contains("no picture came") && said.contains(": black, left out"), "{said}");
    let views = run["views"].as_u64().expect("views");
    assert!(run["views_read_back"].as_u64() > Some(0), "{run}");
    assert!(views >= 3 && views <= announced - count("triggers_unmatched") - count("pictures_black"), "{run}");
}
