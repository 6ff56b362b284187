//! What describes pictures beside them, and networks: nerfstudio, OpenSfM, splits, telemetry, flight plans, manifests.

use std::io::{Cursor, Read as _, Write as _};
use std::path::Path;

use geometry::geodesy::Geodetic;
use models::formats::flight_plan::{self, FlightPlan, Waypoint};
use models::formats::reconstruction::Reconstruction;
use models::formats::{opensfm, split, telemetry, torch, transforms};
use models::onnx::manifest::Manifest;
use zip::write::SimpleFileOptions;
use zip::{CompressionMethod, ZipArchive, ZipWriter};

use crate::driver::{Read, Reader, Shell, line, survive};

fn finite(r: &Reconstruction) -> bool {
    r.shots.iter().all(|f| f.pose.center.is_finite() && f.pose.rotation.is_finite())
        && r.origin.is_none_or(|o| o.is_valid())
}

#[test]
fn nerfstudio_transforms() {
    let frame = "{\n\"file_path\": \"a.jpg\",\n\"transform_matrix\": [\n[1, 0, 0, 1.5],\n[0, 1, 0, 2],\n[0, 0, 1, 3],\n[0, 0, 0, 1]\n]\n}";
    let lens = "\"w\": 64,\n\"h\": 48,\n\"fl_x\": 40.0,\n\"fl_y\": 41,\n\"cx\": 32,\n\"cy\": 24.5,\n\"k1\": 0.01,";
    let shared = format!("{{\n{lens}\n\"frames\": [\n{frame},\n{frame}\n]\n}}\n");
    let own = format!(
        "{{\n\"camera_angle_x\": 0.9,\n\"enu_origin_wgs84\": {{\n\"lat\": 48.1,\n\"lon\": 11.5,\n\"alt\": 500\n}},\n\"frames\": [\n{frame}\n]\n}}\n"
    );
    survive(&Reader {
        name: "transforms",
        seeds: vec![shared.into_bytes(), own.into_bytes()],
        text: true,
        shell: None,
        memory: (64 << 10, 256),
        read: Read::File("transforms.json", &|path| line(transforms::read(path), |file| finite(&file))),
    });
}

const PICKLE: &str = "000001/data.pkl";

/// A picture of Mill-19's form, as PyTorch saved it.
fn saved_by_torch() -> Vec<u8> {
    let file = "tests/data/mega_nerf/train/metadata/000001.pt";
    std::fs::read(Path::new(env!("CARGO_MANIFEST_DIR")).join(file)).expect("a fixture")
}

fn entry(file: &[u8], name: &str) -> Vec<u8> {
    let (mut zip, mut bytes) = (ZipArchive::new(Cursor::new(file)).expect("a zip"), Vec::new());
    zip.by_name(name).expect("an entry").read_to_end(&mut bytes).expect("read");
    bytes
}

/// A file with another pickle.
fn with_pickle(pickle: &[u8]) -> Vec<u8> {
    let file = saved_by_torch();
    let (names, mut zip) =
        (ZipArchive::new(Cursor::new(&file)).expect("a zip"), ZipWriter::new(Cursor::new(Vec::new())));
    for name in names.file_names() {
        let bytes = if name == PICKLE { pickle.to_vec() } else { entry(&file, name) };
        zip.start_file(name, SimpleFileOptions::default().compression_method(CompressionMethod::Stored))
            .expect("begun");
        zip.write_all(&bytes).expect("written");
    }
    zip.finish().expect("ended").into_inner()
}

#[test]
fn dictionaries_of_torch() {
    let pickle = Shell { open: |file| entry(file, PICKLE), close: |pickle| with_pickle(&pickle) };
    survive(&Reader {
        name: "torch",
        seeds: vec![saved_by_torch()],
        text: false,
        shell: Some(pickle),
        // The crate zip makes room for as many entries as a directory may claim, at most one for each byte before it.
        memory: (256 << 10, 2048),
        read: Read::File("000001.pt", &|path| {
            line(torch::read(path), |numbers| numbers.values().all(|values| values.len() <= 64))
        }),
    });
}

