//! Every Gaussian has its own SH degree: it is drawn, differentiated and stepped with that many coefficients, and gets
//! more where the views disagree on its colour.
#![allow(clippy::unwrap_used, clippy::panic, reason = "a test fails by panicking")]

mod scenes;

use config::training::{ShSettings, TrainSettings};
use models::cloud::{GaussianCloud, sh_coefficients};
use scenes::device::{empty_trainer, plain, posed, trainer};
use scenes::{cloud, photo, view};
use std::ops::ControlFlow;
use vulkan::reference::camera::Camera;
use vulkan::reference::gaussian::Gaussian;
use vulkan::reference::loss::{Exposure, Target};
use vulkan::reference::project::Limits;
use vulkan::reference::step::{backward, forward};
use vulkan::trainer::{Rendering, RunBudget};

/// Rows of degree 0, 1, 2, 3, 0, 1, …: what is above is zero.
fn mixed(n: usize) -> GaussianCloud {
    let mut c = cloud(7, n, 3);
    let stride = c.sh_stride();
    for (i, sh) in c.sh.chunks_exact_mut(stride).enumerate() {
        sh[3 * sh_coefficients(own(i))..].fill(0.0);
    }
    c
}

fn own(row: usize) -> u8 {
    (row % 4) as u8
}

/// Degrees raised by residual, from what the rows have.
fn by_residual(share: f32) -> TrainSettings {
    TrainSettings { sh: ShSettings { raise_share: share, ..plain().sh }, ..plain() }
}

#[test]
fn gaussians_of_mixed_degrees_are_drawn_and_differentiated_as_their_references() {
    let (c, v) = (mixed(200), view(48, 36));
    let Some(mut t) = trainer(&c, &v, &by_residual(0.25)) else { return };
    let photo = photo(3, &v);
    t.add_view(&posed(&v, &photo), None).unwrap();
    let mut shown = Rendering::default();
    t.render(&v, &mut shown).unwrap();
    let mut gradient = GaussianCloud::default();
    t.gradient(0, &mut gradient).unwrap();

    let (gaussians, camera, limits) = (Gaussian::<f32>::of_cloud(&c), Camera::<f32>::of(&v), Limits::default());
    let all = |_: usize| 1.0;
    let reference = forward(&gaussians, &camera, own, all, &limits);
    let target = Target { width: 48, rgb: &photo, depth: None, kept: None, background: [0.0; 3] };
    let settings = plain().loss;
    let slopes = backward(&gaussians, &camera, own, all, &limits, &reference, &target, &Exposure::default(), &settings);
    for (at, p) in reference.picture.iter().enumerate() {
        for k in 0..3 {
            assert!((shown.rgb[3 * at + k] - p.rgb[k]).abs() < 1e-4, "pixel {at}");
        }
    }
    let stride = c.sh_stride();
    let largest = slopes.gaussians.iter().flat_map(|g| g.sh.as_flattened()).fold(0.0f32, |m, g| m.max(g.abs()));
    for (row, g) in slopes.gaussians.iter().enumerate() {
        let device = &gradient.sh[row * stride..(row + 1) * stride];
        assert!(device[3 * sh_coefficients(own(row))..].iter().all(|d| *d == 0.0), "row {row}");
        for (d, t) in device.iter().zip(g.sh.as_flattened()) {
            assert!((d - t).abs() < 1e-3 * largest, "row {row}: {d} {t}");
        }
    }
}

#[test]
fn training_touches_no_coefficient_above_the_own_degree_before_the_residual_asks() {
    let (c, v) = (mixed(120), view(48, 36));
    let Some(mut t) = trainer(&c, &v, &by_residual(0.25)) else { return };
    t.add_view(&posed(&v, &photo(4, &v)), None).unwrap();
    let mut last = None;
    // The first occasion is at a twentieth of the schedule's 1,000 steps.
    for _ in 0..12 {
        last = Some(t.step().unwrap());
    }
    assert!(last.unwrap().progress < 0.05);
    let mut after = GaussianCloud::default();
    t.snapshot(&mut after).unwrap();
    let stride = c.sh_stride();
    let mut moved = 0;
    for row in 0..after.len() {
        let sh = &after.sh[row * stride..(row + 1) * stride];
        assert!(sh[3 * sh_coefficients(own(row))..].iter().all(|s| *s == 0.0), "row {row}");
        moved += usize::from(sh != &c.sh[row * stride..(row + 1) * stride]);
    }
    assert!(moved > 60, "{moved}");
}

