//! The passes of a step in the order of the mathematics: project, sort, count, blend, loss, gradient, Adam.

use super::Device;
use super::bands::{Band, COUNTS, Counted};
use crate::commands::Recording;
use crate::constants::{self, TILE_HEIGHT, TILE_WIDTH};
use crate::error::TrainError;
use crate::kernels::{DEPTH_LANES, Kernel};
use crate::layout::{FLAG_DEPTH, FLAG_ORTHOGRAPHIC, LossSums, PoseSums, Push};
use crate::stages::Stage;
use config::training::LossSettings;

/// Rows of a strip in the loss kernels.
const STRIP: usize = constants::STRIP as usize;

/// What the gradient is taken by besides the Gaussians, and what becomes of it.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(crate) struct Gradients {
    /// The view's pose.
    pub pose: bool,
    /// The view's exposure.
    pub exposure: bool,
    /// Gradients are left where the first moments are, and nothing moves (gradient checks).
    pub keep: bool,
}

/// The loss and its terms.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Weighed {
    pub loss: f32,
    pub l1: f32,
    pub ssim: f32,
    pub correlation: Option<f32>,
}

/// Sums over the whole picture and over all visible Gaussians.
#[derive(Clone, Copy, Debug, Default)]
pub(crate) struct PartialSums {
    /// Turn and shift of the camera.
    pub pose: [f64; 6],
    /// Gradient of the logarithm of the gain r g b, and of the offset r g b.
    pub exposure: [f64; 6],
    pub l1: f64,
    pub ssim: f64,
    /// Gaussians with a gradient that is not finite.
    pub non_finite: u64,
}

impl Device {
    /// Does the lazy Adam updates of all Gaussians of the frame.
    pub(crate) fn catch_up(&mut self) -> Result<(), TrainError> {
        self.write_frame();
        let all = Push { mode: 1, ..Push::default() };
        let recording = self.begin()?;
        recording.run(Kernel::Project, self.frame.gaussians as usize, all);
        recording.run(Kernel::CatchUp, self.plan.lanes.loops as usize, all);
        Ok(recording.submit()?)
    }

    /// First submission: the picture in `slot` from `first_pixel` on, projection, sort, counts.
    pub(crate) fn project(&mut self, slot: usize, first_pixel: u32) -> Result<Counted, TrainError> {
        let r = self.begin()?;
        let push = Push { first: first_pixel, ..Push::default() };
        r.run_view(Kernel::Target, slot, self.frame.pixels(), push);
        self.record_counting(&r);
        r.submit_and_read(&COUNTS)?;
        self.cut_bands()
    }

    /// Second submission (one per band where there are several): blend, loss, gradient, Adam.
    pub(crate) fn differentiate(&mut self, by: Gradients) -> Result<(), TrainError> {
        let _phase = tracing::trace_span!("blend, loss, gradient, Adam").entered();
        let visible = self.status().visible as usize;
        let mut r = self.blend()?;
        self.record_depth(&r);
        self.record_loss(&r, by.exposure);
        let single = self.bands.len() == 1;
        if !single {
            // Emitting moved the histogram on; count once more for the second round.
            self.record_tiles(&r);
        }
        for (i, band) in self.bands.iter().enumerate() {
            if i > 0 {
                r.submit()?;
                r = self.begin()?;
            }
            if !single {
                self.record_emit(&r, *band, single);
            }
            self.record_blend_backward(&r, *band, visible, i > 0);
        }
        self.record_update(&r, by);
        r.submit_and_read(&["status", "tile_starts", "lane_sums", "strip_sums"])?;
        Ok(())
    }

    /// The loss of the picture alone: nothing learns from it.
    pub(crate) fn compare(&mut self, by: Gradients) -> Result<(), TrainError> {
        let r = self.blend()?;
        self.record_loss(&r, by.exposure);
        Ok(r.submit_and_read(&["strip_sums"])?)
    }

