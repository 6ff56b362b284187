//! Camera and gimbal attitudes as simulators and recordings need them: the inverse direction of what the decoder does,
//! built from the same [`hal::frames`].

use glam::DQuat;

use hal::frames::{attitude_to_enu, attitude_to_ned, camera_to_mount, euler_to_ned};

/// Camera (OpenCV) → ENU out of gimbal (FRD, x along the optical axis) → NED.
pub fn camera_to_enu(gimbal: DQuat) -> DQuat {
    (attitude_to_enu(gimbal) * camera_to_mount()).normalize()
}

/// Gimbal (FRD) → NED out of camera → ENU: inverse of [`camera_to_enu`].
pub fn gimbal_to_ned(camera: DQuat) -> DQuat {
    attitude_to_ned(camera * camera_to_mount().conjugate())
}

/// FRD → NED from angles in degrees as DJI and MAVLink give them: yaw clockwise from north, pitch −90 straight down.
pub fn from_degrees(yaw: f64, pitch: f64, roll: f64) -> DQuat {
    euler_to_ned(roll.to_radians(), pitch.to_radians(), yaw.to_radians())
}

#[cfg(test)]
mod tests {
    use super::*;
    use glam::DVec3;

    #[test]
    fn dji_angles_give_the_axes_the_data_set_documents() {
        // forward = (sin y cos p, cos y cos p, sin p), right = (cos y, −sin y, 0) in ENU.
        for (yaw, pitch) in [(0.0, -70.0), (57.0, -17.0), (-143.0, -86.0), (172.0, 23.0)] {
            let gimbal = from_degrees(yaw, pitch, 0.0);
            let camera = camera_to_enu(gimbal);
            let ((sy, cy), (sp, cp)) = (f64::to_radians(yaw).sin_cos(), f64::to_radians(pitch).sin_cos());
            assert!((camera * DVec3::Z - DVec3::new(sy * cp, cy * cp, sp)).length() < 1e-12);
            assert!((camera * DVec3::X - DVec3::new(cy, -sy, 0.0)).length() < 1e-12);
            assert!(gimbal_to_ned(camera).dot(gimbal).abs() > 1.0 - 1e-12);
        }
    }
}
