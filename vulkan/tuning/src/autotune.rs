//! Which configuration is the fastest on a device: a few training steps of one small scene with each.
//!
//! Timestamps tell the time of one kind of kernel from another's, so that one trial judges one size of each kind at once;
//! without timestamps each size is tried by itself on the wall clock. The trials take turns, so that whatever else the
//! machine does meanwhile slows all alike, and each keeps its best time.
//!
//! A configuration must also compute what the standard one does, to the bit: one whose gradients are others on this device (a
//! compiler that contracts or a subgroup that runs otherwise than it says) is left out, however fast it is.
//!
//! Every configuration's kernels are compiled first, which can take longer than all steps together (lavapipe: seconds per configuration),
//! so the standard configuration comes first and no further one is begun once the given time is over.

use config::plan::{Plan, PlanRequest};
use models::cloud::GaussianCloud;
use std::time::{Duration, Instant};
use vulkan::gpu::{Gpu, GpuInfo};
use vulkan::kernel_config::KernelConfig;
use vulkan::synthetic::{cloud, photo, plain, posed, view};
use vulkan::trainer::{PictureStore, TrainError, Trainer};

/// Enough tiles for every lane of the looping kernels, and still a few milliseconds per step in software.
const SIDE: (u32, u32) = (128, 96);
const GAUSSIANS: usize = 4000;
/// Instances per Gaussian that are planned for; the scene has fewer.
const INSTANCES: usize = 32;
/// Steps of each trial after the one that compiles.
const REPEATS: usize = 3;
/// The standard size stays unless another is faster by this share: less is noise.
const MARGIN: f64 = 0.03;

/// One configuration's best times.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Trial {
    /// The configuration.
    pub config: KernelConfig,
    /// Milliseconds per step of its wide, its narrow and its blending kernels (of the whole step, three times, where the
    /// device has no timestamps).
    pub ms: [f64; 3],
}

/// What was measured, and what follows from it.
#[derive(Clone, Debug, PartialEq)]
pub struct Autotuned {
    /// The fastest configuration.
    pub config: KernelConfig,
    /// Every trial.
    pub trials: Vec<Trial>,
    /// Configurations that compute something else than the standard one here.
    pub refused: Vec<KernelConfig>,
    /// Seconds it took.
    pub seconds: f64,
}

/// Measures `gpu`: the standard configuration, and then others for as long as `limit` is not over (all without a limit).
///
/// # Errors
/// [`TrainError::Gpu`]: the device, its driver or its memory.
pub fn autotune(gpu: &Gpu, limit: Option<Duration>) -> Result<Autotuned, TrainError> {
    let start = Instant::now();
    let timed = gpu.timestamp_ns() > 0.0;
    let standard = KernelConfig::standard(gpu.info());
    let (mut trials, mut trainers, mut refused) = (Vec::new(), Vec::new(), Vec::new());
    let mut expected = None;
    for config in configs(&Candidates::of(gpu.info()), standard, timed) {
        if !trials.is_empty() && limit.is_some_and(|limit| start.elapsed() >= limit) {
            break;
        }
        let mut trainer = trainer(gpu, config)?;
        // The first pass compiles; its time says nothing.
        let mut gradient = GaussianCloud::default();
        trainer.0.gradient(&mut trainer.1, 0, &mut gradient)?;
        if *expected.get_or_insert_with(|| gradient.clone()) != gradient {
            refused.push(config);
            continue;
        }
        step(&mut trainer, timed)?;
        trainers.push(trainer);
        trials.push(Trial { config, ms: [f64::MAX; 3] });
    }
    for _ in 0..REPEATS {
        for (trainer, trial) in trainers.iter_mut().zip(&mut trials) {
            let ms = step(trainer, timed)?;
            trial.ms = std::array::from_fn(|k| trial.ms[k].min(ms[k]));
        }
    }
    let config = fastest(&trials, standard, timed);
    Ok(Autotuned { config, trials, refused, seconds: start.elapsed().as_secs_f64() })
}

/// Milliseconds of wall clock that the device takes for one small training step with its standard configuration: what devices of one
/// computer are compared by.
///
/// # Errors
/// [`TrainError::Gpu`]: the device, its driver or its memory.
pub fn step_ms(gpu: &Gpu) -> Result<f64, TrainError> {
    let mut trainer = trainer(gpu, KernelConfig::standard(gpu.info()))?;
    // The first one compiles.
    step(&mut trainer, false)?;
    let mut least = f64::INFINITY;
    for _ in 0..REPEATS {
        let [ms, ..] = step(&mut trainer, false)?;
        least = least.min(ms);
    }
    Ok(least)
}

/// What to try, by kind of kernel.
struct Candidates {
    wide: Vec<(u32, u32)>,
    narrow: Vec<(u32, u32)>,
    tiles: Vec<Sizes>,
}

