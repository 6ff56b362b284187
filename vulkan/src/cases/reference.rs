//! The cases through the CPU reference's whole step before the optimiser.
#![allow(missing_docs, reason = "their names say what they promise")]

use super::scenes::{cloud, grey, parameter, photo, view};
use super::{Outcome, Tally};
use crate::constants::COLOUR_MAX;
use crate::reference::gaussian::Gaussian;
use crate::reference::loss::pearson::pearson;
use crate::reference::loss::{Exposure, Target, loss};
use crate::reference::project::Culled;
use crate::reference::rasterise::Pixel;
use config::training::LossSettings;
use models::cloud::GaussianCloud;

const LOSS: fn() -> LossSettings = LossSettings::default;

pub fn a_row_with_nan_or_infinity_in_any_slot_is_counted_and_changes_nothing_else() -> Outcome {
    let mut counted = Tally::default();
    let v = view(21, 17);
    let base = cloud(1, 12, 3);
    let photo = photo(1, &v);
    let mut without = base.clone();
    without.retain(|i| i != 5);
    let expected = counted.ask(&without, &v, &photo, &LOSS());
    for k in 0..59 {
        for bad in [f32::NAN, f32::INFINITY, f32::NEG_INFINITY] {
            let mut c = base.clone();
            *parameter(&mut c, 5, k) = bad;
            let got = counted.ask(&c, &v, &photo, &LOSS());
            promise_eq!(got.count(Culled::NotFinite), 1, "slot {k} = {bad}");
            promise_eq!(got.picture, expected.picture, "slot {k} = {bad}");
            got.check_finite("not finite")?;
        }
    }
    Ok(counted.said())
}

pub fn denormal_and_largest_numbers_in_any_slot_leave_everything_finite() -> Outcome {
    let mut counted = Tally::default();
    let v = view(21, 17);
    let base = cloud(2, 12, 3);
    let photo = photo(2, &v);
    for k in 0..59 {
        for odd in [1e-40, -1e-40, f32::MIN_POSITIVE, f32::MAX, f32::MIN] {
            let mut c = base.clone();
            *parameter(&mut c, 5, k) = odd;
            let got = counted.ask(&c, &v, &photo, &LOSS());
            got.check_finite(&format!("slot {k} = {odd}"))?;
            promise!(got.picture.iter().all(|p| p.rgb.iter().all(|x| *x <= COLOUR_MAX * 1.001)));
        }
    }
    Ok(counted.said())
}

pub fn a_quaternion_of_length_zero_is_not_drawn_and_any_other_length_is_normalised() -> Outcome {
    let mut counted = Tally::default();
    let v = view(21, 17);
    let photo = photo(3, &v);
    let base = cloud(3, 6, 1);
    let expected = counted.ask(&base, &v, &photo, &LOSS());
    for length in [1e-6f32, 1.0, 1e6] {
        let mut c = base.clone();
        for q in &mut c.rotations {
            let norm = q.iter().map(|x| x * x).sum::<f32>().sqrt();
            *q = q.map(|x| x / norm * length);
        }
        let got = counted.ask(&c, &v, &photo, &LOSS());
        for (a, b) in got.picture.iter().zip(&expected.picture) {
            promise!((a.transmittance - b.transmittance).abs() < 1e-4, "{length}");
        }
    }
    let mut c = base;
    c.rotations[2] = [0.0; 4];
    promise_eq!(counted.ask(&c, &v, &photo, &LOSS()).count(Culled::NotFinite), 1);
    Ok(counted.said())
}

pub fn log_scales_up_to_forty_stay_visible_and_finite() -> Outcome {
    let mut counted = Tally::default();
    let v = view(21, 17);
    let photo = photo(4, &v);
    for s in [5.0f32, 10.0, 20.0, 40.0, 80.0, 88.0, 1e5] {
        let mut c = GaussianCloud::with_capacity(0, 1);
        c.push([0.0, 0.0, 5.0], [s, s - 30.0, -40.0], [0.9, 0.1, -0.3, 0.2], 0.0, &[grey(0.8); 3]);
        let got = counted.ask(&c, &v, &photo, &LOSS());
        got.check_finite("huge")?;
        promise!(got.instances > 0, "log scale {s} vanished");
    }
    let mut c = GaussianCloud::with_capacity(0, 1);
    c.push([0.0, 0.0, 5.0], [40.0; 3], [1.0, 0.0, 0.0, 0.0], 0.0, &[grey(0.8); 3]);
    let got = counted.ask(&c, &v, &photo, &LOSS());
    promise!(got.picture.iter().all(|p| (p.transmittance - 0.5).abs() < 1e-3 && (p.rgb[0] - 0.4).abs() < 1e-3));
    Ok(counted.said())
}

