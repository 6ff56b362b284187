use geometry::geodesy::Geodetic;
use serde_json::{Value, json};

use super::command::*;
use super::*;

const HOME: Geodetic = Geodetic { lat_deg: 47.4, lon_deg: 8.5, alt_m: 430.0 };

fn plan() -> FlightPlan {
    let waypoint = |k: f64, yaw_deg, picture| Waypoint {
        position: Geodetic { lat_deg: 47.4 + k * 1e-4, lon_deg: 8.5 - k * 1e-4, alt_m: 470.25 },
        yaw_deg,
        picture,
        every_m: None,
    };
    let waypoints = vec![waypoint(1.0, None, true), waypoint(2.0, Some(90.0), true), waypoint(3.0, None, false)];
    FlightPlan { home: HOME, speed_m_s: 5.0, pitch_deg: Some(-60.0), waypoints, landing: None }
}

fn text(plan: &FlightPlan) -> String {
    let mut out = Vec::new();
    plan.write(&mut out).expect("memory");
    String::from_utf8(out).expect("text")
}

fn read_text(text: &str) -> Result<FlightPlan, String> {
    let dir = tempfile::tempdir().expect("a folder");
    let path = dir.path().join("a.plan");
    std::fs::write(&path, text).expect("written");
    read(&path).map_err(|e| e.to_string())
}

#[test]
fn a_plan_comes_back_as_it_was_written() {
    assert_eq!(read_text(&text(&plan())), Ok(plan()));
    // Lines with pictures, and a landing elsewhere.
    let mut lines = plan();
    lines.waypoints.iter_mut().for_each(|w| w.picture = false);
    lines.waypoints[0].every_m = Some(12.5);
    lines.landing = Some(Geodetic { lat_deg: 47.4012, ..HOME });
    assert_eq!(read_text(&text(&lines)), Ok(lines));
}

fn item(command: u32, frame: u32, params: [f64; 7]) -> Value {
    json!({ "type": "SimpleItem", "command": command, "frame": frame, "params": params })
}

fn with_items(items: &[Value], speeds: Value) -> Result<FlightPlan, String> {
    let mut mission = json!({ "plannedHomePosition": [47.4, 8.5, 430.0], "items": items });
    for (name, speed) in speeds.as_object().expect("speeds") {
        mission[name] = speed.clone();
    }
    read_text(&json!({ "fileType": "Plan", "mission": mission }).to_string())
}

#[test]
fn a_survey_of_qgroundcontrol_is_flown_by_the_items_that_it_holds() {
    let at = |lat: f64| item(NAV_WAYPOINT, FRAME_RELATIVE, [0.0, 0.0, 0.0, 0.0, lat, 8.5, 40.0]);
    let trigger = |m: f64| item(DO_SET_CAM_TRIGG_DIST, FRAME_MISSION, [m, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0]);
    let items = json!([at(47.401), trigger(25.0), at(47.402), trigger(0.0), at(47.403)]);
    for kind in ["survey", "CorridorScan"] {
        let survey = json!({ "type": "ComplexItem", "complexItemType": kind, "version": 5,
            "TransectStyleComplexItem": { "Items": items, "HoverAndCapture": false, "CameraCalc": { "ImageDensity": 2.5 } } });
        let plan = with_items(&[survey], json!({ "cruiseSpeed": 9.0 })).expect(kind);
        assert_eq!(plan.speed_m_s, 9.0);
        assert_eq!(plan.waypoints.iter().map(|w| w.every_m).collect::<Vec<_>>(), [Some(25.0), None, None]);
    }
    let structure = json!({ "type": "ComplexItem", "complexItemType": "StructureScan" });
    assert!(with_items(&[structure], json!({})).expect_err("no").contains("\"StructureScan\""));
    let inner = json!({ "type": "ComplexItem", "TransectStyleComplexItem": { "Items": [at(147.4)] } });
    assert!(with_items(&[inner], json!({})).expect_err("no").contains("mission item 1: its latitude"));
    // More items than are read, hidden in a survey.
    let many: Vec<Value> = (0..=MOST_ITEMS).map(|_| json!({ "type": "SimpleItem" })).collect();
    let many = json!({ "type": "ComplexItem", "TransectStyleComplexItem": { "Items": many } });
    assert!(with_items(&[many], json!({})).expect_err("no").contains("number of mission items"));
}

