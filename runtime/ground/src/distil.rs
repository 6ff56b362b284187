//! Seams are mended by distillation (the paper's L_distill): every aircraft's own model renders its own training
//! views, and the union is trained on these pictures with L1 and SSIM.
//!
//! A teacher looking through its own training cameras shows very nearly its photographs, neighbouring ground included,
//! so no photograph has to leave the aircraft. Only cells of ground where regions meet are trained, and only pixels that show them
//! are looked at; their surroundings are drawn with them and do not move. Some views are kept back: a cell is taken over only where
//! it comes closer to what its teachers show in those. The number and the identity of the Gaussians stay as they are
//! but for those that end up transparent.

use std::ops::ControlFlow;
use std::time::Instant;

use config::budget::Memory;
use config::training::{RateSettings, Strategy, TrainSettings};
use engine::device::DeviceRequest;
use image::RgbImage;
use models::camera::Intrinsics;
use models::camera::View;
use models::cloud::GaussianCloud;
use serde::{Deserialize, Serialize};
use vulkan::trainer::{PictureStore, Rendering, RunBudget, Trainer};

use super::AggregateError;
use super::block::Block;
use super::merge::{Merged, opacity};
use super::plan::Recipe;
use super::seam::Seams;
use lesson::{Errors, Lesson, choose, draw, psnr};

pub use lesson::psnr_of;

mod lesson;

/// Views of each aircraft kept as pictures for the report.
const SAMPLES_PER_MODEL: usize = 1;
/// And of all aircraft.
pub const MOST_SAMPLES: usize = 32;
/// Rates of means, scales and rotations beside those of colours and opacities (sheffield_cross 25.88 dB with 0.1, 25.93 with 0.3, 25.82
/// with 1).
const SHAPE_FACTOR: f32 = 0.3;
/// Where cells are more than the device holds, so large a share of them is tried next.
const FEWER: f64 = 0.75;

/// One view before and after, for the report.
#[derive(Clone, Debug)]
pub struct Sample {
    /// Picture's name.
    pub name: String,
    /// Index of the model whose view it is.
    pub model: usize,
    /// What the aircraft's own model shows.
    pub teacher: RgbImage,
    /// What the union showed before distillation.
    pub merged: RgbImage,
    /// What the global model shows.
    pub global: RgbImage,
    /// PSNR of `merged` and `global` against `teacher`, dB.
    pub psnr: [f64; 2],
}

/// What the seams of a cell have learnt: the same for the same input.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Learnt {
    /// Training views of all models around, and views between them.
    pub views: usize,
    /// Those that see a seam and took part.
    pub used: usize,
    /// Views that were kept back from training.
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
    pub steps: u32,
    /// Per model: squared differences and number of the values in which the views kept back show seams, of the union against the
    /// teacher before and after.
    pub shown: Vec<[[f64; 2]; 2]>,
    /// Transparent Gaussians removed at the end.
    pub pruned: usize,
}

impl Learnt {
    /// Adds what another cell has learnt, whose models are `models` here. The share of Gaussians in seams is none to be added.
    pub fn add(&mut self, cell: &Self, models: &[usize]) {
        self.views += cell.views;
        self.used += cell.used;
        self.kept_back += cell.kept_back;
        self.cells += cell.cells;
        self.accepted += cell.accepted;
        self.over_plan += cell.over_plan;
        self.pruned += cell.pruned;
        self.steps = self.steps.saturating_add(cell.steps);
        for (of_cell, model) in cell.shown.iter().zip(models) {
            let sums = self.shown[*model].as_flattened_mut();
            sums.iter_mut().zip(of_cell.as_flattened()).for_each(|(sum, add)| *sum += add);
        }
    }
}

/// What it took, and what it looks like.
#[derive(Clone, Debug, Default)]
pub struct Effort {
    /// Name of the device; empty when none was needed.
    pub device: String,
    /// Bytes planned and allocated on it.
    pub device_bytes: [u64; 2],
    /// Seconds of rendering by the teachers and of training.
    pub seconds: [f64; 2],
    /// Pictures for the report.
    pub samples: Vec<Sample>,
}

