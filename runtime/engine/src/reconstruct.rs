//! What a job asks of the engine, in the order in which it asks.

use std::ops::ControlFlow;
use std::path::{Path, PathBuf};
use std::time::Instant;

use image::imageops::{FilterType, resize};
use models::camera::{Pose, PosedImage};
use models::formats::model;
use survey::dataset::scaled;
use vulkan::trainer::{RunBudget, StepReport, StopReason, Validated};

use super::energy::EVERY_S;
use super::{PictureSource, Reconstruction, model_path};
use crate::error::EngineError;

/// Fewer key frames than this say too little about the ground.
const FIRST_BUILD: usize = 3;
/// Key frames that may wait to be placed together.
const PLACED_AT_ONCE: usize = 4;
/// A model is rebuilt when the key frames have grown by this share since the last build: often enough that new ground
/// is trained on soon, seldom enough that building does not eat the time of training.
const REBUILD_GROWTH: f64 = 0.34;
/// Share of the Gaussians that is given up where memory or time is short.
const GIVEN_UP: f32 = 1.0 / 3.0;

/// What makes a model out of key frames: the seam at which a rehearsal stands in for networks, device and disk.
pub trait Reconstruct {
    /// Takes in a new key frame. With `more` waiting behind it, poses are solved and depths estimated with the last of them.
    ///
    /// # Errors
    /// A network or the device fails. A picture that cannot be tied to the others keeps its pose and is logged.
    fn add(&mut self, frame: PosedImage, more: bool) -> Result<(), EngineError>;
    /// Number of key frames.
    fn keyframes(&self) -> usize;
    /// Pose of a key frame as it is known now.
    fn pose(&self, name: &str) -> Option<Pose>;
    /// Whether enough key frames came since the last build; with `last`, whether any did.
    fn wants_build(&self, last: bool) -> bool;
    /// Whether key frames came that can be added to the model without building it anew.
    fn wants_growth(&self) -> bool {
        false
    }
    /// Adds the key frames that came to the model as it is trained; true when the poses of all others are known better, too.
    ///
    /// # Errors
    /// The network or the device fails.
    fn grow(&mut self) -> Result<bool, EngineError> {
        Ok(false)
    }
    /// No more key frames come.
    fn land(&mut self) {}
    /// Whether there is a model to train.
    fn has_model(&self) -> bool;
    /// (Re)builds the model from all key frames and starts its schedule; false when `go_on` said no before it was.
    ///
    /// # Errors
    /// The network or the device fails; the pictures give no depth.
    fn build(&mut self, go_on: &dyn Fn() -> bool) -> Result<bool, EngineError>;
    /// Has what training pictures are too small to show cut out of the key frames, once no more of them come; false when `go_on` said
    /// no before it was.
    ///
    /// # Errors
    /// A picture that was there cannot be read any more; the file of the views cannot be written.
    fn look_closer(&mut self, _source: &mut dyn PictureSource, _go_on: &dyn Fn() -> bool) -> Result<bool, EngineError> {
        Ok(true)
    }
    /// Changes how long training may take; the share of the schedule that is over changes with it.
    fn set_seconds(&mut self, seconds: Option<f64>);
    /// Whether the schedule of `budget` is over.
    fn is_done(&self, budget: &RunBudget) -> bool;
    /// Trains until the budget, the schedule, or `each` says stop.
    ///
    /// # Errors
    /// The device fails; the last checkpoint stays valid.
    fn train(
        &mut self,
        budget: &RunBudget,
        each: &mut dyn FnMut(&StepReport) -> ControlFlow<()>,
    ) -> Result<StopReason, EngineError>;
    /// Trains at half the size, or as scheduled again.
    fn halve_resolution(&mut self, on: bool);
    /// Gives up the third of the Gaussians that the loss hangs on least, or that is least opaque where not all are on the device: less memory
    /// moved, less to blend.
    ///
    /// # Errors
    /// The device fails.
    fn shrink(&mut self) -> Result<(), EngineError>;
    /// Gaussians of the model as it is now.
    fn gaussians(&self) -> usize;
    /// Writes the model as it is now; returns its path and its number of Gaussians.
    ///
    /// # Errors
    /// The device cannot be read or the disk written; the file written before stays.
    fn checkpoint(&mut self, out: &Path, finished: bool) -> Result<(PathBuf, usize), EngineError>;
}

