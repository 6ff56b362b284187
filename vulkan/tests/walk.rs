//! A lane's share of instances may exceed what llvmpipe lets one invocation loop over (65,535 iterations): none is lost.
#![allow(clippy::unwrap_used, clippy::panic, reason = "a test fails by panicking")]

mod scenes;

use config::plan::{Plan, PlanRequest};
use models::cloud::GaussianCloud;
use scenes::device::{plain, posed};
use scenes::{grey, photo, view};
use vulkan::fixture::Fixture;
use vulkan::gpu::Gpu;

#[test]
fn every_tile_of_every_giant_is_counted_and_emitted() {
    let gpu = match Gpu::open(None) {
        Ok(gpu) => gpu,
        Err(e) => return needs::missing(needs::Need::Vulkan, e),
    };
    // 3,000 Gaussians that cover all 800 tiles: 75,000 instances per sorting lane.
    let (side, count) = (160, 3000);
    let v = view(side, side);
    let mut cloud = GaussianCloud::with_capacity(0, count);
    for i in 0..count {
        let z = 4.0 + i as f32 * 1e-3;
        cloud.push([0.0, 0.0, z], [3.0; 3], [1.0, 0.0, 0.0, 0.0], -4.6, &[grey(i as f32 / count as f32); 3]);
    }
    let request = PlanRequest {
        device_mib: 64,
        width: side,
        height: side,
        views: 1,
        sh_degree: 0,
        max_gaussians: None,
        scene_gaussians: None,
        ..Default::default()
    };
    let mut pictures = Vec::new();
    for instances in [1 << 19, 2_796_202] {
        let mut t = Fixture::new(&gpu, &Plan::with_capacities(&request, count, instances), &plain()).unwrap();
        t.load(&cloud).unwrap();
        t.add_view(&posed(&v, &photo(1, &v)), None).unwrap();
        let report = t.step().unwrap();
        assert_eq!(report.instances, count as u64 * u64::from(side / 8) * u64::from(side / 4));
        let mut after = GaussianCloud::default();
        t.snapshot(&mut after).unwrap();
        pictures.push((report.loss.to_bits(), after));
    }
    assert!(pictures[0] == pictures[1], "bands and one pass differ");
}
