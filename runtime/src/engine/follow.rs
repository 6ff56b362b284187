//! Trained Gaussians follow their key frames when refinement moves those.
//!
//! A key frame whose camera went from pose A to pose B takes what stands before it along: p → c_B + R_B R_Aᵀ (p − c_A). A
//! Gaussian moves by the mean of its nearest key frames' motions, weighed by how near their optical axes pass. Where those
//! motions contradict each other it was trained with a wrong camera, and fresh ones take its place. SH is not rotated: where
//! the world turned further than shows in it, fresh ones take the place as well. (Linear blend skinning, with cameras as bones.)

use glam::{DQuat, DVec3, Quat, Vec3};
use models::camera::View;
use models::cloud::GaussianCloud;
use rayon::prelude::*;

/// Key frames that a Gaussian is moved by.
const NEAREST: usize = 4;
/// Distance from an optical axis at which a key frame's weight falls to a quarter, as a share of the depth there: a fifth of
/// what a lens of 90° sees to either side.
const NEAR_AXIS: f64 = 0.2;

/// One key frame before and after.
#[derive(Clone, Copy, Debug)]
pub struct Motion {
    /// As it was when the Gaussians were trained.
    pub then: View,
    /// As it is known now.
    pub now: View,
}

impl Motion {
    fn turn(&self) -> DQuat {
        (self.now.pose.rotation * self.then.pose.rotation.conjugate()).normalize()
    }

    fn shift(&self, p: DVec3) -> DVec3 {
        self.now.pose.center + self.turn() * (p - self.then.pose.center) - p
    }

    /// Depth of a point before the camera as it was, and the weight there; `None` behind it.
    fn weight(&self, p: DVec3) -> Option<(f64, f64)> {
        let (away, forward) = (p - self.then.pose.center, self.then.pose.forward());
        let depth = away.dot(forward);
        let (near, aside) = ((NEAR_AXIS * depth).powi(2), (away - depth * forward).length_squared());
        (depth > 0.0 && aside.is_finite()).then(|| (depth, (near + aside).powi(-2)))
    }

    /// How far the camera moved, in pixels at `depth_m`.
    pub fn pixels_at(&self, depth_m: f64) -> f64 {
        let shift = self.now.pose.center.distance(self.then.pose.center) / depth_m.max(1e-3);
        let angle = 2.0 * self.turn().w.abs().min(1.0).acos();
        (shift + angle) * f64::from(self.then.intrinsics.fx)
    }
}

/// Furthest turn that SH is left as it is over: a tenth of the 60° between a third-degree lobe and the next.
const MOST_TURN: f64 = 0.1;

/// The blended motion of a Gaussian's key frames.
struct Blended {
    shift: DVec3,
    turn: DQuat,
    /// Standard deviation of their shifts, pixels.
    apart_px: f64,
}

/// `None` where no key frame saw it: it stays where it is.
fn blend(p: DVec3, motions: &[Motion]) -> Option<Blended> {
    let mut nearest: [Option<(f64, f64, &Motion)>; NEAREST] = [None; NEAREST];
    for motion in motions {
        let Some((depth, weight)) = motion.weight(p) else { continue };
        let lightest = |n: &Option<(f64, f64, &Motion)>| n.map_or(0.0, |n| n.1);
        let at = (0..NEAREST).min_by(|a, b| lightest(&nearest[*a]).total_cmp(&lightest(&nearest[*b])));
        if let Some(at) = at.filter(|at| weight > lightest(&nearest[*at])) {
            nearest[at] = Some((depth, weight, motion));
        }
    }
    let total: f64 = nearest.iter().flatten().map(|n| n.1).sum();
    let mean = |of: &dyn Fn(&(f64, f64, &Motion)) -> DVec3| {
        nearest.iter().flatten().map(|n| of(n) * (n.1 / total)).sum::<DVec3>()
    };
    let first = nearest.iter().flatten().next()?.2.turn();
    let shift = mean(&|n| n.2.shift(p));
    // Of the quaternions' two signs the ones that lie together; the turns are small.
    let turn = nearest.iter().flatten().fold(DQuat::from_xyzw(0.0, 0.0, 0.0, 0.0), |sum, n| {
        let turn = n.2.turn();
        sum + turn * (n.1 / total * if turn.dot(first) < 0.0 { -1.0 } else { 1.0 })
    });
    let apart = nearest.iter().flatten().map(|(depth, weight, motion)| {
        let pixels = (motion.shift(p) - shift).length() / depth * f64::from(motion.then.intrinsics.fx);
        weight / total * pixels.powi(2)
    });
    let apart_px = apart.sum::<f64>().sqrt();
    (shift.is_finite() && turn.length_squared() > 1e-12).then(|| Blended { shift, turn: turn.normalize(), apart_px })
}

/// Moves the Gaussians of `cloud` with their key frames; those whose key frames disagree by more than `limit_px`, or turn them further
/// than [`MOST_TURN`], are taken out.
/// Returns how many those were.
pub fn follow(cloud: &mut GaussianCloud, motions: &[Motion], limit_px: f64) -> usize {
    let blended: Vec<Option<Blended>> =
        cloud.means.par_iter().map(|m| blend(Vec3::from_array(*m).as_dvec3(), motions)).collect();
    for (i, motion) in blended.iter().enumerate() {
        let Some(motion) = motion else { continue };
        let mean = Vec3::from_array(cloud.means[i]).as_dvec3() + motion.shift;
        cloud.means[i] = mean.as_vec3().to_array();
        let [w, x, y, z] = cloud.rotations[i];
        let turned = motion.turn.as_quat() * Quat::from_xyzw(x, y, z, w);
        cloud.rotations[i] = [turned.w, turned.x, turned.y, turned.z];
    }
    let holds = |m: &Blended| m.apart_px <= limit_px && 2.0 * m.turn.w.abs().min(1.0).acos() <= MOST_TURN;
    cloud.retain(|i| blended[i].as_ref().is_none_or(holds))
}

