//! The kernel configuration changes no bit of the trained model.
#![allow(clippy::unwrap_used, clippy::panic, reason = "a test fails by panicking")]

mod scenes;

use config::plan::{Lanes, Plan, PlanRequest};
use models::camera::DepthPrior;
use models::cloud::GaussianCloud;
use scenes::device::{plain, posed};
use scenes::{cloud, photo, view};
use vulkan::constants::{RUNS, SHORT_PART, STRIP};
use vulkan::fixture::Fixture;
use vulkan::gpu::Gpu;
use vulkan::kernel_config::KernelConfig;
use vulkan::trainer::Rendering;

fn gpu() -> Option<Gpu> {
    let gpu = Gpu::open_by_driver(None);
    if let Err(e) = &gpu {
        needs::missing(needs::Need::Vulkan, e);
    }
    gpu.ok()
}

/// Everything that draws random numbers or sums over many lanes: growth, relocation, noise, depth, pose and exposure,
/// two views, and a picture that is no multiple of any workgroup. Few `instances` are done in bands.
fn trained(gpu: &Gpu, config: KernelConfig, instances: usize, steps: u32) -> (GaussianCloud, Rendering, u64) {
    trained_with(gpu, config, (Lanes::SOFTWARE, true), instances, steps)
}

/// Where `refine` says so, poses are refined: their gradient is summed in as many parts as lanes loop.
fn trained_with(
    gpu: &Gpu,
    config: KernelConfig,
    (lanes, refine): (Lanes, bool),
    instances: usize,
    steps: u32,
) -> (GaussianCloud, Rendering, u64) {
    let v = view(77, 53);
    let mut settings = plain();
    settings.density.strategy = config::training::Strategy::Relocate;
    settings.steps = steps;
    settings.regularise.noise = 2.0;
    settings.regularise.opacity_decay = 0.004;
    settings.loss.depth = 0.2;
    (settings.refine_poses, settings.refine_exposure) = (refine, true);
    let request = PlanRequest { device_mib: 64, width: 77, height: 53, views: 2, lanes, ..Default::default() };
    let plan = Plan::with_capacities(&request, 3000, instances);
    let mut trainer = Fixture::with_config(gpu, &plan, &settings, config).unwrap();
    trainer.load(&cloud(8, 1500, 3)).unwrap();
    let depth: Vec<f32> = (0..77 * 53).map(|i| 2.0 + (i % 77) as f32 * 0.05).collect();
    let confidence = depth.iter().map(|d| d / 8.0).collect();
    let prior = DepthPrior { width: 77, height: 53, depth, confidence };
    trainer.add_view(&posed(&v, &photo(1, &v)), Some(&prior)).unwrap();
    trainer.add_view(&posed(&v, &photo(2, &v)), None).unwrap();
    let mut banded = 0;
    for _ in 0..steps {
        banded += u64::from(trainer.step().unwrap().bands > 1);
    }
    let mut model = GaussianCloud::with_capacity(3, trainer.gaussians());
    trainer.snapshot(&mut model).unwrap();
    let mut drawn = Rendering::default();
    trainer.render(&v, &mut drawn).unwrap();
    (model, drawn, banded)
}

/// Bit for bit, NaN included.
fn bits(model: &GaussianCloud) -> Vec<u32> {
    let all = model.means.as_flattened().iter().chain(model.log_scales.as_flattened());
    let all = all.chain(model.rotations.as_flattened()).chain(&model.opacity_logits).chain(&model.sh);
    all.map(|v| v.to_bits()).collect()
}

