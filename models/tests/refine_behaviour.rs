//! Promises of the pose refinement on a made-up survey whose truth is known: what telemetry gets wrong is mended
//! where the pictures can tell, and no input, however bad, makes a pose worse than telemetry's or not a number.
#![allow(clippy::unwrap_used)] // a test may

use config::refine::RefineSettings;
use glam::{DQuat, DVec3};
use models::camera::{Intrinsics, Pose, PoseSigma, View};
use models::onnx::features::Features;
use models::refine::{RefineError, Refiner};
use pose_errors::angle_deg;
use survey::*;

#[path = "support/pose_errors.rs"]
mod pose_errors;

#[path = "support/survey.rs"]
mod survey;

#[test]
fn metres_and_degrees_become_centimetres_and_hundredths_of_a_degree() {
    let mut survey = Survey::new(1);
    let (refiner, report) = survey.fly(&RefineSettings::default());
    let (before, after) = survey.errors(&refiner);
    assert!(before.aligned_angle > 2.0 && before.aligned_position > 0.6);
    assert!(after.aligned_angle < 0.08 && after.aligned_position < 0.08, "{after:?}");
    assert_eq!((report.frames_tied, report.rotations_refused, report.replaced_frames), (18, 0, 0));
    assert!(report.reprojection_rms_px < 1.0 && report.points > 500, "{report:#?}");
    let (near, far) = refiner.depth_range(&name(0)).unwrap();
    assert!(near > 30.0 && near < 50.0 && far > 50.0 && far < 90.0, "{near} {far}");
    // Two key frames hold nearly all points at the right height.
    let low = refiner.sparse_points().iter().filter(|p| p.position[2].abs() < 4.0).count();
    assert!(low * 20 > refiner.sparse_points().len() * 19);
}

#[test]
fn mount_and_delay_are_estimated_when_lines_go_both_ways() {
    let mut survey = Survey::new(2);
    let mount = DQuat::from_scaled_axis(DVec3::new(0.03, -0.02, 0.035));
    for i in 0..18 {
        let speed = if (i / 6) % 2 == 1 { -SPEED } else { SPEED };
        // Reported camera axes lack the mount's turn; reported positions are 0.3 s old.
        survey.telemetry[i].rotation = (survey.telemetry[i].rotation * mount.conjugate()).normalize();
        survey.telemetry[i].center.x -= 0.3 * speed;
    }
    let (refiner, report) = survey.fly(&RefineSettings::default());
    let s = &report.shared;
    println!("{s:?}");
    assert!(s.delay_estimated && (s.delay_s - 0.3).abs() < 0.12);
    assert!(s.mount_estimated.iter().all(|e| *e));
    for (found, true_deg) in s.mount_deg.iter().zip([1.72, -1.15, 2.0]) {
        assert!((found - true_deg).abs() < 1.2, "{found} {true_deg}");
    }
    let (_, after) = survey.errors(&refiner);
    assert!(after.aligned_angle < 0.1 && after.position < 0.6);
}

#[test]
fn a_focal_length_is_estimated_beside_an_aspect_that_a_rolling_shutter_causes_and_never_without_it() {
    let stretched = |aspect_sigma| {
        let mut survey = Survey::new(2).crossed();
        survey.lens = Intrinsics { fx: 416.4, fy: 415.4, cx: 320.4, ..LENS };
        let settings = RefineSettings { focal_sigma: 0.1, aspect_sigma, principal_sigma: 0.02, ..Default::default() };
        let (refiner, report) = survey.fly(&settings);
        let (_, after) = survey.errors(&refiner);
        println!("{:?}", report.shared);
        (refiner.intrinsics(&name(0)).unwrap(), report.shared, after)
    };
    let (lens, shared, after) = stretched(0.005);
    assert!(shared.focal_estimated && shared.aspect_estimated);
    assert!((lens.fx / 416.4 - 1.0).abs() < 0.005 && (lens.fy / 415.4 - 1.0).abs() < 0.005, "{lens:?}");
    let (lens, shared, without) = stretched(0.0);
    assert!(!shared.aspect_estimated && shared.aspect == 1.0 && lens.fx == lens.fy, "{lens:?}");
    assert!(after.aligned_position < without.aligned_position, "{after:?} {without:?}");
}

#[test]
fn on_a_single_straight_line_the_delay_is_left_alone() {
    let mut survey = Survey::new(3);
    survey.truth.truncate(6);
    survey.telemetry.truncate(6);
    for i in 0..6 {
        survey.truth[i].center = DVec3::new(12.0 * i as f64, 0.0, 50.0);
        survey.telemetry[i].center = survey.truth[i].center + vector(&mut survey.rng, 0.3);
    }
    let (_, report) = survey.fly(&RefineSettings { focal_sigma: 0.02, ..Default::default() });
    println!("{:?}", report.shared);
    assert!(!report.shared.delay_estimated && report.shared.delay_s == 0.0);
    assert!(report.shared.focal_scale == 1.0 || report.shared.focal_estimated);
}

