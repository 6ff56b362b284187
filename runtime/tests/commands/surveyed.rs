//! An area dealt to a fleet, and what is refused.

use std::path::Path;

use config::mission::Mission;
use config::survey::SurveySettings;
use geometry::geodesy::{EnuFrame, Geodetic};
use glam::DVec2;
use models::cloud::GaussianCloud;
use models::formats::model::{self, ModelHeader};

use super::{dgtr, error_line};

/// 300 m by 220 m.
const FIELD: &str =
    r#"{"type":"Polygon","coordinates":[[[8.5,47.4],[8.504,47.4],[8.504,47.402],[8.5,47.402],[8.5,47.4]]]}"#;

fn survey(folder: &Path, area: &str, more: &[&str]) -> std::process::Output {
    let path = folder.join("area");
    std::fs::write(&path, area).unwrap();
    let (path, out) = (path.to_string_lossy().into_owned(), folder.join("out").to_string_lossy().into_owned());
    let usual = ["survey", &path, "--out", &out, "--picture", "4000x3000", "--fov-deg", "60"];
    let distance = if more.contains(&"--gsd") { &[][..] } else { &["--gsd", "2"] };
    dgtr(&[&usual[..], distance, more].concat())
}

#[test]
fn a_field_becomes_a_mission_plans_a_figure_and_a_table() {
    let folder = tempfile::tempdir().unwrap();
    let done = survey(folder.path(), FIELD, &["--aircraft", "2", "--name", "field", "--home-height", "430"]);
    let (said, told) = (String::from_utf8_lossy(&done.stdout), String::from_utf8_lossy(&done.stderr));
    assert!(done.status.success(), "{told}");
    assert!(
        said.contains("take-off and landing at 47.4") && said.contains("a1.plan") && said.contains("6.7 ha"),
        "{said}"
    );
    let out = folder.path().join("out");
    let mission = Mission::read(&out.join("mission.toml")).unwrap();
    assert_eq!((mission.name.as_str(), mission.aircraft.len(), mission.origin.alt_m), ("field", 2, 430.0));
    for name in ["a1.plan", "a2.plan", "survey.svg", "survey.csv"] {
        assert!(out.join(name).is_file(), "{name}: {said}");
    }
    // Whoever has a mission keeps it.
    let again = survey(folder.path(), FIELD, &[]);
    assert!(again.status.code() == Some(2) && error_line(&again).contains("choose another folder with --out"));
}

