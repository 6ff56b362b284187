//! Which way is up in a scene that is nowhere on Earth: what its cameras say, who hold their pictures level.

use glam::{DMat3, DQuat, DVec3};

use models::camera::View;

use super::OrthoError;

/// A scene whose z axis lies within this of what its cameras say keeps it.
const NEAR_Z: f64 = 0.35;
/// Pictures are level where their rows leave the horizon by less than this, rms, radians.
const LEVEL: f64 = 0.25;
/// Rows of pictures span the horizon where their second direction has at least this share of the first.
const SPANS: f64 = 0.02;
/// All cameras look down where their axes lie within this of one direction, as a cosine.
const ALIKE: f64 = 0.9;

/// An axis of the scene that points up.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Up {
    /// x.
    X,
    /// Against x.
    MinusX,
    /// y.
    Y,
    /// Against y.
    MinusY,
    /// z.
    Z,
    /// Against z.
    MinusZ,
}

impl Up {
    /// All of them with the names that people give them.
    pub const NAMED: [(&str, Self); 6] = [
        ("x", Self::X),
        ("-x", Self::MinusX),
        ("y", Self::Y),
        ("-y", Self::MinusY),
        ("z", Self::Z),
        ("-z", Self::MinusZ),
    ];

    /// By its name.
    pub fn named(name: &str) -> Option<Self> {
        Self::NAMED.iter().find(|(known, _)| *known == name).map(|(_, up)| *up)
    }

    fn direction(self) -> DVec3 {
        match self {
            Self::X => DVec3::X,
            Self::MinusX => -DVec3::X,
            Self::Y => DVec3::Y,
            Self::MinusY => -DVec3::Y,
            Self::Z => DVec3::Z,
            Self::MinusZ => -DVec3::Z,
        }
    }

    /// What turns the scene so that this axis becomes z.
    pub fn turn(self) -> DQuat {
        DQuat::from_rotation_arc(self.direction(), DVec3::Z)
    }
}

/// What turns a scene that these cameras saw so that z is up; nothing where z is up as far as they tell.
///
/// # Errors
/// They tell of no up, or of none that agrees with z: some are rolled, or all look the same way.
pub fn found(views: &[View]) -> Result<DQuat, OrthoError> {
    if views.is_empty() {
        return Ok(DQuat::IDENTITY);
    }
    let mean = |of: fn(&View) -> DVec3| views.iter().map(of).sum::<DVec3>() / views.len() as f64;
    let (ahead, above) = (mean(|v| v.pose.forward()), mean(|v| v.pose.rotation * -DVec3::Y));
    // The rows of level pictures lie in the horizon, whatever the camera's pitch.
    let mut rows = DMat3::ZERO;
    for view in views {
        let row = view.pose.rotation * DVec3::X;
        rows += DMat3::from_cols(row * row.x, row * row.y, row * row.z) / views.len() as f64;
    }
    let (up, [least, middle, most]) = least_direction(&rows);
    let is_level = least.max(0.0).sqrt() <= LEVEL && middle >= SPANS * most;
    let up = match (is_level, ahead.length() >= ALIKE) {
        // Upright cameras have the sky at the top of their pictures; those that look straight down have it behind them.
        (true, _) => {
            Some(if above.dot(up).abs() >= 0.3 { up * above.dot(up).signum() } else { -up * ahead.dot(up).signum() })
        }
        (false, true) if ahead.z < -ALIKE => return Ok(DQuat::IDENTITY),
        _ => None,
    };
    match up {
        Some(up) if up.angle_between(DVec3::Z) <= NEAR_Z => Ok(DQuat::IDENTITY),
        Some(up) => Ok(DQuat::from_rotation_arc(up.normalize(), DVec3::Z)),
        None => Err(OrthoError::NoUp),
    }
}

