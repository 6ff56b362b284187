//! How much memory `auto` may take: what was said, or a part of what there is.

use config::mission::DEVICE_MIB;
use config::plan::Plan;
use config::training::ShSettings;
use vulkan::gpu::GpuInfo;

/// Shares of the device's memory, and MiB at the most. A card's own memory serves nobody else here; where it is the host's, programs and
/// pictures live in it, too.
const OF_A_CARD: (u64, u64) = (2, 8192);
const OF_THE_HOST: (u64, u64) = (4, 2048);
/// In flight a card takes no more than this, for the host keeps a mirror of a part of it, and where the memory is the host's no more than
/// the default of the mission file, with which flights and the units' bounds were measured (`dgtr plan --systemd`).
const OF_A_CARD_IN_FLIGHT_MIB: u64 = 2048;
/// The least that is worth planning with, MiB.
const LEAST_MIB: u64 = 64;
/// Of the host's memory this share is left to Gaussians and device by the networks and by matching (their plan takes 909 of the default
/// 2,048 MiB).
const OF_HOST_BOUND: u64 = 3;

/// The memory there is.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Room {
    /// Of the device, MiB.
    pub device_mib: u32,
    /// Somebody said so: it is taken whole.
    pub is_said: bool,
    /// Of the host, for Gaussians and what the device takes of it, where that is bounded.
    pub host_bytes: Option<u64>,
    /// The device's memory is counted as the host's.
    pub is_host: bool,
}

impl Room {
    /// Of this device: `said` MiB, or a part of it; in a flight `host_mib` bounds the host's.
    pub fn of(info: &GpuInfo, said: Option<u32>, host_mib: Option<u32>) -> Self {
        let is_card = !info.is_cpu && !info.is_integrated;
        let (share, most) = if is_card { OF_A_CARD } else { OF_THE_HOST };
        let in_flight = if is_card { OF_A_CARD_IN_FLIGHT_MIB } else { u64::from(DEVICE_MIB) };
        let most = if host_mib.is_some() { in_flight } else { most };
        let part = ((info.heap_bytes >> 20) / share).clamp(LEAST_MIB, most);
        Self {
            device_mib: said.unwrap_or(part as u32),
            is_said: said.is_some(),
            host_bytes: host_mib.map(|mib| (u64::from(mib) << 20) / OF_HOST_BOUND),
            is_host: info.is_cpu,
        }
    }

    /// Gaussians of `plan` that the host has room for, too.
    pub fn held(&self, plan: &Plan, sh: &ShSettings) -> u32 {
        // The cloud and its checkpoint, as the host's plan counts them (`engine::host`).
        let each = 2 * 4 * (11 + 3 * (u64::from(sh.degree) + 1).pow(2)) + 20;
        let on_host = if self.is_host { plan.total_bytes } else { plan.mirror_bytes() };
        let left = |all: u64| (all.saturating_sub(on_host) / each).max(Plan::LEAST_GAUSSIANS as u64);
        let held = self.host_bytes.map_or(u64::MAX, left).min(plan.gaussians as u64);
        u32::try_from(held).unwrap_or(u32::MAX)
    }
}
