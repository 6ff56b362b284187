//! What keeps a flight from posing pictures is named while somebody can mend it: by the doctor, in the flight's log and on its page.

use std::io::{Read, Write};
use std::net::{TcpListener, TcpStream};
use std::path::Path;
use std::process::{Child, Stdio};
use std::time::{Duration, Instant};

use hal::mavlink::Encoder;
use hal::mavlink::dialect::{HEARTBEAT_DATA, MavAutopilot};

use super::{dgtr, has_device, program};

const PATIENCE: Duration = Duration::from_secs(90);

/// A router on a port of its own: everybody who connects hears the heartbeats of `system`, once a second, or nothing.
fn router(system: Option<u8>) -> u16 {
    let listener = TcpListener::bind("127.0.0.1:0").unwrap();
    let port = listener.local_addr().unwrap().port();
    std::thread::spawn(move || {
        for stream in listener.incoming().flatten() {
            std::thread::spawn(move || speak(stream, system));
        }
    });
    port
}

fn speak(mut stream: TcpStream, system: Option<u8>) {
    let heartbeat =
        HEARTBEAT_DATA { autopilot: MavAutopilot::MAV_AUTOPILOT_ARDUPILOTMEGA, ..HEARTBEAT_DATA::default() };
    let mut encoder = Encoder::new(system.unwrap_or_default(), 1);
    loop {
        let spoken = system.map_or(Ok(()), |_| stream.write_all(encoder.encode(&heartbeat, None)));
        if spoken.is_err() {
            return;
        }
        std::thread::sleep(Duration::from_secs(1));
    }
}

fn mission(dir: &Path, links: &[(&str, String)]) -> String {
    let aircraft: Vec<String> = links
        .iter()
        .map(|(id, link)| {
            let region = "region_enu = [[-20.0, -20.0], [20.0, -20.0], [20.0, 20.0], [-20.0, 20.0]]";
            let camera = "camera = { folder = \"pictures\" }";
            format!("[[aircraft]]\nid = \"{id}\"\nsystem_id = 3\nlink = \"{link}\"\n{camera}\n{region}\n")
        })
        .collect();
    let text = format!(
        "name = \"listening\"\norigin = {{ lat_deg = 46.0, lon_deg = 7.0, alt_m = 500.0 }}\n\
         camera = {{ width = 64, height = 48, fx = 50.0, fy = 50.0, cx = 32.0, cy = 24.0 }}\n\
         keyframes = {{ max = 4 }}\nmemory = {{ device_mib = 64, host_mib = 1024, max_gaussians = 1000 }}\n\
         upload = {{ folder = \"upload\" }}\n{}",
        aircraft.concat()
    );
    let path = dir.join("mission.toml");
    std::fs::write(&path, text).unwrap();
    path.to_string_lossy().into_owned()
}

#[test]
fn the_doctor_listens_on_every_link_of_a_mission_and_names_what_a_flight_would_lack() {
    let dir = tempfile::tempdir().unwrap();
    let port = dir.path().join("ttyACM0");
    let links = [
        ("other", format!("tcp:127.0.0.1:{}", router(Some(7)))),
        ("right", format!("tcp:127.0.0.1:{}", router(Some(3)))),
        ("silent", format!("tcp:127.0.0.1:{}", router(None))),
        ("unplugged", format!("serial:{}", port.display())),
    ];
    let path = mission(dir.path(), &links);
    let said = || String::from_utf8_lossy(&dgtr(&["doctor", "--mission", &path]).stdout).into_owned();
    let text = said();
    let line = |of: &str, what: &str| text.lines().find(|l| l.contains(what) && l.contains(of)).map(str::to_owned);
    for (of, begins, words) in [
        ("other:", "missing  autopilot", "only other systems are heard: 7, not system_id = 3"),
        ("right:", "ok       autopilot", "heard on tcp"),
        ("silent:", "note     autopilot", "no autopilot is heard on tcp"),
        ("unplugged:", "note     autopilot", "the link cannot be opened"),
        ("other:", "note     camera", "the camera's folder is missing here"),
    ] {
        let line = line(of, words).unwrap_or_else(|| panic!("{of} {words}: {text}"));
        assert!(line.starts_with(begins), "{line}");
    }
    // Of one aircraft the computer that flies is this one.
    mission(dir.path(), &links[1..2]);
    assert!(said().contains("missing  camera"));
    std::fs::create_dir(dir.path().join("pictures")).unwrap();
    assert!(said().contains("ok       camera"));
}

/// A flight, ended with the test.
struct Flight(Child);

impl Drop for Flight {
    fn drop(&mut self) {
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

/// Asks the live page for its state.
fn state(address: &str) -> String {
    let mut stream = TcpStream::connect(address).unwrap();
    write!(stream, "GET /state.json HTTP/1.1\r\nHost: {address}\r\n\r\n").unwrap();
    let mut text = String::new();
    stream.read_to_string(&mut text).unwrap();
    text
}

#[test]
fn a_flight_waits_for_its_cameras_folder_and_says_in_its_log_and_on_its_page_what_it_lacks() {
    if !has_device() || models::onnx::session::check_library().is_err() {
        return;
    }
    let dir = tempfile::tempdir().unwrap();
    let path = mission(dir.path(), &[("one", format!("tcp:127.0.0.1:{}", router(Some(7))))]);
    let log = dir.path().join("fly.log");
    let out = dir.path().join("out");
    let fly = ["fly", "--mission", &path, "--out", out.to_str().unwrap(), "--http", "127.0.0.1:0"];
    let errors = std::fs::File::create(&log).unwrap();
    let _flight = Flight(program().args(fly).stdout(Stdio::null()).stderr(errors).spawn().unwrap());
    let until = Instant::now() + PATIENCE;
    let wanted = [
        "the camera's folder is missing and is waited for",
        "only other systems are heard: 7, not system_id = 3",
        "the camera's folder is missing: no longer so",
    ];
    for words in wanted {
        let said = loop {
            let said = std::fs::read_to_string(&log).unwrap();
            if said.contains(words) {
                break said;
            }
            assert!(Instant::now() < until, "{words}: {said}");
            std::thread::sleep(Duration::from_millis(50));
        };
        let address = said.split_once("http://").and_then(|(_, rest)| rest.split_once('/')).expect("a page").0;
        if words == wanted[1] {
            let page = state(address);
            assert!(page.contains("only other systems are heard"), "{page}");
            std::fs::create_dir(dir.path().join("pictures")).unwrap();
        }
    }
}
