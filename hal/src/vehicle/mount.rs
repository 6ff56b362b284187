//! From the body's pose to the camera's: gimbal or fixed mount, lever arm, and the uncertainty turned into the camera's axes.

use config::mission::{MountAttitude, MountSettings};
use geometry::geodesy::EnuFrame;
use glam::{DMat3, DQuat, DVec3};

use super::{CameraPose, PoseReport};
use crate::autopilot::Autopilot;
use crate::camera::ExifPose;
use crate::frames::{camera_to_mount, fixed_mount};
use crate::pose::BodyPose;

/// Uncertainty of a gimbal's own angles, rad (encoders and mounting; DJI states ±0.02°, hobby gimbals 0.5°).
const GIMBAL_SIGMA: f64 = 0.009;
/// Uncertainty of a pose from EXIF data: GPS without accuracy, altitude by barometer, angles measured against SfM.
const EXIF_POSITION_SIGMA: [f32; 3] = [2.0, 2.0, 5.0];
const EXIF_ROTATION_SIGMA: f32 = 0.05;

/// How the camera sits on the airframe, and where the world's origin is.
pub struct Mount {
    frame: EnuFrame,
    /// Mount → body; `None` when the gimbal says.
    fixed: Option<DQuat>,
    lever: DVec3,
    /// Where a gimbal is set to look, radians above the horizon, when the mission says so.
    gimbal_pitch: Option<f64>,
    max_tilt: f64,
}

impl Mount {
    /// The mount of a mission, with the origin of its frame.
    pub fn new(settings: &MountSettings, frame: EnuFrame) -> Self {
        let fixed = match settings.attitude {
            MountAttitude::Gimbal => None,
            MountAttitude::Fixed => Some(fixed_mount(settings.rotation_deg)),
        };
        Self {
            frame,
            fixed,
            lever: DVec3::from(settings.lever_arm_m.map(f64::from)),
            gimbal_pitch: (settings.rotation_deg != [0.0; 3]).then(|| f64::from(settings.rotation_deg[1]).to_radians()),
            max_tilt: f64::from(settings.max_tilt_deg).to_radians(),
        }
    }

    /// The camera's pose; `None` when the mount needs a gimbal attitude that is missing. `time_sigma_s` is how far the
    /// instant of exposure may be off.
    pub fn camera_pose(&self, body: &BodyPose, time_sigma_s: f64) -> Option<CameraPose> {
        let mount = match self.fixed {
            Some(fixed) => body.attitude * fixed,
            None => body.gimbal?,
        };
        let rotation = (mount * camera_to_mount()).normalize();
        let position = self.frame.to_enu(body.position) + body.attitude * self.lever;
        let blur = body.velocity * time_sigma_s;
        let sum = |a: f64, b: f64| a.hypot(b) as f32;
        let sigma = body.position_sigma_m;
        let variance = body.attitude_sigma_rad * body.attitude_sigma_rad;
        // Diagonal of Rᵀ Σ R: the uncertainty about the world's axes, seen about the camera's.
        let axes = DMat3::from_quat(rotation);
        let about = |axis: DVec3| {
            let v = (axis * axis).dot(variance) + if self.fixed.is_none() { GIMBAL_SIGMA * GIMBAL_SIGMA } else { 0.0 };
            v.sqrt() as f32
        };
        Some(CameraPose {
            position,
            rotation,
            position_sigma_m: [sum(sigma.x, blur.x), sum(sigma.y, blur.y), sum(sigma.z, blur.z)],
            rotation_sigma_rad: [about(axes.x_axis), about(axes.y_axis), about(axes.z_axis)],
        })
    }

    /// Whether the camera looked further than the mission allows from where its mount points it on a level airframe.
    pub(super) fn is_tilted(&self, body: &BodyPose) -> bool {
        let tilt = match (self.fixed, body.gimbal, self.gimbal_pitch) {
            (Some(fixed), ..) => {
                let nose = body.attitude * DVec3::X;
                let level = DQuat::from_rotation_z(nose.y.atan2(nose.x));
                (body.attitude * fixed * DVec3::X).angle_between(level * fixed * DVec3::X)
            }
            // A gimbal turns about the vertical as it likes; its pitch is what was planned.
            (None, Some(gimbal), Some(pitch)) => ((gimbal * DVec3::X).z.clamp(-1.0, 1.0).asin() - pitch).abs(),
            (None, ..) => 0.0,
        };
        tilt > self.max_tilt
    }

