//! From a card's own words to poses: what a real camera's card says, settled by its pictures, against a reference
//! reconstruction of the same flight. Needs the reference data (`DGTR_DATA`); says so and passes without.

#![allow(clippy::unwrap_used)] // a test may

use std::f64::consts::PI;
use std::ops::ControlFlow;

use config::refine::RefineSettings;
use glam::DQuat;
use models::camera::Pose;
use models::refine::{RefineReport, Refiner};
use pose_errors::pose_errors;
use survey::card::CardOptions;
use survey::dataset::{Dataset, PoseSource};

#[path = "support/pose_errors.rs"]
mod pose_errors;

use needs::shared;

/// As `dgtr train` settles a card, with time enough on a busy machine.
fn settle(set: &Dataset, side: u32) -> Option<(Refiner, RefineReport)> {
    let notes = set.card.as_ref().unwrap();
    assert!(notes.distortion_unknown);
    let settings = RefineSettings {
        solve_seconds: 120.0,
        focal_sigma: notes.focal_sigma,
        radial_sigma: 0.05,
        principal_sigma: 0.02,
        aspect_sigma: 0.005,
        feature_side: side,
        max_features: 2000,
        // Without telemetry there is nothing that could be off for all alike.
        mount_sigma_deg: if notes.floats { 0.0 } else { 3.0 },
        delay_sigma_s: if notes.floats { 0.0 } else { 1.0 },
        ..Default::default()
    };
    let mut refiner = match Refiner::open(&settings) {
        Ok(r) => r,
        Err(e) => {
            needs::missing(needs::Need::OnnxRuntime, e);
            return None;
        }
    };
    let all: Vec<usize> = (0..set.frames.len()).collect();
    let scale = f64::from(side) / f64::from(set.frames[0].view.intrinsics.width);
    set.load_ahead(&all, scale, PoseSource::Telemetry, 2, |_, picture| {
        refiner.add(&picture.unwrap()).unwrap();
        ControlFlow::Continue(())
    });
    if notes.floats {
        let placed = refiner.bootstrap().unwrap();
        println!("{placed:?}");
    }
    for _ in 0..if notes.floats { 3 } else { 1 } {
        refiner.solve().unwrap();
        refiner.relink().unwrap();
    }
    let report = refiner.solve().unwrap();
    Some((refiner, report))
}

/// In widths of the picture.
fn focal(refiner: &Refiner, set: &Dataset) -> f64 {
    let k = refiner.intrinsics(&set.frames[0].name).unwrap();
    f64::from(k.fx) / f64::from(k.width)
}

#[test]
fn a_real_card_is_settled_to_a_decimetre_and_its_six_turned_pictures_are_found() {
    let (Some(card), Some(reference)) = (shared("data/brighton_beach_card"), shared("data/brighton_beach")) else {
        return;
    };
    let (set, truth) = (Dataset::open(&card).unwrap(), Dataset::open(&reference).unwrap());
    let Some((refiner, report)) = settle(&set, 1280) else { return };
    let (mut turned, mut found, mut wanted) = (Vec::new(), Vec::new(), Vec::new());
    for frame in &set.frames {
        let pose = refiner.pose(&frame.name).unwrap();
        let is_turned = frame.prior.unwrap().pose.rotation.angle_between(pose.rotation).to_degrees() > 90.0;
        if is_turned {
            turned.push(frame.name.as_str());
        }
        let stem = frame.name.trim_end_matches(".JPG");
        let same = truth.frames.iter().find(|f| f.name.starts_with(stem)).unwrap();
        // In the reference the six were turned back.
        let back = if is_turned { DQuat::from_rotation_z(PI) } else { DQuat::IDENTITY };
        found.push(Pose { rotation: pose.rotation * back, ..pose });
        wanted.push(same.view.pose);
    }
    let errors = pose_errors(&found, &wanted);
    println!("{turned:?}\n{errors:?}, focal length {:.4} of the width\n{report:#?}", focal(&refiner, &set));
    assert_eq!(
        turned,
        ["DJI_0024.JPG", "DJI_0025.JPG", "DJI_0026.JPG", "DJI_0027.JPG", "DJI_0028.JPG", "DJI_0029.JPG"]
    );
    assert_eq!(report.frames_tied, 18);
    assert!(report.reprojection_median_px < 0.3);
    assert!(errors.aligned_position < 0.15 && errors.aligned_angle < 0.3, "{errors:?}");
    // A flat block seen straight down cannot tell its focal length (it drifts by 10 % and more); its radial terms it can:
    // k2 of the same camera model, calibrated on an oblique block, is 0.0153.
    assert!(!report.shared.focal_estimated && report.shared.focal_scale == 1.0);
    assert!(report.shared.radial_estimated[1] && (report.shared.radial[1] - 0.0153).abs() < 0.005);
}

