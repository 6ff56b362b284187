//! QGroundControl's flight plan (`.plan`, JSON, "Plan File Format" of its developer guide), as far as pictures at waypoints and along
//! lines need it: take-off, waypoints, heading, gimbal, speed, pictures, landing. Its surveys and corridor scans are read by the mission
//! items that they hold, and so are lists of waypoints ("QGC WPL 110"). Items are numbered as MAVLink's MAV_CMD and MAV_FRAME number
//! them.

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
const NAV_LAND: u32 = 21;
const NAV_TAKEOFF: u32 = 22;
const NAV_DELAY: u32 = 93;
const CONDITION_YAW: u32 = 115;
const DO_CHANGE_SPEED: u32 = 178;
/// One picture; written because older ArduPilot takes this as a mission item and IMAGE_START_CAPTURE not, and PX4 takes both.
const DO_DIGICAM_CONTROL: u32 = 203;
const DO_MOUNT_CONTROL: u32 = 205;
/// Pictures every so many metres from here on.
const DO_SET_CAM_TRIGG_DIST: u32 = 206;
const SET_CAMERA_MODE: u32 = 530;
const DO_GIMBAL_MANAGER_PITCHYAW: u32 = 1000;
const IMAGE_START_CAPTURE: u32 = 2000;
const IMAGE_STOP_CAPTURE: u32 = 2001;

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
/// Speed of a plan that names none, m/s: QGroundControl's for a multirotor, and ArduCopter's WPNAV_SPEED.
const USUAL_SPEED: f64 = 5.0;
/// Metres between pictures taken from a plan.
const APART: std::ops::RangeInclusive<f64> = 0.1..=10_000.0;
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
    /// Metres between two pictures on the way from here to the next one, the first of them here; `None` = none are taken.
    pub every_m: Option<f64>,
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
    /// Where it lands; `None` = it returns to where it took off as the autopilot is set.
    pub landing: Option<Geodetic>,
}

fn item(items: &mut Vec<Value>, command: u32, params: [Option<f64>; 7]) {
    let number = items.len() + 1;
    let (frame, altitude) = match command {
        NAV_TAKEOFF | NAV_WAYPOINT | NAV_LAND => (FRAME_RELATIVE, params[6]),
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
        let mut every_m = None;
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
            if every_m != waypoint.every_m {
                every_m = waypoint.every_m;
                let mut params = zeros;
                // The first picture at once.
                (params[0], params[2]) = (Some(every_m.unwrap_or(0.0)), Some(1.0));
                item(&mut items, DO_SET_CAM_TRIGG_DIST, params);
            }
        }
        match &self.landing {
            Some(at) => {
                let [lat, lon, alt] = place(at);
                item(&mut items, NAV_LAND, [Some(0.0), Some(0.0), Some(0.0), None, lat, lon, alt]);
            }
            None => item(&mut items, NAV_RETURN_TO_LAUNCH, zeros),
        }
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
    hover_speed: Option<f64>,
    cruise_speed: Option<f64>,
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
    #[serde(rename = "complexItemType")]
    complex: Option<String>,
    #[serde(rename = "TransectStyleComplexItem")]
    transects: Option<Transects>,
    /// Of a survey whose transects hold no items: height above home.
    #[serde(rename = "Altitude")]
    altitude: Option<f64>,
}

/// What QGroundControl's surveys and corridor scans have in common.
#[derive(Deserialize)]
#[serde(rename_all = "PascalCase")]
struct Transects {
    /// What is sent to the vehicle.
    items: Option<Vec<Item>>,
    hover_and_capture: Option<bool>,
    visual_transect_points: Option<Vec<[f64; 2]>>,
    camera_calc: Option<CameraCalc>,
}

#[derive(Deserialize)]
#[serde(rename_all = "PascalCase")]
struct CameraCalc {
    adjusted_footprint_frontal: Option<f64>,
    distance_to_surface: Option<f64>,
}