impl Reconstruct for Reconstruction {
    fn add(&mut self, mut picture: PosedImage, more: bool) -> Result<(), EngineError> {
        if !self.settings.incremental
            && let Some(view) = self.resumed.get(&picture.name)
        {
            picture.view.pose = view.pose;
        }
        let from = Instant::now();
        if let Some(refiner) = &mut self.refiner {
            match refiner.add(&picture) {
                Ok(report) => {
                    self.unsolved = true;
                    tracing::debug!("{}: {} features, {} pairs", picture.name, report.features, report.pairs_verified);
                }
                Err(e) => {
                    tracing::warn!("pose refinement: {e}");
                    self.report.skip("pictures_not_refined", 1);
                }
            }
            self.report.stage("refine", from);
        }
        let lens = scaled(&picture.view.intrinsics, self.settings.scale)?;
        if (lens.width, lens.height) != picture.image.dimensions() {
            picture.image = resize(&picture.image, lens.width, lens.height, FilterType::Lanczos3);
            picture.mask = picture.mask.map(|mask| mask.resized(lens.width, lens.height));
        }
        picture.view.intrinsics = lens;
        let prior = self.depth.as_mut().map(|network| network.estimate(&picture.image)).transpose()?;
        self.pictures.store.add(self.trainer.device_mut(), &picture, prior.as_ref())?;
        self.index.insert(picture.name.clone(), self.views.len());
        self.views.push((picture.name.clone(), picture.view));
        let waiting = self.views.len() - self.initialised;
        if self.settings.incremental && more && waiting < PLACED_AT_ONCE {
            return Ok(());
        }
        if self.settings.incremental && std::mem::take(&mut self.unsolved) {
            self.place()?;
        }
        // Without refinement, or while pictures come, the pose is as good as it will be for now.
        if (self.settings.incremental || self.refiner.is_none())
            && let Some((_, view)) = self.views.last().cloned()
            && self.initialiser.is_some()
        {
            let from = Instant::now();
            self.initialise_waiting(self.views.len() - 1)?;
            let first = !self.has_model();
            let Some(initialiser) = &mut self.initialiser else { return Ok(()) };
            picture.view.pose = view.pose;
            initialiser.add(&picture)?;
            self.initialised = self.views.len();
            if self.settings.incremental && first {
                // The network runs on a picture once its neighbours are there; doing it now spreads the work over the flight.
                initialiser.advance(1)?;
            }
            self.report.stage("init", from);
        }
        Ok(())
    }

    fn keyframes(&self) -> usize {
        self.views.len()
    }

    fn pose(&self, name: &str) -> Option<Pose> {
        self.index.get(name).map(|i| self.views[*i].1.pose)
    }

    fn wants_build(&self, last: bool) -> bool {
        let (now, then) = (self.views.len(), self.growing.built);
        match last {
            _ if now < FIRST_BUILD => false,
            true => now > then,
            false if then > 0 && self.can_grow() => false,
            false => then == 0 || now as f64 >= then as f64 * (1.0 + REBUILD_GROWTH),
        }
    }

    fn wants_growth(&self) -> bool {
        self.has_model() && self.can_grow() && !self.unsolved && self.views.len() > self.built.len()
    }

    fn grow(&mut self) -> Result<bool, EngineError> {
        self.grow_model()
    }

    fn land(&mut self) {
        self.flying = false;
    }

    fn has_model(&self) -> bool {
        !self.built.is_empty()
    }

