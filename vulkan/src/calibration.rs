//! Which shape is the fastest on a device: a few training steps of one small scene with each.
//!
//! Timestamps tell the wide kernels' time from the narrow ones', so that one trial judges a wide and a narrow size at once;
//! without timestamps each size is tried by itself on the wall clock. The trials take turns, so that whatever else the
//! machine does meanwhile slows all alike, and each keeps its best time.
//!
//! Every shape's kernels are compiled first, which can take longer than all steps together (lavapipe: seconds per shape),
//! so the standard shape comes first and no further one is begun once the given time is over.

use crate::cases::scenes::{cloud, photo, plain, posed, view};
use crate::gpu::Gpu;
use crate::kernels::Group;
use crate::shape::KernelShape;
use crate::trainer::{TrainError, Trainer};
use config::plan::{Plan, PlanRequest};
use std::time::{Duration, Instant};

/// Enough tiles for every lane of the looping kernels, and still a few milliseconds per step in software.
const SIDE: (u32, u32) = (128, 96);
const GAUSSIANS: usize = 4000;
/// Instances per Gaussian that are planned for; the scene has fewer.
const INSTANCES: usize = 32;
/// Steps of each trial after the one that compiles.
const REPEATS: usize = 3;
/// The standard size stays unless another is faster by this share: less is noise.
const MARGIN: f64 = 0.03;

/// One shape's best times.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Trial {
    /// The shape.
    pub shape: KernelShape,
    /// Milliseconds of its wide kernels per step (of the whole step where the device has no timestamps).
    pub wide_ms: f64,
    /// Milliseconds of its narrow kernels per step (of the whole step where the device has no timestamps).
    pub narrow_ms: f64,
}

/// What was measured, and what follows from it.
#[derive(Clone, Debug, PartialEq)]
pub struct Calibration {
    /// The fastest shape.
    pub shape: KernelShape,
    /// Every trial.
    pub trials: Vec<Trial>,
    /// Seconds it took.
    pub seconds: f64,
}

/// Measures `gpu`: the standard shape, and then others for as long as `limit` is not over (all without a limit).
///
/// # Errors
/// [`TrainError::Gpu`]: the device, its driver or its memory.
pub fn calibrate(gpu: &Gpu, limit: Option<Duration>) -> Result<Calibration, TrainError> {
    let start = Instant::now();
    let timed = gpu.timestamp_ns() > 0.0;
    let standard = KernelShape::standard(gpu.info());
    let (wide, narrow) = (KernelShape::wide_candidates(gpu.info()), KernelShape::narrow_candidates(gpu.info()));
    let shapes = shapes(&wide, &narrow, standard, timed);
    let (mut trials, mut trainers) = (Vec::new(), Vec::new());
    for shape in shapes {
        if !trials.is_empty() && limit.is_some_and(|limit| start.elapsed() >= limit) {
            break;
        }
        let mut trainer = trainer(gpu, shape)?;
        // The first step compiles; its time says nothing.
        step(&mut trainer, timed)?;
        trainers.push(trainer);
        trials.push(Trial { shape, wide_ms: f64::MAX, narrow_ms: f64::MAX });
    }
    for _ in 0..REPEATS {
        for (trainer, trial) in trainers.iter_mut().zip(&mut trials) {
            let [wide_ms, narrow_ms] = step(trainer, timed)?;
            trial.wide_ms = trial.wide_ms.min(wide_ms);
            trial.narrow_ms = trial.narrow_ms.min(narrow_ms);
        }
    }
    let shape = fastest(&trials, standard, timed);
    Ok(Calibration { shape, trials, seconds: start.elapsed().as_secs_f64() })
}

/// The shapes to try, the standard one first.
fn shapes(wide: &[u32], narrow: &[u32], standard: KernelShape, timed: bool) -> Vec<KernelShape> {
    let others = |list: &[u32], own: u32| list.iter().copied().filter(|n| *n != own).collect::<Vec<_>>();
    let (wide, narrow) = (others(wide, standard.wide), others(narrow, standard.narrow));
    let mut all = vec![standard];
    if timed {
        let size = |list: &[u32], i: usize, own: u32| list.get(i).copied().unwrap_or(own);
        let both = |i| KernelShape { wide: size(&wide, i, standard.wide), narrow: size(&narrow, i, standard.narrow) };
        all.extend((0..wide.len().max(narrow.len())).map(both));
    } else {
        all.extend(wide.iter().map(|w| KernelShape { wide: *w, ..standard }));
        all.extend(narrow.iter().map(|n| KernelShape { narrow: *n, ..standard }));
    }
    all
}