/// The recipe: the trainer's, without everything that adds, moves or discards Gaussians.
fn training(recipe: &Recipe, sh_degree: u8) -> TrainSettings {
    let mut t = TrainSettings { seed: recipe.seed, ..Default::default() };
    t.rates = rates(recipe.rate);
    (t.loss.depth, t.loss.view_dependence) = (0.0, 0.0);
    t.density.strategy = Strategy::None;
    t.regularise.noise = 0.0;
    t.regularise.opacity_decay = 0.0;
    t.resolution.quarter_until = 0.0;
    t.resolution.half_until = 0.0;
    t.sh.degree = sh_degree;
    t.sh.raise_at = [0.0; 3];
    t
}

/// The trainer's learning rates times `factor`.
fn rates(factor: f32) -> RateSettings {
    let mut r = RateSettings::default();
    // What is to be mended is how clouds meet and what colour they have from the neighbour's cameras, not where the ground is
    // nor how fine: pictures smaller than those the models were trained on would blur it.
    for shape in [&mut r.mean_start, &mut r.log_scale, &mut r.rotation] {
        *shape *= SHAPE_FACTOR;
    }
    for rate in [
        &mut r.mean_start,
        &mut r.mean_end,
        &mut r.log_scale,
        &mut r.rotation,
        &mut r.opacity,
        &mut r.sh_dc,
        &mut r.sh_rest,
    ] {
        *rate *= factor;
    }
    r
}

/// Distils the seams of a square in place; None: asked to stop.
///
/// # Errors
/// No device, or a memory plan that does not fit; `merged` is then what it was.
pub fn distil(
    block: &Block<'_>,
    merged: &mut Merged,
    device: Option<&str>,
    cancelled: &dyn Fn() -> bool,
) -> Result<Option<(Learnt, Effort)>, AggregateError> {
    let (inputs, recipe) = (block.inputs, &block.inputs.recipe);
    let models = inputs.models.len();
    let views = (0..models).map(|m| Ok(block.head(m)?.views));
    let views: Vec<Vec<(String, View)>> = views.collect::<Result<_, AggregateError>>()?;
    let mut seams = Seams::find(merged, inputs.squares.seam_m, &|c| inputs.squares.key_of(c) == inputs.key);
    let (mut lessons, views) = choose(&views, &seams, recipe);
    let mut report = Learnt {
        views,
        used: lessons.len(),
        cells: seams.cells.len(),
        seam_share: seams.share,
        shown: vec![[[0.0; 2]; 2]; models],
        ..Default::default()
    };
    let mut effort = Effort::default();
    if lessons.is_empty() || recipe.epochs == 0 {
        report.used = 0;
        return Ok(Some((report, effort)));
    }
    let mut rows = seams.with_halo(merged);
    let (mut trainer, mut pictures) = open(block, &lessons, rows.len(), merged.cloud.sh_degree, device)?;
    while rows.len() > trainer.plan().gaussians && !seams.cells.is_empty() {
        seams.keep((seams.cells.len() as f64 * FEWER) as usize);
        rows = seams.with_halo(merged);
    }
    report.over_plan = report.cells - seams.cells.len();
    effort.device = trainer.device().gpu().info().name.clone();
    effort.device_bytes = [trainer.plan().total_bytes, trainer.device().bytes()];

    let start = Instant::now();
    for m in 0..models {
        if lessons.iter().any(|l| l.model == m) {
            trainer.load(&block.cloud(m)?)?;
            for lesson in lessons.iter_mut().filter(|l| l.model == m) {
                lesson.ask(&mut trainer, &seams)?;
            }
        }
    }
    lessons.retain(Lesson::is_worth_it);
    report.used = lessons.len();
    effort.seconds[0] = start.elapsed().as_secs_f64();
    let (kept_back, taught): (Vec<Lesson>, Vec<Lesson>) = lessons.into_iter().partition(|l| l.is_kept_back);
    report.kept_back = kept_back.len();
    let part = merged.cloud.rows(&rows);
    // Rows that the trainer leaves out would no longer be those of the union.
    let is_whole = (0..part.len()).all(|i| part.is_valid(i));
    if taught.is_empty() || kept_back.is_empty() || !is_whole || part.is_empty() {
        return Ok(Some((report, effort)));
    }

    let start = Instant::now();
    trainer.load(&part)?;
    let before = Shown::of(&mut trainer, &kept_back, models, seams.cells.len())?;
    for lesson in &taught {
        pictures.add(trainer.device_mut(), &lesson.picture(), None)?;
    }
    let of_row: Vec<Option<u16>> = part.means.iter().map(|mean| seams.index_of(mean)).collect();
    // The union has them still, and this is where the ground holds most at once.
    drop(part);
    trainer.hold(|row| of_row[row].is_none());
    let steps = recipe.epochs.saturating_mul(taught.len() as u32);
    let budget = RunBudget { steps: Some(steps), seconds: recipe.seconds };
    let mut each = |_: &_| if cancelled() { ControlFlow::Break(()) } else { ControlFlow::Continue(()) };
    report.steps = trainer.run(&mut pictures, &budget, &mut each)?.steps;
    if cancelled() {
        return Ok(None);
    }
    let mut trained = GaussianCloud::default();
    trainer.snapshot(&mut trained)?;
    let learnt = Shown::of(&mut trainer, &kept_back, models, seams.cells.len())?;
    let accepted = closer(&before.errors(), &learnt.errors());

    // A cell beside one that was not taken over is another surrounding than it was trained in: what is taken over is asked again.
    let takes = |row: usize| of_row[row].is_some_and(|cell| accepted[usize::from(cell)]);
    let mut mixed = trained;
    take_back(&mut mixed, &rows, &merged.cloud, |row| !takes(row));
    trainer.load(&mixed)?;
    let after = Shown::of(&mut trainer, &kept_back, models, seams.cells.len())?;
    let psnr = |shown: &Shown| psnr_of(shown.errors().sum());
    let holds = psnr(&after) > psnr(&before);
    effort.seconds[1] = start.elapsed().as_secs_f64();
    let after = if holds { &after } else { &before };
    report.shown = (0..models).map(|m| [before.of_model[m].sum(), after.of_model[m].sum()]).collect();
    effort.samples = samples(models, &kept_back, &before, after);
    if holds {
        report.accepted = accepted.iter().filter(|a| **a).count();
        let mut visible = vec![true; merged.cloud.len()];
        for (i, row) in rows.iter().enumerate().filter(|(i, _)| takes(*i)) {
            merged.cloud.set_row(*row as usize, &mixed, i);
            visible[*row as usize] = opacity(mixed.opacity_logits[i]) > recipe.prune_opacity;
        }
        report.pruned = merged.retain(|i| visible[i]);
    }
    Ok(Some((report, effort)))
}

