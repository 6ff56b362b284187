//! Who the computer is, without its name, addresses or serial numbers.

use serde::Serialize;

/// The computer.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize)]
pub struct Machine {
    /// What its maker calls it (device tree or DMI).
    pub model: Option<String>,
    /// The processor, where it says so.
    pub processor: Option<String>,
    /// Cores that this process may use.
    pub cores: usize,
    /// Memory, MiB.
    pub memory_mib: Option<u64>,
    /// Release of the kernel.
    pub kernel: Option<String>,
    /// Architecture that the program was built for.
    pub architecture: &'static str,
}

impl Machine {
    /// This one.
    pub fn here() -> Self {
        let line = |path: &str| {
            let text = std::fs::read_to_string(path).ok()?;
            let text = text.trim_matches(|c: char| c == '\0' || c.is_whitespace()).to_owned();
            (!text.is_empty()).then_some(text)
        };
        let after = |path: &str, key: &str| {
            let text = std::fs::read_to_string(path).ok()?;
            let value = text.lines().find_map(|l| l.strip_prefix(key))?;
            Some(value.trim_start_matches([' ', '\t', ':']).trim().to_owned())
        };
        let kib = after("/proc/meminfo", "MemTotal").and_then(|v| v.split(' ').next()?.parse::<u64>().ok());
        Self {
            model: line("/proc/device-tree/model").or_else(|| line("/sys/class/dmi/id/product_name")),
            processor: after("/proc/cpuinfo", "model name"),
            cores: std::thread::available_parallelism().map_or(1, usize::from),
            memory_mib: kib.map(|kib| kib >> 10),
            kernel: line("/proc/sys/kernel/osrelease"),
            architecture: std::env::consts::ARCH,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn this_machine_has_cores_and_an_architecture() {
        let here = Machine::here();
        assert!(here.cores > 0 && !here.architecture.is_empty());
    }
}
