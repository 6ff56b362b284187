//! What an earlier plan of the same store settled stays as it was while it is near enough to what would be settled now.
//!
//! Registration and light are settled over all models at once, so that whoever joins moves everybody, most by little (registration
//! begins where things were, `register/graph.rs`); without this every cell would be another one each time.

use std::collections::HashMap;

use super::frame::Motion;
use super::member::Member;
use super::plan::{Hash, Placed, Plan};

/// A model stays while it would move by no more than this anywhere, metres: less than half of what registration takes a border to be
/// known to at best.
pub const STAYS_M: f64 = 0.02;
/// Its light stays while it would change by no more than this (natural logarithm): half of what counts as even.
const STAYS_LIT: f32 = 0.005;
/// Cells in which holes are looked for keep their size within this factor.
const STAYS_WITHIN: f64 = 2.0;
/// So much of a budget of Gaussians may lie idle before shares are dealt anew.
const LIES_IDLE: f64 = 0.05;

/// What an earlier plan says.
#[derive(Default)]
pub struct Held<'a> {
    plan: Option<&'a Plan>,
    by_content: HashMap<Hash, &'a Placed>,
}

impl<'a> Held<'a> {
    /// Of the plan that lies where the new one goes, when it is of the same place.
    pub fn of(earlier: Option<&'a Plan>, is_same_place: impl Fn(&Plan) -> bool) -> Self {
        let plan = earlier.filter(|p| is_same_place(p));
        let by_content = plan.into_iter().flat_map(|p| &p.models).map(|m| (m.content, m)).collect();
        Self { plan, by_content }
    }

    /// What a model was moved by before.
    pub fn earlier(&self, member: &Member) -> Option<Motion> {
        self.by_content.get(member.content()).and_then(|m| m.correction).map(Motion::of_parts)
    }

    /// Where a model goes that would be moved by `motion` now.
    pub fn motion(&self, member: &Member, motion: Motion) -> Motion {
        let Some(earlier) = self.earlier(member) else { return motion };
        let stays = member.corners().into_iter().all(|p| earlier.point(p).distance(motion.point(p)) <= STAYS_M);
        if stays { earlier } else { motion }
    }

    /// The light of a model that would be given `gain` now.
    pub fn gain(&self, member: &Member, gain: [f32; 3]) -> [f32; 3] {
        let Some(earlier) = self.by_content.get(member.content()).map(|m| m.gain) else { return gain };
        let stays = earlier.iter().zip(gain).all(|(a, b)| (a - b).abs() <= STAYS_LIT);
        if stays { earlier } else { gain }
    }

    /// The side of cells in which holes are looked for, which would be `side_m` now.
    pub fn coverage_m(&self, side_m: f64) -> f64 {
        let near = |m: &f64| *m <= side_m * STAYS_WITHIN && *m >= side_m / STAYS_WITHIN;
        self.plan.map(|p| p.coverage_m).filter(near).unwrap_or(side_m)
    }

    /// The share of its Gaussians that every cell keeps, which would be `share` now.
    pub fn share(&self, share: f64) -> f64 {
        let near = |s: &f64| *s <= share && *s >= share * (1.0 - LIES_IDLE);
        self.plan.and_then(|p| p.share).filter(near).unwrap_or(share)
    }
}

#[cfg(test)]
mod tests {
    use config::ground::GroundSettings;
    use glam::{DQuat, DVec3};

    use super::*;
    use crate::store::Store;
    use crate::testing::{carpet, model, planned, written};

    #[test]
    fn what_was_settled_stays_to_the_bit_while_it_is_near_and_no_longer() {
        let dir = tempfile::tempdir().expect("temp dir");
        let mut members = [written(dir.path(), &model("a", &[], carpet([0.0, 0.0], [40.0, 20.0], 1.0)))];
        let settings = GroundSettings { register: false, epochs: 0, ..Default::default() };
        let mut plan = planned(&mut members, &settings, &Store::folder(&dir.path().join("store")));
        let moved = |turn: f64, east: f64| Motion::rigid(DQuat::from_rotation_z(turn), DVec3::new(east, 0.1, 0.0));
        let earlier = moved(0.01, 0.3);
        plan.models[0].correction = Some(earlier.parts());
        (plan.models[0].gain, plan.coverage_m, plan.share) = ([0.1; 3], 0.8, Some(0.5));
        let held = Held::of(Some(&plan), |_| true);
        let a = &members[0];
        assert_eq!(held.motion(a, moved(0.01, 0.31)).parts(), earlier.parts());
        assert_eq!(held.motion(a, moved(0.01, 0.33)), moved(0.01, 0.33), "3 cm are too much");
        assert_eq!(held.motion(a, moved(0.011, 0.3)), moved(0.011, 0.3), "a milliradian is 4 cm at the far end");
        assert_eq!([held.gain(a, [0.104; 3]), held.gain(a, [0.1, 0.11, 0.1])], [[0.1; 3], [0.1, 0.11, 0.1]]);
        assert_eq!([1.0, 0.5, 2.0].map(|m| held.coverage_m(m)), [0.8, 0.8, 2.0]);
        // Never more than may be kept now.
        assert_eq!([0.51, 0.49, 0.6].map(|s| held.share(s)), [0.5, 0.49, 0.6]);
        // Another model's, and another place's, hold nothing.
        let b = written(dir.path(), &model("b", &[], carpet([0.0, 0.0], [30.0, 20.0], 1.0)));
        assert_eq!(held.motion(&b, moved(0.01, 0.31)), moved(0.01, 0.31));
        let elsewhere = Held::of(Some(&plan), |_| false);
        assert_eq!(elsewhere.motion(a, moved(0.01, 0.31)), moved(0.01, 0.31));
    }
}