#[test]
fn the_focal_length_of_an_oblique_block_is_estimated_to_one_percent() {
    let Some(reference) = shared("data/sheffield_cross") else { return };
    let truth = Dataset::open(&reference).unwrap();
    let card = tempfile::tempdir().unwrap();
    for i in truth.select("train", None).unwrap() {
        let frame = &truth.frames[i];
        std::fs::copy(&frame.path, card.path().join(&frame.name)).unwrap();
    }
    let set = Dataset::open_card(&[card.path().to_owned()], &CardOptions::default()).unwrap();
    let start = set.frames[0].view.intrinsics;
    let Some((refiner, report)) = settle(&set, 640) else { return };
    let poses = set.frames.iter().map(|frame| {
        let same = truth.frames.iter().find(|f| f.name == frame.name).unwrap();
        (refiner.pose(&frame.name).unwrap(), same.view.pose)
    });
    let (found, wanted): (Vec<Pose>, Vec<Pose>) = poses.unzip();
    let errors = pose_errors(&found, &wanted);
    let true_focal = f64::from(truth.frames[0].view.intrinsics.fx) / 640.0;
    let (before, after) = (f64::from(start.fx) / 640.0 / true_focal, focal(&refiner, &set) / true_focal);
    println!("{errors:?}, focal length {before:.4} and {after:.4} of the reference's\n{report:#?}");
    assert_eq!(report.frames_tied, set.frames.len());
    // 4.0 % off before and 0.4 % after: 2.0 % with pixels held square, which the shutter makes them not.
    assert!(report.shared.focal_estimated && (before - 1.0).abs() > 0.035, "{before}");
    assert!((after - 1.0).abs() < 0.01, "{after}");
    assert!(errors.aligned_position < 0.25 && errors.aligned_angle < 0.2, "{errors:?}");
}

/// The JPEG without XMP and without its directory of GPS tags; what it says of lens and time stays.
fn without_gps(jpeg: &[u8]) -> Vec<u8> {
    let mut out = jpeg[..2].to_vec();
    let mut at = 2;
    while jpeg[at + 1] != 0xDA {
        let end = at + 2 + usize::from(u16::from_be_bytes([jpeg[at + 2], jpeg[at + 3]]));
        let mut segment = jpeg[at..end].to_vec();
        if segment[4..].starts_with(b"Exif") {
            // Tag 0x8825, LONG, once: an unknown tag instead.
            for (from, to) in [([0x25, 0x88, 4, 0, 1], [0, 0xC7, 4, 0, 1]), ([0x88, 0x25, 0, 4, 0], [0xC7, 0, 0, 4, 0])]
            {
                if let Some(tag) = segment.windows(5).position(|w| w == from) {
                    segment[tag..tag + 5].copy_from_slice(&to);
                }
            }
            // DJI's maker note has gimbal angles.
            if let Some(tag) = segment.windows(2).position(|w| w == [0x7C, 0x92]) {
                segment[tag] = 0x7D;
            }
        }
        if jpeg[at + 1] != 0xE1 || segment[4..].starts_with(b"Exif") {
            out.extend(segment);
        }
        at = end;
    }
    out.extend(&jpeg[at..]);
    out
}

