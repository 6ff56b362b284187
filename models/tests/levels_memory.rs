//! Host memory of levels of detail.
//!
//! One test, because the mark is the process's.
#![allow(clippy::unwrap_used, clippy::panic, reason = "a test fails by panicking")]

#[path = "support/heap.rs"]
mod heap;

use std::sync::atomic::Ordering;

use heap::{MOST, NOW};
use models::cloud::GaussianCloud;
use models::formats::model::{Chunks, ModelHeader, write_chunks};
use models::levels;

/// Four times the scene takes what the first one took: the rows are in files.
#[test]
fn memory_does_not_grow_with_the_scene() {
    let most = [700, 1_400].map(|side: usize| {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("scene.dgtr");
        let rows = |range: std::ops::Range<usize>| {
            let mut cloud = GaussianCloud::with_capacity(0, range.len());
            for i in range {
                let (x, y) = ((i % side) as f32, (i / side) as f32);
                cloud.push(
                    [x, y, (x * 0.1).sin()],
                    [-0.6, -0.6, -3.0],
                    [1.0, 0.0, 0.0, 0.0],
                    3.0,
                    &[0.3, 0.1, (y * 0.2).cos()],
                );
            }
            cloud
        };
        write_chunks(&path, &ModelHeader::default(), side * side, 0, &rows).unwrap();
        let before = NOW.load(Ordering::Relaxed);
        MOST.store(before, Ordering::Relaxed);
        let written = levels::write(&Chunks::open(&path).unwrap(), &folder.path().join("streamed"), 0).unwrap();
        assert_eq!(written.counts[0], (side * side) as u64);
        MOST.load(Ordering::Relaxed) - before
    });
    println!("{} and {} MiB for 490,000 and 1,960,000 Gaussians", most[0] >> 20, most[1] >> 20);
    assert!(most[1] < most[0] + (24 << 20), "{most:?}");
}
