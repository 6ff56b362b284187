//! What a training step costs on this device: measured once in a few seconds, kept beside the kernels' configurations, and asked by whoever must
//! know beforehand how long a training will take.

use std::path::PathBuf;

use config::kernels::KernelChoice;
use vulkan::gpu::{Gpu, GpuInfo};
use vulkan::kernel_config::KernelConfig;

use crate::cache;
use crate::kernels::choice;
use crate::model::CostModel;

pub mod measure;
pub mod synthetic;

/// What steps cost on this device with kernels of `config`, as far as it was measured.
pub fn known(info: &GpuInfo, config: KernelConfig) -> Option<CostModel> {
    kept(cache::path()?, info, config)
}

/// What steps cost on this device, measured now and kept where it is not known; `None` (and a warning) where it cannot be measured, and where
/// [`config::kernels::VARIABLE`] says that nothing is. Call it before anything that must not wait: it takes seconds.
pub fn of(gpu: &Gpu, config: KernelConfig) -> Option<CostModel> {
    if choice() == KernelChoice::Standard {
        return None;
    }
    measured(gpu, config, cache::path())
}

fn kept(path: PathBuf, info: &GpuInfo, config: KernelConfig) -> Option<CostModel> {
    cache::read_cost(&path, info, info.threads(), config).unwrap_or_else(|e| {
        tracing::warn!("what steps cost is measured anew: {e}");
        None
    })
}

/// Measures it, whatever is kept, and keeps the result; `None` (and a warning) when it cannot be measured.
pub fn anew(gpu: &Gpu, config: KernelConfig) -> Option<CostModel> {
    now(gpu, config, cache::path())
}

fn measured(gpu: &Gpu, config: KernelConfig, path: Option<PathBuf>) -> Option<CostModel> {
    let before = path.clone().and_then(|path| kept(path, gpu.info(), config));
    before.or_else(|| now(gpu, config, path))
}

fn now(gpu: &Gpu, config: KernelConfig, path: Option<PathBuf>) -> Option<CostModel> {
    let info = gpu.info();
    tracing::info!("{}: measuring what a step costs (once)", info.name);
    let model = match measure::measure(gpu, config) {
        Ok(model) if model.is_sound() => model,
        Ok(_) => {
            tracing::warn!("{}: its clock says nothing; what steps cost is not known", info.name);
            return None;
        }
        Err(e) => {
            tracing::warn!("{}: what steps cost could not be measured: {e}", info.name);
            return None;
        }
    };
    let keep = |path: PathBuf| cache::write_cost(&path, info, info.threads(), config, model);
    if let Some(Err(e)) = path.map(keep) {
        tracing::warn!("{e}; what steps cost is measured anew next time");
    }
    Some(model)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_measured_is_kept_for_this_number_of_threads_and_found_again() {
        let Ok(gpu) = Gpu::open(None) else {
            needs::missing(needs::Need::Vulkan, "no Vulkan device");
            return;
        };
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("kernels.toml");
        let config = KernelConfig::standard(gpu.info());
        assert_eq!(kept(path.clone(), gpu.info(), config), None);
        let model = measured(&gpu, config, Some(path.clone())).unwrap();
        assert_eq!(kept(path.clone(), gpu.info(), config), Some(model));
        assert_eq!(measured(&gpu, config, Some(path)), Some(model), "nothing is measured twice");
        // A folder that cannot be: the model is used, and nothing fails.
        std::fs::write(dir.path().join("file"), b"").unwrap();
        assert!(measured(&gpu, config, Some(dir.path().join("file/kernels.toml"))).unwrap().is_sound());
    }
}
