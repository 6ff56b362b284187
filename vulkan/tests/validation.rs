//! Training, rendering in bands and reading back raise no word from the Khronos validation layer, synchronisation
//! checks included. The layer reads its settings from the environment, so the work is done in a child process.
#![allow(clippy::unwrap_used, clippy::panic, reason = "a test fails by panicking")]

mod scenes;

use config::plan::{Plan, PlanRequest};
use models::camera::DepthPrior;
use models::cloud::GaussianCloud;
use scenes::device::{plain, posed};
use scenes::{cloud, photo, view};
use std::process::Command;
use vulkan::constants::{RUNS, SHORT_PART};
use vulkan::fixture::Fixture;
use vulkan::gpu::Gpu;
use vulkan::kernel_config::KernelConfig;
use vulkan::trainer::Rendering;

const CHILD: &str = "DGTR_VALIDATION_CHILD";

#[test]
fn the_validation_layer_has_nothing_to_say() {
    if std::env::var_os(CHILD).is_some() {
        return work();
    }
    let layer = "VK_LAYER_KHRONOS_validation";
    let present = ["/usr/share/vulkan/explicit_layer.d", "/etc/vulkan/explicit_layer.d"]
        .iter()
        .any(|d| std::path::Path::new(d).join("VkLayer_khronos_validation.json").exists());
    if let Err(e) = Gpu::open(None) {
        return needs::missing(needs::Need::Vulkan, e);
    }
    if !present {
        return needs::missing(needs::Need::ValidationLayer, format!("{layer} is not there (vulkan-validationlayers)"));
    }
    let child = Command::new(std::env::current_exe().unwrap())
        .args(["the_validation_layer_has_nothing_to_say", "--exact", "--nocapture"])
        .env(CHILD, "1")
        .env("VK_INSTANCE_LAYERS", layer)
        .env("VK_LAYER_ENABLES", "VK_VALIDATION_FEATURE_ENABLE_SYNCHRONIZATION_VALIDATION_EXT")
        .output()
        .unwrap();
    let said = String::from_utf8_lossy(&child.stdout).into_owned() + &String::from_utf8_lossy(&child.stderr);
    assert!(child.status.success(), "{said}");
    assert!(said.contains("work done"), "{said}");
    assert!(!said.contains("VUID") && !said.contains("SYNC-HAZARD") && !said.contains("Validation Error"), "{said}");
}

fn work() {
    let gpu = Gpu::open(None).unwrap();
    let v = view(64, 48);
    let request = PlanRequest {
        device_mib: 64,
        width: 64,
        height: 48,
        views: 2,
        sh_degree: 3,
        max_gaussians: None,
        scene_gaussians: None,
        ..Default::default()
    };
    let standard = KernelConfig::standard(gpu.info());
    // Every kernel with several lanes that the device can run, those that fetch for each other and those that meet.
    let several = |(tiles, tile_lanes, fetched, summed)| KernelConfig {
        narrow: 32,
        share_lanes: 32,
        tiles,
        tile_lanes,
        fetched,
        summed,
        part: SHORT_PART,
        ..standard
    };
    let staged = KernelConfig::tile_candidates(gpu.info()).into_iter().max_by_key(|t| (t.2, t.0)).map(several).unwrap();
    for (instances, config) in
        [standard, staged, several((2, RUNS, 1, 1))].into_iter().flat_map(|s| [(1 << 16, s), (400, s)])
    {
        let plan = Plan::with_capacities(&request, 300, instances);
        let mut settings = plain();
        settings.refine_poses = true;
        settings.refine_exposure = true;
        let mut t = Fixture::with_config(&gpu, &plan, &settings, config).unwrap();
        t.load(&cloud(3, 200, 3)).unwrap();
        let depth: Vec<f32> = (0..64 * 48).map(|i| (i % 64) as f32).collect();
        let prior = DepthPrior { width: 64, height: 48, confidence: vec![1.0; depth.len()], depth };
        t.add_view(&posed(&v, &photo(1, &v)), Some(&prior)).unwrap();
        t.add_view(&posed(&v, &photo(2, &v)), None).unwrap();
        for _ in 0..4 {
            t.step().unwrap();
        }
        let mut drawn = Rendering::default();
        t.render(&v, &mut drawn).unwrap();
        t.render(&view(150, 90), &mut drawn).unwrap();
        let mut after = GaussianCloud::default();
        t.snapshot(&mut after).unwrap();
    }
    println!("work done");
}
