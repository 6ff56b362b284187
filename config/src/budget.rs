//! What a job may take: time and energy of training, memory of the device and the host. As options of a command and, in the same words, as
//! what a mission's tables say.

use crate::mission::{DEVICE_MIB, MemorySettings};
use crate::training::TrainSettings;

/// What ends a training: whichever comes first.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
#[cfg_attr(feature = "clap", derive(clap::Args))]
pub struct Budget {
    /// Optimiser steps [default: a hundred visits to each picture].
    #[cfg_attr(feature = "clap", arg(long, value_parser = clap::value_parser!(u32).range(1..)))]
    pub steps: Option<u32>,
    /// Seconds of training; with --steps, whichever comes first.
    #[cfg_attr(feature = "clap", arg(long))]
    pub seconds: Option<f64>,
    /// Watt-hours that training may take, by what the board measures or --watts says.
    #[cfg_attr(feature = "clap", arg(long))]
    pub energy_wh: Option<f64>,
}

impl Budget {
    /// What is said here, and for the rest what `[training]` says of time and energy. Its steps are a schedule's and no bound.
    #[must_use]
    pub fn or(self, training: &TrainSettings) -> Self {
        Self {
            steps: self.steps,
            seconds: self.seconds.or(training.seconds),
            energy_wh: self.energy_wh.or(training.energy_wh),
        }
    }
}

/// What a job plans its memory from. Absent numbers are chosen by the plan.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
#[cfg_attr(feature = "clap", derive(clap::Args))]
pub struct Memory {
    /// Device memory, MiB, allocated once [default: 512].
    #[cfg_attr(feature = "clap", arg(id = "budget_mib", long = "budget-mib", value_name = "BUDGET_MIB"))]
    pub device_mib: Option<u32>,
    /// Bound on the host's memory, MiB.
    #[cfg_attr(feature = "clap", arg(skip))]
    pub host_mib: Option<u32>,
    /// Most Gaussians on the device [default: what the budget holds].
    #[cfg_attr(feature = "clap", arg(long))]
    pub max_gaussians: Option<u32>,
    /// Gaussians of the whole scene, when the device holds fewer; the others wait in a file.
    #[cfg_attr(feature = "clap", arg(long, value_name = "N"))]
    pub scene_gaussians: Option<u32>,
    /// Pictures on the device at once; the others wait in a file [default: what half of the budget holds].
    #[cfg_attr(feature = "clap", arg(long, value_name = "N"))]
    pub view_slots: Option<u32>,
}

impl Memory {
    /// The one device allocation, MiB.
    pub fn device_mib(&self) -> u32 {
        self.device_mib.unwrap_or(DEVICE_MIB)
    }

    /// So much of the device, for as many Gaussians.
    pub fn for_gaussians(device_mib: u32, gaussians: usize) -> Self {
        let max_gaussians = Some(u32::try_from(gaussians).unwrap_or(u32::MAX));
        Self { device_mib: Some(device_mib), max_gaussians, ..Self::default() }
    }
}

impl From<&MemorySettings> for Memory {
    fn from(memory: &MemorySettings) -> Self {
        Self {
            device_mib: memory.device_mib,
            host_mib: Some(memory.host_mib),
            max_gaussians: memory.max_gaussians,
            scene_gaussians: memory.scene_gaussians,
            view_slots: memory.view_slots,
        }
    }
}
