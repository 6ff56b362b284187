//! What an ArduPilot says about its state, message by message, in its units.

use geometry::geodesy::{EnuFrame, Geodetic};
use glam::{DQuat, DVec3};

use super::track::Sample;
use hal::frames::{ned_to_enu, yaw_of_ned};
use hal::mavlink::dialect::{
    ATTITUDE_QUATERNION_DATA, CAMERA_FEEDBACK_DATA, CAMERA_IMAGE_CAPTURED_DATA, CAMERA_TRIGGER_DATA, COMMAND_LONG_DATA,
    CameraFeedbackFlags, GIMBAL_DEVICE_ATTITUDE_STATUS_DATA, GLOBAL_POSITION_INT_DATA, GPS_RAW_INT_DATA,
    GimbalDeviceFlags, GpsFixType, HEARTBEAT_DATA, MavAutopilot, MavBool, MavCmd, MavModeFlag, MavState, MavType,
    SIM_STATE_DATA,
};

/// ArduCopter's custom mode number of AUTO.
const COPTER_AUTO: u32 = 3;

fn degrees_e7(degrees: f64) -> i32 {
    (degrees * 1e7).round() as i32
}

fn millimetres(metres: f64) -> i32 {
    (metres * 1e3).round() as i32
}

fn centimetres(ms: f64) -> i16 {
    (ms * 100.0).round() as i16
}

/// Heading in hundredths of a degree, 0..35999.
fn heading_cdeg(attitude: DQuat) -> u16 {
    (yaw_of_ned(attitude).to_degrees() * 100.0).round().rem_euclid(36_000.0) as u16
}

/// MAVLink's order is w, x, y, z; the sign is chosen so that w is never negative.
fn wxyz(q: DQuat) -> [f32; 4] {
    let q = if q.w < 0.0 { -q } else { q };
    [q.w as f32, q.x as f32, q.y as f32, q.z as f32]
}

/// HEARTBEAT of an armed quadrotor in AUTO.
pub fn heartbeat() -> HEARTBEAT_DATA {
    HEARTBEAT_DATA {
        custom_mode: COPTER_AUTO,
        mavtype: MavType::MAV_TYPE_QUADROTOR,
        autopilot: MavAutopilot::MAV_AUTOPILOT_ARDUPILOTMEGA,
        base_mode: MavModeFlag::MAV_MODE_FLAG_SAFETY_ARMED
            | MavModeFlag::MAV_MODE_FLAG_AUTO_ENABLED
            | MavModeFlag::MAV_MODE_FLAG_CUSTOM_MODE_ENABLED,
        system_status: MavState::MAV_STATE_ACTIVE,
        mavlink_version: 3,
    }
}

/// Position and velocity; altitude relative to home, which is the frame's origin.
pub fn position(boot_ms: u32, s: &Sample, at: Geodetic, frame: &EnuFrame) -> GLOBAL_POSITION_INT_DATA {
    let v = ned_to_enu(s.velocity);
    GLOBAL_POSITION_INT_DATA {
        time_boot_ms: boot_ms,
        lat: degrees_e7(at.lat_deg),
        lon: degrees_e7(at.lon_deg),
        alt: millimetres(at.alt_m),
        relative_alt: millimetres(at.alt_m - frame.origin().alt_m),
        vx: centimetres(v.x),
        vy: centimetres(v.y),
        vz: centimetres(v.z),
        hdg: heading_cdeg(s.attitude),
    }
}

/// Attitude with rates about the body's axes, rad/s.
pub fn attitude(boot_ms: u32, attitude: DQuat, rates: DVec3) -> ATTITUDE_QUATERNION_DATA {
    let q = wxyz(attitude);
    ATTITUDE_QUATERNION_DATA {
        time_boot_ms: boot_ms,
        q1: q[0],
        q2: q[1],
        q3: q[2],
        q4: q[3],
        rollspeed: rates.x as f32,
        pitchspeed: rates.y as f32,
        yawspeed: rates.z as f32,
        repr_offset_q: [0.0; 4],
    }
}

