//! From raw GPS and gimbal angles to poses: error against the reference reconstruction before and after, on two
//! real surveys. Needs the reference data (`DGTR_DATA`); says so and passes without.

#![allow(clippy::unwrap_used)] // a test may

use config::refine::RefineSettings;
use models::camera::Pose;
use models::refine::{RefineReport, Refiner};
use pose_errors::{PoseErrors, pose_errors};
use std::time::Instant;
use survey::dataset::{Dataset, PoseSource};

#[path = "support/pose_errors.rs"]
mod pose_errors;

use needs::shared;

fn refine(name: &str, split: &str, settings: &RefineSettings) -> Option<(PoseErrors, PoseErrors, RefineReport)> {
    let dataset = Dataset::open(&shared(&format!("data/{name}"))?).unwrap();
    let mut refiner = match Refiner::open(settings) {
        Ok(r) => r,
        Err(e) => {
            needs::missing(needs::Need::OnnxRuntime, e);
            return None;
        }
    };
    let chosen = dataset.select(split, None).unwrap();
    let images: Vec<_> = chosen.iter().map(|i| dataset.load_posed(*i, 1.0, PoseSource::Telemetry).unwrap()).collect();
    let clock = Instant::now();
    for image in &images {
        let r = refiner.add(image).unwrap();
        if std::env::var_os("DGTR_VERBOSE").is_some() {
            println!("{} {r:?}", image.name);
        }
    }
    let report = refiner.solve().unwrap();
    let seconds = clock.elapsed().as_secs_f64();
    let truth: Vec<Pose> = chosen.iter().map(|i| dataset.frames[*i].view.pose).collect();
    let before: Vec<Pose> = images.iter().map(|i| i.view.pose).collect();
    let after: Vec<Pose> = images.iter().map(|i| refiner.pose(&i.name).unwrap()).collect();
    if std::env::var_os("DGTR_VERBOSE").is_some() {
        for ((i, a), t) in images.iter().zip(&after).zip(&truth) {
            println!(
                "{}: {:.2} m {:.2}° (before {:.2} m {:.2}°) tied {}",
                i.name,
                (a.center - t.center).length(),
                pose_errors::angle_deg(a.rotation, t.rotation),
                (i.view.pose.center - t.center).length(),
                pose_errors::angle_deg(i.view.pose.rotation, t.rotation),
                refiner.is_tied(&i.name)
            );
        }
    }
    let (before, after) = (pose_errors(&before, &truth), pose_errors(&after, &truth));
    println!("{name} {split}: {} key frames, {:.3} s per key frame", images.len(), seconds / images.len() as f64);
    println!("  before {before:?}\n  after  {after:?}\n  {report:#?}");
    Some((before, after, report))
}

/// A busy machine must not cut the solve short.
fn settings() -> RefineSettings {
    RefineSettings { solve_seconds: 120.0, ..Default::default() }
}

#[test]
fn sheffield_cross_from_raw_telemetry_is_refined_to_a_decimetre() {
    let Some((before, after, report)) = refine("sheffield_cross", "train", &settings()) else { return };
    assert!(before.aligned_angle > 2.0 && before.aligned_position > 0.5, "{before:?}");
    assert_eq!(report.frames_tied, 43);
    assert!(after.aligned_angle < 0.12 && after.aligned_position < 0.13, "{after:?}");
    assert!(report.reprojection_median_px < 0.3);
}

#[test]
fn brighton_beach_from_raw_telemetry_is_refined_below_half_a_degree() {
    let Some((before, after, report)) = refine("brighton_beach", "train", &settings()) else { return };
    assert!(before.aligned_angle > 2.5 && before.aligned_position > 0.6, "{before:?}");
    assert_eq!(report.frames_tied, 15);
    assert!(after.aligned_angle < 0.5 && after.aligned_position < 0.3, "{after:?}");
}
