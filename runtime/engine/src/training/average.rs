//! The mean of what the last epochs of a long schedule end with (`[training.average]`), in the memory of the cloud that checkpoints are
//! written from. Near its end a schedule goes round the best model that it can find; the mean of where it was lies nearer to that.

use job::run_json::RunReport;
use vulkan::trainer::StepReport;

use super::Training;
use crate::error::EngineError;

/// What the cloud is the mean of.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(crate) struct Average {
    /// So many ends of epochs; 0: it is no mean.
    epochs: u32,
    /// Steps at the last of them.
    step: u32,
}

/// When the next end of an epoch counts.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Due {
    from: f32,
    step: u32,
}

impl Due {
    pub fn after(&self, step: &StepReport) -> bool {
        (self.from..1.0).contains(&step.progress) && step.step >= self.step
    }
}

impl Training {
    /// When the present parameters are to be counted in, if they are.
    pub(crate) fn average_due(&self, rounded: bool) -> Option<Due> {
        let t = &self.settings;
        let whole = !self.in_pieces && self.trainer.cells().0 == 0;
        (whole && !self.flying && !rounded)
            .then(|| Due { from: t.average.from.max(t.density.until), step: self.average.step + self.views() as u32 })
    }

    /// An epoch is over: its end counts where the schedule is long enough.
    pub(crate) fn end_epoch(&mut self) -> Result<(), EngineError> {
        let looks = u64::from(self.settings.average.visits) * self.views() as u64;
        if u64::from(self.trainer.schedule().expected_steps()) >= looks {
            return self.average();
        }
        self.average.step = self.trainer.schedule().taken();
        Ok(())
    }

    /// Whether the cloud is the mean of epochs of the present Gaussians.
    pub(crate) fn is_average(&self) -> bool {
        self.average.epochs > 0 && self.cloud.len() == self.trainer.gaussians()
    }

    /// Counts the present parameters in.
    pub(crate) fn average(&mut self) -> Result<(), EngineError> {
        let before = if self.is_average() { self.average.epochs } else { 0 };
        match before {
            0 => self.trainer.snapshot(&mut self.cloud)?,
            _ => self.trainer.blend_into(&mut self.cloud, 1.0 / (before + 1) as f32)?,
        }
        self.average = Average { epochs: before + 1, step: self.trainer.schedule().taken() };
        Ok(())
    }

    /// The schedule is over: its model is the mean.
    pub(crate) fn settle_average(&mut self, report: &mut RunReport) -> Result<(), EngineError> {
        if !self.is_average() {
            return Ok(());
        }
        if self.trainer.schedule().taken() > self.average.step {
            self.average()?;
        }
        self.reload()?;
        tracing::info!("the mean of {} epochs", self.average.epochs);
        report.more.insert("averaged_epochs".into(), self.average.epochs.into());
        self.average = Average::default();
        Ok(())
    }

    /// Loads the cloud in place of the Gaussians that it was made of; the schedule goes on where it was.
    pub(crate) fn reload(&mut self) -> Result<(), EngineError> {
        let ((steps, seconds), begun_at) = (self.trainer.schedule().spent(), self.trainer.schedule().begun_at());
        let validated = self.trainer.validated();
        self.trainer.load(&self.cloud)?;
        self.trainer.continue_validated(validated);
        self.trainer.schedule_mut().continue_from(steps, seconds);
        self.trainer.schedule_mut().begin_at(begun_at);
        self.trainer.keep_number();
        Ok(())
    }
}

#[cfg(test)]
mod tests;
