//! `[camera]` and `[mount]`: the lens as calibrated, where its pictures come from, and how it sits on the aircraft.

use std::path::PathBuf;

use serde::{Deserialize, Serialize};

use crate::settings::{Limits, SettingError, Value, choice, record, table};

record! {
    /// Calibration of the camera, pixels of the full picture; the centre of the top-left pixel is at (0.5, 0.5).
    #[derive(Copy)]
    pub struct CameraSettings {
        // Beyond 16,384 a Pi-class companion cannot even decode in time.
        /// Picture width.
        pub width: u32, in Limits::within(1.0, 16_384.0), unit "pixels";
        /// Picture height.
        pub height: u32, in Limits::within(1.0, 16_384.0), unit "pixels";
        /// Focal length along x.
        pub fx: f32, in Limits::above(0.0), unit "pixels";
        /// Focal length along y.
        pub fy: f32, in Limits::above(0.0), unit "pixels";
        /// Principal point x.
        pub cx: f32, unit "pixels";
        /// Principal point y.
        pub cy: f32, unit "pixels";
        /// Brown–Conrady k1, k2, p1, p2 (OpenCV's order); zeros for pictures that are already undistorted.
        #[serde(default)]
        pub distortion: [f32; 4] = [0.0; 4];
        /// From the trigger's time stamp (of a video device, the driver's) to the middle of the exposure; most drivers stamp
        /// the end of a picture, so that it is negative there.
        #[serde(default)]
        pub exposure_delay_ms: f32 = 0.0, in Limits::within(-10_000.0, 10_000.0);
        /// Which of the aircraft's cameras takes the pictures, as the autopilot numbers them (`cam_idx` of CAMERA_FEEDBACK, counted
        /// from 0, `camera_id` of CAMERA_IMAGE_CAPTURED); not said = the one whose exposures fit the pictures.
        #[serde(default)]
        pub index: Option<u8> = None;
    }
}

impl CameraSettings {
    /// A camera without distortion whose optical axis is the middle of its picture; `focal` in pixels.
    pub const fn pinhole(width: u32, height: u32, focal: f32) -> Self {
        Self {
            width,
            height,
            fx: focal,
            fy: focal,
            cx: width as f32 / 2.0,
            cy: height as f32 / 2.0,
            distortion: [0.0; 4],
            exposure_delay_ms: 0.0,
            index: None,
        }
    }
}

choice! {
    /// Where the camera's attitude comes from.
    pub enum MountAttitude {
        /// The autopilot reports it (GIMBAL_DEVICE_ATTITUDE_STATUS).
        Gimbal = "gimbal",
        /// Bolted to the airframe at `rotation_deg`.
        Fixed = "fixed",
    }
}

table! {
    /// How the camera sits on the aircraft.
    #[derive(Copy)]
    pub struct MountSettings {
        /// Where the camera's attitude comes from.
        pub attitude: MountAttitude = MountAttitude::Gimbal;
        /// Roll, pitch, yaw of the optical axis against the airframe for a fixed mount; pitch −90 looks down. For a gimbal the
        /// pitch it is set to, only for `max_tilt_deg`; zeros = not known.
        pub rotation_deg: [f32; 3] = [0.0; 3];
        /// Camera centre in the body, forward, left, up of the position the autopilot reports.
        pub lever_arm_m: [f32; 3] = [0.0; 3];
        /// Device id of the gimbal that carries the camera (1 to 6 on the autopilot, else its component); 0 = the lowest heard.
        pub gimbal: u8 = 0, in Limits::within(0.0, 255.0);
        /// Exposures are left out when the optical axis is further than this from where the mount points it on a level airframe
        /// (ArduPilot's "trigger immediately" fires while the aircraft banks); 180 = never.
        pub max_tilt_deg: f32 = 50.0, in Limits::above(0.0).up_to(180.0),
            from "beyond what an autopilot flies on purpose: ArduPlane's ROLL_LIMIT_DEG is 45, ArduCopter's ANGLE_MAX 30";
    }
}

/// Where an aircraft's pictures come from.
#[derive(Clone, Debug, PartialEq, Eq, Deserialize, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum CameraSource {
    /// A folder that another program writes JPEG or PNG files into.
    Folder(PathBuf),
    /// A program that writes an MJPEG stream to its standard output, with its arguments.
    Command(Vec<String>),
    /// A video device of the kernel, e.g. `/dev/video0`; only in programs built with the feature `v4l2`.
    V4l2(PathBuf),
}

impl Value for CameraSource {
    fn check(&self, _: &Limits) -> Result<(), SettingError> {
        let wanted = match self {
            Self::Command(words) if words.is_empty() => "a program with its arguments",
            Self::V4l2(device) if !device.is_absolute() => "the device's whole path, e.g. /dev/video0",
            _ => return Ok(()),
        };
        Err(SettingError::new("", self, wanted))
    }
}
