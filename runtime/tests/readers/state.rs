//! What a job keeps for its next start: session, report, key frames, numbers, keys, measured kernels; and a flight's log.

use std::os::unix::fs::PermissionsExt;
use std::path::Path;

use config::mission::CameraSettings;
use disk::Disk;
use flight::keyframe_store::{KeyFrame, KeyframeStore};
use geometry::geodesy::Geodetic;
use ground::register::edge::{Edges, Fitted};
use hal::camera::Picture;
use job::run_json::RunReport;
use job::session::{Owner, Session};
use models::camera::{Intrinsics, Pose, PoseSigma, PosedImage, View};
use runtime::train_job::log;
use tuning::cache;
use uplink::flight_number::FlightNumber;
use uplink::keys;
use uplink::memory::Memory;
use vulkan::gpu::{DeviceLimits, GpuInfo};

use crate::driver::{Read, Reader, Shell, Verdict, line, memory_folder, survive};

const ORIGIN: Geodetic = Geodetic { lat_deg: 47.4, lon_deg: 8.5, alt_m: 430.0 };
const LENS: Intrinsics = Intrinsics { width: 8, height: 6, fx: 8.0, fy: 8.0, cx: 4.0, cy: 3.0 };
const CAMERA: CameraSettings = CameraSettings::pinhole(8, 6, 8.0);

/// The refusal of a file that was set aside, with the name it got; the next input finds the place empty.
fn set_aside(folder: &Path, name: &str) -> Verdict {
    let aside = folder.join(name);
    match std::fs::remove_file(&aside) {
        Ok(()) => Err(format!("set aside as {}", aside.display())),
        Err(_) => Ok(true),
    }
}

#[test]
fn sessions() {
    let owner = Owner {
        command: "fly".into(),
        mission: "park".into(),
        aircraft: "west".into(),
        origin: [47.4, 8.5, 430.0],
        picture: [640, 480],
    };
    let other = Owner { mission: "forest".into(), ..owner.clone() };
    let json = |owner: &Owner| serde_json::to_vec_pretty(owner).expect("JSON");
    let disk = Disk::default();
    survive(&Reader {
        name: "session",
        seeds: vec![json(&owner), json(&other)],
        text: true,
        shell: None,
        memory: (192 << 10, 64),
        read: Read::File("session.json", &|path| {
            let folder = path.parent().expect("a folder");
            let session = Session::begin(&disk, folder, &owner).map_err(|e| e.to_string())?;
            if let Some(earlier) = &session.put_aside {
                std::fs::remove_dir_all(earlier).map_err(|e| e.to_string())?;
                return Ok(true);
            }
            set_aside(folder, "session.damaged-1.json")
        }),
    });
}

#[test]
fn reports() {
    let mut report = RunReport::new("serve");
    report.skip("frustum", 3);
    report.more.insert("received".into(), serde_json::json!({ "chunks": 3, "list": [1, 2.5, null] }));
    let full = serde_json::to_vec_pretty(&report).expect("JSON");
    report.psnr = Some(25.5);
    survive(&Reader {
        name: "run-json",
        seeds: vec![full, serde_json::to_vec_pretty(&report).expect("JSON")],
        text: true,
        shell: None,
        memory: (64 << 10, 256),
        read: Read::File("run.json", &|path| {
            line(RunReport::read(path.parent().expect("a folder")), |r| r.psnr.is_none_or(f64::is_finite))
        }),
    });
}

fn key_frame(i: u32) -> KeyFrame {
    let pose = Pose { rotation: glam::DQuat::IDENTITY, center: glam::DVec3::new(f64::from(i), 0.0, 40.0) };
    let posed = PosedImage {
        name: format!("{i:03}.png"),
        time_ns: u64::from(i),
        image: image::RgbImage::from_pixel(LENS.width, LENS.height, image::Rgb([i as u8; 3])),
        view: View { intrinsics: LENS, pose },
        mask: None,
        sigma: PoseSigma { position_m: [1.0, 1.0, f32::INFINITY], rotation_rad: [0.1; 3] },
    };
    KeyFrame { file: Picture::Rgb(posed.image.clone()), posed }
}