impl Candidates {
    fn of(info: &GpuInfo) -> Self {
        Self {
            wide: KernelConfig::part_candidates(info)
                .into_iter()
                .flat_map(|part| KernelConfig::wide_candidates(info).into_iter().map(move |n| (n, part)))
                .collect(),
            narrow: KernelConfig::narrow_candidates(info),
            tiles: KernelConfig::tile_candidates(info),
        }
    }
}

/// What a configuration says about each kind of kernel: its size, lanes per share or tile, Gaussians fetched or pixels held at once, lanes summed
/// at once.
type Sizes = (u32, u32, u32, u32);

fn wide(config: KernelConfig) -> Sizes {
    (config.wide, 1, config.part, 1)
}

fn narrow(config: KernelConfig) -> Sizes {
    (config.narrow, config.share_lanes, 1, 1)
}

fn tiles(config: KernelConfig) -> Sizes {
    (config.tiles, config.tile_lanes, config.fetched, config.summed)
}

const KINDS: [fn(KernelConfig) -> Sizes; 3] = [wide, narrow, tiles];

/// The configuration with these sizes, by kind.
fn with_sizes([of_wide, of_narrow, of_tiles]: [Sizes; 3]) -> KernelConfig {
    let ((wide, _, part, _), (narrow, share_lanes, ..), (tiles, tile_lanes, fetched, summed)) =
        (of_wide, of_narrow, of_tiles);
    KernelConfig { wide, narrow, share_lanes, tiles, tile_lanes, fetched, summed, part }
}

/// The configurations to try, the standard one first.
fn configs(all: &Candidates, standard: KernelConfig, timed: bool) -> Vec<KernelConfig> {
    let own = KINDS.map(|kind| kind(standard));
    let listed = [
        all.wide.iter().map(|(n, part)| (*n, 1, *part, 1)).collect::<Vec<_>>(),
        all.narrow.iter().map(|(n, lanes)| (*n, *lanes, 1, 1)).collect(),
        all.tiles.clone(),
    ];
    let others: [Vec<Sizes>; 3] = std::array::from_fn(|k| {
        let mut others: Vec<_> = listed[k].iter().copied().filter(|sizes| *sizes != own[k]).collect();
        // Several lanes per tile or share promise more than another size: they come first.
        others.sort_by_key(|sizes| std::cmp::Reverse(sizes.1));
        others
    });
    let mut configs = vec![standard];
    if timed {
        for i in 0..others.iter().map(Vec::len).max().unwrap_or(0) {
            configs.push(with_sizes(std::array::from_fn(|k| others[k].get(i).copied().unwrap_or(own[k]))));
        }
    } else {
        for k in (0..3).rev() {
            let but_one = |sizes: &Sizes| with_sizes(std::array::from_fn(|o| if o == k { *sizes } else { own[o] }));
            configs.extend(others[k].iter().map(but_one));
        }
    }
    configs
}

/// Each kind's best size. Without timestamps only trials that are standard otherwise judge a kind.
fn fastest(trials: &[Trial], standard: KernelConfig, timed: bool) -> KernelConfig {
    with_sizes(std::array::from_fn(|k| {
        let standard_otherwise = |t: &&Trial| (0..3).all(|o| o == k || KINDS[o](t.config) == KINDS[o](standard));
        let judges = trials.iter().filter(|t| timed || standard_otherwise(t));
        least(judges.map(|t| (KINDS[k](t.config), t.ms[k])), KINDS[k](standard))
    }))
}

/// The size with the least time, the standard one preferred.
fn least(times: impl Iterator<Item = (Sizes, f64)>, standard: Sizes) -> Sizes {
    let handicap = |size: Sizes| if size == standard { 1.0 - MARGIN } else { 1.0 };
    times.min_by(|a, b| (a.1 * handicap(a.0)).total_cmp(&(b.1 * handicap(b.0)))).map_or(standard, |t| t.0)
}

/// The scene, loaded.
fn trainer(gpu: &Gpu, config: KernelConfig) -> Result<(Trainer, PictureStore), TrainError> {
    let v = view(SIDE.0, SIDE.1);
    let mut gaussians = cloud(1, GAUSSIANS, 3);
    // As small against the picture as trained ones are.
    gaussians.log_scales.as_flattened_mut().iter_mut().for_each(|s| *s -= 1.5);
    let request = PlanRequest {
        device_mib: u32::MAX,
        width: SIDE.0,
        height: SIDE.1,
        views: 1,
        sh_degree: 3,
        max_gaussians: Some(GAUSSIANS),
        scene_gaussians: None,
        lanes: gpu.info().lanes(),
        ..Default::default()
    };
    let plan = Plan::with_capacities(&request, GAUSSIANS, INSTANCES * GAUSSIANS);
    let mut trainer = Trainer::with_config(gpu, &plan, &plain(), config)?;
    trainer.device_mut().time_every_step();
    trainer.load(&gaussians)?;
    let mut pictures = PictureStore::new(&plan);
    pictures.add(trainer.device_mut(), &posed(&v, &photo(1, &v)), None)?;
    Ok((trainer, pictures))
}

