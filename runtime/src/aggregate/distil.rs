//! Seams are mended by distillation (the paper's L_distill): every aircraft's own model renders its own training
//! views, and the union is trained on these pictures with L1 and SSIM.
//!
//! A teacher looking through its own training cameras shows very nearly its photographs, neighbouring ground included,
//! so no photograph has to leave the aircraft. Only views that see a seam take part; elsewhere union and teacher are
//! the same Gaussians. The number and the identity of the Gaussians stay as they are but for those that end up transparent.

use std::ops::ControlFlow;
use std::time::Instant;

use config::ground::GroundSettings;
use config::training::{RateSettings, Strategy, TrainSettings};
use image::RgbImage;
use models::camera::{Intrinsics, PoseSigma, PosedImage, View};
use models::cloud::GaussianCloud;
use models::metrics;
use vulkan::trainer::{Rendering, RunBudget, Trainer};

use super::AggregateError;
use super::member::Member;
use super::merge::{Merged, opacity};
use super::seam::Seams;
use crate::engine::device::DeviceRequest;

/// Views of each aircraft kept as pictures for the report, and of all of them.
const SAMPLES_PER_MODEL: usize = 1;
const MOST_SAMPLES: usize = 32;
/// Stages of training, each at `STAGE_FACTOR` times the rates of the one before.
const STAGES: u32 = 3;
const STAGE_FACTOR: f32 = 0.25;
/// Rates of means, scales and rotations beside those of colours and opacities.
const SHAPE_FACTOR: f32 = 0.1;

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

/// What distillation came to.
#[derive(Clone, Debug, Default)]
pub struct Distilled {
    /// Training views of all models, and views between them.
    pub views: usize,
    /// Those that see a seam and took part.
    pub used: usize,
    /// Share of the Gaussians that lie in a seam.
    pub seam_share: f64,
    /// Steps taken.
    pub steps: u32,
    /// Per model: mean PSNR of the union against the teacher over the views that took part, before and after; None
    /// where none did.
    pub agreement: Vec<Option<[f64; 2]>>,
    /// No distilled model was closer to the teachers than the union, which was kept.
    pub reverted: bool,
    /// Transparent Gaussians removed at the end.
    pub pruned: usize,
    /// Gaussians given up to stay within the memory plan.
    pub over_plan: usize,
    /// Name of the device; empty when none was needed.
    pub device: String,
    /// Bytes planned and allocated on it.
    pub device_bytes: [u64; 2],
    /// Seconds of rendering by the teachers and of training.
    pub seconds: [f64; 2],
    /// Pictures for the report.
    pub samples: Vec<Sample>,
}

/// A view that takes part, with the picture its teacher drew.
struct Lesson {
    model: usize,
    name: String,
    view: View,
    share: f64,
    /// 8 bits: what the trainer keeps of a picture anyway.
    target: RgbImage,
}

/// The recipe: the trainer's, without everything that adds, moves or discards Gaussians.
fn recipe(settings: &GroundSettings, sh_degree: u8, steps: u32) -> TrainSettings {
    let mut t = TrainSettings { seed: settings.seed, steps, ..Default::default() };
    t.loss.depth = 0.0;
    t.density.strategy = Strategy::None;
    t.regularise.noise = 0.0;
    t.regularise.opacity_decay = 0.0;
    t.resolution.quarter_until = 0.0;
    t.resolution.half_until = 0.0;
    t.sh.degree = sh_degree;
    t.sh.raise_at = [0.0; 3];
    t
}

