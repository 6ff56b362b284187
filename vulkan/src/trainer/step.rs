//! One training step.

use super::bands::{COUNTS, Counted};
use super::frame::flags_of;
use super::scene::Blocks;
use super::slots::Picture;
use super::{StepReport, TrainError, Trainer};
use crate::commands::Recording;
use crate::constants::{self, TILE_HEIGHT, TILE_WIDTH};
use crate::kernels::{DEPTH_LANES, Kernel};
use crate::layout::{FLAG_DEPTH, FLAG_FREEZE_SHAPE, LossSums, PoseSums, Push};
use rand::Rng;
use std::time::Instant;

/// Rows of a strip in the loss kernels.
const STRIP: usize = constants::STRIP as usize;

impl Trainer {
    /// One gradient step on the next view.
    ///
    /// # Errors
    /// [`TrainError::NoViews`], [`TrainError::Empty`], [`TrainError::Gpu`].
    pub fn step(&mut self) -> Result<StepReport, TrainError> {
        if self.views.is_empty() {
            return Err(TrainError::NoViews);
        }
        if self.gaussians() == 0 {
            return Err(TrainError::Empty { non_finite: 0 });
        }
        let _step = tracing::trace_span!("step", step = self.updates + 1).entered();
        let start = Instant::now();
        self.measure_extent();
        if self.updates == 0 {
            self.open_degrees();
        }
        let progress = self.progress();
        self.validate(progress)?;
        let (picture, part) = if self.scene.is_paged() {
            self.hold_window(progress)?;
            self.choose_part(progress)
        } else {
            (self.choose(progress), Blocks::WHOLE)
        };
        let (divisor, first_pixel, share) = self.prepare_frame(picture, part, progress);
        self.deferred.write(&mut self.frame.deferred);
        self.write_frame();
        self.commands.weigh(super::timed_weight(self.updates, self.timed_every));
        let counted = self.forward_count(picture, first_pixel)?;
        self.read_ahead();
        self.forward_backward()?;
        self.commands.weigh(1.0);
        let adam_step = self.adam_step();
        self.updates += 1;
        self.looked += share;
        self.flushed = false;
        self.deferred.push(adam_step, self.frame.mean_rate, self.settings.rates.decay(progress));
        self.elapsed_s += start.elapsed().as_secs_f64();
        let mut report = self.read_loss(picture, counted, divisor, progress);
        self.arena.failure()?;
        self.control_density(progress)?;
        self.raise_degrees(progress)?;
        if !self.settings.skips.deferred_moments {
            self.flush()?;
        }
        report.gaussians = self.gaussians();
        report.settled = self.flushed;
        Ok(report)
    }

