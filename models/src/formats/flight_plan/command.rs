//! Mission items as MAVLink's MAV_CMD and MAV_FRAME number them.

pub const NAV_WAYPOINT: u32 = 16;
pub const NAV_RETURN_TO_LAUNCH: u32 = 20;
pub const NAV_LAND: u32 = 21;
pub const NAV_TAKEOFF: u32 = 22;
pub const NAV_DELAY: u32 = 93;
pub const CONDITION_YAW: u32 = 115;
pub const DO_CHANGE_SPEED: u32 = 178;
/// One picture; written because older ArduPilot takes this as a mission item and IMAGE_START_CAPTURE not, and PX4 takes both.
pub const DO_DIGICAM_CONTROL: u32 = 203;
pub const DO_MOUNT_CONTROL: u32 = 205;
/// Pictures every so many metres from here on.
pub const DO_SET_CAM_TRIGG_DIST: u32 = 206;
pub const SET_CAMERA_MODE: u32 = 530;
pub const DO_GIMBAL_MANAGER_PITCHYAW: u32 = 1000;
pub const IMAGE_START_CAPTURE: u32 = 2000;
pub const IMAGE_STOP_CAPTURE: u32 = 2001;

pub const FRAME_GLOBAL: u32 = 0;
pub const FRAME_MISSION: u32 = 2;
pub const FRAME_RELATIVE: u32 = 3;