pub fn needles_thinner_than_f32_can_square_have_a_positive_determinant_and_no_negative_exponent() -> Outcome {
    let mut counted = Tally::default();
    let v = view(64, 48);
    let photo = photo(5, &v);
    for i in 0..200 {
        let angle = i as f32 * 0.0314;
        let mut c = GaussianCloud::with_capacity(0, 1);
        let q = [(angle * 0.5).cos(), 0.1, 0.05, (angle * 0.5).sin()];
        c.push([0.1, -0.1, 3.0], [3.0, -40.0, -40.0], q, 4.0, &[grey(0.7); 3]);
        let got = counted.ask(&c, &v, &photo, &LOSS());
        promise_eq!(got.culled[0], None);
        got.check_finite("needle")?;
        // σ < 0 would show as α above the peak opacity.
        promise!(got.picture.iter().all(|p| p.transmittance >= 1.0 - 0.9821));
    }
    Ok(counted.said())
}

pub fn a_gaussian_at_the_camera_centre_or_behind_it_is_counted_and_not_drawn() -> Outcome {
    let mut counted = Tally::default();
    let v = view(21, 17);
    let photo = photo(6, &v);
    for z in [0.0, 1e-30, -1e-30, 0.0099, -5.0] {
        let mut c = GaussianCloud::with_capacity(3, 1);
        c.push([0.0, 0.0, z], [-1.0; 3], [1.0, 0.0, 0.0, 0.0], 2.0, &[0.1; 48]);
        let got = counted.ask(&c, &v, &photo, &LOSS());
        promise_eq!(got.count(Culled::Near), 1, "{z}");
        got.check_finite("centre")?;
        promise!(got.picture.iter().all(|p| p.transmittance == 1.0));
    }
    Ok(counted.said())
}

pub fn opaque_gaussians_in_front_of_each_other_divide_by_no_zero() -> Outcome {
    let mut counted = Tally::default();
    let v = view(21, 17);
    let photo = photo(7, &v);
    let mut c = GaussianCloud::with_capacity(0, 30);
    for i in 0..30 {
        c.push([0.0, 0.0, 2.0 + i as f32 * 0.1], [4.0; 3], [1.0, 0.0, 0.0, 0.0], 80.0, &[grey(0.3); 3]);
    }
    let got = counted.ask(&c, &v, &photo, &LOSS());
    got.check_finite("opaque")?;
    promise!(got.picture.iter().all(|p| p.transmittance >= 1e-4 && p.transmittance <= 1.1e-3));
    promise!(got.gradient.gaussians.iter().all(|g| g.opacity_logit.abs() < 1.0));
    Ok(counted.said())
}

pub fn nothing_to_draw_is_a_black_picture_with_a_gradient_of_zero() -> Outcome {
    let mut counted = Tally::default();
    let v = view(21, 17);
    let photo = photo(8, &v);
    let empty = counted.ask(&GaussianCloud::with_capacity(3, 0), &v, &photo, &LOSS());
    promise!(empty.instances == 0 && empty.picture.iter().all(|p| p.transmittance == 1.0 && p.rgb == [0.0; 3]));
    let mut behind = cloud(8, 10, 2);
    behind.means.iter_mut().for_each(|m| m[2] = -m[2]);
    let got = counted.ask(&behind, &v, &photo, &LOSS());
    promise_eq!((got.instances, got.count(Culled::Near)), (0, 10));
    promise!(got.gradient.gaussians.iter().all(|g| *g == Gaussian::default()) && got.gradient.pose == [0.0; 6]);
    Ok(counted.said())
}

pub fn pictures_of_one_row_one_column_or_one_pixel_are_drawn() -> Outcome {
    let mut counted = Tally::default();
    for (w, h) in [(1, 1), (1, 17), (17, 1), (5, 3)] {
        let v = view(w, h);
        let got = counted.ask(&cloud(9, 20, 3), &v, &photo(9, &v), &LOSS());
        got.check_finite("small")?;
        promise_eq!(got.picture.len(), (w * h) as usize);
        promise!(got.picture.iter().any(|p| p.transmittance < 1.0), "{w}x{h}");
    }
    Ok(counted.said())
}

pub fn colours_up_to_the_largest_float_are_clamped_and_their_gradient_is_zero() -> Outcome {
    let mut counted = Tally::default();
    let v = view(21, 17);
    let photo = photo(10, &v);
    let mut c = cloud(10, 8, 3);
    c.sh.iter_mut().for_each(|s| *s = f32::MAX.copysign(*s));
    let got = counted.ask(&c, &v, &photo, &LOSS());
    got.check_finite("colours")?;
    for (i, g) in got.gradient.gaussians.iter().enumerate() {
        promise!(g.sh.iter().flatten().all(|s| *s == 0.0), "{i}");
    }
    Ok(counted.said())
}