    /// Fills the frame for a part of a picture; returns the resolution divisor, where in the picture it begins, and its share of it.
    pub(super) fn prepare_frame(&mut self, picture: Picture, part: Blocks, progress: f32) -> (u32, u32, f64) {
        let s = &self.settings;
        let resident = &self.views[self.view_of(picture)];
        let (mut view, depth_at) = match picture {
            Picture::View(_) => (resident.view, resident.depth_at),
            Picture::Crop(index) => (self.crops[index].seen_from(&resident.view), 0),
        };
        let source_width = view.intrinsics.width;
        let divisor = s.resolution.divisor_at(progress, source_width, view.intrinsics.height);
        let (width, height) = ((source_width / divisor).max(1), (view.intrinsics.height / divisor).max(1));
        // Whole blocks of pixels: the lens is scaled by the divisor exactly, what does not fill a block is left out.
        let lens = &mut view.intrinsics;
        let d = divisor as f32;
        (lens.width, lens.height) = (width, height);
        (lens.fx, lens.fy, lens.cx, lens.cy) = (lens.fx / d, lens.fy / d, lens.cx / d, lens.cy / d);
        // A pixel weighs the same whether its picture is looked at whole or in parts: Adam's moments know no difference.
        let whole = f64::from(width) * f64::from(height);
        let ((x, width), (y, height)) = (Blocks::pixels(part.x, width), Blocks::pixels(part.y, height));
        let pixels_share = f64::from(width) * f64::from(height) / whole;
        let (share, whole) = (pixels_share as f32, whole as f32);
        (lens.cx, lens.cy, lens.width, lens.height) = (lens.cx - x as f32, lens.cy - y as f32, width, height);
        let (t, sh_weight) = (self.adam_step(), share * self.view_dependence());
        let f = &mut *self.frame;
        f.look(&view);
        let has_depth = depth_at != 0 && s.loss.depth > 0.0;
        let mut flags = flags_of(&s.skips);
        if s.loss.freeze_shape {
            flags |= FLAG_FREEZE_SHAPE;
        }
        if has_depth {
            flags |= FLAG_DEPTH;
        }
        let degree = s.sh.degree_at(progress).min(self.plan.sh_degree);
        (f.gaussians, f.sh_degree, f.flags, f.divisor) = (self.gaussians as u32, degree.into(), flags, divisor);
        let e = &resident.adjust.exposure;
        f.exposure_gain = std::array::from_fn(|i| e[i].exp() as f32);
        f.exposure_offset = std::array::from_fn(|i| e[i + 3] as f32);
        (f.min_confidence, f.depth_weight) = (s.loss.depth_confidence, share * s.loss.depth);
        f.entropy_weight = share * s.loss.entropy;
        f.sh_weight = sh_weight;
        f.background = [0.0; 3];
        if s.regularise.background > 0.0 {
            let rng = self.sampler.rng();
            f.background = std::array::from_fn(|_| rng.random_range(0.0..1.0) * s.regularise.background);
        }
        f.drop_share = s.regularise.drop.max(self.validation.drop()) * progress;
        let r = &s.rates;
        let mean = r.mean(progress, self.extent);
        // The device multiplies every step by the first bias: what decays for all decays there.
        let decay = r.decay(progress);
        (f.mean_rate, f.log_scale_rate, f.rotation_rate) = (mean / decay, r.log_scale, r.rotation);
        (f.opacity_rate, f.sh_dc_rate, f.sh_rest_rate) = (r.opacity, r.sh_dc, r.sh_rest);
        (f.noise, f.max_noise) = (s.regularise.noise * mean, self.extent);
        (f.beta1, f.beta2, f.epsilon) = (s.adam.beta1, s.adam.beta2, s.adam.epsilon);
        f.moment_scale = self.plan.moment_scale();
        let bias = |beta: f32| (1.0 / (1.0 - f64::from(beta).powi(t as i32))) as f32;
        (f.first_bias, f.second_bias) = (decay * bias(s.adam.beta1), bias(s.adam.beta2));
        (f.step, f.seed) = (self.updates + 1, (s.seed ^ (s.seed >> 32)) as u32);
        (f.l1_weight, f.ssim_weight) = (s.loss.l1 / (3.0 * whole), s.loss.ssim / (3.0 * whole));
        (f.source_width, f.depth_offset) = (source_width, depth_at);
        (divisor, (y * source_width + x) * divisor, pixels_share)
    }

    /// Of the present update, as Adam corrects the bias of its moments by it. Gaussians are updated as often in so many steps whether
    /// pictures are looked at whole or in parts.
    fn adam_step(&self) -> u32 {
        self.steps() + 1
    }

    /// First submission: picture, projection, sort, counts.
    pub(super) fn forward_count(&mut self, picture: Picture, first_pixel: u32) -> Result<Counted, TrainError> {
        let _phase = tracing::trace_span!("project, sort, count").entered();
        let slot = self.resident(picture)?;
        let commands = self.take_recording()?;
        let push = Push { first: first_pixel, ..Push::default() };
        commands.run_view(Kernel::Target, slot, self.frame.pixels(), push);
        self.record_counting(&commands);
        commands.submit_and_read(&COUNTS)?;
        self.cut_bands()
    }

