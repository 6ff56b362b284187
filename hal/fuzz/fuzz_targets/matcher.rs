//! Any exposures and pictures, in any order, with any clues.
#![no_main]

#[path = "../src/victim.rs"]
mod victim;

libfuzzer_sys::fuzz_target!(|data: &[u8]| victim::match_up(data));
