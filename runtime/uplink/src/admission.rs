//! The gates between what arrives and what counts: signature and bounds of an offer, then, once its bytes are here, whether
//! they parse and mean what they should. Whatever fails leaves the last good model in place and is counted with its reason.

use std::collections::BTreeMap;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::path::Path;

use config::upload::UploadSettings;
use serde::Serialize;

use super::memory::Memory;
use super::offer::{Offer, OfferError};
use crate::keys::Identity;

/// Distinct refusals that are remembered; beyond it they are only counted by kind.
const MAX_REMEMBERED: usize = 256;
/// Of these at most so many whose words somebody without a key may have chosen: room is left for the mission's own aircraft.
const MAX_OF_STRANGERS: usize = 128;

/// Why a model that arrived whole does not count.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum ModelRefusal {
    /// Not a readable model, or one that breaks a bound.
    #[error("{0}")]
    Parse(String),
    /// Readable, but not what this aircraft should have made.
    #[error("{0}")]
    Meaning(String),
}

/// Whether a model file may count as this aircraft's.
pub type ModelCheck = dyn Fn(&str, &Path) -> Result<(), ModelRefusal> + Send + Sync;

/// What the ground lets in.
pub struct Admission {
    /// Name of the mission.
    pub mission: String,
    /// Its aircraft.
    pub aircraft: Vec<String>,
    /// Whose signatures count, and our own.
    pub identity: Identity,
    /// The gates behind the transfer.
    pub check: Box<ModelCheck>,
    /// What earlier sessions have received.
    pub memory: Memory,
}

impl Admission {
    /// The gates before the transfer.
    ///
    /// # Errors
    /// What is wrong with the offer.
    pub fn offer(&self, bytes: &[u8], settings: &UploadSettings) -> Result<Offer, OfferError> {
        let offer = Offer::decode(bytes, settings)?;
        offer.check(&self.mission, &self.aircraft, &self.identity)?;
        Ok(offer)
    }

    /// The gates behind the transfer. A model that makes its reader panic costs only itself.
    ///
    /// # Errors
    /// Why the model may not count.
    pub fn model(&self, aircraft: &str, path: &Path) -> Result<(), ModelRefusal> {
        let checked = catch_unwind(AssertUnwindSafe(|| (self.check)(aircraft, path)));
        checked.unwrap_or_else(|_| Err(ModelRefusal::Parse("reading it failed".into())))
    }
}

/// Refusals by their reason, in words, and how often each was met.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize)]
#[serde(transparent)]
pub struct Refusals(BTreeMap<String, u64>);

impl Refusals {
    /// Counts one; the first of its reason is told.
    pub fn count(&mut self, why: String) {
        if self.0.len() < MAX_REMEMBERED && !self.0.contains_key(&why) {
            tracing::warn!("serve: refused: {why}");
        }
        self.add(why, 1);
    }

    /// As [`Refusals::count`], for what nobody has signed.
    pub fn count_of_a_stranger(&mut self, why: String) {
        if self.0.len() < MAX_OF_STRANGERS || self.0.contains_key(&why) {
            self.count(why);
        }
    }

    fn add(&mut self, why: String, times: u64) {
        if self.0.len() < MAX_REMEMBERED || self.0.contains_key(&why) {
            *self.0.entry(why).or_default() += times;
        }
    }

    /// Each reason with its count.
    pub fn iter(&self) -> impl Iterator<Item = (&str, u64)> {
        self.0.iter().map(|(why, n)| (why.as_str(), *n))
    }

    pub(super) fn absorb(&mut self, other: Self) {
        other.0.into_iter().for_each(|(why, n)| self.add(why, n));
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn whatever_strangers_show_there_is_room_for_why_an_aircrafts_model_does_not_count() {
        let mut refusals = Refusals::default();
        (0..10_000).for_each(|size| refusals.count_of_a_stranger(format!("model of {size} bytes")));
        for _ in 0..3 {
            refusals.count("west's final model is not of this session".into());
        }
        let ours = refusals.iter().find(|(why, _)| why.starts_with("west"));
        assert_eq!(ours.map(|(_, times)| times), Some(3));
        assert!(refusals.iter().count() <= MAX_REMEMBERED);
    }
}
