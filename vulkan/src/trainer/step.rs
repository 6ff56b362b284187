//! One training step.

use super::bands::Counted;
use super::frame::{FLAG_DEPTH, FLAG_FREEZE_SHAPE, flags_of};
use super::{StepReport, TrainError, Trainer};
use crate::commands::Push;
use crate::constants::{TILE_HEIGHT, TILE_WIDTH};
use crate::kernels::Kernel;
use config::plan::LOOP_LANES;
use rand::Rng;
use std::time::Instant;

/// Rows of a strip in the loss kernels (`shaders/window.glsl`).
const STRIP: usize = 8;
/// Where `depth_finish` leaves the correlation, in 32-bit words.
const STATUS_CORRELATION: usize = 515;

impl Trainer {
    /// One gradient step on the next view.
    ///
    /// # Errors
    /// [`TrainError::NoViews`], [`TrainError::Empty`], [`TrainError::Gpu`].
    pub fn step(&mut self) -> Result<StepReport, TrainError> {
        if self.views.is_empty() {
            return Err(TrainError::NoViews);
        }
        if self.gaussians == 0 {
            return Err(TrainError::Empty { unsound: 0 });
        }
        let start = Instant::now();
        self.measure_extent();
        if self.steps == 0 {
            self.open_degrees();
        }
        let progress = self.progress();
        let views = &self.views;
        let index = self.sampler.next(views.len(), self.settings.views.residual_share, |v| views[v].last_loss);
        let divisor = self.prepare_frame(index, progress);
        self.deferred.write(&mut self.frame.deferred);
        self.write_frame();
        let counted = self.forward_count(index)?;
        self.forward_backward()?;
        self.steps += 1;
        self.flushed = false;
        self.deferred.push(self.steps, self.frame.rates[0], self.settings.rates.decay(progress));
        self.elapsed_s += start.elapsed().as_secs_f64();
        let mut report = self.read_loss(index, counted, divisor, progress);
        self.control_density(progress)?;
        self.raise_degrees(progress)?;
        if !self.settings.skips.deferred_moments {
            self.flush()?;
        }
        report.gaussians = self.gaussians;
        report.settled = self.flushed;
        Ok(report)
    }

    /// Fills the frame for view `index`; returns the resolution divisor.
    pub(super) fn prepare_frame(&mut self, index: usize, progress: f32) -> u32 {
        let s = &self.settings;
        let resident = &self.views[index];
        let divisor = s.resolution.divisor_at(progress, resident.width, resident.height);
        let (width, height) = ((resident.width / divisor).max(1), (resident.height / divisor).max(1));
        let mut view = resident.view;
        // Whole blocks of pixels: the lens is scaled by the divisor exactly, what does not fill a block is left out.
        let lens = &mut view.intrinsics;
        let d = divisor as f32;
        (lens.width, lens.height) = (width, height);
        (lens.fx, lens.fy, lens.cx, lens.cy) = (lens.fx / d, lens.fy / d, lens.cx / d, lens.cy / d);
        let f = &mut *self.frame;
        f.look(&view);
        let pixels = (width * height) as f32;
        let has_depth = resident.depth_at != 0 && s.loss.depth > 0.0;
        let mut flags = flags_of(&s.skips);
        if s.loss.freeze_shape {
            flags |= FLAG_FREEZE_SHAPE;
        }
        if has_depth {
            flags |= FLAG_DEPTH;
        }
        let degree = s.sh.degree_at(progress).min(self.plan.sh_degree);
        f.counts = [self.gaussians as u32, degree.into(), flags, divisor];
        let e = &resident.adjust.exposure;
        let gain = |i: usize| e[i].exp() as f32;
        f.exposure_gain = [gain(0), gain(1), gain(2), s.loss.depth_confidence];
        f.exposure_offset = [e[3] as f32, e[4] as f32, e[5] as f32, s.loss.depth];
        let mut background = [0.0f32; 3];
        if s.regularise.background > 0.0 {
            let rng = self.sampler.rng();
            background = std::array::from_fn(|_| rng.random_range(0.0..1.0) * s.regularise.background);
        }
        let drop = s.regularise.drop * progress;
        f.background = [background[0], background[1], background[2], drop];
        let r = &s.rates;
        let mean = r.mean(progress, self.extent);
        // The device multiplies every step by the first bias: what decays for all decays there.
        let decay = r.decay(progress);
        f.rates = [mean / decay, r.log_scale, r.rotation, r.opacity];
        f.rates_more = [r.sh_dc, r.sh_rest, s.regularise.noise * mean, self.extent];
        let t = self.steps + 1;
        f.adam = [s.adam.beta1, s.adam.beta2, s.adam.epsilon, self.plan.moment_scale()];
        let bias = |beta: f32| (1.0 / (1.0 - f64::from(beta).powi(t as i32))) as f32;
        f.bias = [decay * bias(s.adam.beta1), bias(s.adam.beta2), 0.0, 0.0];
        let seed = (s.seed ^ (s.seed >> 32)) as u32;
        f.step = [t, seed, 2 * LOOP_LANES as u32, 0];
        f.loss = [s.loss.l1 / (3.0 * pixels), s.loss.ssim / (3.0 * pixels), 0.0, 0.0];
        f.source = [resident.width, resident.height, resident.depth_at, 0];
        divisor
    }

    /// First submission: picture, projection, sort, counts.
    pub(super) fn forward_count(&mut self, index: usize) -> Result<Counted, TrainError> {
        let pixels = self.frame.size[0] as usize * self.frame.size[1] as usize;
        let commands = self.take_recording()?;
        commands.run_view(Kernel::Target, index, pixels);
        self.record_counting(&commands);
        commands.submit()?;
        self.cut_bands()
    }

