//! What Linux says about the board in sysfs: thermal zones, the Raspberry Pi's firmware, alarms of supply monitors (hwmon) and
//! limits of the processor's clock (cpufreq).

use std::fs::File;
use std::io::Read;
use std::path::{Path, PathBuf};

/// Sensors of one kind looked at.
const MAX_SENSORS: usize = 32;
/// Bits of `get_throttled` (raspberrypi-firmware): supply below 4.63 V now; clock capped, throttled or at the soft limit now.
const FIRMWARE_UNDER_VOLTAGE: i64 = 1;
const FIRMWARE_THROTTLED: i64 = 1 << 1 | 1 << 2 | 1 << 3;

/// Where the sensors are.
#[derive(Debug, Default)]
pub struct Board {
    zones: Vec<PathBuf>,
    /// The Raspberry Pi's `get_throttled`, hexadecimal.
    firmware: Vec<PathBuf>,
    supply_alarms: Vec<PathBuf>,
    current_alarms: Vec<PathBuf>,
    /// Power monitors, microwatts.
    powers: Vec<PathBuf>,
    /// The clock's limit of each processor group, and what it was at the start.
    clocks: Vec<(PathBuf, i64)>,
}

/// What they say.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct BoardState {
    /// Of the warmest sensor.
    pub hottest_c: Option<f32>,
    /// The supply is low.
    pub under_voltage: bool,
    /// The clock is held back.
    pub throttled: bool,
    /// Of the rail that takes most: where there are several, one feeds the others.
    pub watts: Option<f32>,
}

impl Board {
    /// Looks for sensors below `sys`.
    pub fn find(sys: &Path) -> Self {
        let platform = files(&sys.join("devices/platform"), |name| name.starts_with("soc"));
        let firmware = platform.iter().flat_map(|soc| files(soc, |name| name.ends_with(":firmware")));
        let hwmon: Vec<PathBuf> = files(&sys.join("class/hwmon"), |name| name.starts_with("hwmon"));
        let files_of = |kind: &'static str, ends: &'static [&'static str]| {
            let fits = move |name: &str| name.starts_with(kind) && ends.iter().any(|end| name.ends_with(end));
            hwmon.iter().flat_map(|monitor| files(monitor, fits)).take(MAX_SENSORS).collect()
        };
        let clocks = files(&sys.join("devices/system/cpu/cpufreq"), |name| name.starts_with("policy"));
        let clocks = clocks.into_iter().map(|p| p.join("scaling_max_freq"));
        Self {
            zones: files(&sys.join("class/thermal"), |name| name.starts_with("thermal_zone"))
                .into_iter()
                .map(|zone| zone.join("temp"))
                .collect(),
            firmware: firmware.map(|f| f.join("get_throttled")).take(MAX_SENSORS).collect(),
            // rpi_volt, ina2xx and ina3221: low supply; over-current makes a Jetson throttle.
            supply_alarms: files_of("in", &["_lcrit_alarm", "_min_alarm"]),
            current_alarms: files_of("curr", &["_crit_alarm"]),
            powers: files_of("power", &["_input", "_average"]),
            clocks: clocks.filter_map(|path| number(&path, 10).map(|khz| (path, khz))).collect(),
        }
    }

    /// Reads the sensors.
    pub fn read(&self) -> BoardState {
        let any = |paths: &[PathBuf]| paths.iter().any(|p| number(p, 10).is_some_and(|v| v != 0));
        let firmware = self.firmware.iter().filter_map(|p| number(p, 16)).fold(0, |a, b| a | b);
        let slowed = self.clocks.iter().any(|(path, first)| number(path, 10).is_some_and(|khz| khz < *first));
        BoardState {
            // Millidegrees.
            hottest_c: self.zones.iter().filter_map(|z| number(z, 10)).max().map(|t| t as f32 / 1000.0),
            under_voltage: firmware & FIRMWARE_UNDER_VOLTAGE != 0 || any(&self.supply_alarms),
            throttled: firmware & FIRMWARE_THROTTLED != 0 || any(&self.current_alarms) || slowed,
            watts: self.powers.iter().filter_map(|p| number(p, 10)).max().map(|microwatts| microwatts as f32 * 1e-6),
        }
    }
}

