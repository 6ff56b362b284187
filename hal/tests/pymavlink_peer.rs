//! pymavlink, an independent implementation, as the autopilot at the far end of a pseudo-terminal: both ways, unsigned and
//! signed. It is installed into a virtual environment below `target/`; where that fails, so do the tests, unless DGTR_SKIP names
//! `python-packages`.
#![allow(clippy::expect_used, clippy::panic, reason = "a test fails by panicking")]

use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::time::Duration;

use config::keys::to_hex;
use config::link::{LinkSettings, Signing};
use config::mission::{CameraSettings, MountAttitude, MountSettings};
use geometry::geodesy::Geodetic;
use hal::link::LinkAddress;
use hal::mavlink::dialect::MavSeverity;
use hal::vehicle::{Event, Vehicle, VehicleSettings};

const KEY: [u8; 32] = [0x5A; 32];

mod python;

fn python() -> Option<PathBuf> {
    python::with("pymavlink", &["pymavlink==2.4.49", "pyserial==3.5"], "pymavlink, serial")
}

/// What happened on our side.
#[derive(Default)]
struct Seen {
    poses: usize,
    triggers: Vec<u32>,
    lost: usize,
    wrong_key: u64,
    unsigned: u64,
    clock_error_ms: f64,
}

/// Talks with the peer until it ends; returns its report and ours.
fn talk(python: &Path, signing: Signing, peer_key: Option<&str>) -> (serde_json::Value, Seen) {
    let folder = tempfile::tempdir().expect("a folder");
    let key = folder.path().join("key");
    std::fs::write(&key, KEY).expect("written");
    std::fs::set_permissions(&key, std::os::unix::fs::PermissionsExt::from_mode(0o600)).expect("its own");
    let settings = VehicleSettings {
        link: LinkSettings { signing, signing_key: Some(key), ..LinkSettings::default() },
        mount: MountSettings { attitude: MountAttitude::Fixed, ..MountSettings::default() },
        ..VehicleSettings::new(
            LinkAddress::Pty(None),
            CameraSettings::pinhole(640, 480, 400.0),
            Geodetic { lat_deg: 46.84265, lon_deg: -91.9939, alt_m: 158.6 },
        )
    };
    let mut vehicle = Vehicle::open(&settings).expect("a pty");
    let device = vehicle.link().link().and_then(|l| l.pty_path()).expect("its path").to_path_buf();
    let script = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/peer.py");
    let mut peer = Command::new(python);
    peer.arg(script).arg(device).args(peer_key).stdout(Stdio::piped());
    let mut peer = peer.spawn().expect("python starts");
    let mut seen = Seen::default();
    let mut told = false;
    while peer.try_wait().expect("a child").is_none() {
        match vehicle.poll(Duration::from_millis(50)).expect("a pty does not fail") {
            Some(Event::Pose(pose)) => {
                seen.poses += 1;
                seen.clock_error_ms = (vehicle.now_ns() as f64 - pose.time_ns as f64) * 1e-6;
                if !std::mem::replace(&mut told, true) {
                    vehicle
                        .status_text(MavSeverity::MAV_SEVERITY_INFO, &"sixty bytes are more than one chunk ".repeat(2));
                }
            }
            Some(Event::Trigger(trigger)) => seen.triggers.push(trigger.sequence),
            Some(Event::LinkLost) => seen.lost += 1,
            _ => {}
        }
    }
    let counters = vehicle.counters();
    (seen.wrong_key, seen.unsigned) = (counters.link.wrong_key, counters.link.unsigned);
    let output = peer.wait_with_output().expect("its output");
    (serde_json::from_slice(&output.stdout).expect("its report"), seen)
}

/// What must hold whenever the two may talk.
fn assert_conversation(report: &serde_json::Value, seen: &Seen) {
    assert!(seen.poses > 20, "{} poses", seen.poses);
    assert_eq!((seen.triggers.as_slice(), seen.lost), (&[1, 2, 3][..], 0));
    assert!(seen.clock_error_ms.abs() < 100.0, "pose stamped {} ms ago", seen.clock_error_ms);
    assert_eq!(report["bad"], 0, "{report}");
    assert!(report["cameras"].as_u64() >= Some(3), "{report}");
    assert!(report["timesync_answers"].as_u64() >= Some(3), "{report}");
    assert_eq!(report["information"], serde_json::json!([640, 480]));
    // Requests and the interval of 262 are accepted, a digicam command without a shot and video are unsupported, a series
    // without an interval is denied.
    let expected = serde_json::json!({"512": 0, "521": 0, "203": 3, "2501": 3, "511": 0, "2000": 2});
    assert_eq!(report["acks"], expected, "{report}");
    let texts = report["texts"].as_array().expect("texts");
    assert_eq!(texts.len(), 2, "{report}");
    assert!(texts[0][0] == texts[1][0] && texts[0][0] != 0 && texts[1][1] == 1, "{report}");
}

#[test]
fn pymavlink_and_we_understand_each_other_unsigned() {
    let Some(python) = python() else { return };
    let (report, seen) = talk(&python, Signing::Off, None);
    assert_conversation(&report, &seen);
    assert_eq!(report["signed"], 0);
}

#[test]
fn pymavlink_and_we_understand_each_other_signed() {
    let Some(python) = python() else { return };
    let (report, seen) = talk(&python, Signing::Require, Some(&to_hex(&KEY)));
    assert_conversation(&report, &seen);
    assert_eq!((report["unsigned"].as_u64(), seen.unsigned, seen.wrong_key), (Some(0), 0, 0));
}

#[test]
fn a_peer_with_another_key_is_heard_by_neither_side() {
    let Some(python) = python() else { return };
    let (report, seen) = talk(&python, Signing::Require, Some(&to_hex(&[1; 32])));
    assert!(seen.poses == 0 && seen.triggers.is_empty() && seen.wrong_key > 50, "{} {}", seen.poses, seen.wrong_key);
    assert_eq!((report["cameras"].as_u64(), report["information"].is_null()), (Some(0), true), "{report}");
    let (_, seen) = talk(&python, Signing::Require, None);
    assert!(seen.poses == 0 && seen.unsigned > 50, "{} {}", seen.poses, seen.unsigned);
}
