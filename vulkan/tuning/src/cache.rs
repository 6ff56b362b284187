//! `dgtr/kernels.toml` in the user's cache folder: per device, driver version and set of kernels the configuration that was
//! measured, the small step that devices are compared by, and what steps cost by how many threads. It is only a cache: it may be
//! deleted, be damaged or be somebody's handiwork at any time.

use std::path::{Path, PathBuf};

use models::formats::{FormatError, read_bounded, write_atomic};
use serde::{Deserialize, Serialize};
use vulkan::gpu::GpuInfo;
use vulkan::kernel_config::{KernelConfig, kernels_fingerprint};

use crate::model::CostModel;

/// Bound on the file; an entry takes some 400 bytes at the most.
const LIMIT: u64 = 128 << 10;
/// Devices that are remembered.
const MOST_DEVICES: usize = 64;

/// The file.
#[derive(Debug, Default, Deserialize, Serialize)]
struct Kept {
    /// The one measured last comes last.
    #[serde(default)]
    device: Vec<Entry>,
    /// Steps, the one measured last comes last.
    #[serde(default)]
    step: Vec<Step>,
    /// Costs, the one measured last comes last.
    #[serde(default)]
    cost: Vec<Cost>,
}

/// Which device, with which driver, ran which kernels.
#[derive(Clone, Debug, PartialEq, Eq, Deserialize, Serialize)]
struct Id {
    name: String,
    vendor_id: u32,
    device_id: u32,
    driver_version: u32,
    /// Fingerprint of the kernels, hexadecimal.
    kernels: String,
}

impl Id {
    fn of(info: &GpuInfo) -> Self {
        Self {
            name: info.name.clone(),
            vendor_id: info.ids.0,
            device_id: info.ids.1,
            driver_version: info.driver_version,
            kernels: format!("{:016x}", kernels_fingerprint()),
        }
    }

    /// Whatever its driver and the kernels were.
    fn is_device(&self, other: &Self) -> bool {
        (&self.name, self.vendor_id, self.device_id) == (&other.name, other.vendor_id, other.device_id)
    }
}

/// A device's small step.
#[derive(Clone, Debug, PartialEq, Deserialize, Serialize)]
struct Step {
    #[serde(flatten)]
    id: Id,
    ms: f64,
}

/// What steps cost on a device with so many threads and kernels of this configuration.
#[derive(Clone, Debug, PartialEq, Deserialize, Serialize)]
struct Cost {
    #[serde(flatten)]
    id: Id,
    threads: u32,
    config: String,
    #[serde(flatten)]
    model: CostModel,
}

/// A device's configuration.
#[derive(Clone, Debug, PartialEq, Eq, Deserialize, Serialize)]
struct Entry {
    #[serde(flatten)]
    id: Id,
    wide: u32,
    narrow: u32,
    share_lanes: u32,
    tiles: u32,
    tile_lanes: u32,
    fetched: u32,
    summed: u32,
    part: u32,
}

impl Entry {
    fn of(info: &GpuInfo, config: KernelConfig) -> Self {
        let KernelConfig { wide, narrow, share_lanes, tiles, tile_lanes, fetched, summed, part } = config;
        Self { id: Id::of(info), wide, narrow, share_lanes, tiles, tile_lanes, fetched, summed, part }
    }

    fn config(&self) -> KernelConfig {
        let Self { wide, narrow, share_lanes, tiles, tile_lanes, fetched, summed, part, .. } = *self;
        KernelConfig { wide, narrow, share_lanes, tiles, tile_lanes, fetched, summed, part }
    }
}

/// Puts `new` last, in place of what was kept of the same; the one measured longest ago makes room.
fn remember<T>(kept: &mut Vec<T>, new: T, is_same: fn(&T, &T) -> bool) {
    kept.retain(|old| !is_same(old, &new));
    kept.push(new);
    let over = kept.len().saturating_sub(MOST_DEVICES);
    kept.drain(..over);
}

