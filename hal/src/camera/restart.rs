//! When a camera that failed is tried again: after half a second, then after twice as long each time, up to ten seconds.

use std::time::{Duration, Instant};

const FIRST_DELAY: Duration = Duration::from_millis(500);
const LONGEST_DELAY: Duration = Duration::from_secs(10);

/// The next attempt.
pub(super) struct Restart {
    at: Instant,
    delay: Duration,
}

impl Default for Restart {
    fn default() -> Self {
        Self { at: Instant::now(), delay: FIRST_DELAY }
    }
}

impl Restart {
    /// It failed: the next attempt is due after the delay, and the one after that twice as late.
    pub(super) fn failed(&mut self) {
        self.at = Instant::now() + self.delay;
        self.delay = (self.delay * 2).min(LONGEST_DELAY);
    }

    /// It works: the next failure waits only briefly.
    pub(super) fn works(&mut self) {
        self.delay = FIRST_DELAY;
    }

    /// Whether it is time to try.
    pub(super) fn is_due(&self) -> bool {
        Instant::now() >= self.at
    }
}