    /// The picture that the frame describes, without one to compare it with.
    pub(crate) fn draw(&mut self) -> Result<(), TrainError> {
        let r = self.begin()?;
        self.record_counting(&r);
        r.submit_and_read(&COUNTS)?;
        self.cut_bands()?;
        let single = self.bands.len() == 1;
        for band in &self.bands {
            let r = self.begin()?;
            self.record_emit(&r, *band, single);
            self.record_blend(&r, *band);
            r.submit_and_read(&["image", "transmittance"])?;
        }
        Ok(())
    }

    /// Begins the second submission: the picture, band by band.
    fn blend(&self) -> Result<Recording<'_>, TrainError> {
        let single = self.bands.len() == 1;
        let mut r = self.begin()?;
        for (i, band) in self.bands.iter().enumerate() {
            if i > 0 {
                r.submit()?;
                r = self.begin()?;
            }
            self.record_emit(&r, *band, single);
            self.record_blend(&r, *band);
        }
        Ok(r)
    }

    /// Depth sort, colours, instances per tile; everything up to where the number of instances is needed.
    fn record_counting(&self, recording: &Recording<'_>) {
        let lanes = self.plan.lanes.loops as usize;
        recording.run(Kernel::Project, self.frame.gaussians as usize, Push::default());
        recording.run(Kernel::CatchUp, lanes, Push::default());
        let blocks = self.plan.lanes.sort as usize;
        for pass in 0..4 {
            let push = Push { pass, ..Push::default() };
            let (count, scatter) = if pass % 2 == 0 {
                (Kernel::SortCount, Kernel::SortScatter)
            } else {
                (Kernel::SortCountOther, Kernel::SortScatterBack)
            };
            recording.run(count, blocks, push);
            recording.run(Kernel::SortScan, 256, push);
            recording.run(scatter, blocks, push);
        }
        recording.run(Kernel::Shade, lanes, Push::default());
        self.record_tiles(recording);
    }

    /// Instances per tile and their prefix sums.
    pub(super) fn record_tiles(&self, recording: &Recording<'_>) {
        let tiles = self.frame.tiles();
        let all = Push { first: 0, last: tiles, ..Push::default() };
        let bytes = 4 * u64::from(tiles) * u64::from(self.plan.lanes.sort);
        recording.clear(self.arena.section("tiles"), bytes, Stage::Count);
        recording.run_rounds(Kernel::Count, self.plan.lanes.sort as usize, all, self.walk_rounds);
        recording.run(Kernel::TilePrefix, tiles as usize, all);
        recording.run(Kernel::TileScan, 256, all);
    }

    /// Instance lists of a band. The only band of a frame was counted already.
    fn record_emit(&self, recording: &Recording<'_>, band: Band, single: bool) {
        let push = Push { first: band.first, last: band.last, mode: 1, pass: 0 };
        if !single {
            recording.run_rounds(Kernel::Count, self.plan.lanes.sort as usize, push, self.walk_rounds);
        }
        recording.run_rounds(Kernel::Emit, self.plan.lanes.sort as usize, push, self.walk_rounds);
    }

    fn record_blend(&self, recording: &Recording<'_>, band: Band) {
        let push = Push { first: band.first, last: band.last, ..Push::default() };
        let blend = if self.frame.has(FLAG_ORTHOGRAPHIC) { Kernel::RasteriseMedian } else { Kernel::Rasterise };
        recording.run(blend, self.frame.places(band), push);
    }

    /// The sums by which the blended depth correlates with the prior, where the picture has one.
    fn record_depth(&self, r: &Recording<'_>) {
        if self.frame.has(FLAG_DEPTH) {
            r.run(Kernel::DepthSums, DEPTH_LANES as usize, Push::default());
            r.run(Kernel::DepthFinish, 1, Push::default());
        }
    }

    /// The loss of the picture, and its gradient at every pixel.
    fn record_loss(&self, r: &Recording<'_>, by_exposure: bool) {
        let (width, height) = (self.frame.size[0] as usize, self.frame.size[1] as usize);
        let (rows, columns) = (width.div_ceil(STRIP) * height, height.div_ceil(STRIP) * width);
        r.run(Kernel::SsimRows, rows, Push::default());
        r.run(Kernel::SsimColumns, columns, Push::default());
        r.run(Kernel::SsimBackRows, rows, Push::default());
        r.run(Kernel::LossGradient, columns, Push::default());
        if by_exposure {
            r.run(Kernel::ExposureSums, columns, Push::default());
        }
    }

    /// The blend's gradient in a band, summed per Gaussian.
    fn record_blend_backward(&self, r: &Recording<'_>, band: Band, visible: usize, adds: bool) {
        let depth = self.frame.has(FLAG_DEPTH);
        let backward = if depth { Kernel::RasteriseBackwardDepth } else { Kernel::RasteriseBackward };
        let push = Push { first: band.first, last: band.last, mode: u32::from(adds), pass: 0 };
        r.run(backward, self.frame.places(band), push);
        r.run(Kernel::Reduce, visible, push);
    }

    /// Projection's gradient, and Adam.
    fn record_update(&self, r: &Recording<'_>, by: Gradients) {
        let (lanes, push) = (self.plan.lanes.loops as usize, Push { mode: u32::from(by.keep), ..Push::default() });
        r.run(Kernel::OptimiseSh, lanes, push);
        r.run(Kernel::ProjectBackward, lanes, push);
        if by.pose {
            r.run(Kernel::PoseSums, lanes, push);
        }
        r.run(Kernel::Optimise, lanes, push);
    }

    /// The device's partial sums, added in order; those of pose and exposure where they are asked for, else zero.
    pub(crate) fn partial_sums(&self, by: Gradients) -> PartialSums {
        let mut sums = PartialSums::default();
        let lanes = self.arena.slice::<PoseSums>(self.arena.section("lane_sums"));
        for p in &lanes[..self.plan.lanes.loops as usize] {
            for i in (0..3).filter(|_| by.pose) {
                sums.pose[i] += f64::from(p.turn[i]);
                sums.pose[i + 3] += f64::from(p.shift[i]);
            }
            sums.non_finite += u64::from(p.non_finite);
        }
        let [width, height] = self.frame.size.map(|n| n as usize);
        let strips = self.arena.slice::<LossSums>(self.arena.section("strip_sums"));
        for p in &strips[..height.div_ceil(STRIP) * width] {
            for i in (0..3).filter(|_| by.exposure) {
                sums.exposure[i] += f64::from(p.gain[i]);
                sums.exposure[i + 3] += f64::from(p.offset[i]);
            }
            sums.l1 += f64::from(p.l1);
            sums.ssim += f64::from(p.ssim);
        }
        sums
    }

    /// The loss and its terms from the partial sums and the depth's correlation.
    pub(crate) fn weigh(&self, sums: &PartialSums, s: &LossSettings) -> Weighed {
        let values = 3.0 * self.frame.pixels() as f64;
        let (l1, ssim) = (sums.l1 / values, sums.ssim / values);
        let useful = self.frame.has(FLAG_DEPTH) && self.status().correlates == 1;
        let correlation = useful.then(|| self.status().correlation);
        let depth_loss = correlation.map_or(0.0, |c| f64::from(s.depth) * (1.0 - f64::from(c)));
        let loss = f64::from(s.l1) * l1 + f64::from(s.ssim) * (1.0 - ssim) + depth_loss;
        Weighed { loss: loss as f32, l1: l1 as f32, ssim: ssim as f32, correlation }
    }

    /// Instances that were blended before their tile was opaque, and the pixels of a tile.
    pub(crate) fn blended(&self) -> (u64, u64) {
        let tiles = self.frame.tiles() as usize;
        let starts = self.arena.slice::<u32>(self.arena.section("tile_starts"));
        let instances = starts[tiles + 1..2 * tiles + 1].iter().map(|n| u64::from(*n)).sum();
        (instances, u64::from(TILE_WIDTH * TILE_HEIGHT))
    }
}
