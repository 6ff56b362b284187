//! Any exposures and pictures, in any order, with any clues.
#![no_main]

#[path = "../src/targets.rs"]
mod targets;

libfuzzer_sys::fuzz_target!(|data: &[u8]| targets::match_up(data));