#[test]
fn a_survey_without_items_is_flown_by_its_points() {
    let survey = |more: Value| {
        let mut transects = json!({ "VisualTransectPoints": [[47.401, 8.5], [47.402, 8.5]] });
        for (name, value) in more.as_object().expect("members") {
            transects[name] = value.clone();
        }
        let item = json!({ "type": "ComplexItem", "complexItemType": "survey", "Altitude": 30.0, "TransectStyleComplexItem": transects });
        with_items(&[item], json!({}))
    };
    let hovering = survey(json!({ "HoverAndCapture": true })).expect("a plan");
    assert!(hovering.waypoints.iter().all(|w| w.picture && w.every_m.is_none() && w.position.alt_m == 460.0));
    assert_eq!(hovering.speed_m_s, USUAL_SPEED);
    let passing = survey(json!({ "CameraCalc": { "AdjustedFootprintFrontal": 20.0 } })).expect("a plan");
    assert_eq!(passing.waypoints.iter().map(|w| w.every_m).collect::<Vec<_>>(), [Some(20.0), None]);
    assert!(survey(json!({})).expect_err("no").contains("save it again"));
}

#[test]
fn pictures_by_distance_or_time_are_read_and_impossible_ones_are_not() {
    let at = |lat: f64| item(NAV_WAYPOINT, FRAME_RELATIVE, [0.0, 0.0, 0.0, 0.0, lat, 8.5, 40.0]);
    let by = |command: u32, params: [f64; 7]| {
        let items = [at(47.401), item(command, FRAME_MISSION, params), at(47.402)];
        with_items(&items, json!({ "hoverSpeed": 4.0 })).map(|p| p.waypoints[0].every_m)
    };
    assert_eq!(by(IMAGE_START_CAPTURE, [0.0, 3.0, 0.0, 0.0, 0.0, 0.0, 0.0]), Ok(Some(12.0)));
    assert_eq!(by(DO_SET_CAM_TRIGG_DIST, [8.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0]), Ok(Some(8.0)));
    for wrong in [-1.0, 1e9, 1e-9] {
        let refused = by(DO_SET_CAM_TRIGG_DIST, [wrong, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0]).expect_err("no");
        assert!(refused.contains("mission item 2: pictures must be 0.1 to 10000 m apart"), "{refused}");
    }
}

#[test]
fn a_list_of_waypoints_is_known_by_its_content() {
    let list = "QGC WPL 110\r\n0\t1\t0\t16\t0\t0\t0\t0\t47.4\t8.5\t430\t1\r\n\
        1\t0\t3\t22\t0\t0\t0\t0\t47.4\t8.5\t40\t1\n2\t0\t3\t16\t0\t0\t0\t0\t47.401\t8.5\t40\t1\n\
        3\t0\t0\t206\t15\t0\t1\t0\t0\t0\t0\t1\n4\t0\t3\t16\t0\t0\t0\tnan\t47.402\t8.5\t40\t1\n";
    let plan = read_text(list).expect("a plan");
    assert_eq!((plan.home, plan.waypoints.len(), plan.waypoints[0].every_m), (HOME, 2, Some(15.0)));
    assert_eq!((plan.waypoints[0].position.alt_m, plan.waypoints[1].yaw_deg), (470.0, None));
    let refused = |from: &str, to: &str| read_text(&list.replace(from, to)).expect_err(to);
    assert!(refused("\t47.401", "").contains("waypoint 2 has no twelve numbers"));
    assert!(refused("\t206", "\t-6").contains("waypoint 3"));
    assert!(read_text("QGC WPL 110\n").expect_err("empty").contains("no waypoint"));
}

/// The members that "Plan File Format" of QGroundControl's developer guide lists.
#[test]
fn a_plan_has_what_qgroundcontrol_documents() {
    let file: Value = serde_json::from_str(&text(&plan())).expect("JSON");
    assert_eq!((&file["fileType"], &file["version"]), (&json!("Plan"), &json!(1)));
    assert!(file["groundStation"].is_string());
    assert_eq!((&file["geoFence"]["version"], &file["rallyPoints"]["version"]), (&json!(2), &json!(2)));
    let mission = &file["mission"];
    for number in ["version", "firmwareType", "vehicleType", "globalPlanAltitudeMode", "cruiseSpeed", "hoverSpeed"] {
        assert!(mission[number].is_number(), "{number}");
    }
    assert_eq!(mission["plannedHomePosition"], json!([47.4, 8.5, 430.0]));
    let items = mission["items"].as_array().expect("items");
    for (i, item) in items.iter().enumerate() {
        assert_eq!((&item["type"], &item["doJumpId"]), (&json!("SimpleItem"), &json!(i + 1)));
        assert_eq!(item["params"].as_array().map(Vec::len), Some(7));
    }
    let commands: Vec<u64> = items.iter().filter_map(|i| i["command"].as_u64()).collect();
    assert_eq!(commands, [22, 178, 205, 16, 203, 115, 16, 203, 16, 20]);
    assert_eq!(
        (&items[3]["frame"], &items[3]["Altitude"], &items[3]["AltitudeMode"]),
        (&json!(3), &json!(40.25), &json!(1))
    );
}

