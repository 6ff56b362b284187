//! Skipped work is work that changes nothing: with a skip switched off the trained Gaussians stay the same, and more is
//! counted.
#![allow(clippy::unwrap_used, clippy::panic, reason = "a test fails by panicking")]

mod scenes;

use config::training::{SkipSettings, TrainSettings};
use models::cloud::GaussianCloud;
use scenes::device::{empty_trainer, plain, posed};
use scenes::{cloud, photo, view};
use std::ops::ControlFlow;
use vulkan::trainer::{Counters, RunBudget};

/// A crowd in front of the camera, opaque in the middle, partly outside, partly invisible.
fn crowd() -> GaussianCloud {
    let mut c = cloud(31, 300, 1);
    for i in 0..300 {
        match i % 5 {
            0 => c.means[i][0] += 3.0 * c.means[i][2],
            1 => c.opacity_logits[i] = -9.0,
            2 => (c.opacity_logits[i], c.log_scales[i]) = (6.0, [-1.0; 3]),
            _ => {}
        }
    }
    c
}

/// Gaussians and counters after eight steps, and the visible ones of the first.
fn train(skips: SkipSettings) -> Option<(GaussianCloud, Counters, usize)> {
    let v = view(64, 48);
    let settings = TrainSettings { skips, ..plain() };
    let mut t = empty_trainer(1, 300, &v, &settings)?;
    t.load(&crowd()).unwrap();
    let mut turned = posed(&v, &photo(2, &v));
    turned.view.pose.rotation = glam::DQuat::from_rotation_y(0.3);
    t.add_view(&posed(&v, &photo(1, &v)), None).unwrap();
    t.add_view(&turned, None).unwrap();
    let mut visible = 0;
    let summary = t
        .run(&RunBudget { steps: Some(8), seconds: None }, &mut |r| {
            visible = visible.max(r.visible);
            ControlFlow::Continue(())
        })
        .unwrap();
    let mut after = GaussianCloud::default();
    t.snapshot(&mut after).unwrap();
    Some((after, summary.counters, visible))
}

fn furthest(a: &GaussianCloud, b: &GaussianCloud) -> f32 {
    let all = |c: &GaussianCloud| -> Vec<f32> {
        let geometry = c.means.as_flattened().iter().chain(c.log_scales.as_flattened());
        geometry.chain(c.rotations.as_flattened()).chain(&c.opacity_logits).chain(&c.sh).copied().collect()
    };
    all(a).iter().zip(all(b)).map(|(x, y)| (x - y).abs()).fold(0.0, f32::max)
}

#[test]
fn a_skip_switched_off_costs_work_and_changes_no_gaussian() {
    let on = SkipSettings::default();
    let Some((expected, counted, visible)) = train(on) else { return };
    let (got, c, _) = train(SkipSettings { exact_tiles: false, ..on }).unwrap();
    assert!(got == expected && c.instances > counted.instances, "exact tiles");
    let (got, c, _) = train(SkipSettings { early_end: false, ..on }).unwrap();
    assert!(got == expected && c.evaluations > counted.evaluations && c.behind_opaque == 0, "early end");
    assert!(counted.behind_opaque > 0);
    // What differs is rounding alone, which Adam's normalisation enlarges where a gradient is nearly zero.
    let moved = furthest(&crowd(), &expected);
    for (name, skips) in
        [("frustum", SkipSettings { frustum: false, ..on }), ("opacity", SkipSettings { opacity: false, ..on })]
    {
        let (got, _, more) = train(skips).unwrap();
        let error = furthest(&got, &expected);
        println!("{name}: {more} visible instead of {visible}, {error:.1e} apart, moved {moved:.1e}");
        assert!(more > visible && error < 1e-3 * moved, "{name}: {error}");
    }
    let (got, c, _) = train(SkipSettings { deferred_moments: false, ..on }).unwrap();
    let error = furthest(&got, &expected);
    println!("deferred moments: {error:.1e} apart");
    assert!(error < 1e-3 * moved && c.instances == counted.instances, "deferred moments: {error}");
}