/// Copies of pictures that say nothing of where they were taken.
fn stripped<'a>(pictures: impl Iterator<Item = (&'a std::path::Path, &'a str)>) -> (tempfile::TempDir, Dataset) {
    let card = tempfile::tempdir().unwrap();
    for (path, name) in pictures {
        std::fs::write(card.path().join(name), without_gps(&std::fs::read(path).unwrap())).unwrap();
    }
    let set = Dataset::open_card(&[card.path().to_owned()], &CardOptions::default()).unwrap();
    assert!(set.origin.is_none() && set.card.as_ref().unwrap().floats);
    (card, set)
}

#[test]
fn a_card_without_gps_is_a_scene_up_to_similarity() {
    let (Some(card), Some(reference)) = (shared("data/brighton_beach_card"), shared("data/brighton_beach")) else {
        return;
    };
    let (with, truth) = (Dataset::open(&card).unwrap(), Dataset::open(&reference).unwrap());
    let (_card, set) = stripped(with.frames.iter().map(|f| (f.path.as_path(), f.name.as_str())));
    let Some((refiner, report)) = settle(&set, 1280) else { return };
    let (mut found, mut wanted) = (Vec::new(), Vec::new());
    for frame in &set.frames {
        let pose = refiner.pose(&frame.name).unwrap();
        let same = truth.frames.iter().find(|f| f.name.starts_with(frame.name.trim_end_matches(".JPG"))).unwrap();
        found.push(pose);
        wanted.push(same.view.pose);
    }
    // In the reference six pictures were turned back.
    let turned = |found: &[Pose]| -> Vec<Pose> {
        let number = |i: usize| set.frames[i].name[4..8].parse::<u32>().unwrap();
        let back = |i| if (24..30).contains(&number(i)) { DQuat::from_rotation_z(PI) } else { DQuat::IDENTITY };
        found.iter().enumerate().map(|(i, p)| Pose { rotation: p.rotation * back(i), ..*p }).collect()
    };
    let errors = pose_errors(&turned(&found), &wanted);
    println!("{errors:?}, focal length {:.4} of the width\n{report:#?}", focal(&refiner, &set));
    assert_eq!(report.frames_tied, 18);
    assert!(errors.aligned_position < 0.15 && errors.aligned_angle < 0.3, "{errors:?}");
}

#[test]
fn an_oblique_card_without_gps_is_a_scene_up_to_similarity() {
    let Some(reference) = shared("data/sheffield_cross") else { return };
    let truth = Dataset::open(&reference).unwrap();
    let train = truth.select("train", None).unwrap();
    let (_card, set) =
        stripped(train.iter().map(|i| (truth.frames[*i].path.as_path(), truth.frames[*i].name.as_str())));
    let Some((refiner, report)) = settle(&set, 640) else { return };
    let poses = set.frames.iter().map(|frame| {
        let same = truth.frames.iter().find(|f| f.name == frame.name).unwrap();
        (refiner.pose(&frame.name).unwrap(), same.view.pose)
    });
    let (found, wanted): (Vec<Pose>, Vec<Pose>) = poses.unzip();
    let errors = pose_errors(&found, &wanted);
    println!("{errors:?}, focal length {:.4} of the width\n{report:#?}", focal(&refiner, &set));
    assert_eq!(report.frames_tied, set.frames.len());
    let true_focal = f64::from(truth.frames[0].view.intrinsics.fx) / 640.0;
    assert!((focal(&refiner, &set) / true_focal - 1.0).abs() < 0.015);
    assert!(errors.aligned_position < 0.3 && errors.aligned_angle < 0.25, "{errors:?}");
}
