//! Poses of held-out pictures in a model's own frame.
//!
//! A model trained from telemetry lives in the frame of its refined poses, which is bent by decimetres against the
//! reconstruction that a data set's poses come from. A held-out picture keeps its place *relative to its neighbours*:
//! each of the nearest training views carries it over, and the weighted mean is taken. Where model and data set agree,
//! this changes nothing.

use geometry::median;
use glam::{DQuat, DVec3};
use models::camera::{Pose, View};
use survey::dataset::{Dataset, picture_names};

/// Neighbours that vote: enough to average their noise, few enough to stay local.
const NEIGHBOURS: usize = 4;
/// Poses nearer than this are the same (metres, and 1 − |cos| of half the angle).
const SAME: f64 = 1e-9;
/// A pair agrees with the motion of the others up to this angle: ten times what refinement turns telemetry by, far less than two
/// pictures differ by that only share a name.
const AGREES_RAD: f64 = 0.26;
/// And up to this share of the root mean square distance of the pictures from their middle.
const AGREES_SHARE: f64 = 0.25;
/// Frames whose scales differ by less are of one unit: refinement changes a scale by a few hundredths.
const ONE_UNIT: f64 = 0.2;

/// Pairs of poses of the same pictures: in the data set, and in the model.
#[derive(Clone, Debug, Default)]
pub struct PoseTransfer {
    pairs: Vec<(Pose, Pose)>,
    /// Model units per unit of the data set.
    scale: Option<f64>,
}

impl PoseTransfer {
    /// From the views a model was trained on, matched by name: a flight stores its pictures as PNG under the camera's names.
    /// Without a common picture, or with equal poses, nothing is moved. Pairs that share a name and not the motion of the
    /// others are left out, which is said; where most do, nothing is moved.
    pub fn between(set: &Dataset, model_views: &[(String, View)]) -> Self {
        let found = picture_names(set).pair(model_views.iter().map(|(name, _)| name.as_str()));
        let pairs = found.iter().zip(model_views).filter_map(|(i, (_, view))| {
            let i = (*i)?;
            Some((set.frames[i].view.pose, view.pose))
        });
        let (transfer, others) = Self::of(pairs.collect());
        if others > 0 {
            let all = others + transfer.pairs.len();
            tracing::warn!(
                "{}: {others} of {all} pictures that the model has, too, are not where one motion of the others puts them; {}",
                set.root.display(),
                match transfer.is_identity() {
                    true => "the data set's poses are used as they are; is the model of these pictures?",
                    false => "left out where poses are carried into the model's frame",
                }
            );
        }
        transfer
    }

    /// The pairs that agree on one motion, and how many others there are.
    fn of(pairs: Vec<(Pose, Pose)>) -> (Self, usize) {
        let same =
            |(a, b): &(Pose, Pose)| a.center.distance(b.center) < SAME && 1.0 - a.rotation.dot(b.rotation).abs() < SAME;
        if pairs.iter().all(same) {
            return (Self::default(), 0);
        }
        let all = pairs.len();
        let (agreeing, scale) = agreeing(pairs);
        match agreeing.len() * 2 > all {
            true => (
                Self { scale: Some(scale).filter(|s| (s - 1.0).abs() > ONE_UNIT), pairs: agreeing.clone() },
                all - agreeing.len(),
            ),
            false => (Self::default(), all),
        }
    }

    /// Whether poses are moved at all.
    pub fn is_identity(&self) -> bool {
        self.pairs.is_empty()
    }

    /// A data set pose in the model's frame.
    pub fn apply(&self, pose: &Pose) -> Pose {
        if self.pairs.is_empty() {
            return *pose;
        }
        let mut near: Vec<&(Pose, Pose)> = self.pairs.iter().collect();
        let distance = |p: &(Pose, Pose)| p.0.center.distance_squared(pose.center);
        near.sort_by(|a, b| distance(a).total_cmp(&distance(b)));
        near.truncate(NEIGHBOURS);
        let (mut center, mut rotation, mut sum) = (DVec3::ZERO, DQuat::from_xyzw(0.0, 0.0, 0.0, 0.0), 0.0);
        for pair in near {
            let (from, to) = pair;
            let turn = to.rotation * from.rotation.conjugate();
            let way = turn * (pose.center - from.center);
            let carried = to.center + self.scale.map_or(way, |scale| way * scale);
            let turned = turn * pose.rotation;
            // One metre keeps a neighbour at the very same place from taking it all.
            let weight = 1.0 / (1.0 + distance(pair));
            center += carried * weight;
            let sign = if turned.dot(rotation) < 0.0 { -1.0 } else { 1.0 };
            rotation += turned * (weight * sign);
            sum += weight;
        }
        Pose { rotation: rotation.normalize(), center: center / sum }
    }
}

