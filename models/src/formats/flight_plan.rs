//! QGroundControl's flight plan (`.plan`, JSON, "Plan File Format" of its developer guide), as far as pictures at waypoints and along
//! lines need it: take-off, waypoints, heading, gimbal, speed, pictures, landing. Its surveys and corridor scans are read by the mission
//! items that they hold, and so are lists of waypoints ("QGC WPL 110"). Items are numbered as MAVLink's MAV_CMD and MAV_FRAME number
//! them.

use std::path::Path;

use geometry::geodesy::Geodetic;

use flown::Reading;

use super::{FormatError, read_bounded};

mod command;
mod flown;
mod qgc;
mod waypoints;
mod write;

#[cfg(test)]
mod tests;

/// A plan of some thousand items has a MiB.
const LIMIT: u64 = 8 << 20;
/// Most mission items of a plan read.
const MOST_ITEMS: usize = 20_000;
/// Speeds taken from a plan, m/s.
const SPEEDS: std::ops::Range<f64> = 0.1..100.0;
/// Speed of a plan that names none, m/s: QGroundControl's for a multirotor, and ArduCopter's WPNAV_SPEED.
const USUAL_SPEED: f64 = 5.0;
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

/// Reads a plan of QGroundControl or a list of waypoints, known by its content.
///
/// # Errors
/// The operating system's; a file that is no plan, or has items that are not flown here.
pub fn read(path: &Path) -> Result<FlightPlan, FormatError> {
    let bytes = read_bounded(path, LIMIT)?;
    let bad = |what: String| FormatError::invalid(path, what);
    let mission = match bytes.starts_with(waypoints::BEGIN.as_bytes()) {
        true => waypoints::read(&String::from_utf8_lossy(&bytes)).map_err(bad)?,
        false => {
            let file: qgc::File =
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
    if lat_deg == 0.0 && lon_deg == 0.0 {
        return Err(bad("its home is at 0, 0, where nobody flies; set it, as heights count from there".into()));
    }
    let mut reading = Reading::new(home, mission.hover_speed.or(mission.cruise_speed).unwrap_or(USUAL_SPEED));
    for (i, item) in mission.items.iter().enumerate() {
        match reading.take(item) {
            Ok(true) => {}
            Ok(false) => {
                let behind = mission.items[i + 1..].iter().filter(|item| Reading::leads_on(item)).count();
                if behind > 0 {
                    let path = path.display();
                    tracing::warn!(
                        "{path}: {behind} waypoints or surveys behind the landing, item {}, are not flown",
                        i + 1
                    );
                }
                break;
            }
            Err(what) => return Err(bad(format!("mission item {}: {what}", i + 1))),
        }
    }
    if let Some([slowest, fastest]) = reading.speeds.filter(|[slowest, fastest]| slowest < fastest) {
        let path = path.display();
        tracing::warn!(
            "{path}: its speed changes from {slowest} to {fastest} m/s; all of it is flown at {slowest} m/s"
        );
    }
    let plan = reading.done();
    if !SPEEDS.contains(&plan.speed_m_s) {
        return Err(bad(format!("its speed must be {} to {} m/s", SPEEDS.start, SPEEDS.end)));
    }
    if plan.waypoints.is_empty() {
        return Err(bad("has no waypoint; plan at least one".into()));
    }
    Ok(plan)
}

fn is_place(at: &Geodetic) -> bool {
    at.is_valid() && at.alt_m.abs() <= HIGHEST
}