/// Gimbal attitude with yaw against north.
pub fn gimbal(boot_ms: u32, attitude: DQuat) -> GIMBAL_DEVICE_ATTITUDE_STATUS_DATA {
    GIMBAL_DEVICE_ATTITUDE_STATUS_DATA {
        time_boot_ms: boot_ms,
        q: wxyz(attitude),
        angular_velocity_x: f32::NAN,
        angular_velocity_y: f32::NAN,
        angular_velocity_z: f32::NAN,
        flags: GimbalDeviceFlags::GIMBAL_DEVICE_FLAGS_ROLL_LOCK
            | GimbalDeviceFlags::GIMBAL_DEVICE_FLAGS_PITCH_LOCK
            | GimbalDeviceFlags::GIMBAL_DEVICE_FLAGS_YAW_LOCK
            | GimbalDeviceFlags::GIMBAL_DEVICE_FLAGS_YAW_IN_EARTH_FRAME,
        delta_yaw: f32::NAN,
        delta_yaw_velocity: f32::NAN,
        ..Default::default()
    }
}

/// The receiver's own view, with the accuracy it believes in (one standard deviation, metres).
pub fn gps(unix_us: u64, s: &Sample, at: Geodetic, fix: bool, sigma_m: f64) -> GPS_RAW_INT_DATA {
    let speed = s.velocity.truncate().length();
    let course = s.velocity.x.atan2(s.velocity.y).to_degrees().rem_euclid(360.0);
    GPS_RAW_INT_DATA {
        time_usec: unix_us,
        lat: degrees_e7(at.lat_deg),
        lon: degrees_e7(at.lon_deg),
        alt: millimetres(at.alt_m),
        eph: if fix { 70 } else { u16::MAX },
        epv: if fix { 110 } else { u16::MAX },
        vel: (speed * 100.0).round() as u16,
        cog: ((course * 100.0).round() as u16) % 36_000,
        fix_type: if fix { GpsFixType::GPS_FIX_TYPE_3D_FIX } else { GpsFixType::GPS_FIX_TYPE_NO_FIX },
        satellites_visible: if fix { 17 } else { 0 },
        alt_ellipsoid: millimetres(at.alt_m),
        h_acc: millimetres(if fix { sigma_m } else { 500.0 }) as u32,
        v_acc: millimetres(if fix { 1.5 * sigma_m } else { 500.0 }) as u32,
        vel_acc: if fix { 200 } else { 50_000 },
        hdg_acc: 0,
        yaw: 0,
    }
}

/// Announcement of an exposure; the angles are the vehicle's, not the camera's.
pub fn feedback(time_us: u64, index: u16, s: &Sample, at: Geodetic, frame: &EnuFrame) -> CAMERA_FEEDBACK_DATA {
    let (yaw, pitch, roll) = s.attitude.to_euler(glam::EulerRot::ZYX);
    CAMERA_FEEDBACK_DATA {
        time_usec: time_us,
        lat: degrees_e7(at.lat_deg),
        lng: degrees_e7(at.lon_deg),
        alt_msl: at.alt_m as f32,
        alt_rel: (at.alt_m - frame.origin().alt_m) as f32,
        roll: roll.to_degrees() as f32,
        pitch: pitch.to_degrees() as f32,
        yaw: yaw.to_degrees().rem_euclid(360.0) as f32,
        foc_len: 0.0,
        img_idx: index,
        target_system: 0,
        cam_idx: 0,
        flags: CameraFeedbackFlags::CAMERA_FEEDBACK_PHOTO,
        completed_captures: index,
    }
}

/// The component id of the first camera, MAV_COMP_ID_CAMERA.
const CAMERA_COMPONENT: u8 = 100;

