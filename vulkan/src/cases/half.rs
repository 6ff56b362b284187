//! Moments in 16 bits against moments in 32: the device's training, and the reference's arithmetic.
#![allow(missing_docs, reason = "their names say what they promise")]

use std::ops::ControlFlow;

use super::scenes::{cloud, photo, plain, posed, view};
use super::{Broken, Outcome, Tally};
use crate::fixture::Fixture;
use crate::gpu::Gpu;
use crate::reference::adam::{Moments, adam, half_moments};
use crate::trainer::RunBudget;
use config::plan::{Plan, PlanRequest};
use config::training::TrainSettings;
use models::cloud::GaussianCloud;
use rand::{Rng, SeedableRng};

/// Room for 512 Gaussians and two pictures of 64×48.
pub fn request(half_moments: bool) -> PlanRequest {
    PlanRequest {
        device_mib: 64,
        width: 64,
        height: 48,
        views: 2,
        sh_degree: 3,
        max_gaussians: Some(512),
        scene_gaussians: None,
        half_moments,
        ..Default::default()
    }
}

/// Loss and Gaussians after `steps` steps on two photographs of noise.
fn train(gpu: &Gpu, half_moments: bool, c: &GaussianCloud, steps: u32) -> Result<(f32, GaussianCloud), Broken> {
    let v = view(64, 48);
    let mut t = Fixture::new(gpu, &Plan::new(&request(half_moments))?, &TrainSettings { seed: 3, ..plain() })?;
    t.load(c)?;
    let mut turned = posed(&v, &photo(2, &v));
    turned.view.pose.rotation = glam::DQuat::from_rotation_y(0.2);
    t.add_view(&posed(&v, &photo(1, &v)), None)?;
    t.add_view(&turned, None)?;
    let budget = RunBudget { steps: Some(steps), seconds: None };
    let loss = t.run(&budget, &mut |_| ControlFlow::Continue(()))?.last.map_or(f32::NAN, |r| r.loss);
    let mut after = GaussianCloud::default();
    t.snapshot(&mut after)?;
    promise!((0..after.len()).all(|i| after.is_valid(i)), "a row went bad");
    Ok((loss, after))
}

/// 400 steps come to the same loss (within a twentieth of what they gained), and to the same bytes every time.
pub fn training_with_half_moments_ends_where_training_with_whole_ones_does(gpu: &Gpu) -> Outcome {
    let c = cloud(11, 300, 3);
    let (start, _) = train(gpu, false, &c, 1)?;
    let (whole, _) = train(gpu, false, &c, 400)?;
    let (half, after) = train(gpu, true, &c, 400)?;
    promise!(whole < 0.9 * start, "the loss fell only from {start} to {whole}");
    promise!((half - whole).abs() < 0.05 * (start - whole), "{half} in 16 bits, {whole} in 32, {start} at first");
    promise!(after == train(gpu, true, &c, 400)?.1, "not the same bytes twice");
    Ok(format!("loss {start:.4} → {whole:.4} in 32 bits, {half:.4} in 16"))
}

/// A Gaussian that fills the picture, one of which a trace is seen, colours of 1e30: every number stays finite.
pub fn tiny_and_huge_gradients_in_half_moments_leave_every_number_finite(gpu: &Gpu) -> Outcome {
    let mut c = cloud(12, 64, 3);
    let stride = c.sh_stride();
    for i in 0..c.len() {
        match i % 4 {
            0 => (c.log_scales[i], c.opacity_logits[i]) = ([6.0; 3], 8.0),
            1 => (c.log_scales[i], c.opacity_logits[i]) = ([-9.0; 3], -5.4),
            2 => c.sh[i * stride..i * stride + 3].fill(1e30),
            _ => {}
        }
    }
    let (loss, _) = train(gpu, true, &c, 200)?;
    promise!(loss.is_finite(), "loss {loss}");
    Ok(Tally::default().said())
}

/// Second moments over 20,000 random gradients, averaged over the last half: in 16 bits, divided by those in 32.
fn drift(size: f32, by_chance: bool) -> f64 {
    let scale = (1 << 20) as f32;
    let mut rng = rand_pcg::Pcg64Mcg::seed_from_u64(5);
    let (mut half, mut full, mut sums) = (Moments::default(), Moments::default(), [0.0; 2]);
    for t in 1..=20_000u32 {
        let g = size * (0..12).map(|_| rng.random_range(-0.5..0.5f32)).sum::<f32>();
        adam(&mut 0.0, &mut half, g, 0.0, t);
        adam(&mut 0.0, &mut full, g, 0.0, t);
        half = half_moments(half, scale, if by_chance { rng.random() } else { 0x1000 });
        if t > 10_000 {
            sums[0] += f64::from(half.second);
            sums[1] += f64::from(full.second);
        }
    }
    sums[0] / sums[1]
}

/// Rounded by chance, second moments in 16 bits stay within 2 % of those in 32; rounded to nearest they would not.
pub fn second_moments_in_sixteen_bits_are_right_on_average_only_when_rounded_by_chance() -> Outcome {
    for size in [1e-6, 1e-4, 1e-2] {
        let by_chance = drift(size, true);
        promise!((by_chance - 1.0).abs() < 0.02, "gradients of {size}: {by_chance} of the true moment");
    }
    let nearest = drift(1e-4, false);
    promise!((nearest - 1.0).abs() > 0.02, "rounding to nearest would do: {nearest}");
    Ok(format!("by chance {:.4}, to nearest {nearest:.4} of the true moment", drift(1e-4, true)))
}

/// What is too large is clamped; a first moment without a second one would be divided by nothing, so both go.
pub fn moments_beyond_sixteen_bits_are_clamped_and_those_below_are_none() -> Outcome {
    let scale = (1 << 20) as f32;
    let huge = half_moments(Moments { first: -1e18, second: 1e36 }, scale, 8191);
    promise!(huge.first < 0.0 && huge.first.is_finite() && huge.second > 0.0 && huge.second.is_finite(), "{huge:?}");
    promise_eq!(half_moments(Moments { first: 1e-13, second: 1e-30 }, scale, 0), Moments::default());
    promise_eq!(half_moments(Moments::default(), scale, 8191), Moments::default());
    Ok(Tally::default().said())
}
