//! Axes. The one place where MAVLink's world (North-East-Down, body forward-right-down) becomes ours (East-North-Up, body
//! forward-left-up) and where the camera's axes (OpenCV: x right, y down, z forward) meet the airframe's.

use glam::{DMat3, DQuat, DVec3};

/// NED vector → ENU vector (and back: it is its own inverse).
pub fn ned_to_enu(v: DVec3) -> DVec3 {
    DVec3::new(v.y, v.x, -v.z)
}

/// Body FRD → NED as MAVLink sends it (quaternion w, x, y, z) → body FLU → ENU.
pub fn attitude_to_enu(frd_to_ned: DQuat) -> DQuat {
    (ned_enu() * frd_to_ned * frd_flu()).normalize()
}

/// Inverse of [`attitude_to_enu`], for simulators that speak MAVLink.
pub fn attitude_to_ned(flu_to_enu: DQuat) -> DQuat {
    (ned_enu() * flu_to_enu * frd_flu()).normalize()
}

/// Aerospace angles (roll, pitch, yaw about x, y, z of FRD; yaw clockwise from north, pitch up positive), radians, →
/// body FRD → NED.
pub fn euler_to_ned(roll: f64, pitch: f64, yaw: f64) -> DQuat {
    DQuat::from_rotation_z(yaw) * DQuat::from_rotation_y(pitch) * DQuat::from_rotation_x(roll)
}

/// Heading of an attitude (FRD → NED): clockwise from north, radians.
pub fn yaw_of_ned(frd_to_ned: DQuat) -> f64 {
    let forward = frd_to_ned * DVec3::X;
    libm::atan2(forward.y, forward.x)
}

/// Camera (OpenCV) → its mount (FLU, optical axis forward).
pub fn camera_to_mount() -> DQuat {
    // Columns: where the camera's right, down and forward point in forward-left-up.
    DQuat::from_mat3(&DMat3::from_cols(-DVec3::Y, -DVec3::Z, DVec3::X))
}

/// A mount bolted to the airframe at aerospace angles (degrees; pitch −90 looks down): mount FLU → body FLU.
pub fn fixed_mount(rotation_deg: [f32; 3]) -> DQuat {
    let [roll, pitch, yaw] = rotation_deg.map(|d| f64::from(d).to_radians());
    frd_flu() * euler_to_ned(roll, pitch, yaw) * frd_flu()
}

/// NED ↔ ENU: half a turn about the line north-east.
fn ned_enu() -> DQuat {
    DQuat::from_xyzw(core::f64::consts::FRAC_1_SQRT_2, core::f64::consts::FRAC_1_SQRT_2, 0.0, 0.0)
}

/// FRD ↔ FLU: half a turn about forward.
fn frd_flu() -> DQuat {
    DQuat::from_xyzw(1.0, 0.0, 0.0, 0.0)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn close(a: DVec3, b: DVec3) {
        assert!((a - b).length() < 1e-12, "{a} against {b}");
    }

    #[test]
    fn axes_agree_with_hand_checked_cases() {
        close(ned_to_enu(DVec3::new(1.0, 2.0, 3.0)), DVec3::new(2.0, 1.0, -3.0));
        // Level, nose east: forward is east, left is north.
        let east = attitude_to_enu(euler_to_ned(0.0, 0.0, core::f64::consts::FRAC_PI_2));
        close(east * DVec3::X, DVec3::X);
        close(east * DVec3::Y, DVec3::Y);
        close(east * DVec3::Z, DVec3::Z);
        // Rolled right by 90°, nose north: left points up.
        let rolled = attitude_to_enu(euler_to_ned(core::f64::consts::FRAC_PI_2, 0.0, 0.0));
        close(rolled * DVec3::X, DVec3::Y);
        close(rolled * DVec3::Y, DVec3::Z);
        assert!(
            (attitude_to_ned(rolled).dot(euler_to_ned(core::f64::consts::FRAC_PI_2, 0.0, 0.0)).abs() - 1.0) < 1e-12
        );
    }

    #[test]
    fn a_nadir_camera_has_its_up_towards_the_heading() {
        let body = attitude_to_enu(euler_to_ned(0.0, 0.0, core::f64::consts::FRAC_PI_2));
        let camera = body * fixed_mount([0.0, -90.0, 0.0]) * camera_to_mount();
        close(camera * DVec3::Z, -DVec3::Z);
        close(camera * -DVec3::Y, DVec3::X);
        close(camera * DVec3::X, -DVec3::Y);
    }

    #[test]
    fn gimbal_angles_follow_djis_convention() {
        // forward = (sin y cos p, cos y cos p, sin p), right = (cos y, −sin y, 0).
        for (yaw, pitch) in [(93.1f64, -75.1f64), (-170.0, -30.0), (12.0, -90.0), (0.0, 0.0)] {
            let (y, p) = (yaw.to_radians(), pitch.to_radians());
            let camera = attitude_to_enu(euler_to_ned(0.0, p, y)) * camera_to_mount();
            close(camera * DVec3::Z, DVec3::new(y.sin() * p.cos(), y.cos() * p.cos(), p.sin()));
            close(camera * DVec3::X, DVec3::new(y.cos(), -y.sin(), 0.0));
        }
    }
}