/// Where the file lies; none without a home.
pub fn path() -> Option<PathBuf> {
    let folder = |name: &str| std::env::var_os(name).map(PathBuf::from).filter(|p| p.is_absolute());
    let cache = folder("XDG_CACHE_HOME").or_else(|| folder("HOME").map(|home| home.join(".cache")))?;
    Some(cache.join("dgtr/kernels.toml"))
}

/// What was measured on this very device, with this driver and these kernels; `None` when nothing was.
///
/// # Errors
/// A file that is there and cannot be used.
pub fn read(path: &Path, info: &GpuInfo) -> Result<Option<KernelConfig>, FormatError> {
    let kept = load(path)?;
    // Another driver's, or other kernels', says nothing.
    let id = Id::of(info);
    let found = kept.device.iter().rev().find(|e| e.id == id);
    match found.map(Entry::config) {
        Some(config) if !config.fits(info) => {
            let what = format!("{}: {config} is no configuration this device can run", info.name);
            Err(FormatError::Invalid { path: path.into(), what })
        }
        config => Ok(config),
    }
}

/// Remembers `config`, in place of whatever was remembered of the device. A damaged file is begun anew.
///
/// # Errors
/// A file or folder that cannot be written.
pub fn write(path: &Path, info: &GpuInfo, config: KernelConfig) -> Result<(), FormatError> {
    let mut kept = load(path).unwrap_or_default();
    remember(&mut kept.device, Entry::of(info, config), |a, b| a.id.is_device(&b.id));
    save(path, &kept)
}

/// Milliseconds of the small step on this very device, with this driver and these kernels; `None` when it was not measured.
///
/// # Errors
/// A file that is there and cannot be used.
pub fn read_step(path: &Path, info: &GpuInfo) -> Result<Option<f64>, FormatError> {
    let (kept, id) = (load(path)?, Id::of(info));
    let found = kept.step.iter().rev().find(|s| s.id == id);
    Ok(found.map(|s| s.ms).filter(|ms| *ms > 0.0))
}

/// Remembers it, in place of what was remembered of the device. A damaged file is begun anew.
///
/// # Errors
/// A file or folder that cannot be written.
pub fn write_step(path: &Path, info: &GpuInfo, ms: f64) -> Result<(), FormatError> {
    let mut kept = load(path).unwrap_or_default();
    remember(&mut kept.step, Step { id: Id::of(info), ms }, |a, b| a.id.is_device(&b.id));
    save(path, &kept)
}

/// What steps cost on this very device, with this driver, so many threads and kernels of this configuration; `None` when it was not measured.
///
/// # Errors
/// A file that is there and cannot be used.
pub fn read_cost(
    path: &Path,
    info: &GpuInfo,
    threads: u32,
    config: KernelConfig,
) -> Result<Option<CostModel>, FormatError> {
    let (kept, id, config) = (load(path)?, Id::of(info), config.to_string());
    let found = kept.cost.iter().rev().find(|c| c.id == id && c.threads == threads && c.config == config);
    Ok(found.map(|c| c.model).filter(CostModel::is_sound))
}

/// Remembers it, in place of what was remembered of the device with so many threads. A damaged file is begun anew.
///
/// # Errors
/// A file or folder that cannot be written.
pub fn write_cost(
    path: &Path,
    info: &GpuInfo,
    threads: u32,
    config: KernelConfig,
    model: CostModel,
) -> Result<(), FormatError> {
    let mut kept = load(path).unwrap_or_default();
    let new = Cost { id: Id::of(info), threads, config: config.to_string(), model };
    remember(&mut kept.cost, new, |a, b| a.id.is_device(&b.id) && a.threads == b.threads);
    save(path, &kept)
}

