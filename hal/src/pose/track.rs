//! The recent track of the aircraft: positions, attitudes and gimbal angles as they were sent, each in its own ring, and
//! the pose at any instant between them. It never extrapolates silently.

use geometry::geodesy::Geodetic;
use glam::{DQuat, DVec3};

use super::PoseSource;
use super::ring::{Around, Ring, Stamped};
use super::{BodyPose, PoseError};
use crate::frames::{attitude_to_enu, yaw_of_ned};

/// An exposure may be announced seconds after it: 5 s of positions at 50 Hz, of attitudes at 100 Hz, of gimbal status at 50 Hz.
const POSITIONS: usize = 256;
const ATTITUDES: usize = 512;
const GIMBALS: usize = 256;

/// Samples further apart than this are not interpolated.
const MAX_POSITION_GAP_NS: u64 = 1_500_000_000;
const MAX_ATTITUDE_GAP_NS: u64 = 500_000_000;
const MAX_GIMBAL_GAP_NS: u64 = 1_500_000_000;
/// [`Track::pose_near`] goes this far beyond the newest sample.
pub const MAX_EXTRAPOLATION_NS: u64 = 150_000_000;
/// No mount turns faster (DJI's gimbals: 360°/s at most), rad/s, and what noise may add, rad: a faster change is not a movement.
const MAX_GIMBAL_TURN: f64 = 6.5;
const GIMBAL_TURN_SLACK: f64 = 0.1;
/// Acceleration of a survey flight that interpolation does not know about, m/s²; and angular, rad/s².
const UNKNOWN_ACCELERATION: f64 = 2.0;
const UNKNOWN_ANGULAR_ACCELERATION: f64 = 2.0;

/// A position as sent.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct PositionSample {
    /// Boot time, ns.
    pub boot_ns: u64,
    /// Where.
    pub position: Geodetic,
    /// Velocity east, north, up, m/s.
    pub velocity: DVec3,
    /// One standard deviation east, north, up, m.
    pub sigma_m: DVec3,
}

/// An attitude as sent.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct AttitudeSample {
    /// Boot time, ns.
    pub boot_ns: u64,
    /// Body FRD → NED.
    pub frd_to_ned: DQuat,
    /// One standard deviation about east, north, up, rad.
    pub sigma_rad: DVec3,
}

/// A gimbal attitude as sent.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct GimbalSample {
    /// Boot time, ns.
    pub boot_ns: u64,
    /// Gimbal FRD → NED, or → the vehicle's heading frame.
    pub attitude: DQuat,
    /// Yaw is relative to the vehicle's heading, not to north.
    pub yaw_in_vehicle_frame: bool,
}

impl GimbalSample {
    /// Whether no mount turns from this attitude to `next` in the time between.
    fn jumps_to(&self, next: &Self) -> bool {
        let dt_s = next.boot_ns.saturating_sub(self.boot_ns) as f64 * 1e-9;
        self.yaw_in_vehicle_frame == next.yaw_in_vehicle_frame
            && self.attitude.angle_between(next.attitude) > MAX_GIMBAL_TURN * dt_s + GIMBAL_TURN_SLACK
    }
}

macro_rules! stamped {
    ($($t:ty),*) => {$(
        impl Stamped for $t {
            fn boot_ns(&self) -> u64 {
                self.boot_ns
            }
        }
    )*};
}
stamped!(PositionSample, AttitudeSample, GimbalSample);

/// The recent track.
#[derive(Default)]
pub struct Track {
    positions: Ring<PositionSample, POSITIONS>,
    attitudes: Ring<AttitudeSample, ATTITUDES>,
    gimbals: Ring<GimbalSample, GIMBALS>,
}

/// Two samples and the way between them, after the rules on gaps and extrapolation.
type Bracket<T> = (T, T, f64);

fn bracket<T: Stamped + Copy>(around: Around<T>, max_gap_ns: u64, reach_ns: u64) -> Result<Bracket<T>, PoseError> {
    match around {
        Around::Empty => Err(PoseError::Empty),
        Around::Before => Err(PoseError::TooOld),
        Around::Between(a, b, _) if b.boot_ns() - a.boot_ns() > max_gap_ns => Err(PoseError::Gap),
        Around::Between(a, b, f) => Ok((a, b, f)),
        Around::After(newest, by_ns) if by_ns <= reach_ns => Ok((newest, newest, 0.0)),
        Around::After(..) => Err(PoseError::NotYet),
    }
}

impl Track {
    /// Adds a position; false when it is not newer than the newest.
    pub fn push_position(&mut self, sample: PositionSample) -> bool {
        self.positions.push(sample)
    }

    /// Adds an attitude.
    pub fn push_attitude(&mut self, sample: AttitudeSample) -> bool {
        self.attitudes.push(sample)
    }

