//! A plan as QGroundControl writes it.

use std::io::{self, Write};

use geometry::geodesy::Geodetic;
use serde_json::{Value, json};

use super::FlightPlan;
use super::command::*;

/// MAV_MOUNT_MODE_MAVLINK_TARGETING.
const MOUNT_TARGETING: f64 = 2.0;
/// MAV_AUTOPILOT_ARDUPILOTMEGA and MAV_TYPE_QUADROTOR: only what QGroundControl shows; the items are those of PX4, too.
const FIRMWARE: u32 = 3;
const VEHICLE: u32 = 2;
/// A picture is taken when the aircraft stood for this long, seconds.
const HOLD_S: f64 = 1.0;

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
    /// Errors of `out`.
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
