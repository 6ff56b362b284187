//! Poses of held-out pictures in a model's own frame.
//!
//! A model trained from telemetry lives in the frame of its refined poses, which is bent by decimetres against the
//! reconstruction that a data set's poses come from. A held-out picture keeps its place *relative to its neighbours*:
//! each of the nearest training views carries it over, and the weighted mean is taken. Where model and data set agree,
//! this changes nothing.

use std::collections::HashMap;
use std::path::Path;

use glam::{DQuat, DVec3};
use models::camera::{Pose, View};
use survey::dataset::Dataset;

/// Neighbours that vote: enough to average their noise, few enough to stay local.
const NEIGHBOURS: usize = 4;
/// Poses nearer than this are the same (metres, and 1 − |cos| of half the angle).
const SAME: f64 = 1e-9;

/// File name without folder and extension.
pub fn stem(name: &str) -> String {
    Path::new(name).file_stem().map_or_else(|| name.to_owned(), |s| s.to_string_lossy().into_owned())
}

/// Pairs of poses of the same pictures: in the data set, and in the model.
#[derive(Clone, Debug, Default)]
pub struct PoseTransfer {
    pairs: Vec<(Pose, Pose)>,
}

impl PoseTransfer {
    /// From the views a model was trained on, matched by file stem: a flight stores its pictures as PNG under the
    /// camera's names. Without a common picture, or with equal poses, nothing is moved.
    pub fn between(set: &Dataset, model_views: &[(String, View)]) -> Self {
        let by_stem: HashMap<String, &Pose> = set.frames.iter().map(|f| (stem(&f.name), &f.view.pose)).collect();
        let pairs: Vec<(Pose, Pose)> =
            model_views.iter().filter_map(|(name, view)| Some((**by_stem.get(&stem(name))?, view.pose))).collect();
        let same =
            |(a, b): &(Pose, Pose)| a.center.distance(b.center) < SAME && 1.0 - a.rotation.dot(b.rotation).abs() < SAME;
        if pairs.iter().all(same) { Self::default() } else { Self { pairs } }
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
            let carried = to.center + turn * (pose.center - from.center);
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
        let transfer = PoseTransfer { pairs };
        let held_out = pose(14.0, 0.4);
        let (got, want) = (transfer.apply(&held_out), moved(&held_out));
        assert!(got.center.distance(want.center) < 1e-9 && got.rotation.dot(want.rotation).abs() > 1.0 - 1e-12);
    }

    #[test]
    fn without_pairs_nothing_moves() {
        assert_eq!(PoseTransfer::default().apply(&pose(1.0, 2.0)), pose(1.0, 2.0));
        assert!(PoseTransfer::default().is_identity());
    }
}
