//! Host memory of the delivery encoding stays below what its callers plan for it.
//!
//! One test, because the mark is the process's.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic, reason = "a test fails by panicking")]

#[path = "support/heap.rs"]
mod heap;

use std::sync::atomic::Ordering;

use heap::{MOST, NOW};
use models::cloud::GaussianCloud;
use models::formats::delivery::{ENCODED_BYTES, ENCODING_BYTES, Rounding};
use models::formats::model::{self, ModelHeader};
use rand::{Rng, SeedableRng};

#[test]
fn encoding_holds_no_more_than_is_planned_for_it_and_its_file_takes_no_more() {
    let (n, mut rng) = (50_000, rand_pcg::Pcg64::seed_from_u64(1));
    let mut cloud = GaussianCloud::with_capacity(3, n);
    for _ in 0..n {
        let mut number = |size: f32| rng.random_range(-size..size);
        let (mean, scales) = ([number(200.0), number(200.0), number(5.0)], [(); 3].map(|()| number(1.0) - 2.0));
        let (rotation, sh) = ([1.0, number(1.0), number(1.0), number(1.0)], [(); 48].map(|()| number(0.5)));
        cloud.push(mean, scales, rotation, number(4.0), &sh);
    }
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("m.dgtr");
    for rounding in [Rounding::default(), Rounding::fine()] {
        let before = NOW.load(Ordering::Relaxed);
        MOST.store(before, Ordering::Relaxed);
        model::write_rounded(&Default::default(), &path, &ModelHeader::default(), &cloud, &rounding).unwrap();
        let each = (MOST.load(Ordering::Relaxed) - before) / n;
        let size = path.metadata().unwrap().len() as usize / n;
        println!("{each} bytes of memory and {size} of the disk per Gaussian");
        assert!(each <= ENCODING_BYTES && size <= ENCODED_BYTES, "{each} and {size} bytes per Gaussian");
    }
}
