//! Scenes of any size and place, rates beyond reason, and very long runs.

use super::device::{ready, survive};
use super::scenes::{Answer, cloud, empty_trainer, photo, plain, posed, view};
use super::{Broken, Outcome, Tally};
use crate::gpu::Gpu;
use crate::reference::camera::Camera;
use crate::reference::gaussian::{Gaussian, PARAMETERS};
use crate::reference::loss::Target;
use crate::reference::project::Limits;
use crate::reference::trainer::ReferenceTrainer;
use crate::trainer::{Rendering, RunBudget, TrainError};
use config::training::{RateSettings, Strategy, TrainSettings};
use glam::DVec3;
use models::camera::View;
use models::cloud::GaussianCloud;
use std::ops::ControlFlow;

/// One grey level and a bit: a contribution at the cut-off may fall on the other side.
const GREY_LEVEL: f32 = 1.1 / 255.0;

/// Multiplies every length of a scene.
fn scaled(base: &GaussianCloud, scale: f32) -> GaussianCloud {
    let mut c = base.clone();
    c.means.iter_mut().for_each(|m| *m = m.map(|x| x * scale));
    c.log_scales.iter_mut().for_each(|s| *s = s.map(|x| x + scale.ln()));
    c
}

/// Scenes of other sizes than metres.
const SIZES: [(&str, f32); 2] = [("a centimetre", 0.0052), ("a hundred kilometres", 1.25e4)];

/// A scene and its camera with the camera at `center`, both in f32 as far as they are given so.
fn moved(base: &GaussianCloud, at_origin: &View, metres: f64) -> (GaussianCloud, View) {
    let (mut c, mut v) = (base.clone(), *at_origin);
    v.pose.center = DVec3::new(metres, -metres, 0.1 * metres);
    for m in &mut c.means {
        *m = std::array::from_fn(|k| (f64::from(m[k]) + v.pose.center[k]) as f32);
    }
    (c, v)
}

/// Every rate `factor` times the usual one.
fn wild(factor: f32) -> RateSettings {
    let sane = RateSettings::default();
    RateSettings {
        mean_start: sane.mean_start * factor,
        mean_end: sane.mean_end * factor,
        log_scale: sane.log_scale * factor,
        rotation: sane.rotation * factor,
        opacity: sane.opacity * factor,
        sh_dc: sane.sh_dc * factor,
        sh_rest: sane.sh_rest * factor,
        ..sane
    }
}

/// Largest difference of transmittance between two pictures of the reference.
fn apart(a: &Answer, b: &Answer) -> f32 {
    let pairs = a.picture.iter().zip(&b.picture);
    pairs.map(|(a, b)| (a.transmittance - b.transmittance).abs()).fold(0.0, f32::max)
}

/// Steps of the reference: their losses.
fn reference_losses(t: &mut ReferenceTrainer<f32>, v: &View, photo: &[[f32; 3]], steps: usize) -> Vec<f32> {
    let target =
        Target { width: v.intrinsics.width as usize, rgb: photo, depth: None, kept: None, background: [0.0; 3] };
    (0..steps).map(|_| t.step(&Camera::of(v), &target, 0.0).loss.total).collect()
}

/// Scenes 1 cm and 100 km across train as one of metres does, as long as nothing is nearer than the near plane of 1 cm.
pub fn scenes_a_centimetre_and_a_hundred_kilometres_across_train_alike(gpu: &Gpu) -> Outcome {
    let mut counted = Tally::default();
    let v = view(21, 17);
    let mut t = ready(gpu, 0, &v, &plain())?;
    let base = cloud(13, 20, 0);
    let (expected, report) = survive(&mut counted, &mut t, &base, &v, "metres")?;
    for (case, scale) in SIZES {
        let (got, r) = survive(&mut counted, &mut t, &scaled(&base, scale), &v, case)?;
        for (a, b) in got.transmittance.iter().zip(&expected.transmittance) {
            promise!((a - b).abs() < GREY_LEVEL, "{case}: {a} instead of {b}");
        }
        promise!((r.loss - report.loss).abs() < 0.02 * report.loss, "{case}: loss {} against {}", r.loss, report.loss);
    }
    Ok(counted.said())
}

