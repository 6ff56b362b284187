//! The shaders against their references: the picture of a scene, and what whole training steps make of it.
#![allow(clippy::unwrap_used, clippy::panic, reason = "a test fails by panicking")]

mod scenes;

use config::training::TrainSettings;
use models::camera::{OrthographicView, Pose, PosedImage};
use models::cloud::GaussianCloud;
use models::mask::Mask;
use scenes::device::{plain, posed, trainer};
use scenes::{answer, cloud, photo, view};
use vulkan::reference::camera::Camera;
use vulkan::reference::gaussian::{Gaussian, PARAMETERS};
use vulkan::reference::loss::Target;
use vulkan::reference::project::Limits;
use vulkan::reference::rasterise::Pixel;
use vulkan::reference::step::forward;
use vulkan::reference::trainer::ReferenceTrainer;
use vulkan::trainer::{Rendering, TrainError};

#[test]
fn the_picture_is_that_of_the_reference() {
    for (seed, n, w, h) in [(1, 1, 16, 16), (2, 30, 37, 29), (3, 300, 96, 70), (4, 60, 5, 3)] {
        let v = view(w, h);
        let c = cloud(seed, n, 3);
        let Some(mut trainer) = trainer(&c, &v, &plain()) else { return };
        let mut drawn = Rendering::default();
        trainer.render(&v, &mut drawn).unwrap();
        let expected = answer(&c, &v, &photo(seed, &v), &Default::default());
        assert_same(&format!("{n} Gaussians, {w}x{h}"), &drawn, &expected.picture);
    }
}

#[test]
fn the_orthographic_picture_is_that_of_the_reference() {
    for (seed, n, w, h) in [(2, 30, 37, 29), (3, 300, 96, 70)] {
        let v = view(w, h);
        let c = cloud(seed, n, 3);
        let Some(mut trainer) = trainer(&c, &v, &plain()) else { return };
        // As much in the picture as the perspective view shows a few metres away; pixels that are not square.
        let per_metre = f64::from(v.intrinsics.fx) / 4.0;
        let map =
            OrthographicView { width: w, height: h, pixels_per_metre: [per_metre, 1.25 * per_metre], pose: v.pose };
        let mut drawn = Rendering::default();
        trainer.render_orthographic(&map, &mut drawn).unwrap();
        let gaussians = Gaussian::<f32>::of_cloud(&c);
        let expected = forward(&gaussians, &Camera::orthographic(&map), |_| 3, |_| 1.0, &Limits::default());
        assert!(expected.picture.iter().any(|p| p.transmittance < 0.95), "something is in the picture");
        assert_same(&format!("{n} Gaussians, {w}x{h}, orthographic"), &drawn, &expected.picture);
        // The next perspective picture knows nothing of it.
        let (mut before, mut after) = (Rendering::default(), Rendering::default());
        trainer.render(&v, &mut before).unwrap();
        trainer.render_orthographic(&map, &mut after).unwrap();
        assert!(after == drawn);
        trainer.render(&v, &mut after).unwrap();
        assert!(after == before);
    }
}

#[test]
fn an_orthographic_camera_that_is_no_number_is_refused() {
    let v = view(16, 16);
    let Some(mut trainer) = trainer(&cloud(1, 3, 0), &v, &plain()) else { return };
    let good = OrthographicView { width: 16, height: 16, pixels_per_metre: [4.0; 2], pose: v.pose };
    for bad in [
        OrthographicView { width: 0, ..good },
        OrthographicView { pixels_per_metre: [4.0, f64::NAN], ..good },
        OrthographicView { pixels_per_metre: [0.0, 4.0], ..good },
        OrthographicView { pose: Pose { center: glam::DVec3::NAN, ..v.pose }, ..good },
    ] {
        let refused = trainer.render_orthographic(&bad, &mut Rendering::default());
        assert!(matches!(refused, Err(TrainError::BadView { .. })), "{bad:?}");
    }
}

