//! MAVProxy, the developers' ground station, with its camera module beside a vehicle whose camera is ours: what it discovers, sets, takes
//! and is told. It is installed into a virtual environment below `target/`; where that fails, so does the test, unless DGTR_SKIP names
//! `python-packages`.
#![allow(clippy::expect_used, clippy::panic, reason = "a test fails by panicking")]

use rig::Ended;

mod python;
mod rig;

/// Those that its camera module imports, not the windows and maps, which are a gigabyte.
const PACKAGES: [&str; 8] = [
    "--no-deps",
    "MAVProxy==1.8.75",
    "pymavlink==2.4.50",
    "pyserial",
    "fastcrc",
    "defusedxml",
    "numpy",
    "opencv-python-headless",
];

#[test]
fn mavproxys_camera_module_discovers_sets_and_takes_and_is_told_of_each_picture() {
    let Some(python) = python::with("mavproxy", &PACKAGES, "MAVProxy.modules.mavproxy_camera") else { return };
    let Ended { report, asked, posed } = rig::with_client(python, "mavproxy_client.py");
    assert!(report["information"].as_str().is_some_and(|line| line.contains("resolution=32x24")), "{report}");
    assert!(report["settings"].as_u64().is_some_and(|n| n >= 3), "{report}");
    assert_eq!(asked, [5.5], "{report}");
    assert!(report["set"].as_str().is_some_and(|line| line.contains("5.5") && !line.contains("pending")), "{report}");
    // Each of them once, counted from 0; nothing was refused.
    let indices: Vec<i64> = report["captured"].as_array().expect("a list").iter().filter_map(|i| i.as_i64()).collect();
    assert_eq!(indices, (0..indices.len() as i64).collect::<Vec<_>>(), "{report}");
    assert!(indices.len() >= 4 && posed >= indices.len(), "{posed}: {report}");
    assert_eq!(report["rejected"], serde_json::json!([]), "{report}");
}