    /// The camera's pose out of a picture's own data; `None` without angles.
    pub(super) fn exif_pose(&self, exif: &ExifPose) -> Option<CameraPose> {
        Some(CameraPose {
            position: self.frame.to_enu(exif.position),
            rotation: (exif.mount? * camera_to_mount()).normalize(),
            position_sigma_m: EXIF_POSITION_SIGMA,
            rotation_sigma_rad: [EXIF_ROTATION_SIGMA; 3],
        })
    }

    /// The newest pose of the body.
    pub(super) fn report(&self, autopilot: &Autopilot, now_ns: u64) -> Option<PoseReport> {
        let newest = autopilot.track().newest_position()?;
        let body = autopilot.pose_near(newest.boot_ns).ok()?;
        Some(PoseReport {
            time_ns: autopilot.clock().to_companion_ns(newest.boot_ns).unwrap_or(now_ns),
            position: self.frame.to_enu(body.position),
            velocity: body.velocity,
            rotation: body.attitude,
            position_sigma_m: body.position_sigma_m.as_vec3().to_array(),
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::frames::{attitude_to_enu, euler_to_ned};
    use geometry::geodesy::Geodetic;

    #[test]
    fn lever_arm_and_uncertainty_turn_with_the_airframe() {
        let origin = Geodetic { lat_deg: 46.0, lon_deg: 7.0, alt_m: 400.0 };
        let settings = MountSettings {
            attitude: MountAttitude::Fixed,
            rotation_deg: [0.0, -90.0, 0.0],
            lever_arm_m: [0.3, 0.1, -0.2],
            ..MountSettings::default()
        };
        let mount = Mount::new(&settings, EnuFrame::new(origin));
        let body = BodyPose {
            position: origin,
            velocity: DVec3::new(8.0, 0.0, 0.0),
            attitude: attitude_to_enu(euler_to_ned(0.0, 0.0, std::f64::consts::FRAC_PI_2)),
            gimbal: None,
            position_sigma_m: DVec3::splat(0.5),
            attitude_sigma_rad: DVec3::new(0.01, 0.01, 0.05),
        };
        let pose = mount.camera_pose(&body, 0.1).expect("fixed mount");
        // Nose east: forward is east, left is north.
        assert!((pose.position - DVec3::new(0.3, 0.1, -0.2)).length() < 1e-6, "{}", pose.position);
        assert!((pose.position_sigma_m[0] - 0.5f32.hypot(0.8)).abs() < 1e-6);
        // A nadir camera turns about its optical axis when the heading is off.
        assert!((pose.rotation_sigma_rad[2] - 0.05).abs() < 1e-6 && (pose.rotation_sigma_rad[0] - 0.01).abs() < 1e-6);
        let gimbal = MountSettings { attitude: MountAttitude::Gimbal, ..settings };
        assert!(Mount::new(&gimbal, EnuFrame::new(origin)).camera_pose(&body, 0.0).is_none());
    }

    #[test]
    fn a_steep_bank_tilts_a_fixed_camera_and_a_held_gimbal_stays_level() {
        let origin = Geodetic { lat_deg: 46.0, lon_deg: 7.0, alt_m: 400.0 };
        let settings =
            MountSettings { rotation_deg: [0.0, -90.0, 0.0], max_tilt_deg: 40.0, ..MountSettings::default() };
        let banked = |roll_deg: f64, gimbal_pitch_deg: f64| BodyPose {
            position: origin,
            velocity: DVec3::ZERO,
            attitude: attitude_to_enu(euler_to_ned(roll_deg.to_radians(), 0.05, 2.0)),
            gimbal: Some(attitude_to_enu(euler_to_ned(0.0, gimbal_pitch_deg.to_radians(), 2.0))),
            position_sigma_m: DVec3::ONE,
            attitude_sigma_rad: DVec3::splat(0.01),
        };
        let tilted = |settings: &MountSettings, body| Mount::new(settings, EnuFrame::new(origin)).is_tilted(&body);
        let fixed = MountSettings { attitude: MountAttitude::Fixed, ..settings };
        assert!(tilted(&fixed, banked(45.0, -90.0)) && !tilted(&fixed, banked(35.0, -90.0)));
        assert!(!tilted(&settings, banked(45.0, -89.0)) && tilted(&settings, banked(0.0, -45.0)));
        let unsaid = MountSettings { rotation_deg: [0.0; 3], ..settings };
        assert!(!tilted(&unsaid, banked(0.0, -45.0)), "nobody said where the gimbal should look");
        assert!(!tilted(&MountSettings { max_tilt_deg: 180.0, ..fixed }, banked(170.0, 0.0)), "switched off");
    }
}