#[test]
fn network_manifests() {
    let networks = Path::new(env!("CARGO_MANIFEST_DIR")).join("networks");
    let seeds = ["random_pair", "plane_sweep", "random_depth", "mean_square"];
    survive(&Reader {
        name: "manifest",
        seeds: seeds.map(|name| std::fs::read(networks.join(name).with_extension("toml")).expect("a manifest")).into(),
        text: true,
        shell: None,
        memory: (64 << 10, 256),
        read: Read::File("n.toml", &|path| {
            line(Manifest::read(path), |m| {
                let (w, h) = m.input_size(4000, 3000);
                w > 0 && h > 0 && m.input.std.iter().all(|s| s.is_finite() && *s != 0.0)
            })
        }),
    });
}

/// One part of two shots and two points, and one of none.
const OPENSFM: &str = r#"[{
"cameras": {"v2 a": {"projection_type": "brown", "width": 64, "height": 48, "focal_x": 0.8, "focal_y": 0.8,
"c_x": 0.01, "c_y": 0, "k1": 0.01, "k2": -0.01, "k3": 0, "p1": 0.001, "p2": 0}},
"shots": {
"a.jpg": {"rotation": [3.1, 0.1, 0], "translation": [1, 2.5, 60], "camera": "v2 a"},
"b.jpg": {"rotation": [0, 0, 0], "translation": [1, 2.5, 61], "camera": "v2 a"}
},
"points": {
"1": {"coordinates": [1, 2, 3], "color": [255, 0, 3]},
"2": {"coordinates": [1.5, 2, -3]}
},
"reference_lla": {"latitude": 48.1, "longitude": 11.5, "altitude": 500}
},
{"cameras": {}, "shots": {}}
]
"#;

#[test]
fn opensfm_reconstructions() {
    let fisheye = OPENSFM.replace("brown", "fisheye").replace("\"focal_x\": 0.8, \"focal_y\"", "\"focal\"");
    survive(&Reader {
        name: "opensfm",
        seeds: vec![OPENSFM.into(), fisheye.into()],
        text: true,
        shell: None,
        memory: (160 << 10, 256),
        read: Read::File("reconstruction.json", &|path| {
            let mut whole = true;
            let points = opensfm::points(path, &mut |at, _| whole &= at.iter().all(|v| v.is_finite()));
            let read = line(opensfm::read(path), |r| finite(&r) && whole);
            read.and_then(|usable| line(points, |()| usable))
        }),
    });
}

#[test]
fn opensfm_references() {
    let beside = OPENSFM.replace("reference_lla", "reference");
    survive(&Reader {
        name: "opensfm-reference",
        seeds: [
            r#"{"latitude": 48.1, "longitude": 11.5, "altitude": 500}"#,
            "{\n\"altitude\": -3.5,\n\"latitude\": -33,\n\"longitude\": 151\n}",
        ]
        .map(|s| s.as_bytes().to_vec())
        .into(),
        text: true,
        shell: None,
        memory: (160 << 10, 256),
        read: Read::File("reference_lla.json", &|path| {
            let reconstruction = path.with_file_name("reconstruction.json");
            if !reconstruction.exists() {
                std::fs::write(&reconstruction, &beside).expect("written");
            }
            line(opensfm::read(&reconstruction), |r| (r.origin.is_some() || !path.is_file()) && finite(&r))
        }),
    });
}

