//! Host memory of the initialisation stays below its plan: Rust's share by a counting allocator, ONNX Runtime's (whose
//! malloc that one does not see) by the process's own high-water mark.
//!
//! One test, because both marks are the process's.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic, reason = "a test fails by panicking")]

#[path = "support/heap.rs"]
mod heap;

use std::path::Path;
use std::sync::atomic::Ordering;

use config::init::InitSettings;
use glam::{DQuat, DVec3};
use image::{Rgb, RgbImage};
use models::camera::{Intrinsics, Pose, PoseSigma, PosedImage, View};
use models::init::Initialiser;
use models::onnx::session::find_library;

use heap::{MOST, NOW};

/// `VmRSS` or `VmHWM`, bytes.
fn resident(field: &str) -> u64 {
    let status = std::fs::read_to_string("/proc/self/status").unwrap_or_default();
    let line = status.lines().find(|l| l.starts_with(field)).unwrap_or_default();
    line.split_whitespace().nth(1).and_then(|v| v.parse::<u64>().ok()).unwrap_or(0) * 1024
}

fn picture(i: usize, size: (u32, u32)) -> PosedImage {
    let (w, h) = size;
    let f = 0.75 * w as f32;
    let intrinsics = Intrinsics { width: w, height: h, fx: f, fy: f, cx: w as f32 / 2.0, cy: h as f32 / 2.0 };
    let (x, y) = (16.0 * (i % 9) as f64, 20.0 * (i / 9) as f64);
    let pose = Pose { rotation: DQuat::from_rotation_x(std::f64::consts::PI), center: DVec3::new(x, y, 60.0) };
    let metres = 60.0 / f64::from(f);
    let cell = |v: f64| (v / 1.5).floor() as i64 as u64;
    let image = RgbImage::from_fn(w, h, |u, v| {
        let at = (x + (f64::from(u) - f64::from(w) / 2.0) * metres, y - (f64::from(v) - f64::from(h) / 2.0) * metres);
        let hash = (cell(at.0).wrapping_mul(0x9E37_79B9_7F4A_7C15) ^ cell(at.1).wrapping_mul(0xC2B2_AE3D_27D4_EB4F))
            .wrapping_mul(0x1656_67B1_9E37_79F9);
        Rgb([(hash >> 56) as u8, (hash >> 48) as u8, 90])
    });
    let sigma = PoseSigma { position_m: [0.0; 3], rotation_rad: [0.0; 3] };
    PosedImage { name: i.to_string(), time_ns: 0, image, view: View { intrinsics, pose }, mask: None, sigma }
}

/// Peak of Rust's bytes, of the resident set, and the plan, all since before the initialiser was opened.
fn peaks(settings: &InitSettings, network: Option<&Path>, pictures: usize, size: (u32, u32)) -> [u64; 3] {
    let (before, resident_before) = (NOW.load(Ordering::Relaxed), resident("VmRSS"));
    MOST.store(before, Ordering::Relaxed);
    let mut init = Initialiser::open(settings, network).unwrap();
    for i in 0..pictures {
        // One at a time, as they come from disc or camera.
        init.add(&picture(i, size)).unwrap();
    }
    let planned = init.planned_bytes(pictures, 200_000);
    let out = init.build(200_000, &mut |_, _| {}).unwrap();
    assert!(out.cloud.len() > 1000 && out.cloud.len() <= 200_000, "{:?}", out.report);
    assert_eq!(out.report.planned_bytes, planned);
    let rust = (MOST.load(Ordering::Relaxed) - before) as u64;
    [rust, resident("VmHWM").saturating_sub(resident_before), planned]
}

#[test]
fn the_whole_initialisation_stays_below_its_planned_bytes() {
    if find_library().is_err() {
        needs::missing(needs::Need::OnnxRuntime, "no ONNX Runtime");
        return;
    }
    let mib = |bytes: u64| bytes as f64 / f64::from(1 << 20);
    // An unposed network first: the high-water mark only rises, and this one is small.
    let manifest = Path::new(env!("CARGO_MANIFEST_DIR")).join("networks/random_pair.toml");
    let known =
        InitSettings { depth_m: Some([40.0, 80.0]), stride: 1, window: 1, covisible: 0, ..InitSettings::default() };
    let [rust, _, planned] = peaks(&known, Some(&manifest), 24, (64, 48));
    println!("unposed, 24 pictures of 64×48: Rust {:.1} MiB of {:.1} planned", mib(rust), mib(planned));
    assert!(rust < planned, "{rust} of {planned} bytes");
    let [rust, process, planned] = peaks(&InitSettings::default(), None, 43, (640, 480));
    println!(
        "posed, 43 pictures of 640×480: Rust {:.1} MiB, process {:.1} MiB of {:.1} planned",
        mib(rust),
        mib(process),
        mib(planned)
    );
    // The picture at hand is the caller's.
    let at_hand = 640 * 480 * 3;
    assert!(rust < planned && process < planned + at_hand, "{rust} {process} of {planned} bytes");
    // A plan that is never approached would prove nothing.
    assert!(process > planned / 5, "{process} of {planned} bytes");
}