/// Scenes of all sizes on the reference, three steps each.
pub fn scenes_a_centimetre_and_a_hundred_kilometres_across_train_alike_in_the_reference() -> Outcome {
    let mut counted = Tally::default();
    let v = view(21, 17);
    let (base, photo) = (cloud(13, 20, 0), photo(1, &v));
    let train = |c: &GaussianCloud, extent: f32| {
        let mut t = ReferenceTrainer::new(Gaussian::of_cloud(c), plain(), extent, Limits::default());
        reference_losses(&mut t, &v, &photo, 3)[2]
    };
    let (expected, loss) = (counted.ask(&base, &v, &photo, &Default::default()), train(&base, 5.0));
    for (case, scale) in SIZES {
        let c = scaled(&base, scale);
        let got = counted.ask(&c, &v, &photo, &Default::default());
        got.check_finite(case)?;
        promise!(apart(&got, &expected) < GREY_LEVEL, "{case}: {} apart", apart(&got, &expected));
        let its_loss = train(&c, 5.0 * scale);
        promise!((its_loss - loss).abs() < 0.02 * loss, "{case}: loss {its_loss} against {loss}");
    }
    Ok(counted.said())
}

/// Camera and scene 10 km from the origin give the picture of the origin; at ECEF's 6,378 km all stays finite.
pub fn cameras_far_from_the_origin_see_the_same_picture(gpu: &Gpu) -> Outcome {
    let mut counted = Tally::default();
    let at_origin = view(21, 17);
    let base = cloud(14, 20, 0);
    let mut t = ready(gpu, 0, &at_origin, &plain())?;
    let (expected, _) = survive(&mut counted, &mut t, &base, &at_origin, "origin")?;
    for (metres, same) in [(1e4, true), (6.378e6, false)] {
        let (c, v) = moved(&base, &at_origin, metres);
        let mut t = ready(gpu, 0, &v, &plain())?;
        let (got, _) = survive(&mut counted, &mut t, &c, &v, &format!("{metres} m"))?;
        let worst = got.transmittance.iter().zip(&expected.transmittance).map(|(a, b)| (a - b).abs());
        let worst = worst.fold(0.0, f32::max);
        promise!(!same || worst < 5.0 * GREY_LEVEL, "{metres} m from the origin: {worst} apart");
    }
    Ok(counted.said())
}

/// Cameras far from the origin, on the reference.
pub fn cameras_far_from_the_origin_see_the_same_picture_in_the_reference() -> Outcome {
    let mut counted = Tally::default();
    let at_origin = view(21, 17);
    let (base, photo) = (cloud(14, 20, 0), photo(1, &at_origin));
    let expected = counted.ask(&base, &at_origin, &photo, &Default::default());
    for (metres, same) in [(1e4, true), (6.378e6, false)] {
        let (c, v) = moved(&base, &at_origin, metres);
        let got = counted.ask(&c, &v, &photo, &Default::default());
        got.check_finite(&format!("{metres} m"))?;
        let worst = apart(&got, &expected);
        promise!(!same || worst < 5.0 * GREY_LEVEL, "{metres} m from the origin: {worst} apart");
    }
    Ok(counted.said())
}

