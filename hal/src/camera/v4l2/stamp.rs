//! The driver's numbers and times: what was lost, and when on the companion's clock a picture was taken.

use std::time::Duration;

use rustix::time::{ClockId, clock_gettime};

/// A picture is in our hands within this after its stamp; a stamp further off is of another clock.
const LONGEST_WAY: Duration = Duration::from_secs(2);
/// A larger step of the numbers is a restart of the driver's counter and no loss: more than a minute at 60 a second.
const LARGEST_GAP: u32 = 1 << 12;

/// The clock of the drivers' time stamps.
pub(super) fn monotonic_now() -> Duration {
    let now = clock_gettime(ClockId::Monotonic);
    Duration::new(now.tv_sec.unsigned_abs(), now.tv_nsec.unsigned_abs() as u32)
}

/// The stamp, if it can be one of this clock: not after the picture was `fetched`, nor long before.
pub(super) fn believed(taken: Option<Duration>, fetched: Duration) -> Option<Duration> {
    taken.filter(|taken| fetched.checked_sub(*taken).is_some_and(|way| way <= LONGEST_WAY))
}

/// Time `at` of the drivers' clock on the companion's, ns, which shows `now_ns` when the former shows `now`.
pub(super) fn on_companion_clock(now_ns: u64, now: Duration, at: Duration) -> u64 {
    let ago = u64::try_from(now.saturating_sub(at).as_nanos()).unwrap_or(u64::MAX);
    now_ns.saturating_sub(ago)
}

/// Counts what is missing between the numbers of the pictures that came.
#[derive(Debug, Default)]
pub(super) struct Numbers {
    last: Option<u32>,
    lost: u64,
}

impl Numbers {
    /// A picture of this number came.
    pub(super) fn next(&mut self, number: u32) {
        let step = self.last.map_or(1, |last| number.wrapping_sub(last));
        if (1..=LARGEST_GAP).contains(&step) {
            self.lost += u64::from(step - 1);
        }
        self.last = Some(number);
    }

    /// The device was opened again and counts anew.
    pub(super) fn start_again(&mut self) {
        self.last = None;
    }

    /// Pictures that never came.
    pub(super) fn lost(&self) -> u64 {
        self.lost
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn gaps_in_the_numbers_are_losses_and_restarts_are_none() {
        let lost = |numbers: &[u32]| {
            let mut n = Numbers::default();
            numbers.iter().for_each(|&number| n.next(number));
            n.lost()
        };
        assert_eq!(lost(&[5, 6, 7]), 0);
        assert_eq!(lost(&[0, 3, 4, 6]), 3);
        assert_eq!(lost(&[u32::MAX - 1, 1]), 2);
        assert_eq!(lost(&[900, 0, 1]), 0, "the counter began anew");
        assert_eq!(lost(&[0, 0, 0]), 0, "a driver that does not count");
    }

    #[test]
    fn a_stamp_is_moved_onto_the_companions_clock() {
        let at = Duration::from_millis;
        // Started 990 s after boot: 10 s there are 1000 s here.
        assert_eq!(on_companion_clock(10_000_000_000, at(1_000_000), at(999_958)), 9_958_000_000);
        assert_eq!(on_companion_clock(10, at(1_000_000), at(999_958)), 0, "before the start");
        assert_eq!(on_companion_clock(10, at(5), at(6)), 10, "not in the future");
    }

    #[test]
    fn stamps_of_another_clock_are_not_believed() {
        let at = Duration::from_millis;
        assert_eq!(believed(Some(at(70_000)), at(70_040)), Some(at(70_000)));
        assert_eq!(believed(Some(at(70_041)), at(70_040)), None);
        assert_eq!(believed(Some(at(10)), at(70_040)), None);
        assert_eq!(believed(None, at(70_040)), None);
    }

    #[test]
    fn the_stamps_clock_does_not_go_back() {
        let first = monotonic_now();
        assert!(first > Duration::ZERO && monotonic_now() >= first);
    }
}