/// Two cameras see the same Gaussians; the left half of the scene looks the same to both, the right half does not.
#[test]
fn the_degree_is_raised_where_the_views_disagree() {
    let (left, mut right) = (view(64, 48), view(64, 48));
    right.pose.center.x = 3.0;
    right.pose.rotation = glam::DQuat::from_rotation_y(-0.55);
    let mut c = GaussianCloud::with_capacity(3, 0);
    let grid = |k: i32| k as f32 * 0.25;
    for (x, y) in (-8..8).flat_map(|x| (-5..6).map(move |y| (x, y))) {
        c.push([grid(x) + 0.12, grid(y), 5.0], [-2.0, -2.0, -4.0], [1.0, 0.0, 0.0, 0.0], 3.0, &[0.0; 48]);
    }
    let Some(mut t) = empty_trainer(3, 256, &left, &by_residual(0.3)) else { return };
    t.load(&c).unwrap();
    // Grey everywhere, but where a pixel's ray meets the right half the two cameras see black and white.
    let seen = |v: &models::camera::View, shade: f32| -> Vec<[f32; 3]> {
        let (rotation, translation) = v.pose.world_to_camera();
        let back = rotation.conjugate();
        let k = v.intrinsics;
        (0..k.pixels())
            .map(|i| {
                let (px, py) = ((i as u32 % k.width) as f32 + 0.5, (i as u32 / k.width) as f32 + 0.5);
                let ray = back * glam::Vec3::new((px - k.cx) / k.fx, (py - k.cy) / k.fy, 1.0);
                let from = back * -translation;
                let x = from.x + ray.x * (5.0 - from.z) / ray.z;
                [if x > 0.0 { shade } else { 0.5 }; 3]
            })
            .collect()
    };
    t.add_view(&posed(&left, &seen(&left, 0.1)), None).unwrap();
    t.add_view(&posed(&right, &seen(&right, 0.9)), None).unwrap();
    let budget = RunBudget { steps: Some(120), seconds: None };
    let raised = t.run(&budget, &mut |_| ControlFlow::Continue(())).unwrap().counters.sh_raised;
    let mut after = GaussianCloud::default();
    t.snapshot(&mut after).unwrap();
    let stride = after.sh_stride();
    let has = |row: usize| after.sh[row * stride + 3..(row + 1) * stride].iter().any(|s| *s != 0.0);
    let asked = (0..c.len()).filter(|i| c.means[*i][0] > 0.3 && has(*i)).count();
    let quiet = (0..c.len()).filter(|i| c.means[*i][0] < -0.3 && has(*i)).count();
    assert!(raised > 50, "{raised}");
    assert!(asked > 2 * quiet, "{asked} on the side that changes, {quiet} on the other");
}

#[test]
fn without_a_share_every_gaussian_has_every_coefficient_from_the_first_step() {
    let (c, v) = (mixed(120), view(48, 36));
    let Some(mut t) = trainer(&c, &v, &plain()) else { return };
    t.add_view(&posed(&v, &photo(4, &v)), None).unwrap();
    let budget = RunBudget { steps: Some(3), seconds: None };
    let counters = t.run(&budget, &mut |_| ControlFlow::Continue(())).unwrap().counters;
    assert_eq!((counters.sh_raised, counters.sh_missing), (0, 0));
    let mut after = GaussianCloud::default();
    t.snapshot(&mut after).unwrap();
    let stride = after.sh_stride();
    let full = after.sh.chunks_exact(stride).filter(|sh| sh[45..].iter().any(|s| *s != 0.0)).count();
    assert!(full > 80, "{full}");
}
