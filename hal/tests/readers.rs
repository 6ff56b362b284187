//! Every reader of the HAL against broken input, as the readers of `models` are: 100,000 inputs each (`DGTR_FUZZ_INPUTS` says
//! otherwise), mutated from whole ones. Whatever comes, nothing panics and memory stays bounded.
#![allow(clippy::expect_used, clippy::panic, reason = "a test fails by panicking")]

use std::path::Path;
use std::time::Duration;

use hal::camera::{JpegSplitter, exif_pose, is_complete};
use hal::link::TlogLink;
use hal::traits::Link;

#[path = "../../models/tests/readers/memory.rs"]
mod memory;
#[path = "../../models/tests/readers/mutation.rs"]
mod mutation;
#[path = "../fuzz/src/targets.rs"]
mod targets;

use mutation::{Random, mutate};

/// Inputs for each reader unless the environment says otherwise.
fn inputs() -> usize {
    std::env::var("DGTR_FUZZ_INPUTS").ok().and_then(|n| n.parse().ok()).unwrap_or(100_000)
}

/// A stretch of a recorded flight.
fn stretch<'a>(flight: &'a [u8], most: usize, random: &mut Random) -> &'a [u8] {
    let from = random.below(flight.len() - most);
    &flight[from..from + most]
}

fn flight() -> Vec<u8> {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("../tests/data/run8_trimmed.tlog");
    std::fs::read(path).expect("the recording in the repository")
}

/// A JPEG's head with a GPS position: EXIF in little-endian TIFF, one directory that points to the next.
fn tagged() -> Vec<u8> {
    let entry = |tag: u16, kind: u16, count: u32, value: u32| {
        [&tag.to_le_bytes()[..], &kind.to_le_bytes(), &count.to_le_bytes(), &value.to_le_bytes()].concat()
    };
    let text = |c: u8| u32::from(c);
    let gps = [
        entry(1, 2, 2, text(b'N')),
        entry(2, 5, 3, 128),
        entry(3, 2, 2, text(b'W')),
        entry(4, 5, 3, 128),
        entry(5, 1, 1, 0),
        entry(6, 5, 1, 128),
    ];
    let mut tiff =
        [&b"II*\0"[..], &8u32.to_le_bytes(), &1u16.to_le_bytes(), &entry(0x8825, 4, 1, 26), &[0; 4]].concat();
    tiff.extend_from_slice(&6u16.to_le_bytes());
    gps.iter().for_each(|e| tiff.extend_from_slice(e));
    tiff.resize(128, 0);
    (0..6u32).for_each(|k| tiff.extend_from_slice(&(1 + k % 2).to_le_bytes()));
    let app1 = [&b"Exif\0\0"[..], &tiff].concat();
    let length = u16::try_from(app1.len() + 2).expect("short").to_be_bytes();
    [&[0xFF, 0xD8, 0xFF, 0xE1][..], &length, &app1, &[0xFF, 0xDA, 0, 4, 1, 2, 3, 4, 0xFF, 0xD9]].concat()
}

#[test]
fn mavlink_matcher_and_reconciliation() {
    let (flight, mut random, mut largest) = (flight(), Random::new(3), 0);
    for _ in 0..inputs() {
        let [seed, other] = [(); 2].map(|()| stretch(&flight, 400, &mut random));
        let input = mutate(seed, other, false, &mut random);
        targets::parse(&input);
        targets::match_up(&input);
        let ((), held) = memory::peak(|| targets::reconcile_all(&input));
        largest = largest.max(held);
        // Quadratic in what is left, 32 bytes a pair.
        assert!(held < (64 << 10) + 64 * (input.len() / 16).pow(2), "{held} bytes for {}", input.len());
    }
    println!("{} inputs, {largest} bytes held at most by the reconciliation", inputs());
}

#[test]
fn logs_and_pictures() {
    let folder = ["/dev/shm"].into_iter().find(|f| Path::new(f).is_dir()).map(tempfile::tempdir_in);
    let folder = folder.unwrap_or_else(tempfile::tempdir).expect("a folder for the inputs");
    let (log, picture) = (folder.path().join("a.tlog"), folder.path().join("a.jpg"));
    let (flight, tagged, mut random) = (flight(), tagged(), Random::new(4));
    std::fs::write(&picture, &tagged).expect("written");
    assert!(exif_pose(&picture).is_some(), "what is mutated is whole to begin with");
    let (mut records, mut poses, mut whole, mut buffer, mut largest) = (0u64, 0u64, 0u64, [0; 512], 0);
    for _ in 0..inputs() {
        let [seed, other] = [(); 2].map(|()| stretch(&flight, 600, &mut random));
        std::fs::write(&log, mutate(seed, other, false, &mut random)).expect("written");
        let ((), held) = memory::peak(|| {
            let mut link = TlogLink::open(&log).expect("opens");
            while link.read(&mut buffer, Duration::ZERO).is_ok() {}
            records += link.records();
        });
        assert!(held < 128 << 10, "{held} bytes for a log");

        let input = mutate(&tagged, &tagged, false, &mut random);
        std::fs::write(&picture, &input).expect("written");
        let ((), held) = memory::peak(|| {
            poses += u64::from(exif_pose(&picture).is_some());
            whole += u64::from(is_complete(&picture).is_ok_and(|complete| complete));
            let mut splitter = JpegSplitter::default();
            splitter.push(&input);
            while splitter.next_jpeg().is_some() {}
        });
        assert!(held < (512 << 10) + 64 * input.len(), "{held} bytes for a picture of {}", input.len());
        largest = largest.max(held);
    }
    println!("{} inputs: {records} records, {poses} poses, {whole} whole pictures, {largest} bytes at most", inputs());
    assert!(records > 0 && poses > 0 && whole > 0, "mutations reach the decoders");
}