/// PX4's announcement of an exposure: time since boot, and its counter.
pub fn camera_trigger(boot_us: u64, sequence: u16) -> CAMERA_TRIGGER_DATA {
    CAMERA_TRIGGER_DATA { time_usec: boot_us, seq: sequence.into() }
}

/// An exposure as a command to the camera of the system; PX4 sends both this and [`digicam_control`].
pub fn image_start_capture(system: u8) -> COMMAND_LONG_DATA {
    COMMAND_LONG_DATA {
        command: MavCmd::MAV_CMD_IMAGE_START_CAPTURE,
        target_system: system,
        target_component: CAMERA_COMPONENT,
        param3: 1.0,
        param4: f32::NAN,
        param5: f32::NAN,
        param6: f32::NAN,
        param7: f32::NAN,
        ..COMMAND_LONG_DATA::default()
    }
}

/// An exposure in the older way, to every system.
pub fn digicam_control() -> COMMAND_LONG_DATA {
    COMMAND_LONG_DATA {
        command: MavCmd::MAV_CMD_DO_DIGICAM_CONTROL,
        target_system: 0,
        target_component: CAMERA_COMPONENT,
        param1: f32::NAN,
        param2: f32::NAN,
        param3: f32::NAN,
        param4: f32::NAN,
        param5: 1.0,
        param6: f32::NAN,
        param7: f32::NAN,
        ..COMMAND_LONG_DATA::default()
    }
}

/// A picture was taken; `q` is the vehicle's attitude and the relative altitude is not known, as PX4 has it.
pub fn image_captured(boot_us: u64, unix_us: u64, index: u16, s: &Sample, at: Geodetic) -> CAMERA_IMAGE_CAPTURED_DATA {
    CAMERA_IMAGE_CAPTURED_DATA {
        time_utc: unix_us,
        time_boot_ms: (boot_us / 1000) as u32,
        lat: degrees_e7(at.lat_deg),
        lon: degrees_e7(at.lon_deg),
        alt: millimetres(at.alt_m),
        relative_alt: -1000,
        q: wxyz(s.attitude),
        image_index: index.into(),
        camera_id: 1,
        capture_result: MavBool::MAV_BOOL_TRUE,
        ..CAMERA_IMAGE_CAPTURED_DATA::default()
    }
}

/// Place, attitude (FRD → NED) and velocity (ENU) in what [`sim_state`] says.
pub fn truth(m: &SIM_STATE_DATA) -> (Geodetic, DQuat, DVec3) {
    let at =
        Geodetic { lat_deg: f64::from(m.lat_int) * 1e-7, lon_deg: f64::from(m.lon_int) * 1e-7, alt_m: m.alt.into() };
    let attitude = DQuat::from_xyzw(m.q2.into(), m.q3.into(), m.q4.into(), m.q1.into()).normalize();
    (at, attitude, ned_to_enu(DVec3::new(m.vn.into(), m.ve.into(), m.vd.into())))
}

/// The simulator's truth.
pub fn sim_state(s: &Sample, at: Geodetic, rates: DVec3) -> SIM_STATE_DATA {
    let q = wxyz(s.attitude);
    let (yaw, pitch, roll) = s.attitude.to_euler(glam::EulerRot::ZYX);
    let v = ned_to_enu(s.velocity);
    SIM_STATE_DATA {
        q1: q[0],
        q2: q[1],
        q3: q[2],
        q4: q[3],
        roll: roll as f32,
        pitch: pitch as f32,
        yaw: yaw as f32,
        xgyro: rates.x as f32,
        ygyro: rates.y as f32,
        zgyro: rates.z as f32,
        lat: at.lat_deg as f32,
        lon: at.lon_deg as f32,
        alt: at.alt_m as f32,
        vn: v.x as f32,
        ve: v.y as f32,
        vd: v.z as f32,
        lat_int: degrees_e7(at.lat_deg),
        lon_int: degrees_e7(at.lon_deg),
        ..Default::default()
    }
}
