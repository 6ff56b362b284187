//! Every reader of `config` against broken text: the mission file, with what is planned from it, and files of settings.
#![allow(clippy::expect_used, clippy::panic, reason = "a test fails by panicking")]

use std::path::Path;

use config::init::InitSettings;
use config::mission::{KeyframeSettings, Mission, NetworkSettings};
use config::plan::{Plan, PlanRequest};
use config::refine::RefineSettings;
use config::settings::SettingError;
use config::training::TrainSettings;
use disk::plan::{DiskPlan, DiskRequest};
use serde::Deserialize;

#[path = "../../tests/readers/driver.rs"]
mod driver;

use driver::{Read, Reader, line, memory_folder, survive};

/// Every table, several aircraft, each kind of camera and region.
const FULL: &str = r#"
name = "park"
seed = 7
origin = { lat_deg = 28.0, lon_deg = -82.0, alt_m = 0.0 }
[camera]
width = 64
height = 48
fx = 50.0
fy = 50.0
cx = 32.0
cy = 24.0
[keyframes]
t_min_m = 6.0
max = 24
[memory]
device_mib = 96
host_mib = 1024
max_gaussians = 15000
disk_mib = 2000
[training]
seconds = 600.0
[upload]
connect = ["tcp/127.0.0.1:7447"]
listen = ["tcp/127.0.0.1:7447"]
max_kib_s = 400
[link]
patience_s = 2.0
[failsafe]
[faults]
picture_loss_pct = 20.0
[[aircraft]]
id = "west"
link = "udpin:127.0.0.1:14550"
camera = { folder = "w" }
region_enu = [[-40.0, -20.0], [0.0, -20.0], [0.0, 20.0], [-40.0, 20.0]]
[[aircraft]]
id = "east"
link = "serial:/dev/ttyAMA0:921600"
camera = { command = ["rpicam-vid", "-o", "-"] }
region_wgs84 = [[28.0, -82.0], [28.0, -81.999], [28.001, -81.999], [28.001, -82.0]]
"#;

/// What a mission is used for first: its regions, its keys, its plans. Each works, or refuses in one line.
fn usable(mission: &Mission) -> bool {
    let (camera, memory) = (&mission.camera, &mission.memory);
    let device = Plan::new(&PlanRequest {
        device_mib: memory.device_mib(),
        width: camera.width,
        height: camera.height,
        views: mission.keyframes.max,
        max_gaussians: memory.max_gaussians.map(|n| n as usize),
        scene_gaussians: memory.scene_gaussians.map(|n| n as usize),
        ..PlanRequest::default()
    });
    let disk = DiskPlan::new(&DiskRequest {
        width: camera.width,
        height: camera.height,
        key_frames: mission.keyframes.max,
        scratch: 0,
        gaussians: memory.max_gaussians.map_or(1 << 20, |n| n as usize),
        sh_degree: 3,
        delivered: 0,
        map: mission.map.disk_bytes(),
        recording: 0,
    });
    let refusals = [
        mission.check_trust().err().map(|e| e.to_string()),
        device.err().map(|e| e.to_string()),
        disk.fits(u64::from(memory.disk_mib.unwrap_or(0)) << 20).err().map(|e| e.to_string()),
    ];
    let corners = mission.aircraft.iter().flat_map(|a| mission.region(a)).flatten();
    refusals.iter().flatten().all(|line| !line.contains('\n')) && corners.into_iter().all(f64::is_finite)
}

#[test]
fn mission_files() {
    let flown = Path::new(env!("CARGO_MANIFEST_DIR")).join("../tests/missions/sheffield_cross.toml");
    survive(&Reader {
        name: "mission",
        seeds: vec![std::fs::read(flown).expect("the mission in the repository"), FULL.into()],
        text: true,
        shell: None,
        memory: (128 << 10, 256),
        read: Read::File("m.toml", &|path| line(Mission::read(path), |mission| usable(&mission))),
    });
}

/// The tables of a file for `dgtr train --settings`.
#[derive(Default, Deserialize)]
#[serde(default, deny_unknown_fields)]
struct Tables {
    training: TrainSettings,
    init: InitSettings,
    refine: RefineSettings,
    network: NetworkSettings,
    keyframes: KeyframeSettings,
}

impl Tables {
    fn check(&self) -> Result<(), SettingError> {
        self.training.check()?;
        self.init.check()?;
        self.refine.check()?;
        self.network.check()?;
        self.keyframes.check()
    }
}

#[test]
fn files_of_settings() {
    let some = "[training]\nseconds = 60.0\n[training.rates]\n[training.density]\n[init]\n[refine]\n[keyframes]\nt_min_m = 3\nmax = 64\n";
    let network = "[network]\npair = \"n.toml\"\n[training]\nseed = 3\n";
    survive(&Reader {
        name: "settings",
        seeds: [some, network].map(|s| s.as_bytes().to_vec()).into(),
        text: true,
        shell: None,
        memory: (128 << 10, 256),
        read: Read::Bytes(&|bytes| {
            let text = std::str::from_utf8(bytes).map_err(|e| e.to_string())?;
            let tables: Tables = config::settings::parse(text).map_err(|e| e.to_string())?;
            line(tables.check(), |()| true)
        }),
    });
}

/// A file of lines that a power cut tore is opened again: what is kept ends with a line.
#[test]
fn files_of_lines() {
    let folder = memory_folder();
    let disk = disk::Disk::default();
    let path = folder.path().join("lines.csv");
    survive(&Reader {
        name: "lines",
        seeds: ["picture,lat_deg\na.png,46.8\nb.png,46.9\n", "x\n"].map(|s| s.as_bytes().to_vec()).into(),
        text: true,
        shell: None,
        memory: (192 << 10, 8),
        read: Read::Bytes(&|bytes| {
            std::fs::write(&path, bytes).expect("written");
            drop(disk.append_lines(&path).map_err(|e| e.to_string())?);
            let kept = std::fs::read(&path).expect("there");
            let whole = bytes.starts_with(&kept) && !kept.contains(&0) && kept.last().is_none_or(|b| *b == b'\n');
            // Nothing left of a file that had lines counts as refused.
            if kept.is_empty() { Err("no whole line".into()) } else { Ok(whole) }
        }),
    });
}
