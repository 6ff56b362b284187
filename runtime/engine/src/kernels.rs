//! Which shape of the kernels this process trains with: the one the user fixed, the one measured earlier on this device with this
//! driver and these kernels, or the one measured now. Whatever goes wrong on the way costs a warning and some speed, never
//! the run; and since the shape changes no bit of the model, it needs no place in it.

use std::path::PathBuf;
use std::time::Duration;

use config::kernels::{KernelChoice, VARIABLE};
use vulkan::calibration::calibrate;
use vulkan::gpu::{Gpu, GpuInfo};
use vulkan::shape::KernelShape;

pub mod cache;

/// No further shape is tried after this when nobody asked for it.
const PATIENCE: Duration = Duration::from_millis(1500);

/// Where a shape comes from.
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

/// The shape that commands use on `gpu`, measured first if it never was. Call it before anything that must not wait: it
/// may take a second or two. A software renderer compiles for seconds per shape, so it is measured on request only
/// ([`measure`]).
pub fn shape_of(gpu: &Gpu) -> KernelShape {
    let choice = choice();
    let (shape, source) = found(gpu.info(), choice);
    if source == Source::Standard && choice == KernelChoice::Calibrated && !gpu.info().is_cpu {
        return measured(gpu, cache::path(), Some(PATIENCE)).map_or(shape, |m| m.0);
    }
    shape
}

/// The shape on the device and where it comes from, without measuring.
pub fn known(info: &GpuInfo) -> (KernelShape, Source) {
    found(info, choice())
}

fn found(info: &GpuInfo, choice: KernelChoice) -> (KernelShape, Source) {
    let standard = (KernelShape::standard(info), Source::Standard);
    match choice {
        KernelChoice::Standard => standard,
        KernelChoice::Fixed { wide, narrow, share_lanes, tiles, tile_lanes, fetched, summed, part } => {
            let fixed = KernelShape { wide, narrow, share_lanes, tiles, tile_lanes, fetched, summed, part };
            if fixed.fits(info) {
                return (fixed, Source::Fixed);
            }
            tracing::warn!("{VARIABLE}: {} cannot run {fixed}; the default is used", info.name);
            standard
        }
        KernelChoice::Calibrated => kept(info, cache::path()).unwrap_or(standard),
    }
}

/// Measures the device with every shape, whatever is kept, and keeps the result; `None` (and a warning) when it cannot be measured.
pub fn measure(gpu: &Gpu) -> Option<(KernelShape, Source)> {
    measured(gpu, cache::path(), None)
}

/// What [`VARIABLE`] asks for; what cannot be understood is warned of and is the default.
pub fn choice() -> KernelChoice {
    KernelChoice::from_environment().unwrap_or_else(|e| {
        tracing::warn!("{e}; the default is used");
        KernelChoice::Standard
    })
}

fn kept(info: &GpuInfo, path: Option<PathBuf>) -> Option<(KernelShape, Source)> {
    let path = path?;
    match cache::read(&path, info) {
        Ok(shape) => shape.map(|shape| (shape, Source::Kept(path))),
        Err(e) => {
            tracing::warn!("kernel shapes of earlier runs are not used: {e}");
            None
        }
    }
}

fn measured(gpu: &Gpu, path: Option<PathBuf>, limit: Option<Duration>) -> Option<(KernelShape, Source)> {
    let name = &gpu.info().name;
    tracing::info!("{name}: measuring which shape of the kernels is the fastest (once)");
    let found = match calibrate(gpu, limit) {
        Ok(found) => found,
        Err(e) => {
            tracing::warn!("{name}: kernels could not be measured, the default shape is used: {e}");
            return None;
        }
    };
    for shape in &found.refused {
        tracing::warn!("{name}: kernels of shape {shape} compute something else here and are never used");
    }
    tracing::info!("{name}: kernels of shape {}, measured in {:.1} s", found.shape, found.seconds);
    let Some(path) = path else {
        tracing::warn!("neither XDG_CACHE_HOME nor HOME is set: kernels are measured anew next time");
        return Some((found.shape, Source::Measured));
    };
    match cache::write(&path, gpu.info(), found.shape) {
        Ok(()) => Some((found.shape, Source::Kept(path))),
        Err(e) => {
            tracing::warn!("the kernels' shape is not kept and will be measured anew next time: {e}");
            Some((found.shape, Source::Measured))
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_measured_is_kept_and_found_again() {
        let Ok(gpu) = Gpu::open(None) else {
            println!("skipped: no Vulkan device");
            return;
        };
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("dgtr/kernels.toml");
        assert_eq!(kept(gpu.info(), Some(path.clone())), None);
        let (shape, source) = measured(&gpu, Some(path.clone()), Some(Duration::ZERO)).unwrap();
        assert_eq!(source, Source::Kept(path.clone()));
        assert_eq!(kept(gpu.info(), Some(path)), Some((shape, source)));
        // A folder that cannot be: the shape is used, and nothing fails.
        std::fs::write(dir.path().join("file"), b"").unwrap();
        let nowhere = Some(dir.path().join("file/kernels.toml"));
        let (shape, source) = measured(&gpu, nowhere, Some(Duration::ZERO)).unwrap();
        assert!(shape.fits(gpu.info()) && source == Source::Measured);
    }
}
