//! In flight: what a new key frame shows stands in the model as soon as it is there. Its pose is settled among its neighbours, its
//! depth becomes Gaussians where none stand, theirs move along, and all else stays as it is.

use std::cmp::Ordering;
use std::collections::BTreeSet;
use std::time::Instant;

use models::camera::DepthPrior;
use models::cloud::GaussianCloud;
use vulkan::trainer::{BoundingBox, Fate, Trained};

use super::carry::{Claims, Room};
use super::follow::{Motion, Motions};
use super::rebuild::{CONTRADICTED_PX, MOVED_PX, RENEWED_AT};
use super::{Reconstruction, take_refined};
use crate::error::EngineError;

/// All poses are solved at once whenever the key frames have grown by this share: their errors, which pictures and GPS bound, are
/// spread evenly again, for a cost that all solves together keep in proportion to the key frames.
const WHOLE_GROWTH: f64 = 0.34;
/// Share of the plan that is freed at once where new ground finds no room.
const FREED: usize = 50;
/// Key frames within so many pictures' widths of one that moved may move a Gaussian with it.
const AROUND: f64 = 2.0;

/// What has been done since the last growth, and in all of them.
#[derive(Debug, Default)]
pub(super) struct Growing {
    /// Views whose pose or lens may have changed.
    moved: BTreeSet<usize>,
    /// Key frames when all poses were last solved.
    solved: usize,
    /// That was since the last growth.
    whole: bool,
    /// Key frames when everything was last built at once.
    pub built: usize,
    totals: Totals,
}

/// Sums over all growths, for the report: per growth, nothing in them grows with the flight.
#[derive(Debug, Default, serde::Serialize)]
struct Totals {
    growths: u64,
    pictures: u64,
    depths: u64,
    compared: u64,
    adjusted_frames: u64,
    adjusted_observations: u64,
    gaussians: u64,
    made_room: u64,
    whole_solves: u64,
}

impl Growing {
    /// All poses were solved at once.
    pub fn all_placed(&mut self, views: usize) {
        (self.solved, self.whole) = (views, true);
        self.moved.extend(0..views);
        self.totals.whole_solves += 1;
    }

    /// Everything was built anew.
    pub fn all_built(&mut self, views: usize) {
        (self.built, self.whole) = (views, false);
        self.moved.clear();
    }
}

impl Reconstruction {
    /// Places the newest key frames: at once among their neighbours, or with all others where it is time.
    pub(super) fn place(&mut self) -> Result<(), EngineError> {
        let (n, solved) = (self.views.len(), self.growing.solved);
        if n as f64 >= solved as f64 * (1.0 + WHOLE_GROWTH) {
            return self.refine();
        }
        let Some(refiner) = &mut self.refiner else { return Ok(()) };
        let _span = tracing::info_span!("place").entered();
        let from = Instant::now();
        let near = refiner.solve_near()?;
        for name in &near.moved {
            let Some(&i) = self.index.get(name) else { continue };
            take_refined(refiner, &mut self.initialiser, name, &mut self.views[i].1);
            self.growing.moved.insert(i);
        }
        let points = refiner.recent_points().iter().map(|p| p.position.map(|v| v as f32));
        if let Some(initialiser) = &mut self.initialiser {
            initialiser.hint_points(points);
        }
        self.growing.totals.adjusted_frames += near.adjusted_frames as u64;
        self.growing.totals.adjusted_observations += near.observations as u64;
        self.report.stage("refine", from);
        Ok(())
    }

    /// Whether new key frames can be added to the model as it is.
    pub(super) fn can_grow(&self) -> bool {
        let network = self.initialiser.as_ref().is_some_and(models::init::Initialiser::grows);
        self.flying && network
    }

    /// After a load: while pictures come, the newest are trained on first and their Gaussians are the only new ones.
    pub(super) fn fly_on(&mut self) {
        if self.can_grow() {
            self.trainer.while_views_come();
        }
    }