/// Rates a million times too large leave every row finite, and with sane rates the loss falls again; rates that are no
/// rates are refused by name.
pub fn extreme_learning_rates_are_recovered_from_or_refused(gpu: &Gpu) -> Outcome {
    let mut counted = Tally::default();
    let v = view(21, 17);
    let sane = RateSettings::default();
    for factor in [1e3f32, 1e6] {
        let mut t = ready(gpu, 1, &v, &plain())?;
        t.load(&cloud(15, 30, 1))?;
        t.set_rates(&wild(factor))?;
        for step in 0..10 {
            let r = t.step()?;
            promise!(r.loss.is_finite(), "rates × {factor}, step {step}: loss {}", r.loss);
            counted.scene(1, r.visible, r.instances);
        }
        t.set_rates(&sane)?;
        let (mut first, mut last) = (f32::NAN, f32::NAN);
        for step in 0..30 {
            last = t.step()?.loss;
            first = if step == 0 { last } else { first };
        }
        promise!(last <= first, "rates × {factor}: with sane rates the loss rose from {first} to {last}");
        let mut after = GaussianCloud::default();
        t.snapshot(&mut after)?;
        promise!((0..after.len()).all(|i| after.is_valid(i)), "rates × {factor}: a row went bad");
    }
    let mut t = ready(gpu, 0, &v, &plain())?;
    for bad in [f32::NAN, f32::INFINITY, -1.0] {
        let refused = t.set_rates(&RateSettings { opacity: bad, ..sane });
        promise!(
            matches!(&refused, Err(TrainError::Settings(e)) if e.field == "rates.opacity"),
            "a rate of {bad} was not refused by name"
        );
    }
    Ok(counted.said())
}

/// The reference's optimiser is thrown as far, stays finite, and finds back.
pub fn extreme_learning_rates_are_recovered_from_by_the_reference() -> Outcome {
    let v = view(21, 17);
    let photo = photo(1, &v);
    let mut said = String::new();
    for factor in [1e3f32, 1e6] {
        let mut settings = plain();
        settings.rates = wild(factor);
        let mut t =
            ReferenceTrainer::new(Gaussian::<f32>::of_cloud(&cloud(15, 30, 1)), settings, 5.0, Limits::default());
        let losses = reference_losses(&mut t, &v, &photo, 10);
        promise!(losses.iter().all(|l| l.is_finite()), "rates × {factor}: losses {losses:?}");
        t.settings.rates = RateSettings::default();
        let losses = reference_losses(&mut t, &v, &photo, 30);
        promise!(losses[29] <= losses[0], "rates × {factor}: the loss rose from {} to {}", losses[0], losses[29]);
        let finite = t.cloud.iter_mut().all(|g| (0..PARAMETERS).all(|k| g.parameter(k).is_finite()));
        promise!(finite, "rates × {factor}: a row went bad");
        said = format!("× {factor:.0e}: loss {:.3} → {:.3}", losses[0], losses[29]);
    }
    Ok(said)
}

/// Identical Gaussians are drawn in the order of their rows, and training keeps them finite.
pub fn duplicated_gaussians_are_drawn_in_the_order_of_their_rows(gpu: &Gpu) -> Outcome {
    let mut counted = Tally::default();
    let v = view(21, 17);
    let mut t = ready(gpu, 0, &v, &plain())?;
    let mut c = GaussianCloud::with_capacity(0, 2);
    for brightness in [1.0, 0.0] {
        c.push([0.0, 0.0, 4.0], [0.0; 3], [1.0, 0.0, 0.0, 0.0], 0.0, &[super::scenes::grey(brightness); 3]);
    }
    let (drawn, _) = survive(&mut counted, &mut t, &c, &v, "duplicates")?;
    // First row in front: 0.5·1 + 0.25·0 at the peak, not 0.25.
    let peak = drawn.rgb.iter().copied().fold(0.0, f32::max);
    promise!((peak - 0.5).abs() < 0.01, "peak {peak}");
    Ok(counted.said())
}

