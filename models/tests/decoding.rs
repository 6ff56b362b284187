//! What decoding costs: pictures of a real camera, reduced while they are decoded. Needs the reference data (`DGTR_DATA`); says so
//! and passes without.

#![allow(clippy::unwrap_used)] // a test may

use std::fs;
use std::time::Instant;

use models::picture::decode_at_least;

use needs::shared;

/// Rounds over all pictures, of which the best counts.
const ROUNDS: usize = 5;

/// On one thread and on one processor: `taskset -c 0 cargo test --release -p models --test decoding -- --ignored --nocapture`.
#[test]
#[ignore = "a measurement, not a promise"]
fn milliseconds_of_a_megapixel_at_a_quarter_of_its_size() {
    let Some(card) = shared("data/brighton_beach_card/DCIM") else { return };
    let mut files: Vec<_> = fs::read_dir(card).unwrap().map(|entry| entry.unwrap().path()).collect();
    files.sort();
    let sizes: Vec<(u32, u32)> = files.iter().map(|f| image::image_dimensions(f).unwrap()).collect();
    let megapixels: f64 = sizes.iter().map(|(w, h)| f64::from(w * h) * 1e-6).sum();
    let megabytes: f64 = files.iter().map(|f| fs::metadata(f).unwrap().len() as f64 * 1e-6).sum();
    let mut least = f64::INFINITY;
    for _ in 0..ROUNDS {
        let clock = Instant::now();
        for (file, (w, h)) in files.iter().zip(&sizes) {
            let wanted = (w / 4, h / 4);
            let picture = decode_at_least(file, wanted).unwrap();
            assert!(picture.width() >= wanted.0 && picture.width() <= wanted.0 + 2);
        }
        least = least.min(clock.elapsed().as_secs_f64() * 1e3);
    }
    let each = least / megapixels;
    println!(
        "{} pictures, {:.1} megapixels and {:.1} MB each: {each:.2} ms a megapixel, {:.1} ms for 12",
        files.len(),
        megapixels / files.len() as f64,
        megabytes / files.len() as f64,
        12.0 * each
    );
}
