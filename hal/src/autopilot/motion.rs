//! Position and attitude messages into the track: units, frames, which of several sources is believed, and what is too
//! wild to be true.

use geometry::geodesy::{EnuFrame, Geodetic};
use glam::{DQuat, DVec3};

use super::mounts::{Believed, Gimbal};
use super::{Autopilot, Handled};
use crate::frames::{euler_to_ned, ned_to_enu};
use crate::mavlink::Frame;
use crate::mavlink::dialect::{
    ATTITUDE_DATA, ATTITUDE_QUATERNION_DATA, GIMBAL_DEVICE_ATTITUDE_STATUS_DATA, GLOBAL_POSITION_INT_DATA,
    GPS_GLOBAL_ORIGIN_DATA, GPS_RAW_INT_DATA, GimbalDeviceFlags, MavFrame, ODOMETRY_DATA,
};
use crate::pose::track::{AttitudeSample, GimbalSample, PositionSample, moved};

/// A better source keeps worse ones out for this long after its last sample.
const HOLD_NS: u64 = 1_000_000_000;
/// No multicopter turns faster than this; a faster change is a spike. rad/s, and what noise may add, rad.
const MAX_TURN: f64 = 15.0;
const TURN_SLACK: f64 = 0.2;
/// A position off the track by more than this (m, plus acceleration over the gap, m/s²) is a spike.
const MAX_OFFSET: f64 = 5.0;
const MAX_ACCELERATION: f64 = 30.0;
/// So many spikes in a row are the truth: the estimate stepped.
const SPIKES: u8 = 4;
/// After a step the position is trusted only within the step's size, for this long.
const STEP_HOLD_NS: u64 = 10_000_000_000;
/// Without GPS_RAW_INT's accuracy fields: metres per unit of HDOP (GPS standard positioning service).
const METRES_PER_HDOP: f64 = 1.5;
/// Position uncertainty before anything is known about it, and without a fix, m.
const UNKNOWN_SIGMA_M: f64 = 3.0;
const NO_FIX_SIGMA_M: f64 = 100.0;
/// Uncertainty of attitude: ArduPilot and PX4 hold 1° of tilt; heading rests on a compass (measured against SfM on real
/// flights: 1.4° bias, 1.5° noise).
const TILT_SIGMA: f64 = 0.0175;
const HEADING_SIGMA: f64 = 0.045;

/// What is remembered between motion messages.
#[derive(Default)]
pub(super) struct Motion {
    gps_sigma_m: Option<DVec3>,
    origin: Option<Geodetic>,
    odometry_resets: Option<u8>,
    attitude_rank: u8,
    attitude_heard_ns: u64,
    global_heard_ns: Option<u64>,
    attitude_spikes: u8,
    position_spikes: u8,
    step_m: f64,
    step_boot_ns: u64,
}

fn unit(q: [f32; 4]) -> Option<DQuat> {
    let [w, x, y, z] = q.map(f64::from);
    let q = DQuat::from_xyzw(x, y, z, w);
    let norm = q.length();
    // Half a unit either way: truncated telemetry is mended, garbage is not.
    if norm.is_finite() && (0.5..2.0).contains(&norm) { Some(q.normalize()) } else { None }
}

impl Autopilot {
    pub(super) fn on_global_position(&mut self, frame: &Frame<'_>, now_ns: u64) -> Handled {
        let Some(m) = frame.message::<GLOBAL_POSITION_INT_DATA>() else { return Handled::Other };
        let boot_ns = self.stamp(m.time_boot_ms, now_ns);
        let position = Geodetic {
            lat_deg: f64::from(m.lat) * 1e-7,
            lon_deg: f64::from(m.lon) * 1e-7,
            alt_m: f64::from(m.alt) * 1e-3,
        };
        // Exactly 0, 0 is what autopilots send before the first fix.
        if m.lat == 0 && m.lon == 0 {
            self.counters.telemetry.unfixed += 1;
            return Handled::Other;
        }
        if !position.is_valid() {
            self.counters.telemetry.impossible += 1;
            return Handled::Other;
        }
        let cm_s = |v: i16| f64::from(v) * 0.01;
        let velocity = ned_to_enu(DVec3::new(cm_s(m.vx), cm_s(m.vy), cm_s(m.vz)));
        self.landing.on_motion(f64::from(m.relative_alt) * 1e-3, velocity.length(), now_ns);
        self.state.home_alt_m = Some(position.alt_m - f64::from(m.relative_alt) * 1e-3);
        self.motion.global_heard_ns = Some(boot_ns);
        let sigma_m = self.motion.gps_sigma_m.unwrap_or(DVec3::splat(UNKNOWN_SIGMA_M));
        self.add_position(PositionSample { boot_ns, position, velocity, sigma_m })
    }

