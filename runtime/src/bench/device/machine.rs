//! Who the computer is, without its name, addresses or serial numbers.

use std::process::Command;

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

/// What a Raspberry Pi 5's power management says, watts; `None` elsewhere.
pub fn pmic_watts() -> Option<f32> {
    let said = Command::new("vcgencmd").arg("pmic_read_adc").output().ok()?;
    watts_of_rails(&String::from_utf8_lossy(&said.stdout))
}

/// Volts times amperes of every rail that has both: lines as `3V3_SYS_A current(1)=0.06926208A` and `3V3_SYS_V volt(9)=3.33227V`.
fn watts_of_rails(text: &str) -> Option<f32> {
    let value = |line: &str, unit: char| line.rsplit_once('=')?.1.trim().strip_suffix(unit)?.parse::<f32>().ok();
    let rail = |line: &str| line.split_whitespace().next().map(str::to_owned);
    let amperes = text.lines().filter_map(|l| Some((rail(l)?.strip_suffix("_A")?.to_owned(), value(l, 'A')?)));
    let volts = |name: &str| text.lines().find(|l| rail(l).is_some_and(|r| r.strip_suffix("_V") == Some(name)));
    let watts = amperes.filter_map(|(name, amperes)| Some(amperes * value(volts(&name)?, 'V')?));
    watts.reduce(|a, b| a + b).filter(|watts| watts.is_finite())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn power_is_summed_over_the_rails_of_a_raspberry_pi_5() {
        let said = "     3V7_WL_SW_A current(0)=0.10000000A\n       VDD_CORE_A current(7)=2.00000000A\n\
                    \x20    3V7_WL_SW_V volt(8)=3.70000000V\n       VDD_CORE_V volt(15)=0.75000000V\n\
                    \x20         EXT5V_V volt(24)=5.14398000V\n";
        let watts = watts_of_rails(said).expect("two rails");
        assert!((watts - (0.37 + 1.5)).abs() < 1e-5, "{watts}");
        assert_eq!(watts_of_rails("error=1 error_msg=\"Command not registered\""), None);
        assert_eq!(watts_of_rails(""), None);
    }

    #[test]
    fn this_machine_has_cores_and_an_architecture() {
        let here = Machine::here();
        assert!(here.cores > 0 && !here.architecture.is_empty());
    }
}
