//! Which kernel configuration this process trains with: the one the user fixed, the one measured earlier on this device with this
//! driver and these kernels, or the one measured now. Whatever goes wrong on the way costs a warning and some speed, never
//! the run; and since the configuration changes no bit of the model, it needs no place in it.

use std::path::PathBuf;
use std::time::Duration;

use config::kernels::{KernelChoice, VARIABLE};
use vulkan::gpu::{Gpu, GpuInfo};
use vulkan::kernel_config::KernelConfig;

use crate::autotune::autotune;
use crate::cache;

/// No further configuration is tried after this when nobody asked for it.
const PATIENCE: Duration = Duration::from_millis(1500);

/// Where a configuration comes from.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Source {
    /// [`VARIABLE`] says so.
    Fixed,
    /// Measured now or earlier and kept in this file.
    Kept(PathBuf),
    /// Measured now, and nowhere kept.
    Measured,
    /// Built in.
    Standard,
}

/// The configuration that commands use on `gpu`, measured first if it never was. Call it before anything that must not wait: it
/// may take a second or two. A software renderer compiles for seconds per configuration, so it is measured on request only
/// ([`measure`]).
pub fn config_of(gpu: &Gpu) -> KernelConfig {
    let choice = choice();
    let (config, source) = found(gpu.info(), choice);
    if source == Source::Standard && choice == KernelChoice::Autotuned && !gpu.info().is_cpu {
        return measured(gpu, cache::path(), Some(PATIENCE)).map_or(config, |m| m.0);
    }
    config
}

/// The configuration on the device and where it comes from, without measuring.
pub fn known(info: &GpuInfo) -> (KernelConfig, Source) {
    found(info, choice())
}

fn found(info: &GpuInfo, choice: KernelChoice) -> (KernelConfig, Source) {
    let standard = (KernelConfig::standard(info), Source::Standard);
    match choice {
        KernelChoice::Standard => standard,
        KernelChoice::Fixed { wide, narrow, share_lanes, tiles, tile_lanes, fetched, summed, part } => {
            let fixed = KernelConfig { wide, narrow, share_lanes, tiles, tile_lanes, fetched, summed, part };
            if fixed.fits(info) {
                return (fixed, Source::Fixed);
            }
            tracing::warn!("{VARIABLE}: {} cannot run {fixed}; the default is used", info.name);
            standard
        }
        KernelChoice::Autotuned => kept(info, cache::path()).unwrap_or(standard),
    }
}

/// Measures the device with every configuration, whatever is kept, and keeps the result; `None` (and a warning) when it cannot be measured.
pub fn measure(gpu: &Gpu) -> Option<(KernelConfig, Source)> {
    measured(gpu, cache::path(), None)
}

/// What [`VARIABLE`] asks for; what cannot be understood is warned of and is the default.
pub fn choice() -> KernelChoice {
    KernelChoice::from_environment().unwrap_or_else(|e| {
        tracing::warn!("{e}; the default is used");
        KernelChoice::Standard
    })
}

fn kept(info: &GpuInfo, path: Option<PathBuf>) -> Option<(KernelConfig, Source)> {
    let path = path?;
    match cache::read(&path, info) {
        Ok(config) => config.map(|config| (config, Source::Kept(path))),
        Err(e) => {
            tracing::warn!("kernel configurations of earlier runs are not used: {e}");
            None
        }
    }
}

fn measured(gpu: &Gpu, path: Option<PathBuf>, limit: Option<Duration>) -> Option<(KernelConfig, Source)> {
    let name = &gpu.info().name;
    tracing::info!("{name}: measuring which kernel configuration is the fastest (once)");
    let found = match autotune(gpu, limit) {
        Ok(found) => found,
        Err(e) => {
            tracing::warn!("{name}: kernels could not be measured, the default configuration is used: {e}");
            return None;
        }
    };
    for config in &found.refused {
        tracing::warn!("{name}: kernels of configuration {config} compute something else here and are never used");
    }
    tracing::info!("{name}: kernels of configuration {}, measured in {:.1} s", found.config, found.seconds);
    let Some(path) = path else {
        tracing::warn!("neither XDG_CACHE_HOME nor HOME is set: kernels are measured anew next time");
        return Some((found.config, Source::Measured));
    };
    match cache::write(&path, gpu.info(), found.config) {
        Ok(()) => Some((found.config, Source::Kept(path))),
        Err(e) => {
            tracing::warn!("the kernels' configuration is not kept and will be measured anew next time: {e}");
            Some((found.config, Source::Measured))
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::fixtures::device;
    use config::kernels::PROFILES;

    #[test]
    fn a_profile_is_what_the_devices_of_its_name_begin_with() {
        let board = device("Mali-G610");
        let board = GpuInfo { ids: (0x13b5, 1), ..board };
        let card = GpuInfo { is_integrated: false, subgroup_size: 32, ..board.clone() };
        let processor = GpuInfo { is_cpu: true, subgroup_size: 8, ..board.clone() };
        for ((name, numbers), info) in PROFILES.into_iter().zip([processor, board, card]) {
            let standard = KernelConfig::standard(&info);
            assert_eq!(standard.to_string(), numbers, "{name}");
            assert_eq!(found(&info, name.parse().unwrap()), (standard, Source::Fixed));
        }
    }

    #[test]
    fn what_is_measured_is_kept_and_found_again() {
        let Ok(gpu) = Gpu::open(None) else {
            needs::missing(needs::Need::Vulkan, "no Vulkan device");
            return;
        };
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("dgtr/kernels.toml");
        assert_eq!(kept(gpu.info(), Some(path.clone())), None);
        let (config, source) = measured(&gpu, Some(path.clone()), Some(Duration::ZERO)).unwrap();
        assert_eq!(source, Source::Kept(path.clone()));
        assert_eq!(kept(gpu.info(), Some(path)), Some((config, source)));
        // A folder that cannot be: the configuration is used, and nothing fails.
        std::fs::write(dir.path().join("file"), b"").unwrap();
        let nowhere = Some(dir.path().join("file/kernels.toml"));
        let (config, source) = measured(&gpu, nowhere, Some(Duration::ZERO)).unwrap();
        assert!(config.fits(gpu.info()) && source == Source::Measured);
    }
}
