//! Who decides the kernel configuration: workgroup sizes, and how many lanes share a tile. It belongs to a device and
//! not to a mission, which many devices share, so the environment variable [`VARIABLE`] names it. The trained
//! model's bytes do not depend on it.

use std::str::FromStr;

/// `auto` (or not set), `default`, a profile of [`PROFILES`], or, to tune,
/// `WIDExNARROWxSHARExTILESxRUNSxFETCHEDxSUMMEDxPART` such as `64x8x1x8x1x1x1x8`.
pub const VARIABLE: &str = "DGTR_KERNELS";

/// What the three kinds of devices begin with, by name: a processor (Mesa's llvmpipe), a board's GPU, a graphics card.
pub const PROFILES: [(&str, &str); 3] =
    [("processor", "64x8x1x8x1x1x1x8"), ("board", "64x32x1x8x8x1x1x2"), ("card", "64x32x32x8x8x1x8x8")];

/// Who decides.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum KernelChoice {
    /// `auto`: measured once per device and driver, then remembered.
    #[default]
    Autotuned,
    /// `default`: the built-in sizes; nothing is measured, nothing is read or written.
    Standard,
    /// A profile's numbers, or `WIDExNARROWxSHARExTILESxRUNSxFETCHEDxSUMMEDxPART`.
    Fixed {
        /// Lanes of a workgroup of the plain loops over Gaussians or pixels.
        wide: u32,
        /// Lanes of a workgroup of the kernels that sort, count and emit.
        narrow: u32,
        /// Lanes that work on a share of the Gaussians: 1, or `narrow`.
        share_lanes: u32,
        /// Tiles of a workgroup of the blend: 8, 16 or 32; or 2, whose 8 lanes each meet in shared memory, as all do (2 or 8 tiles) where
        /// lanes cannot read each other.
        tiles: u32,
        /// Lanes that blend a tile: 1, or 8.
        tile_lanes: u32,
        /// Gaussians that the lanes of a tile fetch at once: 1, or `tile_lanes`.
        fetched: u32,
        /// Lanes of a tile whose sums are added at once: 1, in a loop and with fewer registers, or `tile_lanes`.
        summed: u32,
        /// Pixels of a strip whose SSIM sums a lane holds at once: 8, or 2.
        part: u32,
    },
}

/// A value that names no configuration.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error(
    "{VARIABLE}: '{0}' is none of auto, default, processor, board, card and no eight numbers such as 64x8x1x8x1x1x1x8"
)]
pub struct KernelChoiceError(String);

impl FromStr for KernelChoice {
    type Err = KernelChoiceError;

    fn from_str(text: &str) -> Result<Self, Self::Err> {
        match text {
            "" | "auto" => Ok(Self::Autotuned),
            "default" => Ok(Self::Standard),
            other => fixed(profile(other)).ok_or_else(|| KernelChoiceError(other.chars().take(40).collect())),
        }
    }
}

/// The numbers of the profile of this name; what names none is taken for numbers.
fn profile(text: &str) -> &str {
    PROFILES.iter().find(|(name, _)| *name == text).map_or(text, |(_, numbers)| numbers)
}

fn fixed(text: &str) -> Option<KernelChoice> {
    let mut numbers = text.split('x').map(|n| n.parse().ok());
    let [wide, narrow, share_lanes, tiles, tile_lanes, fetched, summed, part] =
        [(); 8].map(|()| numbers.next().flatten());
    let none_left = numbers.next().is_none();
    none_left.then_some(KernelChoice::Fixed {
        wide: wide?,
        narrow: narrow?,
        share_lanes: share_lanes?,
        tiles: tiles?,
        tile_lanes: tile_lanes?,
        fetched: fetched?,
        summed: summed?,
        part: part?,
    })
}

/// `native` (or not set) or `driver`: whose kernels run where the device is the processor.
pub const PROCESSOR_VARIABLE: &str = "DGTR_PROCESSOR";

/// Whose kernels run where the device is the processor.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum ProcessorKernels {
    /// Functions of this program.
    #[default]
    Native,
    /// Kernels of the software driver, as on any other device.
    Driver,
}

/// A value of [`PROCESSOR_VARIABLE`] that names nobody's kernels.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("{PROCESSOR_VARIABLE}: '{0}' is neither native nor driver")]
pub struct ProcessorKernelsError(String);

impl FromStr for ProcessorKernels {
    type Err = ProcessorKernelsError;

    fn from_str(text: &str) -> Result<Self, Self::Err> {
        match text {
            "" | "native" => Ok(Self::Native),
            "driver" => Ok(Self::Driver),
            other => Err(ProcessorKernelsError(other.chars().take(40).collect())),
        }
    }
}

impl ProcessorKernels {
    /// What the environment says.
    ///
    /// # Errors
    /// A value that names nobody's kernels.
    pub fn from_environment() -> Result<Self, ProcessorKernelsError> {
        std::env::var_os(PROCESSOR_VARIABLE).unwrap_or_default().to_string_lossy().parse()
    }
}

impl KernelChoice {
    /// What the environment says.
    ///
    /// # Errors
    /// A value that names no configuration.
    pub fn from_environment() -> Result<Self, KernelChoiceError> {
        std::env::var_os(VARIABLE).unwrap_or_default().to_string_lossy().parse()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_processor_s_kernels_are_native_or_the_driver_s() {
        for (text, expected) in
            [("", ProcessorKernels::Native), ("native", ProcessorKernels::Native), ("driver", ProcessorKernels::Driver)]
        {
            assert_eq!(text.parse(), Ok(expected));
        }
        let refused = "gpu".parse::<ProcessorKernels>().unwrap_err().to_string();
        assert!(refused.contains(PROCESSOR_VARIABLE) && refused.contains("gpu"), "{refused}");
    }

    #[test]
    fn names_profiles_and_numbers_are_read_and_everything_else_is_refused() {
        assert_eq!("".parse(), Ok(KernelChoice::Autotuned));
        assert_eq!("auto".parse(), Ok(KernelChoice::Autotuned));
        assert_eq!("default".parse(), Ok(KernelChoice::Standard));
        let fixed = KernelChoice::Fixed {
            wide: 128,
            narrow: 16,
            share_lanes: 16,
            tiles: 8,
            tile_lanes: 8,
            fetched: 1,
            summed: 8,
            part: 2,
        };
        assert_eq!("128x16x16x8x8x1x8x2".parse(), Ok(fixed));
        for (name, numbers) in PROFILES {
            assert!(
                matches!(name.parse(), Ok(KernelChoice::Fixed { .. }))
                    && name.parse::<KernelChoice>() == numbers.parse()
            );
        }
        let bad = "off Board 64 64x8 64x8x1x8x1x1x8 64x8x1x8x1x1x1x x8x1x8x1x1x1x8 64x-8x1x8x1x1x1x8 99999999999x8x1x8x1x1x1x8 \
                   64x8x1x8x1x1x1x8x1";
        for bad in bad.split(' ') {
            let refused = bad.parse::<KernelChoice>().unwrap_err().to_string();
            assert!(refused.contains(VARIABLE) && refused.contains(bad), "{refused}");
        }
    }
}