/// Reads a plan of QGroundControl or a list of waypoints, known by its content.
///
/// # Errors
/// The operating system's; a file that is no plan, or has items that are not flown here.
pub fn read(path: &Path) -> Result<FlightPlan, FormatError> {
    let bytes = read_bounded(path, LIMIT)?;
    let bad = |what: String| FormatError::invalid(path, what);
    let mission = match bytes.starts_with(WAYPOINTS.as_bytes()) {
        true => waypoint_list(&String::from_utf8_lossy(&bytes)).map_err(bad)?,
        false => {
            let file: File =
                serde_json::from_slice(&bytes).map_err(|e| bad(format!("not a plan of QGroundControl: {e}")))?;
            if file.file_type != "Plan" {
                return Err(bad("no plan of QGroundControl: its fileType is another; save it as .plan".into()));
            }
            file.mission
        }
    };
    if mission.count() > MOST_ITEMS {
        let (size, limit) = (mission.count() as u64, MOST_ITEMS as u64);
        return Err(FormatError::TooLarge { path: path.into(), what: "its number of mission items", size, limit });
    }
    let [lat_deg, lon_deg, alt_m] = mission.planned_home_position;
    let home = Geodetic { lat_deg, lon_deg, alt_m };
    if !is_place(&home) {
        return Err(bad("its plannedHomePosition is no latitude, longitude and height".into()));
    }
    let speed_m_s = mission.hover_speed.or(mission.cruise_speed).unwrap_or(USUAL_SPEED);
    let plan = FlightPlan { home, speed_m_s, pitch_deg: None, waypoints: Vec::new(), landing: None };
    let mut reading = Reading { plan, yaw: None, every_m: None };
    for (i, item) in mission.items.iter().enumerate() {
        match reading.take(item) {
            Ok(true) => {}
            Ok(false) => break,
            Err(what) => return Err(bad(format!("mission item {}: {what}", i + 1))),
        }
    }
    let plan = reading.plan;
    if !SPEEDS.contains(&plan.speed_m_s) {
        return Err(bad(format!("its speed must be {} to {} m/s", SPEEDS.start, SPEEDS.end)));
    }
    if plan.waypoints.is_empty() {
        return Err(bad("has no waypoint; plan at least one".into()));
    }
    Ok(plan)
}

impl Mission {
    /// Items with those that surveys hold.
    fn count(&self) -> usize {
        let of = |t: &Transects| {
            t.items.as_ref().map_or(0, Vec::len) + t.visual_transect_points.as_ref().map_or(0, Vec::len)
        };
        self.items.iter().map(|item| 1 + item.transects.as_ref().map_or(0, of)).sum()
    }
}

/// What a list of waypoints begins with.
const WAYPOINTS: &str = "QGC WPL ";

/// A list of waypoints as MAVLink's file format has it ("Mission Plain-Text File Format"): index, current, frame, command, four
/// parameters, latitude, longitude, height, autocontinue. The first is home.
fn waypoint_list(text: &str) -> Result<Mission, String> {
    let rows = || text.lines().skip(1).filter(|line| !line.trim().is_empty());
    let count = rows().count();
    if count > MOST_ITEMS {
        return Err(format!("has {count} waypoints; at most {MOST_ITEMS} are read"));
    }
    let row = |(k, line): (usize, &str)| {
        let cells: Vec<Option<f64>> = line.split_whitespace().map(|cell| cell.parse().ok()).collect();
        let wrong = || format!("waypoint {k} has no twelve numbers; save it again as \"QGC WPL 110\"");
        // Not a number is a parameter that is not given.
        let given = |at: usize| cells[at].filter(|v| v.is_finite());
        if cells.len() != 12 || cells.iter().any(Option::is_none) {
            return Err(wrong());
        }
        let whole = |at: usize| given(at).filter(|v| (0.0..65_536.0).contains(v)).map(|v| v as u32);
        let mut params: [Option<f64>; 7] = std::array::from_fn(|p| given(4 + p));
        let command = whole(3).ok_or_else(wrong)?;
        // ArduPilot writes 0 for a heading that it leaves alone.
        if command == NAV_WAYPOINT {
            params[3] = params[3].filter(|yaw| *yaw != 0.0);
        }
        Ok(Item {
            kind: SIMPLE.into(),
            command: Some(command),
            frame: whole(2),
            params,
            complex: None,
            transects: None,
            altitude: None,
        })
    };
    let mut items = rows().enumerate().map(row).collect::<Result<Vec<Item>, String>>()?;
    if items.is_empty() {
        return Err("has no waypoint; plan at least one".into());
    }
    let home = items.remove(0).params;
    let (Some(lat), Some(lon), Some(alt)) = (home[4], home[5], home[6]) else {
        return Err("waypoint 0, its home, has no latitude, longitude and height".into());
    };
    Ok(Mission { hover_speed: None, cruise_speed: None, planned_home_position: [lat, lon, alt], items })
}

