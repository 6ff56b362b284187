//! Gaussians that are held are drawn and do not move; the others are trained around them.
#![allow(clippy::unwrap_used, clippy::panic, reason = "a test fails by panicking")]

mod scenes;

use config::plan::Plan;
use models::cloud::GaussianCloud;
use scenes::device::{plain, posed};
use scenes::{cloud, photo, view};
use vulkan::cases::half::request;
use vulkan::fixture::Fixture;
use vulkan::gpu::Gpu;

#[test]
fn what_is_held_stays_to_the_seventh_digit_and_the_rest_learns() {
    let Ok(gpu) = Gpu::open(None) else { return needs::missing(needs::Need::Vulkan, "no Vulkan device") };
    let v = view(64, 48);
    let start = cloud(8, 300, 3);
    // Sixteen bits hold smaller moments.
    for (half_moments, digits) in [(false, 1e-7), (true, 1e-4)] {
        let plan = Plan::new(&request(half_moments)).unwrap();
        let mut trainer = Fixture::new(&gpu, &plan, &plain()).unwrap();
        trainer.load(&start).unwrap();
        trainer.add_view(&posed(&v, &photo(1, &v)), None).unwrap();
        trainer.hold(|row| row % 3 > 0);
        let losses: Vec<f32> = (0..60).map(|_| trainer.step().unwrap().loss).collect();
        assert!(losses[59] < 0.9 * losses[0], "{} to {}", losses[0], losses[59]);
        let mut after = GaussianCloud::with_capacity(3, 300);
        trainer.snapshot(&mut after).unwrap();
        let moved = |i: usize| {
            let of = |a: &[f32], b: &[f32]| a.iter().zip(b).map(|(a, b)| (a - b).abs()).fold(0.0, f32::max);
            let stride = start.sh_stride();
            let sh = i * stride..(i + 1) * stride;
            let logits = (start.opacity_logits[i] - after.opacity_logits[i]).abs();
            let geometry = of(&start.means[i], &after.means[i])
                .max(of(&start.log_scales[i], &after.log_scales[i]))
                .max(of(&start.rotations[i], &after.rotations[i]));
            geometry.max(logits).max(of(&start.sh[sh.clone()], &after.sh[sh]))
        };
        let most = |is_held: bool| (0..300).filter(|i| (i % 3 > 0) == is_held).map(moved).fold(0.0, f32::max);
        assert!(most(true) < digits, "moved by {}, half moments: {half_moments}", most(true));
        assert!(most(false) > 1e-2, "{}", most(false));
    }
}
