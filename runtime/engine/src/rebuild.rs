//! What a rebuild keeps of what is trained already.

use models::camera::View;

use super::Reconstruction;
use super::budget::Share;
use super::carry::{Room, carry_over};
use super::first_gaussians::FirstGaussians;
use super::follow::{Motion, Motions, follow};
use crate::error::EngineError;

/// Key frames that refinement moved less than this have not moved, pixels at the ground.
pub(super) const MOVED_PX: f64 = 0.05;
/// Trained Gaussians are kept over a rebuild only where their key frames' motions agree to this, pixels.
pub(super) const CONTRADICTED_PX: f64 = 1.5;

/// After the landing, what was trained in flight makes way for first Gaussians of all pictures when less than this share of a
/// schedule went into it: theirs come from depths that all neighbours had a part in.
const WORTH_KEEPING: f32 = 0.5;

/// Where the schedule goes on from after a growth, and begins after a landing that keeps most Gaussians. What is there has been trained and
/// would be shaken by the rates of its beginning each time; pictures are still looked at in half their size. 0.2 to 0.7 dB on a flight of 150
/// pictures (tests/results/TRIED.md).
pub(super) const RENEWED_AT: f32 = 0.3;

impl Reconstruction {
    /// Where the schedule begins that follows a landing: large rates and small pictures are for what was not trained yet.
    pub(super) fn begin_after_landing(&mut self, loaded: usize, new: usize) {
        let landed = self.settings.incremental && !self.flying;
        if landed && 2 * new < loaded {
            self.trainer.schedule_mut().begin_at(RENEWED_AT);
        }
    }

    /// The cloud to train: what is trained already, and fresh Gaussians where it is not. How many of them are fresh.
    pub(super) fn take_over(&mut self, fresh: &FirstGaussians) -> Result<usize, EngineError> {
        if self.builds > 0 {
            self.trainer.snapshot(&mut self.cloud)?;
        }
        let made = fresh.report.as_ref().filter(|_| self.settings.incremental);
        Ok(match made {
            _ if self.is_continued() || self.first.is_some() => 0,
            Some(made) => {
                if self.builds > 0 && self.is_hardly_trained() {
                    self.cloud.clone_from(&fresh.cloud);
                    return Ok(self.cloud.len());
                }
                self.follow_key_frames(0.5 * (made.depth_m[0] + made.depth_m[1]));
                if self.builds > 0 && 2 * self.cloud.len() < fresh.cloud.len() {
                    // What grew with the region in mind is coarse where less of it was flown.
                    self.cloud.clone_from(&fresh.cloud);
                    return Ok(self.cloud.len());
                }
                let (capacity, ground) = (self.trainer.plan().scene, self.initialiser.as_ref().map(|i| i.ground_m2()));
                let room = Room::new(Share::over(capacity, ground.unwrap_or(0.0)).square());
                carry_over(&mut self.cloud, &fresh.cloud, 2.0 * made.voxel_m, capacity, room)
            }
            None => {
                self.cloud.clone_from(&fresh.cloud);
                self.cloud.len()
            }
        })
    }

    /// No more pictures come, and most of the training is still ahead.
    fn is_hardly_trained(&self) -> bool {
        let steps = u32::try_from(self.header.steps).unwrap_or(u32::MAX);
        !self.flying && self.settings.training.progress(steps, self.train_s) < WORTH_KEEPING
    }

    /// Moves what is trained with the key frames that refinement moved since, at `depth_m`.
    fn follow_key_frames(&mut self, depth_m: f32) {
        let then = |(i, (name, now)): (usize, &(String, View))| {
            let then = self.built.get(i).or_else(|| self.resumed.get(name))?;
            Some(Motion { then: *then, now: *now })
        };
        let motions: Vec<Motion> = self.views.iter().enumerate().filter_map(then).collect();
        let most_px = motions.iter().map(|m| m.pixels_at(depth_m.into())).fold(0.0, f64::max);
        if most_px > MOVED_PX {
            let dropped = follow(&mut self.cloud, &Motions::new(motions, depth_m.into()), CONTRADICTED_PX);
            self.report.skip("gaussians_contradicted", dropped as u64);
            tracing::info!(
                "refinement moved earlier key frames by up to {most_px:.1} px: {} Gaussians follow, {dropped} are made anew",
                self.cloud.len()
            );
        }
    }
}
