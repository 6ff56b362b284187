//! What flipped bits of memory make of a model is mended, and a sound model left as it is.
#![allow(clippy::unwrap_used, reason = "a test fails by panicking")]

use models::cloud::{GaussianCloud, Plausible};
use rand::{Rng, SeedableRng};
use rand_pcg::Pcg64Mcg;

/// A textured ground, and what is far away and large.
fn scene(n: usize, seed: u64) -> GaussianCloud {
    let mut rng = Pcg64Mcg::seed_from_u64(seed);
    let mut cloud = GaussianCloud::with_capacity(1, n);
    for i in 0..n {
        let far = if i % 50 == 0 { 20.0 } else { 1.0 };
        let mean = [0, 1, 2].map(|_| far * rng.random_range(-50.0..50.0f32));
        let size = (far * rng.random_range(0.05..2.0f32)).ln();
        let scales = [0, 1, 2].map(|_| size + rng.random_range(-3.0..0.5f32));
        let sh: [f32; 12] = std::array::from_fn(|k| rng.random_range(-2.0..2.0) * if k < 3 { 1.0 } else { 0.5 });
        cloud.push(mean, scales, [1.0, 0.0, 0.0, 0.0], rng.random_range(-8.0..16.0), &sh);
    }
    cloud
}

#[test]
fn a_sound_scene_is_left_as_it_is_to_the_bit_with_its_large_far_and_bright_gaussians() {
    for (n, seed) in [(20_000, 0), (20_000, 1), (300, 2), (3, 3), (0, 4)] {
        let mut cloud = scene(n, seed);
        if n > 0 {
            // As the first of a model in metres.
            cloud.log_scales[0] = [0.0; 3];
        }
        let before = cloud.clone();
        assert_eq!(Plausible::of(&cloud.means).mend(&mut cloud), 0);
        assert!(cloud == before);
    }
    // One place says nothing of a scene's size, nor do few.
    for mut cloud in [scene(63, 1), scene(64, 1)] {
        cloud.means.fill([7.0; 3]);
        cloud.log_scales[0] = [12.0; 3];
        assert_eq!(Plausible::of(&cloud.means).mend(&mut cloud), 0);
    }
}

#[test]
fn a_scene_of_any_unit_under_a_sky_far_beyond_it_is_left_as_it_is() {
    for unit in [1e-4, 1.0, 1e6f32] {
        let mut cloud = scene(20_000, 5);
        // One in 200: too few for the sky to count as the scene's size.
        for i in (0..cloud.len()).step_by(200) {
            let around = 0.1 * i as f32;
            cloud.means[i] = [3e4 * around.cos(), 3e4 * around.sin(), 1e4];
            cloud.log_scales[i] = [3e4f32.ln(); 3];
        }
        cloud.means.iter_mut().flatten().for_each(|v| *v *= unit);
        cloud.log_scales.iter_mut().flatten().for_each(|v| *v += unit.ln());
        let before = cloud.clone();
        assert_eq!(Plausible::of(&cloud.means).mend(&mut cloud), 0, "{unit}");
        assert!(cloud == before, "{unit}");
    }
}

#[test]
fn what_a_flipped_bit_makes_of_a_value_becomes_what_the_gaussians_other_values_say() {
    let sound = scene(20_000, 7);
    let mut cloud = sound.clone();
    // Means far out, as flipped bits leave them, do not make the scene larger.
    (0..50).for_each(|i| cloud.means[7 + 397 * i] = [3e30, f32::MAX, 1e9]);
    let flipped = |value: f32, bit: u32| f32::from_bits(value.to_bits() ^ 1 << bit);
    cloud.log_scales[11] = [-3.0, flipped(-5.0, 30), -2.5];
    cloud.log_scales[12] = [flipped(0.4, 30), -1.0, 0.5];
    cloud.log_scales[13] = [40.0; 3];
    cloud.log_scales[17] = [1e-30; 3];
    cloud.opacity_logits[13] = flipped(-0.4, 30);
    cloud.sh[12 * 14] = flipped(0.3, 30);
    cloud.sh[12 * 15 + 7] = flipped(-0.01, 30);
    assert_eq!(Plausible::of(&cloud.means).mend(&mut cloud), 1 + 1 + 3 + 3 + 1 + 1 + 1);
    assert_eq!(cloud.log_scales[11], [-3.0, -2.5, -2.5]);
    assert_eq!(cloud.log_scales[12], [0.5, -1.0, 0.5]);
    // Twice the scene's diameter, of which it has the side.
    let [long, ..] = cloud.log_scales[13];
    assert!(cloud.log_scales[13] == [long; 3] && (1000.0..8000.0).contains(&long.exp()), "{long}");
    assert_eq!(cloud.log_scales[17], [0.0; 3]);
    assert_eq!(cloud.opacity_logits[13], -30.0);
    assert_eq!(cloud.sh[12 * 14], 0.5 * (cloud.sh[12 * 14 + 1] + cloud.sh[12 * 14 + 2]));
    assert_eq!(cloud.sh[12 * 15 + 7], 0.0);
    // What is no number is left to who counts and drops it.
    cloud.log_scales[16][0] = f32::NAN;
    assert_eq!(Plausible::of(&cloud.means).mend(&mut cloud), 0);
    assert!(cloud.log_scales[16][0].is_nan());
}
