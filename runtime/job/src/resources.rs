//! What the process may use and has used, as the kernel counts it.

use std::path::Path;
use std::sync::Arc;

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

/// What is freed goes back to the system, for the rest of the process: glibc raises the size from which a block is a mapping of its own
/// to that of the largest freed so far (32 MiB at most), and keeps free memory for each thread apart. A flight's growths free the same
/// tens of megabytes every few seconds: it held 797 MiB for 604 (`tests/long.sh`). Worth its page faults where work comes in small
/// parts, not where everything is made at once (first Gaussians of 43 pictures take a seventh longer). To be called before threads start.
#[cfg(target_env = "gnu")]
#[expect(unsafe_code, reason = "the allocator's settings can be reached by its own call only")]
pub fn return_freed_memory() {
    /// Blocks from this size on are mappings of their own, and as much may stay free at the end of the heap, bytes.
    const MOST_KEPT: libc::c_int = 1 << 20;
    /// Heaps that threads share.
    const HEAPS: libc::c_int = 2;
    for (setting, value) in
        [(libc::M_MMAP_THRESHOLD, MOST_KEPT), (libc::M_TRIM_THRESHOLD, MOST_KEPT), (libc::M_ARENA_MAX, HEAPS)]
    {
        // SAFETY: `mallopt` takes two numbers, sets one of the allocator's own under its lock, and refuses what it does not know.
        unsafe { libc::mallopt(setting, value) };
    }
}

/// Other allocators have no such settings.
#[cfg(not(target_env = "gnu"))]
pub fn return_freed_memory() {}

/// Makes a file that grows over `RLIMIT_FSIZE` a failed write (EFBIG), as a full disk is one, instead of the end of the process.
///
/// # Errors
/// The system refuses to install the handler.
pub fn survive_file_size_limit() -> std::io::Result<()> {
    // Nobody asks the flag: that there is a handler is enough.
    signal_hook::flag::register(signal_hook::consts::SIGXFSZ, Arc::default()).map(drop)
}

/// Most descriptors that are asked for: twice as many as one host has ports.
const MOST_OPEN: u64 = 1 << 17;

/// Lets this process have as many descriptors as the system leaves it. Each connection that says nothing holds one until it is ended;
/// a ground without any can neither receive nor write.
///
/// # Errors
/// The system's.
pub fn open_many_files() -> std::io::Result<()> {
    let Rlimit { current, maximum } = getrlimit(Resource::Nofile);
    let wanted = maximum.unwrap_or(MOST_OPEN).min(MOST_OPEN);
    if current.is_some_and(|now| now < wanted) {
        setrlimit(Resource::Nofile, Rlimit { current: Some(wanted), maximum })?;
    }
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

/// What this process may still write to, bytes: what is available, less where its own limit (RLIMIT_DATA) leaves less.
pub fn writable_bytes() -> Option<u64> {
    let limit = rustix::process::getrlimit(rustix::process::Resource::Data).current;
    let left = limit.map(|limit| limit.saturating_sub(status_bytes("VmData").unwrap_or(0)));
    match (available_bytes(), left) {
        (Some(available), Some(left)) => Some(available.min(left)),
        (available, left) => available.or(left),
    }
}

/// What this user may still write to the file system of `path`, bytes; None while it is not there.
pub fn free_disk_bytes(path: &Path) -> Option<u64> {
    let stat = rustix::fs::statvfs(path).ok()?;
    Some(stat.f_bavail.saturating_mul(stat.f_frsize))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_peak_is_at_least_what_is_resident_now() {
        let now = rss_bytes().expect("procfs");
        assert!(peak_rss_bytes().expect("procfs") + (1 << 20) >= now && now > 1 << 20);
    }

    /// This program once more, for one test that is left out otherwise.
    fn child(test: &str) -> std::process::Command {
        let mut command = std::process::Command::new(std::env::current_exe().expect("this program"));
        command.args([test, "--exact", "--ignored", "--test-threads=1"]);
        command
    }

    const TOLD: &str = "DGTR_TOLD_TO_RETURN";

    /// Not a test of its own: what the next one starts, so that nothing was allocated before.
    #[test]
    #[ignore = "started by another test"]
    #[cfg(target_env = "gnu")]
    fn block_child() {
        let Some(told) = std::env::var_os(TOLD).map(|told| told == "yes") else { return };
        if told {
            return_freed_memory();
        }
        drop(std::hint::black_box(vec![1u8; 30 << 20]));
        let block = std::hint::black_box(vec![1u8; 2 << 20]);
        // The allocator's two words lie at the beginning of a mapping.
        let own = block.as_ptr() as usize % rustix::param::page_size() == 2 * size_of::<usize>();
        assert_eq!(own, told);
    }

    #[test]
    #[cfg(target_env = "gnu")]
    fn a_large_block_is_a_mapping_of_its_own_whatever_was_freed_before() {
        for told in ["yes", "no"] {
            let output = child("resources::tests::block_child").env(TOLD, told).output().expect("starts");
            let said = String::from_utf8_lossy(&output.stdout);
            assert!(output.status.success() && said.contains("1 passed"), "{told}: {said}");
        }
    }

    const LIMITED: &str = "DGTR_FILE_SIZE_LIMITED";

    /// Not a test of its own: what the next one starts.
    #[test]
    #[ignore = "started by another test"]
    fn limited_child() {
        let Some(path) = std::env::var_os(LIMITED).map(std::path::PathBuf::from) else { return };
        if path.extension().is_some() {
            survive_file_size_limit().expect("a handler");
        }
        setrlimit(Resource::Fsize, Rlimit { current: Some(4096), maximum: None }).expect("a limit");
        let disk = disk::Disk::default();
        let e = disk.replace(&path, |out| out.write_all(&[7; 1 << 20])).expect_err("over the limit");
        assert!(disk::is_full(&e.source), "{e}");
        assert!(!path.exists());
    }

    #[test]
    fn a_file_over_the_size_limit_is_an_error_and_not_the_end_of_the_process() {
        use std::os::unix::process::ExitStatusExt;
        let dir = tempfile::tempdir().expect("folder");
        let run = |name: &str| {
            let mut command = child("resources::tests::limited_child");
            command.env(LIMITED, dir.path().join(name)).stdout(std::process::Stdio::null());
            command.stderr(std::process::Stdio::null()).status().expect("starts")
        };
        assert_eq!(run("bare").signal(), Some(signal_hook::consts::SIGXFSZ), "without the handler it is the end");
        assert!(run("survives.bin").success());
        assert_eq!(
            std::fs::read_dir(dir.path())
                .expect("folder")
                .flatten()
                .filter(|e| !e.file_name().to_string_lossy().starts_with(".dgtr-"))
                .count(),
            0
        );
    }
}