    /// Adds the key frames that came since to the model; what it did not touch stays as it is. True when all poses were solved, too.
    pub(super) fn grow_model(&mut self) -> Result<bool, EngineError> {
        let _span = tracing::info_span!("grow").entered();
        let (clock, first) = (Instant::now(), self.built.len());
        self.initialise_waiting(self.views.len())?;
        let whole = std::mem::take(&mut self.growing.whole);
        self.growing.moved.extend(first..self.views.len());
        let moved = std::mem::take(&mut self.growing.moved);
        if whole && let Some(initialiser) = &mut self.initialiser {
            let light = initialiser.survey_light()?.cloned();
            self.even_light(light, 0)?;
        }
        let made = self.initialise_new()?;
        let depth_m =
            made.as_ref().map_or(self.depth_m, |(made, _)| 0.5 * (made.report.depth_m[0] + made.report.depth_m[1]));
        self.depth_m = depth_m;
        let followed = self.follow_in_place(&moved, f64::from(depth_m))?;
        let mut new = 0;
        if let Some((made, growth)) = &made {
            self.even_light(made.light.clone(), first)?;
            new = self.take_in(&made.cloud, 2.0 * made.report.voxel_m)?;
            let totals = &mut self.growing.totals;
            totals.depths += growth.depths as u64;
            totals.compared += growth.compared as u64;
            totals.gaussians += new as u64;
        }
        self.built.extend(self.views[first..].iter().map(|v| v.1));
        for i in moved {
            self.pictures.store.renew(i, self.views[i].1)?;
        }
        self.trainer.schedule_mut().renew(RENEWED_AT);
        self.growing.totals.growths += 1;
        self.growing.totals.pictures += (self.views.len() - first) as u64;
        self.report.views = self.views.len() as u64;
        self.report.more.insert("growth".into(), serde_json::to_value(&self.growing.totals)?);
        self.report.stage("grow", clock);
        tracing::info!(
            "grown to {} key frames: {new} Gaussians more, {followed} moved along, {} in all, {:.2} s",
            self.views.len(),
            self.trainer.gaussians(),
            clock.elapsed().as_secs_f64()
        );
        Ok(whole)
    }

    /// Depths and Gaussians of the new key frames; their priors go to the trainer.
    fn initialise_new(&mut self) -> Result<Option<(models::init::Initialisation, models::init::Growth)>, EngineError> {
        let (from, share) = (Instant::now(), self.share());
        let Some(mut initialiser) = self.initialiser.take() else { return Ok(None) };
        let own_network = self.depth.is_some();
        let (index, trainer, pictures, mut failed) = (&self.index, &mut self.trainer, &mut self.pictures.store, Ok(()));
        let mut prior = |name: &str, depth: DepthPrior| {
            if let (Some(&i), Ok(()), false) = (index.get(name), &failed, own_network) {
                failed = pictures.set_prior(trainer.device_mut(), i, Some(&depth));
            }
        };
        let made = initialiser.grow(&|m2| share.of(m2), &mut prior);
        self.initialiser = Some(initialiser);
        failed?;
        self.report.stage("init", from);
        Ok(made?)
    }

