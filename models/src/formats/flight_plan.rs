//! QGroundControl's flight plan (`.plan`, JSON, "Plan File Format" of its developer guide), as far as single pictures at waypoints
//! need it: take-off, waypoints, heading, gimbal, speed, one picture, the way home. Mission items are numbered as MAVLink's
//! MAV_CMD and MAV_FRAME number them.

use std::io::{self, Write};
use std::path::Path;

use geometry::geodesy::Geodetic;
use serde::Deserialize;
use serde_json::{Value, json};

use super::{FormatError, read_bounded};

/// A plan of some thousand items has a MiB.
const LIMIT: u64 = 8 << 20;
/// Most mission items of a plan read.
const MOST_ITEMS: usize = 20_000;

const NAV_WAYPOINT: u32 = 16;
const NAV_RETURN_TO_LAUNCH: u32 = 20;
const NAV_TAKEOFF: u32 = 22;
const CONDITION_YAW: u32 = 115;
const DO_CHANGE_SPEED: u32 = 178;
/// One picture; written because older ArduPilot takes this as a mission item and IMAGE_START_CAPTURE not, and PX4 takes both.
const DO_DIGICAM_CONTROL: u32 = 203;
const DO_MOUNT_CONTROL: u32 = 205;
const IMAGE_START_CAPTURE: u32 = 2000;

const FRAME_GLOBAL: u32 = 0;
const FRAME_MISSION: u32 = 2;
const FRAME_RELATIVE: u32 = 3;

/// MAV_MOUNT_MODE_MAVLINK_TARGETING.
const MOUNT_TARGETING: f64 = 2.0;
/// MAV_AUTOPILOT_ARDUPILOTMEGA and MAV_TYPE_QUADROTOR: only what QGroundControl shows; the items are those of PX4, too.
const FIRMWARE: u32 = 3;
const VEHICLE: u32 = 2;
/// A picture is taken when the aircraft stood for this long, seconds.
const HOLD_S: f64 = 1.0;
/// Speeds taken from a plan, m/s.
const SPEEDS: std::ops::Range<f64> = 0.1..100.0;
/// Heights taken from a plan, metres either way.
const HIGHEST: f64 = 100_000.0;

/// One waypoint.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Waypoint {
    /// Where; its height is on the scale of [`FlightPlan::home`].
    pub position: Geodetic,
    /// Heading there, degrees clockwise from north; `None` = as it flies.
    pub yaw_deg: Option<f64>,
    /// Whether a picture is taken.
    pub picture: bool,
}

/// A flight from waypoint to waypoint and back home.
#[derive(Clone, Debug, PartialEq)]
pub struct FlightPlan {
    /// Where the aircraft takes off: heights are written relative to it.
    pub home: Geodetic,
    /// Speed, m/s.
    pub speed_m_s: f64,
    /// Pitch of the camera, degrees; −90 looks straight down; `None` = as it is.
    pub pitch_deg: Option<f64>,
    /// In flying order.
    pub waypoints: Vec<Waypoint>,
}

fn item(items: &mut Vec<Value>, command: u32, params: [Option<f64>; 7]) {
    let number = items.len() + 1;
    let (frame, altitude) = match command {
        NAV_TAKEOFF | NAV_WAYPOINT => (FRAME_RELATIVE, params[6]),
        _ => (FRAME_MISSION, None),
    };
    let mut item = json!({
        "autoContinue": true, "command": command, "doJumpId": number, "frame": frame, "params": params, "type": "SimpleItem",
    });
    if let Some(altitude) = altitude {
        item["AMSLAltAboveTerrain"] = Value::Null;
        item["Altitude"] = altitude.into();
        // Relative to home.
        item["AltitudeMode"] = 1.into();
    }
    items.push(item);
}