#[test]
fn a_gps_height_that_jumps_by_25_metres_is_overruled_by_the_pictures() {
    let mut survey = Survey::new(4);
    survey.telemetry[8].center.z += 25.0;
    let (refiner, _) = survey.fly(&RefineSettings::default());
    let off = (refiner.pose(&name(8)).unwrap().center - survey.truth[8].center).length();
    assert!(off < 0.6, "{off}");
}

#[test]
fn heights_wrong_by_a_common_70_metres_move_the_map_and_nothing_else() {
    let mut survey = Survey::new(5);
    survey.telemetry.iter_mut().for_each(|p| p.center.z -= 70.0);
    let (refiner, report) = survey.fly(&RefineSettings::default());
    let (_, after) = survey.errors(&refiner);
    assert!(after.aligned_angle < 0.1 && after.aligned_position < 0.1);
    assert!((report.ground_m.unwrap() + 70.0).abs() < 1.5, "{:?}", report.ground_m);
}

#[test]
fn headings_turned_by_half_a_turn_are_refused_and_righted_even_on_the_first_frame() {
    let mut survey = Survey::new(6);
    for i in [0, 9] {
        survey.telemetry[i].rotation = DQuat::from_rotation_z(3.1) * survey.telemetry[i].rotation;
    }
    let (refiner, report) = survey.fly(&RefineSettings::default());
    for i in 0..18 {
        let off = angle_deg(refiner.pose(&name(i)).unwrap().rotation, survey.truth[i].rotation);
        assert!(off < 1.0, "frame {i}: {off}");
    }
    assert_eq!(report.rotations_refused, 2);
}

#[test]
fn a_duplicate_picture_lands_on_its_twin_and_a_duplicate_name_is_an_error() {
    let mut survey = Survey::new(7);
    survey.truth.insert(5, survey.truth[4]);
    let twin = Pose { center: survey.telemetry[4].center + DVec3::new(0.8, -0.5, 0.4), ..survey.telemetry[4] };
    survey.telemetry.insert(5, twin);
    let (mut refiner, report) = survey.fly(&RefineSettings::default());
    assert!(report.pairs_without_baseline >= 1);
    let (a, b) = (refiner.pose(&name(4)).unwrap(), refiner.pose(&name(5)).unwrap());
    assert!((a.center - b.center).length() < 0.15, "{}", (a.center - b.center).length());
    let view = View { intrinsics: LENS, pose: twin };
    let again = refiner.add_features(&name(5), 0, &view, &SIGMA, Features::default());
    assert!(matches!(again, Err(RefineError::Duplicate(_))));
}

#[test]
fn a_camera_that_only_turns_keeps_its_place_and_gives_no_points() {
    let mut survey = Survey::new(8);
    let here = DVec3::new(30.0, 14.0, 50.0);
    survey.truth = (0..5).map(|i| looking_down(here, f64::from(i) * 0.1)).collect();
    survey.telemetry = survey.truth.clone();
    let (refiner, report) = survey.fly(&RefineSettings::default());
    assert_eq!(report.pairs_verified, report.pairs_without_baseline);
    for i in 0..5 {
        let pose = refiner.pose(&name(i)).unwrap();
        assert!((pose.center - here).length() < 1.0, "{pose:?}");
        assert!(angle_deg(pose.rotation, survey.truth[i].rotation) < 1.5);
    }
}

#[test]
fn pictures_without_overlap_keep_their_telemetry() {
    let mut survey = Survey::new(9);
    let settings = RefineSettings::default();
    let mut refiner = Refiner::without_network(&settings).unwrap();
    for i in 0..4 {
        let pose = looking_down(DVec3::new(1000.0 * i as f64, 0.0, 50.0), 0.0);
        let features = noise_features(i);
        let view = View { intrinsics: LENS, pose };
        let report = refiner.add_features(&name(i as usize), time(i as usize), &view, &SIGMA, features).unwrap();
        assert_eq!(report.pairs_verified, 0);
        survey.truth[i as usize] = pose;
    }
    let report = refiner.solve().unwrap();
    assert_eq!((report.frames_linked, report.points), (0, 0));
    for i in 0..4 {
        let pose = refiner.pose(&name(i)).unwrap();
        assert!((pose.center - survey.truth[i].center).length() < 1e-6);
        assert!(angle_deg(pose.rotation, survey.truth[i].rotation) < 1e-6);
        assert!(refiner.depth_range(&name(i)).is_none() && !refiner.is_tied(&name(i)));
    }
}

#[test]
fn all_wrong_matches_leave_telemetry_as_it_is() {
    let survey = Survey::new(10);
    let mut refiner = Refiner::without_network(&RefineSettings::default()).unwrap();
    for i in 0..8 {
        let view = View { intrinsics: LENS, pose: survey.telemetry[i] };
        refiner.add_features(&name(i), time(i), &view, &SIGMA, noise_features(i as u64)).unwrap();
    }
    let report = refiner.solve().unwrap();
    assert_eq!(report.pairs_verified, 0);
    for i in 0..8 {
        assert!((refiner.pose(&name(i)).unwrap().center - survey.telemetry[i].center).length() < 1e-6);
    }
}

