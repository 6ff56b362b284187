//! Promises that only show with many Gaussians: software drivers bound the loops of one invocation.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic)] // a test may

use config::plan::{Plan, PlanRequest};
use config::training::TrainSettings;
use glam::{DQuat, DVec3};
use models::camera::{Intrinsics, Pose, View};
use models::cloud::GaussianCloud;
use vulkan::fixture::Fixture;
use vulkan::gpu::Gpu;
use vulkan::trainer::Rendering;

/// A carpet of small opaque Gaussians that fills a 640×480 view, seen at a slant so that all depths differ.
fn carpet(columns: usize, rows: usize) -> GaussianCloud {
    let mut cloud = GaussianCloud::with_capacity(0, columns * rows);
    for r in 0..rows {
        for c in 0..columns {
            let x = (c as f32 + 0.5) / columns as f32 * 80.0 - 40.0;
            let y = (r as f32 + 0.5) / rows as f32 * 60.0 - 30.0;
            let sigma = (80.0 / columns as f32).ln();
            cloud.push([x, y, 0.02 * y], [sigma; 3], [1.0, 0.0, 0.0, 0.0], 4.0, &[1.0, 0.5, 0.0]);
        }
    }
    cloud
}

#[test]
fn a_view_of_a_hundred_and_twenty_thousand_gaussians_has_no_holes() {
    let Ok(gpu) = Gpu::open(None) else {
        needs::missing(needs::Need::Vulkan, "no Vulkan device (install mesa-vulkan-drivers)");
        return;
    };
    let cloud = carpet(400, 300);
    let request = PlanRequest {
        device_mib: 1024,
        width: 640,
        height: 480,
        views: 0,
        sh_degree: 0,
        max_gaussians: Some(cloud.len()),
        scene_gaussians: None,
        ..Default::default()
    };
    let mut settings = TrainSettings::default();
    settings.sh.degree = 0;
    let mut trainer = Fixture::new(&gpu, &Plan::new(&request).unwrap(), &settings).unwrap();
    trainer.load(&cloud).unwrap();
    let intrinsics = Intrinsics { width: 640, height: 480, fx: 320.0, fy: 320.0, cx: 320.0, cy: 240.0 };
    // Looking straight down from 40 m: the carpet reaches the picture's edges.
    let pose = Pose { rotation: DQuat::from_xyzw(1.0, 0.0, 0.0, 0.0), center: DVec3::new(0.0, 0.0, 40.0) };
    let mut rendering = Rendering::default();
    trainer.render(&View { intrinsics, pose }, &mut rendering).unwrap();
    let holes = (0..480usize)
        .flat_map(|y| (0..640usize).map(move |x| (x, y)))
        .filter(|(x, y)| (8..632).contains(x) && (8..472).contains(y))
        .filter(|(x, y)| rendering.transmittance[y * 640 + x] > 0.05)
        .count();
    assert_eq!(holes, 0, "{holes} pixels can be seen through");
}