impl FlightPlan {
    /// Writes the plan.
    ///
    /// # Errors
    /// Those of `out`.
    pub fn write(&self, out: &mut dyn Write) -> io::Result<()> {
        let mut items = Vec::with_capacity(3 * self.waypoints.len() + 4);
        let zeros = [Some(0.0); 7];
        let place = |at: &Geodetic| {
            // A centimetre on the ground, a centimetre of height.
            let degrees = |v: f64| Some((v * 1e7).round() / 1e7);
            let above = ((at.alt_m - self.home.alt_m) * 100.0).round() / 100.0;
            [degrees(at.lat_deg), degrees(at.lon_deg), Some(above)]
        };
        if let Some(first) = self.waypoints.first() {
            let above = Geodetic { alt_m: first.position.alt_m, ..self.home };
            let [lat, lon, alt] = place(&above);
            item(&mut items, NAV_TAKEOFF, [Some(0.0), Some(0.0), Some(0.0), None, lat, lon, alt]);
        }
        // Ground speed, no change of throttle.
        let speed = [Some(1.0), Some(self.speed_m_s), Some(-1.0), Some(0.0), Some(0.0), Some(0.0), Some(0.0)];
        item(&mut items, DO_CHANGE_SPEED, speed);
        if let Some(pitch) = self.pitch_deg {
            let mut params = zeros;
            (params[0], params[6]) = (Some(pitch), Some(MOUNT_TARGETING));
            item(&mut items, DO_MOUNT_CONTROL, params);
        }
        for waypoint in &self.waypoints {
            // ArduPilot turns by this on the way to the waypoint, PX4 by the waypoint's own parameter.
            if let Some(yaw) = waypoint.yaw_deg {
                let mut params = zeros;
                params[0] = Some(yaw);
                item(&mut items, CONDITION_YAW, params);
            }
            let [lat, lon, alt] = place(&waypoint.position);
            let hold = if waypoint.picture { HOLD_S } else { 0.0 };
            item(&mut items, NAV_WAYPOINT, [Some(hold), Some(0.0), Some(0.0), waypoint.yaw_deg, lat, lon, alt]);
            if waypoint.picture {
                let mut params = zeros;
                params[4] = Some(1.0);
                item(&mut items, DO_DIGICAM_CONTROL, params);
            }
        }
        item(&mut items, NAV_RETURN_TO_LAUNCH, zeros);
        let plan = json!({
            "fileType": "Plan",
            "groundStation": "QGroundControl",
            "version": 1,
            "geoFence": { "circles": [], "polygons": [], "version": 2 },
            "rallyPoints": { "points": [], "version": 2 },
            "mission": {
                "version": 2,
                "firmwareType": FIRMWARE,
                "vehicleType": VEHICLE,
                "globalPlanAltitudeMode": 1,
                "cruiseSpeed": self.speed_m_s,
                "hoverSpeed": self.speed_m_s,
                "plannedHomePosition": [self.home.lat_deg, self.home.lon_deg, self.home.alt_m],
                "items": items,
            },
        });
        serde_json::to_writer_pretty(&mut *out, &plan)?;
        out.write_all(b"\n")
    }
}

#[derive(Deserialize)]
#[serde(rename_all = "camelCase")]
struct File {
    file_type: String,
    mission: Mission,
}

#[derive(Deserialize)]
#[serde(rename_all = "camelCase")]
struct Mission {
    hover_speed: f64,
    planned_home_position: [f64; 3],
    items: Vec<Item>,
}

#[derive(Deserialize)]
struct Item {
    #[serde(rename = "type")]
    kind: String,
    command: Option<u32>,
    frame: Option<u32>,
    #[serde(default)]
    params: [Option<f64>; 7],
}

/// Reads a plan of simple items.
///
/// # Errors
/// The operating system's; a file that is no plan, or has items that are not flown here.
pub fn read(path: &Path) -> Result<FlightPlan, FormatError> {
    let bytes = read_bounded(path, LIMIT)?;
    let file: File = serde_json::from_slice(&bytes)
        .map_err(|e| FormatError::invalid(path, format!("not a plan of QGroundControl: {e}")))?;
    if file.file_type != "Plan" {
        return Err(FormatError::invalid(path, "no plan of QGroundControl: its fileType is another; save it as .plan"));
    }
    let mission = file.mission;
    if mission.items.len() > MOST_ITEMS {
        let (size, limit) = (mission.items.len() as u64, MOST_ITEMS as u64);
        return Err(FormatError::TooLarge { path: path.into(), what: "its number of mission items", size, limit });
    }
    let [lat_deg, lon_deg, alt_m] = mission.planned_home_position;
    let home = Geodetic { lat_deg, lon_deg, alt_m };
    if !is_place(&home) {
        return Err(FormatError::invalid(path, "its plannedHomePosition is no latitude, longitude and height"));
    }
    let mut plan = FlightPlan { home, speed_m_s: mission.hover_speed, pitch_deg: None, waypoints: Vec::new() };
    let mut yaw = None;
    for (i, item) in mission.items.iter().enumerate() {
        let wrong = |what: String| FormatError::invalid(path, format!("mission item {}: {what}", i + 1));
        match plan.take(item, &mut yaw) {
            Ok(true) => {}
            Ok(false) => break,
            Err(what) => return Err(wrong(what)),
        }
    }
    if !SPEEDS.contains(&plan.speed_m_s) {
        return Err(FormatError::invalid(path, format!("its speed must be {} to {} m/s", SPEEDS.start, SPEEDS.end)));
    }
    if plan.waypoints.is_empty() {
        return Err(FormatError::invalid(path, "has no waypoint; plan at least one"));
    }
    Ok(plan)
}