    /// Moves what is trained with the key frames among `moved` that refinement moved since; how many Gaussians that were.
    fn follow_in_place(&mut self, moved: &BTreeSet<usize>, depth_m: f64) -> Result<usize, EngineError> {
        let motion = |i: usize| self.built.get(i).map(|then| Motion { then: *then, now: self.views[i].1 });
        let has_moved = |i: &usize| motion(*i).is_some_and(|m| m.pixels_at(depth_m) > MOVED_PX);
        let going: Vec<usize> = moved.iter().copied().filter(has_moved).collect();
        let shifted: Vec<Motion> = going.iter().filter_map(|i| motion(*i)).collect();
        if shifted.is_empty() {
            return Ok(0);
        }
        let wide = |m: &Motion| depth_m * f64::from(m.then.intrinsics.width) / f64::from(m.then.intrinsics.fx);
        let reach = AROUND * shifted.iter().map(wide).fold(0.0, f64::max);
        let looks_at = |m: &Motion| (m.then.pose.center + m.then.pose.forward() * depth_m).truncate();
        let (mut low, mut high) = (glam::DVec2::INFINITY, glam::DVec2::NEG_INFINITY);
        for m in &shifted {
            (low, high) = (low.min(looks_at(m) - reach), high.max(looks_at(m) + reach));
        }
        let within = |p: glam::DVec2| p.cmpge(low).all() && p.cmple(high).all();
        let near = BoundingBox {
            low: [low.x as f32, low.y as f32, f32::NEG_INFINITY],
            high: [high.x as f32, high.y as f32, f32::INFINITY],
        };
        // Those around that stand still hold what is theirs.
        let around: Vec<Motion> = (0..self.built.len()).filter_map(motion).filter(|m| within(looks_at(m))).collect();
        let (motions, mut followed) = (Motions::new(around, depth_m), 0);
        let fate = |g: &Trained| {
            let fate = motions.fate(g.mean, g.rotation, CONTRADICTED_PX);
            followed += usize::from(fate != Fate::Stays);
            fate
        };
        let dropped = self.trainer.revise(&near, fate)?;
        self.report.skip("gaussians_contradicted", dropped as u64);
        // Of the others what they moved adds up until it shows.
        going.into_iter().for_each(|i| self.built[i] = self.views[i].1);
        Ok(followed)
    }

    /// Adds those of `fresh` where nothing stands that is trained; makes room for them where there is none. How many they are.
    fn take_in(&mut self, fresh: &GaussianCloud, edge_m: f32) -> Result<usize, EngineError> {
        let (mut low, mut high) = (glam::Vec3::INFINITY, glam::Vec3::NEG_INFINITY);
        for m in &fresh.means {
            (low, high) = (low.min(glam::Vec3::from_array(*m)), high.max(glam::Vec3::from_array(*m)));
        }
        let around = BoundingBox { low: (low - 8.0 * edge_m).into(), high: (high + 8.0 * edge_m).into() };
        let (mut claims, mut room) = (Claims::new(edge_m), Room::new(self.share().square()));
        self.trainer.each(&around, |g| {
            claims.claim(g);
            room.count(g.mean);
        })?;
        // Where nothing stands, and in no square more than its share.
        let mut new = fresh.clone();
        new.retain(|i| !claims.hold(fresh.means[i]) && room.take(fresh.means[i]));
        let capacity = self.trainer.plan().scene;
        let over = (self.trainer.gaussians() + new.len()).saturating_sub(capacity);
        if over > 0 {
            self.make_room(over.max(capacity / FREED))?;
        }
        Ok(self.trainer.extend(&new)?.loaded)
    }

    /// Takes out the Gaussians that cover least.
    fn make_room(&mut self, least: usize) -> Result<(), EngineError> {
        let mut covers: Vec<f32> = Vec::with_capacity(self.trainer.gaussians());
        self.trainer.each(&BoundingBox::ALL, |g| covers.push(g.covers_m2()))?;
        let least = least.min(covers.len().saturating_sub(1));
        if least == 0 {
            return Ok(());
        }
        let (below, most, _) = covers.select_nth_unstable_by(least - 1, f32::total_cmp);
        // Of those that cover the same the first ones.
        let (most, mut ties) = (*most, 1 + below.iter().filter(|c| c.total_cmp(most).is_eq()).count());
        let gone = self.trainer.revise(&BoundingBox::ALL, |g| match g.covers_m2().total_cmp(&most) {
            Ordering::Less => Fate::Goes,
            Ordering::Equal if ties > 0 => {
                ties -= 1;
                Fate::Goes
            }
            _ => Fate::Stays,
        })?;
        self.growing.totals.made_room += gone as u64;
        Ok(())
    }
}

#[cfg(test)]
#[cfg(feature = "lab")]
mod tests;
