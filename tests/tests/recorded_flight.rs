//! A flight recorded from ArduPilot's simulator, played to `dgtr fly` over a pseudo-terminal: what the autopilot said is
//! real, the pictures are ray-cast from where it truly was (SIM_STATE). The short recording is in the repository; with
//! the shared data the whole survey is flown.
#![allow(clippy::expect_used, clippy::panic, reason = "a test fails by panicking")]

mod support;

use std::collections::HashMap;
use std::path::{Path, PathBuf};
use std::time::Duration;

use config::geodesy::{EnuFrame, Geodetic};
use glam::DQuat;
use models::dataset::Dataset;
use support::{Running, run, wait_until};

#[path = "../shared_data.rs"]
mod shared_data;

use shared_data::shared;

const PATIENCE: Duration = Duration::from_secs(180);

/// The whole survey of 40 exposures if it is there, else the piece in the repository.
fn recording() -> PathBuf {
    let piece = || Path::new(env!("CARGO_MANIFEST_DIR")).join("data/run8_trimmed.tlog");
    shared("data/sitl/run8/survey.tlog").unwrap_or_else(piece)
}

fn mission(folder: &Path) {
    let text = r#"
name = "recorded"
origin = { lat_deg = 46.84265, lon_deg = -91.9939, alt_m = 158.6 }
camera = { width = 640, height = 480, fx = 385.0, fy = 385.0, cx = 320.0, cy = 240.0 }
keyframes = { t_min_m = 14.0, max = 24 }
memory = { device_mib = 128, host_mib = 1024, max_gaussians = 20000, image_scale = 0.4 }
training = { seconds = 5.0 }
upload = { folder = "upload" }

[[aircraft]]
id = "one"
link = "serial:port:921600"
camera = { folder = "camera" }
region_enu = [[-200.0, -200.0], [200.0, -200.0], [200.0, 200.0], [-200.0, 200.0]]
"#;
    std::fs::write(folder.join("mission.toml"), text).expect("mission");
}

/// Mean and largest.
fn spread(values: &[f64]) -> (f64, f64) {
    (values.iter().sum::<f64>() / values.len() as f64, values.iter().copied().fold(0.0, f64::max))
}

#[test]
fn every_exposure_of_a_recorded_survey_becomes_a_picture_with_the_pose_it_was_taken_from() {
    let dir = tempfile::tempdir().expect("tempdir");
    let at = dir.path();
    let log = recording();
    let replay = [
        "replay",
        log.to_str().expect("path"),
        "--link",
        "pty:port",
        "--camera-dir",
        "camera",
        "--reference",
        "truth",
        "--speed",
        "0.25", // twice real time: the simulator that recorded it ran eight times as fast
        "--linger",
        "1",
    ];
    let _replay = Running::start(at, &replay, &at.join("replay.log"));
    wait_until("the port", &at.join("replay.log"), PATIENCE, || at.join("port").exists());
    mission(at);
    let said = run(at, &["fly", "--mission", "mission.toml", "--out", "out", "--silence", "8"]);
    assert!(said.status.success(), "{}", String::from_utf8_lossy(&said.stderr));

    let written = at.join("truth/transforms.json");
    wait_until("the truth", &at.join("replay.log"), PATIENCE, || written.is_file());
    let truth = Dataset::open(&at.join("truth")).expect("the truth");
    // The truth is given about the recording's own home, a few metres from the mission's origin.
    let home = EnuFrame::new(truth.origin.expect("the reference says where it lies"));
    let places: HashMap<String, usize> = truth.frames.iter().enumerate().map(|(i, f)| (stem(&f.name), i)).collect();
    let geotags = std::fs::read_to_string(at.join("out/geotags.csv")).expect("geotags.csv");
    let (mut metres, mut degrees) = (Vec::new(), Vec::new());
    for line in geotags.lines().skip(1) {
        let cells: Vec<&str> = line.split(',').collect();
        let n = |i: usize| cells[i].parse::<f64>().expect("a number");
        let pose = truth.frames[places[&stem(cells[0])]].view.pose;
        let at = home.to_enu(Geodetic { lat_deg: n(2), lon_deg: n(3), alt_m: n(4) });
        metres.push(pose.center.distance(at));
        let turned = pose.rotation.dot(DQuat::from_xyzw(n(9), n(10), n(11), n(8))).abs().min(1.0);
        degrees.push(2.0 * turned.acos().to_degrees());
    }
    let exposures = truth.select("train", None).expect("the flown pictures").len();
    let ((mean_m, max_m), (mean_deg, max_deg)) = (spread(&metres), spread(&degrees));
    println!(
        "{exposures} exposures, {} pictures with a pose; against SIM_STATE: position {mean_m:.3} m mean, {max_m:.3} m \
         at most; attitude {mean_deg:.2}° mean, {max_deg:.2}° at most",
        metres.len()
    );
    assert_eq!(metres.len(), exposures, "{geotags}");
    assert!(mean_m <= 0.15 && mean_deg <= 1.0, "{mean_m} m, {mean_deg}°");
    let (header, cloud) = models::formats::model::read(&at.join("out/model.dgtr")).expect("a model");
    assert!(header.finished && cloud.len() > 1000);
    // Trained at four tenths of the camera's size: after the landing every key frame gives nine crops that show all of it.
    let run: serde_json::Value =
        serde_json::from_slice(&std::fs::read(at.join("out/run.json")).expect("run.json")).expect("JSON");
    assert_eq!(run["crops"], 9 * header.views.len(), "{run}");
}

fn stem(name: &str) -> String {
    Path::new(name).file_stem().map_or_else(String::new, |s| s.to_string_lossy().into_owned())
}