/// The trainer: room for the largest model and for what is trained, and for the lessons.
fn open(
    block: &Block<'_>,
    lessons: &[Lesson],
    rows: usize,
    sh_degree: u8,
    device: Option<&str>,
) -> Result<(Trainer, PictureStore), AggregateError> {
    let recipe = &block.inputs.recipe;
    let largest = (0..block.inputs.models.len()).map(|m| block.rows(m)).max().unwrap_or(0).max(rows);
    let side = |of: fn(&Intrinsics) -> u32| lessons.iter().map(|l| of(&l.view.intrinsics)).max().unwrap_or(1);
    let request = DeviceRequest {
        device: device.map(str::to_owned),
        // Their targets are in the host's memory anyway.
        memory: Memory { view_slots: Some(lessons.len() as u32), ..Memory::for_gaussians(recipe.device_mib, largest) },
        size: (side(|k| k.width), side(|k| k.height)),
        views: lessons.len(),
        crops: 0,
        folder: None,
    };
    request.open::<AggregateError>(&training(recipe, sh_degree))
}

/// What the views kept back show.
struct Shown {
    pictures: Vec<RgbImage>,
    /// How far that is from what the teachers show.
    of_model: Vec<Errors>,
}

impl Shown {
    fn of(trainer: &mut Trainer, lessons: &[Lesson], models: usize, cells: usize) -> Result<Self, AggregateError> {
        let mut this =
            Self { pictures: Vec::with_capacity(lessons.len()), of_model: vec![Errors::none(cells); models] };
        let mut drawn = Rendering::default();
        for lesson in lessons {
            let picture = draw(trainer, &lesson.view, &mut drawn)?;
            lesson.errors(&picture, &mut this.of_model[lesson.model]);
            this.pictures.push(picture);
        }
        Ok(this)
    }

