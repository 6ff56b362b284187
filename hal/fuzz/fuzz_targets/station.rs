//! Whatever a ground station may ask of the camera.
#![no_main]

#[path = "../src/targets.rs"]
mod targets;

libfuzzer_sys::fuzz_target!(|data: &[u8]| drop(targets::ask_camera(data)));
