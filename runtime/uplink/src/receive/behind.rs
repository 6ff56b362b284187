//! Telling an aircraft that its numbers fell behind: what it shows is older than what is here, and it waits for an answer.

use std::time::{Duration, Instant};

use crate::offer::{Hash, Offer};

/// Offers of one aircraft that it was told of, the newest ones.
const MOST_TOLD: usize = 16;
/// Telling takes one part in so many of an aircraft's time at most: whoever never takes the answer does not hold up its transfer.
const TELLING: u32 = 4;

/// What one aircraft shows that is older than what is here.
pub(super) struct Behind {
    /// The inlets that show it.
    inlets: Vec<usize>,
    /// What the aircraft is told of, where an earlier session received it.
    remembered: Option<Offer>,
    /// Its offers that it was told of, and until when that is not said again.
    told: Vec<(Hash, Instant)>,
    /// How long that is at least.
    told_for: Duration,
}

impl Behind {
    pub(super) fn new(told_for: Duration) -> Self {
        Self { inlets: Vec::new(), remembered: None, told: Vec::new(), told_for }
    }

    /// Somebody is to be told.
    pub(super) fn is_shown(&self) -> bool {
        !self.inlets.is_empty()
    }

    /// This older offer is shown by these inlets; `remembered` is what an earlier session received, where that makes it older.
    ///
    /// Its sender is told of each offer, not of each number, for another start of the aircraft may begin with the same one. It is said again:
    /// an answer may be lost, and after a start on a full disk the same offer is made again.
    pub(super) fn show(&mut self, offer: &Offer, inlets: impl Iterator<Item = usize>, remembered: Option<Offer>) {
        let (digest, now) = (offer.digest(), Instant::now());
        if self.told.iter().any(|(told, until)| *told == digest && now < *until) {
            return;
        }
        self.told.retain(|(told, _)| *told != digest);
        if self.told.len() >= MOST_TOLD {
            self.told.remove(0);
        }
        self.told.push((digest, now + self.told_for));
        self.inlets = inlets.collect();
        self.remembered = remembered;
    }

    /// Tells, by `deliver`, the inlets that show it what the newest is: `complete`, which is here, or what is remembered.
    pub(super) fn tell<E>(
        &mut self,
        complete: Option<&Offer>,
        deliver: impl FnOnce(&Offer, &[usize]) -> Result<(), E>,
    ) -> Result<(), E> {
        let inlets = std::mem::take(&mut self.inlets);
        let remembered = self.remembered.take();
        let Some(newest) = complete.or(remembered.as_ref()).filter(|_| !inlets.is_empty()) else { return Ok(()) };
        let begun = Instant::now();
        let delivered = deliver(newest, &inlets);
        let rest = Instant::now() + (TELLING - 1) * begun.elapsed();
        if let Some((_, until)) = self.told.last_mut() {
            *until = rest.max(*until);
        }
        delivered
    }
}
