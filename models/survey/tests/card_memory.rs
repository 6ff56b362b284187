//! Host memory does not grow with the number of a card's pictures.
//!
//! One test, because the mark is the process's.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic, reason = "a test fails by panicking")]

#[path = "../../tests/support/heap.rs"]
mod heap;

use std::ops::ControlFlow;
use std::sync::atomic::Ordering;

use geometry::geodesy::{EnuFrame, Geodetic};
use glam::DVec3;
use image::{Rgb, RgbImage};
use survey::card::write::Tags;
use survey::dataset::{Dataset, PoseSource};

use heap::{MOST, NOW};

const SIZE: (u32, u32) = (1600, 1200);

/// Bytes that reading `n` pictures at quarter size needs beyond what was there before.
fn peak(n: u32, jpeg: &[u8]) -> usize {
    let dir = tempfile::tempdir().unwrap();
    let frame = EnuFrame::new(Geodetic { lat_deg: 46.8, lon_deg: -92.0, alt_m: 150.0 });
    for i in 0..n {
        let position = Some(frame.to_geodetic(DVec3::new(10.0 * f64::from(i), 0.0, 40.0)));
        let time_ns = Some(1_500_000_000_000_000_000 + u64::from(i) * 2_000_000_000);
        let tags = Tags { position, time_ns, ..Tags::default() }.with_dji([90.0, -90.0, 0.0], 40.0);
        std::fs::write(dir.path().join(format!("{i:04}.jpg")), tags.into_jpeg(jpeg).unwrap()).unwrap();
    }
    let set = Dataset::open(dir.path()).unwrap();
    let all: Vec<usize> = (0..set.frames.len()).collect();
    assert_eq!(all.len(), n as usize);
    let before = NOW.load(Ordering::Relaxed);
    MOST.store(before, Ordering::Relaxed);
    let mut next = 0;
    set.load_ahead(&all, 0.25, PoseSource::Telemetry, THREADS, |i, picture| {
        assert_eq!((i, picture.unwrap().image.dimensions()), (next, (SIZE.0 / 4, SIZE.1 / 4)));
        next += 1;
        ControlFlow::Continue(())
    });
    assert_eq!(next, n as usize);
    MOST.load(Ordering::Relaxed) - before
}

/// Threads that decode.
const THREADS: usize = 2;

#[test]
fn the_hundredth_picture_needs_no_more_memory_than_the_first() {
    let photo = RgbImage::from_fn(SIZE.0, SIZE.1, |x, y| Rgb([(x / 7) as u8, (y / 5) as u8, (x ^ y) as u8]));
    let mut jpeg = std::io::Cursor::new(Vec::new());
    photo.write_to(&mut jpeg, image::ImageFormat::Jpeg).unwrap();
    drop(photo);
    let (few, many) = (peak(4, jpeg.get_ref()), peak(100, jpeg.get_ref()));
    // A decoder may queue the 16-bit coefficients of one picture; beside it each thread has a reduced picture in hand.
    let pixels = (SIZE.0 * SIZE.1) as usize;
    let bound = THREADS * (3 * 2 * pixels + 2 * 3 * pixels / 16);
    println!(
        "{few} bytes for 4 pictures, {many} for 100, bound {bound}; 100 reduced ones are {}",
        100 * 3 * pixels / 16
    );
    assert!(few < bound && many < bound, "{few} and {many} of {bound}");
}
