//! What a model that is delivered rounded goes through while it is trained. Half-way through its schedule those Gaussians leave that the
//! loss hangs on least; the others learn to do without them. For the last share of it places, sizes, rotations and opacities are rounded,
//! and colours alone are trained on top of them: what the rounding breaks, they mend.

use std::cmp::Ordering;

use config::training::RateSettings;
use models::formats::FormatError;
use models::formats::delivery;
use vulkan::trainer::{BoundingBox, Fate, StepReport, Trained};

use super::Reconstruction;
use super::average::Average;
use crate::error::EngineError;

/// Rates of the colours beside those at the end of the schedule: they have something to mend.
const COLOR_FACTOR: f32 = 2.0;
/// How often each view is looked at before it is known what the loss hangs on.
const PASSES: usize = 2;

/// What has been done to the model since it was built.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct Delivery {
    thinned: bool,
    pub rounded: bool,
}

/// What is done next.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Next {
    Thin,
    Round,
}

/// When it is done.
#[derive(Clone, Copy, Debug)]
pub(super) struct Due {
    /// From which progress on, and after how many steps since the model was loaded; until which.
    thin: Option<(f32, u32)>,
    round: Option<f32>,
}

impl Due {
    pub fn after(&self, step: &StepReport) -> Option<Next> {
        let round = self.round.is_some_and(|from| (from..1.0).contains(&step.progress));
        let thin = self.thin.is_some_and(|(from, least)| step.progress >= from && step.step >= least);
        match () {
            () if round => Some(Next::Round),
            () if thin && step.progress < self.round.unwrap_or(1.0) => Some(Next::Thin),
            () => None,
        }
    }
}

impl Reconstruction {
    /// What is yet to be done to a model that is delivered rounded; nothing while pictures come.
    pub(super) fn delivery_due(&self) -> Due {
        let t = &self.settings.training;
        let delivers = self.settings.delivers.is_some() && !self.flying;
        let thins = delivers && !self.delivery.thinned && t.thinned_share > 0.0;
        Due {
            thin: thins.then_some((t.thinned_at, self.least_steps())),
            round: (delivers && !self.delivery.rounded && t.rounded_share > 0.0).then_some(1.0 - t.rounded_share),
        }
    }

    /// Steps after which every view has been looked at [`PASSES`] times.
    fn least_steps(&self) -> u32 {
        (PASSES * self.views.len()) as u32
    }

    /// Does what is due. The schedule goes on.
    pub(super) fn prepare_delivery(&mut self, next: Next) -> Result<(), EngineError> {
        match next {
            Next::Thin => {
                (self.delivery.thinned, self.header.thinned) = (true, true);
                let t = &self.settings.training;
                let gone = self.thin(t.thinned_share, t.thinned_loss * self.pictures.store.mean_loss())?;
                self.trainer.keep_number();
                self.report.skip("gaussians_thinned", gone as u64);
                tracing::info!("thinned for delivery by {gone} Gaussians, {} remain", self.trainer.gaussians());
                Ok(())
            }
            Next::Round => self.round(),
        }
    }

    /// Takes Gaussians out, those of the least [sensitivity](Trained::sensitivity), and leaves all else as it is: `share` of them, or as
    /// many as have sensitivities of no more than `most_loss` together. How many those were. The least opaque ones where too few steps
    /// were taken to tell.
    pub(super) fn thin(&mut self, share: f32, most_loss: f32) -> Result<usize, EngineError> {
        let told = self.trainer.schedule().taken() >= self.least_steps();
        let worth = |g: &Trained| if told { g.sensitivity } else { g.opacity_logit };
        let mut all = Vec::with_capacity(self.trainer.gaussians());
        self.trainer.each(&BoundingBox::ALL, |g| all.push(worth(g)))?;
        all.sort_unstable_by(f32::total_cmp);
        let mut leave = (f64::from(share) * all.len() as f64) as usize;
        if told {
            let mut lost = 0.0f64;
            let cheap = all.iter().take_while(|v| {
                lost += f64::from(**v);
                lost <= f64::from(most_loss)
            });
            leave = leave.min(cheap.count());
        }
        let Some(most) = leave.checked_sub(1).map(|last| all[last]) else { return Ok(0) };
        // Of those that are worth the same the first ones.
        let below = all.partition_point(|v| v.total_cmp(&most).is_lt());
        let mut ties = leave - below;
        Ok(self.trainer.revise(&BoundingBox::ALL, |g| {
            let goes = match worth(g).total_cmp(&most) {
                Ordering::Less => true,
                Ordering::Equal if ties > 0 => {
                    ties -= 1;
                    true
                }
                _ => false,
            };
            if goes { Fate::Goes } else { Fate::Stays }
        })?)
    }

    /// Rounds what gives a Gaussian its shape, as its delivery will, and trains colours alone from here on.
    fn round(&mut self) -> Result<(), EngineError> {
        match self.is_average() {
            true => self.average()?,
            false => self.trainer.snapshot(&mut self.cloud)?,
        }
        let rounded = delivery::round_shapes(&self.cloud, &self.settings.delivers.unwrap_or_default())
            .map_err(|e| FormatError::Invalid { path: "the model".into(), what: format!("not rounded: {e}") })?;
        self.cloud.clone_from(&rounded);
        drop(rounded);
        self.average = Average::default();
        self.reload()?;
        let rates = self.settings.training.rates;
        self.trainer.set_rates(&RateSettings {
            mean_start: 0.0,
            mean_end: 0.0,
            log_scale: 0.0,
            rotation: 0.0,
            opacity: 0.0,
            sh_dc: COLOR_FACTOR * rates.sh_dc,
            sh_rest: COLOR_FACTOR * rates.sh_rest,
            ..rates
        })?;
        self.delivery.rounded = true;
        tracing::info!("rounded for delivery: colours go on");
        Ok(())
    }

    /// A model that is built anew is trained as a whole. One that is continued is not thinned a second time.
    pub(super) fn begin_delivery(&mut self) -> Result<(), EngineError> {
        self.average = Average::default();
        let thinned = self.is_continued() && self.header.thinned;
        let was = std::mem::replace(&mut self.delivery, Delivery { thinned, rounded: false });
        if was.rounded {
            self.trainer.set_rates(&self.settings.training.rates)?;
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests;
