//! What a running job may change between steps: fewer pixels, other rates, another loss.

use config::training::{LossSettings, RateSettings};

use super::{TrainError, Trainer};

impl Trainer {
    /// Trains on pictures of at most 1/`divisor` of their size from now on, whatever the schedule says (1 = as scheduled):
    /// the failsafe's way to a third of the work without touching the model.
    pub fn set_least_divisor(&mut self, divisor: u32) {
        self.settings.resolution.least_divisor = divisor.max(1);
    }

    /// Takes other learning rates from the next step on.
    ///
    /// # Errors
    /// [`TrainError::Settings`] when one is negative or not a number; the old ones then stay.
    pub fn set_rates(&mut self, rates: &RateSettings) -> Result<(), TrainError> {
        let mut settings = self.settings.clone();
        settings.rates = *rates;
        settings.check()?;
        self.settings = settings;
        Ok(())
    }

    /// Takes another loss from the next step on.
    ///
    /// # Errors
    /// [`TrainError::Settings`] when a weight is negative or not a number; the old one then stays.
    pub fn set_loss(&mut self, loss: &LossSettings) -> Result<(), TrainError> {
        let mut settings = self.settings.clone();
        settings.loss = *loss;
        settings.check()?;
        self.settings = settings;
        Ok(())
    }
}
