//! What a model that is delivered rounded goes through while it is trained. Half-way through its schedule those Gaussians leave that the
//! loss hangs on least; the others learn to do without them. For the last share of it places, sizes, rotations and opacities are rounded,
//! and colours alone are trained on top of them: what the rounding breaks, they mend.

use std::cmp::Ordering;
use std::path::{Path, PathBuf};
use std::time::Instant;

use config::map::MapSettings;
use config::training::RateSettings;
use disk::Disk;
use job::run_json::RunReport;
use models::formats::FormatError;
use models::formats::delivery::{self, Rounding};
use models::formats::model::ModelHeader;
use vulkan::trainer::{BoundingBox, Fate, StepReport, Trained};

use super::poses::Poses;
use super::training::Training;
use super::{map, model_path};
use crate::error::EngineError;

/// Rates of the colours beside those at the end of the schedule: they have something to mend.
const COLOR_FACTOR: f32 = 2.0;
/// How often each view is visited before it is known what the loss hangs on.
const PASSES: usize = 2;

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

/// The model as it is delivered: its file, its map, and what has been done to it since it was built.
pub(super) struct Delivery {
    pub(super) disk: Disk,
    /// To what the model is rounded, if it is.
    rounding: Option<Rounding>,
    map: Option<MapSettings>,
    /// The build that the last map shows.
    mapped: u32,
    thinned: bool,
    rounded: bool,
    /// What the model file says of itself, as of the last checkpoint.
    pub(super) header: ModelHeader,
}

impl Delivery {
    pub fn new(disk: Disk, rounding: Option<Rounding>, map: Option<MapSettings>, header: ModelHeader) -> Self {
        Self { disk, rounding, map, mapped: 0, thinned: false, rounded: false, header }
    }

    /// Shapes are rounded, and colours alone are trained.
    pub fn is_rounded(&self) -> bool {
        self.rounded
    }

    pub fn count_steps(&mut self, steps: u32) {
        self.header.steps += u64::from(steps);
    }

    /// Goes on where the model of an earlier run ended.
    pub fn continue_from(&mut self, earlier: &ModelHeader) {
        (self.header.steps, self.header.thinned) = (earlier.steps, earlier.thinned);
    }

    /// What is yet to be done to a model that is delivered rounded; nothing while pictures come.
    pub fn due(&self, training: &Training) -> Due {
        let t = &training.settings;
        let delivers = self.rounding.is_some() && !training.flying;
        let thins = delivers && !self.thinned && t.thinned_share > 0.0;
        Due {
            thin: thins.then_some((t.thinned_at, least_steps(training))),
            round: (delivers && !self.rounded && t.rounded_share > 0.0).then_some(1.0 - t.rounded_share),
        }
    }

    /// Does what is due. The schedule goes on.
    pub fn prepare(&mut self, next: Next, training: &mut Training, report: &mut RunReport) -> Result<(), EngineError> {
        match next {
            Next::Thin => {
                (self.thinned, self.header.thinned) = (true, true);
                let t = &training.settings;
                let (share, most_loss) = (t.thinned_share, t.thinned_loss * training.pictures.store.mean_loss());
                let gone = thin(training, share, most_loss)?;
                training.trainer.keep_number();
                report.skip("gaussians_thinned", gone as u64);
                tracing::info!("thinned for delivery by {gone} Gaussians, {} remain", training.trainer.gaussians());
                Ok(())
            }
            Next::Round => self.round(training),
        }
    }

    /// Rounds what gives a Gaussian its shape, as its delivery will, and trains colours alone from here on.
    fn round(&mut self, training: &mut Training) -> Result<(), EngineError> {
        match training.is_average() {
            true => training.average()?,
            false => training.trainer.snapshot(&mut training.cloud)?,
        }
        let rounded = delivery::round_shapes(&training.cloud, &self.rounding.unwrap_or_default())
            .map_err(|e| FormatError::Invalid { path: "the model".into(), what: format!("not rounded: {e}") })?;
        training.cloud.clone_from(&rounded);
        drop(rounded);
        training.average = Default::default();
        training.reload()?;
        let rates = training.settings.rates;
        training.trainer.set_rates(&RateSettings {
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
        tracing::info!("places and shapes are quantised for delivery; colours are trained on");
        Ok(())
    }

    /// A model that is built anew is trained as a whole. One that is `continued` is not thinned a second time.
    pub fn begin(&mut self, continued: bool, training: &mut Training) -> Result<(), EngineError> {
        training.average = Default::default();
        self.thinned = continued && self.header.thinned;
        if std::mem::take(&mut self.rounded) {
            let rates = training.settings.rates;
            training.trainer.set_rates(&rates)?;
        }
        Ok(())
    }

    /// Writes the model as it is now to `out`, and a map of it after each build; its path and how many Gaussians it has.
    pub fn write(
        &mut self,
        poses: &Poses,
        training: &mut Training,
        (out, finished): (&Path, bool),
        report: &mut RunReport,
    ) -> Result<(PathBuf, usize), EngineError> {
        let _span = tracing::info_span!("checkpoint").entered();
        let from = Instant::now();
        self.header.finished = finished;
        let views = poses.views().iter().enumerate().take(training.built.views.len());
        let view = |i: usize| training.pictures.store.view(i);
        self.header.views = views.filter_map(|(i, v)| Some((v.0.clone(), view(i)?))).collect();
        self.header.lights = training.pictures.lights(self.header.views.len());
        let path = model_path(out);
        let gaussians = training.write(&self.disk, &path, &self.header)?;
        report.stage("checkpoint", from);
        let wants_map = training.has_model() && (finished || self.mapped < training.built.times);
        if let Some(settings) = self.map.filter(|_| wants_map) {
            self.mapped = training.built.times;
            map::draw(training, &self.header, settings, (&self.disk, &out.join("map")), report);
        }
        Ok((path, gaussians))
    }
}

/// Steps after which every view has been visited [`PASSES`] times.
fn least_steps(training: &Training) -> u32 {
    (PASSES * training.views()) as u32
}

/// Takes Gaussians out, those of the least [sensitivity](Trained::sensitivity), and leaves all else as it is: `share` of them, or as
/// many as have sensitivities of no more than `most_loss` together. How many those were. The least opaque ones where too few steps
/// were taken to tell.
pub(super) fn thin(training: &mut Training, share: f32, most_loss: f32) -> Result<usize, EngineError> {
    let (least_steps, trainer) = (least_steps(training), &mut training.trainer);
    let told = trainer.schedule().taken() >= least_steps;
    let worth = |g: &Trained| if told { g.sensitivity } else { g.opacity_logit };
    let mut all = Vec::with_capacity(trainer.gaussians());
    trainer.each(&BoundingBox::ALL, |g| all.push(worth(g)))?;
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
    Ok(trainer.revise(&BoundingBox::ALL, |g| {
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

#[cfg(test)]
mod tests;
