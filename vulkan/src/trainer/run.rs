//! A run of steps: how long it may take, what it says about itself, and when it ends early.

use crate::model::Counters;
use config::training::TrainSettings;

/// How long [`run`](super::Trainer::run) may take; whichever comes first. Neither given: the settings' schedule.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct RunBudget {
    /// Steps.
    pub steps: Option<u32>,
    /// Seconds of wall clock.
    pub seconds: Option<f64>,
}

/// One step.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct StepReport {
    /// Number of this step, from 1: of the pictures visited, which a scene larger than the device makes of several updates.
    pub step: u32,
    /// The view it visited.
    pub view: usize,
    /// The crop of its picture that it visited; `None`: the whole picture at training size.
    pub crop: Option<usize>,
    /// The whole loss.
    pub loss: f32,
    /// Mean absolute difference.
    pub l1: f32,
    /// Mean SSIM, 0…1.
    pub ssim: f32,
    /// Pearson's correlation with the depth prior, when the view has one that says something.
    pub depth_correlation: Option<f32>,
    /// Gaussians after the step, those that are not on the device included.
    pub gaussians: usize,
    /// Gaussians in view.
    pub visible: usize,
    /// Gaussian–tile instances.
    pub instances: u64,
    /// Bands they were blended in (1 unless they exceed the plan).
    pub bands: usize,
    /// The picture was reduced by this factor.
    pub divisor: u32,
    /// Seconds of training so far.
    pub elapsed_s: f64,
    /// Share of the schedule that is over, 0…1.
    pub progress: f32,
    /// Every Gaussian is up to date: a snapshot taken now does not change the bits of what follows.
    pub settled: bool,
}

/// Why a run ended.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum StopReason {
    /// The schedule is over.
    Schedule,
    /// The callback said so.
    Caller,
    /// The loss stopped falling.
    Converged,
}

/// A run.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct TrainSummary {
    /// Steps taken.
    pub steps: u32,
    /// Seconds of wall clock.
    pub seconds: f64,
    /// Why it ended.
    pub reason: StopReason,
    /// Gaussians now.
    pub gaussians: usize,
    /// The last step.
    pub last: Option<StepReport>,
    /// Work done and skipped since `load`.
    pub counters: Counters,
}

/// Early stop: epochs in a row without a useful fall of the mean loss. Losses of small pictures say nothing about those of larger ones,
/// so that epochs count from where pictures have their full size. Whoever interrupts training in between loses none of them.
#[derive(Clone, Copy, Debug, Default)]
pub(crate) struct Patience {
    sum: f64,
    count: u32,
    best: Option<f64>,
    idle: u32,
}

impl Patience {
    pub fn is_over(&mut self, settings: &TrainSettings, report: &StepReport, views: usize) -> bool {
        let (resolution, settings) = (&settings.resolution, &settings.stop);
        if !settings.enabled || report.progress < resolution.half_until.max(resolution.quarter_until) {
            return false;
        }
        self.sum += f64::from(report.loss);
        self.count += 1;
        if (self.count as usize) < views.max(1) {
            return false;
        }
        let mean = self.sum / f64::from(self.count);
        let improved = self.best.is_none_or(|b| mean < b * (1.0 - f64::from(settings.least_gain)));
        self.idle = if improved { 0 } else { self.idle + 1 };
        self.best = Some(self.best.map_or(mean, |b| b.min(mean)));
        (self.sum, self.count) = (0.0, 0);
        self.idle >= settings.patience.max(1)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn epochs_without_a_fall_end_a_run_but_not_before_pictures_have_their_full_size() {
        let mut settings = TrainSettings::default();
        settings.stop.enabled = true;
        settings.resolution.half_until = 0.5;
        let mut patience = Patience::default();
        // Two views, ten epochs: small pictures have small losses that fall no more.
        let at = |progress, loss| StepReport { progress, loss, ..StepReport::default() };
        assert!((0..20).all(|_| !patience.is_over(&settings, &at(0.4, 0.1), 2)));
        // At full size it falls from above theirs, and then no longer.
        assert!((0..10).all(|i| !patience.is_over(&settings, &at(0.6, 0.3 - 0.01 * i as f32), 2)));
        let idle = (0..20).position(|_| patience.is_over(&settings, &at(0.8, 0.3), 2));
        assert_eq!(idle, Some(2 * settings.stop.patience as usize - 1));
    }
}
