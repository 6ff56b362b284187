//! The autopilot's boot clock out of 32-bit milliseconds (wraps after 49.7 days) and 32- or 64-bit microseconds (ArduPilot's
//! CAMERA_FEEDBACK with a feedback pin wraps after 71.6 minutes), with restarts and jumps told apart from wraps.

/// Going back further than messages can be out of order means that the autopilot restarted.
const RESTART_BACK_MS: i32 = -5_000;
/// Going forward by this much more than the companion's clock allows is a jump (fastest simulators: 50×).
const JUMP_FORWARD_MS: u64 = 10_000;
const FASTEST: u64 = 50;

/// Microsecond stamps from here on are Unix time (2001-09-09), below it time since boot (31 years).
pub const UNIX_FROM_US: u64 = 1_000_000_000_000_000;

/// What a time stamp did to the clock.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Tick {
    /// Goes on; boot time, ns.
    Normal(u64),
    /// The autopilot restarted or its clock jumped: older samples mean nothing any more; boot time, ns.
    Restarted(u64),
}

/// Unwraps boot times.
#[derive(Clone, Copy, Debug, Default)]
pub struct BootClock {
    /// Newest boot time, ms, unwrapped; and the companion's time then, ns.
    newest: Option<(u64, u64)>,
}

impl BootClock {
    /// Newest boot time seen, ns.
    pub fn newest_ns(&self) -> Option<u64> {
        self.newest.map(|(ms, _)| ms * 1_000_000)
    }

    /// A boot time in milliseconds, received at `now_ns` of the companion.
    pub fn tick_ms(&mut self, ms: u32, now_ns: u64) -> Tick {
        let Some((newest, seen_ns)) = self.newest else {
            self.newest = Some((u64::from(ms), now_ns));
            return Tick::Normal(u64::from(ms) * 1_000_000);
        };
        let delta = ms.wrapping_sub(newest as u32) as i32;
        let allowed = JUMP_FORWARD_MS + now_ns.saturating_sub(seen_ns) / 1_000_000 * FASTEST;
        if delta < RESTART_BACK_MS || (delta > 0 && u64::from(delta.unsigned_abs()) > allowed) {
            self.newest = Some((u64::from(ms), now_ns));
            return Tick::Restarted(u64::from(ms) * 1_000_000);
        }
        let unwrapped = newest.saturating_add_signed(delta.into());
        if delta >= 0 {
            self.newest = Some((unwrapped, now_ns));
        }
        Tick::Normal(unwrapped * 1_000_000)
    }

    /// A boot time in microseconds, from a field that may hold 32 or 64 bits, next to the newest one; `None` before
    /// any [`BootClock::tick_ms`].
    pub fn near_us(&self, us: u64) -> Option<u64> {
        let newest_us = self.newest?.0 * 1000;
        let wrap = if us <= u64::from(u32::MAX) { 1u64 << 32 } else { 1000u64 << 32 };
        let base = newest_us - newest_us % wrap;
        let candidate = base + us % wrap;
        let nearest = if candidate > newest_us + wrap / 2 {
            candidate.saturating_sub(wrap)
        } else if candidate + wrap / 2 < newest_us {
            candidate + wrap
        } else {
            candidate
        };
        Some(nearest * 1000)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn milliseconds_go_on_over_their_wrap() {
        let mut clock = BootClock::default();
        clock.tick_ms(u32::MAX - 10, 0);
        assert_eq!(clock.tick_ms(89, 100_000_000), Tick::Normal(((1u64 << 32) + 89) * 1_000_000));
    }

    #[test]
    fn a_restart_and_a_jump_are_noticed_and_disorder_is_not() {
        let mut clock = BootClock::default();
        clock.tick_ms(600_000, 0);
        assert_eq!(clock.tick_ms(599_900, 1_000), Tick::Normal(599_900_000_000));
        assert_eq!(clock.tick_ms(2_000, 2_000), Tick::Restarted(2_000_000_000));
        assert_eq!(clock.tick_ms(90_000, 3_000), Tick::Restarted(90_000_000_000));
        // The same step after a link pause of ten seconds, in an 8× simulator, is no jump.
        assert_eq!(clock.tick_ms(170_000, 10_000_003_000), Tick::Normal(170_000_000_000));
    }

    #[test]
    fn microseconds_of_32_bits_land_next_to_now() {
        let mut clock = BootClock::default();
        assert_eq!(clock.near_us(5), None);
        let wrap = 1u64 << 32;
        clock.tick_ms((2 * wrap / 1000) as u32 + 50, 0); // 50 ms after the second wrap
        let now_us = clock.newest.expect("set").0 * 1000;
        assert_eq!(clock.near_us(now_us % wrap), Some(now_us * 1000));
        assert_eq!(clock.near_us(wrap - 1000), Some((2 * wrap - 1000) * 1000));
        assert_eq!(clock.near_us(now_us), Some(now_us * 1000), "64-bit field");
    }
}
