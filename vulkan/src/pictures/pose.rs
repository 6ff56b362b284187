//! Camera pose and exposure of each view, optimised on the host: a dozen numbers per step, in f64 so that a refined
//! pose loses no digits.

use config::training::{AdamSettings, RateSettings};
use glam::{DQuat, DVec3};
use models::camera::Pose;

/// Adam over six numbers.
#[derive(Clone, Copy, Debug, Default)]
struct Six {
    first: [f64; 6],
    second: [f64; 6],
    steps: i32,
}

impl Six {
    fn step(&mut self, gradient: [f64; 6], rates: [f64; 6], adam: &AdamSettings) -> [f64; 6] {
        let (b1, b2) = (f64::from(adam.beta1), f64::from(adam.beta2));
        self.steps += 1;
        std::array::from_fn(|i| {
            let g = if gradient[i].is_finite() { gradient[i] } else { 0.0 };
            self.first[i] += (g - self.first[i]) * (1.0 - b1);
            self.second[i] += (g * g - self.second[i]) * (1.0 - b2);
            let m = self.first[i] / (1.0 - b1.powi(self.steps));
            let v = self.second[i] / (1.0 - b2.powi(self.steps));
            -rates[i] * m / (v.sqrt() + f64::from(adam.epsilon))
        })
    }
}

/// What a view learns besides the Gaussians.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct Adjust {
    pose_steps: Six,
    exposure_steps: Six,
    /// Logarithm of the gain (r, g, b), then the offset.
    pub exposure: [f64; 6],
}

impl Adjust {
    /// Gradient by (turn, shift) of the camera frame: p' = exp(turn) p + shift.
    pub fn move_pose(
        &mut self,
        pose: &mut Pose,
        gradient: [f64; 6],
        r: &RateSettings,
        extent: f32,
        adam: &AdamSettings,
    ) {
        let (turn, shift) = (f64::from(r.pose_rotation), f64::from(r.pose_translation * extent));
        let d = self.pose_steps.step(gradient, [turn, turn, turn, shift, shift, shift], adam);
        *pose = moved(pose, d);
    }

    pub fn move_exposure(&mut self, gradient: [f64; 6], r: &RateSettings, adam: &AdamSettings) {
        let d = self.exposure_steps.step(gradient, [f64::from(r.exposure); 6], adam);
        for (e, d) in self.exposure.iter_mut().zip(d) {
            // A gain of e^±3 or an offset of three whole ranges says that the picture is useless, not that it is dark.
            *e = (*e + d).clamp(-3.0, 3.0);
        }
    }
}

/// The pose after p' = exp(turn) p + shift in the camera's frame.
fn moved(pose: &Pose, d: [f64; 6]) -> Pose {
    let turned = DQuat::from_scaled_axis(DVec3::new(d[0], d[1], d[2]));
    let to_camera = pose.rotation.normalize().conjugate();
    let translation = turned * -(to_camera * pose.center) + DVec3::new(d[3], d[4], d[5]);
    let rotation = (turned * to_camera).normalize().conjugate();
    Pose { rotation, center: -(rotation * translation) }
}
