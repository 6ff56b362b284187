//! What the ground holds of 24 aircraft at once: the union, and one model at a time.
#![allow(clippy::expect_used, reason = "a test fails by panicking")]
#![allow(unsafe_code, reason = "the allocator that knows the peak")]

#[path = "../../tests/peak_allocator.rs"]
mod peak_allocator;

use std::path::Path;

use config::ground::GroundSettings;
use ground::LocalModel;
use ground::jobs::aggregate::{self, Outcome};
use ground::member::Member;
use models::cloud::GaussianCloud;
use models::formats::model::{self, ModelHeader};
use peak_allocator::peak_of;

/// Gaussians along each side of a model, and the bytes that one of degree 3 takes.
const ALONG: usize = 100;
const BYTES: usize = 4 * (11 + 48);

fn aircraft(dir: &Path, i: usize) -> Member {
    let (x, y) = ((i % 6) as f32 * 80.0, (i / 6) as f32 * 80.0);
    let mut cloud = GaussianCloud::with_capacity(3, ALONG * ALONG);
    for n in 0..ALONG * ALONG {
        let mean = [x + (n % ALONG) as f32, y + (n / ALONG) as f32, 0.0];
        cloud.push(mean, [-0.7; 3], [1.0, 0.0, 0.0, 0.0], 3.0, &[0.1; 48]);
    }
    let [w, s, e, n] = [x + 10.0, y + 10.0, x + 90.0, y + 90.0].map(f64::from);
    let region = vec![[w, s], [e, s], [e, n], [w, n]];
    let header = ModelHeader { aircraft: format!("a{i}"), region, ..Default::default() };
    let path = dir.join(format!("a{i}.dgtr"));
    model::write(&path, &header, &cloud).expect("written");
    Member::of(LocalModel::read(&path).expect("read"))
}

fn merged(aircraft_of_field: usize) -> (Outcome, usize) {
    let dir = tempfile::tempdir().expect("temp dir");
    let settings = GroundSettings { epochs: 0, register: false, ..Default::default() };
    let (outcome, peak) = peak_of(|| {
        let members = (0..aircraft_of_field).map(|i| aircraft(dir.path(), i)).collect();
        aggregate::run(members, &settings, None, dir.path(), &|| false).expect("merged")
    });
    (outcome, peak)
}

/// All models, a copy of each and the union were in memory together.
#[test]
fn the_ground_holds_the_union_and_one_model_at_a_time() {
    let model = ALONG * ALONG * BYTES;
    for n in [6, 24] {
        let (outcome, peak) = merged(n);
        assert_eq!(outcome.kept.len(), n);
        assert!(outcome.kept.iter().all(|k| k.gaussians == ALONG * ALONG && k.own >= 80 * 80));
        let union = outcome.gaussians * BYTES;
        // A model with its bytes as they are read, and what is known of 80 × 80 m of ground.
        let most = union + 4 * model + n * 400_000;
        assert!(peak < most, "{n} aircraft: {peak} bytes, union {union}, a model {model}");
        assert!(n * model > union + 4 * model || n < 24, "all models together would not be noticed");
    }
}