/// Distils in place.
///
/// # Errors
/// No device, or a memory plan that does not fit; `merged` is then what it was, within the plan.
pub fn distil(
    members: &[Member],
    merged: &mut Merged,
    settings: &GroundSettings,
    go_on: &dyn Fn() -> bool,
) -> Result<Distilled, AggregateError> {
    let seams = Seams::find(merged, settings.seam_m);
    let (mut lessons, views) = choose(members, &seams, settings);
    let mut report =
        Distilled { views, seam_share: seams.share, agreement: vec![None; members.len()], ..Default::default() };
    if lessons.is_empty() || merged.cloud.is_empty() || settings.epochs == 0 {
        return Ok(report);
    }
    report.used = lessons.len();
    let largest = members.iter().map(|m| m.gaussians).max().unwrap_or(0).max(merged.cloud.len());
    let side = |of: fn(&Intrinsics) -> u32| lessons.iter().map(|l| of(&l.view.intrinsics)).max().unwrap_or(1);
    let request = DeviceRequest {
        device: settings.device.clone(),
        device_mib: settings.device_mib,
        size: (side(|k| k.width), side(|k| k.height)),
        views: lessons.len(),
        crops: 0,
        // Their targets are in the host's memory anyway.
        view_slots: Some(lessons.len() as u32),
        folder: None,
        max_gaussians: Some(largest),
        scene_gaussians: None,
    };
    let steps = settings.epochs.saturating_mul(lessons.len() as u32);
    let mut trainer: Trainer = request.open::<AggregateError>(&recipe(settings, merged.cloud.sh_degree, steps))?;
    report.over_plan = merged.keep_most_important(trainer.plan().gaussians);
    report.device = trainer.gpu().info().name.clone();
    report.device_bytes = [trainer.plan().total_bytes, trainer.device_bytes()];

    let start = Instant::now();
    for (m, member) in members.iter().enumerate() {
        if lessons.iter().any(|l| l.model == m) {
            trainer.load(&member.cloud()?)?;
            for lesson in lessons.iter_mut().filter(|l| l.model == m) {
                lesson.target = render(&mut trainer, &lesson.view)?;
            }
        }
    }
    report.seconds[0] = start.elapsed().as_secs_f64();

    trainer.load(&merged.cloud)?;
    let before = shown(&mut trainer, &lessons)?;
    let start = Instant::now();
    for lesson in &lessons {
        trainer.add_view(&lesson.picture(), None)?;
    }
    let (best, after) = distil_in_stages(&mut trainer, merged, &lessons, &before, settings, &mut report, go_on)?;
    report.seconds[1] = start.elapsed().as_secs_f64();
    report.agreement = agreement(members.len(), &lessons, &before, &after);
    report.reverted = best.is_none();
    if let Some(cloud) = best {
        merged.cloud = cloud;
    }
    let visible: Vec<bool> = merged.cloud.opacity_logits.iter().map(|&l| opacity(l) > settings.prune_opacity).collect();
    report.pruned = merged.retain(|i| visible[i]);
    report.samples = samples(members.len(), &lessons, &before, &after);
    Ok(report)
}

