//! A plan as the simulated aircraft flies it.

use geometry::geodesy::{EnuFrame, Geodetic};
use models::formats::flight_plan::FlightPlan;
use sim::survey::{Route, Waypoint};

/// The waypoints of `plan` around `origin`; where it says nothing of the camera's pitch it is `pitch_deg`.
pub fn route(plan: &FlightPlan, origin: Geodetic, pitch_deg: f64) -> Route {
    let frame = EnuFrame::new(origin);
    let waypoints = plan.waypoints.iter();
    Route {
        waypoints: waypoints
            .map(|w| Waypoint {
                position: frame.to_enu(w.position),
                yaw_deg: w.yaw_deg,
                picture: w.picture,
                every_m: w.every_m,
            })
            .collect(),
        speed_ms: plan.speed_m_s,
        gimbal_pitch_deg: plan.pitch_deg.unwrap_or(pitch_deg),
    }
}
