//! MAVSDK, whose camera client ground stations' programs are built on, beside a vehicle whose camera is ours: what it lists, sets, takes
//! and is told. It is installed into a virtual environment below `target/`; where that fails, so does the test, unless DGTR_SKIP names
//! `python-packages`.
#![allow(clippy::expect_used, clippy::panic, reason = "a test fails by panicking")]

use rig::Ended;

mod python;
mod rig;

#[test]
fn mavsdks_camera_client_lists_sets_and_takes_and_is_told_of_each_picture() {
    let Some(python) = python::with("mavsdk", &["mavsdk==4.1.0"], "mavsdk.mavsdk") else { return };
    let Ended { report, asked, posed } = rig::with_client(python, "mavsdk_client.py");
    assert_eq!(report["camera"], serde_json::json!([100, 32, 24]), "{report}");
    assert!(report["settings"].as_array().is_some_and(|s| s.len() >= 3), "{report}");
    assert!(report["options"].to_string().contains("KF_DISTANCE"), "{report}");
    assert_eq!(
        (asked.as_slice(), report["set"].as_str().and_then(|v| v.parse().ok())),
        (&[5.5][..], Some(5.5)),
        "{report}"
    );
    // Each of them once, with the exposure's own time, counted from 0.
    let captured = report["captured"].as_array().expect("a list");
    let indices: Vec<i64> = captured.iter().filter_map(|c| c[0].as_i64()).collect();
    assert_eq!(indices, (0..indices.len() as i64).collect::<Vec<_>>(), "{report}");
    assert!(indices.len() >= 4 && posed >= indices.len(), "{posed}: {report}");
    assert!(captured.iter().all(|c| c[1] == true && c[2] == true), "{report}");
    assert!(report["photos"].as_array().is_some_and(|p| p.len() >= 4), "{report}");
}