fn is_place(at: &Geodetic) -> bool {
    at.is_valid() && at.alt_m.abs() <= HIGHEST
}

impl FlightPlan {
    /// One mission item; false when it ends the flight.
    fn take(&mut self, item: &Item, yaw: &mut Option<f64>) -> Result<bool, String> {
        let p = &item.params;
        let number = |k: usize| p[k].ok_or_else(|| format!("its parameter {} is missing", k + 1));
        let Some(command) = item.command.filter(|_| item.kind == "SimpleItem") else {
            return Err("surveys and other complex items are not flown here; plan waypoints".into());
        };
        match command {
            // The simulated aircraft begins in the air.
            NAV_TAKEOFF => {}
            NAV_WAYPOINT => {
                let above = match item.frame {
                    Some(FRAME_GLOBAL) => 0.0,
                    Some(FRAME_RELATIVE) => self.home.alt_m,
                    _ => return Err("heights must be above home or above the sea (frame 3 or 0)".into()),
                };
                let position = Geodetic { lat_deg: number(4)?, lon_deg: number(5)?, alt_m: above + number(6)? };
                if !is_place(&position) {
                    return Err("its latitude, longitude or height is impossible".into());
                }
                let yaw_deg = p[3].or(yaw.take());
                if yaw_deg.is_some_and(|y| y.abs() > 360.0) {
                    return Err("its heading must be -360 to 360 degrees".into());
                }
                self.waypoints.push(Waypoint { position, yaw_deg, picture: false });
            }
            NAV_RETURN_TO_LAUNCH => return Ok(false),
            CONDITION_YAW => *yaw = Some(number(0)?),
            DO_CHANGE_SPEED => self.speed_m_s = number(1)?,
            DO_MOUNT_CONTROL => {
                let pitch = number(0)?;
                if pitch.abs() > 180.0 {
                    return Err("its pitch must be -180 to 180 degrees".into());
                }
                self.pitch_deg = Some(pitch);
            }
            DO_DIGICAM_CONTROL | IMAGE_START_CAPTURE => match self.waypoints.last_mut() {
                Some(waypoint) => waypoint.picture = true,
                None => return Err("takes a picture before the first waypoint".into()),
            },
            other => return Err(format!("command {other} is not flown here; plan waypoints with single pictures")),
        }
        Ok(true)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const HOME: Geodetic = Geodetic { lat_deg: 47.4, lon_deg: 8.5, alt_m: 430.0 };

    fn plan() -> FlightPlan {
        let waypoint = |k: f64, yaw_deg, picture| Waypoint {
            position: Geodetic { lat_deg: 47.4 + k * 1e-4, lon_deg: 8.5 - k * 1e-4, alt_m: 470.25 },
            yaw_deg,
            picture,
        };
        let waypoints = vec![waypoint(1.0, None, true), waypoint(2.0, Some(90.0), true), waypoint(3.0, None, false)];
        FlightPlan { home: HOME, speed_m_s: 5.0, pitch_deg: Some(-60.0), waypoints }
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
    }

    /// The members that "Plan File Format" of QGroundControl's developer guide lists.
    #[test]
    fn a_plan_has_what_qgroundcontrol_documents() {
        let file: Value = serde_json::from_str(&text(&plan())).expect("JSON");
        assert_eq!((&file["fileType"], &file["version"]), (&json!("Plan"), &json!(1)));
        assert!(file["groundStation"].is_string());
        assert_eq!((&file["geoFence"]["version"], &file["rallyPoints"]["version"]), (&json!(2), &json!(2)));
        let mission = &file["mission"];
        for number in ["version", "firmwareType", "vehicleType", "globalPlanAltitudeMode", "cruiseSpeed", "hoverSpeed"]
        {
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
        assert!(refused("\"command\": 178", "\"command\": 206").contains("mission item 2: command 206"));
        assert!(refused("\"SimpleItem\"", "\"ComplexItem\"").contains("mission item 1: surveys"));
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
}