pub fn duplicated_gaussians_are_drawn_in_the_order_of_their_rows() -> Outcome {
    let mut counted = Tally::default();
    let v = view(21, 17);
    let mut c = GaussianCloud::with_capacity(0, 2);
    for brightness in [1.0, 0.0] {
        c.push([0.0, 0.0, 4.0], [0.0; 3], [1.0, 0.0, 0.0, 0.0], 0.0, &[grey(brightness); 3]);
    }
    let got = counted.ask(&c, &v, &photo(11, &v), &LOSS());
    // First row in front: 0.5·1 + 0.25·0 at the peak, not 0.25.
    let peak = got.picture.iter().map(|p| p.rgb[0]).fold(0.0, f32::max);
    promise!((peak - 0.5).abs() < 0.01, "{peak}");
    Ok(counted.said())
}

pub fn the_same_scene_at_any_scale_gives_the_same_picture() -> Outcome {
    let mut counted = Tally::default();
    let v = view(21, 17);
    let photo = photo(12, &v);
    let base = cloud(12, 20, 0);
    let expected = counted.ask(&base, &v, &photo, &LOSS());
    for scale in [0.1f32, 100.0, 1e4, 1e6] {
        let mut c = base.clone();
        c.means.iter_mut().for_each(|m| *m = m.map(|x| x * scale));
        c.log_scales.iter_mut().for_each(|s| *s = s.map(|x| x + scale.ln()));
        let got = counted.ask(&c, &v, &photo, &LOSS());
        for (a, b) in got.picture.iter().zip(&expected.picture) {
            // One contribution at the cut-off may fall on the other side.
            promise!((a.transmittance - b.transmittance).abs() < 1.1 / 255.0, "{scale}: {a:?} {b:?}");
        }
    }
    Ok(counted.said())
}

fn constant_picture(value: f32, n: usize) -> Vec<Pixel<f32>> {
    vec![Pixel { rgb: [value; 3], depth: 2.0, transmittance: 0.0 }; n]
}

pub fn ssim_of_constant_pictures_has_no_negative_variance() -> Outcome {
    let counted = Tally::default();
    for (x, y) in [(0.0, 0.0), (1.0, 1.0), (0.3, 0.7), (0.999, 0.9991), (1000.0, 1.0)] {
        let truth = vec![[y; 3]; 25 * 15];
        let target = Target { width: 25, rgb: &truth, depth: None, kept: None, background: [0.0; 3] };
        let l = loss(&constant_picture(x, 25 * 15), &target, &Exposure::default(), &LOSS());
        promise!(l.total.is_finite() && l.ssim <= 1.0 + 1e-5 && l.ssim >= -1.0, "{x} {y}: {}", l.ssim);
        promise!(l.gradient.iter().all(|p| p.rgb.iter().all(|g| g.is_finite())));
        if x == y {
            promise!((l.ssim - 1.0).abs() < 1e-5 && l.l1 == 0.0);
        }
    }
    Ok(counted.said())
}

pub fn pearson_of_constant_depth_or_an_empty_mask_has_value_and_gradient_zero() -> Outcome {
    let counted = Tally::default();
    let ramp: Vec<f32> = (0..50).map(|i| i as f32 / 50.0).collect();
    let (sure, unsure) = (vec![1.0f32; 50], vec![0.0f32; 50]);
    let mut two = unsure.clone();
    two[..2].fill(1.0);
    let nan = vec![f32::NAN; 50];
    for (case, depth, prior, confidence) in [
        ("constant rendering", &vec![3.0; 50], &ramp, &sure),
        ("constant prior", &ramp, &vec![0.4; 50], &sure),
        ("empty mask", &ramp, &ramp, &unsure),
        ("two pixels", &ramp, &ramp, &two),
        ("prior not a number", &ramp, &nan, &sure),
        ("nothing rendered", &vec![0.0; 50], &ramp, &sure),
    ] {
        let (rho, gradient) = pearson(depth, prior, confidence, 0.1);
        promise!(rho == 0.0 && gradient.iter().all(|g| *g == 0.0), "{case}: {rho}");
    }
    let (rho, gradient) = pearson(&ramp.iter().map(|d| 5.0 + 3.0 * d).collect::<Vec<_>>(), &ramp, &sure, 0.1);
    promise!((rho - 1.0).abs() < 1e-5 && gradient.iter().all(|g| g.abs() < 1e-5));
    Ok(counted.said())
}

pub fn exposure_against_a_black_photograph_stays_finite() -> Outcome {
    let counted = Tally::default();
    let truth = vec![[0.0f32; 3]; 9 * 9];
    let target = Target { width: 9, rgb: &truth, depth: None, kept: None, background: [0.0; 3] };
    for gain in [-80.0f32, 0.0, 5.0] {
        let exposure = Exposure { log_gain: [gain; 3], offset: [0.0; 3] };
        let l = loss(&constant_picture(0.0, 81), &target, &exposure, &LOSS());
        promise!(l.total.is_finite() && l.exposure.log_gain == [0.0; 3]);
        promise!(l.exposure.offset.iter().all(|v| v.is_finite()));
    }
    Ok(counted.said())
}