    /// Of all teachers together.
    fn errors(&self) -> Errors {
        let mut sum = Errors::none(self.of_model.first().map_or(0, |e| e.0.len()));
        for of_model in &self.of_model {
            sum.0.iter_mut().zip(&of_model.0).for_each(|(s, e)| *s = [s[0] + e[0], s[1] + e[1]]);
        }
        sum
    }
}

/// Per cell: whether it came closer to its teachers.
fn closer(before: &Errors, after: &Errors) -> Vec<bool> {
    before.0.iter().zip(&after.0).map(|(b, a)| a[0] < b[0]).collect()
}

/// Makes those rows of `trained`, the `rows` of `untouched`, for which `returns` says so what they were.
fn take_back(trained: &mut GaussianCloud, rows: &[u32], untouched: &GaussianCloud, returns: impl Fn(usize) -> bool) {
    for (i, row) in rows.iter().enumerate().filter(|(i, _)| returns(*i)) {
        trained.set_row(i, untouched, *row as usize);
    }
}

/// The views with the most seam in them, of as many aircraft as the report can show.
fn samples(models: usize, lessons: &[Lesson], before: &Shown, after: &Shown) -> Vec<Sample> {
    let mut samples = Vec::new();
    for m in 0..models {
        let mut mine: Vec<usize> = (0..lessons.len()).filter(|&i| lessons[i].model == m).collect();
        mine.sort_by(|&a, &b| lessons[b].share.total_cmp(&lessons[a].share));
        samples.extend(mine.iter().take(SAMPLES_PER_MODEL).map(|&i| {
            let [merged, global] = [before, after].map(|shown| shown.pictures[i].clone());
            let teacher = lessons[i].target.clone();
            let psnr = [&merged, &global].map(|shown| psnr(&teacher, shown));
            Sample { name: lessons[i].name.clone(), model: m, teacher, merged, global, psnr }
        }));
        if samples.len() >= MOST_SAMPLES {
            break;
        }
    }
    samples
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::carpet;

    #[test]
    fn only_cells_that_came_closer_are_taken_over() {
        let before = Errors(vec![[300.0, 3.0], [300.0, 3.0], [300.0, 3.0], [0.0, 0.0]]);
        let after = Errors(vec![[299.0, 3.0], [301.0, 3.0], [300.0, 3.0], [0.0, 0.0]]);
        let accepted = closer(&before, &after);
        assert_eq!(accepted, [true, false, false, false], "worse, equal and unseen ones are not");
        let untouched = carpet([0.0, 0.0], [4.0, 1.0], 1.0);
        let rows = [3, 1, 0, 2];
        let mut taken = untouched.rows(&rows);
        for (logit, mean) in taken.opacity_logits.iter_mut().zip(&mut taken.means) {
            (*logit, mean[2]) = (*logit + 1.0, 9.0);
        }
        take_back(&mut taken, &rows, &untouched, |row| !accepted[row]);
        assert_eq!(taken.opacity_logits, [4.0, 3.0, 3.0, 3.0]);
        assert_eq!(taken.means[1..], untouched.rows(&rows).means[1..]);
        assert!(taken.means[0] != untouched.means[3] && taken.means[0][..2] == untouched.means[3][..2]);
    }

    #[test]
    fn what_seams_are_off_is_measured_where_they_are() {
        let errors = Errors(vec![[3.0 * 255.0 * 255.0, 300.0], [0.0, 600.0], [1.0, 0.0]]);
        let of = |c: usize| psnr_of(Errors(vec![errors.0[c]]).sum());
        assert!(of(0).is_some_and(|db| (db - 20.0).abs() < 1e-9));
        assert_eq!(of(1), Some(60.0));
        assert_eq!(of(2), None);
        assert!(psnr_of(errors.sum()).is_some_and(|db| db > 20.0 && db < 60.0));
    }
}
