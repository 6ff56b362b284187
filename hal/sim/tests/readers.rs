//! The reader of recordings against broken input.
#![allow(clippy::expect_used, clippy::panic, reason = "a test fails by panicking")]

use std::path::Path;

use sim::replay::Recording;

#[path = "../../../tests/readers/driver.rs"]
mod driver;

use driver::{Random, Read, Reader, line, memory_folder, survive};

/// Stretches of a recorded flight.
fn stretches(length: usize) -> Vec<Vec<u8>> {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../tests/data/run8_trimmed.tlog");
    let flight = std::fs::read(path).expect("the recording in the repository");
    let mut random = Random::new(3);
    let stretch = |_| {
        let from = random.below(flight.len() - length);
        flight[from..from + length].to_vec()
    };
    (0..256).map(stretch).collect()
}

#[test]
fn recordings() {
    let folder = memory_folder();
    let path = folder.path().join("whole.tlog");
    let mut seeds = stretches(6000);
    seeds.retain(|bytes| {
        std::fs::write(&path, bytes).expect("written");
        Recording::read(&path).is_ok()
    });
    seeds.truncate(32);
    survive(&Reader {
        name: "recording",
        seeds,
        text: false,
        shell: None,
        memory: (256 << 10, 32),
        read: Read::File("a.tlog", &|path| {
            line(Recording::read(path), |r| r.home.is_valid() && r.length_s().is_finite() && r.boot_s(1.0).is_finite())
        }),
    });
}
