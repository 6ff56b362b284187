//! The bounds a service manager sets a flight: the numbers of the mission's own plan, in the words of systemd.resource-control(5).

use std::fmt;

use config::mission::MemorySettings;

/// Where the device's memory lies.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum DeviceMemory {
    /// In the host's, beside the job's own: a board's GPU.
    Shared,
    /// In the host's, and counted there by the host's plan: a software renderer.
    Planned,
    /// On a card of its own.
    Separate,
}

/// Bounds of one flight's service.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct ServiceLimits {
    host_mib: u64,
    /// The part of the bound that is the device's; 0: it lies elsewhere or is counted already.
    device_mib: u64,
    /// Processors for the job, and all that there are.
    processors: (usize, usize),
}

impl ServiceLimits {
    /// What a flight with `memory` may take of a computer with so many processors: one of them stays free for the system and
    /// the autopilot's bridge, wherever there are two.
    pub fn of_flight(memory: &MemorySettings, device: DeviceMemory, processors: usize) -> Self {
        let device_mib = if device == DeviceMemory::Shared { memory.device_mib().into() } else { 0 };
        Self {
            host_mib: memory.host_mib.into(),
            device_mib,
            processors: (processors.saturating_sub(1).max(1), processors),
        }
    }
}

/// The text of a drop-in.
impl fmt::Display for ServiceLimits {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { host_mib, device_mib, processors: (ours, all) } = self;
        writeln!(f, "[Service]\n# memory.host_mib = {host_mib}")?;
        if *device_mib > 0 {
            writeln!(f, "# memory.device_mib = {device_mib}, in the same memory")?;
        }
        writeln!(f, "MemoryMax={}M\n# {ours} of {all} processors\nCPUQuota={}%", host_mib + device_mib, 100 * ours)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_bound_on_memory_is_the_missions_and_a_devices_share_is_counted_once() {
        let memory = MemorySettings { host_mib: 3000, device_mib: Some(700), ..MemorySettings::default() };
        let bound = |device| ServiceLimits::of_flight(&memory, device, 4).to_string();
        assert!(bound(DeviceMemory::Shared).contains("\nMemoryMax=3700M\n"));
        assert!(bound(DeviceMemory::Planned).contains("\nMemoryMax=3000M\n"));
        assert!(bound(DeviceMemory::Separate).contains("\nMemoryMax=3000M\n"));
    }

    #[test]
    fn one_processor_stays_free_where_there_are_two() {
        let quota = |n| ServiceLimits::of_flight(&MemorySettings::default(), DeviceMemory::Shared, n).to_string();
        for (processors, percent) in [(1, 100), (2, 100), (4, 300), (8, 700)] {
            assert!(quota(processors).ends_with(&format!("\nCPUQuota={percent}%\n")), "{processors}");
        }
    }

    /// What the package ships holds for a board of four processors and a mission that says nothing of memory.
    #[test]
    fn the_shipped_unit_has_the_bounds_of_a_missions_defaults() {
        let unit = include_str!("../../../package/dgtr-fly.service");
        let limits = ServiceLimits::of_flight(&MemorySettings::default(), DeviceMemory::Shared, 4).to_string();
        for line in limits.lines().filter(|l| l.contains('=') && !l.starts_with('#')) {
            assert!(unit.lines().any(|l| l == line), "{line} is not in the unit");
        }
    }
}
