//! What a rebuild keeps of what is trained already.

use std::collections::HashSet;

use job::run_json::RunReport;
use models::camera::View;
use models::cloud::GaussianCloud;
use models::init::InitReport;
use models::light::Light;

use super::Training;
use crate::budget::Share;
use crate::carry::{Room, carry_over};
use crate::error::EngineError;
use crate::follow::{Motion, Motions, follow};
use crate::poses::Poses;
use crate::resumed::Resumed;

/// Key frames that refinement moved less than this have not moved, pixels at the ground.
pub(crate) const MOVED_PX: f64 = 0.05;
/// Trained Gaussians are kept over a rebuild only where their key frames' motions agree to this, pixels.
pub(crate) const CONTRADICTED_PX: f64 = 1.5;

/// After the landing, what was trained in flight makes way for first Gaussians of all pictures when less than this share of a
/// schedule went into it: theirs come from depths that all neighbours had a part in.
const WORTH_KEEPING: f32 = 0.5;

/// Where the schedule goes on from after a growth, and begins after a landing that keeps most Gaussians. What is there has been trained and
/// would be shaken by the rates of its beginning each time; pictures are still visited in half their size. 0.2 to 0.7 dB on a flight of 150
/// pictures (tests/results/TRIED.md).
pub(crate) const RENEWED_AT: f32 = 0.3;

/// Gaussians to train from.
pub(crate) struct Fresh {
    pub cloud: GaussianCloud,
    /// Pictures that have a depth.
    pub with_depth: HashSet<String>,
    /// The pictures' light, where it is uneven.
    pub light: Option<Light>,
    /// Of the feed-forward network.
    pub report: Option<InitReport>,
}

impl From<GaussianCloud> for Fresh {
    fn from(cloud: GaussianCloud) -> Self {
        Self { cloud, with_depth: HashSet::new(), light: None, report: None }
    }
}

/// What a rebuild begins with.
pub(crate) struct Rebuild<'a> {
    pub poses: &'a Poses,
    pub resumed: &'a Resumed,
    /// Steps of training over all continuations.
    pub steps: u64,
    /// Ground that the pictures show, square metres.
    pub ground_m2: Option<f64>,
}

impl Training {
    /// Where the schedule begins that follows a landing: large rates and small pictures are for what was not trained yet.
    pub(crate) fn begin_after_landing(&mut self, loaded: usize, new: usize) {
        let landed = self.incremental && !self.flying;
        if landed && 2 * new < loaded {
            self.trainer.schedule_mut().begin_at(RENEWED_AT);
        }
    }

    /// The cloud to train: what is trained already, and fresh Gaussians where it is not. How many of them are fresh.
    pub(crate) fn take_over(
        &mut self,
        fresh: &Fresh,
        from: &Rebuild<'_>,
        report: &mut RunReport,
    ) -> Result<usize, EngineError> {
        let rebuilt = self.built.times > 0;
        if rebuilt {
            self.trainer.snapshot(&mut self.cloud)?;
        }
        if self.is_continued(from.resumed, from.poses) || self.first.is_some() {
            return Ok(0);
        }
        let Some(made) = fresh.report.as_ref().filter(|_| self.incremental) else { return Ok(self.begin_anew(fresh)) };
        if rebuilt && self.is_hardly_trained(from.steps) {
            return Ok(self.begin_anew(fresh));
        }
        self.follow_key_frames(from, 0.5 * (made.depth_m[0] + made.depth_m[1]), report);
        if rebuilt && 2 * self.cloud.len() < fresh.cloud.len() {
            // What grew with the region in mind is coarse where less of it was flown.
            return Ok(self.begin_anew(fresh));
        }
        let capacity = self.trainer.plan().scene;
        let room = Room::new(Share::over(capacity, from.ground_m2.unwrap_or(0.0)).square());
        Ok(carry_over(&mut self.cloud, &fresh.cloud, 2.0 * made.merge.voxel_m, capacity, room))
    }

    fn begin_anew(&mut self, fresh: &Fresh) -> usize {
        self.cloud.clone_from(&fresh.cloud);
        self.cloud.len()
    }

    /// No more pictures come, and most of the training is still ahead.
    fn is_hardly_trained(&self, steps: u64) -> bool {
        let steps = u32::try_from(steps).unwrap_or(u32::MAX);
        !self.flying && self.settings.progress(steps, self.train_s) < WORTH_KEEPING
    }

    /// Moves what is trained with the key frames that refinement moved since, at `depth_m`.
    fn follow_key_frames(&mut self, from: &Rebuild<'_>, depth_m: f32, report: &mut RunReport) {
        let then = |(i, (name, now)): (usize, &(String, View))| {
            let then = self.built.views.get(i).or_else(|| from.resumed.views.get(name))?;
            Some(Motion { then: *then, now: *now })
        };
        let motions: Vec<Motion> = from.poses.views().iter().enumerate().filter_map(then).collect();
        let most_px = motions.iter().map(|m| m.pixels_at(depth_m.into())).fold(0.0, f64::max);
        if most_px > MOVED_PX {
            let dropped = follow(&mut self.cloud, &Motions::new(motions, depth_m.into()), CONTRADICTED_PX);
            report.skip("gaussians_contradicted", dropped as u64);
            tracing::info!(
                "refinement moved earlier key frames by up to {most_px:.1} px: {} Gaussians follow, {dropped} are made anew",
                self.cloud.len()
            );
        }
    }
}
