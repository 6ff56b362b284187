//! One training step.

use super::{PictureStore, StepReport, TrainError, Trainer};
use crate::device::frame::flags_of;
use crate::device::{Counted, Gradients};
use crate::layout::{FLAG_DEPTH, FLAG_FREEZE_SHAPE};
use crate::model::{Blocks, Choice};
use crate::pictures::{Picture, Refinement};
use rand::Rng;
use std::time::Instant;

/// What a step visits.
#[derive(Clone, Copy, Debug)]
pub(super) struct Visit {
    picture: Picture,
    /// The part of it.
    part: Blocks,
    /// Where in the schedule, 0…1.
    progress: f32,
}

impl Visit {
    /// A visit to a whole picture.
    pub fn whole(picture: Picture, progress: f32) -> Self {
        Self { picture, part: Blocks::WHOLE, progress }
    }
}

/// How a picture is visited.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Framed {
    /// It is reduced by this factor.
    pub divisor: u32,
    /// Where the part begins in the picture's pixels.
    pub first_pixel: u32,
    /// Share of the picture's pixels.
    pub share: f64,
}

impl Trainer {
    /// One gradient step on the next view.
    ///
    /// # Errors
    /// [`TrainError::NoViews`], [`TrainError::Empty`], [`TrainError::Gpu`].
    pub fn step(&mut self, pictures: &mut PictureStore) -> Result<StepReport, TrainError> {
        let _step = tracing::trace_span!("step", step = self.model.updates + 1).entered();
        let start = Instant::now();
        let visit = self.next_visit(pictures)?;
        let framed = self.frame(pictures, visit);
        let by = Gradients { pose: self.settings.refine_poses, exposure: self.settings.refine_exposure, keep: false };
        self.model.deferred.write(&mut self.device.frame.deferred);
        self.device.write_frame();
        self.device.time_step(self.model.updates);
        let counted = self.project(pictures, visit.picture, framed)?;
        pictures.read_ahead(self.turns.peek(pictures, &self.settings, self.model.updates + 1, visit.progress));
        self.device.differentiate(by)?;
        self.device.time_all();
        let decay = self.settings.rates.decay(visit.progress);
        self.model.stepped(self.schedule.adam_step(), self.device.frame.mean_rate, decay);
        self.schedule.spend(framed.share, start.elapsed().as_secs_f64());
        let mut report = self.learn(pictures, visit, by, counted);
        self.device.arena.failure()?;
        let Self { device, model, schedule, settings, .. } = self;
        let chance = (self.turns.views.rng(), visit.progress);
        self.density.control(device, model, schedule, settings, chance)?;
        model.raise_degrees(device, visit.progress, settings)?;
        if !settings.skips.deferred_moments {
            model.flush(device)?;
        }
        (report.gaussians, report.settled) = (model.total(), model.flushed);
        Ok(report)
    }

    /// What the next step visits; in a scene of cells, those that it shows are on the device.
    fn next_visit(&mut self, pictures: &mut PictureStore) -> Result<Visit, TrainError> {
        if pictures.is_empty() {
            return Err(TrainError::NoViews);
        }
        if self.gaussians() == 0 {
            return Err(TrainError::Empty { non_finite: 0 });
        }
        self.model.measure_extent(&self.device, || pictures.centers());
        if self.model.updates == 0 {
            self.model.open_degrees(&mut self.device);
        }
        let progress = self.schedule.progress();
        self.validate(pictures, progress)?;
        let Self { device, model, settings, turns, .. } = self;
        if !model.scene.is_paged() {
            return Ok(Visit::whole(turns.next(pictures, settings, model.updates, progress), progress));
        }
        let crops_due = settings.crops.is_due(model.updates, progress);
        let capacity = self.density.window_capacity(device.plan().gaussians, settings, progress);
        let (sampler, updates) = (&mut turns.views, settings.cells.updates);
        model.hold_window(device, Choice { pictures, sampler, capacity, updates, crops_due })?;
        let (picture, part) = model.scene.next_part(crops_due, turns.views.rng());
        Ok(Visit { picture, part, progress })
    }

    /// First submission: the picture, projection, sort, counts.
    pub(super) fn project(
        &mut self,
        pictures: &mut PictureStore,
        picture: Picture,
        framed: Framed,
    ) -> Result<Counted, TrainError> {
        let _phase = tracing::trace_span!("project, sort, count").entered();
        let slot = pictures.resident(&mut self.device, picture)?;
        self.device.project(slot, framed.first_pixel)
    }