#[test]
fn what_cannot_be_surveyed_is_refused_in_one_line_and_nothing_is_written() {
    let folder = tempfile::tempdir().unwrap();
    let crossed =
        FIELD.replace("[8.504,47.4],[8.504,47.402],[8.5,47.402]", "[8.504,47.402],[8.504,47.4],[8.5,47.4015]");
    let two = format!(r#"{{"type":"GeometryCollection","features":[{FIELD},{FIELD}]}}"#);
    let large = FIELD.replace("8.504", "9.5");
    let girdle = FIELD.replace("8.504", "-171.49");
    for (area, more, word) in [
        (crossed.as_str(), &[][..], "sides that cross each other"),
        (&two, &[], "holds 2 polygons"),
        (&large, &[], "at most 100 km² within 20 km"),
        (&girdle, &[], "area"),
        ("", &[], "neither GeoJSON"),
        (FIELD, &["--aircraft", "65"], "--aircraft 65: must be 1 to 64"),
        (FIELD, &["--aircraft", "0"], "--aircraft 0: must be 1 to 64"),
        (FIELD, &["--gsd", "20"], "--highest"),
        (FIELD, &["--gsd", "nan"], "--gsd NaN"),
        (FIELD, &["--side-overlap", "1"], "--side-overlap 1: must be 0 to 0.95"),
        (FIELD, &["--wind", "16"], "--wind 16"),
        (FIELD, &["--speed", "nan"], "--speed NaN"),
        (FIELD, &["--speed", "900"], "--speed 900"),
        (FIELD, &["--home-height", "nan"], "--home-height NaN: must be -10000 to 10000 m"),
        (FIELD, &["--interval", "60"], "--interval 60"),
        (FIELD, &["--clearance", "0"], "--clearance 0: must be 1 to 500 m"),
        (FIELD, &["--clearance", "nan"], "--clearance NaN"),
        (FIELD, &["--endurance", "3"], "raise --endurance"),
        (FIELD, &["--endurance", "20,10"], "once for each of 1 aircraft"),
        (FIELD, &["--take-off", "47.4,8.5", "--take-off", "47.4,8.5"], "--take-off was given 2 times"),
        (FIELD, &["--take-off", "7.4,8.5"], "near the area"),
        (FIELD, &["--take-off=-47.401,-171.498"], "near the area"),
        (FIELD, &["--terrain", "none.tif"], "none.tif"),
        (FIELD, &["--name", "a/b"], "name"),
    ] {
        let refused = survey(folder.path(), area, more);
        let line = error_line(&refused);
        assert!(refused.status.code() == Some(2) && line.contains(word), "{more:?}: {line}");
        assert!(!folder.path().join("out").exists(), "{more:?}");
    }
}

/// A square of 220 m in which a hole is left out, across the antimeridian.
#[test]
fn an_area_across_the_antimeridian_is_flown_there_and_its_hole_is_flown_round() {
    const HALF: f64 = 0.0004;
    let folder = tempfile::tempdir().unwrap();
    let ring = |half: f64| {
        let corners = [[-half, -half], [half, -half], [half, half], [-half, half], [-half, -half]];
        corners.map(|[x, y]| [if x < 0.0 { 180.0 + x } else { x - 180.0 }, -17.0 + y])
    };
    let area = format!(r#"{{"type":"Polygon","coordinates":[{:?},{:?}]}}"#, ring(0.001), ring(HALF));
    let done = survey(folder.path(), &area, &["--clearance", "15"]);
    let (said, told) = (String::from_utf8_lossy(&done.stdout), String::from_utf8_lossy(&done.stderr));
    assert!(done.status.success() && said.contains("holes of the area are flown round, 15 m off, by "), "{said}{told}");
    let mission = Mission::read(&folder.path().join("out/mission.toml")).unwrap();
    assert!(
        mission.origin.lon_deg.abs() > 179.99 && (mission.origin.lat_deg + 17.0).abs() < 1e-6,
        "{:?}",
        mission.origin
    );
    let plan = models::formats::flight_plan::read(&folder.path().join("out/a1.plan")).unwrap();
    assert!(plan.waypoints.iter().all(|w| w.position.lon_deg.abs() > 179.99), "{plan:?}");
    let frame = EnuFrame::new(mission.origin);
    let high = frame.to_enu(Geodetic { lat_deg: -17.0 + HALF, lon_deg: -180.0 + HALF, alt_m: 0.0 }).truncate();
    let ways = std::iter::once(plan.home).chain(plan.waypoints.iter().map(|w| w.position)).chain(plan.landing);
    let ways: Vec<DVec2> = ways.map(|at| frame.to_enu(at).truncate()).collect();
    for (a, b) in ways.iter().zip(&ways[1..]) {
        for p in (0..=100).map(|k| a.lerp(*b, f64::from(k) / 100.0)) {
            let off = (p - p.clamp(-high, high)).length();
            assert!(off > 14.98, "{off} m from the hole, from {a} to {b}");
        }
    }
}

/// Whoever stands in the field types the folder of the ground, and nothing else.
#[test]
fn what_is_left_is_planned_as_the_first_survey_was_unless_it_is_said_again() {
    let folder = tempfile::tempdir().unwrap();
    let at = |name: &str| folder.path().join(name);
    let first =
        ["--aircraft", "2", "--wind", "7", "--endurance", "30,20", "--side-overlap", "0.7", "--home-height", "430"];
    let done = survey(folder.path(), FIELD, &[&first[..], &["--take-off", "47.3999,8.5"]].concat());
    assert!(done.status.success(), "{}", String::from_utf8_lossy(&done.stderr));
    let flown = Mission::read(&at("out/mission.toml")).unwrap();
    let planned = flown.survey.clone().expect("[survey]");
    assert_eq!((planned.gsd_cm, planned.wind_m_s, planned.side_overlap, planned.clearance_m), (2.0, 7.0, 0.7, 10.0));
    assert_eq!((&planned.endurance_min, &planned.take_off), (&vec![30.0, 20.0], &vec![[47.3999, 8.5]; 2]));
    // The second aircraft did all of its ground; from the first nothing came.
    let ground = at("ground").to_string_lossy().into_owned();
    let nothing = dgtr(&["survey", "--after", &ground]);
    assert!(nothing.status.code() == Some(2) && error_line(&nothing).contains("--out of dgtr serve"), "{nothing:?}");
    std::fs::create_dir_all(at("ground/received/a2")).unwrap();
    std::fs::copy(at("out/mission.toml"), at("ground/mission.toml")).unwrap();
    let header = ModelHeader {
        mission: "survey".into(),
        aircraft: "a2".into(),
        origin: Some(flown.origin),
        finished: true,
        ..ModelHeader::default()
    };
    let mut cloud = GaussianCloud::with_capacity(0, 1);
    cloud.push([0.0; 3], [-2.0; 3], [1.0, 0.0, 0.0, 0.0], 0.5, &[0.0; 3]);
    model::write(&at("ground/received/a2/model.dgtr"), &header, &cloud).unwrap();
    let done = dgtr(&["survey", "--after", &ground]);
    assert!(done.status.success(), "{}", String::from_utf8_lossy(&done.stderr));
    let said = String::from_utf8_lossy(&done.stdout).into_owned();
    assert!(
        said.contains("what a1 left is dealt to the others") && said.contains("ground-after-1/mission.toml"),
        "{said}"
    );
    assert!(said.contains("the ground goes on: dgtr serve --mission "), "{said}");
    let again = Mission::read(&at("ground-after-1/mission.toml")).unwrap();
    assert_eq!(again.aircraft.iter().map(|a| a.id.as_str()).collect::<Vec<_>>(), ["a2"]);
    let wanted = SurveySettings { endurance_min: vec![20.0], take_off: vec![[47.3999, 8.5]], ..planned.clone() };
    assert_eq!(again.survey, Some(wanted.clone()));
    let done = dgtr(&["survey", "--after", &ground, "--wind", "3", "--take-off", "47.4021,8.5"]);
    assert!(done.status.success(), "{}", String::from_utf8_lossy(&done.stderr));
    let other = Mission::read(&at("ground-after-2/mission.toml")).unwrap();
    let take_off = vec![[47.4021, 8.5]];
    assert_eq!(other.survey, Some(SurveySettings { wind_m_s: 3.0, take_off, ..wanted }));
    // A mission that somebody wrote by hand says nothing of it.
    let text = std::fs::read_to_string(at("ground/mission.toml")).unwrap();
    let (before, after) = text.split_once("[survey]").expect("the table");
    let (_, after) = after.split_once("[[aircraft]]").expect("the aircraft");
    std::fs::write(at("ground/mission.toml"), format!("{before}[[aircraft]]{after}")).unwrap();
    let refused = dgtr(&["survey", "--after", &ground]);
    assert!(refused.status.code() == Some(2) && error_line(&refused).contains("give --gsd"), "{refused:?}");
}
