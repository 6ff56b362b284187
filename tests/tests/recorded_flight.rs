//! A flight recorded from ArduPilot's simulator, played to `dgtr fly` over a pseudo-terminal: what the autopilot said is
//! real, the pictures are ray-cast from where it truly was (SIM_STATE). The short recording is in the repository; with
//! the shared data the whole survey is flown.
#![allow(clippy::expect_used, clippy::panic, reason = "a test fails by panicking")]

mod support;

use std::collections::HashMap;
use std::path::{Path, PathBuf};
use std::time::Duration;

use geometry::geodesy::{EnuFrame, Geodetic};
use glam::{DQuat, DVec3};
use hal::mavlink::MessageData;
use hal::mavlink::dialect::SIM_STATE_DATA;
use models::metrics::psnr;
use sim::axes::camera_to_enu;
use sim::reference::Lens;
use sim::replay::Recording;
use sim::world::{World, WorldSettings};
use support::hub::Hub;
use support::{Running, run, wait_until};
use survey::dataset::Dataset;

use needs::shared;

const PATIENCE: Duration = Duration::from_secs(180);

/// The whole survey of 40 exposures if it is there, else the piece in the repository.
fn recording() -> PathBuf {
    shared("data/sitl/run8/survey.tlog").unwrap_or_else(piece)
}

/// Exposures without the ways there and back.
fn piece() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("data/run8_trimmed.tlog")
}

fn mission(folder: &Path) {
    let text = r#"
name = "recorded"
origin = { lat_deg = 46.84265, lon_deg = -91.9939, alt_m = 158.6 }
camera = { width = 640, height = 480, fx = 385.0, fy = 385.0, cx = 320.0, cy = 240.0 }
keyframes = { t_min_m = 14.0, max = 24 }
memory = { device_mib = 128, host_mib = 1024, max_gaussians = 20000, image_scale = 0.4 }
training = { seconds = 5.0 }
link = { battery_swap_s = 0.0 }
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
    // The simulator that recorded it ran eight times as fast: 0.25 is twice real time, DGTR_SPEED=0.125 real time.
    let speed = std::env::var("DGTR_SPEED").unwrap_or_else(|_| "0.25".into());
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
        &speed,
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

/// The simulated camera's own parts of a mission: small pictures, the least training.
const BESIDE: &str = r#"
name = "beside"
seed = 4
origin = { lat_deg = 46.84265, lon_deg = -91.9939, alt_m = 158.6 }
camera = { width = 160, height = 120, fx = 96.0, fy = 96.0, cx = 80.0, cy = 60.0 }
keyframes = { t_min_m = 14.0, max = 24 }
memory = { device_mib = 96, host_mib = 1024, max_gaussians = 5000 }
training = { seconds = 1.0 }
upload = { folder = "upload" }

[[aircraft]]
id = "one"
link = "serial:fly-port:921600"
camera = { folder = "camera" }
region_enu = [[-200.0, -200.0], [200.0, -200.0], [200.0, 200.0], [-200.0, 200.0]]
"#;

/// The autopilot is SITL's, recorded; it has a line to the camera and one to the onboard job, as SITL has several ports.
#[test]
fn a_camera_beside_a_running_autopilot_photographs_what_it_triggers_and_fly_flies_with_it() {
    let dir = tempfile::tempdir().expect("tempdir");
    let at = dir.path();
    std::fs::write(at.join("mission.toml"), BESIDE).expect("mission");
    let hub = Hub::start(at, "vehicle", &["camera-port", "fly-port"]);
    let beside = ["sim", "--mission", "mission.toml", "--autopilot", "serial:camera-port:921600"];
    let mut camera = Running::start(at, &beside, &at.join("camera.log"));
    let fly = ["fly", "--mission", "mission.toml", "--out", "out", "--silence", "3"];
    let mut job = Running::start(at, &fly, &at.join("fly.log"));
    wait_until("both being there", &at.join("fly.log"), PATIENCE, || hub.heartbeats().iter().all(|n| *n > 0));
    let log = piece();
    let replay = ["replay", log.to_str().expect("path"), "--link", "pty:vehicle", "--linger", "0"];
    let _replay = Running::start(at, &replay, &at.join("replay.log"));
    let said = |log: &str| std::fs::read_to_string(at.join(log)).unwrap_or_default();
    assert_eq!(job.code(PATIENCE), Some(0), "{}{}", said("fly.log"), said("camera.log"));
    camera.interrupt();
    assert_eq!(camera.code(PATIENCE), Some(0), "{}", said("camera.log"));
    assert!(hub.asked_for(SIM_STATE_DATA::ID), "the camera asks the simulator for its truth");

    let recording = Recording::read(&log).expect("reads");
    let truth = recording.truth.as_ref().expect("truth");
    let origin = Geodetic { lat_deg: 46.84265, lon_deg: -91.9939, alt_m: 158.6 };
    let (home, frame) = (EnuFrame::new(recording.home), EnuFrame::new(origin));
    let world = World::new(4, &WorldSettings::default());
    let lens = Lens { width: 160, height: 120, fx: 96.0, fy: 96.0, cx: 80.0, cy: 60.0 };
    let render = |boot_s: f64, east_m: f64| {
        let s = truth.at(boot_s);
        let place = frame.to_enu(home.to_geodetic(s.position)) + DVec3::X * east_m;
        world.render(&lens.at(place, camera_to_enu(s.gimbal))).0
    };
    let shares = |pixels: &[u8]| pixels.iter().map(|v| f32::from(*v) / 255.0).collect::<Vec<_>>();
    let mut taken = 0;
    for (boot_s, index) in &recording.exposures {
        let path = at.join(format!("camera/one_{index:04}.jpg"));
        if !path.is_file() {
            continue;
        }
        taken += 1;
        if taken % 8 == 1 {
            let picture = shares(models::picture::decode(&path).expect("a picture").as_raw());
            let [there, aside] = [0.0, 3.0].map(|east_m| psnr(&shares(render(*boot_s, east_m).as_raw()), &picture));
            println!("picture {index}: {there:.1} dB, {aside:.1} dB 3 m beside the truth");
            assert!(
                there > aside + 3.0,
                "picture {index}: {there:.1} dB against the truth, {aside:.1} dB 3 m beside it"
            );
        }
    }
    let geotags = std::fs::read_to_string(at.join("out/geotags.csv")).expect("geotags.csv");
    let posed = geotags.lines().count() - 1;
    println!("{} exposures, {taken} pictures, {posed} with a pose", recording.exposures.len());
    // The clocks are learnt within the first second of the recording, which is eight of the autopilot's.
    assert!(taken >= 36 && posed >= 36, "{geotags}{}{}", said("camera.log"), said("fly.log"));
    let (header, _) = models::formats::model::read(&at.join("out/model.dgtr")).expect("a model");
    assert!(header.finished && header.views.len() >= 8, "{} key frames", header.views.len());
}
