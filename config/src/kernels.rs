//! Who decides the workgroup sizes of the kernels. They belong to a device and not to a mission, which many devices share,
//! so they are given by the environment variable [`VARIABLE`]. The trained model's bytes do not depend on them.

use std::str::FromStr;

/// `auto` (or not set), `default`, or `WIDExNARROW` such as `64x8`.
pub const VARIABLE: &str = "DGTR_KERNELS";

/// Who decides.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum KernelChoice {
    /// `auto`: measured once per device and driver, then remembered.
    #[default]
    Calibrated,
    /// `default`: the built-in sizes; nothing is measured, nothing is read or written.
    Standard,
    /// `WIDExNARROW`: these.
    Fixed {
        /// Lanes of a workgroup of the plain loops over Gaussians or pixels.
        wide: u32,
        /// Lanes of a workgroup of the kernels with much state.
        narrow: u32,
    },
}

/// A value that is none of the three.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("{VARIABLE}: '{0}' is none of auto, default, WIDExNARROW (such as 64x8)")]
pub struct KernelChoiceError(String);

impl FromStr for KernelChoice {
    type Err = KernelChoiceError;

    fn from_str(text: &str) -> Result<Self, Self::Err> {
        match text {
            "" | "auto" => Ok(Self::Calibrated),
            "default" => Ok(Self::Standard),
            other => other
                .split_once('x')
                .and_then(|(wide, narrow)| Some(Self::Fixed { wide: wide.parse().ok()?, narrow: narrow.parse().ok()? }))
                .ok_or_else(|| KernelChoiceError(other.chars().take(40).collect())),
        }
    }
}

impl KernelChoice {
    /// What the environment says.
    ///
    /// # Errors
    /// A value that is none of the three.
    pub fn from_environment() -> Result<Self, KernelChoiceError> {
        std::env::var_os(VARIABLE).unwrap_or_default().to_string_lossy().parse()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_three_forms_are_read_and_everything_else_is_refused() {
        assert_eq!("".parse(), Ok(KernelChoice::Calibrated));
        assert_eq!("auto".parse(), Ok(KernelChoice::Calibrated));
        assert_eq!("default".parse(), Ok(KernelChoice::Standard));
        assert_eq!("128x16".parse(), Ok(KernelChoice::Fixed { wide: 128, narrow: 16 }));
        for bad in ["off", "64", "64x", "x8", "64x-8", "99999999999x8"] {
            let refused = bad.parse::<KernelChoice>().unwrap_err().to_string();
            assert!(refused.contains(VARIABLE) && refused.contains(bad), "{refused}");
        }
    }
}
