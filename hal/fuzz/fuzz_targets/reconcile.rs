//! Any exposures and pictures that are left at the end of a flight.
#![no_main]

#[path = "../src/targets.rs"]
mod targets;

libfuzzer_sys::fuzz_target!(|data: &[u8]| targets::reconcile_all(data));
