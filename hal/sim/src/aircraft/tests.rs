//! Promises of the simulated flight.

use super::super::survey::{SurveySettings, Waypoint, lines};
use super::*;

fn pitch_roll(q: DQuat) -> (f64, f64) {
    let (_, pitch, roll) = q.to_euler(glam::EulerRot::ZYX);
    (pitch, roll)
}

const ORIGIN: Geodetic = Geodetic { lat_deg: 47.0, lon_deg: 8.0, alt_m: 400.0 };

const STRAIGHT_DOWN: Manner = Manner { speed_ms: 5.0, gimbal_pitch_deg: -90.0 };

fn flight(wrong: &Imperfections, seed: u64) -> Flight {
    let region = [DVec2::new(-30.0, -30.0), DVec2::new(30.0, -30.0), DVec2::new(30.0, 30.0), DVec2::new(-30.0, 30.0)];
    let legs = Leg::of_lines(&lines(&region, DVec2::new(50.0, 40.0), &SurveySettings::default()), 40.0);
    fly(ORIGIN, &legs, STRAIGHT_DOWN, wrong, "IMG_", seed).expect("a flight")
}

#[test]
fn a_seed_fixes_the_flight_and_another_changes_it() {
    let wrong = Imperfections::default();
    let print = |f: &Flight| format!("{:?} {:?}", f.exposures, f.reported.at(33.3));
    assert_eq!(print(&flight(&wrong, 1)), print(&flight(&wrong, 1)));
    assert_ne!(print(&flight(&wrong, 1)), print(&flight(&wrong, 2)));
}

#[test]
fn every_planned_picture_is_taken_on_its_line_at_height() {
    let flight = flight(&Imperfections::default(), 5);
    assert_eq!(flight.exposures.len(), 21);
    for e in &flight.exposures {
        let at = flight.truth.at(e.middle_s);
        assert!((at.position.z - 40.0).abs() < 1.0 && at.position.truncate().abs().max_element() < 33.0, "{at:?}");
        let across = at.position.x.min(at.position.y).abs();
        assert!(across < 35.0 && e.middle_s > e.trigger_s && e.ready_s > e.middle_s);
    }
}

#[test]
fn a_perfect_aircraft_reports_the_truth_and_a_real_one_is_wrong_as_told() {
    let perfect = flight(&Imperfections::none(), 1);
    for k in 0..50 {
        let (a, b) = (perfect.truth.at(f64::from(k)), perfect.reported.at(f64::from(k)));
        assert!((a.position - b.position).length() < 1e-9 && angle_between(a.gimbal, b.gimbal) < 1e-7);
    }
    let wrong = Imperfections { gps_bias_m: 1.0, yaw_bias_deg: 2.0, ..Imperfections::default() };
    let mut errors = Vec::new();
    for seed in 0..20 {
        let f = flight(&wrong, seed);
        let (a, b) = (f.truth.at(30.0), f.reported.at(30.0));
        errors
            .push(((a.position - b.position).truncate().length(), angle_between(a.attitude, b.attitude).to_degrees()));
    }
    let mean = errors.iter().fold((0.0, 0.0), |s, e| (s.0 + e.0 / 20.0, s.1 + e.1 / 20.0));
    assert!((0.5..2.5).contains(&mean.0) && (0.7..4.0).contains(&mean.1), "{mean:?}");
}

#[test]
fn it_leans_into_the_wind_and_into_acceleration() {
    let calm = flight(&Imperfections::none(), 1);
    // Hovering in no wind is level; gaining speed lowers the nose.
    let (pitch, roll) = pitch_roll(calm.truth.at(1.0).attitude);
    assert!(pitch.abs() < 1e-6 && roll.abs() < 1e-6);
    let (pitch, _) = pitch_roll(calm.truth.at(HOVER + 1.0).attitude);
    assert!(pitch < -0.05, "{pitch}");
    let windy = flight(&Imperfections { wind_ms: [0.0, 8.0], ..Imperfections::none() }, 1);
    let thrust = windy.truth.at(1.0).attitude * DVec3::NEG_Z; // NED
    assert!(thrust.x < -0.05, "wind towards north is met by leaning south: {thrust}");
}

