//! Promises of the refinement in flight on a made-up survey whose truth is known: a new key frame is placed at a cost that does not
//! grow with those before it, nearly as well as by adjusting all of them.
#![allow(clippy::unwrap_used)] // a test may

use config::refine::RefineSettings;
use glam::DVec3;
use models::camera::View;
use models::refine::{NearReport, Refiner};
use pose_errors::PoseErrors;
use survey::*;

#[path = "support/pose_errors.rs"]
mod pose_errors;

#[path = "support/survey.rs"]
mod survey;

/// A block of `lines` lines back and forth.
fn block(lines: usize) -> Survey {
    let mut survey = Survey::new(11);
    let (points, descriptors) = (survey.points.clone(), survey.descriptors.clone());
    (survey.points, survey.descriptors) = (Vec::new(), Vec::new());
    // The world of three lines again and again to the north, each time with descriptors of its own.
    for k in 0..lines.div_ceil(3) {
        survey.points.extend(points.iter().map(|p| *p + DVec3::Y * (110.0 * k as f64)));
        let strange = |d: &[f32; 64]| {
            std::array::from_fn(|i| d[(i * 7 + k * 11) % 64] * if (i + k) % 3 == 0 { -1.0 } else { 1.0 })
        };
        survey.descriptors.extend(descriptors.iter().map(strange));
    }
    survey.truth.clear();
    for line in 0..lines {
        for k in 0..6 {
            let back = line % 2 == 1;
            let x = f64::from(if back { 5 - k } else { k }) * 12.0;
            let jitter = vector(&mut survey.rng, 1.0);
            survey
                .truth
                .push(looking_down(DVec3::new(x, line as f64 * 14.0, 50.0) + jitter, if back { -1.57 } else { 1.57 }));
        }
    }
    survey.telemetry = survey.truth.clone();
    for p in &mut survey.telemetry {
        p.rotation = (p.rotation * glam::DQuat::from_scaled_axis(vector(&mut survey.rng, 0.03))).normalize();
        p.center += vector(&mut survey.rng, 0.5);
    }
    survey
}

/// Flies it; all key frames are adjusted whenever there are `growth` times as many as when they last were.
fn fly(survey: &mut Survey, growth: f64) -> (Refiner, Vec<NearReport>) {
    let mut refiner = Refiner::without_network(&RefineSettings { solve_seconds: 120.0, ..Default::default() }).unwrap();
    let (mut reports, mut whole) = (Vec::new(), 0);
    for i in 0..survey.truth.len() {
        let features = survey.features(&survey.truth[i].clone());
        let view = View { intrinsics: LENS, pose: survey.telemetry[i] };
        refiner.add_features(&name(i), time(i), &view, &SIGMA, features).unwrap();
        if (i + 1) as f64 >= growth * whole as f64 {
            whole = i + 1;
            refiner.solve().unwrap();
        } else {
            reports.push(refiner.solve_near().unwrap());
        }
    }
    (refiner, reports)
}

fn errors(survey: &Survey, refiner: &Refiner) -> PoseErrors {
    survey.errors(refiner).1
}

#[test]
fn a_new_key_frame_costs_the_same_however_many_there_are() {
    let mut survey = block(24);
    let (refiner, reports) = fly(&mut survey, 1.34);
    let tenth = |from: usize| {
        let part = &reports[from..from + reports.len() / 10];
        let mean = |of: &dyn Fn(&NearReport) -> usize| part.iter().map(of).sum::<usize>() as f64 / part.len() as f64;
        (mean(&|r| r.observations), mean(&|r| r.adjusted_frames), mean(&|r| r.moved.len()))
    };
    let (early, late) = (tenth(reports.len() / 5), tenth(reports.len() - reports.len() / 10));
    println!("{early:?} {late:?}, last {:?}", reports.last());
    assert!(early.0 > 300.0 && early.1 > 3.0, "{early:?}");
    assert!(late.0 < 1.25 * early.0 && late.1 < 1.25 * early.1 && late.2 < 1.25 * early.2, "{early:?} {late:?}");
    assert!(reports.iter().all(|r| r.adjusted_frames <= 7 && r.moved.len() <= 7), "one new one and six neighbours");
    assert!((0..survey.truth.len()).all(|i| refiner.is_tied(&name(i))));
}

#[test]
fn poses_in_flight_are_nearly_those_of_an_adjustment_of_all() {
    let mut survey = block(9);
    let (mut refiner, reports) = fly(&mut survey, 1.34);
    assert!(reports.len() > 30);
    let flying = errors(&survey, &refiner);
    refiner.solve().unwrap();
    let landed = errors(&survey, &refiner);
    assert!(flying.aligned_angle < 0.12 && flying.aligned_position < 0.12, "{flying:?}");
    assert!(landed.aligned_angle < 0.08 && landed.aligned_position < 0.08, "{landed:?}");
}

#[test]
fn the_same_flight_twice_gives_the_same_bits() {
    let flown = || {
        let mut survey = block(6);
        let (refiner, _) = fly(&mut survey, 1.34);
        (0..survey.truth.len()).map(|i| refiner.pose(&name(i)).unwrap()).collect::<Vec<_>>()
    };
    assert_eq!(flown(), flown());
}

#[test]
fn a_gps_position_that_jumped_is_overruled_at_once_and_no_other_key_frame_suffers() {
    let mut survey = block(6);
    let jumped = 27;
    survey.telemetry[jumped].center += DVec3::new(9.0, -6.0, 14.0);
    let (refiner, _) = fly(&mut survey, 1.34);
    for i in 0..survey.truth.len() {
        let off = (refiner.pose(&name(i)).unwrap().center - survey.truth[i].center).length();
        assert!(off < 0.8, "key frame {i}: {off}");
    }
}

#[test]
fn key_frames_without_a_link_follow_telemetry_and_nothing_moves_for_them() {
    let mut survey = block(3);
    let (mut refiner, _) = fly(&mut survey, 1.34);
    let before: Vec<_> = (0..18).map(|i| refiner.pose(&name(i)).unwrap()).collect();
    let far = looking_down(DVec3::new(5000.0, 0.0, 50.0), 0.0);
    let view = View { intrinsics: LENS, pose: far };
    refiner.add_features("far.jpg", time(90), &view, &SIGMA, noise_features(5)).unwrap();
    let report = refiner.solve_near().unwrap();
    assert_eq!((report.frames, report.adjusted_frames, report.moved), (1, 0, vec!["far.jpg".to_owned()]));
    assert!((0..18).all(|i| refiner.pose(&name(i)).unwrap() == before[i]));
    assert!((refiner.pose("far.jpg").unwrap().center - far.center).length() < 1.0);
    assert_eq!(refiner.solve_near().unwrap().frames, 0, "it was looked at");
}