#[test]
fn flight_plans() {
    let home = Geodetic { lat_deg: 47.4, lon_deg: 8.5, alt_m: 430.0 };
    let waypoint = |k: f64, yaw_deg, picture| Waypoint {
        position: Geodetic { lat_deg: 47.4 + k * 1e-4, lon_deg: 8.5, alt_m: 470.0 },
        yaw_deg,
        picture,
        every_m: (!picture).then_some(9.0),
    };
    let waypoints = vec![waypoint(0.0, None, true), waypoint(1.0, Some(90.0), true), waypoint(2.0, None, false)];
    let plan = FlightPlan { home, speed_m_s: 5.0, pitch_deg: Some(-60.0), waypoints, landing: Some(home) };
    let mut whole = Vec::new();
    plan.write(&mut whole).expect("memory");
    let bare = r#"{
"fileType": "Plan",
"mission": {
"hoverSpeed": 5,
"plannedHomePosition": [-33, 151, 20],
"items": [
{"type": "SimpleItem", "command": 16, "frame": 0, "params": [0, 0, 0, null, -33.001, 151.001, 60]},
{"type": "SimpleItem", "command": 2000, "frame": 2, "params": [0, 0, 1, null, null, null, null]}
]
}
}
"#;
    let survey = r#"{"fileType": "Plan", "mission": {"plannedHomePosition": [-33, 151, 20], "items": [
{"type": "ComplexItem", "complexItemType": "survey", "Altitude": 30, "TransectStyleComplexItem": {
"HoverAndCapture": true, "VisualTransectPoints": [[-33, 151], [-33.001, 151]]}},
{"type": "ComplexItem", "complexItemType": "CorridorScan", "TransectStyleComplexItem": {"Items": [
{"type": "SimpleItem", "command": 206, "params": [25, 0, 1, 0, 0, 0, 0]},
{"type": "SimpleItem", "command": 16, "frame": 0, "params": [0, 0, 0, null, -33.001, 151.001, 60]}]}}
]}}
"#;
    let list = "QGC WPL 110\n0\t1\t0\t16\t0\t0\t0\t0\t-33\t151\t20\t1\n1\t0\t3\t16\t0\t0\t0\t0\t-33.001\t151\t40\t1\n";
    survive(&Reader {
        name: "plan",
        seeds: vec![whole, bare.into(), survey.into(), list.into()],
        text: true,
        shell: None,
        memory: (64 << 10, 256),
        read: Read::File("reflight.plan", &|path| {
            line(flight_plan::read(path), |plan| {
                let flown =
                    plan.waypoints.iter().all(|w| w.position.is_valid() && w.yaw_deg.is_none_or(f64::is_finite));
                flown && !plan.waypoints.is_empty() && plan.speed_m_s.is_finite() && plan.home.is_valid()
            })
        }),
    });
}

#[test]
fn splits() {
    let region = "{\n\"id\": 3,\n\"bbox_min_xy\": [0, -1.5],\n\"bbox_max_xy\": [2, 1],\n\"images\": [\"a\", \"b\"]\n}";
    let seeds = [
        format!("{{\n\"train\": [\"a\", \"b\"],\n\"test\": [\"c\"],\n\"regions\": [\n{region},\n{region}\n]\n}}\n"),
        "{\n\"train\": [],\n\"note\": {\"by\": 1}\n}".to_owned(),
    ];
    survive(&Reader {
        name: "split",
        seeds: seeds.map(String::into_bytes).into(),
        text: true,
        shell: None,
        memory: (64 << 10, 256),
        read: Read::File("split.json", &|path| {
            line(split::read(path), |s| s.regions.iter().all(|r| r.min[0] < r.max[0] && r.min[1] < r.max[1]))
        }),
    });
}

#[test]
fn telemetry_tables() {
    let head = "image,timestamp,lat_deg,lon_deg,alt_m,gimbal_yaw_deg,gimbal_pitch_deg,gimbal_roll_deg";
    let full = format!(
        "{head},flight_yaw_deg,flight_pitch_deg,flight_roll_deg,gps_e_m,gps_n_m,gps_u_m\n\
         a.jpg,2021:05:04 10:11:12,48.1,11.5,560,10,-90,0,9,1,2,1.5,2.5,60\n\
         b.jpg,,48.1002,11.5,560.5,350,-80,1,,,,2.5,2.5,60\n"
    );
    let bare = format!("{head}\na.jpg,2021:05:04 10:11:12,-33.0,151.5,60,-10,-45.5,0\n");
    let origin = Geodetic { lat_deg: 48.1, lon_deg: 11.5, alt_m: 500.0 };
    survive(&Reader {
        name: "gps",
        seeds: vec![full.into_bytes(), bare.into_bytes()],
        text: true,
        shell: None,
        memory: (64 << 10, 256),
        read: Read::File("gps.csv", &|path| {
            let usable = |t: &telemetry::Telemetry| {
                let pose = t.prior.pose;
                t.position.is_valid() && pose.center.is_finite() && pose.rotation.is_finite()
            };
            let both = [Some(origin), None].map(|o| line(telemetry::read(path, o), |t| t.values().all(usable)));
            let [with, without] = both;
            with.and_then(|a| without.map(|b| a && b))
        }),
    });
}