/// Direction of the least of a symmetric matrix's eigenvalues, and all three, by Jacobi's rotations.
fn least_direction(matrix: &DMat3) -> (DVec3, [f64; 3]) {
    let (mut a, mut axes) = (*matrix, DMat3::IDENTITY);
    for _ in 0..16 {
        for (p, q) in [(0, 1), (0, 2), (1, 2)] {
            let off = a.col(q)[p];
            if off.abs() < 1e-15 {
                continue;
            }
            let angle = 0.5 * (2.0 * off).atan2(a.col(q)[q] - a.col(p)[p]);
            let (s, c) = angle.sin_cos();
            let mut turn = DMat3::IDENTITY;
            (turn.col_mut(p)[p], turn.col_mut(q)[q]) = (c, c);
            (turn.col_mut(p)[q], turn.col_mut(q)[p]) = (-s, s);
            a = turn.transpose() * a * turn;
            axes *= turn;
        }
    }
    let values = [a.x_axis.x, a.y_axis.y, a.z_axis.z];
    let least = (1..3).fold(0, |best, i| if values[i] < values[best] { i } else { best });
    let mut sorted = values;
    sorted.sort_by(f64::total_cmp);
    (axes.col(least), sorted)
}

#[cfg(test)]
mod tests {
    use models::camera::{Intrinsics, Pose};

    use super::*;

    /// Cameras on a ring that look to its middle, pitched down by `pitch`; the scene is z up before `turn`.
    fn ring(n: usize, pitch: f64, turn: DQuat, part: f64) -> Vec<View> {
        let intrinsics = Intrinsics { width: 40, height: 30, fx: 40.0, fy: 40.0, cx: 20.0, cy: 15.0 };
        let of = |i: usize| {
            let yaw = part * std::f64::consts::TAU * i as f64 / n as f64;
            let ahead = DVec3::new(-yaw.cos() * pitch.cos(), -yaw.sin() * pitch.cos(), -pitch.sin());
            let right = DVec3::new(-yaw.sin(), yaw.cos(), 0.0);
            let rotation = DQuat::from_mat3(&DMat3::from_cols(right, ahead.cross(right), ahead));
            let center = DVec3::new(yaw.cos(), yaw.sin(), 1.0) * 10.0;
            View { intrinsics, pose: Pose { rotation: turn * rotation, center: turn * center } }
        };
        (0..n).map(of).collect()
    }

    #[test]
    fn level_cameras_tell_up_in_whatever_axes_the_scene_has() {
        for pitch in [0.0, 0.5, 1.2, 1.57] {
            for (_, axis) in Up::NAMED {
                let turn = axis.turn().conjugate();
                for part in [1.0, 0.4] {
                    let up = found(&ring(12, pitch, turn, part)).expect("an up") * axis.direction();
                    assert!(up.z > 0.999, "{axis:?} pitch {pitch}: {up}");
                }
            }
            assert_eq!(
                found(&ring(12, pitch, DQuat::from_rotation_x(0.2), 1.0)).ok(),
                Some(DQuat::IDENTITY),
                "z is near"
            );
        }
    }

    #[test]
    fn cameras_that_tell_of_no_up_are_refused_unless_they_look_down_along_z() {
        // Each rolled about its own axis.
        let mut rolled = ring(12, 0.3, DQuat::IDENTITY, 1.0);
        for (i, view) in rolled.iter_mut().enumerate() {
            view.pose.rotation *= DQuat::from_rotation_z(0.9 * i as f64);
        }
        assert!(matches!(found(&rolled), Err(OrthoError::NoUp)));
        // All alike.
        let alike = vec![ring(1, 0.2, Up::Y.turn().conjugate(), 1.0)[0]; 5];
        assert!(matches!(found(&alike), Err(OrthoError::NoUp)));
        let down = vec![ring(1, std::f64::consts::FRAC_PI_2, DQuat::IDENTITY, 1.0)[0]; 5];
        assert_eq!(found(&down).ok(), Some(DQuat::IDENTITY));
        assert_eq!(found(&[]).ok(), Some(DQuat::IDENTITY));
        assert_eq!((Up::named("-y"), Up::named("w")), (Some(Up::MinusY), None));
    }
}
