//! The second half of the work: depths of all pictures, checked against each other, become samples, and the samples the
//! budgeted cloud.

use std::time::Instant;

use config::init::InitSettings;

use super::{Initialiser, VOXELS_PER_GAUSSIAN};
use crate::camera::{DepthPrior, View};
use crate::init::consistency::resolve;
use crate::init::fill::continued;
use crate::init::frame::unproject;
use crate::init::merge::VoxelMerge;
use crate::init::pairs::{SkippedPairs, partners};
use crate::init::report::Initialisation;
use crate::init::samples::samples;
use crate::init::{InitError, finish};

/// Views that a depth is compared with.
const WITNESSES: usize = 6;
/// Edge of the finest voxels, in sample spacings.
const VOXEL: f32 = 0.7;
/// A cell's Gaussian reaches this many spreads of its samples: a square's is 0.29 edges, and 0.5 edges close the gaps.
const SPREAD: f32 = 1.7;

impl Initialiser {
    /// Consistency, samples, merge.
    pub(super) fn assemble(&mut self, max_gaussians: usize) -> Result<Initialisation, InitError> {
        let started = Instant::now();
        let views: Vec<View> = self.frames.iter().map(|f| f.view).collect();
        let mut spacing = Vec::new();
        let mut center = glam::DVec3::ZERO;
        for (i, frame) in self.frames.iter().enumerate() {
            let k = &frame.view.intrinsics;
            if let Some(depth) = self.typical_depth(i) {
                spacing.push((depth as f32 * self.settings.stride as f32 / k.fx.max(k.fy), depth as f32));
                center += unproject(&frame.view, k.cx, k.cy, depth as f32).as_dvec3() / self.frames.len() as f64;
            }
        }
        spacing.sort_by(|a, b| a.0.total_cmp(&b.0));
        let (edge, global_scale) = spacing.get(spacing.len() / 2).copied().unwrap_or((1.0, 1.0));
        let capacity = max_gaussians.saturating_mul(VOXELS_PER_GAUSSIAN);
        let mut merge = VoxelMerge::new(edge * VOXEL, center.as_vec3(), capacity);
        let mut depth_priors = Vec::new();
        let report = &mut self.report;
        (report.supported, report.alone, report.removed, report.filled, report.samples) = (0, 0, 0, 0, 0);
        for i in 0..self.frames.len() {
            let Some(own) = &self.frames[i].depth else { continue };
            let resolved = if self.settings.consistency {
                let depth = self
                    .settings
                    .depth_m
                    .or_else(|| self.range.of(&views[i]))
                    .map_or(1.0, |[n, f]| f64::from(2.0 / (1.0 / n + 1.0 / f)));
                let wide = InitSettings { covisible: WITNESSES, ..self.settings.clone() };
                let mut others = partners(i, &views, depth, &wide, &mut SkippedPairs::default());
                others.truncate(WITNESSES);
                let others: Vec<usize> = others.into_iter().map(|o| o.0).collect();
                let fill = match self.settings.depth_m.or_else(|| self.range.of(&views[i])) {
                    Some(range) if self.settings.fill => continued(own, range),
                    _ => None,
                };
                resolve(&self.frames, i, &others, self.settings.depth_tolerance, fill.as_deref()).map(
                    |(grid, count)| {
                        report.filled += count.filled;
                        report.supported += count.supported;
                        report.alone += count.alone;
                        report.removed += count.removed;
                        grid
                    },
                )
            } else {
                None
            };
            let grid = resolved.as_ref().unwrap_or(own);
            for sample in samples(
                &self.frames[i],
                grid,
                self.appearance.get(i).and_then(Option::as_ref),
                &self.settings,
                global_scale,
            ) {
                report.samples += 1;
                merge.push(sample);
            }
            let (width, height) = (grid.width as u32, grid.height as u32);
            let grid = grid.clone();
            depth_priors.push((
                self.frames[i].name.clone(),
                DepthPrior { width, height, depth: grid.depth, confidence: grid.confidence },
            ));
        }
        report.voxels = merge.len();
        report.voxel_m = merge.edge();
        report.dropped_samples = merge.dropped();
        let spread = if self.settings.local_scale { SPREAD } else { 0.0 };
        let merged = merge.finish(max_gaussians, spread);
        let (cloud, abnormal) = finish::cloud(&merged, self.settings.max_scale_ratio);
        report.abnormal = abnormal;
        report.gaussians = cloud.len();
        report.merge_ms = started.elapsed().as_secs_f64() * 1e3;
        report.planned_bytes = 0;
        let planned = self.planned_bytes(self.frames.len(), max_gaussians);
        self.report.planned_bytes = planned;
        Ok(Initialisation { cloud, depth_priors, report: self.report.clone() })
    }
}