    fn build(&mut self, go_on: &dyn Fn() -> bool) -> Result<bool, EngineError> {
        let clock = Instant::now();
        self.refine()?;
        let from = Instant::now();
        let Some(mut fresh) = self.initialise(go_on)? else { return Ok(false) };
        self.report.stage("init", from);
        self.even_light(fresh.light.take(), 0)?;
        let new = self.take_over(&fresh)?;
        let loaded = self.load_first()?;
        self.begin_delivery()?;
        self.fly_on();
        self.begin_after_landing(loaded.loaded, new);
        self.report.skip("gaussians_not_finite", loaded.dropped_non_finite as u64);
        self.report.skip("gaussians_over_capacity", loaded.dropped_over_capacity as u64);
        let mut with_prior = 0;
        for (i, (name, view)) in self.views.iter().enumerate() {
            self.pictures.store.renew(i, *view)?;
            let has_depth = fresh.with_depth.contains(name);
            if self.depth.is_none() && !has_depth {
                self.pictures.store.set_prior(self.trainer.device_mut(), i, None)?;
            }
            with_prior += u64::from(self.depth.is_some() || has_depth);
        }
        self.built = self.views.iter().map(|v| v.1).collect();
        self.growing.all_built(self.views.len());
        self.depth_m = fresh.report.as_ref().map_or(0.0, |made| 0.5 * (made.depth_m[0] + made.depth_m[1]));
        let network = self.depth.as_ref().map(|network| network.name().to_owned());
        let network = network.or(fresh.report.as_ref().map(|report| report.network.clone()));
        if with_prior > 0 {
            let prior = serde_json::json!({ "name": network, "views": with_prior });
            self.report.more.insert("depth_prior".into(), prior);
        }
        if let Some(network) = &mut self.depth {
            network.close();
        }
        if let Some(refined) = &self.refined {
            self.report.more.insert("reprojection_rms_px".into(), refined.reprojection_rms_px.into());
            self.report.more.insert("refine".into(), serde_json::to_value(refined)?);
        }
        if let Some(made) = &fresh.report {
            self.report.skipped.insert("pairs".into(), made.skipped.total() as u64);
            self.report.skipped.insert("depth_samples_inconsistent".into(), made.removed as u64);
            self.report.more.insert("init".into(), serde_json::to_value(made)?);
        }
        if self.is_continued() && !self.settings.incremental {
            let steps = u32::try_from(self.header.steps).unwrap_or(u32::MAX);
            self.trainer.schedule_mut().continue_from(steps, self.train_s);
        }
        self.builds += 1;
        self.report.views = self.views.len() as u64;
        self.report.more.insert("builds".into(), self.builds.into());
        self.report.more.insert("gaussians_kept".into(), loaded.loaded.saturating_sub(new).into());
        tracing::info!(
            "built from {} key frames: {} Gaussians ({} of them new) in {:.1} s",
            self.views.len(),
            loaded.loaded,
            new,
            clock.elapsed().as_secs_f64()
        );
        Ok(true)
    }

    fn look_closer(&mut self, source: &mut dyn PictureSource, go_on: &dyn Fn() -> bool) -> Result<bool, EngineError> {
        self.cut_crops(source, go_on)
    }

    fn set_seconds(&mut self, seconds: Option<f64>) {
        self.settings.training.seconds = seconds;
        self.trainer.schedule_mut().set_seconds(seconds);
    }

    fn is_done(&self, budget: &RunBudget) -> bool {
        let (steps, seconds) = self.trainer.schedule().spent();
        let by_steps = budget.steps.is_some_and(|s| steps >= s);
        let by_time = budget.seconds.is_some_and(|s| seconds >= s);
        by_steps || by_time
    }