#[test]
fn what_is_not_flown_here_is_named_by_its_item() {
    let refused = |from: &str, to: &str| {
        let text = text(&plan());
        assert!(text.contains(from), "{from}");
        read_text(&text.replacen(from, to, 1)).expect_err(to)
    };
    assert!(refused("\"command\": 178", "\"command\": 207").contains("mission item 2: command 207"));
    assert!(refused("\"SimpleItem\"", "\"ComplexItem\"").contains("mission item 1: complex items"));
    assert!(refused("47.4001", "147.4").contains("mission item 4: its latitude"));
    assert!(
        refused(
            "\"frame\": 3,\n        \"params\": [\n          1.0",
            "\"frame\": 10,\n        \"params\": [\n          1.0"
        )
        .contains("item 4: heights")
    );
    assert!(refused("\"Plan\"", "\"Fence\"").contains("fileType"));
    assert!(refused("430.0", "4.3e9").contains("plannedHomePosition"));
    assert!(read_text("{}").expect_err("empty").contains("not a plan"));
}

#[test]
fn pictures_are_flown_with_the_pitch_that_they_are_taken_with_and_the_slowest_speed() {
    let at = |lat: f64| item(NAV_WAYPOINT, FRAME_RELATIVE, [0.0, 0.0, 0.0, 0.0, lat, 8.5, 40.0]);
    let pitch = |deg: f64| item(DO_MOUNT_CONTROL, FRAME_MISSION, [deg, 0.0, 0.0, 0.0, 0.0, 0.0, 2.0]);
    let speed = |kind: f64, v: f64| item(DO_CHANGE_SPEED, FRAME_MISSION, [kind, v, -1.0, 0.0, 0.0, 0.0, 0.0]);
    let trigger = |m: f64| item(DO_SET_CAM_TRIGG_DIST, FRAME_MISSION, [m, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0]);
    let flown = |items: &[Value]| with_items(items, json!({ "hoverSpeed": 4.0 }));
    // A climb's speed and "as it is" change nothing; the camera is put away at the end.
    let plan = flown(&[
        pitch(-90.0),
        at(47.401),
        trigger(20.0),
        speed(2.0, 1.0),
        speed(1.0, -1.0),
        at(47.402),
        trigger(0.0),
        speed(1.0, 7.0),
        pitch(0.0),
        at(47.403),
    ]);
    assert_eq!(plan.map(|p| (p.speed_m_s, p.pitch_deg)), Ok((4.0, Some(-90.0))));
    let twice = [at(47.401), trigger(20.0), at(47.402), pitch(-45.0), at(47.403)];
    assert!(flown(&twice).expect_err("two pitches").contains("mission item 5: takes pictures at another pitch"));
    let fast = [at(47.401), speed(1.0, 500.0), at(47.402)];
    assert!(flown(&fast).expect_err("fast").contains("mission item 2: its speed must be 0.1 to 100 m/s"));
    let turn = item(CONDITION_YAW, FRAME_MISSION, [30.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0]);
    assert!(flown(&[turn, at(47.401)]).expect_err("relative").contains("mission item 1: turns by an angle"));
    let five = item(IMAGE_START_CAPTURE, FRAME_MISSION, [0.0, 2.0, 5.0, 0.0, 0.0, 0.0, 0.0]);
    assert!(flown(&[at(47.401), five, at(47.402)]).expect_err("five").contains("mission item 2: takes so many"));
}

#[test]
fn heights_count_from_a_home_that_is_known() {
    let list = "QGC WPL 110\n0\t1\t0\t16\t0\t0\t0\t0\t47.4\t8.5\t430\t1\n1\t0\t3\t16\t0\t0\t0\t0\t47.401\t8.5\t40\t1\n";
    assert!(read_text(list).is_ok());
    for (from, to, word) in [
        ("0\t1\t0\t16", "0\t1\t3\t22", "waypoint 0 is no home"),
        ("\t47.4\t8.5\t430", "\tnan\t8.5\t430", "waypoint 0 is no home"),
        ("\t47.4\t8.5\t430", "\t0\t0\t0", "home is at 0, 0"),
    ] {
        let refused = read_text(&list.replacen(from, to, 1)).expect_err(word);
        assert!(refused.contains(word), "{refused}");
    }
    // A survey of points alone, above the sea.
    for mode in [json!({ "DistanceToSurfaceRelative": false }), json!({ "DistanceMode": 2 })] {
        let mut calc = json!({ "AdjustedFootprintFrontal": 20.0, "DistanceToSurface": 470.0 });
        mode.as_object().expect("members").iter().for_each(|(name, value)| calc[name] = value.clone());
        let transects = json!({ "VisualTransectPoints": [[47.401, 8.5], [47.402, 8.5]], "CameraCalc": calc });
        let survey = json!({ "type": "ComplexItem", "TransectStyleComplexItem": transects });
        assert!(with_items(&[survey], json!({})).expect_err("above the sea").contains("above the sea or the terrain"));
    }
}
