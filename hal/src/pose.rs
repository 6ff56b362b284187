//! Where the aircraft was, at any time in the recent past.

pub mod ring;
pub mod track;

use geometry::geodesy::Geodetic;
use glam::{DQuat, DVec3};

/// A pose of the body at one instant.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct BodyPose {
    /// Position the autopilot reports (its own reference point), altitude above mean sea level.
    pub position: Geodetic,
    /// Velocity east, north, up, m/s; zero when unknown.
    pub velocity: DVec3,
    /// Body (forward-left-up) → ENU.
    pub attitude: DQuat,
    /// Gimbal's camera mount (forward-left-up, optical axis forward) → ENU, when the autopilot reports one.
    pub gimbal: Option<DQuat>,
    /// One standard deviation of position, east, north, up, metres.
    pub position_sigma_m: DVec3,
    /// One standard deviation of attitude about east, north, up, radians.
    pub attitude_sigma_rad: DVec3,
}

/// Why there is no pose.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum PoseError {
    /// Nothing was received yet.
    Empty,
    /// The time lies after the newest sample: ask again later.
    NotYet,
    /// The time lies before the oldest sample kept.
    TooOld,
    /// The samples on both sides are too far apart to interpolate.
    Gap,
}

/// Where the aircraft was. Times are nanoseconds on the source's own clock (the autopilot's boot clock for MAVLink).
pub trait PoseSource {
    /// The pose at `time_ns`, interpolated; refuses to extrapolate beyond its stated limit.
    ///
    /// # Errors
    /// [`PoseError::NotYet`] when the answer will be known later, else a final refusal.
    fn pose_at(&self, time_ns: u64) -> Result<BodyPose, PoseError>;
}