/// Without timestamps only trials that differ from the standard in one size judge that size.
fn fastest(trials: &[Trial], standard: KernelShape, timed: bool) -> KernelShape {
    let wide = trials.iter().filter(|t| timed || t.shape.narrow == standard.narrow);
    let narrow = trials.iter().filter(|t| timed || t.shape.wide == standard.wide);
    KernelShape {
        wide: least(wide.map(|t| (t.shape.wide, t.wide_ms)), standard.wide),
        narrow: least(narrow.map(|t| (t.shape.narrow, t.narrow_ms)), standard.narrow),
    }
}

/// The size with the least time, the standard one preferred.
fn least(times: impl Iterator<Item = (u32, f64)>, standard: u32) -> u32 {
    let handicap = |size: u32| if size == standard { 1.0 - MARGIN } else { 1.0 };
    times.min_by(|a, b| (a.1 * handicap(a.0)).total_cmp(&(b.1 * handicap(b.0)))).map_or(standard, |t| t.0)
}

/// The scene, loaded.
fn trainer(gpu: &Gpu, shape: KernelShape) -> Result<Trainer, TrainError> {
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
        sort_lanes: gpu.info().sort_lanes(),
        ..Default::default()
    };
    let plan = Plan::with_capacities(&request, GAUSSIANS, INSTANCES * GAUSSIANS);
    let mut trainer = Trainer::with_shape(gpu, &plan, &plain(), shape)?;
    trainer.load(&gaussians)?;
    trainer.add_view(&posed(&v, &photo(1, &v)), None)?;
    Ok(trainer)
}

/// One step: milliseconds of its wide and of its narrow kernels.
fn step(trainer: &mut Trainer, timed: bool) -> Result<[f64; 2], TrainError> {
    let (start, before) = (Instant::now(), trainer.group_ms());
    trainer.step()?;
    if !timed {
        return Ok([start.elapsed().as_secs_f64() * 1e3; 2]);
    }
    let after = trainer.group_ms();
    Ok([Group::Wide, Group::Narrow].map(|g| after[g as usize] - before[g as usize]))
}

#[cfg(test)]
mod tests {
    use super::*;

    const STANDARD: KernelShape = KernelShape { wide: 64, narrow: 32 };

    fn trial(wide: u32, narrow: u32, wide_ms: f64, narrow_ms: f64) -> Trial {
        Trial { shape: KernelShape { wide, narrow }, wide_ms, narrow_ms }
    }

    #[test]
    fn every_size_is_tried_and_with_timestamps_two_at_once() {
        let (wide, narrow) = ([32, 64, 128, 256], [16, 32, 64]);
        for (timed, count) in [(true, 4), (false, 6)] {
            let all = shapes(&wide, &narrow, STANDARD, timed);
            assert_eq!((all.len(), all[0]), (count, STANDARD));
            assert!(wide.iter().all(|w| all.iter().any(|s| s.wide == *w)));
            assert!(narrow.iter().all(|n| all.iter().any(|s| s.narrow == *n)));
        }
    }

    #[test]
    fn the_two_sizes_are_judged_apart() {
        let timed = [trial(32, 16, 9.0, 1.0), trial(64, 32, 5.0, 5.0), trial(128, 64, 2.0, 7.0)];
        assert_eq!(fastest(&timed, STANDARD, true), KernelShape { wide: 128, narrow: 16 });
        // Whole steps: (128, 32) says nothing about narrow sizes.
        let whole = [trial(64, 32, 5.0, 5.0), trial(128, 32, 2.0, 2.0), trial(64, 16, 4.0, 4.0)];
        assert_eq!(fastest(&whole, STANDARD, false), KernelShape { wide: 128, narrow: 16 });
    }

    #[test]
    fn a_gain_within_the_noise_changes_nothing() {
        let close = [trial(64, 32, 10.0, 10.0), trial(128, 64, 9.8, 9.6)];
        assert_eq!(fastest(&close, STANDARD, true), KernelShape { wide: 64, narrow: 64 });
        assert_eq!(fastest(&[], STANDARD, true), STANDARD);
    }
}
