//! What became of the models and of the seams in all cells together.

use super::cell::Head;
use super::distil::{Effort, Sample, psnr_of};
use super::merge::Kept;
use super::plan::Plan;

/// Pictures for the report, of all cells.
const MOST_SAMPLES: usize = 32;

/// What distillation came to, over all cells.
#[derive(Clone, Debug, Default)]
pub struct Distilled {
    /// Training views of all models, and views between them; one that is looked at for several cells counts for each.
    pub views: usize,
    /// Those that see a seam and took part.
    pub used: usize,
    /// Those of them that were kept back from training.
    pub kept_back: usize,
    /// Cells of ground where regions meet.
    pub cells: usize,
    /// Those that are closer to their teachers now and were taken over.
    pub accepted: usize,
    /// Cells that did not fit into the memory plan and stayed as they were merged.
    pub over_plan: usize,
    /// Share of the Gaussians that lie in a seam.
    pub seam_share: f64,
    /// Steps taken.
    pub steps: u64,
    /// Per model: PSNR of the union against the teacher where the views kept back show seams, before and after; None where none
    /// did.
    pub agreement: Vec<Option<[f64; 2]>>,
    /// Transparent Gaussians removed at the end.
    pub pruned: usize,
    /// Name of the device; empty when none was needed now.
    pub device: String,
    /// Bytes planned and allocated on it at most.
    pub device_bytes: [u64; 2],
    /// Seconds of rendering by the teachers and of training.
    pub seconds: [f64; 2],
    /// Pictures of what was distilled now, for the report.
    pub samples: Vec<Sample>,
}

impl Distilled {
    /// Adds what a job took; `plan_index` are its models'.
    pub fn took(&mut self, effort: Effort, plan_index: &dyn Fn(usize) -> usize) {
        if !effort.device.is_empty() {
            self.device = effort.device;
        }
        for i in 0..2 {
            self.device_bytes[i] = self.device_bytes[i].max(effort.device_bytes[i]);
            self.seconds[i] += effort.seconds[i];
        }
        let samples = effort.samples.into_iter().map(|s| Sample { model: plan_index(s.model), ..s });
        self.samples.extend(samples.take(MOST_SAMPLES - self.samples.len().min(MOST_SAMPLES)));
    }
}

/// What became of each model's Gaussians, and what the seams have learnt, by the cells' own account. `so_far` is what is known of the
/// effort.
pub fn tally(plan: &Plan, heads: &[Head], so_far: Distilled) -> (Vec<Kept>, Distilled) {
    let of =
        |m: &super::plan::Placed| Kept { gaussians: m.strays as usize, stray: m.strays as usize, ..Default::default() };
    let mut kept: Vec<Kept> = plan.models.iter().map(of).collect();
    let mut all = so_far;
    let mut shown = vec![[[0.0; 2]; 2]; plan.models.len()];
    let (mut in_seams, mut rows) = (0.0, 0.0);
    for (cell, head) in plan.cells.iter().zip(heads) {
        let models = plan.inputs(cell).models;
        for (model, of_cell) in models.iter().zip(&head.report.kept) {
            kept[model.index].add(of_cell);
        }
        let learnt = &head.report.learnt;
        for (model, of_cell) in models.iter().zip(&learnt.shown) {
            for (sum, add) in shown[model.index].as_flattened_mut().iter_mut().zip(of_cell.as_flattened()) {
                *sum += add;
            }
        }
        all.views += learnt.views;
        all.used += learnt.used;
        all.kept_back += learnt.kept_back;
        all.cells += learnt.cells;
        all.accepted += learnt.accepted;
        all.over_plan += learnt.over_plan;
        all.pruned += learnt.pruned;
        all.steps += u64::from(learnt.steps);
        in_seams += learnt.seam_share * head.count as f64;
        rows += head.count as f64;
    }
    all.seam_share = if rows > 0.0 { in_seams / rows } else { 0.0 };
    all.agreement = shown.into_iter().map(|[before, after]| Some([psnr_of(before)?, psnr_of(after)?])).collect();
    (kept, all)
}