/// Together with the standard configuration: the smallest and the largest of each size, with one lane per tile and share and with
/// several, fetching for themselves and for each other, summed in a loop and at once, where the device can, with strips in parts and at once (each configuration costs a
/// compilation).
fn configs(gpu: &Gpu) -> Vec<KernelConfig> {
    let info = gpu.info();
    let wide = KernelConfig::wide_candidates(info);
    let tiles = KernelConfig::tile_candidates(info);
    if !info.shuffles {
        println!("skipped: four lanes per tile ({} has no shuffles)", info.name);
    }
    let of = |wide, narrow, share_lanes, (tiles, tile_lanes, fetched, summed)| KernelConfig {
        wide,
        narrow,
        share_lanes,
        tiles,
        tile_lanes,
        fetched,
        summed,
        part: if wide == 64 { STRIP } else { SHORT_PART },
    };
    let direct = tiles.iter().rev().find(|t| t.1 > 1 && (t.2, t.3) == (1, 1));
    // A workgroup per share is never chosen in software, but does the same there, too.
    let staged = tiles.iter().max_by_key(|t| (t.2, t.0)).unwrap();
    let mut all = vec![of(wide[0], 32, 32, *staged), of(wide[wide.len() - 1], 16, 1, tiles[0])];
    all.extend(direct.map(|t| of(64, 32, 1, *t)));
    all
}

#[test]
fn the_trained_model_and_its_pictures_are_the_same_to_the_bit_with_every_config() {
    let Some(gpu) = gpu() else { return };
    let (model, drawn, _) = trained(&gpu, KernelConfig::standard(gpu.info()), 200_000, 110);
    assert!(model.len() > 1500, "density control did not run");
    for config in configs(&gpu) {
        let (other, other_drawn, _) = trained(&gpu, config, 200_000, 110);
        assert!(bits(&other) == bits(&model), "{config:?}: another model");
        assert!(other_drawn.rgb == drawn.rgb && other_drawn.depth == drawn.depth, "{config:?}: another picture");
    }
}

/// As on a Raspberry Pi 4; and where it is a matter of choice.
#[test]
fn lanes_that_meet_in_shared_memory_leave_the_same_bits_at_once_and_in_bands() {
    let Some(gpu) = gpu() else { return };
    let standard = KernelConfig::standard(gpu.info());
    let meeting = Gpu::open_without_shuffles(Some(&gpu.info().name)).unwrap();
    for (instances, steps) in [(200_000, 110), (3000, 6)] {
        let (model, drawn, _) = trained(&gpu, standard, instances, steps);
        for (gpu, tiles, summed) in [(&gpu, 2, 1), (&meeting, 2, RUNS), (&meeting, 8, 1)] {
            let config = KernelConfig { tiles, tile_lanes: RUNS, fetched: 1, summed, ..standard };
            let (other, other_drawn, _) = trained(gpu, config, instances, steps);
            assert!(bits(&other) == bits(&model), "{config:?}, {instances} instances: another model");
            assert!(other_drawn.rgb == drawn.rgb && other_drawn.depth == drawn.depth, "{config:?}: another picture");
        }
    }
}

#[test]
fn in_bands_the_model_is_the_same_to_the_bit_with_every_config() {
    let Some(gpu) = gpu() else { return };
    let (model, _, banded) = trained(&gpu, KernelConfig::standard(gpu.info()), 3000, 6);
    assert_eq!(banded, 6, "the plan holds every instance at once");
    for config in configs(&gpu) {
        let (other, _, _) = trained(&gpu, config, 3000, 6);
        assert!(bits(&other) == bits(&model), "{config:?}: another model");
    }
}

#[test]
fn a_board_s_and_a_card_s_number_of_lanes_leave_the_same_bits_at_once_and_in_bands() {
    let Some(gpu) = gpu() else { return };
    let config = KernelConfig::standard(gpu.info());
    for (instances, steps) in [(200_000, 20), (3000, 4)] {
        for (lanes, refine) in [(Lanes::BOARD, true), (Lanes::CARD, false)] {
            let (few, drawn, _) = trained_with(&gpu, config, (Lanes::SOFTWARE, refine), instances, steps);
            let (many, other, _) = trained_with(&gpu, config, (lanes, refine), instances, steps);
            assert!(bits(&few) == bits(&many) && drawn.rgb == other.rgb, "{instances} instances, {lanes:?}");
        }
    }
}