/// Those pairs that the most common turn, the median ratio of distances and the median shift carry from one frame into the other,
/// and that ratio.
fn agreeing(pairs: Vec<(Pose, Pose)>) -> (Vec<(Pose, Pose)>, f64) {
    let turn = |(from, to): &(Pose, Pose)| to.rotation * from.rotation.conjugate();
    let near = |a: DQuat, b: DQuat| a.angle_between(b).min((-a).angle_between(b)) < AGREES_RAD;
    // More than a few dozen say no more about the most common one.
    let candidates = pairs.iter().step_by(pairs.len().div_ceil(64));
    let votes = |t: DQuat| pairs.iter().filter(|p| near(turn(p), t)).count();
    let Some(common) = candidates.map(turn).max_by_key(|t| votes(*t)) else { return (pairs, 1.0) };
    let mut turned: Vec<(Pose, Pose)> = pairs.into_iter().filter(|p| near(turn(p), common)).collect();
    let count = turned.len();
    let apart =
        |of: fn(&(Pose, Pose)) -> DVec3, i: usize| of(&turned[i]).distance(of(&turned[(i + count / 2) % count]));
    let ratios = (0..count).filter_map(|i| {
        let (from, to) = (apart(|p| p.0.center, i), apart(|p| p.1.center, i));
        (from > SAME && to > SAME).then_some(to / from)
    });
    let mut ratios: Vec<f64> = ratios.collect();
    let scale = median(&mut ratios).unwrap_or(1.0);
    let shift = |(from, to): &(Pose, Pose)| to.center - common * from.center * scale;
    let middle = |of: &dyn Fn(&(Pose, Pose)) -> DVec3| {
        DVec3::from(
            [0, 1, 2].map(|k| median(&mut turned.iter().map(|p| of(p)[k]).collect::<Vec<_>>()).unwrap_or_default()),
        )
    };
    let (usual, center) = (middle(&shift), middle(&|p| p.1.center));
    let spread = (turned.iter().map(|p| p.1.center.distance_squared(center)).sum::<f64>() / count as f64).sqrt();
    turned.retain(|p| shift(p).distance(usual) <= AGREES_SHARE * spread + SAME);
    (turned, scale)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn pose(x: f64, yaw: f64) -> Pose {
        Pose {
            rotation: DQuat::from_rotation_z(yaw) * DQuat::from_xyzw(1.0, 0.0, 0.0, 0.0),
            center: DVec3::new(x, 1.0, 50.0),
        }
    }

    #[test]
    fn a_frame_moved_as_a_whole_moves_held_out_poses_exactly() {
        let turn = DQuat::from_axis_angle(DVec3::new(0.1, 0.2, 0.9).normalize(), 0.3);
        let shift = DVec3::new(3.0, -2.0, 1.0);
        let moved = |p: &Pose| Pose { rotation: turn * p.rotation, center: turn * p.center + shift };
        let pairs = (0..6).map(|i| pose(f64::from(i) * 10.0, f64::from(i))).map(|p| (p, moved(&p))).collect();
        let (transfer, others) = PoseTransfer::of(pairs);
        assert_eq!(others, 0);
        let held_out = pose(14.0, 0.4);
        let (got, want) = (transfer.apply(&held_out), moved(&held_out));
        assert!(got.center.distance(want.center) < 1e-9 && got.rotation.dot(want.rotation).abs() > 1.0 - 1e-12);
    }

    #[test]
    fn a_frame_in_another_unit_moves_held_out_poses_by_its_scale() {
        let moved = |p: &Pose| Pose { center: p.center * 0.02 + DVec3::X, ..*p };
        let pairs = (0..6).map(|i| pose(f64::from(i * i) * 10.0, f64::from(i))).map(|p| (p, moved(&p))).collect();
        let held_out = pose(14.0, 0.4);
        let got = PoseTransfer::of(pairs).0.apply(&held_out);
        assert!(got.center.distance(moved(&held_out).center) < 1e-9, "{}", got.center);
    }

    #[test]
    fn pictures_that_only_share_a_name_do_not_move_others() {
        let shift = DVec3::new(0.3, -0.2, 0.1);
        let moved = |p: &Pose| Pose { center: p.center + shift, ..*p };
        let mut pairs: Vec<_> =
            (0..6).map(|i| pose(f64::from(i) * 10.0, f64::from(i))).map(|p| (p, moved(&p))).collect();
        pairs[3].1 = pose(200.0, 0.7);
        let (transfer, others) = PoseTransfer::of(pairs.clone());
        assert_eq!(others, 1);
        let held_out = pose(31.0, 0.4);
        assert!(transfer.apply(&held_out).center.distance(moved(&held_out).center) < 1e-9);
        // Another aircraft's like-named pictures: no motion is common to them.
        for (i, pair) in pairs.iter_mut().enumerate() {
            pair.1 = pose(((i * 37 + 11) % 60) as f64, 2.5 * i as f64 + 0.8 * (i * i) as f64);
        }
        let (transfer, others) = PoseTransfer::of(pairs);
        assert_eq!((transfer.is_identity(), others), (true, 6));
    }

    #[test]
    fn without_pairs_nothing_moves() {
        assert_eq!(PoseTransfer::default().apply(&pose(1.0, 2.0)), pose(1.0, 2.0));
        assert!(PoseTransfer::default().is_identity());
    }
}
