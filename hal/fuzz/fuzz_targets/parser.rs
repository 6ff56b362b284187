//! Any bytes on the line.
#![no_main]

#[path = "../src/victim.rs"]
mod victim;

libfuzzer_sys::fuzz_target!(|data: &[u8]| victim::parse(data));
