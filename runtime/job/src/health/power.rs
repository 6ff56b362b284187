//! What the board takes while it works.

use std::path::Path;
use std::process::Command;

use super::board::Board;

/// Where that is known from.
#[derive(Debug)]
pub struct Power {
    said: Option<f32>,
    board: Board,
}

impl Power {
    /// What was `said`, else what the board's sensors say.
    pub fn new(said: Option<f32>) -> Self {
        Self::with_sensors(Path::new("/sys"), said)
    }

    /// As [`Power::new`], with the sensors below `sys`.
    pub fn with_sensors(sys: &Path, said: Option<f32>) -> Self {
        Self { said, board: Board::find(sys) }
    }

    /// Watts now: of the rail that takes most (power monitors of hwmon), or of all rails of a Raspberry Pi; `None` where nothing tells.
    pub fn watts(&self) -> Option<f64> {
        let measured = || self.board.read().watts.or_else(pmic_watts);
        self.said.or_else(measured).filter(|watts| *watts > 0.0 && watts.is_finite()).map(f64::from)
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
    fn what_was_said_counts_and_nothing_is_made_of_nonsense() {
        let of = |said| Power::with_sensors(Path::new("/nonexistent"), said).watts();
        assert_eq!(of(Some(7.5)), Some(7.5));
        assert_eq!([Some(0.0), Some(-1.0), Some(f32::NAN)].map(of), [None; 3]);
    }
}
