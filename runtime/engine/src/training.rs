//! Training: Gaussians on the device, the pictures they are trained on, the schedule, and what a new model takes over of the one before.

use std::collections::BTreeSet;

use config::training::TrainSettings;
use image::RgbImage;
use job::run_json::RunReport;
use models::camera::{DepthPrior, PosedImage, View};
use models::cloud::GaussianCloud;
use models::formats::model::Chunks;
use models::light::Light;
use models::mask::Mask;
use vulkan::trainer::{RunBudget, StepReport, TrainSummary, Trainer, Validated};

use super::device::DeviceRequest;
use super::energy::{Meter, shorter};
use super::poses::Poses;
use super::resumed::Resumed;
use crate::error::EngineError;
use average::Average;
use light::LitPictures;
use rebuild::RENEWED_AT;
pub(super) use rebuild::{Fresh, Rebuild};
pub(super) use saved::Earlier;

pub(super) mod average;
pub(super) mod crops;
pub(super) mod growth;
mod light;
mod rebuild;
mod saved;

/// What the Gaussians were made of.
#[derive(Debug, Default)]
pub(super) struct Built {
    /// Views as the Gaussians know them.
    pub views: Vec<View>,
    /// Key frames when everything was last built at once.
    pub key_frames: usize,
    /// How often it was.
    pub times: u32,
    /// Typical depth of the pictures, metres.
    pub depth_m: f32,
}

/// A model in training.
pub(super) struct Training {
    pub(super) settings: TrainSettings,
    /// Models are built while pictures still come, and what is trained is kept over a rebuild.
    pub(super) incremental: bool,
    /// Pictures still come.
    pub(super) flying: bool,
    pub(super) trainer: Trainer,
    /// What the trainer trains on.
    pub(super) pictures: LitPictures,
    /// As of the last checkpoint; none where the scene is in pieces.
    pub(super) cloud: GaussianCloud,
    /// All Gaussians are in the trainer's file only.
    pub(super) in_pieces: bool,
    /// The model whose Gaussians are the first.
    pub(super) first: Option<Chunks>,
    pub(super) built: Built,
    /// What the cloud is the mean of.
    pub(super) average: Average,
    /// What the schedule takes, where its energy is bounded.
    pub(super) meter: Option<Meter>,
    /// Seconds of training over all continuations.
    pub(super) train_s: f64,
}

impl Training {
    /// Opens the device and plans its memory. `in_memory`: all Gaussians must be together in the host's.
    pub fn open(
        device: &DeviceRequest,
        settings: &TrainSettings,
        meter: Option<Meter>,
        incremental: bool,
        in_memory: bool,
    ) -> Result<Self, EngineError> {
        let (trainer, pictures) = device.open::<EngineError>(settings)?;
        let in_pieces = trainer.plan().is_paged() && !in_memory;
        let cloud = match in_pieces {
            true => GaussianCloud::with_capacity(settings.sh.degree, 0),
            false => GaussianCloud::with_memory(settings.sh.degree, trainer.plan().scene),
        };
        Ok(Self {
            settings: settings.clone(),
            incremental,
            flying: incremental,
            cloud,
            in_pieces,
            first: None,
            trainer,
            pictures: LitPictures::new(pictures),
            built: Built { views: Vec::with_capacity(device.views), ..Built::default() },
            average: Average::default(),
            meter,
            train_s: 0.0,
        })
    }

    /// Models are built while pictures still come.
    pub fn is_incremental(&self) -> bool {
        self.incremental
    }

    pub fn has_model(&self) -> bool {
        !self.built.views.is_empty()
    }

    /// Whether the model that is continued was trained on exactly these pictures, and nothing was built of them since.
    pub fn is_continued(&self, resumed: &Resumed, poses: &Poses) -> bool {
        self.built.times == 0 && resumed.is_of(poses)
    }

    /// Gaussians of the model as it is now.
    pub fn gaussians(&self) -> usize {
        if self.has_model() { self.trainer.gaussians() } else { self.cloud.len() }
    }

    /// Pictures that are trained on.
    pub fn views(&self) -> usize {
        self.pictures.store.len()
    }

    /// Adds a picture to those that are trained on.
    pub fn add(&mut self, picture: &PosedImage, prior: Option<&DepthPrior>) -> Result<(), EngineError> {
        self.pictures.store.add(self.trainer.device_mut(), picture, prior)?;
        Ok(())
    }

    /// A picture and its mask as they are trained on.
    pub fn picture(&mut self, i: usize) -> Result<Option<(View, RgbImage, Option<Mask>)>, EngineError> {
        let (store, device) = (&mut self.pictures.store, self.trainer.device_mut());
        let Some(view) = store.view(i) else { return Ok(None) };
        Ok(Some((view, store.image(device, i)?, store.mask(device, i)?)))
    }

    /// The depth that view `i` is held to, if any.
    pub fn set_prior(&mut self, i: usize, depth: Option<&DepthPrior>) -> Result<(), EngineError> {
        Ok(self.pictures.store.set_prior(self.trainer.device_mut(), i, depth)?)
    }

