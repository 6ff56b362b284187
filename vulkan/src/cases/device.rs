//! The cases on the device, through whole training steps.
#![allow(missing_docs, reason = "their names say what they promise")]

use super::scenes::{answer, cloud, empty_trainer, grey, parameter, photo, plain, posed, trainer, view};
use super::{Broken, Outcome, Tally};
use crate::constants::COLOUR_MAX;
use crate::fixture::Fixture;
use crate::gpu::Gpu;
use crate::trainer::{Rendering, RunBudget, StepReport, TrainError};
use config::training::{Strategy, TrainSettings};
use models::camera::{DepthPrior, View};
use models::cloud::GaussianCloud;
use std::ops::ControlFlow;

/// Loads, renders and trains `steps` steps; everything that comes back must be finite.
pub(super) fn survive(
    counted: &mut Tally,
    t: &mut Fixture,
    c: &GaussianCloud,
    v: &View,
    case: &str,
) -> Result<(Rendering, StepReport), Broken> {
    t.load(c)?;
    let mut drawn = Rendering::default();
    t.render(v, &mut drawn)?;
    let all = drawn.rgb.iter().chain(&drawn.depth).chain(&drawn.transmittance);
    promise!(all.into_iter().all(|x| x.is_finite()), "{case}: picture");
    let mut report = t.step()?;
    for _ in 0..2 {
        report = t.step()?;
    }
    promise!(report.loss.is_finite(), "{case}: loss");
    let mut after = GaussianCloud::default();
    t.snapshot(&mut after)?;
    promise_eq!(after.len(), c.len(), "{case}");
    promise!((0..after.len()).all(|i| after.is_valid(i)), "{case}: a row went bad");
    counted.scene(3, report.visible, report.instances);
    Ok((drawn, report))
}

/// Room for 256 Gaussians of `degree` and one photograph from `v`.
pub(super) fn ready(gpu: &Gpu, degree: u8, v: &View, settings: &TrainSettings) -> Result<Fixture, Broken> {
    let mut t = empty_trainer(gpu, degree, 256, v, settings)?;
    t.add_view(&posed(v, &photo(1, v)), None)?;
    Ok(t)
}

pub fn a_row_with_nan_or_infinity_in_any_slot_is_dropped_and_counted_at_load(gpu: &Gpu) -> Outcome {
    let counted = Tally::default();
    let v = view(21, 17);
    let base = cloud(1, 12, 3);
    let mut t = ready(gpu, 3, &v, &plain())?;
    for k in 0..59 {
        for bad in [f32::NAN, f32::INFINITY, f32::NEG_INFINITY] {
            let mut c = base.clone();
            *parameter(&mut c, 5, k) = bad;
            let report = t.load(&c)?;
            promise_eq!((report.loaded, report.dropped_non_finite), (11, 1), "slot {k} = {bad}");
        }
    }
    let mut none = base;
    none.means.iter_mut().for_each(|m| m[0] = f32::NAN);
    promise_eq!(t.load(&none).err(), Some(TrainError::Empty { non_finite: 12 }));
    Ok(counted.said())
}

pub fn denormal_and_largest_numbers_in_any_slot_leave_everything_finite(gpu: &Gpu) -> Outcome {
    let mut counted = Tally::default();
    let v = view(21, 17);
    let base = cloud(2, 12, 3);
    let mut t = ready(gpu, 3, &v, &plain())?;
    // Every kind of slot; the SH coefficients of one degree behave alike.
    for k in [0, 1, 2, 3, 4, 5, 10, 11, 12, 14, 23, 38, 58] {
        for odd in [1e-40, f32::MIN_POSITIVE, f32::MAX, f32::MIN] {
            let mut c = base.clone();
            *parameter(&mut c, 5, k) = odd;
            let (drawn, _) = survive(&mut counted, &mut t, &c, &v, &format!("slot {k} = {odd}"))?;
            promise!(drawn.rgb.iter().all(|x| *x <= COLOUR_MAX * 1.001));
        }
    }
    Ok(counted.said())
}