    /// Adds a gimbal attitude.
    pub fn push_gimbal(&mut self, sample: GimbalSample) -> bool {
        self.gimbals.push(sample)
    }

    /// Newest position.
    pub fn newest_position(&self) -> Option<PositionSample> {
        self.positions.newest()
    }

    /// Newest attitude.
    pub fn newest_attitude(&self) -> Option<AttitudeSample> {
        self.attitudes.newest()
    }

    /// Forgets everything: the boot clock restarted.
    pub fn clear(&mut self) {
        self.positions.clear();
        self.attitudes.clear();
        self.gimbals.clear();
    }

    /// Forgets the gimbal's attitudes: another one is believed.
    pub fn clear_gimbals(&mut self) {
        self.gimbals.clear();
    }

    /// Forgets positions: the estimator stepped.
    pub fn clear_positions(&mut self) {
        self.positions.clear();
    }

    /// As [`PoseSource::pose_at`], going up to [`MAX_EXTRAPOLATION_NS`] beyond the newest samples with the last velocity
    /// and attitude, the uncertainty grown accordingly.
    ///
    /// # Errors
    /// Errors of [`PoseSource::pose_at`].
    pub fn pose_near(&self, boot_ns: u64) -> Result<BodyPose, PoseError> {
        self.pose(boot_ns, MAX_EXTRAPOLATION_NS)
    }

    fn pose(&self, boot_ns: u64, reach_ns: u64) -> Result<BodyPose, PoseError> {
        let (p, q, f) = bracket(self.positions.around(boot_ns), MAX_POSITION_GAP_NS, reach_ns)?;
        let (a, b, g) = bracket(self.attitudes.around(boot_ns), MAX_ATTITUDE_GAP_NS, reach_ns)?;
        let gimbal = match bracket(self.gimbals.around(boot_ns), MAX_GIMBAL_GAP_NS, reach_ns) {
            Ok((c, d, _)) if c.jumps_to(&d) => None,
            Ok((c, d, h)) if c.yaw_in_vehicle_frame == d.yaw_in_vehicle_frame => {
                Some((c, c.attitude.slerp(d.attitude, h)))
            }
            Ok((c, d, h)) => {
                let nearer = if h < 0.5 { c } else { d };
                Some((nearer, nearer.attitude))
            }
            // Later perhaps; when the caller takes what there is, the pose goes without.
            Err(PoseError::NotYet) if reach_ns == 0 => return Err(PoseError::NotYet),
            Err(_) => None,
        };

        let mix = |x: f64, y: f64| x + (y - x) * f;
        // Longitudes on both sides of ±180°: take the short way.
        let wrap = libm::round((q.position.lon_deg - p.position.lon_deg) / 360.0) * 360.0;
        let mut position = Geodetic {
            lat_deg: mix(p.position.lat_deg, q.position.lat_deg),
            lon_deg: mix(p.position.lon_deg, q.position.lon_deg - wrap),
            alt_m: mix(p.position.alt_m, q.position.alt_m),
        };
        let beyond_s = boot_ns.saturating_sub(q.boot_ns) as f64 * 1e-9;
        if beyond_s > 0.0 {
            position = moved(position, q.velocity * beyond_s);
        }
        let frd_to_ned = a.frd_to_ned.slerp(b.frd_to_ned, g).normalize();

        // Half the unknown acceleration over the time to the nearest sample on either side.
        let free_s = |from: u64, to: u64, at: f64| (to - from) as f64 * 1e-9 * libm::sqrt((at * (1.0 - at)).max(0.0));
        let free_p = free_s(p.boot_ns, q.boot_ns, f) + beyond_s;
        let free_a = free_s(a.boot_ns, b.boot_ns, g) + boot_ns.saturating_sub(b.boot_ns) as f64 * 1e-9;
        let grow = |s: DVec3, by: f64| DVec3::new(libm::hypot(s.x, by), libm::hypot(s.y, by), libm::hypot(s.z, by));
        Ok(BodyPose {
            position,
            velocity: p.velocity.lerp(q.velocity, f),
            attitude: attitude_to_enu(frd_to_ned),
            gimbal: gimbal.map(|(sample, q)| {
                let heading = if sample.yaw_in_vehicle_frame { yaw_of_ned(frd_to_ned) } else { 0.0 };
                attitude_to_enu(DQuat::from_rotation_z(heading) * q)
            }),
            position_sigma_m: grow(p.sigma_m.max(q.sigma_m), 0.5 * UNKNOWN_ACCELERATION * free_p * free_p),
            attitude_sigma_rad: grow(
                a.sigma_rad.max(b.sigma_rad),
                0.5 * UNKNOWN_ANGULAR_ACCELERATION * free_a * free_a,
            ),
        })
    }
}

