//! A list of waypoints ("QGC WPL 110").

use super::MOST_ITEMS;
use super::command::{FRAME_GLOBAL, NAV_WAYPOINT};
use super::flown::SIMPLE;
use super::qgc::{Item, Mission};

/// What a list of waypoints begins with.
pub const BEGIN: &str = "QGC WPL ";

/// A list of waypoints as MAVLink's file format has it ("Mission Plain-Text File Format"): index, current, frame, command, four
/// parameters, latitude, longitude, height, autocontinue. The first is home.
pub fn read(text: &str) -> Result<Mission, String> {
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
    let home = items.remove(0);
    let ([.., Some(lat), Some(lon), Some(alt)], Some(NAV_WAYPOINT), Some(FRAME_GLOBAL)) =
        (home.params, home.command, home.frame)
    else {
        return Err(
            "waypoint 0 is no home (command 16 in frame 0, with latitude, longitude and height above the sea); \
                    save it again with its home"
                .into(),
        );
    };
    Ok(Mission { hover_speed: None, cruise_speed: None, planned_home_position: [lat, lon, alt], items })
}
