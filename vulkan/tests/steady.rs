//! Nothing is allocated once training runs: no heap in a step, one device allocation as large as the plan says.
#![allow(clippy::unwrap_used, clippy::panic, reason = "a test fails by panicking")]

#[path = "../../tests/counting_allocator.rs"]
mod counting_allocator;
mod scenes;

use counting_allocator::allocations;
use scenes::device::{empty_trainer, plain, posed};
use scenes::{cloud, photo, view};

#[test]
fn steps_allocate_nothing_density_control_and_bands_included() {
    let v = view(64, 48);
    let mut settings = plain();
    settings.density.strategy = config::training::Strategy::Relocate;
    settings.steps = 60; // a densification every seventh step
    settings.regularise.noise = 50.0;
    let Some(mut trainer) = empty_trainer(3, 400, &v, &settings) else { return };
    trainer.load(&cloud(8, 300, 3)).unwrap();
    for seed in [1, 2] {
        trainer.add_view(&posed(&v, &photo(seed, &v)), None).unwrap();
    }
    // The first steps fill the view order and measure the scene.
    for _ in 0..4 {
        trainer.step().unwrap();
    }
    let before = allocations();
    let grown = (0..40).map(|_| trainer.step().unwrap().gaussians).last().unwrap();
    let made = allocations() - before;
    println!("40 steps, {grown} Gaussians: {made} heap allocations");
    assert_eq!(made, 0);
    assert!(grown > 300, "density control did not run");
    assert_eq!(trainer.device().bytes(), trainer.plan().total_bytes);
}
