//! The second half of the work: depths of all pictures, checked against each other, become samples, and the samples the
//! budgeted cloud.

use std::time::Instant;

use config::init::InitSettings;
use rayon::prelude::*;

use super::strips::{Strips, at_once};
use super::{Initialiser, VOXELS_PER_GAUSSIAN};
use crate::camera::{DepthPrior, Pinhole};
use crate::cloud::GaussianCloud;
use crate::init::consistency::{ConsistencyCount, resolve};
use crate::init::fill::continued;
use crate::init::lighting::measure;
use crate::init::merge::{Sample, VoxelMerge};
use crate::init::pairs::{SkippedPairs, partners};
use crate::init::report::{Initialisation, MergeReport};
use crate::init::samples::samples;
use crate::init::{InitError, finish};
use crate::light::{Light, PictureLight};

/// Pictures that are checked at once, while as many others are being merged.
pub(super) const AHEAD: usize = 2;
/// Views that a depth is compared with.
pub(super) const WITNESSES: usize = 6;
/// Edge of the finest voxels, in sample spacings.
const VOXEL: f32 = 0.7;
/// A cell's Gaussian reaches this many spreads of its samples: a square's is 0.29 edges, and 0.5 edges close the gaps.
const SPREAD: f32 = 1.7;

impl Initialiser {
    /// Consistency, samples, merge of `pictures`.
    pub(super) fn assemble(
        &mut self,
        pictures: &[usize],
        max_gaussians: usize,
        prior: &mut dyn FnMut(&str, DepthPrior),
    ) -> Result<Initialisation, InitError> {
        let started = Instant::now();
        let (mut spacing, mut looked_at) = (Vec::new(), Vec::new());
        for &i in pictures {
            let frame = &self.frames[i];
            let k = &frame.view.intrinsics;
            if let Some(depth) = self.typical_depth(i) {
                spacing.push((depth as f32 * self.settings.stride as f32 / k.fx.max(k.fy), depth as f32));
                looked_at.push(Pinhole::from(&frame.view).unproject([k.cx, k.cy], depth));
            }
        }
        let center = looked_at.iter().fold(glam::DVec3::ZERO, |sum, p| sum + *p / pictures.len() as f64);
        spacing.sort_by(|a, b| a.0.total_cmp(&b.0));
        let (edge, global_scale) = spacing.get(spacing.len() / 2).copied().unwrap_or((1.0, 1.0));
        let voxels = max_gaussians.saturating_mul(VOXELS_PER_GAUSSIAN);
        let held = at_once(voxels);
        let mut strips = Strips::over(&looked_at, voxels.div_ceil(held));
        let report = &mut self.report;
        report.merge = MergeReport::default();
        let times = &mut report.times;
        (times.consistency_ms, times.samples_ms, times.voxels_ms, times.cloud_ms) = (0.0, 0.0, 0.0, 0.0);
        // Pictures that show each strip: the first pass goes through all of them and finds out.
        let mut showing = vec![Vec::new(); strips.count()];
        showing[0] = pictures.iter().copied().filter(|&i| self.frames[i].has_depth()).collect();
        let mut cloud = GaussianCloud::with_capacity(0, if strips.count() > 1 { max_gaussians } else { 0 });
        for strip in 0..strips.count() {
            let mut merge = VoxelMerge::new(edge * VOXEL, center.as_vec3(), held);
            let frames = std::mem::take(&mut showing[strip]);
            // While this thread sorts the samples of some pictures into voxels, the others check the next pictures.
            let mut waiting: Vec<Checked> = Vec::new();
            for next in frames.chunks(AHEAD).map(Some).chain([None]) {
                let this = &*self;
                let mut checked = Ok(Vec::new());
                let check = || -> Result<Vec<Checked>, InitError> {
                    let checked = next.unwrap_or(&[]).par_iter().map(|&i| this.check(i, global_scale).transpose());
                    checked.flatten_iter().collect()
                };
                let voxels_ms = rayon::in_place_scope(|scope| {
                    scope.spawn(|_| checked = check());
                    let started = Instant::now();
                    for done in &mut waiting {
                        done.samples.iter().for_each(|row| merge.push_all(row, |s| strips.of(s) == strip));
                        if strip == 0 {
                            let found = strips.found(&done.samples);
                            strips.count_in(&found);
                            let others = found.iter().enumerate().skip(1).filter(|(_, samples)| **samples > 0);
                            others.for_each(|(other, _)| showing[other].push(done.index));
                            if let Some(depth) = done.prior.take() {
                                prior(&this.frames[done.index].name, depth);
                            }
                        }
                    }
                    started.elapsed().as_secs_f64() * 1e3
                });
                let report = &mut self.report;
                report.times.voxels_ms += voxels_ms;
                for done in std::mem::replace(&mut waiting, checked?) {
                    report.times.consistency_ms += done.consistency_ms;
                    report.times.samples_ms += done.samples_ms;
                    if strip == 0 {
                        report.merge.samples += done.samples.iter().map(Vec::len).sum::<usize>();
                        report.merge.supported += done.count.supported;
                        report.merge.alone += done.count.alone;
                        report.merge.removed += done.count.removed;
                        report.merge.filled += done.count.filled;
                    }
                }
            }
            let (report, cutting) = (&mut self.report, Instant::now());
            report.merge.voxels += merge.len();
            report.merge.voxel_m = report.merge.voxel_m.max(merge.edge());
            report.merge.dropped_samples += merge.dropped();
            let spread = if self.settings.local_scale { SPREAD } else { 0.0 };
            let merged = merge.finish(strips.share(strip, max_gaussians), spread);
            let (part, abnormal) = finish::cloud(&merged, self.settings.max_scale_ratio);
            report.merge.abnormal += abnormal;
            match strips.count() {
                1 => cloud = part,
                _ => cloud.extend(&part),
            }
            report.times.cloud_ms += cutting.elapsed().as_secs_f64() * 1e3;
        }
        self.report.gaussians = cloud.len();
        self.report.times.merge_ms = started.elapsed().as_secs_f64() * 1e3;
        self.report.planned_bytes = self.planned_bytes(self.frames.len(), max_gaussians);
        Ok(Initialisation { cloud, light: self.light.clone(), report: self.report.clone() })
    }