#[test]
fn poses_that_are_not_numbers_are_refused_counted_and_leave_no_trace() {
    let mut survey = Survey::new(11);
    let (mut refiner, _) = survey.fly(&RefineSettings::default());
    let before = refiner.pose(&name(3)).unwrap();
    let good = survey.telemetry[0];
    let bad = [
        (Pose { center: DVec3::new(f64::NAN, 0.0, 0.0), ..good }, SIGMA),
        (Pose { rotation: DQuat::from_xyzw(0.0, 0.0, 0.0, 0.0), ..good }, SIGMA),
        (Pose { rotation: DQuat::from_xyzw(f64::NAN, 0.0, 0.0, 1.0), ..good }, SIGMA),
        (good, PoseSigma { position_m: [0.0; 3], ..SIGMA }),
        (good, PoseSigma { rotation_rad: [f32::NAN; 3], ..SIGMA }),
    ];
    for (pose, sigma) in bad {
        let view = View { intrinsics: LENS, pose };
        let result = refiner.add_features("bad", 0, &view, &sigma, noise_features(1));
        assert!(matches!(result, Err(RefineError::Invalid { .. })));
    }
    let report = refiner.solve().unwrap();
    assert_eq!((report.frames, report.frames_invalid), (18, 5));
    assert!((refiner.pose(&name(3)).unwrap().center - before.center).length() < 0.05);
    assert!(refiner.pose("bad").is_none());
}

#[test]
fn fewer_than_three_points_and_fewer_than_two_frames_are_no_problem() {
    let survey = Survey::new(12);
    let mut refiner = Refiner::without_network(&RefineSettings::default()).unwrap();
    assert_eq!(refiner.solve().unwrap().frames, 0);
    for i in 0..3 {
        let mut features = noise_features(1);
        features.keypoints.truncate(2);
        features.descriptors.truncate(128);
        let view = View { intrinsics: LENS, pose: survey.telemetry[i] };
        refiner.add_features(&name(i), 0, &view, &SIGMA, features).unwrap();
        assert_eq!(refiner.solve().unwrap().points, 0);
        assert!(refiner.pose(&name(i)).unwrap().center.is_finite());
    }
}

#[test]
fn telemetry_without_any_certainty_of_rotation_is_still_refined() {
    let mut survey = Survey::new(13);
    let settings = RefineSettings::default();
    let mut refiner = Refiner::without_network(&settings).unwrap();
    let sigma = PoseSigma { position_m: [1.0; 3], rotation_rad: [f32::INFINITY; 3] };
    for i in 0..18 {
        let features = survey.features(&survey.truth[i].clone());
        let view = View { intrinsics: LENS, pose: survey.telemetry[i] };
        refiner.add_features(&name(i), time(i), &view, &sigma, features).unwrap();
    }
    refiner.solve().unwrap();
    let (_, after) = survey.errors(&refiner);
    assert!(after.aligned_angle < 0.15 && after.aligned_position < 0.15);
}

#[test]
fn caps_hold_and_what_they_leave_out_is_counted() {
    let mut survey = Survey::new(14);
    let settings = RefineSettings {
        max_keyframes: 10,
        max_features: 300,
        max_tracks: 100,
        tracks_per_keyframe: 0,
        max_observations: 500,
        ..Default::default()
    };
    let mut refiner = Refiner::without_network(&settings).unwrap();
    for i in 0..18 {
        let features = survey.features(&survey.truth[i].clone());
        let view = View { intrinsics: LENS, pose: survey.telemetry[i] };
        let result = refiner.add_features(&name(i), time(i), &view, &SIGMA, features);
        assert_eq!(matches!(result, Err(RefineError::Full { .. })), i >= 10);
    }
    let report = refiner.solve().unwrap();
    assert_eq!((report.frames, report.frames_over_cap), (10, 8));
    assert!(report.adjusted_tracks <= 100 && report.observations <= 500 && report.observations_over_cap > 0);
    assert!(refiner.bytes() < 1 << 20, "{}", refiner.bytes());
}

#[test]
fn solving_after_every_key_frame_ends_where_solving_once_does_and_is_repeatable() {
    let fly = |every: bool| {
        let mut survey = Survey::new(15);
        let mut refiner = Refiner::without_network(&RefineSettings::default()).unwrap();
        for i in 0..18 {
            let features = survey.features(&survey.truth[i].clone());
            let view = View { intrinsics: LENS, pose: survey.telemetry[i] };
            refiner.add_features(&name(i), time(i), &view, &SIGMA, features).unwrap();
            if every {
                refiner.solve().unwrap();
            }
        }
        refiner.solve().unwrap();
        let (_, after) = survey.errors(&refiner);
        (after, refiner.pose(&name(17)).unwrap())
    };
    let (step, once, again) = (fly(true), fly(false), fly(false));
    assert!(step.0.aligned_angle < 0.1 && step.0.aligned_position < 0.1);
    assert_eq!(once.1, again.1, "the same input gives the same bits");
}
