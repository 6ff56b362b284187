//! A fixed ring of stamped samples in order of time, and the two around any instant.

use heapless::Deque;

/// Something with a time on the autopilot's boot clock.
pub trait Stamped {
    /// Boot time, ns.
    fn boot_ns(&self) -> u64;
}

/// Where an instant lies among the samples.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Around<T> {
    /// No samples.
    Empty,
    /// Before the oldest one kept.
    Before,
    /// Between these two, this fraction of the way.
    Between(T, T, f64),
    /// After the newest one, by so many ns.
    After(T, u64),
}

/// The newest `N` samples.
pub struct Ring<T, const N: usize> {
    samples: Deque<T, N>,
}

impl<T, const N: usize> Default for Ring<T, N> {
    fn default() -> Self {
        Self { samples: Deque::new() }
    }
}

impl<T: Stamped + Copy, const N: usize> Ring<T, N> {
    /// Adds a sample; false when it is not newer than the newest one (a duplicate or out of order), which is dropped.
    pub fn push(&mut self, sample: T) -> bool {
        if self.newest().is_some_and(|newest| sample.boot_ns() <= newest.boot_ns()) {
            return false;
        }
        if self.samples.is_full() {
            self.samples.pop_front();
        }
        self.samples.push_back(sample).is_ok()
    }

    /// The newest sample.
    pub fn newest(&self) -> Option<T> {
        self.samples.back().copied()
    }

    /// Forgets all samples.
    pub fn clear(&mut self) {
        self.samples.clear();
    }

    /// The samples around `boot_ns`.
    pub fn around(&self, boot_ns: u64) -> Around<T> {
        let mut after: Option<&T> = None;
        for sample in self.samples.iter().rev() {
            if sample.boot_ns() <= boot_ns {
                return match after {
                    None if sample.boot_ns() == boot_ns => Around::Between(*sample, *sample, 0.0),
                    None => Around::After(*sample, boot_ns - sample.boot_ns()),
                    Some(after) => {
                        let span = after.boot_ns() - sample.boot_ns();
                        Around::Between(*sample, *after, (boot_ns - sample.boot_ns()) as f64 / span as f64)
                    }
                };
            }
            after = Some(sample);
        }
        if after.is_some() { Around::Before } else { Around::Empty }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[derive(Clone, Copy, Debug, PartialEq)]
    struct At(u64);

    impl Stamped for At {
        fn boot_ns(&self) -> u64 {
            self.0
        }
    }

    #[test]
    fn the_ring_keeps_the_newest_and_knows_what_lies_around() {
        let mut ring = Ring::<At, 4>::default();
        assert_eq!(ring.around(5), Around::Empty);
        for t in [10, 20, 30, 30, 25, 40, 50] {
            ring.push(At(t));
        }
        assert_eq!(ring.around(19), Around::Before);
        assert_eq!(ring.around(25), Around::Between(At(20), At(30), 0.5));
        assert_eq!(ring.around(50), Around::Between(At(50), At(50), 0.0));
        assert_eq!(ring.around(57), Around::After(At(50), 7));
    }
}
