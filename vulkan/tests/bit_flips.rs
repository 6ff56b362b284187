//! Bits of a model that memory flips cost little of its pictures once a checkpoint was written or read. `DGTR_MODEL` names a model to
//! measure beside the scene that is made here.
#![allow(clippy::unwrap_used, clippy::panic, reason = "a test fails by panicking")]

mod scenes;

use std::path::Path;
use std::time::Instant;

use config::plan::{Plan, PlanRequest};
use glam::{DQuat, DVec3};
use models::camera::{Intrinsics, Pose, View};
use models::cloud::{GaussianCloud, Plausible};
use models::formats::model;
use models::metrics::psnr;
use rand::{Rng, SeedableRng};
use rand_pcg::Pcg64Mcg;
use scenes::device::{open, plain};
use vulkan::fixture::Fixture;
use vulkan::trainer::Rendering;

const FLIPS: usize = 20_000;

/// A textured ground of small Gaussians, as a survey has it, and what of it two cameras 20 m above see.
fn survey() -> (GaussianCloud, Vec<View>) {
    let mut rng = Pcg64Mcg::seed_from_u64(5);
    let side = 160;
    let mut cloud = GaussianCloud::with_capacity(3, side * side);
    for i in 0..side * side {
        let [x, y] = [i % side, i / side].map(|k| 0.2 * k as f32 - 16.0);
        let color = if (x.floor() + y.floor()) as i32 % 2 == 0 { 0.8 } else { -0.8 };
        let mut sh = [0.0; 48];
        sh.iter_mut().for_each(|v| *v = rng.random_range(-0.05..0.05));
        (0..3).for_each(|k| sh[k] += color * [1.0, 0.7, 0.4][k]);
        let scales = [0, 1, 2].map(|_| rng.random_range(0.05..0.15f32).ln());
        cloud.push([x, y, rng.random_range(-0.1..0.1)], scales, [1.0, 0.2, -0.1, 0.3], rng.random_range(1.0..4.0), &sh);
    }
    let intrinsics = Intrinsics { width: 200, height: 150, fx: 140.0, fy: 140.0, cx: 100.0, cy: 75.0 };
    let down = DQuat::from_rotation_x(std::f64::consts::PI);
    let from = |x: f64| View { intrinsics, pose: Pose { rotation: down, center: DVec3::new(x, 0.0, 20.0) } };
    (cloud, vec![from(-3.0), from(4.0)])
}

/// Flips bits at random in all parameters; rows that are no numbers any more go, as every reader has it.
fn flip(cloud: &mut GaussianCloud, seed: u64) {
    let mut rng = Pcg64Mcg::seed_from_u64(seed);
    let columns: [&mut [f32]; 5] = [
        cloud.means.as_flattened_mut(),
        cloud.log_scales.as_flattened_mut(),
        cloud.rotations.as_flattened_mut(),
        &mut cloud.opacity_logits,
        &mut cloud.sh,
    ];
    let mut values: Vec<&mut f32> = columns.into_iter().flatten().collect();
    for _ in 0..FLIPS {
        let at = rng.random_range(0..values.len());
        *values[at] = f32::from_bits(values[at].to_bits() ^ 1 << rng.random_range(0..32));
    }
    cloud.drop_invalid();
}

/// What the views see of it, as a screen shows it.
fn drawn(trainer: &mut Fixture, cloud: &GaussianCloud, views: &[View]) -> Vec<f32> {
    trainer.load(cloud).unwrap();
    let (mut all, mut rendering) = (Vec::new(), Rendering::default());
    for view in views {
        trainer.render(view, &mut rendering).unwrap();
        all.extend(rendering.rgb.iter().map(|v| v.clamp(0.0, 1.0)));
    }
    all
}

/// PSNR against the sound model's pictures of one whose bits were flipped, and of that one mended, for each of so many seeds.
fn measure(name: &str, sound: &GaussianCloud, views: &[View], seeds: u64) -> Option<Vec<[f64; 2]>> {
    let gpu = open()?;
    let request = PlanRequest {
        device_mib: 1024,
        width: views[0].intrinsics.width,
        height: views[0].intrinsics.height,
        views: 1,
        max_gaussians: Some(sound.len()),
        sh_degree: sound.sh_degree,
        ..Default::default()
    };
    let mut trainer = Fixture::new(&gpu, &Plan::new(&request).unwrap(), &plain()).unwrap();
    let mut mended = sound.clone();
    assert_eq!(Plausible::of(&sound.means).mend(&mut mended), 0, "nothing is wrong with it");
    assert!(mended == *sound);
    let whole = drawn(&mut trainer, sound, views);
    let one = |seed| {
        let mut cloud = sound.clone();
        flip(&mut cloud, seed);
        let flipped = psnr(&drawn(&mut trainer, &cloud, views), &whole);
        let from = Instant::now();
        let values = Plausible::of(&cloud.means).mend(&mut cloud);
        let ms = from.elapsed().as_secs_f64() * 1e3;
        let mended = psnr(&drawn(&mut trainer, &cloud, views), &whole);
        println!(
            "{name}, {} Gaussians, {FLIPS} flips by seed {seed}: {flipped:.2} dB, {mended:.2} dB with {values} values mended in {ms:.1} ms",
            sound.len()
        );
        [flipped, mended]
    };
    Some((1..=seeds).map(one).collect())
}

#[test]
fn twenty_thousand_flipped_bits_of_a_model_cost_little_once_it_is_mended_and_a_sound_one_nothing() {
    let (cloud, views) = survey();
    let Some(measured) = measure("survey", &cloud, &views, 3) else { return };
    for [flipped, mended] in measured {
        assert!(mended > 20.0 && mended > flipped + 5.0, "{flipped} {mended}");
    }
    if let Some(path) = std::env::var_os("DGTR_MODEL") {
        let (header, cloud) = model::read(Path::new(&path)).unwrap();
        let views: Vec<View> = header.views.iter().step_by(8).map(|(_, view)| *view).collect();
        measure("model", &cloud, &views, 1);
    }
}