/// One step: milliseconds of each kind of its kernels.
fn step((trainer, pictures): &mut (Trainer, PictureStore), timed: bool) -> Result<[f64; 3], TrainError> {
    let (start, before) = (Instant::now(), trainer.device().kind_ms());
    trainer.step(pictures)?;
    if !timed {
        return Ok([start.elapsed().as_secs_f64() * 1e3; 3]);
    }
    let after = trainer.device().kind_ms();
    Ok(std::array::from_fn(|kind| after[kind] - before[kind]))
}

#[cfg(test)]
mod tests {
    use super::*;

    const STANDARD: KernelConfig = with_sizes_of(64, (32, 1), (32, 1, 1, 1));

    const fn with_sizes_of(wide: u32, narrow: (u32, u32), of_tiles: Sizes) -> KernelConfig {
        let (tiles, tile_lanes, fetched, summed) = of_tiles;
        let (narrow, share_lanes) = narrow;
        KernelConfig { wide, narrow, share_lanes, tiles, tile_lanes, fetched, summed, part: 8 }
    }

    fn trial(wide: u32, narrow: (u32, u32), tiles: Sizes, ms: [f64; 3]) -> Trial {
        Trial { config: with_sizes_of(wide, narrow, tiles), ms }
    }

    #[test]
    fn every_size_is_tried_and_with_timestamps_one_of_each_kind_at_once() {
        let all = Candidates {
            wide: vec![(32, 8), (64, 8), (128, 8), (64, 2)],
            narrow: vec![(16, 1), (32, 1), (16, 16), (32, 32)],
            tiles: vec![(16, 1, 1, 1), (32, 1, 1, 1), (8, 4, 1, 1), (8, 4, 4, 1), (16, 4, 1, 4), (16, 4, 4, 4)],
        };
        for (timed, count) in [(true, 6), (false, 12)] {
            let tried = configs(&all, STANDARD, timed);
            assert_eq!((tried.len(), tried[0]), (count, STANDARD));
            assert!(all.wide.iter().all(|w| tried.iter().any(|s| (s.wide, s.part) == *w)));
            assert!(all.narrow.iter().all(|n| tried.iter().any(|s| (s.narrow, s.share_lanes) == *n)));
            assert!(all.tiles.iter().all(|t| tried.iter().any(|s| tiles(*s) == *t)));
            assert_eq!(tried[1].tile_lanes, 4);
        }
    }

    #[test]
    fn the_kinds_are_judged_apart() {
        let timed = [
            trial(32, (16, 1), (8, 4, 1, 1), [9.0, 1.0, 4.0]),
            trial(64, (32, 1), (32, 1, 1, 1), [5.0, 5.0, 5.0]),
            trial(128, (32, 32), (16, 4, 1, 4), [2.0, 7.0, 3.0]),
        ];
        assert_eq!(fastest(&timed, STANDARD, true).to_string(), "128x16x1x16x4x1x4x8");
        // Whole steps: (128, …, (8, 4, 1, 1)) says nothing about narrow sizes, nor about tiles.
        let whole = [
            trial(64, (32, 1), (32, 1, 1, 1), [5.0; 3]),
            trial(128, (32, 1), (8, 4, 1, 1), [1.0; 3]),
            trial(64, (16, 16), (32, 1, 1, 1), [4.0; 3]),
            trial(64, (32, 1), (8, 4, 1, 1), [3.0; 3]),
        ];
        assert_eq!(fastest(&whole, STANDARD, false).to_string(), "64x16x16x8x4x1x1x8");
    }

    #[test]
    fn a_gain_within_the_noise_changes_nothing() {
        let close = [trial(64, (32, 1), (32, 1, 1, 1), [10.0; 3]), trial(128, (32, 32), (8, 4, 1, 1), [9.8, 9.6, 9.8])];
        assert_eq!(fastest(&close, STANDARD, true).to_string(), "64x32x32x32x1x1x1x8");
        assert_eq!(fastest(&[], STANDARD, true), STANDARD);
    }

    #[test]
    fn autotuning_without_time_for_more_measures_the_standard_configuration_and_keeps_it() {
        let Ok(gpu) = Gpu::open(None) else {
            println!("skipped: no Vulkan device");
            return;
        };
        let found = autotune(&gpu, Some(Duration::ZERO)).unwrap();
        println!("{found:?}");
        let standard = KernelConfig::standard(gpu.info());
        assert_eq!((found.config, found.trials.len(), found.trials[0].config), (standard, 1, standard));
        let t = found.trials[0];
        assert!(t.ms.iter().all(|ms| *ms > 0.0 && *ms < 1e6), "{t:?}");
    }
}