    /// The pictures that see most of what picture `i` sees.
    pub(super) fn witnesses(&self, i: usize) -> Vec<usize> {
        let depth = self.typical_depth(i).unwrap_or(1.0);
        let wide = InitSettings { covisible: WITNESSES, ..self.settings.clone() };
        let views = self.frames.iter().map(|f| &f.view);
        let others = partners((i, &self.frames[i].view), views, depth, &wide, &mut SkippedPairs::default());
        others.into_iter().take(WITNESSES).map(|o| o.0).collect()
    }

    /// The pictures' light where it is uneven.
    pub(super) fn measure_light(&mut self) -> Result<Option<Light>, InitError> {
        let started = Instant::now();
        let found = measure(&self.frames, |i| self.witnesses(i), self.settings.depth_tolerance)?;
        self.report.light = [found.solved.before, found.solved.after];
        self.report.times.light_ms = started.elapsed().as_secs_f64() * 1e3;
        let [differ, left] = [found.solved.before, found.solved.after].map(|log| 100.0 * log.exp_m1());
        match &found.light {
            None => {
                tracing::info!(
                    "exposure correction is not needed: colours of a place differ by {differ:.1} %, by {left:.1} at best"
                )
            }
            Some(light) => {
                let gains = light.gains.values().flatten().fold([0.0f32; 2], |[a, b], g| [a.min(*g), b.max(*g)]);
                let [low, high, corner] = [gains[0], gains[1], light.corner()].map(|log| 100.0 * log.exp_m1());
                tracing::info!(
                    "exposure correction: pictures {low:+.0} to {high:+.0} %, corners {corner:+.0} %; colours of a place differ by {differ:.1} %, by {left:.1} with that taken out"
                );
            }
        }
        Ok(found.light)
    }

    /// The depths of picture `i` after comparison with the pictures that see the same ground, as samples and as a prior.
    fn check(&self, i: usize, global_scale: f32) -> Result<Option<Checked>, InitError> {
        let started = Instant::now();
        let Some(own) = self.frames[i].depth()? else { return Ok(None) };
        let range = self.known_range(i);
        let mut count = ConsistencyCount::default();
        let mut grid = None;
        if self.settings.consistency {
            let others = self.witnesses(i);
            let fill = range.filter(|_| self.settings.fill).and_then(|range| continued(&own, range));
            if let Some((resolved, found)) =
                resolve(&self.frames, i, &others, self.settings.depth_tolerance, fill.as_deref())?
            {
                (grid, count) = (Some(resolved), found);
            }
        }
        let mut grid = grid.unwrap_or_else(|| own.into_owned());
        // What other pictures know of the ground there does not make the picture's colours its own.
        self.frames[i].leave_out(&mut grid);
        let consistency_ms = started.elapsed().as_secs_f64() * 1e3;
        let appearance = self.appearance.get(i).and_then(Option::as_ref);
        let mut image = self.frames[i].image()?;
        if let Some(light) = &self.light {
            let (own, lens) = (light.of(&self.frames[i].name), &self.frames[i].view.intrinsics);
            own.change(&PictureLight::default(), image.to_mut(), lens);
        }
        let samples = samples(&self.frames[i].view, image.as_ref(), &grid, appearance, &self.settings, global_scale);
        let samples_ms = started.elapsed().as_secs_f64() * 1e3 - consistency_ms;
        let (width, height) = (grid.width as u32, grid.height as u32);
        let prior = Some(DepthPrior { width, height, depth: grid.depth, confidence: grid.confidence });
        Ok(Some(Checked { index: i, samples, prior, count, consistency_ms, samples_ms }))
    }
}

/// A picture whose depths have been compared with the others'.
struct Checked {
    index: usize,
    /// By rows of its grid.
    samples: Vec<Vec<Sample>>,
    /// Until it is given away.
    prior: Option<DepthPrior>,
    count: ConsistencyCount,
    consistency_ms: f64,
    samples_ms: f64,
}
