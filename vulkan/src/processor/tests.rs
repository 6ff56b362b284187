//! What training on the processor leaves does not depend on its threads or its vectors.

use crate::fixture::Fixture;
use crate::gpu::{Forced, Gpu};
use crate::synthetic::{cloud, photo, plain, posed, view};
use crate::trainer::Rendering;
use config::plan::{Plan, PlanRequest};
use config::training::Strategy;
use fearless_simd::Level;
use models::camera::DepthPrior;
use models::cloud::GaussianCloud;

/// A picture that is no multiple of a vector, a strip or a tile, with all that has sums over it: growth, noise, depth, pose and exposure.
fn trained(gpu: &Gpu, half_moments: bool) -> (GaussianCloud, Rendering) {
    let v = view(77, 53);
    let mut settings = plain();
    settings.density.strategy = Strategy::Relocate;
    settings.steps = 40;
    settings.regularise.noise = 2.0;
    settings.loss.depth = 0.2;
    (settings.refine_poses, settings.refine_exposure) = (true, true);
    let request = PlanRequest { device_mib: 64, width: 77, height: 53, views: 2, half_moments, ..Default::default() };
    let mut trainer = Fixture::new(gpu, &Plan::with_capacities(&request, 3000, 9000), &settings).unwrap();
    trainer.load(&cloud(8, 1500, 3)).unwrap();
    let depth: Vec<f32> = (0..77 * 53).map(|i| 2.0 + (i % 77) as f32 * 0.05).collect();
    let confidence = depth.iter().map(|d| d / 8.0).collect();
    let prior = DepthPrior { width: 77, height: 53, depth, confidence };
    trainer.add_view(&posed(&v, &photo(1, &v)), Some(&prior)).unwrap();
    trainer.add_view(&posed(&v, &photo(2, &v)), None).unwrap();
    for _ in 0..settings.steps {
        trainer.step().unwrap();
    }
    let (mut model, mut drawn) = (GaussianCloud::default(), Rendering::default());
    trainer.snapshot(&mut model).unwrap();
    trainer.render(&v, &mut drawn).unwrap();
    (model, drawn)
}

fn open(threads: usize, level: Level) -> Option<Gpu> {
    let gpu = Gpu::open(Some("processor")).ok()?;
    Some(gpu.forced(Forced { threads: Some(threads), level: Some(level), ..Forced::default() }))
}

/// The vectors that this processor has, the best first.
fn levels() -> Vec<Level> {
    let best = Level::new();
    #[cfg(target_arch = "x86_64")]
    let others =
        [best.as_avx2().map(Level::Avx2), best.as_sse4_2().map(Level::Sse4_2), best.as_sse2().map(Level::Sse2)];
    #[cfg(not(target_arch = "x86_64"))]
    let others = [None; 0];
    std::iter::once(best).chain(others.into_iter().flatten()).collect()
}

#[test]
fn a_model_has_the_same_bits_with_any_number_of_threads_and_any_vectors() {
    for half_moments in [false, true] {
        let Some(gpu) = open(1, Level::new()) else {
            return needs::missing(needs::Need::Vulkan, "no processor to train on");
        };
        let one = trained(&gpu, half_moments);
        assert!(one.0.len() > 1500, "nothing grew");
        for threads in [2, 3, 4, 8] {
            let Some(gpu) = open(threads, Level::new()) else { return };
            assert!(trained(&gpu, half_moments) == one, "{threads} threads");
        }
        for level in levels() {
            let Some(gpu) = open(2, level) else { return };
            assert!(trained(&gpu, half_moments) == one, "{level:?}");
        }
    }
}

#[test]
fn pictures_of_any_height_and_width_have_one_loss_with_any_number_of_threads() {
    for (width, height) in [(1, 1), (3, 17), (70, 18), (5, 19), (9, 41), (2, 81), (65, 200)] {
        let loss = |threads: usize| {
            let gpu = open(threads, Level::new())?;
            let v = view(width, height);
            let request = PlanRequest { device_mib: 64, width, height, views: 1, ..Default::default() };
            let mut trainer = Fixture::new(&gpu, &Plan::with_capacities(&request, 300, 9000), &plain()).unwrap();
            trainer.load(&cloud(5, 300, 1)).unwrap();
            trainer.add_view(&posed(&v, &photo(1, &v)), None).unwrap();
            trainer.step().unwrap();
            Some(trainer.step().unwrap().loss)
        };
        let Some(one) = loss(1) else { return needs::missing(needs::Need::Vulkan, "no processor to train on") };
        assert!(one.is_finite() && one > 0.0, "{width} x {height}: {one}");
        assert_eq!(loss(8), Some(one), "{width} x {height}");
    }
}