/// Trains in stages of falling rates, each from the best state so far, and returns the state closest to the teachers with
/// its pictures; None when no stage came closer than the union itself.
///
/// Adam starts without a memory of gradients and moves everything by its rate at first. How far that may be depends on how
/// good the models are: coarse ones gain from a rate that would spoil fine ones, so the rate is found by trying.
fn distil_in_stages(
    trainer: &mut Trainer,
    merged: &Merged,
    lessons: &[Lesson],
    before: &[RgbImage],
    settings: &GroundSettings,
    report: &mut Distilled,
    go_on: &dyn Fn() -> bool,
) -> Result<(Option<GaussianCloud>, Vec<RgbImage>), AggregateError> {
    let closeness = |shown: &[RgbImage]| lessons.iter().zip(shown).map(|(l, s)| psnr(&l.target, s)).sum::<f64>();
    let mut best = (closeness(before), None, before.to_vec());
    let steps = (settings.epochs.saturating_mul(lessons.len() as u32)).div_ceil(STAGES);
    let start = Instant::now();
    for stage in 0..STAGES {
        let left = settings.seconds.map(|s| (s - start.elapsed().as_secs_f64()) / f64::from(STAGES - stage));
        if !go_on() || left.is_some_and(|s| s <= 0.0) {
            break;
        }
        trainer.load(best.1.as_ref().unwrap_or(&merged.cloud))?;
        let factor = STAGE_FACTOR.powi(stage as i32) * settings.rate;
        trainer.set_rates(&rates(factor))?;
        let budget = RunBudget { steps: Some(steps), seconds: left };
        let mut each = |_: &_| if go_on() { ControlFlow::Continue(()) } else { ControlFlow::Break(()) };
        report.steps += trainer.run(&budget, &mut each)?.steps;
        let after = shown(trainer, lessons)?;
        let reached = closeness(&after);
        // The trainer leaves out rows it cannot use; then sources and rows would no longer belong together.
        if reached > best.0 && trainer.gaussians() == merged.cloud.len() {
            let mut cloud = best.1.take().unwrap_or_default();
            trainer.snapshot(&mut cloud)?;
            best = (reached, Some(cloud), after);
        }
    }
    Ok((best.1, best.2))
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

/// The views that take part, without their pictures yet, and the number of views there are.
fn choose(members: &[Member], seams: &Seams, settings: &GroundSettings) -> (Vec<Lesson>, usize) {
    let (mut lessons, mut views) = (Vec::new(), 0);
    for (m, model) in members.iter().enumerate() {
        let between = if settings.between_views { between(&model.header.views) } else { Vec::new() };
        for (name, view) in model.header.views.iter().chain(&between) {
            views += 1;
            let share = seams.seen_by(view);
            let sees = share > 0.0 && share >= f64::from(settings.seam_share);
            if sees || settings.all_views {
                let view = View { intrinsics: scaled(&view.intrinsics, settings.scale), pose: view.pose };
                lessons.push(Lesson { model: m, name: name.clone(), view, share, target: RgbImage::new(0, 0) });
            }
        }
    }
    (lessons, views)
}

/// A view half-way from each view to its nearest neighbour, turned like the view itself; each pair once.
fn between(views: &[(String, View)]) -> Vec<(String, View)> {
    let mut made: Vec<(usize, usize)> = Vec::new();
    for (i, (_, view)) in views.iter().enumerate() {
        let apart = |j: &usize| views[*j].1.pose.center.distance(view.pose.center);
        let nearest = (0..views.len()).filter(|&j| j != i).min_by(|a, b| apart(a).total_cmp(&apart(b)));
        if let Some(j) = nearest
            && !made.contains(&(j, i))
        {
            made.push((i, j));
        }
    }
    let half_way = |(i, j): (usize, usize)| {
        let (a, b) = (&views[i], &views[j]);
        let mut view = a.1;
        view.pose.center = 0.5 * (a.1.pose.center + b.1.pose.center);
        (format!("{} – {}", a.0, b.0), view)
    };
    made.into_iter().map(half_way).collect()
}

fn scaled(k: &Intrinsics, scale: f32) -> Intrinsics {
    let side = |n: u32| ((n as f32 * scale).round() as u32).max(1);
    k.resized(side(k.width), side(k.height))
}

impl Lesson {
    fn picture(&self) -> PosedImage {
        PosedImage {
            name: self.name.clone(),
            time_ns: 0,
            image: self.target.clone(),
            view: self.view,
            mask: None,
            sigma: PoseSigma { position_m: [0.0; 3], rotation_rad: [0.0; 3] },
        }
    }
}

fn render(trainer: &mut Trainer, view: &View) -> Result<RgbImage, AggregateError> {
    let mut into = Rendering::default();
    trainer.render(view, &mut into)?;
    // The renderer fills exactly the size it was asked for.
    Ok(metrics::to_rgb8(&into.rgb, into.width, into.height).unwrap_or_default())
}

fn shown(trainer: &mut Trainer, lessons: &[Lesson]) -> Result<Vec<RgbImage>, AggregateError> {
    lessons.iter().map(|l| render(trainer, &l.view)).collect()
}

fn psnr(a: &RgbImage, b: &RgbImage) -> f64 {
    // Equal pictures are as close as 8 bits can tell, not infinitely close.
    metrics::psnr(&metrics::to_f32(a), &metrics::to_f32(b)).min(60.0)
}

fn agreement(models: usize, lessons: &[Lesson], before: &[RgbImage], after: &[RgbImage]) -> Vec<Option<[f64; 2]>> {
    let of = |m: usize| {
        let mine: Vec<usize> = (0..lessons.len()).filter(|&i| lessons[i].model == m).collect();
        let mean = |shown: &[RgbImage]| {
            mine.iter().map(|&i| psnr(&lessons[i].target, &shown[i])).sum::<f64>() / mine.len() as f64
        };
        (!mine.is_empty()).then(|| [mean(before), mean(after)])
    };
    (0..models).map(of).collect()
}

/// The views with the most seam in them, of as many aircraft as the report can show.
fn samples(models: usize, lessons: &[Lesson], before: &[RgbImage], after: &[RgbImage]) -> Vec<Sample> {
    let mut samples = Vec::new();
    for m in 0..models {
        let mut mine: Vec<usize> = (0..lessons.len()).filter(|&i| lessons[i].model == m).collect();
        mine.sort_by(|&a, &b| lessons[b].share.total_cmp(&lessons[a].share));
        samples.extend(mine.iter().take(SAMPLES_PER_MODEL).map(|&i| Sample {
            name: lessons[i].name.clone(),
            model: m,
            teacher: lessons[i].target.clone(),
            merged: before[i].clone(),
            global: after[i].clone(),
            psnr: [psnr(&lessons[i].target, &before[i]), psnr(&lessons[i].target, &after[i])],
        }));
        if samples.len() >= MOST_SAMPLES {
            break;
        }
    }
    samples
}
