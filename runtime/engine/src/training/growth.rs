//! In flight: what a new key frame shows stands in the model as soon as it is there. Its pose is settled among its neighbours, its
//! depth becomes Gaussians where none stand, theirs move along, and all else stays as it is.

use std::cmp::Ordering;
use std::collections::BTreeSet;

use glam::DVec2;
use job::run_json::RunReport;
use models::cloud::GaussianCloud;
use vulkan::trainer::{BoundingBox, Fate, Trained};

use super::Training;
use super::rebuild::{CONTRADICTED_PX, MOVED_PX};
use crate::budget::Share;
use crate::carry::{Claims, Room};
use crate::error::EngineError;
use crate::follow::{Motion, Motions};
use crate::poses::{Placed, Poses};

/// Share of the plan that is freed at once where new ground finds no room.
const FREED: usize = 50;
/// Key frames within so many pictures' widths of one that moved may move a Gaussian with it.
const AROUND: f64 = 2.0;

/// Sums over all growths, for the report: per growth, nothing in them grows with the flight.
#[derive(Debug, Default, serde::Serialize)]
pub(crate) struct Totals {
    pub growths: u64,
    pub pictures: u64,
    pub depths: u64,
    pub compared: u64,
    pub adjusted_frames: u64,
    pub adjusted_observations: u64,
    pub gaussians: u64,
    pub made_room: u64,
    pub whole_solves: u64,
}

impl Totals {
    pub fn count_placed(&mut self, placed: &Placed) {
        self.adjusted_frames += placed.adjusted.0 as u64;
        self.adjusted_observations += placed.adjusted.1 as u64;
        self.whole_solves += u64::from(placed.whole);
    }
}

/// Moves what is trained with the key frames among `moved` that refinement moved since; how many Gaussians that were.
pub(crate) fn follow(
    training: &mut Training,
    poses: &Poses,
    moved: &BTreeSet<usize>,
    report: &mut RunReport,
) -> Result<usize, EngineError> {
    let (built, depth_m) = (&training.built.views, f64::from(training.built.depth_m));
    let motion = |i: usize| built.get(i).map(|then| Motion { then: *then, now: poses.view(i) });
    let has_moved = |i: &usize| motion(*i).is_some_and(|m| m.pixels_at(depth_m) > MOVED_PX);
    let going: Vec<usize> = moved.iter().copied().filter(has_moved).collect();
    let shifted: Vec<Motion> = going.iter().filter_map(|i| motion(*i)).collect();
    if shifted.is_empty() {
        return Ok(0);
    }
    let wide = |m: &Motion| depth_m * f64::from(m.then.intrinsics.width) / f64::from(m.then.intrinsics.fx);
    let reach = AROUND * shifted.iter().map(wide).fold(0.0, f64::max);
    let looks_at = |m: &Motion| (m.then.pose.center + m.then.pose.forward() * depth_m).truncate();
    let (mut low, mut high) = (DVec2::INFINITY, DVec2::NEG_INFINITY);
    for m in &shifted {
        (low, high) = (low.min(looks_at(m) - reach), high.max(looks_at(m) + reach));
    }
    let within = |p: DVec2| p.cmpge(low).all() && p.cmple(high).all();
    let near = BoundingBox {
        low: [low.x as f32, low.y as f32, f32::NEG_INFINITY],
        high: [high.x as f32, high.y as f32, f32::INFINITY],
    };
    // Those around that stand still hold what is theirs.
    let around: Vec<Motion> = (0..built.len()).filter_map(motion).filter(|m| within(looks_at(m))).collect();
    let (motions, mut followed) = (Motions::new(around, depth_m), 0);
    let fate = |g: &Trained| {
        let fate = motions.fate(g.mean, g.rotation, CONTRADICTED_PX);
        followed += usize::from(fate != Fate::Stays);
        fate
    };
    let dropped = training.trainer.revise(&near, fate)?;
    report.skip("gaussians_contradicted", dropped as u64);
    // Of the others what they moved adds up until it shows.
    going.into_iter().for_each(|i| training.built.views[i] = poses.view(i));
    Ok(followed)
}

/// Adds those of `fresh` where nothing stands that is trained; makes room for them where there is none. How many they are.
pub(crate) fn take_in(
    training: &mut Training,
    fresh: &GaussianCloud,
    edge_m: f32,
    share: &Share,
    totals: &mut Totals,
) -> Result<usize, EngineError> {
    let (mut low, mut high) = (glam::Vec3::INFINITY, glam::Vec3::NEG_INFINITY);
    for m in &fresh.means {
        (low, high) = (low.min(glam::Vec3::from_array(*m)), high.max(glam::Vec3::from_array(*m)));
    }
    let around = BoundingBox { low: (low - 8.0 * edge_m).into(), high: (high + 8.0 * edge_m).into() };
    let (mut claims, mut room) = (Claims::new(edge_m), Room::new(share.square()));
    training.trainer.each(&around, |g| {
        claims.claim(g);
        room.count(g.mean);
    })?;
    // Where nothing stands, and in no square more than its share.
    let mut new = fresh.clone();
    new.retain(|i| !claims.hold(fresh.means[i]) && room.take(fresh.means[i]));
    let capacity = training.trainer.plan().scene;
    let over = (training.trainer.gaussians() + new.len()).saturating_sub(capacity);
    if over > 0 {
        totals.made_room += make_room(training, over.max(capacity / FREED))? as u64;
    }
    Ok(training.trainer.extend(&new)?.loaded)
}

/// Takes out the Gaussians that cover least; how many.
fn make_room(training: &mut Training, least: usize) -> Result<usize, EngineError> {
    let trainer = &mut training.trainer;
    let mut covers: Vec<f32> = Vec::with_capacity(trainer.gaussians());
    trainer.each(&BoundingBox::ALL, |g| covers.push(g.covers_m2()))?;
    let least = least.min(covers.len().saturating_sub(1));
    if least == 0 {
        return Ok(0);
    }
    let (below, most, _) = covers.select_nth_unstable_by(least - 1, f32::total_cmp);
    // Of those that cover the same the first ones.
    let (most, mut ties) = (*most, 1 + below.iter().filter(|c| c.total_cmp(most).is_eq()).count());
    Ok(trainer.revise(&BoundingBox::ALL, |g| match g.covers_m2().total_cmp(&most) {
        Ordering::Less => Fate::Goes,
        Ordering::Equal if ties > 0 => {
            ties -= 1;
            Fate::Goes
        }
        _ => Fate::Stays,
    })?)
}

#[cfg(test)]
#[cfg(feature = "lab")]
mod tests;