fn save(path: &Path, kept: &Kept) -> Result<(), FormatError> {
    let text = toml::to_string(kept).map_err(|e| FormatError::Invalid { path: path.into(), what: e.to_string() })?;
    write_atomic(path, |out| {
        writeln!(
            out,
            "# Kernel configurations, steps and their costs, measured by dgtr (`dgtr doctor --autotune`); may be deleted."
        )?;
        out.write_all(text.as_bytes())
    })
}

fn load(path: &Path) -> Result<Kept, FormatError> {
    if !path.exists() {
        return Ok(Kept::default());
    }
    let invalid = |what: String| FormatError::Invalid { path: path.into(), what };
    let text = String::from_utf8(read_bounded(path, LIMIT)?).map_err(|_| invalid("not UTF-8 text".into()))?;
    // One line, as every warning is.
    toml::from_str(&text).map_err(|e| invalid(e.message().to_owned()))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::fixtures::device;

    const CONFIG: KernelConfig = KernelConfig {
        wide: 128,
        narrow: 16,
        share_lanes: 16,
        tiles: 8,
        tile_lanes: 8,
        fetched: 8,
        summed: 1,
        part: 2,
    };
    const OTHER: KernelConfig =
        KernelConfig { wide: 64, narrow: 32, share_lanes: 1, tiles: 32, tile_lanes: 1, fetched: 1, summed: 1, part: 8 };

    #[test]
    fn every_device_gets_its_own_configuration_back() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("deep/dgtr/kernels.toml");
        let (a, b) = (device("V3D \"7.1\""), device("llvmpipe"));
        assert_eq!(read(&path, &a).unwrap(), None);
        write(&path, &a, CONFIG).unwrap();
        write(&path, &b, OTHER).unwrap();
        assert_eq!(read(&path, &a).unwrap(), Some(CONFIG));
        assert_eq!(read(&path, &b).unwrap(), Some(OTHER));
    }

    #[test]
    fn the_step_of_a_device_is_kept_beside_its_configuration_until_its_driver_changes() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("kernels.toml");
        let (a, b) = (device("V3D"), device("llvmpipe"));
        write(&path, &a, CONFIG).unwrap();
        write_step(&path, &a, 12.5).unwrap();
        write_step(&path, &b, 3.25).unwrap();
        write_step(&path, &b, 3.5).unwrap();
        assert_eq!([&a, &b].map(|info| read_step(&path, info).unwrap()), [Some(12.5), Some(3.5)]);
        assert_eq!(read(&path, &a).unwrap(), Some(CONFIG));
        assert_eq!(read_step(&path, &GpuInfo { driver_version: 8, ..a.clone() }).unwrap(), None);
        // What nobody could have measured is not believed.
        for ms in [0.0, -1.0, f64::NAN, f64::INFINITY] {
            write_step(&path, &a, ms).unwrap();
            assert!(read_step(&path, &a).unwrap().is_none_or(|ms| ms > 0.0), "{ms}");
        }
        let endless = (0..2 * MOST_DEVICES).map(|i| device(&format!("device {i}")));
        endless.for_each(|info| write_step(&path, &info, 1.0).unwrap());
        assert!(std::fs::metadata(&path).unwrap().len() < LIMIT);
    }

    #[test]
    fn what_steps_cost_is_kept_by_driver_threads_and_config() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("kernels.toml");
        let (info, of) = (device("llvmpipe"), |pixel_ns: f64| CostModel { pixel_ns, ..CostModel::default() });
        write(&path, &info, CONFIG).unwrap();
        write_cost(&path, &info, 1, CONFIG, of(3.0)).unwrap();
        write_cost(&path, &info, 2, CONFIG, of(2.0)).unwrap();
        let read = |info: &GpuInfo, threads, config| read_cost(&path, info, threads, config).unwrap();
        assert_eq!([1, 2, 4].map(|n| read(&info, n, CONFIG)), [Some(of(3.0)), Some(of(2.0)), None]);
        assert_eq!(read(&info, 2, OTHER), None, "other kernels take other times");
        assert_eq!(read(&GpuInfo { driver_version: 8, ..info.clone() }, 2, CONFIG), None);
        write_cost(&path, &info, 2, OTHER, of(1.0)).unwrap();
        assert_eq!((read(&info, 2, CONFIG), read(&info, 2, OTHER)), (None, Some(of(1.0))));
        assert_eq!(super::read(&path, &info).unwrap(), Some(CONFIG));
        // What nobody could have measured is not believed.
        for ns in [f64::NAN, -1.0, f64::INFINITY, 0.0] {
            write_cost(&path, &info, 1, CONFIG, of(ns)).unwrap();
            assert_eq!(read_cost(&path, &info, 1, CONFIG).unwrap_or(None), None, "{ns}");
        }
        (0..2 * MOST_DEVICES as u32).for_each(|n| write_cost(&path, &info, n, CONFIG, of(1.0)).unwrap());
        (0..2 * MOST_DEVICES).for_each(|i| write(&path, &device(&format!("device {i}")), CONFIG).unwrap());
        assert!(std::fs::metadata(&path).unwrap().len() < LIMIT);
    }

    #[test]
    fn another_driver_version_or_other_kernels_are_measured_anew_and_replace_the_entry() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("kernels.toml");
        let old = device("V3D");
        let new = GpuInfo { driver_version: 8, ..old.clone() };
        write(&path, &old, CONFIG).unwrap();
        assert_eq!(read(&path, &new).unwrap(), None);
        write(&path, &new, OTHER).unwrap();
        assert_eq!(read(&path, &new).unwrap(), Some(OTHER));
        assert_eq!(read(&path, &old).unwrap(), None);
        let fingerprint = format!("{:016x}", kernels_fingerprint());
        let text = std::fs::read_to_string(&path).unwrap();
        assert_eq!(text.matches(&fingerprint).count(), 1, "{text}");
        std::fs::write(&path, text.replace(&fingerprint, "0123456789abcdef")).unwrap();
        assert_eq!(read(&path, &new).unwrap(), None);
    }

    #[test]
    fn a_damaged_file_is_reported_in_one_line_and_begun_anew() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("kernels.toml");
        let info = device("V3D");
        write(&path, &info, CONFIG).unwrap();
        let sound = std::fs::read_to_string(&path).unwrap();
        let unusable = sound.replace("wide = 128", "wide = 48");
        let endless = "#".repeat(LIMIT as usize + 1);
        let cut = sound.split_at(sound.find("kernels =").unwrap() + 12).0;
        for damaged in [cut.as_bytes(), b"\xff\xfe", endless.as_bytes(), unusable.as_bytes(), b"device = 3"] {
            std::fs::write(&path, damaged).unwrap();
            let said = read(&path, &info).unwrap_err().to_string();
            assert!(said.contains("kernels.toml") && said.lines().count() == 1, "{said}");
            write(&path, &info, CONFIG).unwrap();
            assert_eq!(read(&path, &info).unwrap(), Some(CONFIG));
        }
    }

    #[test]
    fn the_file_does_not_grow_without_end() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("kernels.toml");
        for i in 0..MOST_DEVICES + 5 {
            write(&path, &device(&format!("device {i}")), CONFIG).unwrap();
        }
        assert_eq!(load(&path).unwrap().device.len(), MOST_DEVICES);
        assert_eq!(read(&path, &device("device 0")).unwrap(), None);
        assert_eq!(read(&path, &device("device 68")).unwrap(), Some(CONFIG));
        assert!(std::fs::metadata(&path).unwrap().len() < LIMIT);
    }

    #[test]
    fn a_folder_that_cannot_be_written_is_an_error_and_no_panic() {
        let dir = tempfile::tempdir().unwrap();
        std::fs::write(dir.path().join("file"), b"").unwrap();
        assert!(write(&dir.path().join("file/kernels.toml"), &device("V3D"), CONFIG).is_err());
    }
}