/// Entries of `folder` whose name fits; none when it is not there.
fn files(folder: &Path, fits: impl Fn(&str) -> bool) -> Vec<PathBuf> {
    let entries = std::fs::read_dir(folder).into_iter().flatten().flatten();
    let named = entries.filter(|e| e.file_name().to_str().is_some_and(&fits)).map(|e| e.path());
    named.take(MAX_SENSORS).collect()
}

/// The one number in a file of sysfs; read without a heap.
fn number(path: &Path, radix: u32) -> Option<i64> {
    let mut bytes = [0; 32];
    let count = File::open(path).ok()?.read(&mut bytes).ok()?;
    let text = std::str::from_utf8(&bytes[..count]).ok()?.trim();
    i64::from_str_radix(text.strip_prefix("0x").unwrap_or(text), radix).ok()
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A folder with these files, in the manner of sysfs.
    fn sysfs(files: &[(&str, &str)]) -> tempfile::TempDir {
        let sys = tempfile::tempdir().expect("a folder");
        for (name, text) in files {
            set(sys.path(), name, text);
        }
        sys
    }

    fn set(sys: &Path, name: &str, text: &str) {
        let path = sys.join(name);
        std::fs::create_dir_all(path.parent().expect("a parent")).expect("a folder");
        std::fs::write(path, text).expect("written");
    }

    #[test]
    fn the_hottest_zone_counts() {
        let sys =
            sysfs(&[("class/thermal/thermal_zone0/temp", "48312\n"), ("class/thermal/thermal_zone1/temp", "81250\n")]);
        assert_eq!(Board::find(sys.path()).read().hottest_c, Some(81.25));
        assert_eq!(Board::find(Path::new("/nonexistent")).read(), BoardState::default());
    }

    #[test]
    fn a_raspberry_pis_firmware_tells_under_voltage_from_throttling_and_from_the_past() {
        for (soc, firmware) in [("soc", "soc:firmware"), ("soc@107c000000", "soc@107c000000:firmware")] {
            let name = format!("devices/platform/{soc}/{firmware}/get_throttled");
            let sys = sysfs(&[(&name, "0\n")]);
            let board = Board::find(sys.path());
            let read = |bits: &str| {
                set(sys.path(), &name, bits);
                let state = board.read();
                (state.under_voltage, state.throttled)
            };
            assert_eq!(read("0\n"), (false, false));
            assert_eq!(read("1\n"), (true, false));
            assert_eq!(read("e0008\n"), (false, true));
            assert_eq!(read("50005\n"), (true, true));
            assert_eq!(read("50000\n"), (false, false), "it happened, it is over");
            assert_eq!(read("what\n"), (false, false));
        }
    }

    #[test]
    fn alarms_of_a_supply_monitor_are_read() {
        let (low, over) = ("class/hwmon/hwmon2/in0_lcrit_alarm", "class/hwmon/hwmon3/curr1_crit_alarm");
        let sys = sysfs(&[(low, "0\n"), (over, "0\n"), ("class/hwmon/hwmon3/in1_input", "4980\n")]);
        let board = Board::find(sys.path());
        assert_eq!(board.read(), BoardState::default());
        set(sys.path(), low, "1\n");
        assert!(board.read().under_voltage && !board.read().throttled);
        set(sys.path(), low, "0\n");
        set(sys.path(), over, "1\n");
        assert!(board.read().throttled && !board.read().under_voltage);
    }

    #[test]
    fn the_rail_that_takes_most_power_counts() {
        let sys = sysfs(&[
            ("class/hwmon/hwmon1/power1_input", "4250000\n"),
            ("class/hwmon/hwmon1/power2_average", "1100000\n"),
            ("class/hwmon/hwmon1/power1_max", "90000000\n"),
        ]);
        assert_eq!(Board::find(sys.path()).read().watts, Some(4.25));
        assert_eq!(Board::find(Path::new("/nonexistent")).read().watts, None);
    }

    #[test]
    fn a_clock_that_is_limited_in_flight_is_throttled_and_one_that_was_before_is_not() {
        let name = "devices/system/cpu/cpufreq/policy0/scaling_max_freq";
        let sys = sysfs(&[(name, "1800000\n")]);
        let board = Board::find(sys.path());
        assert!(!board.read().throttled);
        set(sys.path(), name, "1200000\n");
        assert!(board.read().throttled);
        assert!(!Board::find(sys.path()).read().throttled, "somebody's choice");
    }
}