    /// Second submission (one per band where there are several): blend, loss, gradient, Adam.
    pub(super) fn forward_backward(&mut self) -> Result<(), TrainError> {
        let depth = self.frame.counts[2] & FLAG_DEPTH != 0;
        let single = self.bands.len() == 1;
        let backward = if depth { Kernel::RasteriseBackwardDepth } else { Kernel::RasteriseBackward };
        let lanes = LOOP_LANES as usize;
        let visible = self.arena.slice::<u32>(self.arena.section("status"))[0] as usize;
        let mut r = self.take_recording()?;
        for (i, band) in self.bands.iter().enumerate() {
            if i > 0 {
                r.submit()?;
                r = self.take_recording()?;
            }
            self.record_emit(&r, *band, single);
            self.record_blend(&r, *band);
        }
        let (width, height) = (self.frame.size[0] as usize, self.frame.size[1] as usize);
        let (rows, columns) = (width.div_ceil(STRIP) * height, height.div_ceil(STRIP) * width);
        if depth {
            r.run(Kernel::DepthSums, lanes, Push::default());
            r.run(Kernel::DepthFinish, 1, Push::default());
        }
        r.run(Kernel::SsimRows, rows, Push::default());
        r.run(Kernel::SsimColumns, columns, Push::default());
        r.run(Kernel::SsimBackRows, rows, Push::default());
        r.run(Kernel::LossGradient, columns, Push::default());
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
            r.run(backward, (band.last - band.first) as usize, push);
            r.run(Kernel::Reduce, visible, push);
        }
        r.run(Kernel::Optimise, lanes, Push { mode: u32::from(self.gradients_only), ..Push::default() });
        r.submit()?;
        Ok(())
    }

    /// Sums the partial losses in a fixed order, moves pose and exposure, and makes the report.
    fn read_loss(&mut self, index: usize, counted: Counted, divisor: u32, progress: f32) -> StepReport {
        let sums = self.partial_sums();
        let Weighed { loss, l1, ssim, correlation } = self.weigh(&sums);
        let tiles = self.frame.tiles() as usize;
        let starts = self.arena.slice::<u32>(self.arena.section("tile_starts"));
        let blended: u64 = starts[tiles + 1..2 * tiles + 1].iter().map(|n| u64::from(*n)).sum();
        let missing = self.missing_coefficients();
        let c = &mut self.totals.counters;
        c.culled += (self.gaussians - counted.visible.min(self.gaussians)) as u64;
        c.instances += counted.instances;
        c.evaluations += blended * u64::from(TILE_WIDTH * TILE_HEIGHT);
        c.behind_opaque += counted.instances.saturating_sub(blended);
        c.banded_steps += u64::from(self.bands.len() > 1);
        c.unsound_gradients += sums.unsound;
        c.sh_missing += missing;

        let s = &self.settings;
        let view = &mut self.views[index];
        view.last_loss = loss;
        if s.refine_poses {
            view.adjust.move_pose(&mut view.view.pose, sums.pose, &s.rates, self.extent, &s.adam);
        }
        if s.refine_exposure {
            let g = &sums.loss;
            view.adjust.move_exposure([g[1], g[2], g[3], g[4], g[5], g[6]], &s.rates, &s.adam);
        }
        StepReport {
            step: self.steps,
            view: index,
            loss,
            l1,
            ssim,
            depth_correlation: correlation,
            gaussians: self.gaussians,
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
        let values = 3.0 * f64::from(self.frame.size[0]) * f64::from(self.frame.size[1]);
        let (l1, ssim) = (sums.loss[0] / values, sums.loss[7] / values);
        let s = &self.settings.loss;
        let depth = self.frame.counts[2] & FLAG_DEPTH != 0;
        let status = self.arena.slice::<u32>(self.arena.section("status"));
        let useful = depth && status[STATUS_CORRELATION + 1] == 1;
        let correlation = useful.then(|| f32::from_bits(status[STATUS_CORRELATION]));
        let depth_loss = correlation.map_or(0.0, |c| f64::from(s.depth) * (1.0 - f64::from(c)));
        let loss = f64::from(s.l1) * l1 + f64::from(s.ssim) * (1.0 - ssim) + depth_loss;
        Weighed { loss: loss as f32, l1: l1 as f32, ssim: ssim as f32, correlation }
    }

    /// The device's partial sums, added in order.
    pub(super) fn partial_sums(&self) -> PartialSums {
        let partials = self.arena.slice::<[f32; 4]>(self.arena.section("partials"));
        let lanes = LOOP_LANES as usize;
        let mut sums = PartialSums::default();
        for p in partials[..2 * lanes].chunks_exact(2) {
            for i in 0..3 {
                sums.pose[i] += f64::from(p[0][i]);
                sums.pose[i + 3] += f64::from(p[1][i]);
            }
            sums.unsound += p[0][3] as u64;
        }
        let (width, height) = (self.frame.size[0] as usize, self.frame.size[1] as usize);
        let strips = height.div_ceil(STRIP) * width;
        for p in partials[2 * lanes..2 * (lanes + strips)].chunks_exact(2) {
            for i in 0..4 {
                sums.loss[i] += f64::from(p[0][i]);
                sums.loss[i + 4] += f64::from(p[1][i]);
            }
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
    /// L1, gradient of log gain r g b, gradient of offset r g b, SSIM.
    pub loss: [f64; 8],
    /// Gaussians with a gradient that is not finite.
    pub unsound: u64,
}