pub fn log_scales_up_to_forty_stay_visible(gpu: &Gpu) -> Outcome {
    let mut counted = Tally::default();
    let v = view(21, 17);
    let mut t = ready(gpu, 0, &v, &plain())?;
    for s in [5.0f32, 10.0, 20.0, 40.0, 80.0, 88.0, 1e5] {
        let mut c = GaussianCloud::with_capacity(0, 1);
        c.push([0.0, 0.0, 5.0], [s, s - 30.0, -40.0], [0.9, 0.1, -0.3, 0.2], 0.0, &[grey(0.8); 3]);
        let (_, report) = survive(&mut counted, &mut t, &c, &v, &format!("log scale {s}"))?;
        promise!(report.visible == 1 && report.instances > 0, "log scale {s} vanished");
    }
    let mut c = GaussianCloud::with_capacity(0, 1);
    c.push([0.0, 0.0, 5.0], [40.0; 3], [1.0, 0.0, 0.0, 0.0], 0.0, &[grey(0.8); 3]);
    let (drawn, _) = survive(&mut counted, &mut t, &c, &v, "log scale 40")?;
    promise!(drawn.transmittance.iter().all(|x| (x - 0.5).abs() < 1e-3));
    promise!(drawn.rgb.iter().all(|x| (x - 0.4).abs() < 1e-3));
    Ok(counted.said())
}

pub fn needles_have_a_positive_determinant_and_never_more_than_their_peak_opacity(gpu: &Gpu) -> Outcome {
    let mut counted = Tally::default();
    let v = view(64, 48);
    let mut t = ready(gpu, 0, &v, &plain())?;
    for i in 0..20 {
        let angle = i as f32 * 0.314;
        let mut c = GaussianCloud::with_capacity(0, 1);
        let q = [(angle * 0.5).cos(), 0.1, 0.05, (angle * 0.5).sin()];
        c.push([0.1, -0.1, 3.0], [3.0, -40.0, -40.0], q, 4.0, &[grey(0.7); 3]);
        let (drawn, report) = survive(&mut counted, &mut t, &c, &v, "needle")?;
        promise_eq!(report.visible, 1);
        promise!(drawn.transmittance.iter().all(|x| *x >= 1.0 - 0.9821));
    }
    Ok(counted.said())
}

pub fn at_the_camera_centre_or_behind_nothing_is_drawn_and_the_step_still_ends(gpu: &Gpu) -> Outcome {
    let mut counted = Tally::default();
    let v = view(21, 17);
    let mut t = ready(gpu, 3, &v, &plain())?;
    for z in [0.0, 1e-30, -1e-30, 0.0099, -5.0] {
        let mut c = GaussianCloud::with_capacity(3, 1);
        c.push([0.0, 0.0, z], [-1.0; 3], [1.0, 0.0, 0.0, 0.0], 2.0, &[0.1; 48]);
        let (drawn, report) = survive(&mut counted, &mut t, &c, &v, &format!("depth {z}"))?;
        promise_eq!((report.visible, report.instances), (0, 0), "{z}");
        promise!(drawn.transmittance.iter().all(|x| *x == 1.0) && drawn.rgb.iter().all(|x| *x == 0.0));
        let mut after = GaussianCloud::default();
        t.snapshot(&mut after)?;
        promise_eq!(after, c, "a step that saw nothing moved something");
    }
    Ok(counted.said())
}

pub fn opaque_gaussians_in_front_of_each_other_divide_by_no_zero(gpu: &Gpu) -> Outcome {
    let mut counted = Tally::default();
    let v = view(21, 17);
    let mut t = ready(gpu, 0, &v, &plain())?;
    let mut c = GaussianCloud::with_capacity(0, 30);
    for i in 0..30 {
        c.push([0.0, 0.0, 2.0 + i as f32 * 0.1], [4.0; 3], [1.0, 0.0, 0.0, 0.0], 80.0, &[grey(0.3); 3]);
    }
    let (drawn, _) = survive(&mut counted, &mut t, &c, &v, "opaque")?;
    promise!(drawn.transmittance.iter().all(|x| (1e-4..=1.1e-3).contains(x)));
    Ok(counted.said())
}