fn is_place(at: &Geodetic) -> bool {
    at.is_valid() && at.alt_m.abs() <= HIGHEST
}

/// How QGroundControl calls an item that is one of MAVLink's, and one that is more.
const SIMPLE: &str = "SimpleItem";
const COMPLEX: &str = "ComplexItem";

/// A plan that is being read.
struct Reading {
    plan: FlightPlan,
    /// Heading at the next waypoint.
    yaw: Option<f64>,
    /// Metres between pictures from here on.
    every_m: Option<f64>,
}

impl Reading {
    /// One mission item; false when it ends the flight.
    fn take(&mut self, item: &Item) -> Result<bool, String> {
        match (item.kind.as_str(), item.command, &item.transects) {
            (SIMPLE, Some(command), _) => self.simple(command, item),
            (COMPLEX, _, Some(transects)) => match &transects.items {
                Some(items) => {
                    for inner in items {
                        let command = inner.command.filter(|_| inner.kind == SIMPLE);
                        let command = command.ok_or("its survey holds an item that is no simple one")?;
                        if !self.simple(command, inner)? {
                            return Ok(false);
                        }
                    }
                    Ok(true)
                }
                None => self.transects(transects, item.altitude).map(|()| true),
            },
            (COMPLEX, ..) if item.complex.as_deref().is_some_and(|c| c.ends_with("LandingPattern")) => Ok(false),
            (COMPLEX, ..) => Err(format!(
                "complex items of the kind {:?} are not flown here; plan waypoints, surveys or corridor scans",
                item.complex.as_deref().unwrap_or_default()
            )),
            _ => Err("is no item of QGroundControl's; plan waypoints or surveys".into()),
        }
    }

    /// A survey that is kept by what is shown of it.
    fn transects(&mut self, transects: &Transects, altitude: Option<f64>) -> Result<(), String> {
        let calc = transects.camera_calc.as_ref();
        let height = altitude.or(calc.and_then(|c| c.distance_to_surface));
        let every_m = match transects.hover_and_capture {
            Some(true) => None,
            _ => calc.and_then(|c| c.adjusted_footprint_frontal).filter(|m| APART.contains(m)),
        };
        let hovers = transects.hover_and_capture == Some(true);
        let (Some(points), Some(height), true) =
            (&transects.visual_transect_points, height, hovers || every_m.is_some())
        else {
            return Err(
                "its survey says neither its items nor its height, points and distance of pictures; open it in \
                        QGroundControl and save it again"
                    .into(),
            );
        };
        for (k, [lat_deg, lon_deg]) in points.iter().enumerate() {
            let position = Geodetic { lat_deg: *lat_deg, lon_deg: *lon_deg, alt_m: self.plan.home.alt_m + height };
            let every_m = every_m.filter(|_| k + 1 < points.len());
            let yaw_deg = self.yaw.take();
            self.waypoint(Waypoint { position, yaw_deg, picture: hovers, every_m })?;
        }
        Ok(())
    }