#[cfg(test)]
mod tests {
    use models::camera::{Intrinsics, Pose, Projector};

    use super::*;

    /// Straight down from 50 m.
    fn view(x: f64, y: f64) -> View {
        let intrinsics = Intrinsics { width: 640, height: 480, fx: 400.0, fy: 400.0, cx: 320.0, cy: 240.0 };
        let rotation = DQuat::from_rotation_x(std::f64::consts::PI);
        View { intrinsics, pose: Pose { rotation, center: DVec3::new(x, y, 50.0) } }
    }

    fn grid() -> Vec<View> {
        (0..12).map(|i| view(10.0 * f64::from(i % 4), 10.0 * f64::from(i / 4))).collect()
    }

    fn moved(views: &[View], by: impl Fn(usize, &Pose) -> Pose) -> Vec<Motion> {
        let now = |(i, then): (usize, &View)| Motion { then: *then, now: View { pose: by(i, &then.pose), ..*then } };
        views.iter().enumerate().map(now).collect()
    }

    fn cloud() -> GaussianCloud {
        let mut cloud = GaussianCloud::with_capacity(0, 64);
        for i in 0..64 {
            let mean = [(i % 8) as f32 * 4.0, (i / 8) as f32 * 3.0, (i % 3) as f32];
            cloud.push(mean, [-1.0, -2.0, -3.0], [0.8, 0.0, 0.6, 0.0], 1.0, &[0.1; 3]);
        }
        cloud
    }

    #[test]
    fn when_all_cameras_move_as_one_every_picture_stays_as_it_was() {
        let turn = DQuat::from_rotation_z(0.05) * DQuat::from_rotation_x(-0.02);
        let motions = moved(&grid(), |_, p| Pose {
            rotation: turn * p.rotation,
            center: turn * p.center + DVec3::new(3.0, -2.0, 1.0),
        });
        let (before, mut after) = (cloud(), cloud());
        assert_eq!(follow(&mut after, &motions, 1.5), 0);
        for motion in &motions {
            let (then, now) = (Projector::new(&motion.then), Projector::new(&motion.now));
            for i in 0..before.len() {
                let seen = |p: &Projector, c: &GaussianCloud| p.project(c.means[i].into()).unwrap();
                let (a, b) = (seen(&then, &before), seen(&now, &after));
                assert!((a.0 - b.0).hypot(a.1 - b.1) < 0.01, "{a:?} {b:?}");
                let axis = |c: &GaussianCloud, v: &View| {
                    let [w, x, y, z] = c.rotations[i].map(f64::from);
                    v.pose.rotation.conjugate() * (DQuat::from_xyzw(x, y, z, w) * DVec3::X)
                };
                assert!((axis(&before, &motion.then) - axis(&after, &motion.now)).length() < 1e-5);
            }
        }
    }

    #[test]
    fn one_wrong_camera_costs_what_stood_before_it_and_nothing_else() {
        // The first camera was 20 m off; the others stay.
        let motions =
            moved(&grid(), |i, p| Pose { center: p.center + if i == 0 { DVec3::X * 20.0 } else { DVec3::ZERO }, ..*p });
        assert!(motions[0].pixels_at(50.0) > 150.0);
        let mut after = cloud();
        let dropped = follow(&mut after, &motions, 1.5);
        assert!(dropped > 0 && dropped < 32, "{dropped}");
        let far = |m: &&[f32; 3]| m[0] > 20.0;
        let kept: Vec<_> = after.means.iter().filter(far).collect();
        assert_eq!(kept, cloud().means.iter().filter(far).collect::<Vec<_>>(), "far from it nothing moves");
    }

    #[test]
    fn what_turned_further_than_sh_hides_is_made_anew() {
        let turned = |by: f64| {
            let turn = DQuat::from_rotation_z(by);
            moved(&grid(), |_, p| Pose { rotation: turn * p.rotation, center: turn * p.center })
        };
        assert_eq!(follow(&mut cloud(), &turned(0.09), 1.5), 0);
        assert_eq!(follow(&mut cloud(), &turned(0.11), 1.5), 64);
    }

    #[test]
    fn a_bend_that_grows_slowly_is_followed_and_what_nobody_saw_stays() {
        let motions = moved(&grid(), |_, p| Pose { center: p.center + DVec3::Z * (0.002 * p.center.x), ..*p });
        let mut after = cloud();
        after.push([15.0, 10.0, 80.0], [-1.0; 3], [1.0, 0.0, 0.0, 0.0], 1.0, &[0.1; 3]);
        assert_eq!(follow(&mut after, &motions, 1.5), 0);
        assert_eq!(after.means[64], [15.0, 10.0, 80.0], "behind every camera");
        for (then, now) in cloud().means.iter().zip(&after.means) {
            assert!((now[2] - then[2] - 0.002 * then[0]).abs() < 0.02, "{then:?} {now:?}");
        }
        let mut empty = GaussianCloud::default();
        assert_eq!(follow(&mut empty, &motions, 1.5) + follow(&mut cloud(), &[], 1.5), 0);
    }
}