pub fn pictures_of_one_row_one_column_or_one_pixel_are_those_of_the_reference(gpu: &Gpu) -> Outcome {
    let mut counted = Tally::default();
    for (w, h) in [(1, 1), (1, 17), (17, 1)] {
        let v = view(w, h);
        let mut t = ready(gpu, 3, &v, &plain())?;
        let c = cloud(9, 20, 3);
        let (drawn, _) = survive(&mut counted, &mut t, &c, &v, &format!("{w}x{h}"))?;
        let expected = answer(&c, &v, &photo(1, &v), &Default::default());
        for (i, p) in expected.picture.iter().enumerate() {
            promise!((drawn.transmittance[i] - p.transmittance).abs() < 1.0 / 255.0, "{w}x{h}");
        }
    }
    Ok(counted.said())
}

pub fn colours_up_to_the_largest_float_are_clamped(gpu: &Gpu) -> Outcome {
    let mut counted = Tally::default();
    let v = view(21, 17);
    let mut t = ready(gpu, 3, &v, &plain())?;
    let mut c = cloud(10, 8, 3);
    c.sh.iter_mut().for_each(|s| *s = f32::MAX.copysign(*s));
    survive(&mut counted, &mut t, &c, &v, "largest colours")?;
    Ok(counted.said())
}

pub fn the_same_scene_at_any_scale_gives_the_same_picture(gpu: &Gpu) -> Outcome {
    let mut counted = Tally::default();
    let v = view(21, 17);
    let mut t = ready(gpu, 0, &v, &plain())?;
    let base = cloud(12, 20, 0);
    let (expected, _) = survive(&mut counted, &mut t, &base, &v, "scale 1")?;
    for scale in [0.1f32, 100.0, 1e4, 1e6] {
        let mut c = base.clone();
        c.means.iter_mut().for_each(|m| *m = m.map(|x| x * scale));
        c.log_scales.iter_mut().for_each(|s| *s = s.map(|x| x + scale.ln()));
        let (got, _) = survive(&mut counted, &mut t, &c, &v, &format!("scale {scale}"))?;
        for (a, b) in got.transmittance.iter().zip(&expected.transmittance) {
            promise!((a - b).abs() < 1.1 / 255.0, "{scale}: {a} {b}");
        }
    }
    Ok(counted.said())
}

pub fn a_black_photograph_of_nothing_has_loss_zero_and_exposure_stays_finite(gpu: &Gpu) -> Outcome {
    let counted = Tally::default();
    let v = view(21, 17);
    let settings = TrainSettings { refine_exposure: true, refine_poses: true, ..plain() };
    let mut t = empty_trainer(gpu, 0, 256, &v, &settings)?;
    t.add_view(&posed(&v, &vec![[0.0; 3]; 21 * 17]), None)?;
    let mut behind = cloud(8, 10, 0);
    behind.means.iter_mut().for_each(|m| m[2] = -m[2]);
    t.load(&behind)?;
    for _ in 0..5 {
        let report = t.step()?;
        promise!(report.l1 == 0.0 && (report.ssim - 1.0).abs() < 1e-5 && report.loss.abs() < 1e-5, "{report:?}");
    }
    // Something bright against black: gain and offset move, and nothing overflows.
    t.load(&cloud(8, 10, 0))?;
    for _ in 0..20 {
        promise!(t.step()?.loss.is_finite());
    }
    let pose = t.pictures.view(0).ok_or(TrainError::NoViews)?.pose;
    promise!(pose.center.is_finite() && pose.rotation.is_finite());
    Ok(counted.said())
}