    /// Begins the second submission: the picture, band by band.
    pub(super) fn blend(&self) -> Result<Recording<'_>, TrainError> {
        let single = self.bands.len() == 1;
        let mut r = self.take_recording()?;
        for (i, band) in self.bands.iter().enumerate() {
            if i > 0 {
                r.submit()?;
                r = self.take_recording()?;
            }
            self.record_emit(&r, *band, single);
            self.record_blend(&r, *band);
        }
        Ok(r)
    }

    /// The loss of the picture, and its gradient at every pixel.
    pub(super) fn record_loss(&self, r: &Recording<'_>) {
        let (width, height) = (self.frame.size[0] as usize, self.frame.size[1] as usize);
        let (rows, columns) = (width.div_ceil(STRIP) * height, height.div_ceil(STRIP) * width);
        r.run(Kernel::SsimRows, rows, Push::default());
        r.run(Kernel::SsimColumns, columns, Push::default());
        r.run(Kernel::SsimBackRows, rows, Push::default());
        r.run(Kernel::LossGradient, columns, Push::default());
        if self.wants_exposure() {
            r.run(Kernel::ExposureSums, columns, Push::default());
        }
    }

    /// Whether the gradient of the view's exposure is asked for.
    fn wants_exposure(&self) -> bool {
        self.gradients_only || self.settings.refine_exposure
    }

    /// Whether the gradient of the view's pose is asked for.
    fn wants_pose(&self) -> bool {
        self.gradients_only || self.settings.refine_poses
    }

    /// Second submission (one per band where there are several): blend, loss, gradient, Adam.
    pub(super) fn forward_backward(&mut self) -> Result<(), TrainError> {
        let _phase = tracing::trace_span!("blend, loss, gradient, Adam").entered();
        let depth = self.frame.has(FLAG_DEPTH);
        let single = self.bands.len() == 1;
        let backward = if depth { Kernel::RasteriseBackwardDepth } else { Kernel::RasteriseBackward };
        let lanes = self.plan.lanes.loops as usize;
        let visible = self.status().visible as usize;
        let mut r = self.blend()?;
        if depth {
            r.run(Kernel::DepthSums, DEPTH_LANES as usize, Push::default());
            r.run(Kernel::DepthFinish, 1, Push::default());
        }
        self.record_loss(&r);
        if !single {
            // Emitting moved the histogram on; count once more for the second round.
            self.record_tiles(&r);
        }
        for (i, band) in self.bands.iter().enumerate() {
            if i > 0 {
                r.submit()?;
                r = self.take_recording()?;
            }
            if !single {
                self.record_emit(&r, *band, single);
            }
            let push = Push { first: band.first, last: band.last, mode: u32::from(i > 0), pass: 0 };
            r.run(backward, self.frame.places(*band), push);
            r.run(Kernel::Reduce, visible, push);
        }
        let push = Push { mode: u32::from(self.gradients_only), ..Push::default() };
        r.run(Kernel::OptimiseSh, lanes, push);
        r.run(Kernel::ProjectBackward, lanes, push);
        if self.wants_pose() {
            r.run(Kernel::PoseSums, lanes, push);
        }
        r.run(Kernel::Optimise, lanes, push);
        r.submit_and_read(&["status", "tile_starts", "lane_sums", "strip_sums"])?;
        Ok(())
    }

    /// Sums the partial losses in a fixed order, moves pose and exposure, and makes the report.
    fn read_loss(&mut self, picture: Picture, counted: Counted, divisor: u32, progress: f32) -> StepReport {
        let sums = self.partial_sums();
        let Weighed { loss, l1, ssim, correlation } = self.weigh(&sums);
        let tiles = self.frame.tiles() as usize;
        let starts = self.arena.slice::<u32>(self.arena.section("tile_starts"));
        let blended: u64 = starts[tiles + 1..2 * tiles + 1].iter().map(|n| u64::from(*n)).sum();
        let missing = self.missing_coefficients();
        let c = &mut self.counters;
        c.culled += (self.gaussians - counted.visible.min(self.gaussians)) as u64;
        c.instances += counted.instances;
        c.evaluations += blended * u64::from(TILE_WIDTH * TILE_HEIGHT);
        c.behind_opaque += counted.instances.saturating_sub(blended);
        c.banded_steps += u64::from(self.bands.len() > 1);
        c.non_finite_gradients += sums.non_finite;
        c.sh_missing += missing;

        let s = &self.settings;
        let index = self.view_of(picture);
        let view = &mut self.views[index];
        match picture {
            Picture::View(_) => view.last_loss = loss,
            Picture::Crop(crop) => self.crops[crop].last_loss = loss,
        }
        if s.refine_poses {
            view.adjust.move_pose(&mut view.view.pose, sums.pose, &s.rates, self.extent, &s.adam);
        }
        if s.refine_exposure {
            view.adjust.move_exposure(sums.exposure, &s.rates, &s.adam);
        }
        StepReport {
            step: self.looked.ceil() as u32,
            view: index,
            crop: if let Picture::Crop(crop) = picture { Some(crop) } else { None },
            loss,
            l1,
            ssim,
            depth_correlation: correlation,
            gaussians: self.gaussians(),
            visible: counted.visible,
            instances: counted.instances,
            bands: self.bands.len(),
            divisor,
            elapsed_s: self.elapsed_s,
            progress,
            settled: false,
        }
    }

    /// The loss and its terms from the partial sums and the depth's correlation.
    pub(super) fn weigh(&self, sums: &PartialSums) -> Weighed {
        let values = 3.0 * self.frame.pixels() as f64;
        let (l1, ssim) = (sums.l1 / values, sums.ssim / values);
        let s = &self.settings.loss;
        let useful = self.frame.has(FLAG_DEPTH) && self.status().correlates == 1;
        let correlation = useful.then(|| self.status().correlation);
        let depth_loss = correlation.map_or(0.0, |c| f64::from(s.depth) * (1.0 - f64::from(c)));
        let loss = f64::from(s.l1) * l1 + f64::from(s.ssim) * (1.0 - ssim) + depth_loss;
        Weighed { loss: loss as f32, l1: l1 as f32, ssim: ssim as f32, correlation }
    }

    /// The device's partial sums, added in order; those of pose and exposure where they are asked for, else zero.
    pub(super) fn partial_sums(&self) -> PartialSums {
        let mut sums = PartialSums::default();
        let (pose, exposure) = (self.wants_pose(), self.wants_exposure());
        let lanes = self.arena.slice::<PoseSums>(self.arena.section("lane_sums"));
        for p in &lanes[..self.plan.lanes.loops as usize] {
            for i in (0..3).filter(|_| pose) {
                sums.pose[i] += f64::from(p.turn[i]);
                sums.pose[i + 3] += f64::from(p.shift[i]);
            }
            sums.non_finite += u64::from(p.non_finite);
        }
        let [width, height] = self.frame.size.map(|n| n as usize);
        let strips = self.arena.slice::<LossSums>(self.arena.section("strip_sums"));
        for p in &strips[..height.div_ceil(STRIP) * width] {
            for i in (0..3).filter(|_| exposure) {
                sums.exposure[i] += f64::from(p.gain[i]);
                sums.exposure[i + 3] += f64::from(p.offset[i]);
            }
            sums.l1 += f64::from(p.l1);
            sums.ssim += f64::from(p.ssim);
        }
        sums
    }
}

/// The loss and its terms.
#[derive(Clone, Copy, Debug)]
pub(super) struct Weighed {
    pub loss: f32,
    pub l1: f32,
    pub ssim: f32,
    pub correlation: Option<f32>,
}

/// Sums over the whole picture and over all visible Gaussians.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct PartialSums {
    /// Turn and shift of the camera.
    pub pose: [f64; 6],
    /// Gradient of the logarithm of the gain r g b, and of the offset r g b.
    pub exposure: [f64; 6],
    pub l1: f64,
    pub ssim: f64,
    /// Gaussians with a gradient that is not finite.
    pub non_finite: u64,
}
