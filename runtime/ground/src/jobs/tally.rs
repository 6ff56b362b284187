//! What became of the models and of the seams in all cells together.

use super::cell::Head;
use crate::distil::{Effort, Learnt, MOST_SAMPLES, Sample, psnr_of};
use crate::merge::Kept;
use crate::plan::Plan;

/// What distillation came to, over all cells.
#[derive(Clone, Debug, Default)]
pub struct Distilled {
    /// Of all cells, per model of the plan; a view that is looked at for several cells counts for each.
    pub learnt: Learnt,
    /// Per model: PSNR of the union against the teacher where the views kept back show seams, before and after; None where none
    /// did.
    pub agreement: Vec<Option<[f64; 2]>>,
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
        |m: &crate::plan::Placed| Kept { gaussians: m.strays as usize, stray: m.strays as usize, ..Default::default() };
    let mut kept: Vec<Kept> = plan.models.iter().map(of).collect();
    let mut all = Learnt { shown: vec![[[0.0; 2]; 2]; plan.models.len()], ..Default::default() };
    let (mut in_seams, mut rows) = (0.0, 0.0);
    for (cell, head) in plan.cells.iter().zip(heads) {
        let models = plan.inputs(cell).models;
        for (model, of_cell) in models.iter().zip(&head.report.kept) {
            kept[model.index].add(of_cell);
        }
        let learnt = &head.report.learnt;
        let of_models: Vec<usize> = models.iter().map(|m| m.index).collect();
        all.add(learnt, &of_models);
        in_seams += learnt.seam_share * head.count as f64;
        rows += head.count as f64;
    }
    all.seam_share = if rows > 0.0 { in_seams / rows } else { 0.0 };
    let agreement = all.shown.iter().map(|[before, after]| Some([psnr_of(*before)?, psnr_of(*after)?])).collect();
    (kept, Distilled { learnt: all, agreement, ..so_far })
}
