//! What of a plan's mission items is flown.

use geometry::geodesy::Geodetic;

use super::command::*;
use super::qgc::{CameraCalc, Item, Transects};
use super::{FlightPlan, SPEEDS, Waypoint, is_place};

/// Metres between pictures taken from a plan.
const APART: std::ops::RangeInclusive<f64> = 0.1..=10_000.0;

/// How QGroundControl calls an item that is one of MAVLink's, and one that is more.
pub const SIMPLE: &str = "SimpleItem";
const COMPLEX: &str = "ComplexItem";

/// Speeds of DO_CHANGE_SPEED that leave it as it is, or as it was set up.
const UNCHANGED: [f64; 2] = [-1.0, -2.0];

fn is_landing(item: &Item) -> bool {
    item.complex.as_deref().is_some_and(|kind| kind.ends_with("LandingPattern"))
}

/// A plan that is being read.
pub struct Reading {
    pub plan: FlightPlan,
    /// Speed and pitch of the camera from here on.
    speed_m_s: f64,
    pitch_deg: Option<f64>,
    /// The slowest and the fastest that waypoints are flown to; the first is not, as the flight begins there.
    pub speeds: Option<[f64; 2]>,
    /// Whether a picture was taken: all of them are taken with the camera at [`FlightPlan::pitch_deg`].
    took: bool,
    /// Heading at the next waypoint.
    yaw: Option<f64>,
    /// Metres between pictures from here on.
    every_m: Option<f64>,
}

impl Reading {
    /// Nothing flown yet, from `home`.
    pub fn new(home: Geodetic, speed_m_s: f64) -> Self {
        let plan = FlightPlan { home, speed_m_s, pitch_deg: None, waypoints: Vec::new(), landing: None };
        Self { plan, speed_m_s, pitch_deg: None, speeds: None, took: false, yaw: None, every_m: None }
    }

    /// The whole flight.
    pub fn done(mut self) -> FlightPlan {
        if !self.took {
            self.plan.pitch_deg = self.pitch_deg;
        }
        self.plan.speed_m_s = self.speeds.map_or(self.speed_m_s, |[slowest, _]| slowest);
        self.plan
    }

    /// Whether an item is one that an aircraft flies to.
    pub fn leads_on(item: &Item) -> bool {
        match item.kind.as_str() {
            COMPLEX => !is_landing(item),
            _ => item.command == Some(NAV_WAYPOINT),
        }
    }

    /// One mission item; false when it ends the flight.
    pub fn take(&mut self, item: &Item) -> Result<bool, String> {
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
            (COMPLEX, ..) if is_landing(item) => Ok(false),
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
        if !calc.is_none_or(CameraCalc::is_above_home) {
            return Err(
                "its survey lies above the sea or the terrain; open it in QGroundControl and save it again".into()
            );
        }
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
        if let Some(last) = self.plan.waypoints.last() {
            let v = self.speed_m_s;
            self.speeds = Some(self.speeds.map_or([v; 2], |[slowest, fastest]| [slowest.min(v), fastest.max(v)]));
            if last.every_m.is_some() {
                self.picture()?;
            }
        }
        if waypoint.picture {
            self.picture()?;
        }
        self.plan.waypoints.push(waypoint);
        Ok(())
    }

    /// Pictures are taken here, or on the way here.
    fn picture(&mut self) -> Result<(), String> {
        if self.took && self.plan.pitch_deg != self.pitch_deg {
            return Err("takes pictures at another pitch of the camera than before it; plan a flight for each".into());
        }
        (self.took, self.plan.pitch_deg) = (true, self.pitch_deg);
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
            CONDITION_YAW if p[3].is_some_and(|relative| relative != 0.0) => {
                return Err("turns by an angle; give the heading itself (parameter 4 is 0)".into());
            }
            CONDITION_YAW => self.yaw = Some(number(0)?),
            // Of climbs and descents, or the speed that it has.
            DO_CHANGE_SPEED if p[0].is_some_and(|kind| kind > 1.0) || p[1].is_some_and(|v| UNCHANGED.contains(&v)) => {}
            DO_CHANGE_SPEED => {
                let speed = number(1)?;
                if !SPEEDS.contains(&speed) {
                    return Err(format!("its speed must be {} to {} m/s", SPEEDS.start, SPEEDS.end));
                }
                self.speed_m_s = speed;
            }
            DO_MOUNT_CONTROL | DO_GIMBAL_MANAGER_PITCHYAW => {
                let pitch = number(0)?;
                if pitch.abs() > 180.0 {
                    return Err("its pitch must be -180 to 180 degrees".into());
                }
                self.pitch_deg = Some(pitch);
            }
            DO_SET_CAM_TRIGG_DIST => self.trigger(number(0)?)?,
            IMAGE_STOP_CAPTURE => self.trigger(0.0)?,
            // Every so many seconds, without an end.
            IMAGE_START_CAPTURE if p[2].unwrap_or(1.0) != 1.0 && p[1].unwrap_or(0.0) > 0.0 => {
                if p[2].is_some_and(|count| count > 1.0) {
                    return Err("takes so many pictures and then no more; stop them with IMAGE_STOP_CAPTURE".into());
                }
                self.trigger(number(1)? * self.speed_m_s)?;
            }
            DO_DIGICAM_CONTROL | IMAGE_START_CAPTURE => {
                self.picture()?;
                match self.plan.waypoints.last_mut() {
                    Some(waypoint) => waypoint.picture = true,
                    None => return Err("takes a picture before the first waypoint".into()),
                }
            }
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
