//! The companion's own state as flags of the failsafe ladder, beside those of the HAL: temperature, memory, training.

use std::path::PathBuf;

use hal::failsafe::Flags;

use crate::resources;

/// Linux thermal zones report millidegrees; a Raspberry Pi 5 and an RK3588 throttle from 80–85 °C on.
const HOT_MILLIDEGREES: i64 = 80_000;
/// Where they shut down soon after.
const VERY_HOT_MILLIDEGREES: i64 = 90_000;
/// Share of the host budget from which memory counts as short.
const MEMORY_SHARE: f64 = 0.95;

/// Reads the flags; keeps nothing but where to look.
pub struct Health {
    zones: Vec<PathBuf>,
    host_bytes: u64,
}

impl Health {
    /// Looks for thermal sensors; `host_mib` is the mission's bound on resident memory.
    pub fn new(host_mib: u32) -> Self {
        let zones = std::fs::read_dir("/sys/class/thermal").into_iter().flatten().flatten();
        let zones = zones.map(|z| z.path().join("temp")).filter(|p| p.is_file()).take(32).collect();
        Self { zones, host_bytes: u64::from(host_mib) << 20 }
    }

    /// Looks at memory only, so that a hot machine changes nothing.
    #[cfg(test)]
    pub fn without_sensors(host_mib: u32) -> Self {
        Self { zones: Vec::new(), host_bytes: u64::from(host_mib) << 20 }
    }

    /// What is seen now: `seen` by the HAL, and here.
    pub fn flags(&self, seen: Flags, training_failed: bool) -> Flags {
        let hottest =
            self.zones.iter().filter_map(|z| std::fs::read_to_string(z).ok()?.trim().parse::<i64>().ok()).max();
        let rss = resources::rss_bytes().unwrap_or(0);
        Flags {
            hot: hottest.is_some_and(|t| t >= HOT_MILLIDEGREES),
            very_hot: hottest.is_some_and(|t| t >= VERY_HOT_MILLIDEGREES),
            memory_low: rss as f64 > MEMORY_SHARE * self.host_bytes as f64,
            training_failed,
            ..seen
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_small_host_budget_is_flagged_beside_what_the_hal_saw() {
        let seen = Flags { battery_low: true, ..Flags::default() };
        let flags = Health::new(1).flags(seen, true);
        assert!(flags.memory_low && flags.battery_low && flags.training_failed && !flags.link_lost);
        let flags = Health::new(1 << 20).flags(Flags::default(), false);
        assert!(!flags.memory_low && !flags.battery_low && !flags.training_failed);
    }
}
