//! What a service manager hears of a real `dgtr serve` and `dgtr fly`, and what it is told to bound.

use std::os::unix::net::UnixDatagram;
use std::path::Path;
use std::process::Stdio;
use std::time::{Duration, Instant};

use super::{dgtr, has_device, program};

/// An onboard job and a ground that have nothing to do.
pub(super) fn mission(dir: &Path) -> String {
    let path = dir.join("mission.toml");
    let text = r#"
name = "supervised"
origin = { lat_deg = 46.0, lon_deg = 7.0, alt_m = 500.0 }
camera = { width = 64, height = 48, fx = 50.0, fy = 50.0, cx = 32.0, cy = 24.0 }
keyframes = { max = 4 }
memory = { device_mib = 64, host_mib = 1024, max_gaussians = 1000 }
upload = { folder = "upload", poll_s = 0.1 }

[[aircraft]]
id = "one"
link = "udpin:127.0.0.1:0"
camera = { folder = "pictures" }
region_enu = [[-20.0, -20.0], [20.0, -20.0], [20.0, 20.0], [-20.0, 20.0]]
"#;
    std::fs::write(&path, text).unwrap();
    std::fs::create_dir_all(dir.join("pictures")).unwrap();
    path.to_string_lossy().into_owned()
}

/// Everything a manager that waits `watchdog_us` hears of a job until it ends; its exit code.
fn heard(dir: &Path, arguments: &[&str], watchdog_us: &str) -> (Vec<String>, Option<i32>) {
    let address = dir.join("notify");
    let socket = UnixDatagram::bind(&address).unwrap();
    socket.set_read_timeout(Some(Duration::from_millis(20))).unwrap();
    let mut command = program();
    command.args(arguments).env("NOTIFY_SOCKET", &address).env("WATCHDOG_USEC", watchdog_us);
    let mut child = command.stdout(Stdio::null()).stderr(Stdio::null()).spawn().unwrap();
    let (began, mut words, mut ended) = (Instant::now(), Vec::new(), false);
    let mut bytes = [0; 1024];
    loop {
        match socket.recv(&mut bytes) {
            Ok(n) => words.push(String::from_utf8_lossy(&bytes[..n]).into_owned()),
            // Nothing is left to hear.
            Err(_) if ended => break,
            Err(_) => ended = child.try_wait().unwrap().is_some(),
        }
        assert!(began.elapsed() < Duration::from_secs(60), "{words:?}");
    }
    (words, child.wait().unwrap().code())
}

/// Position of a word, which was said once.
fn once(words: &[String], word: &str) -> usize {
    let at: Vec<usize> = (0..words.len()).filter(|&i| words[i] == word).collect();
    assert_eq!(at.len(), 1, "{word}: {words:?}");
    at[0]
}

/// Ready first and a goodbye last, signs of life and how it stands in between.
fn is_whole(words: &[String], status: &str) {
    let (ready, goodbye) = (once(words, "READY=1"), once(words, "STOPPING=1"));
    assert_eq!(goodbye, words.len() - 1, "{words:?}");
    let signs = words[ready..goodbye].iter().filter(|w| *w == "WATCHDOG=1").count();
    assert!(signs >= 3 && !words[..ready].contains(&"WATCHDOG=1".to_owned()), "{words:?}");
    assert!(words.iter().any(|w| w.starts_with("STATUS=") && w.contains(status)), "{words:?}");
}

#[test]
fn a_ground_says_when_it_listens_that_it_is_at_work_and_that_it_ends() {
    let dir = tempfile::tempdir().unwrap();
    let (mission, out) = (mission(dir.path()), dir.path().join("out"));
    let serve = ["serve", "--mission", &mission, "--out", out.to_str().unwrap(), "--timeout", "1.5"];
    let (words, code) = heard(dir.path(), &serve, "400000");
    is_whole(&words, "0 of 1 final models");
    assert_eq!(code, Some(4), "no model has arrived");
}

#[test]
fn an_onboard_job_says_when_capture_listens_and_its_loop_gives_the_signs_of_life() {
    if !has_device() || models::onnx::session::check_library().is_err() {
        return;
    }
    let dir = tempfile::tempdir().unwrap();
    let (mission, out) = (mission(dir.path()), dir.path().join("out"));
    let fly = ["fly", "--mission", &mission, "--out", out.to_str().unwrap(), "--patience", "1"];
    let (words, _) = heard(dir.path(), &fly, "400000");
    is_whole(&words, "listening on udpin:127.0.0.1:0");
    assert!(words[0].starts_with("STATUS=opening"), "{words:?}");
}

#[test]
fn a_drop_in_bounds_a_flight_by_its_missions_memory() {
    let dir = tempfile::tempdir().unwrap();
    let mission = mission(dir.path());
    let output = dgtr(&["plan", "--mission", &mission, "--systemd"]);
    let text = String::from_utf8_lossy(&output.stdout).into_owned();
    assert!(text.starts_with("[Service]\n") && text.contains("CPUQuota="), "{text}");
    // The host's alone, or with the device's where that lies in the same memory.
    assert!(text.contains("MemoryMax=1024M") || text.contains("MemoryMax=1088M"), "{text}");
    assert_eq!(dgtr(&["plan", "--systemd"]).status.code(), Some(2), "bounds are a mission's");
}
