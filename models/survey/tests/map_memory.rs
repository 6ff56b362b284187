//! Host memory of writing a map.
//!
//! One test, because the mark is the process's.
#![allow(clippy::unwrap_used, clippy::panic, reason = "a test fails by panicking")]

#[path = "../../tests/support/heap.rs"]
mod heap;

use std::sync::atomic::Ordering;

use glam::DVec2;
use heap::{MOST, NOW};
use survey::ortho::crs::Crs;
use survey::ortho::files::{MapFiles, Pixels};
use survey::ortho::grid::{BLOCK, Grid};

/// 72 million pixels hold no more than 5 million: blocks go to the disk.
#[test]
fn memory_does_not_grow_with_the_map() {
    let most = [[1100.0, 1100.0], [3000.0, 6000.0]].map(|metres| {
        let folder = tempfile::tempdir().unwrap();
        let grid = Grid::new(Crs::local(), [DVec2::ZERO, DVec2::from(metres)], 0.5).unwrap();
        let before = NOW.load(Ordering::Relaxed);
        MOST.store(before, Ordering::Relaxed);
        let mut files = MapFiles::begin(folder.path(), &grid).unwrap();
        // A diagonal of blocks: the others are not there, as around most flights.
        for block in files.blocks().to_vec().into_iter().filter(|b| b.x / BLOCK == b.y / BLOCK) {
            let n = (block.width * block.height) as usize;
            let metres = vec![1.5; n];
            let pixels =
                Pixels { rgba: &mut vec![200; 4 * n], heights: &metres, height_sigmas: &metres, plane_sigmas: &metres };
            files.write(block, pixels).unwrap();
        }
        files.finish(&Default::default(), None).unwrap();
        MOST.load(Ordering::Relaxed) - before
    });
    println!("{most:?} bytes at most");
    let planned = config::map::MapSettings::default().host_bytes() as usize;
    assert!(most.iter().all(|m| *m < planned) && most[1] < most[0] + (8 << 20), "{most:?} of {planned}");
}
