//! More instances than planned, and the same bits all the same: pictures and training through several bands equal those of a
//! plan that holds everything; two runs with one seed are identical.
#![allow(clippy::unwrap_used, clippy::panic, reason = "a test fails by panicking")]

mod scenes;

use config::plan::{Plan, PlanRequest};
use models::cloud::GaussianCloud;
use scenes::device::{plain, posed};
use scenes::{cloud, photo, view};
use vulkan::fixture::Fixture;
use vulkan::gpu::Gpu;
use vulkan::trainer::Rendering;

const SIZE: [u32; 2] = [96, 70];

/// Picture, cloud after ten steps, and the most bands a step needed.
fn train(gpu: &Gpu, instances: usize) -> (Rendering, GaussianCloud, usize) {
    let v = view(SIZE[0], SIZE[1]);
    let request = PlanRequest {
        device_mib: 64,
        width: SIZE[0],
        height: SIZE[1],
        views: 2,
        sh_degree: 2,
        max_gaussians: None,
        scene_gaussians: None,
        ..Default::default()
    };
    let plan = Plan::with_capacities(&request, 300, instances);
    let mut t = Fixture::new(gpu, &plan, &plain()).unwrap();
    t.load(&cloud(21, 300, 2)).unwrap();
    for seed in [1, 2] {
        t.add_view(&posed(&v, &photo(seed, &v)), None).unwrap();
    }
    let mut drawn = Rendering::default();
    t.render(&v, &mut drawn).unwrap();
    let bands = (0..10).map(|_| t.step().unwrap().bands).max().unwrap_or(0);
    let mut after = GaussianCloud::default();
    t.snapshot(&mut after).unwrap();
    (drawn, after, bands)
}

#[test]
fn instances_beyond_the_plan_are_blended_in_bands_with_identical_bits() {
    let gpu = match Gpu::open(None) {
        Ok(gpu) => gpu,
        Err(e) => return needs::missing(needs::Need::Vulkan, e),
    };
    let (picture, trained, bands) = train(&gpu, 1 << 20);
    assert_eq!(bands, 1);
    let (again, trained_again, _) = train(&gpu, 1 << 20);
    assert!(picture == again && trained == trained_again, "two runs with one seed differ");
    for instances in [4000, 1500, 300] {
        let (banded, trained_banded, bands) = train(&gpu, instances);
        println!("{instances} instances planned: {bands} bands");
        assert!(bands > 1);
        assert!(banded == picture, "{instances}: the picture differs");
        assert!(trained_banded == trained, "{instances}: training differs");
    }
}