#[test]
fn lists_of_key_frames() {
    let list = |frames: u32| {
        let folder = tempfile::tempdir().expect("a folder");
        let mut store = KeyframeStore::open(&Disk::default(), folder.path(), &CAMERA, &LENS, ORIGIN).expect("opened");
        (0..frames).for_each(|i| store.add(&key_frame(i)).expect("stored"));
        std::fs::read(folder.path().join("transforms.json")).expect("a list")
    };
    let disk = Disk::default();
    survive(&Reader {
        name: "key-frames",
        seeds: vec![list(2), list(1)],
        text: true,
        shell: None,
        memory: (64 << 10, 256),
        read: Read::File("transforms.json", &|path| {
            let folder = path.parent().expect("a folder");
            let store = KeyframeStore::open(&disk, folder, &CAMERA, &LENS, ORIGIN).map_err(|e| e.to_string())?;
            set_aside(folder, "transforms.damaged-1.json")?;
            // A picture lies in its folder, and its pose can be trained from.
            let usable = |pose: &Pose| View { intrinsics: LENS, pose: *pose }.is_usable();
            Ok(store.names().all(|n| !n.contains(['/', '\0'])) && store.poses().iter().all(usable))
        }),
    });
}

#[test]
fn flight_numbers() {
    survive(&Reader {
        name: "flight-number",
        seeds: ["41\n", "7"].map(|s| s.as_bytes().to_vec()).into(),
        text: true,
        shell: None,
        memory: (96 << 10, 8),
        // 1 is where a damaged one starts anew.
        read: Read::File("a1.flight", &|path| match FlightNumber::begin(Some(path)).get() {
            0 => Ok(false),
            1 => Err("a1.flight: begun anew".into()),
            _ => Ok(true),
        }),
    });
}

#[test]
fn private_keys() {
    let folder = tempfile::tempdir().expect("a folder");
    let seeds = ["a", "b"].map(|id| {
        keys::make(folder.path(), id).expect("a key");
        std::fs::read(keys::private_path(folder.path(), id)).expect("there")
    });
    survive(&Reader {
        name: "private-key",
        seeds: seeds.into(),
        text: true,
        shell: None,
        memory: (4 << 10, 16),
        read: Read::File("west.key", &|path| {
            // Of what is no file here the reader has to say so.
            let _ = std::fs::set_permissions(path, std::fs::Permissions::from_mode(0o600));
            line(keys::make(path.parent().expect("a folder"), "west"), |(_, new)| !new)
        }),
    });
}

#[test]
fn measured_kernels() {
    let info = GpuInfo {
        name: "V3D \"7.1\"".into(),
        version: (1, 3),
        is_cpu: false,
        is_integrated: true,
        subgroup_size: 16,
        shuffles: true,
        heap_bytes: 1 << 30,
        ids: (0x14e4, 42),
        driver_version: 7,
        limits: DeviceLimits { workgroup_lanes: 256, texel_elements: 1 << 27, storage_buffers: 8 },
    };
    let kept = |names: &[&str]| {
        let folder = tempfile::tempdir().expect("a folder");
        let path = folder.path().join("kernels.toml");
        for name in names {
            let info = GpuInfo { name: (*name).into(), ..info.clone() };
            cache::write(&path, &info, vulkan::kernel_config::KernelConfig::standard(&info)).expect("written");
        }
        std::fs::read(path).expect("there")
    };
    survive(&Reader {
        name: "kernels",
        seeds: vec![kept(&["llvmpipe", &info.name]), kept(&[&info.name])],
        text: true,
        shell: None,
        memory: (64 << 10, 256),
        read: Read::File("kernels.toml", &|path| {
            line(cache::read(path, &info), |config| config.is_none_or(|config| config.fits(&info)))
        }),
    });
}