    pub(super) fn on_odometry(&mut self, frame: &Frame<'_>, now_ns: u64) -> Handled {
        let Some(m) = frame.message::<ODOMETRY_DATA>() else { return Handled::Other };
        let fields = [m.x, m.y, m.z, m.vx, m.vy, m.vz];
        let (Some(q), true) = (unit(m.q), fields.iter().all(|v| v.is_finite())) else {
            self.counters.telemetry.impossible += 1;
            return Handled::Other;
        };
        // Only a frame tied to north can be placed in the world; only a body frame makes `q` an attitude.
        let child_is_body = m.child_frame_id == MavFrame::MAV_FRAME_BODY_FRD;
        let Some(boot_ns) = self.place_us(m.time_usec) else { return Handled::Other };
        if m.frame_id != MavFrame::MAV_FRAME_LOCAL_NED || !child_is_body {
            return Handled::Other;
        }
        self.clock.arrival(now_ns, boot_ns);
        if self.motion.odometry_resets.replace(m.reset_counter).is_some_and(|r| r != m.reset_counter) {
            self.counters.telemetry.position_steps += 1;
            self.track.clear_positions();
        }
        self.add_attitude(AttitudeSample { boot_ns, frd_to_ned: q, sigma_rad: attitude_sigma() }, 1);
        let global = self.motion.global_heard_ns.is_some_and(|t| boot_ns.saturating_sub(t) < HOLD_NS);
        let (Some(origin), false) = (self.motion.origin, global) else { return Handled::Other };
        let enu = ned_to_enu(DVec3::new(m.x.into(), m.y.into(), m.z.into()));
        if enu.length() > 1e5 {
            self.counters.telemetry.impossible += 1;
            return Handled::Other;
        }
        let velocity = ned_to_enu(q * DVec3::new(m.vx.into(), m.vy.into(), m.vz.into()));
        // Row-major upper triangle of 6 × 6: variances of x, y, z at 0, 6, 11; NaN at 0 = unknown.
        let sigma = |i: usize| libm::sqrt(f64::from(m.pose_covariance[i]));
        let sigma_m = if m.pose_covariance[0] > 0.0 {
            DVec3::new(sigma(6), sigma(0), sigma(11))
        } else {
            self.motion.gps_sigma_m.unwrap_or(DVec3::splat(UNKNOWN_SIGMA_M))
        };
        let sigma_m = if sigma_m.is_finite() { sigma_m } else { DVec3::splat(UNKNOWN_SIGMA_M) };
        let position = EnuFrame::new(origin).to_geodetic(enu);
        self.add_position(PositionSample { boot_ns, position, velocity, sigma_m })
    }

    pub(super) fn on_attitude_quaternion(&mut self, frame: &Frame<'_>, now_ns: u64) {
        let Some(m) = frame.message::<ATTITUDE_QUATERNION_DATA>() else { return };
        let boot_ns = self.stamp(m.time_boot_ms, now_ns);
        match unit([m.q1, m.q2, m.q3, m.q4]) {
            Some(q) => {
                self.add_attitude(AttitudeSample { boot_ns, frd_to_ned: q, sigma_rad: attitude_sigma() }, 3);
            }
            None => self.counters.telemetry.impossible += 1,
        }
    }

    pub(super) fn on_attitude(&mut self, frame: &Frame<'_>, now_ns: u64) {
        let Some(m) = frame.message::<ATTITUDE_DATA>() else { return };
        let boot_ns = self.stamp(m.time_boot_ms, now_ns);
        if ![m.roll, m.pitch, m.yaw].iter().all(|a| a.abs() <= 7.0) {
            self.counters.telemetry.impossible += 1;
            return;
        }
        let frd_to_ned = euler_to_ned(m.roll.into(), m.pitch.into(), m.yaw.into());
        self.add_attitude(AttitudeSample { boot_ns, frd_to_ned, sigma_rad: attitude_sigma() }, 2);
    }

    pub(super) fn on_gimbal(&mut self, frame: &Frame<'_>, now_ns: u64) {
        let Some(m) = frame.message::<GIMBAL_DEVICE_ATTITUDE_STATUS_DATA>() else { return };
        let Some(attitude) = unit(m.q) else {
            self.counters.telemetry.impossible += 1;
            return;
        };
        // A gimbal with a component of its own has a clock of its own.
        let boot_ns = if frame.component() == self.ids.autopilot {
            self.stamp(m.time_boot_ms, now_ns)
        } else {
            match self.clock.to_boot_ns(now_ns) {
                Some(boot_ns) => boot_ns,
                None => return,
            }
        };
        let gimbal = Gimbal::new(frame.component(), m.gimbal_device_id, self.ids.autopilot);
        match self.mounts.hear(gimbal) {
            Believed::Yes => {}
            Believed::Instead => self.track.clear_gimbals(),
            Believed::No => {
                self.counters.link.foreign += 1;
                return;
            }
        }
        let has = |flag| m.flags.contains(flag);
        let yaw_in_vehicle_frame = if has(GimbalDeviceFlags::GIMBAL_DEVICE_FLAGS_YAW_IN_VEHICLE_FRAME) {
            true
        } else if has(GimbalDeviceFlags::GIMBAL_DEVICE_FLAGS_YAW_IN_EARTH_FRAME) {
            false
        } else {
            !has(GimbalDeviceFlags::GIMBAL_DEVICE_FLAGS_YAW_LOCK)
        };
        if self.track.push_gimbal(GimbalSample { boot_ns, attitude, yaw_in_vehicle_frame }) {
            self.counters.telemetry.gimbals += 1;
        }
    }

