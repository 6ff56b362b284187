//! Promises of the engine.

use config::training::Strategy;
use models::formats::model::ModelHeader;
use vulkan::gpu::Gpu;

use super::*;
use crate::testing::{picture, settings};

#[test]
fn giving_up_gaussians_does_not_start_the_schedule_anew() {
    if Gpu::list().is_err() {
        needs::missing(needs::Need::Vulkan, "no Vulkan device (install mesa-vulkan-drivers)");
        return;
    }
    let mut settings = settings();
    settings.training.density.strategy = Strategy::Relocate;
    let mut engine = Reconstruction::open(settings, ModelHeader::default(), "train").expect("opens");
    (0..3).for_each(|i| engine.add(picture(i), i < 2).expect("taken"));
    assert!(engine.build(&|| false).expect("built"));
    // As after a landing.
    engine.training.trainer.schedule_mut().begin_at(0.25);
    let budget = RunBudget { steps: Some(20), seconds: None };
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
    let after = engine.gaussians();
    assert!(after < before && !engine.is_done(&budget));
    assert_eq!(engine.training.trainer.schedule().progress(), 0.25 + 0.75 * 0.2);
    assert_eq!(until(&mut engine, u32::MAX), StopReason::Schedule);
    assert_eq!(steps, 20);
    assert!(engine.is_done(&budget));
    assert_eq!(engine.gaussians(), after, "what was given up is not grown again");
}
