//! The processor as a device: by how many threads it computes, and how much memory it has.

use super::{DeviceLimits, GpuInfo};
use fearless_simd::Level;

/// The variable that says by how many threads Mesa's software driver computes; so many compute the kernels here.
const THREADS: &str = "LP_NUM_THREADS";

/// Threads by which a processor computes: one for each core, where [`THREADS`] does not say otherwise.
pub(super) fn threads() -> u32 {
    let cores = || std::thread::available_parallelism().map_or(1, |n| n.get() as u32);
    std::env::var(THREADS).ok().and_then(|n| n.trim().parse().ok()).unwrap_or_else(cores)
}

/// What the processor is, as other devices say it of themselves. Nothing is refused by a limit: its kernels know none.
pub(super) fn info() -> GpuInfo {
    let memory = rustix::system::sysinfo();
    GpuInfo {
        name: format!("processor ({} threads, {})", threads(), vectors()),
        version: (0, 0),
        is_cpu: true,
        is_integrated: false,
        subgroup_size: 8,
        shuffles: false,
        heap_bytes: memory.totalram as u64 * u64::from(memory.mem_unit),
        ids: (0, 0),
        driver_version: 0,
        limits: DeviceLimits { workgroup_lanes: 1 << 10, texel_elements: u32::MAX, storage_buffers: u32::MAX },
    }
}

/// The vectors that it computes with.
fn vectors() -> &'static str {
    match Level::new() {
        #[cfg(target_arch = "aarch64")]
        Level::Neon(_) => "NEON",
        #[cfg(target_arch = "x86_64")]
        Level::Avx512(_) => "AVX-512",
        #[cfg(target_arch = "x86_64")]
        Level::Avx2(_) => "AVX2",
        #[cfg(target_arch = "x86_64")]
        Level::Sse4_2(_) => "SSE4.2",
        #[cfg(target_arch = "x86_64")]
        Level::Sse2(_) => "SSE2",
        _ => "no vectors",
    }
}
