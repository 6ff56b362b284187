//! Offers as they are seen: the same bytes are read and their signature is checked once, however often they lie there.

use std::collections::HashMap;
use std::sync::Arc;

use config::mission::MAX_AIRCRAFT;

use super::super::offer::{Offer, OfferError};

/// An offer, and which inlet shows it.
pub(super) type Shown = (Arc<Offer>, usize);

/// Different offers of one aircraft that one inlet may show: an honest one shows one, replays of older ones may come with it.
const PER_AIRCRAFT: usize = 4;
/// Offers that are remembered: those of every aircraft, by several inlets.
const MOST: usize = 4 * PER_AIRCRAFT * MAX_AIRCRAFT;

/// What is shown now.
#[derive(Clone, Default)]
pub(super) struct Offered {
    /// By the hash of their bytes.
    offers: HashMap<blake3::Hash, Arc<Offer>>,
    by_aircraft: HashMap<String, Vec<Shown>>,
}

impl Offered {
    /// Of one aircraft, in the order they were seen.
    pub fn of(&self, aircraft: &str) -> &[Shown] {
        self.by_aircraft.get(aircraft).map_or(&[], Vec::as_slice)
    }

    /// Takes over what `newer` shows of the aircraft in it.
    pub fn update(&mut self, newer: Self) {
        self.by_aircraft.extend(newer.by_aircraft);
        self.offers = newer.offers;
    }

    /// The aircraft that are shown.
    pub fn aircraft(&self) -> impl Iterator<Item = &str> {
        self.by_aircraft.keys().map(String::as_str)
    }

    /// Takes in what `inlet` shows; `let_in` is asked where neither this nor the look before has these bytes.
    ///
    /// # Errors
    /// Errors of `let_in`.
    pub fn see(
        &mut self,
        before: &Self,
        bytes: &[u8],
        inlet: usize,
        let_in: impl FnOnce(&[u8]) -> Result<Offer, OfferError>,
    ) -> Result<(), OfferError> {
        let hash = blake3::hash(bytes);
        let known = self.offers.get(&hash).or_else(|| before.offers.get(&hash));
        let offer = known.map_or_else(|| let_in(bytes).map(Arc::new), |known| Ok(known.clone()))?;
        let others = self.by_aircraft.entry(offer.aircraft.clone()).or_default();
        if keep_newest(others, &offer, inlet) && self.offers.len() < MOST {
            self.offers.insert(hash, offer);
        }
        Ok(())
    }
}

/// Any number of the same, and the newest ones of each aircraft: more would be a flood.
fn keep_newest(seen: &mut Vec<Shown>, offer: &Arc<Offer>, inlet: usize) -> bool {
    let here = |s: &&mut Shown| s.1 == inlet;
    if seen.iter().any(|(o, i)| *i == inlet && o == offer) {
        return true;
    }
    if seen.iter().filter(|(_, i)| *i == inlet).count() < PER_AIRCRAFT {
        seen.push((offer.clone(), inlet));
        return true;
    }
    let oldest = seen.iter_mut().filter(here).min_by_key(|(o, _)| o.order);
    let replaced = oldest.filter(|(o, _)| o.order < offer.order);
    let newer = replaced.is_some();
    if let Some(place) = replaced {
        place.0 = offer.clone();
    }
    newer
}

#[cfg(test)]
mod tests {
    use super::super::super::offer::testing::offer;
    use super::*;

    #[test]
    fn the_same_bytes_are_let_in_once_however_often_and_by_however_many_inlets_they_are_shown() {
        let (west, mut asked) = (offer("m", "west", 1), 0);
        let (bytes, mut before) = (west.encode(), Offered::default());
        for _ in 0..3 {
            let mut now = Offered::default();
            for inlet in [0, 1, 0] {
                let let_in = |_: &[u8]| {
                    asked += 1;
                    Ok(west.clone())
                };
                now.see(&before, &bytes, inlet, let_in).expect("let in");
            }
            let shown: Vec<_> = now.of("west").iter().map(|(o, inlet)| (o.order, *inlet)).collect();
            assert_eq!(shown, [(west.order, 0), (west.order, 1)]);
            before = now;
        }
        assert_eq!((asked, before.of("east").len()), (1, 0));
    }

    #[test]
    fn what_is_refused_is_refused_again_and_not_remembered() {
        let (west, mut now) = (offer("m", "west", 1), Offered::default());
        for _ in 0..2 {
            let refused = now.see(&Offered::default(), &west.encode(), 0, |_| Err(OfferError::Version(9)));
            assert_eq!(refused, Err(OfferError::Version(9)));
        }
        assert!(now.of("west").is_empty() && now.offers.is_empty());
    }

    #[test]
    fn of_a_flood_of_different_offers_the_newest_remain() {
        let mut now = Offered::default();
        for counter in [3, 9, 1, 7, 2, 8, 4, 6, 5] {
            let flood = offer("m", "west", counter);
            now.see(&Offered::default(), &flood.encode(), 0, |_| Ok(flood.clone())).expect("let in");
        }
        let mut kept: Vec<u64> = now.of("west").iter().map(|(o, _)| o.order.counter).collect();
        kept.sort_unstable();
        assert_eq!(kept, [6, 7, 8, 9]);
    }
}
