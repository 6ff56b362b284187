//! The last share of the schedule, with rounded values: a model that is delivered rounded gets its places, sizes, rotations and
//! opacities rounded before training ends, and its colours are trained on top of them. What the rounding breaks, they mend.

use config::training::RateSettings;
use models::formats::FormatError;
use models::formats::delivery::{self, Rounding};

use super::Reconstruction;
use crate::error::JobError;

/// Rates of the colours beside those at the end of the schedule: they have something to mend.
const COLOR_FACTOR: f32 = 2.0;

impl Reconstruction {
    /// The progress at which the model is rounded; `None`: it has been, or never is because it is delivered as it is.
    pub(super) fn rounded_from(&self) -> Option<f32> {
        let share = self.settings.training.rounded_share;
        (self.settings.delivers && !self.rounded && share > 0.0).then_some(1.0 - share)
    }

    /// Rounds what gives a Gaussian its shape, as its delivery will, and trains colours alone from here on. The schedule goes on.
    pub(super) fn round(&mut self) -> Result<(), JobError> {
        self.trainer.snapshot(&mut self.cloud)?;
        let rounded = delivery::round_shapes(&self.cloud, &Rounding::default())
            .map_err(|e| FormatError::Invalid { path: "the model".into(), what: format!("not rounded: {e}") })?;
        self.cloud.clone_from(&rounded);
        drop(rounded);
        let (steps, seconds) = self.trainer.spent();
        self.trainer.load(&self.cloud)?;
        self.trainer.continue_from(steps, seconds);
        self.fly_on();
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
        self.rounded = true;
        tracing::info!("rounded for delivery: colours go on");
        Ok(())
    }

    /// A model that is built anew is trained as a whole.
    pub(super) fn unround(&mut self) -> Result<(), JobError> {
        if std::mem::take(&mut self.rounded) {
            self.trainer.set_rates(&self.settings.training.rates)?;
        }
        Ok(())
    }
}