    fn train(
        &mut self,
        budget: &RunBudget,
        each: &mut dyn FnMut(&StepReport) -> ControlFlow<()>,
    ) -> Result<StopReason, EngineError> {
        let _span = tracing::info_span!("train").entered();
        let from = Instant::now();
        let mut last = None;
        let summary = loop {
            self.read_power();
            let (due, before, mut next) = (self.delivery_due(), self.trainer.schedule().elapsed_s(), None);
            let read_s = if self.meter.is_some() { before + EVERY_S } else { f64::INFINITY };
            let (mut asked_to_stop, mut reads, mut counts) = (false, false, false);
            let average = self.average_due();
            let summary = self.trainer.run(&mut self.pictures.store, budget, &mut |step| {
                next = due.after(step);
                reads = step.elapsed_s >= read_s;
                counts = average.is_some_and(|due| due.after(step));
                asked_to_stop = each(step).is_break();
                let goes_on = next.is_none() && !reads && !counts && !asked_to_stop;
                if goes_on { ControlFlow::Continue(()) } else { ControlFlow::Break(()) }
            })?;
            last = summary.last.or(last);
            self.header.steps += u64::from(summary.steps);
            self.report.steps += u64::from(summary.steps);
            self.train_s += self.trainer.schedule().elapsed_s() - before;
            if counts {
                self.end_epoch()?;
            }
            next.map_or(Ok(()), |next| self.prepare_delivery(next))?;
            if (next.is_none() && !reads && !counts) || asked_to_stop {
                break summary;
            }
        };
        self.read_power();
        self.report.stage("train", from);
        let c = summary.counters;
        for (name, count) in [
            ("culled", c.culled),
            ("behind_opaque", c.behind_opaque),
            ("gradients_not_finite", c.non_finite_gradients),
            ("sh_coefficients", c.sh_missing),
        ] {
            // The counters run on since `load`.
            self.report.skipped.insert(name.to_owned(), count);
        }
        let work = serde_json::json!({ "instances": c.instances, "evaluations": c.evaluations });
        self.report.more.insert("work".into(), work);
        if let (cells @ 1.., _) = self.trainer.cells() {
            let windows = serde_json::json!({ "cells": cells, "windows": c.windows, "paged_bytes": c.paged_bytes });
            self.report.more.insert("cells".into(), windows);
        }
        if let Some(Validated { views, holds, drop }) = self.trainer.validated() {
            let validation = serde_json::json!({ "views": views, "holds": holds, "drop": drop });
            if self.report.more.insert("validation".into(), validation).is_none() {
                let (holds, drop) = (100.0 * holds, 100.0 * drop);
                tracing::info!(
                    "of what is learnt of the other pictures {holds:.0} % holds for {views} that were kept back: \
                     {drop:.0} % of the Gaussians are left out of each step by the end"
                );
            }
        }
        self.report.more.insert("views_read_back".into(), self.pictures.store.read_back().into());
        if let Some(last) = last.filter(|last| last.loss.is_finite()) {
            self.report.more.insert("loss".into(), f64::from(last.loss).into());
        }
        for (name, ms) in self.trainer.device().stage_ms() {
            self.report.stage_ms.insert(format!("device_{name}"), ms);
        }
        self.report.gaussians = self.trainer.gaussians() as u64;
        if summary.reason != StopReason::Caller {
            self.settle_average()?;
        }
        Ok(summary.reason)
    }

    fn halve_resolution(&mut self, on: bool) {
        self.trainer.set_least_divisor(if on { 2 } else { 1 });
    }

    fn shrink(&mut self) -> Result<(), EngineError> {
        let gone = self.thin(GIVEN_UP, f32::INFINITY)?;
        self.trainer.keep_number();
        tracing::warn!("gave up {gone} Gaussians, {} remain", self.trainer.gaussians());
        Ok(())
    }

    fn gaussians(&self) -> usize {
        if self.has_model() { self.trainer.gaussians() } else { self.cloud.len() }
    }

    fn checkpoint(&mut self, out: &Path, finished: bool) -> Result<(PathBuf, usize), EngineError> {
        let _span = tracing::info_span!("checkpoint").entered();
        let from = Instant::now();
        let in_pieces = self.in_pieces && self.has_model();
        if self.has_model() && !in_pieces && !self.is_average() {
            self.trainer.snapshot(&mut self.cloud)?;
        }
        self.header.finished = finished;
        let views = self.views.iter().enumerate().take(self.built.len());
        self.header.views = views.filter_map(|(i, v)| Some((v.0.clone(), self.pictures.store.view(i)?))).collect();
        self.header.lights = self.lights(self.header.views.len());
        let path = model_path(out);
        let gaussians = match in_pieces {
            true => self.write_pieces(&path)?,
            false => {
                model::write_checkpoint(&self.settings.disk, &path, &self.header, &self.cloud)?;
                self.cloud.len()
            }
        };
        self.report.stage("checkpoint", from);
        if let Some(map) = self.settings.map.filter(|_| self.has_model() && (finished || self.mapped < self.builds)) {
            self.draw_map(map, &out.join("map"));
        }
        Ok((path, gaussians))
    }
}

#[cfg(test)]
mod tests;
