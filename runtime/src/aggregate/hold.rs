//! What an earlier plan of the same store settled stays as it was while it is near enough to what would be settled now.
//!
//! Registration and light are settled over all models at once, so that whoever joins moves everybody, most by less than a millimetre;
//! without this every cell would be another one each time.

use std::collections::HashMap;

use super::frame::Motion;
use super::member::Member;
use super::plan::{Hash, Placed, Plan};

/// A model stays while it would move by no more than this anywhere, metres: less than half of what registration takes a border to be
/// known to at best.
const STAYS_M: f64 = 0.02;
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

    /// Where a model goes that would be moved by `motion` now.
    pub fn motion(&self, member: &Member, motion: Motion) -> Motion {
        let Some(parts) = self.by_content.get(member.content()).and_then(|m| m.correction) else { return motion };
        let earlier = Motion::of_parts(parts);
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
