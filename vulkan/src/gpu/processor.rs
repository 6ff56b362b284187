//! The processor as a device: by how many threads it computes.

/// The variable that says by how many threads Mesa's software driver computes; so many compute the kernels here.
const THREADS: &str = "LP_NUM_THREADS";

/// Threads by which a processor computes: one for each core, where [`THREADS`] does not say otherwise.
pub(super) fn threads() -> u32 {
    let cores = || std::thread::available_parallelism().map_or(1, |n| n.get() as u32);
    std::env::var(THREADS).ok().and_then(|n| n.trim().parse().ok()).unwrap_or_else(cores)
}
