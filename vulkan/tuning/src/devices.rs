//! Which device trains where nobody names one: of several the one with the faster step, measured once and kept. A board has two,
//! its GPU and Mesa's driver for the processor, and it is not always the GPU that wins (on a Raspberry Pi 5 others saw the processor
//! ahead by nine times).

use std::path::PathBuf;

use config::kernels::KernelChoice;
use vulkan::gpu::{Gpu, GpuError, GpuInfo};

use crate::autotune::step_ms;
use crate::cache;
use crate::kernels::choice;

/// The processor must be faster than a GPU by this: its cores are wanted for matching pictures and for networks, too. Chosen, not
/// measured: no board was at hand.
const PROCESSOR_HANDICAP: f64 = 1.25;

/// Opens the device whose name contains `name`, or the one with the fastest step. Call it before anything that must not wait: devices
/// seen for the first time are measured, where there are several, which takes seconds (a software renderer compiles).
///
/// # Errors
/// Errors of [`Gpu::open`].
pub fn open(name: Option<&str>) -> Result<Gpu, GpuError> {
    open_by(name, &measured)
}

/// Opens a device without measuring: the first hardware device until they were.
///
/// # Errors
/// Errors of [`Gpu::open`].
pub fn open_known(name: Option<&str>) -> Result<Gpu, GpuError> {
    open_by(name, &known)
}

fn open_by(name: Option<&str>, step: &dyn Fn(&GpuInfo) -> Option<f64>) -> Result<Gpu, GpuError> {
    if name.is_some() || choice() == KernelChoice::Standard {
        return Gpu::open(name);
    }
    let devices = Gpu::list()?;
    if devices.len() < 2 {
        return Gpu::open(None);
    }
    let steps: Vec<Option<f64>> = devices.iter().map(step).collect();
    let chosen = &devices[fastest(&devices, &steps)];
    tracing::debug!("{}: chosen of {} devices", chosen.name, devices.len());
    Gpu::open(Some(&chosen.name))
}

/// Milliseconds of a device's small step, as far as it was measured.
pub fn known(info: &GpuInfo) -> Option<f64> {
    cache::read_step(&cache::path()?, info).unwrap_or_else(|e| {
        tracing::debug!("steps of earlier runs are not used: {e}");
        None
    })
}

/// Milliseconds of a step on this device, measured and kept where it is not known.
pub fn measured(info: &GpuInfo) -> Option<f64> {
    known(info).or_else(|| {
        tracing::info!("{}: measuring a step (once), to choose among the devices", info.name);
        // What does not work is no choice.
        let ms = Gpu::open(Some(&info.name)).map_err(Into::into).and_then(|gpu| step_ms(&gpu)).unwrap_or_else(|e| {
            tracing::warn!("{}: not used, {e}", info.name);
            f64::INFINITY
        });
        let kept = |path: PathBuf| {
            cache::write_step(&path, info, ms).map_err(|e| tracing::warn!("{e}; measured anew next time"))
        };
        _ = cache::path().filter(|_| ms.is_finite()).map(kept);
        Some(ms)
    })
}

/// The device with the least step; the first that is no software renderer, or the first, while not all were measured.
pub fn fastest(devices: &[GpuInfo], steps: &[Option<f64>]) -> usize {
    let first = devices.iter().position(|d| !d.is_cpu).unwrap_or(0);
    let handicap = |i: usize| if devices[i].is_cpu { PROCESSOR_HANDICAP } else { 1.0 };
    let all: Option<Vec<f64>> = steps.iter().enumerate().map(|(i, ms)| Some((*ms)? * handicap(i))).collect();
    let least = all.and_then(|all| {
        let finite = all.into_iter().enumerate().filter(|(_, ms)| ms.is_finite());
        finite.min_by(|a, b| a.1.total_cmp(&b.1).then(a.0.cmp(&b.0))).map(|(i, _)| i)
    });
    least.unwrap_or(first)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::fixtures::device;

    #[test]
    fn the_faster_device_trains_whichever_kind_it_is() {
        let board = [GpuInfo { is_cpu: true, ..device("llvmpipe") }, device("V3D")];
        let ms = |a: f64, b: f64| fastest(&board, &[Some(a), Some(b)]);
        assert_eq!(ms(10.0, 90.0), 0, "the processor by nine times");
        assert_eq!(ms(90.0, 10.0), 1);
        assert_eq!(ms(10.0, 11.0), 1, "its cores are wanted for other work");
        assert_eq!(ms(10.0, f64::INFINITY), 0, "a device that computes nothing is no choice");
        assert_eq!(ms(f64::INFINITY, f64::INFINITY), 1);
        assert_eq!(fastest(&board, &[Some(1.0), None]), 1, "not measured yet");
        assert_eq!(fastest(&board[..1], &[None]), 0);
    }
}
