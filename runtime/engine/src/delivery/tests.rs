//! Promises of what a model goes through before it is delivered.

use std::ops::ControlFlow;

use models::cloud::GaussianCloud;
use models::formats::delivery::{self, Rounding};
use models::formats::model::ModelHeader;
use vulkan::gpu::Gpu;
use vulkan::trainer::{RunBudget, StepReport, StopReason};

use super::*;
use crate::testing::{picture, settings};
use crate::{EngineSettings, Reconstruct, Reconstruction};

/// An engine that has built its model from three pictures.
fn built(delivers: bool) -> Option<Reconstruction> {
    built_as(delivers.then(Rounding::default), false)
}

fn settings_for(delivers: Option<Rounding>, incremental: bool) -> EngineSettings {
    EngineSettings { delivers, incremental, ..settings() }
}

/// A reconstruction; with `incremental`, as a flight does it after its landing.
fn built_as(delivers: Option<Rounding>, incremental: bool) -> Option<Reconstruction> {
    if Gpu::list().is_err() {
        needs::missing(needs::Need::Vulkan, "no Vulkan device (install mesa-vulkan-drivers)");
        return None;
    }
    let mut engine =
        Reconstruction::open(settings_for(delivers, incremental), ModelHeader::default(), "train").expect("opens");
    engine.land();
    (0..3).for_each(|i| engine.add(picture(i), i < 2).expect("taken"));
    assert!(engine.build(&|| false).expect("built"));
    Some(engine)
}

/// Trains for so many steps of a schedule of 20; why it ended.
fn train(engine: &mut Reconstruction, steps: u32) -> StopReason {
    let mut left = steps;
    let each = &mut |_: &StepReport| {
        left -= 1;
        if left == 0 { ControlFlow::Break(()) } else { ControlFlow::Continue(()) }
    };
    engine.train(&RunBudget { steps: Some(20), seconds: None }, each).expect("trains")
}

fn sensitivities(engine: &mut Reconstruction) -> Vec<u32> {
    let mut all = Vec::new();
    engine.training.trainer.each(&BoundingBox::ALL, |g| all.push(g.sensitivity)).expect("the device works");
    all.sort_by(f32::total_cmp);
    all.into_iter().map(f32::to_bits).collect()
}

#[test]
fn those_leave_that_the_loss_hangs_on_least_and_the_others_stay_as_they_are() {
    let Some(mut engine) = built(false) else { return };
    train(&mut engine, 9);
    let (before, steps) = (sensitivities(&mut engine), engine.training.trainer.schedule().taken());
    assert!(f32::from_bits(before[before.len() / 2]) > 0.0 && before[0] < before[before.len() - 1]);
    let gone = thin(&mut engine.training, 0.25, f32::INFINITY).expect("the device works");
    assert_eq!(gone, before.len() / 4);
    assert!(sensitivities(&mut engine) == before[gone..] && engine.training.trainer.schedule().taken() == steps);
}

#[test]
fn no_more_leave_than_what_they_may_cost_together() {
    let Some(mut engine) = built(false) else { return };
    train(&mut engine, 9);
    let before = sensitivities(&mut engine);
    let cost = |n: usize| before[..n].iter().map(|v| f64::from(f32::from_bits(*v))).sum::<f64>() as f32;
    let (few, loss) = (before.len() / 10, engine.training.pictures.store.mean_loss());
    assert!(loss > 0.0 && loss < 1.0 && cost(before.len() / 2) > cost(few + 1), "{loss}");
    let between = 0.5 * (cost(few) + cost(few + 1));
    assert_eq!(thin(&mut engine.training, 0.5, between).expect("the device works"), few);
    assert_eq!(
        thin(&mut engine.training, 0.5, 0.0).expect("the device works"),
        0,
        "those that are left are all of use"
    );
}

#[test]
fn before_every_picture_was_looked_at_the_least_opaque_ones_leave() {
    let Some(mut engine) = built(false) else { return };
    let opacities = |engine: &mut Reconstruction| {
        let mut all = Vec::new();
        engine.training.trainer.each(&BoundingBox::ALL, |g| all.push(g.opacity_logit)).expect("the device works");
        all.sort_by(f32::total_cmp);
        all
    };
    train(&mut engine, 1);
    let before = opacities(&mut engine);
    let gone = thin(&mut engine.training, 0.5, 0.0).expect("the device works");
    assert!(gone > 0 && opacities(&mut engine) == before[gone..]);
}