    /// Fills the frame for a part of a picture.
    pub(super) fn frame(&mut self, pictures: &PictureStore, visit: Visit) -> Framed {
        let (s, Visit { picture, part, progress }) = (&self.settings, visit);
        let seen = pictures.seen(picture);
        let (mut view, depth_at) = (seen.view, seen.depth_at);
        let source_width = view.intrinsics.width;
        let divisor = s.resolution.divisor_at(progress, source_width, view.intrinsics.height);
        let (width, height) = ((source_width / divisor).max(1), (view.intrinsics.height / divisor).max(1));
        // Whole blocks of pixels: the lens is scaled by the divisor exactly, what does not fill a block is left out.
        let lens = &mut view.intrinsics;
        let d = divisor as f32;
        (lens.width, lens.height) = (width, height);
        (lens.fx, lens.fy, lens.cx, lens.cy) = (lens.fx / d, lens.fy / d, lens.cx / d, lens.cy / d);
        // A pixel weighs the same whether its picture is visited whole or in parts: Adam's moments know no difference.
        let whole = f64::from(width) * f64::from(height);
        let ((x, width), (y, height)) = (Blocks::pixels(part.x, width), Blocks::pixels(part.y, height));
        let pixels_share = f64::from(width) * f64::from(height) / whole;
        let (share, whole) = (pixels_share as f32, whole as f32);
        (lens.cx, lens.cy, lens.width, lens.height) = (lens.cx - x as f32, lens.cy - y as f32, width, height);
        // View dependence costs nothing where views are visited too seldom to be overfitted.
        let dependent = self.schedule.visits_each(pictures.len(), s.loss.view_dependence_visits);
        let (t, extent) = (self.schedule.adam_step(), self.model.extent);
        let plan = self.device.plan();
        let (sh_degree, moment_scale) = (s.sh.degree_at(progress).min(plan.sh_degree), plan.moment_scale());
        let f = &mut *self.device.frame;
        f.look(&view);
        let has_depth = depth_at != 0 && s.loss.depth > 0.0;
        let mut flags = flags_of(&s.skips);
        if s.loss.freeze_shape {
            flags |= FLAG_FREEZE_SHAPE;
        }
        if has_depth {
            flags |= FLAG_DEPTH;
        }
        (f.gaussians, f.sh_degree, f.flags, f.divisor) =
            (self.model.gaussians as u32, sh_degree.into(), flags, divisor);
        let e = &seen.exposure;
        f.exposure_gain = std::array::from_fn(|i| e[i].exp() as f32);
        f.exposure_offset = std::array::from_fn(|i| e[i + 3] as f32);
        (f.min_confidence, f.depth_weight) = (s.loss.depth_confidence, share * s.loss.depth);
        f.entropy_weight = share * s.loss.entropy;
        f.sh_weight = share * if dependent { s.loss.view_dependence } else { 0.0 };
        f.background = [0.0; 3];
        if s.regularise.background > 0.0 {
            let rng = self.turns.views.rng();
            f.background = std::array::from_fn(|_| rng.random_range(0.0..1.0) * s.regularise.background);
        }
        f.drop_share = s.regularise.drop.max(self.validation.drop()) * progress;
        let r = &s.rates;
        let mean = r.mean(progress, extent);
        // The device multiplies every step by the first bias: what decays for all decays there.
        let decay = r.decay(progress);
        (f.mean_rate, f.log_scale_rate, f.rotation_rate) = (mean / decay, r.log_scale, r.rotation);
        (f.opacity_rate, f.sh_dc_rate, f.sh_rest_rate) = (r.opacity, r.sh_dc, r.sh_rest);
        (f.noise, f.max_noise) = (s.regularise.noise * mean, extent);
        (f.beta1, f.beta2, f.epsilon) = (s.adam.beta1, s.adam.beta2, s.adam.epsilon);
        f.moment_scale = moment_scale;
        let bias = |beta: f32| (1.0 / (1.0 - f64::from(beta).powi(t as i32))) as f32;
        (f.first_bias, f.second_bias) = (decay * bias(s.adam.beta1), bias(s.adam.beta2));
        (f.step, f.seed) = (self.model.updates + 1, (s.seed ^ (s.seed >> 32)) as u32);
        (f.l1_weight, f.ssim_weight) = (s.loss.l1 / (3.0 * whole), s.loss.ssim / (3.0 * whole));
        (f.source_width, f.depth_offset) = (source_width, depth_at);
        Framed { divisor, first_pixel: (y * source_width + x) * divisor, share: pixels_share }
    }

    /// Sums the partial losses in a fixed order, moves pose and exposure, and makes the report.
    fn learn(&mut self, pictures: &mut PictureStore, visit: Visit, by: Gradients, counted: Counted) -> StepReport {
        let (s, Visit { picture, progress, .. }) = (&self.settings, visit);
        let sums = self.device.partial_sums(by);
        let weighed = self.device.weigh(&sums, &s.loss);
        let (blended, pixels) = self.device.blended();
        let (bands, divisor) = (self.device.bands.len(), self.device.frame.divisor);
        let missing = self.model.missing_coefficients();
        let on_device = self.model.gaussians;
        let c = &mut self.model.counters;
        c.culled += (on_device - counted.visible.min(on_device)) as u64;
        c.instances += counted.instances;
        c.evaluations += blended * pixels;
        c.behind_opaque += counted.instances.saturating_sub(blended);
        c.banded_steps += u64::from(bands > 1);
        c.non_finite_gradients += sums.non_finite;
        c.sh_missing += missing;
        let refinement = Refinement {
            pose: by.pose.then_some(sums.pose),
            exposure: by.exposure.then_some(sums.exposure),
            rates: &s.rates,
            adam: &s.adam,
            extent: self.model.extent,
        };
        pictures.learn(picture, weighed.loss, refinement);
        StepReport {
            step: self.schedule.visited.ceil() as u32,
            view: pictures.view_of(picture),
            crop: if let Picture::Crop(crop) = picture { Some(crop) } else { None },
            loss: weighed.loss,
            l1: weighed.l1,
            ssim: weighed.ssim,
            depth_correlation: weighed.correlation,
            gaussians: self.model.total(),
            visible: counted.visible,
            instances: counted.instances,
            bands,
            divisor,
            elapsed_s: self.schedule.elapsed_s(),
            progress,
            settled: false,
        }
    }
}

#[cfg(test)]
impl crate::fixture::Fixture {
    /// Puts a part of view 0 on the device as a step at the beginning would visit it; by which factor it is reduced.
    pub(crate) fn project_part(&mut self, part: Blocks) -> u32 {
        let visit = Visit { picture: Picture::View(0), part, progress: 0.0 };
        let framed = self.trainer.frame(&self.pictures, visit);
        self.trainer.device.write_frame();
        self.trainer.project(&mut self.pictures, visit.picture, framed).unwrap();
        framed.divisor
    }
}