    /// Brings the training pictures from number `from` on into the common light; without one (a continuation makes no new depths) into
    /// that of the model that is continued.
    pub fn even_light(
        &mut self,
        poses: &Poses,
        light: Option<&Light>,
        resumed: &Resumed,
        from: usize,
    ) -> Result<(), EngineError> {
        let continued = Some(&resumed.lights).filter(|_| self.built.times == 0);
        let of = |name: &str| match light {
            Some(light) => Some(light.of(name)),
            None => continued.and_then(|lights| lights.get(name)).copied(),
        };
        self.pictures.even(&mut self.trainer, poses.views(), &of, from)
    }

    /// Poses and lenses of the views become those of `poses`; a depth that `fresh` lacks is no longer held to. How many views have one.
    pub fn renew_views(&mut self, poses: &Poses, fresh: &Fresh, own_depths: bool) -> Result<usize, EngineError> {
        let mut with_prior = 0;
        for (i, (name, view)) in poses.views().iter().enumerate() {
            self.pictures.store.renew(i, *view)?;
            let has_depth = own_depths || fresh.with_depth.contains(name);
            if !has_depth {
                self.set_prior(i, None)?;
            }
            with_prior += usize::from(has_depth);
        }
        Ok(with_prior)
    }

    /// After a growth: views that moved are trained on as they are now, and those from number `first` on stand in the model.
    pub fn renew_moved(&mut self, poses: &Poses, moved: &BTreeSet<usize>, first: usize) -> Result<(), EngineError> {
        self.built.views.extend(poses.views()[first..].iter().map(|v| v.1));
        for &i in moved {
            self.pictures.store.renew(i, poses.view(i))?;
        }
        self.trainer.schedule_mut().renew(RENEWED_AT);
        Ok(())
    }

    /// The Gaussians stand for the key frames of `poses` from here on.
    pub fn set_built(&mut self, poses: &Poses, fresh: &Fresh) {
        self.built.views = poses.views().iter().map(|v| v.1).collect();
        self.built.key_frames = poses.len();
        self.built.depth_m = fresh.report.as_ref().map_or(0.0, |made| 0.5 * (made.depth_m[0] + made.depth_m[1]));
        self.built.times += 1;
    }

    /// Changes how long training may take.
    pub fn set_seconds(&mut self, seconds: Option<f64>) {
        self.settings.seconds = seconds;
        self.trainer.schedule_mut().set_seconds(seconds);
    }

    /// Whether the schedule of `budget` is over.
    pub fn is_done(&self, budget: &RunBudget) -> bool {
        let (steps, seconds) = self.trainer.schedule().spent();
        let by_steps = budget.steps.is_some_and(|s| steps >= s);
        let by_time = budget.seconds.is_some_and(|s| seconds >= s);
        by_steps || by_time
    }

    /// Reads the power, where energy ends the schedule, and sets its seconds by it.
    pub fn read_power(&mut self, report: &mut RunReport) {
        let Some(meter) = &mut self.meter else { return };
        let by_energy = meter.read(self.trainer.schedule().spent().1);
        report.more.insert("energy_wh".into(), meter.used_wh().into());
        self.trainer.schedule_mut().set_seconds(shorter(self.settings.seconds, Some(by_energy)));
    }

    /// Says what was trained and what was skipped. The counters run on since the Gaussians were loaded.
    pub fn note_trained(&self, summary: &TrainSummary, last: Option<StepReport>, report: &mut RunReport) {
        let c = summary.counters;
        for (name, count) in [
            ("culled", c.culled),
            ("behind_opaque", c.behind_opaque),
            ("gradients_not_finite", c.non_finite_gradients),
            ("sh_coefficients", c.sh_missing),
        ] {
            report.skipped.insert(name.to_owned(), count);
        }
        let work = serde_json::json!({ "instances": c.instances, "evaluations": c.evaluations });
        report.more.insert("work".into(), work);
        if let (cells @ 1.., _) = self.trainer.cells() {
            let windows = serde_json::json!({ "cells": cells, "windows": c.windows, "paged_bytes": c.paged_bytes });
            report.more.insert("cells".into(), windows);
        }
        if let Some(Validated { views, holds, drop }) = self.trainer.validated() {
            let validation = serde_json::json!({ "views": views, "holds": holds, "drop": drop });
            if report.more.insert("validation".into(), validation).is_none() {
                let (holds, drop) = (100.0 * holds, 100.0 * drop);
                tracing::info!(
                    "of what is learnt of the other pictures {holds:.0} % holds for {views} that were kept back: \
                     {drop:.0} % of the Gaussians are left out of each step by the end"
                );
            }
        }
        report.more.insert("views_read_back".into(), self.pictures.store.read_back().into());
        if let Some(last) = last.filter(|last| last.loss.is_finite()) {
            report.more.insert("loss".into(), f64::from(last.loss).into());
        }
        for (name, ms) in self.trainer.device().stage_ms() {
            report.stage_ms.insert(format!("device_{name}"), ms);
        }
        report.gaussians = self.trainer.gaussians() as u64;
    }
}
