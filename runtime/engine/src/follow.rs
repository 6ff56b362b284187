//! Trained Gaussians follow their key frames when refinement moves those.
//!
//! A key frame whose camera went from pose A to pose B takes what stands before it along: p → c_B + R_B R_Aᵀ (p − c_A). A
//! Gaussian moves by the mean of its nearest key frames' motions, weighed by how near their optical axes pass. Where those
//! motions contradict each other it was trained with a wrong camera, and fresh ones take its place. SH is not rotated: where
//! the world turned further than shows in it, fresh ones take the place as well. (Linear blend skinning, with cameras as bones.)

use std::collections::HashMap;

use glam::{DQuat, DVec3, Quat, Vec3};
use models::camera::View;
use models::cloud::GaussianCloud;
use rayon::prelude::*;
use vulkan::trainer::Fate;

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
    /// Whether it moved at all.
    pub fn is_still(&self) -> bool {
        self.then.pose == self.now.pose
    }

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

/// Key frames by where they look: those near a place are found without a look at all of them.
pub struct Motions {
    all: Vec<Motion>,
    /// Side of a square, metres: what a picture shows.
    side: f64,
    squares: HashMap<[i64; 2], Vec<u32>>,
}

impl Motions {
    /// Of key frames that look at ground `depth_m` away.
    pub fn new(all: Vec<Motion>, depth_m: f64) -> Self {
        let wide = |m: &Motion| depth_m * f64::from(m.then.intrinsics.width) / f64::from(m.then.intrinsics.fx);
        let side = all.iter().map(wide).fold(1e-3, f64::max);
        let mut squares: HashMap<[i64; 2], Vec<u32>> = HashMap::new();
        for (i, m) in all.iter().enumerate() {
            let at = m.then.pose.center + m.then.pose.forward() * depth_m;
            squares.entry(square(at, side)).or_default().push(i as u32);
        }
        Self { all, side, squares }
    }

    /// Those whose axes pass near a place; all, where hardly any do.
    fn near(&self, p: DVec3) -> Vec<&Motion> {
        let [x, y] = square(p, self.side);
        let around = (-1..=1).flat_map(|dy| (-1..=1).map(move |dx| [x + dx, y + dy]));
        let found: Vec<&Motion> =
            around.filter_map(|at| self.squares.get(&at)).flatten().map(|i| &self.all[*i as usize]).collect();
        if found.len() < NEAREST { self.all.iter().collect() } else { found }
    }

    /// Where a Gaussian goes with its key frames; those whose key frames disagree by more than `limit_px`, or turn it further than
    /// [`MOST_TURN`], go. What no key frame that moved sees stays as it is, to the bit.
    pub fn fate(&self, mean: [f32; 3], rotation: [f32; 4], limit_px: f64) -> Fate {
        let p = Vec3::from_array(mean).as_dvec3();
        let Some(blended) = blend(p, &self.near(p)) else { return Fate::Stays };
        if blended.apart_px > limit_px || 2.0 * blended.turn.w.abs().min(1.0).acos() > MOST_TURN {
            return Fate::Goes;
        }
        let [w, x, y, z] = rotation;
        let turned = blended.turn.as_quat() * Quat::from_xyzw(x, y, z, w);
        Fate::Moves {
            mean: (p + blended.shift).as_vec3().to_array(),
            rotation: [turned.w, turned.x, turned.y, turned.z],
        }
    }
}

fn square(p: DVec3, side: f64) -> [i64; 2] {
    [(p.x / side).floor() as i64, (p.y / side).floor() as i64]
}

/// `None` where no key frame saw it, or none of those that did has moved: it stays where it is.
fn blend(p: DVec3, motions: &[&Motion]) -> Option<Blended> {
    let mut nearest: [Option<(f64, f64, &Motion)>; NEAREST] = [None; NEAREST];
    for motion in motions {
        let Some((depth, weight)) = motion.weight(p) else { continue };
        let lightest = |n: &Option<(f64, f64, &Motion)>| n.map_or(0.0, |n| n.1);
        let at = (0..NEAREST).min_by(|a, b| lightest(&nearest[*a]).total_cmp(&lightest(&nearest[*b])));
        if let Some(at) = at.filter(|at| weight > lightest(&nearest[*at])) {
            nearest[at] = Some((depth, weight, motion));
        }
    }
    if nearest.iter().flatten().all(|n| n.2.is_still()) {
        return None;
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

/// Moves the Gaussians of `cloud` with their key frames, as [`Motions::fate`] says; how many were taken out.
pub fn follow(cloud: &mut GaussianCloud, motions: &Motions, limit_px: f64) -> usize {
    let places = cloud.means.par_iter().zip(&cloud.rotations);
    let fates: Vec<Fate> = places.map(|(m, r)| motions.fate(*m, *r, limit_px)).collect();
    for (i, fate) in fates.iter().enumerate() {
        if let Fate::Moves { mean, rotation } = fate {
            (cloud.means[i], cloud.rotations[i]) = (*mean, *rotation);
        }
    }
    cloud.retain(|i| fates[i] != Fate::Goes)
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

    fn moved(views: &[View], by: impl Fn(usize, &Pose) -> Pose) -> Motions {
        let now = |(i, then): (usize, &View)| Motion { then: *then, now: View { pose: by(i, &then.pose), ..*then } };
        Motions::new(views.iter().enumerate().map(now).collect(), 50.0)
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
        for motion in &motions.all {
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
        assert!(motions.all[0].pixels_at(50.0) > 150.0);
        let mut after = cloud();
        let dropped = follow(&mut after, &motions, 1.5);
        assert!(dropped > 0 && dropped < 32, "{dropped}");
        let far = |m: &&[f32; 3]| m[0] > 20.0;
        let kept: Vec<_> = after.means.iter().filter(far).collect();
        assert_eq!(kept, cloud().means.iter().filter(far).collect::<Vec<_>>(), "far from it nothing moves");
    }

    #[test]
    fn what_is_found_near_a_place_is_what_a_look_at_all_key_frames_finds() {
        let grid: Vec<View> = (0..1000).map(|i| view(12.0 * f64::from(i % 20), 20.0 * f64::from(i / 20))).collect();
        let motions = moved(&grid, |i, p| match i {
            200..206 => Pose { center: p.center + DVec3::new(0.02, -0.01, 0.03) * (i - 199) as f64, ..*p },
            _ => *p,
        });
        let all: Vec<&Motion> = motions.all.iter().collect();
        let mut stayed = 0;
        for i in 0..2000 {
            let p = DVec3::new(f64::from(i % 50) * 5.0, f64::from(i / 50) * 10.0, f64::from(i % 7) - 3.0);
            assert!(motions.near(p).len() < 260, "{}", motions.near(p).len());
            let (near, of_all) = (blend(p, &motions.near(p)), blend(p, &all));
            assert_eq!(near.is_some(), of_all.is_some(), "{p}");
            stayed += usize::from(near.is_none());
            if let (Some(near), Some(of_all)) = (near, of_all) {
                assert!((near.shift - of_all.shift).length() < 1e-12);
            }
        }
        assert!(stayed > 1500 && stayed < 2000, "{stayed} are seen by nothing that moved");
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
        assert_eq!(follow(&mut empty, &motions, 1.5) + follow(&mut cloud(), &Motions::new(Vec::new(), 50.0), 1.5), 0);
    }
}