pub fn a_depth_prior_that_says_nothing_has_no_correlation(gpu: &Gpu) -> Outcome {
    let counted = Tally::default();
    let v = view(21, 17);
    let n = 21 * 17;
    let ramp: Vec<f32> = (0..n).map(|i| 3.0 + (i % 21) as f32).collect();
    let mut two = vec![0.0; n];
    two[..2].fill(1.0);
    for (case, depth, confidence, useful) in [
        ("constant prior", vec![4.0; n], vec![1.0; n], false),
        ("empty mask", ramp.clone(), vec![0.0; n], false),
        ("two pixels", ramp.clone(), two, false),
        ("not a number", vec![f32::NAN; n], vec![1.0; n], false),
        ("ramp", ramp.clone(), vec![1.0; n], true),
    ] {
        let mut t = empty_trainer(gpu, 0, 256, &v, &plain())?;
        let prior = DepthPrior { width: 21, height: 17, depth, confidence };
        t.add_view(&posed(&v, &photo(1, &v)), Some(&prior))?;
        t.load(&cloud(3, 40, 0))?;
        let report = t.step()?;
        promise_eq!(report.depth_correlation.is_some(), useful, "{case}");
        promise!(report.loss.is_finite(), "{case}");
        let mut after = GaussianCloud::default();
        t.snapshot(&mut after)?;
        promise!((0..after.len()).all(|i| after.is_valid(i)), "{case}");
    }
    Ok(counted.said())
}

pub fn poses_that_are_not_finite_are_refused_and_a_flipped_one_sees_nothing(gpu: &Gpu) -> Outcome {
    let counted = Tally::default();
    let v = view(21, 17);
    let mut t = trainer(gpu, &cloud(4, 20, 1), &v, &plain())?;
    let mut bad = posed(&v, &photo(1, &v));
    bad.view.pose.center.x = f64::NAN;
    promise!(matches!(t.add_view(&bad, None), Err(TrainError::BadView { .. })));
    bad.view.pose.center.x = 0.0;
    bad.view.pose.rotation = glam::DQuat::from_xyzw(0.0, 0.0, 0.0, 0.0);
    promise!(matches!(t.add_view(&bad, None), Err(TrainError::BadView { .. })));
    bad.view.pose.rotation = glam::DQuat::from_rotation_y(std::f64::consts::PI);
    t.add_view(&bad, None)?;
    promise_eq!(t.step()?.visible, 0);
    Ok(counted.said())
}

pub fn relocation_survives_all_dead_none_dead_and_fully_opaque(gpu: &Gpu) -> Outcome {
    let counted = Tally::default();
    let v = view(21, 17);
    let mut settings = plain();
    settings.density.strategy = Strategy::Relocate;
    settings.density.every = 1;
    settings.density.growth = 0.0;
    let mut t = ready(gpu, 0, &v, &settings)?;
    let few = RunBudget { steps: Some(4), seconds: None };
    for (case, logit, dead) in [("all dead", -20.0, 30), ("none dead", 0.0, 0), ("opaque", 80.0, 0), ("some", 3.0, 7)] {
        let mut c = cloud(6, 30, 0);
        c.opacity_logits.fill(logit);
        c.opacity_logits[..dead].fill(-20.0);
        t.load(&c)?;
        let summary = t.run(&few, &mut |_| ControlFlow::Continue(()))?;
        let mut after = GaussianCloud::default();
        t.snapshot(&mut after)?;
        promise!(summary.gaussians == 30 && (0..30).all(|i| after.is_valid(i)), "{case}");
        let expected = if dead == 7 { 7 } else { 0 };
        promise_eq!(summary.counters.relocated, expected, "{case}");
    }
    Ok(counted.said())
}

pub fn growth_fills_the_plan_and_stops_there(gpu: &Gpu) -> Outcome {
    let counted = Tally::default();
    let v = view(21, 17);
    let mut settings = plain();
    settings.density.strategy = Strategy::Relocate;
    settings.density.every = 1;
    settings.density.growth = 0.9;
    let mut t = ready(gpu, 0, &v, &settings)?;
    t.load(&cloud(6, 200, 0))?;
    let summary = t.run(&RunBudget { steps: Some(6), seconds: None }, &mut |_| ControlFlow::Continue(()))?;
    promise_eq!((summary.gaussians, summary.counters.added), (256, 56));
    Ok(counted.said())
}
