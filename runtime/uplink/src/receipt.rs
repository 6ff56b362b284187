//! What the ground says to an aircraft about a model: safe here, or refused. An aircraft that believed a stranger would
//! stop offering what nobody has.

use serde::{Deserialize, Serialize};

use super::offer::{Hash, Offer, Order, is_safe_name};
use crate::keys::{Domain, GROUND, Identity, SignatureBytes};

const VERSION: u8 = 1;
/// Longest encoded receipt.
pub const MAX_ENCODED: u64 = 1024;
/// Longest reason that is sent.
const MAX_REASON: usize = 256;

/// The ground's word on one model.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub enum Verdict {
    /// Verified and safe on the ground's disk.
    Received,
    /// Arrived whole, but does not count, for this reason.
    Refused(String),
}

/// A receipt: the verdict on one offer.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Receipt {
    version: u8,
    mission: String,
    aircraft: String,
    order: Order,
    model: Hash,
    verdict: Verdict,
}

/// What a receipt means for what is on offer now.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Delivery {
    /// Nobody has fetched it yet.
    Waiting,
    /// Somebody is fetching it.
    Fetching,
    /// It is where nothing can be lost any more.
    Delivered,
    /// The ground will not take it.
    Refused(String),
    /// The ground has a newer one of this aircraft, of this order: our own numbers fell behind.
    Behind(Order),
}

impl Receipt {
    /// The verdict on `offer`.
    pub fn new(offer: &Offer, verdict: Verdict) -> Self {
        let verdict = match verdict {
            Verdict::Refused(why) => Verdict::Refused(why.chars().take(MAX_REASON / 4).collect()),
            received => received,
        };
        let (mission, aircraft) = (offer.mission.clone(), offer.aircraft.clone());
        Self { version: VERSION, mission, aircraft, order: offer.order, model: offer.model, verdict }
    }

    /// Wire bytes, signed.
    pub fn seal(&self, identity: &Identity) -> Vec<u8> {
        // Plain integers and strings: serialising into a growing vector has no way to fail.
        let mut bytes = postcard::to_allocvec(self).unwrap_or_default();
        bytes.extend(identity.sign(Domain::Receipt, &bytes).iter().flatten());
        bytes
    }

    /// Wire bytes → a receipt for this aircraft by this mission's ground; None for anything else.
    pub fn open(bytes: &[u8], identity: &Identity, mission: &str, aircraft: &str) -> Option<Self> {
        if bytes.len() as u64 > MAX_ENCODED {
            return None;
        }
        let (receipt, rest): (Self, _) = postcard::take_from_bytes(bytes).ok()?;
        let signature = SignatureBytes::try_from(rest).ok();
        let signed = &bytes[..bytes.len() - rest.len()];
        identity.verify(GROUND, Domain::Receipt, signed, signature.as_ref()).ok()?;
        let ours = receipt.version == VERSION
            && is_safe_name(&receipt.mission)
            && receipt.mission == mission
            && receipt.aircraft == aircraft
            && (signature.is_some() || rest.is_empty());
        ours.then_some(receipt)
    }

    /// What it means for `offer`; None when it is about an older one.
    pub fn bearing(&self, offer: &Offer) -> Option<Delivery> {
        match &self.verdict {
            Verdict::Received if self.order == offer.order && self.model == offer.model => Some(Delivery::Delivered),
            Verdict::Refused(why) if self.order == offer.order && self.model == offer.model => {
                Some(Delivery::Refused(why.clone()))
            }
            Verdict::Received if self.order >= offer.order => Some(Delivery::Behind(self.order)),
            _ => None,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::keys::testing::identities;
    use crate::offer::testing::offer;

    #[test]
    fn only_the_grounds_own_receipt_is_believed() {
        let all = identities(["a1", "a2"]);
        let [a1, a2, ground] = [&all[0], &all[1], &all[2]];
        let receipt = Receipt::new(&offer("m", "a1", 3), Verdict::Received);
        let opened = |bytes: &[u8]| Receipt::open(bytes, a1, "m", "a1");
        let bytes = receipt.seal(ground);
        assert_eq!(opened(&bytes), Some(receipt.clone()));
        for forged in [receipt.seal(a2), receipt.seal(a1), receipt.seal(&Identity::unsigned()), Vec::new()] {
            assert_eq!(opened(&forged), None);
        }
        for at in 0..bytes.len() {
            let mut spoilt = bytes.clone();
            spoilt[at] ^= 1;
            assert_eq!(opened(&spoilt), None, "byte {at}");
            assert_eq!(opened(&bytes[..at]), None, "{at} bytes");
        }
        // Somebody else's receipt, or another mission's.
        assert_eq!(Receipt::open(&bytes, a2, "m", "a2"), None);
        assert_eq!(Receipt::open(&bytes, a1, "other", "a1"), None);
    }

    #[test]
    fn a_receipt_bears_on_its_own_offer_and_says_when_numbers_fell_behind() {
        let third = offer("m", "a1", 3);
        let received = Receipt::new(&third, Verdict::Received);
        assert_eq!(received.bearing(&third), Some(Delivery::Delivered));
        assert_eq!(received.bearing(&offer("m", "a1", 4)), None);
        assert_eq!(received.bearing(&offer("m", "a1", 2)), Some(Delivery::Behind(third.order)));
        let refused = Receipt::new(&third, Verdict::Refused("no".into()));
        assert_eq!(refused.bearing(&third), Some(Delivery::Refused("no".into())));
        assert_eq!(refused.bearing(&offer("m", "a1", 2)), None);
        let long = Receipt::new(&third, Verdict::Refused("é".repeat(10_000)));
        assert!(long.seal(&identities(["a1"])[1]).len() as u64 <= MAX_ENCODED);
    }
}
