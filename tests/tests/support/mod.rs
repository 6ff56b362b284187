//! Starting, watching and ending `dgtr` processes.
#![allow(dead_code, reason = "each test binary uses its own part")]

pub mod hub;
pub mod plane;
pub mod radio;

use std::net::TcpListener;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Output, Stdio};
use std::time::{Duration, Instant};

/// A port of this machine that nobody listens on.
pub fn free_port() -> u16 {
    TcpListener::bind("127.0.0.1:0").and_then(|l| l.local_addr()).expect("a port").port()
}

/// `dgtr ARGUMENTS` in `folder`.
pub fn dgtr(folder: &Path, arguments: &[&str]) -> Command {
    let mut command = Command::new(env!("CARGO_BIN_EXE_dgtr-under-test"));
    command.args(arguments).current_dir(folder).stdin(Stdio::null()).env_remove("RUST_LOG");
    // Nothing is measured, and nothing is written to the user's cache folder.
    command.env(config::kernels::VARIABLE, "default");
    command
}

/// Runs to the end.
pub fn run(folder: &Path, arguments: &[&str]) -> Output {
    dgtr(folder, arguments).output().expect("starts")
}

/// What a refused command must look like: its exit code, and exactly one line that contains `words`.
pub fn refused(folder: &Path, arguments: &[&str], code: i32, words: &[&str]) {
    let output = run(folder, arguments);
    let text = String::from_utf8_lossy(&output.stderr);
    assert_eq!(output.status.code(), Some(code), "{arguments:?}: {text}");
    let lines: Vec<&str> = text.lines().filter(|l| l.starts_with("dgtr: ")).collect();
    assert_eq!(lines.len(), 1, "{arguments:?} must say one line: {text}");
    assert!(!text.contains("panicked"), "{text}");
    for word in words {
        assert!(lines[0].contains(word), "{arguments:?}: {word:?} is not in {}", lines[0]);
    }
}

/// A child that is ended when the test is over.
pub struct Running(pub Child);

impl Running {
    pub fn start(folder: &Path, arguments: &[&str], log: &Path) -> Self {
        let file = std::fs::File::create(log).expect("log");
        Self(dgtr(folder, arguments).stdout(Stdio::null()).stderr(file).spawn().expect("starts"))
    }

    /// Ctrl-C.
    pub fn interrupt(&self) {
        let pid = rustix::process::Pid::from_child(&self.0);
        rustix::process::kill_process(pid, rustix::process::Signal::INT).expect("signal");
    }

    pub fn code(&mut self, patience: Duration) -> Option<i32> {
        let until = Instant::now() + patience;
        while Instant::now() < until {
            if let Some(status) = self.0.try_wait().expect("wait") {
                return status.code();
            }
            std::thread::sleep(Duration::from_millis(50));
        }
        None
    }
}

impl Drop for Running {
    fn drop(&mut self) {
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

/// Waits for `what`, or fails with the log.
pub fn wait_until(what: &str, log: &Path, patience: Duration, mut holds: impl FnMut() -> bool) {
    let until = Instant::now() + patience;
    while !holds() {
        let said = || std::fs::read_to_string(log).unwrap_or_default();
        assert!(Instant::now() < until, "{what} did not happen within {patience:?}:\n{}", said());
        std::thread::sleep(Duration::from_millis(50));
    }
}

/// A mission of one small aircraft, flown by `dgtr sim`; all but two of its views wait in a file.
pub fn small_mission(folder: &Path) -> PathBuf {
    let path = folder.join("mission.toml");
    let text = r#"
name = "small"
seed = 3
origin = { lat_deg = 46.0, lon_deg = 7.0, alt_m = 500.0 }
camera = { width = 256, height = 192, fx = 200.0, fy = 200.0, cx = 128.0, cy = 96.0, exposure_delay_ms = 60.0 }
keyframes = { t_min_m = 6.0, max = 24 }
memory = { device_mib = 96, host_mib = 1024, max_gaussians = 15000, view_slots = 2 }
training = { seconds = 600.0 }
upload = { folder = "upload" }

[[aircraft]]
id = "one"
link = "serial:port:921600"
camera = { folder = "camera" }
region_enu = [[-20.0, -20.0], [20.0, -20.0], [20.0, 20.0], [-20.0, 20.0]]
"#;
    std::fs::write(&path, text).expect("mission");
    std::fs::create_dir_all(folder.join("camera")).expect("camera");
    path
}

/// The mission's text changed: every `from` becomes its `to`.
pub fn change_mission(folder: &Path, changes: &[(&str, &str)]) {
    let path = folder.join("mission.toml");
    let mut text = std::fs::read_to_string(&path).expect("mission");
    for (from, to) in changes {
        assert!(text.contains(from), "{from:?} is not in the mission");
        text = text.replace(from, to);
    }
    std::fs::write(&path, text).expect("mission");
}