#[test]
fn exposures_of_a_flight_log() {
    let recorded = Path::new(env!("CARGO_MANIFEST_DIR")).join("../tests/data/run8_trimmed.tlog");
    let flight = std::fs::read(recorded).expect("the recording in the repository");
    // Pieces around an exposure: CAMERA_FEEDBACK is message 180.
    let id = [0xB4, 0, 0];
    let frames = flight.windows(10).enumerate().filter(|(_, w)| w[0] == 0xFD && w[7..] == id).map(|(at, _)| at);
    let seeds: Vec<Vec<u8>> =
        frames.map(|at| flight[at.saturating_sub(60)..flight.len().min(at + 100)].into()).collect();
    assert!(seeds.len() > 1, "{} exposures in the recording", seeds.len());
    let folder = memory_folder();
    let path = folder.path().join("a.tlog");
    survive(&Reader {
        name: "exposures",
        seeds,
        text: false,
        shell: None,
        memory: (96 << 10, 16),
        read: Read::Bytes(&|bytes| {
            std::fs::write(&path, bytes).expect("written");
            line(log::read(&path, None, None), |found| {
                let mut exposures = found.series.iter().flat_map(|s| &s.exposures);
                exposures.all(|e| e.fix.position.is_valid() && e.time_s.is_finite())
            })
        }),
    });
}

/// The name of a pair, and of its file.
const PAIR: [u8; 32] = [7; 32];
const PAIR_FILE: &str = "0707070707070707070707070707070707070707070707070707070707070707.edge";

#[test]
fn fits_of_pairs_of_models() {
    let fitted = Fitted {
        turn: [0.0, 0.0, 0.6, 0.8],
        scale: 1.01,
        shift: [1.0, -2.0, 0.5],
        places: [[10.0, 20.0, 30.0]; 6],
        points: [40, 50],
        rms_m: [3.0, 0.1],
    };
    let disk = Disk::default();
    let kept = |found: Option<Fitted>| {
        let folder = tempfile::tempdir().expect("a folder");
        Edges::open(&disk, folder.path()).put(&PAIR, found).expect("kept");
        std::fs::read(folder.path().join(PAIR_FILE)).expect("there")
    };
    survive(&Reader {
        name: "fits of pairs",
        seeds: vec![kept(Some(fitted)), kept(None)],
        text: false,
        shell: Some(Shell {
            open: |bytes| bytes[..bytes.len().saturating_sub(32)].to_vec(),
            close: |mut content| {
                content.extend_from_slice(blake3::hash(&content).as_bytes());
                content
            },
        }),
        memory: (64 << 10, 16),
        read: Read::File(PAIR_FILE, &|path| {
            let mut edges = Edges::open(&disk, path.parent().expect("a folder"));
            match edges.get(&PAIR) {
                Some(found) => Ok(found.is_none_or(|f| f.scale > 0.0 && f.shift.iter().all(|v| v.is_finite()))),
                None => Err(edges.damaged.pop().unwrap_or_else(|| format!("{PAIR_FILE}: is not there"))),
            }
        }),
    });
}

/// What earlier sessions received.
#[test]
fn orders_that_a_ground_remembers() {
    let last = |flight: u32| {
        format!("{{\n\"key\": \"ab12\",\n\"flight\": {flight},\n\"counter\": 5,\n\"session\": \"9c\"\n}}")
    };
    let seeds =
        [format!("{{\n\"west\": {},\n\"east\": {}\n}}\n", last(1), last(40)), format!("{{\n\"a1\": {}\n}}\n", last(2))];
    survive(&Reader {
        name: "orders",
        seeds: seeds.map(String::into_bytes).into(),
        text: true,
        shell: None,
        memory: (192 << 10, 64),
        read: Read::File("park.received.json", &|path| {
            let folder = path.parent().expect("a folder");
            let received = folder.join("received");
            let memory = Memory::open(folder, "park", &received, None, false).map_err(|e| e.to_string())?;
            // Where the file was refused it lies beside.
            let aside = ["park.received.damaged-1.json", "park.received.previous.json"].map(|name| folder.join(name));
            let refused = aside[0].exists();
            aside.iter().for_each(|path| drop(std::fs::remove_file(path)));
            match refused {
                true => Err(format!("{} is set aside", path.display())),
                false => Ok(memory.session() != &[0; 32]),
            }
        }),
    });
}