    fn waypoint(&mut self, waypoint: Waypoint) -> Result<(), String> {
        if !is_place(&waypoint.position) {
            return Err("its latitude, longitude or height is impossible".into());
        }
        if waypoint.yaw_deg.is_some_and(|y| y.abs() > 360.0) {
            return Err("its heading must be -360 to 360 degrees".into());
        }
        self.plan.waypoints.push(waypoint);
        Ok(())
    }

    /// Where an item lies.
    fn place(&self, item: &Item) -> Result<Geodetic, String> {
        let number = |k: usize| item.params[k].ok_or_else(|| format!("its parameter {} is missing", k + 1));
        let above = match item.frame {
            Some(FRAME_GLOBAL) => 0.0,
            Some(FRAME_RELATIVE) => self.plan.home.alt_m,
            _ => return Err("heights must be above home or above the sea (frame 3 or 0)".into()),
        };
        Ok(Geodetic { lat_deg: number(4)?, lon_deg: number(5)?, alt_m: above + number(6)? })
    }

    fn simple(&mut self, command: u32, item: &Item) -> Result<bool, String> {
        let p = &item.params;
        let number = |k: usize| p[k].ok_or_else(|| format!("its parameter {} is missing", k + 1));
        match command {
            // The simulated aircraft begins in the air; it waits for each picture, and its camera takes nothing but pictures.
            NAV_TAKEOFF | NAV_DELAY | SET_CAMERA_MODE => {}
            NAV_WAYPOINT => {
                let yaw_deg = p[3].or(self.yaw.take());
                let every_m = self.every_m;
                let position = self.place(item)?;
                self.waypoint(Waypoint { position, yaw_deg, picture: false, every_m })?;
            }
            NAV_RETURN_TO_LAUNCH => return Ok(false),
            NAV_LAND => {
                // At 0, 0 it lands where it is.
                self.plan.landing = match (p[4], p[5]) {
                    (Some(lat), Some(lon)) if lat != 0.0 || lon != 0.0 => Some(self.place(item)?).filter(is_place),
                    _ => None,
                };
                return Ok(false);
            }
            CONDITION_YAW => self.yaw = Some(number(0)?),
            DO_CHANGE_SPEED => self.plan.speed_m_s = number(1)?,
            DO_MOUNT_CONTROL | DO_GIMBAL_MANAGER_PITCHYAW => {
                let pitch = number(0)?;
                if pitch.abs() > 180.0 {
                    return Err("its pitch must be -180 to 180 degrees".into());
                }
                self.plan.pitch_deg = Some(pitch);
            }
            DO_SET_CAM_TRIGG_DIST => self.trigger(number(0)?)?,
            IMAGE_STOP_CAPTURE => self.trigger(0.0)?,
            // Every so many seconds, without an end.
            IMAGE_START_CAPTURE if p[2].unwrap_or(1.0) != 1.0 && p[1].unwrap_or(0.0) > 0.0 => {
                self.trigger(number(1)? * self.plan.speed_m_s)?;
            }
            DO_DIGICAM_CONTROL | IMAGE_START_CAPTURE => match self.plan.waypoints.last_mut() {
                Some(waypoint) => waypoint.picture = true,
                None => return Err("takes a picture before the first waypoint".into()),
            },
            other => return Err(format!("command {other} is not flown here; plan waypoints, pictures and surveys")),
        }
        Ok(true)
    }

    /// From the last waypoint on.
    fn trigger(&mut self, every_m: f64) -> Result<(), String> {
        self.every_m = match every_m {
            0.0 => None,
            m if APART.contains(&m) => Some(m),
            _ => return Err(format!("pictures must be {} to {} m apart", APART.start(), APART.end())),
        };
        if let Some(waypoint) = self.plan.waypoints.last_mut() {
            waypoint.every_m = self.every_m;
        }
        Ok(())
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
}
