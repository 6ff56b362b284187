//! Promises of the engine.

use models::cloud::GaussianCloud;
use models::formats::delivery::{self, Rounding};
use models::formats::model::ModelHeader;
use vulkan::gpu::Gpu;

use super::*;
use crate::engine::EngineSettings;
use crate::engine::testing::{picture, settings};

#[test]
fn giving_up_gaussians_does_not_start_the_schedule_anew() {
    if Gpu::list().is_err() {
        println!("skipped: no Vulkan device (install mesa-vulkan-drivers)");
        return;
    }
    let mut engine = Reconstruction::open(settings(), ModelHeader::default(), "train").expect("opens");
    (0..3).for_each(|i| engine.add(picture(i), i < 2).expect("taken"));
    assert!(engine.build(&|| true).expect("built"));
    let budget = RunBudget { steps: Some(6), seconds: None };
    let mut steps = 0;
    let mut until = |engine: &mut Reconstruction, last: u32| {
        let each = &mut |_: &StepReport| {
            steps += 1;
            if steps == last { ControlFlow::Break(()) } else { ControlFlow::Continue(()) }
        };
        engine.train(&budget, each).expect("trains")
    };
    assert_eq!(until(&mut engine, 4), StopReason::Caller);
    let before = engine.gaussians();
    engine.shrink().expect("the device works");
    assert!(engine.gaussians() < before && !engine.is_done(&budget));
    assert_eq!(until(&mut engine, u32::MAX), StopReason::Schedule);
    assert_eq!(steps, 6);
    assert!(engine.is_done(&budget));
}

#[test]
fn what_is_delivered_rounded_ends_its_training_with_rounded_shapes_and_new_colours() {
    if Gpu::list().is_err() {
        println!("skipped: no Vulkan device (install mesa-vulkan-drivers)");
        return;
    }
    let trained = |delivers: bool| {
        let mut engine =
            Reconstruction::open(EngineSettings { delivers, ..settings() }, ModelHeader::default(), "train")
                .expect("opens");
        (0..3).for_each(|i| engine.add(picture(i), i < 2).expect("taken"));
        assert!(engine.build(&|| true).expect("built"));
        let mut steps = 0;
        let budget = RunBudget { steps: Some(20), seconds: None };
        let mut each = |_: &StepReport| {
            steps += 1;
            ControlFlow::Continue(())
        };
        assert_eq!(engine.train(&budget, &mut each).expect("trains"), StopReason::Schedule);
        engine.trainer.snapshot(&mut engine.cloud).expect("read");
        (steps, engine.header.steps, engine.cloud)
    };
    let ((steps, counted, rounded), (_, _, exact)) = (trained(true), trained(false));
    assert_eq!((steps, counted), (20, 20), "the schedule goes on where it was");
    let again = delivery::round_shapes(&rounded, &Rounding::default()).expect("rounds");
    let places = |cloud: &GaussianCloud| {
        let mut places: Vec<_> = cloud.means.iter().map(|m| m.map(f32::to_bits)).collect();
        places.sort_unstable();
        places
    };
    assert!(places(&again) == places(&rounded));
    let of_exact = delivery::round_shapes(&exact, &Rounding::default()).expect("rounds");
    assert!(places(&of_exact) != places(&exact));
}
