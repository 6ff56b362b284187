//! An area dealt to a fleet, and what is refused.

use std::path::Path;

use config::mission::Mission;

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
fn an_area_across_the_antimeridian_is_flown_there_and_what_leads_over_its_hole_is_counted() {
    let folder = tempfile::tempdir().unwrap();
    let ring = |half: f64| {
        let corners = [[-half, -half], [half, -half], [half, half], [-half, half], [-half, -half]];
        corners.map(|[x, y]| [if x < 0.0 { 180.0 + x } else { x - 180.0 }, -17.0 + y])
    };
    let area = format!(r#"{{"type":"Polygon","coordinates":[{:?},{:?}]}}"#, ring(0.001), ring(0.0004));
    let done = survey(folder.path(), &area, &[]);
    let told = String::from_utf8_lossy(&done.stderr);
    assert!(done.status.success(), "{told}");
    let told: Vec<&str> = told.lines().filter(|line| line.contains("holes of the area")).collect();
    assert!(told.len() == 1 && told[0].contains("lines reach into them, and"), "{told:?}");
    let lines = told[0].split("not avoided: ").nth(1).and_then(|rest| rest.split(' ').next()?.parse::<usize>().ok());
    assert!(lines.is_some_and(|lines| lines > 1), "{told:?}");
    let mission = Mission::read(&folder.path().join("out/mission.toml")).unwrap();
    assert!(
        mission.origin.lon_deg.abs() > 179.99 && (mission.origin.lat_deg + 17.0).abs() < 1e-6,
        "{:?}",
        mission.origin
    );
    let plan = models::formats::flight_plan::read(&folder.path().join("out/a1.plan")).unwrap();
    assert!(plan.waypoints.iter().all(|w| w.position.lon_deg.abs() > 179.99), "{plan:?}");
}