/// A contribution at the cut-off may fall on the other side: one grey level, rarely.
fn assert_same(what: &str, drawn: &Rendering, expected: &[Pixel<f32>]) {
    let (mut worst, mut beyond) = (0.0f32, 0);
    for (i, p) in expected.iter().enumerate() {
        let mut error = (drawn.transmittance[i] - p.transmittance).abs();
        error = error.max((drawn.depth[i] - p.depth).abs() / 8.0);
        for k in 0..3 {
            error = error.max((drawn.rgb[3 * i + k] - p.rgb[k]).abs());
        }
        worst = worst.max(error);
        beyond += usize::from(error > 2e-4);
    }
    println!("{what}: worst {worst:.1e}, {beyond} pixels beyond 2e-4");
    assert!(worst < 1.5 / 255.0 && beyond * 50 <= expected.len(), "{what}: {worst} {beyond}");
}

#[test]
fn whole_steps_move_every_parameter_as_the_reference_does() {
    steps_follow_the_reference(None, plain());
}

#[test]
fn steps_that_weigh_the_entropy_of_opacities_move_every_parameter_as_the_reference_does() {
    let mut settings = plain();
    settings.loss.entropy = 2.0;
    steps_follow_the_reference(None, settings);
}

#[test]
fn steps_that_hold_colours_back_from_varying_move_every_parameter_as_the_reference_does() {
    let mut settings = plain();
    (settings.loss.view_dependence, settings.loss.view_dependence_visits) = (1e-3, 0);
    steps_follow_the_reference(None, settings.clone());
    // Of the degrees that are evaluated so far alone.
    settings.sh.raise_at = [0.0, 0.0, 1.0];
    steps_follow_the_reference(None, settings);
}

#[test]
fn whole_steps_on_a_masked_picture_move_every_parameter_as_the_reference_does() {
    steps_follow_the_reference(Some(Mask::from_fn(37, 29, |x, y| !(x > 9 && x < 24 && y > 4))), plain());
}

fn steps_follow_the_reference(mask: Option<Mask>, settings: TrainSettings) {
    let v = view(37, 29);
    let c = cloud(5, 40, 3);
    let photo = photo(5, &v);
    let Some(mut gpu) = trainer(&c, &v, &settings) else { return };
    gpu.add_view(&PosedImage { mask: mask.clone(), ..posed(&v, &photo) }, None).unwrap();
    let kept = mask.map(|m| (0..37 * 29).map(|i| m.keeps(i % 37, i / 37)).collect::<Vec<_>>());
    let camera = Camera::<f64>::of(&v);
    let extent = config::training::scene_extent(&c.means, &[[0.0; 3]]);
    let mut reference =
        ReferenceTrainer::new(Gaussian::<f64>::of_cloud(&c), settings.clone(), extent, Limits::default());
    let rgb: Vec<[f64; 3]> = photo.iter().map(|p| p.map(f64::from)).collect();
    let mut got = GaussianCloud::default();
    for step in 0..8u32 {
        let target = Target { width: 37, rgb: &rgb, depth: None, kept: kept.as_deref(), background: [0.0; 3] };
        let report = gpu.step().unwrap();
        let gradient = reference.step(&camera, &target, settings.progress(step, 0.0));
        let total = gradient.loss.total as f32;
        assert!((report.loss - total).abs() < 2e-4, "step {step}: loss {} against {total}", report.loss);
        gpu.snapshot(&mut got).unwrap();
        let mut far = vec![];
        for i in 0..c.len() {
            let mut g = Gaussian::<f64>::of_row(&got, i);
            let mut t = reference.cloud[i];
            let mut before = Gaussian::<f64>::of_row(&c, i);
            for k in 0..PARAMETERS {
                let (a, b, start) = (*g.parameter(k), *t.parameter(k), *before.parameter(k));
                let moved = (b - start).abs().max(1e-6);
                if (a - b).abs() > 0.1 * moved + 1e-5 {
                    far.push((i, k, a - start, b - start));
                }
            }
        }
        println!("step {step}: loss {total:.5}, {} of {} parameters differ", far.len(), c.len() * PARAMETERS);
        for f in far.iter().take(12) {
            println!("   {f:?}");
        }
        assert!(far.len() * 50 < c.len() * PARAMETERS, "step {step}: {} differ", far.len());
    }
}
