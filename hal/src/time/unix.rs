//! Unix time ↔ boot time out of SYSTEM_TIME. ArduPilot stamps CAMERA_FEEDBACK with GPS time in Unix microseconds; before
//! the first fix the field is 0 or nonsense, and it may step when the fix comes.

use heapless::HistoryBuf;

use super::boot::UNIX_FROM_US;

/// Offsets kept: 16 s at ArduPilot's 1 Hz.
const KEPT: usize = 16;
/// An offset this far from the others is a step of GPS time, not jitter.
const STEP_NS: u64 = 500_000_000;

/// Offset between Unix and boot time.
#[derive(Default)]
pub struct UnixMap {
    offsets: HistoryBuf<i64, KEPT>,
    steps: u32,
}

impl UnixMap {
    /// A SYSTEM_TIME: Unix µs and boot ns of the same instant. Implausible Unix times are ignored.
    pub fn update(&mut self, unix_us: u64, boot_ns: u64) {
        let Ok(unix_ns) = i64::try_from(unix_us.saturating_mul(1000)) else { return };
        if unix_us < UNIX_FROM_US {
            return;
        }
        let offset = unix_ns - boot_ns as i64;
        if self.offset().is_some_and(|o| o.abs_diff(offset) > STEP_NS) {
            self.offsets.clear();
            self.steps += 1;
        }
        self.offsets.write(offset);
    }

    /// Boot time of a Unix time, ns; `None` before the first valid SYSTEM_TIME.
    pub fn to_boot_ns(&self, unix_us: u64) -> Option<u64> {
        let boot = i64::try_from(unix_us.checked_mul(1000)?).ok()?.checked_sub(self.offset()?)?;
        u64::try_from(boot).ok()
    }

    /// Unix time of a boot time, µs; `None` before the first valid SYSTEM_TIME.
    pub fn to_unix_us(&self, boot_ns: u64) -> Option<u64> {
        let unix_ns = i64::try_from(boot_ns).ok()?.checked_add(self.offset()?)?;
        Some(u64::try_from(unix_ns).ok()? / 1000)
    }

    /// How often GPS time stepped.
    pub fn steps(&self) -> u32 {
        self.steps
    }

    /// Forgets everything, for a restarted autopilot.
    pub fn reset(&mut self) {
        self.offsets.clear();
    }

    /// The smallest recent offset: the boot field is cut to whole milliseconds, which only adds to the offset.
    fn offset(&self) -> Option<i64> {
        self.offsets.as_slice().iter().copied().min()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn unix_time_is_mapped_and_time_before_the_fix_is_ignored() {
        let mut map = UnixMap::default();
        map.update(0, 3_000_000_000);
        assert_eq!(map.to_boot_ns(1_795_248_412_679_283), None);
        map.update(1_795_248_412_000_900, 10_000_000_000);
        map.update(1_795_248_413_000_100, 11_000_000_000);
        assert_eq!(map.to_boot_ns(1_795_248_412_500_100), Some(10_500_000_000));
        map.update(1_795_248_423_000_000, 12_000_000_000);
        assert_eq!((map.steps(), map.to_boot_ns(1_795_248_423_000_000)), (1, Some(12_000_000_000)));
    }
}