#[test]
fn pictures_along_a_route_are_as_far_apart_as_asked_also_around_its_corners() {
    let waypoint =
        |x, y, every_m| Waypoint { position: DVec3::new(x, y, 40.0), yaw_deg: None, picture: false, every_m };
    let waypoints = vec![
        waypoint(0.0, 0.0, Some(10.0)),
        waypoint(95.0, 0.0, Some(10.0)),
        waypoint(95.0, 30.0, None),
        waypoint(0.0, 30.0, Some(20.0)),
        waypoint(0.0, 90.0, None),
    ];
    let route = Route { waypoints, speed_ms: 5.0, gimbal_pitch_deg: -90.0 };
    let manner = Manner { speed_ms: 5.0, gimbal_pitch_deg: -90.0 };
    let flight = fly(ORIGIN, &Leg::of_route(&route), manner, &Imperfections::none(), "IMG_", 3).expect("a flight");
    // 0 to 90; 5, 15 and 25 of the second leg; 0 to 60 of the last.
    assert_eq!(flight.exposures.len(), 10 + 3 + 4);
    let places: Vec<DVec3> = flight.exposures.iter().map(|e| flight.truth.at(e.middle_s).position).collect();
    for (taken, wanted) in [(0, [0.0, 0.0]), (9, [90.0, 0.0]), (10, [95.0, 5.0]), (13, [0.0, 30.0]), (16, [0.0, 90.0])]
    {
        assert!((places[taken] - DVec3::new(wanted[0], wanted[1], 40.0)).length() < 1.5, "{taken}: {}", places[taken]);
    }
}

#[test]
fn a_route_is_flown_to_each_waypoint_with_its_height_and_heading_and_a_picture_where_one_is_asked_for() {
    let waypoint =
        |x, y, z, yaw_deg, picture| Waypoint { position: DVec3::new(x, y, z), yaw_deg, picture, every_m: None };
    let waypoints = vec![
        waypoint(0.0, 0.0, 40.0, None, true),
        waypoint(30.0, 0.0, 40.0, Some(0.0), true),
        waypoint(30.0, 0.0, 55.0, None, false),
        waypoint(30.0, 20.0, 50.0, Some(-90.0), true),
        waypoint(30.0, 20.0, 50.0, Some(90.0), true),
    ];
    let asked: Vec<Waypoint> = waypoints.iter().filter(|w| w.picture).copied().collect();
    let route = Route { waypoints, speed_ms: 5.0, gimbal_pitch_deg: -60.0 };
    let manner = Manner { speed_ms: route.speed_ms, gimbal_pitch_deg: route.gimbal_pitch_deg };
    for (wrong, off) in [(Imperfections::none(), 0.5), (Imperfections::default(), 2.0)] {
        let flight = fly(ORIGIN, &Leg::of_route(&route), manner, &wrong, "IMG_", 3).expect("a flight");
        assert_eq!(flight.exposures.len(), asked.len());
        for (exposure, asked) in flight.exposures.iter().zip(&asked) {
            let at = flight.truth.at(exposure.middle_s);
            assert!((at.position - asked.position).length() < off, "{at:?} {asked:?}");
            let (yaw, pitch, _) = at.gimbal.to_euler(glam::EulerRot::ZYX);
            assert!((pitch.to_degrees() + 60.0).abs() < 2.0, "{pitch}");
            if let Some(wanted) = asked.yaw_deg {
                assert!((yaw.to_degrees() - wanted).abs() < 4.0, "{yaw} {asked:?}");
            }
        }
    }
    assert!(fly(ORIGIN, &[], manner, &Imperfections::none(), "IMG_", 3).is_none());
}