    pub(super) fn on_gps(&mut self, frame: &Frame<'_>) {
        let Some(m) = frame.message::<GPS_RAW_INT_DATA>() else { return };
        let fix = m.fix_type as u8;
        self.state.gps_fix = Some(fix);
        self.motion.gps_sigma_m = Some(if fix < 3 {
            DVec3::splat(NO_FIX_SIGMA_M)
        } else {
            let dop = |v: u16| if v == u16::MAX { UNKNOWN_SIGMA_M } else { f64::from(v) * 0.01 * METRES_PER_HDOP };
            let accuracy = |mm: u32, dop_m: f64| if mm == 0 { dop_m } else { f64::from(mm) * 1e-3 };
            // h_acc is the radius over both axes.
            let h = accuracy(m.h_acc, dop(m.eph)) * core::f64::consts::FRAC_1_SQRT_2;
            DVec3::new(h, h, accuracy(m.v_acc, 1.5 * dop(m.epv)))
        });
    }

    pub(super) fn on_origin(&mut self, frame: &Frame<'_>) {
        let Some(m) = frame.message::<GPS_GLOBAL_ORIGIN_DATA>() else { return };
        let origin = Geodetic {
            lat_deg: f64::from(m.latitude) * 1e-7,
            lon_deg: f64::from(m.longitude) * 1e-7,
            alt_m: f64::from(m.altitude) * 1e-3,
        };
        if origin.is_valid() && self.motion.origin.replace(origin).is_some_and(|o| o != origin) {
            self.counters.telemetry.position_steps += 1;
        }
    }

    fn add_attitude(&mut self, sample: AttitudeSample, rank: u8) {
        let motion = &mut self.motion;
        let held = sample.boot_ns.saturating_sub(motion.attitude_heard_ns) < HOLD_NS;
        if rank < motion.attitude_rank && held {
            return;
        }
        motion.attitude_rank = rank;
        motion.attitude_heard_ns = sample.boot_ns;
        if let Some(newest) = self.track.newest_attitude() {
            let dt = sample.boot_ns.saturating_sub(newest.boot_ns) as f64 * 1e-9;
            let turn = newest.frd_to_ned.angle_between(sample.frd_to_ned);
            if turn > MAX_TURN * dt + TURN_SLACK && motion.attitude_spikes < SPIKES {
                motion.attitude_spikes += 1;
                self.counters.telemetry.spikes += 1;
                return;
            }
        }
        motion.attitude_spikes = 0;
        if self.track.push_attitude(sample) {
            self.counters.telemetry.attitudes += 1;
        }
    }

    fn add_position(&mut self, mut sample: PositionSample) -> Handled {
        let motion = &mut self.motion;
        if let Some(newest) = self.track.newest_position() {
            let dt = sample.boot_ns.saturating_sub(newest.boot_ns) as f64 * 1e-9;
            let expected = moved(newest.position, newest.velocity * dt);
            let off = EnuFrame::new(expected).to_enu(sample.position).length();
            if off > MAX_OFFSET + 0.5 * MAX_ACCELERATION * dt * dt {
                if motion.position_spikes < SPIKES {
                    motion.position_spikes += 1;
                    self.counters.telemetry.spikes += 1;
                    return Handled::Other;
                }
                self.counters.telemetry.position_steps += 1;
                motion.step_m = off;
                motion.step_boot_ns = sample.boot_ns;
                self.track.clear_positions();
            }
        }
        motion.position_spikes = 0;
        if motion.step_m > 0.0 && sample.boot_ns.saturating_sub(motion.step_boot_ns) < STEP_HOLD_NS {
            sample.sigma_m = sample.sigma_m.max(DVec3::splat(motion.step_m));
        }
        if !self.track.push_position(sample) {
            return Handled::Other;
        }
        self.counters.telemetry.positions += 1;
        Handled::Position
    }
}

fn attitude_sigma() -> DVec3 {
    DVec3::new(TILT_SIGMA, TILT_SIGMA, HEADING_SIGMA)
}
