//! Promises on a made-up survey: what becomes of pictures that do not say where they were taken, and what surveyed points make of
//! any.
#![allow(clippy::unwrap_used)] // a test may

use config::refine::RefineSettings;
use glam::{DQuat, DVec2, DVec3};
use models::camera::{Pose, PoseSigma, View};
use models::refine::{ControlPoint, RefineReport, Refiner};
use pose_errors::PoseErrors;
use survey::*;

#[path = "support/pose_errors.rs"]
mod pose_errors;

#[path = "support/survey.rs"]
mod survey;

const UNKNOWN: PoseSigma = PoseSigma { position_m: [f32::INFINITY; 3], rotation_rad: [f32::INFINITY; 3] };

/// Five points of the ground, marked to a pixel in every picture that shows them.
fn control(survey: &mut Survey) -> Vec<ControlPoint> {
    let places = [[0.0, 0.0, 1.0], [60.0, 0.0, -2.0], [0.0, 28.0, 2.0], [60.0, 28.0, 0.0], [30.0, 14.0, 2.5]];
    let mut points = Vec::new();
    for (k, place) in places.into_iter().map(DVec3::from_array).enumerate() {
        let mut marks = Vec::new();
        for (i, pose) in survey.truth.iter().enumerate() {
            let q = pose.rotation.conjugate() * (place - pose.center);
            let noise = DVec2::new(normal(&mut survey.rng), normal(&mut survey.rng)) * 0.5;
            let at = q.truncate() / q.z * 400.0 + DVec2::new(320.0, 240.0) + noise;
            if at.x > 0.0 && at.y > 0.0 && at.x < 640.0 && at.y < 480.0 {
                marks.push((name(i), at.as_vec2().to_array()));
            }
        }
        assert!(marks.len() > 2);
        points.push(ControlPoint { name: format!("p{k}"), place, sigma_m: DVec3::splat(0.02), marks });
    }
    points
}

/// Telemetry is off by metres for all alike, as plain GPS is.
fn shifted(seed: u64) -> Survey {
    let mut survey = Survey::new(seed);
    survey.telemetry.iter_mut().for_each(|p| p.center += DVec3::new(1.8, -1.2, 2.6));
    survey
}

fn with_control(survey: &mut Survey, points: Vec<ControlPoint>) -> (PoseErrors, RefineReport) {
    let (mut refiner, _) = survey.fly(&RefineSettings { solve_seconds: 60.0, ..Default::default() });
    refiner.set_control(points);
    let report = refiner.solve().unwrap();
    (survey.errors(&refiner).1, report)
}

#[test]
fn surveyed_points_bring_poses_from_metres_to_centimetres_and_say_how_far_they_are_off() {
    let without = with_control(&mut shifted(3), Vec::new()).0;
    let mut survey = shifted(3);
    let points = control(&mut survey);
    let (with, report) = with_control(&mut survey, points);
    assert!(without.position > 2.0, "{without:?}");
    // What is left is a tilt: the height of a point marked to half a pixel is known to a decimetre or two.
    assert!(with.position < 0.15 && with.angle < 0.2, "{with:?}");
    assert_eq!(report.control.len(), 5);
    for r in &report.control {
        let off = DVec3::from_array(r.off_m).length();
        assert!(r.views > 2 && off < 0.06 && r.error_px > 0.05 && r.error_px < 1.5, "{r:?}");
    }
}

#[test]
fn a_point_surveyed_wrongly_or_marked_in_the_wrong_place_does_not_bend_the_rest() {
    let mut survey = shifted(4);
    let mut points = control(&mut survey);
    points[1].place += DVec3::new(4.0, 0.0, -3.0);
    points[2].marks[0].1 = [20.0, 30.0];
    points[3].marks.truncate(1);
    points.push(ControlPoint { marks: vec![("nobody.jpg".into(), [1.0, 2.0])], ..points[0].clone() });
    let marks = points[2].marks.len();
    let (errors, report) = with_control(&mut survey, points);
    // Three good points are left, on one side of the survey.
    assert!(errors.position < 0.4, "{errors:?}");
    assert!(DVec3::from_array(report.control[1].off_m).length() > 3.0, "{:?}", report.control[1]);
    assert_eq!((report.control[2].views, report.control[3].views, report.control[5].views), (marks - 1, 0, 0));
}

/// As a card without GPS is settled, with one picture of something else.
fn from_nothing(survey: &mut Survey, control: Vec<ControlPoint>) -> Refiner {
    let settings =
        RefineSettings { solve_seconds: 60.0, mount_sigma_deg: 0.0, delay_sigma_s: 0.0, ..Default::default() };
    let mut refiner = Refiner::without_network(&settings).unwrap();
    let nowhere = Pose { rotation: DQuat::from_xyzw(1.0, 0.0, 0.0, 0.0), center: DVec3::new(0.0, 0.0, 50.0) };
    let view = View { intrinsics: LENS, pose: nowhere };
    for i in 0..survey.truth.len() {
        let features = survey.features(&survey.truth[i].clone());
        refiner.add_features(&name(i), time(i), &view, &UNKNOWN, features).unwrap();
    }
    refiner.add_features("else.jpg", time(99), &view, &UNKNOWN, noise_features(7)).unwrap();
    refiner.set_control(control);
    let placed = refiner.bootstrap().unwrap();
    assert!(placed.placed >= 12 && placed.start.is_some(), "{placed:?}");
    for _ in 0..2 {
        refiner.solve().unwrap();
        refiner.relink().unwrap();
    }
    refiner.solve().unwrap();
    refiner
}

#[test]
fn a_survey_without_positions_is_right_up_to_a_similarity_and_what_shows_something_else_is_not_tied() {
    let mut survey = Survey::new(5);
    let refiner = from_nothing(&mut survey, Vec::new());
    assert!((0..survey.truth.len()).all(|i| refiner.is_tied(&name(i))) && !refiner.is_tied("else.jpg"));
    assert!(!refiner.is_fixed());
    let errors = survey.errors(&refiner).1;
    assert!(errors.aligned_position < 0.15 && errors.aligned_angle < 0.15, "{errors:?}");
}

#[test]
fn surveyed_points_give_a_survey_without_positions_its_place_heading_and_scale() {
    let mut survey = Survey::new(6);
    let points = control(&mut survey);
    let refiner = from_nothing(&mut survey, points.clone());
    assert!(refiner.is_fixed());
    let errors = survey.errors(&refiner).1;
    assert!(errors.position < 0.15 && errors.angle < 0.15 && (errors.scale - 1.0).abs() < 0.003, "{errors:?}");
    // Two points leave it turning about the line between them.
    let refiner = from_nothing(&mut survey, points[..2].to_vec());
    assert!(!refiner.is_fixed());
}