#[test]
fn a_model_for_delivery_is_thinned_once_and_one_that_is_not_never() {
    for (delivers, share) in [(true, 0.3), (false, 0.0)] {
        let Some(mut engine) = built(delivers) else { return };
        (engine.training.settings.thinned_share, engine.training.settings.thinned_loss) = (0.3, 1e6);
        let whole = engine.gaussians();
        train(&mut engine, 9);
        assert_eq!(engine.gaussians(), whole, "not before its time");
        assert_eq!(train(&mut engine, u32::MAX), StopReason::Schedule);
        assert_eq!(engine.gaussians(), whole - (share * whole as f64) as usize);
    }
}

#[test]
fn a_model_that_is_continued_after_it_had_been_thinned_is_not_thinned_again() {
    for incremental in [false, true] {
        let Some(mut engine) = built_as(Some(Rounding::default()), incremental) else { return };
        assert!(!engine.delivery.thinned);
        engine.training.settings.thinned_loss = 1e6;
        train(&mut engine, u32::MAX);
        assert!(engine.delivery.thinned);
        let (dir, left) = (tempfile::tempdir().expect("a folder"), engine.gaussians());
        engine.checkpoint(dir.path(), true).expect("written");
        let mut settings = settings_for(Some(Rounding::default()), incremental);
        settings.training.thinned_loss = 1e6;
        let mut again = Reconstruction::open(settings, ModelHeader::default(), "train").expect("opens");
        assert!(again.resume(dir.path()).expect("read").is_some());
        again.land();
        (0..3).for_each(|i| again.add(picture(i), i < 2).expect("taken"));
        assert!(again.build(&|| false).expect("built"));
        train(&mut again, u32::MAX);
        assert_eq!((again.delivery.thinned, again.gaussians()), (true, left), "incremental: {incremental}");
    }
}

#[test]
fn a_schedule_that_the_clock_ends_is_thinned_and_rounded_too() {
    let Some(mut engine) = built(true) else { return };
    engine.training.settings.thinned_loss = 1e6;
    let whole = engine.gaussians();
    // Long enough for a few dozen steps on a machine that does other work as well.
    let budget = RunBudget { steps: None, seconds: Some(5.0) };
    let mut each = |_: &StepReport| ControlFlow::Continue(());
    assert_eq!(engine.train(&budget, &mut each).expect("trains"), StopReason::Schedule);
    assert!(engine.delivery.is_rounded() && engine.delivery.thinned && engine.gaussians() < whole);
}

#[test]
fn what_is_delivered_rounded_ends_its_training_with_rounded_shapes_and_new_colours() {
    let trained = |delivers: Option<Rounding>| {
        let mut engine = built_as(delivers, false)?;
        let mut steps = 0;
        let budget = RunBudget { steps: Some(20), seconds: None };
        let mut each = |_: &StepReport| {
            steps += 1;
            ControlFlow::Continue(())
        };
        assert_eq!(engine.train(&budget, &mut each).expect("trains"), StopReason::Schedule);
        engine.training.trainer.snapshot(&mut engine.training.cloud).expect("read");
        Some((steps, engine.delivery.header.steps, engine.training.cloud))
    };
    let places = |cloud: &GaussianCloud| {
        let mut places: Vec<_> = cloud.means.iter().map(|m| m.map(f32::to_bits)).collect();
        places.sort_unstable();
        places
    };
    let Some((_, _, exact)) = trained(None) else { return };
    for rounding in [Rounding::default(), Rounding::fine()] {
        let Some((steps, counted, rounded)) = trained(Some(rounding)) else { return };
        assert_eq!((steps, counted), (20, 20), "the schedule goes on where it was");
        let again = delivery::round_shapes(&rounded, &rounding).expect("rounds");
        assert!(places(&again) == places(&rounded));
        let of_exact = delivery::round_shapes(&exact, &rounding).expect("rounds");
        assert!(places(&of_exact) != places(&exact));
    }
}

#[test]
fn what_is_delivered_rounded_pays_for_view_dependence_in_any_schedule_and_finely_for_a_share_of_it() {
    let Some(exact) = built_as(None, false) else { return };
    let loss = |engine: &Reconstruction| {
        let loss = &engine.training.settings.loss;
        (loss.view_dependence, loss.view_dependence_visits > 0)
    };
    let (weight, waits) = loss(&exact);
    assert!(weight > 0.0 && waits);
    assert!(Rounding::fine().view_dependence < Rounding::default().view_dependence);
    for rounding in [Rounding::default(), Rounding::fine()] {
        let share = rounding.view_dependence;
        let engine = built_as(Some(rounding), false).expect("as before");
        assert_eq!(loss(&engine), (weight * share, false));
    }
}