/// A quaternion of length zero is dropped and counted; any other length is normalised.
pub fn a_quaternion_of_length_zero_is_dropped_and_any_other_length_is_normalised(gpu: &Gpu) -> Outcome {
    let mut counted = Tally::default();
    let v = view(21, 17);
    let mut t = ready(gpu, 1, &v, &plain())?;
    let base = cloud(3, 6, 1);
    let (expected, _) = survive(&mut counted, &mut t, &base, &v, "as made")?;
    for length in [1e-6f32, 1.0, 1e6] {
        let mut c = base.clone();
        for q in &mut c.rotations {
            let norm = q.iter().map(|x| x * x).sum::<f32>().sqrt();
            *q = q.map(|x| x / norm * length);
        }
        t.load(&c)?;
        let mut drawn = Rendering::default();
        t.render(&v, &mut drawn)?;
        for (a, b) in drawn.transmittance.iter().zip(&expected.transmittance) {
            promise!((a - b).abs() < GREY_LEVEL, "length {length}: {a} instead of {b}");
        }
    }
    let mut c = base.clone();
    c.rotations[2] = [0.0; 4];
    promise_eq!(t.load(&c)?.dropped_non_finite, 1);
    // The shorter it is, the longer its gradient: one whose square is no number is dropped and counted.
    let mut settings = plain();
    settings.loss.l1 = 1e17;
    let mut t = ready(gpu, 1, &v, &settings)?;
    let mut c = base;
    c.rotations.as_flattened_mut().iter_mut().for_each(|x| *x *= 1e-6);
    t.load(&c)?;
    let mut gradient = GaussianCloud::default();
    t.gradient(0, &mut gradient)?;
    let largest = gradient.rotations.as_flattened().iter().fold(0.0f32, |most, x| most.max(x.abs()));
    promise!(largest < 1e18, "a gradient of {largest:e} reaches the moments");
    let summary = t.run(&RunBudget { steps: Some(1), seconds: None }, &mut |_| ControlFlow::Continue(()))?;
    promise!(summary.counters.non_finite_gradients > 0, "dropped without being counted");
    Ok(counted.said())
}

/// Photographs of one colour have SSIM without negative variance.
pub fn constant_photographs_have_no_negative_variance(gpu: &Gpu) -> Outcome {
    let mut counted = Tally::default();
    let v = view(25, 15);
    for grey in [0.0f32, 1.0, 0.5] {
        let mut t = empty_trainer(gpu, 0, 256, &v, &plain())?;
        t.add_view(&posed(&v, &vec![[grey; 3]; 25 * 15]), None)?;
        let (_, report) = survive(&mut counted, &mut t, &cloud(16, 20, 0), &v, &format!("grey {grey}"))?;
        promise!(report.ssim <= 1.0 + 1e-5 && report.ssim >= -1.0, "grey {grey}: SSIM {}", report.ssim);
    }
    Ok(counted.said())
}

/// `steps` steps on a tiny scene with density control, noise and opacity decay: every loss and row finite, and the mean
/// opacity neither at 0 nor at 1. Not in [`super::CASES`]: it takes minutes.
///
/// # Errors
/// [`Broken`] names the step.
pub fn long_run(gpu: &Gpu, steps: u32) -> Result<String, Broken> {
    let v = view(16, 16);
    let mut settings = TrainSettings { steps, ..plain() };
    settings.regularise = TrainSettings::default().regularise;
    settings.density.strategy = Strategy::Relocate;
    let mut t = empty_trainer(gpu, 1, 40, &v, &settings)?;
    t.add_view(&posed(&v, &photo(7, &v)), None)?;
    t.load(&cloud(17, 30, 1))?;
    let mut after = GaussianCloud::default();
    let (mut low, mut high, mut loss) = (1.0f64, 0.0f64, f32::NAN);
    for step in 1..=steps {
        loss = t.step()?.loss;
        promise!(loss.is_finite(), "step {step}: loss {loss}");
        if step % 1000 == 0 || step == steps {
            t.snapshot(&mut after)?;
            promise!((0..after.len()).all(|i| after.is_valid(i)), "step {step}: a row went bad");
            let opacity = |logit: &f32| 1.0 / (1.0 + (-f64::from(*logit)).exp());
            let mean = after.opacity_logits.iter().map(opacity).sum::<f64>() / after.len() as f64;
            (low, high) = (low.min(mean), high.max(mean));
            promise!(mean > 0.01 && mean < 0.99, "step {step}: mean opacity {mean:.4}");
        }
    }
    Ok(format!("{steps} steps, loss {loss:.4}, mean opacity {low:.2}…{high:.2}, {} Gaussians", after.len()))
}
