//! What the process may use and has used, as the kernel counts it.

use rustix::process::{Resource, Rlimit, getrlimit, setrlimit};

/// Bounds the memory this process may write to (heap, stacks, private mappings) for the rest of its life.
///
/// `RLIMIT_DATA`, not `RLIMIT_AS`: a software Vulkan driver reserves address space it never touches.
///
/// # Errors
/// The kernel's, when the hard limit is already lower.
pub fn limit_data(mib: u64) -> std::io::Result<()> {
    let bytes = mib.saturating_mul(1 << 20);
    let hard = getrlimit(Resource::Data).maximum;
    setrlimit(Resource::Data, Rlimit { current: Some(bytes), maximum: hard })?;
    Ok(())
}

/// One `Name:  N kB` line of /proc/self/status, in bytes; None where there is no procfs.
fn status_bytes(name: &str) -> Option<u64> {
    let status = std::fs::read_to_string("/proc/self/status").ok()?;
    let line = status.lines().find_map(|l| l.strip_prefix(name)?.strip_prefix(':'))?;
    line.trim().strip_suffix(" kB")?.trim().parse::<u64>().ok().map(|k| k * 1024)
}

/// Highest resident set size so far, bytes.
pub fn peak_rss_bytes() -> Option<u64> {
    status_bytes("VmHWM")
}

/// Resident set size now, bytes.
pub fn rss_bytes() -> Option<u64> {
    status_bytes("VmRSS")
}

/// What the kernel believes could be allocated now without swapping, bytes.
pub fn available_bytes() -> Option<u64> {
    let info = std::fs::read_to_string("/proc/meminfo").ok()?;
    let line = info.lines().find_map(|l| l.strip_prefix("MemAvailable:"))?;
    line.trim().strip_suffix(" kB")?.trim().parse::<u64>().ok().map(|k| k * 1024)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_peak_is_at_least_what_is_resident_now() {
        let now = rss_bytes().expect("procfs");
        assert!(peak_rss_bytes().expect("procfs") + (1 << 20) >= now && now > 1 << 20);
    }
}