/// A geodetic position moved by a few metres.
pub(crate) fn moved(position: Geodetic, enu: DVec3) -> Geodetic {
    geometry::geodesy::EnuFrame::new(position).to_geodetic(enu)
}

impl PoseSource for Track {
    fn pose_at(&self, boot_ns: u64) -> Result<BodyPose, PoseError> {
        self.pose(boot_ns, 0)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::frames::euler_to_ned;

    const S: u64 = 1_000_000_000;

    /// One second of eastward flight at 8 m/s, yawing over north; the gimbal looks down in the vehicle's frame.
    fn track() -> Track {
        let mut track = Track::default();
        let start = Geodetic { lat_deg: 46.8, lon_deg: -92.0, alt_m: 200.0 };
        for i in 0..=10u64 {
            let t = i as f64 * 0.1;
            track.push_position(PositionSample {
                boot_ns: S + i * S / 10,
                position: moved(start, DVec3::new(8.0 * t, 0.0, 0.0)),
                velocity: DVec3::new(8.0, 0.0, 0.0),
                sigma_m: DVec3::splat(0.5),
            });
        }
        for i in 0..=25u64 {
            track.push_attitude(AttitudeSample {
                boot_ns: S + i * S / 25,
                frd_to_ned: euler_to_ned(0.0, 0.0, (i as f64 - 12.5) * 0.02),
                sigma_rad: DVec3::splat(0.01),
            });
        }
        track
    }

    #[test]
    fn the_pose_between_samples_is_interpolated_and_its_sigma_grows_with_the_gap() {
        let track = track();
        let start = track.pose_at(S).expect("a sample");
        let pose = track.pose_at(S + S / 2 + S / 20).expect("between samples");
        let way = geometry::geodesy::EnuFrame::new(start.position).to_enu(pose.position);
        assert!((way - DVec3::new(8.0 * 0.55, 0.0, 0.0)).length() < 1e-3, "{way}");
        // Yaw 0.025 rad east of north: the nose leans east.
        assert!((pose.attitude * DVec3::X - DVec3::new(0.025, 1.0, 0.0)).length() < 1e-3);
        assert!(pose.position_sigma_m.x > start.position_sigma_m.x);
    }

    #[test]
    fn the_future_is_refused_and_a_little_of_it_given_on_request() {
        let track = track();
        assert_eq!(track.pose_at(2 * S + 1), Err(PoseError::NotYet));
        let near = track.pose_near(2 * S + S / 10).expect("100 ms beyond");
        let newest = track.pose_at(2 * S).expect("newest");
        let way = geometry::geodesy::EnuFrame::new(newest.position).to_enu(near.position);
        assert!((way.x - 0.8).abs() < 1e-6 && near.position_sigma_m.x > newest.position_sigma_m.x);
        assert_eq!(track.pose_near(2 * S + S / 2), Err(PoseError::NotYet));
        assert_eq!(track.pose_at(S - 1), Err(PoseError::TooOld));
    }

    #[test]
    fn samples_too_far_apart_are_not_bridged() {
        let mut track = track();
        let mut far = track.newest_attitude().expect("one");
        far.boot_ns += S;
        track.push_attitude(far);
        let mut position = track.newest_position().expect("one");
        position.boot_ns += S;
        track.push_position(position);
        assert_eq!(track.pose_at(2 * S + S / 2), Err(PoseError::Gap));
    }

    #[test]
    fn nothing_is_interpolated_over_a_jump_that_no_mount_makes() {
        let looks = |pitch: f64| euler_to_ned(0.0, pitch, 0.0);
        for (pitch, expected) in [(-1.4, true), (0.0, false)] {
            let mut track = track();
            for (boot_ns, pitch) in [(S + S / 2, -1.57), (S + S / 2 + S / 20, pitch)] {
                track.push_gimbal(GimbalSample { boot_ns, attitude: looks(pitch), yaw_in_vehicle_frame: true });
            }
            let pose = track.pose_at(S + S / 2 + S / 40).expect("a pose");
            assert_eq!(pose.gimbal.is_some(), expected, "to {pitch} in 50 ms");
        }
    }

    #[test]
    fn a_gimbal_in_the_vehicles_frame_turns_with_it() {
        let mut track = track();
        for boot_ns in [S, 2 * S] {
            let attitude = euler_to_ned(0.0, -core::f64::consts::FRAC_PI_2, 0.0);
            track.push_gimbal(GimbalSample { boot_ns, attitude, yaw_in_vehicle_frame: true });
        }
        let pose = track.pose_at(2 * S - S / 25).expect("a pose");
        let gimbal = pose.gimbal.expect("reported");
        assert!((gimbal * DVec3::X + DVec3::Z).length() < 1e-9, "looks down");
        assert!((gimbal * DVec3::Z - pose.attitude * DVec3::X).length() < 1e-9, "its up is the heading");
    }
}
