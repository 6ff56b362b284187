//! Promises of the mean of the last epochs.

use std::ops::ControlFlow;

use models::cloud::GaussianCloud;
use models::formats::delivery::{Rounding, round_shapes};
use models::formats::model::ModelHeader;
use vulkan::gpu::Gpu;
use vulkan::trainer::{RunBudget, StopReason};

use super::*;
use crate::testing::{picture, settings};
use crate::{EngineSettings, Reconstruct, Reconstruction};

/// An engine that has built its model from three pictures and averages from progress 0.5 on where a schedule has so many visits to each.
fn built(visits: u32) -> Option<Reconstruction> {
    built_with(visits, |_| ())
}

/// An engine as [`built`] makes it, with other settings.
fn built_with(visits: u32, change: impl Fn(&mut EngineSettings)) -> Option<Reconstruction> {
    if Gpu::list().is_err() {
        needs::missing(needs::Need::Vulkan, "no Vulkan device (install mesa-vulkan-drivers)");
        return None;
    }
    let mut settings = settings();
    (settings.training.average.from, settings.training.average.visits) = (0.5, visits);
    (settings.training.density.until, settings.training.thinned_share) = (0.5, 0.0);
    change(&mut settings);
    let mut engine = Reconstruction::open(settings, ModelHeader::default(), "train").expect("opens");
    engine.land();
    (0..3).for_each(|i| engine.add(picture(i), i < 2).expect("taken"));
    assert!(engine.build(&|| false).expect("built"));
    Some(engine)
}

/// Trains up to a step of a schedule of 20; the Gaussians then, and why it ended.
fn train(engine: &mut Reconstruction, until: u32) -> (GaussianCloud, StopReason) {
    let each = &mut |step: &StepReport| {
        if step.step >= until { ControlFlow::Break(()) } else { ControlFlow::Continue(()) }
    };
    let reason = engine.train(&RunBudget { steps: Some(20), seconds: None }, each).expect("trains");
    let mut now = GaussianCloud::default();
    engine.training.trainer.snapshot(&mut now).expect("the device works");
    (now, reason)
}

/// What an engine has at those of its steps.
fn at<const N: usize>(mut engine: Reconstruction, steps: [u32; N]) -> [GaussianCloud; N] {
    steps.map(|step| train(&mut engine, step).0)
}

fn mean(ends: &[GaussianCloud]) -> GaussianCloud {
    let mut mean = ends[0].clone();
    for (n, end) in ends.iter().enumerate().skip(1) {
        let share = 1.0 / (n + 1) as f32;
        let blend = |to: &mut [f32], from: &[f32]| to.iter_mut().zip(from).for_each(|(t, f)| *t += share * (f - *t));
        blend(mean.means.as_flattened_mut(), end.means.as_flattened());
        blend(mean.log_scales.as_flattened_mut(), end.log_scales.as_flattened());
        blend(mean.rotations.as_flattened_mut(), end.rotations.as_flattened());
        blend(&mut mean.opacity_logits, &end.opacity_logits);
        blend(&mut mean.sh, &end.sh);
    }
    mean
}

/// Epochs of three steps that end after progress 0.5 of a schedule of 20.
const ENDS: [u32; 4] = [11, 14, 17, 20];

#[test]
fn a_long_schedule_ends_with_the_mean_of_what_its_epochs_end_with() {
    let Some(ends) = built(1_000).map(|engine| at(engine, ENDS)) else { return };
    let Some(mut engine) = built(6) else { return };
    // A checkpoint in the midst of it holds the mean so far and leaves no trace in what follows.
    assert_eq!(train(&mut engine, 15).1, StopReason::Caller);
    let folder = tempfile::tempdir().expect("a folder");
    let (path, _) = engine.checkpoint(folder.path(), false).expect("written");
    let (_, so_far) = models::formats::model::read(&path).expect("read");
    assert!(so_far == mean(&ends[..2]) && so_far != ends[1]);
    let (got, reason) = train(&mut engine, 21);
    assert!(reason == StopReason::Schedule && got == mean(&ends) && got != ends[3]);
    assert_eq!(engine.report.more.get("averaged_epochs"), Some(&4.into()));
    assert!(!engine.training.is_average() && engine.is_done(&RunBudget { steps: Some(20), seconds: None }));
}

#[test]
fn a_schedule_that_looks_at_each_view_less_often_ends_with_its_last_step() {
    let Some([.., last]) = built(1_000).map(|engine| at(engine, ENDS)) else { return };
    let Some(mut engine) = built(7) else { return };
    for step in [11, 14, 17] {
        train(&mut engine, step);
    }
    let (got, reason) = train(&mut engine, 21);
    assert!(reason == StopReason::Schedule && got == last, "twenty steps are less than seven looks at three views");
    assert_eq!(engine.report.more.get("averaged_epochs"), None);
}

#[test]
fn what_is_rounded_for_delivery_is_the_mean_and_colours_go_on_from_there() {
    let delivers = |settings: &mut EngineSettings| settings.delivers = Some(Rounding::default());
    let never_rounds = |settings: &mut EngineSettings| {
        delivers(settings);
        settings.training.rounded_share = 0.0;
    };
    // It is rounded after step 18, the first of the last 15 %.
    let Some(ends) = built_with(1_000, never_rounds).map(|engine| at(engine, [11, 14, 17, 18])) else { return };
    let Some(mut engine) = built_with(1, delivers) else { return };
    let (got, reason) = train(&mut engine, 21);
    assert!(reason == StopReason::Schedule && engine.delivery.is_rounded() && !engine.training.is_average());
    let rounded = |cloud: &GaussianCloud| round_shapes(cloud, &Rounding::default()).expect("rounded");
    let (expected, last) = (rounded(&mean(&ends)), rounded(&ends[3]));
    let shape = |c: &GaussianCloud| (c.means.clone(), c.log_scales.clone(), c.opacity_logits.clone());
    assert!(shape(&got) == shape(&expected) && shape(&got) != shape(&last));
    assert!(got.sh != expected.sh, "colours are trained on top");
}

#[test]
fn a_schedule_that_ends_early_is_over_at_the_same_step_and_ends_with_the_mean_of_its_epochs() {
    // No epoch is ever better: the first at full size, from step 11 on, is the best, and two more are waited for.
    let stops = |settings: &mut EngineSettings| {
        let stop = &mut settings.training.stop;
        (stop.enabled, stop.patience, stop.least_gain) = (true, 2, 0.999);
    };
    let Some(mut uninterrupted) = built_with(1_000, stops) else { return };
    let Some(mut engine) = built_with(1, stops) else { return };
    for engine in [&mut uninterrupted, &mut engine] {
        let (_, reason) = train(engine, 21);
        assert_eq!((reason, engine.training.trainer.schedule().spent().0), (StopReason::Converged, 19));
    }
    // Steps 11, 14, 17 and the last one.
    assert_eq!(uninterrupted.report.more.get("averaged_epochs"), None);
    assert_eq!(engine.report.more.get("averaged_epochs"), Some(&4.into()));
}

#[test]
fn gaussians_that_are_no_longer_as_many_are_no_part_of_a_mean() {
    let Some(mut engine) = built(1) else { return };
    train(&mut engine, 14);
    assert!(engine.training.is_average());
    engine.shrink().expect("the device works");
    assert!(!engine.training.is_average());
    let (got, reason) = train(&mut engine, 21);
    assert!(reason == StopReason::Schedule && got.len() == engine.gaussians());
    // Steps 17 and 20.
    assert_eq!(engine.report.more.get("averaged_epochs"), Some(&2.into()));
}
