//! What an aircraft says of itself between its models, every two seconds: that it is there, and how it is. A heartbeat is bound to the
//! ground's session and numbered, so that an old one that somebody kept says nothing.
//!
//! ```text
//! version u8 · flight · counter · condition   (postcard)
//! number of the ground's session (32)
//! Ed25519 signature of "dgtr heartbeat\0", the key and everything before (64; absent in missions without keys)
//! ```

use std::time::{Duration, Instant};

use serde::{Deserialize, Serialize};

use crate::keys::{Domain, Identity, SignatureBytes};
use crate::offer::{Hash, Order};

/// Version of the wire format; another one is not heard.
const VERSION: u8 = 1;
/// Bytes of a sealed heartbeat at most.
pub const MAX_SEALED: u64 = 64 + 32 + 64;
/// Between two heartbeats.
pub const EVERY: Duration = Duration::from_secs(2);

/// How an aircraft is.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct Condition {
    /// Charge of its battery, percent.
    pub battery_pct: Option<u8>,
    /// Battery for the way home only.
    pub battery_low: bool,
    /// Its computer does not hear its autopilot.
    pub link_lost: bool,
    /// Its flight is over.
    pub landed: bool,
    /// Ground of its region that is covered, percent.
    pub covered_pct: Option<u8>,
}

/// A heartbeat.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Heartbeat {
    version: u8,
    /// Larger = newer, per aircraft; counts apart from its models.
    pub order: Order,
    /// What it says.
    pub condition: Condition,
}

impl Heartbeat {
    /// Says it.
    pub fn new(order: Order, condition: Condition) -> Self {
        Self { version: VERSION, order, condition }
    }

    /// Wire bytes for this session under this key.
    pub fn seal(&self, session: &Hash, key: &str, identity: &Identity) -> Vec<u8> {
        // Plain integers: serialising into a growing vector has no way to fail.
        let mut bytes = postcard::to_allocvec(self).unwrap_or_default();
        bytes.extend(session);
        let signature = identity.sign(Domain::Heartbeat, &signed(&bytes, key));
        bytes.extend(signature.iter().flatten());
        bytes
    }

    /// The heartbeat that `aircraft` sealed for this session under this key; `None` for anything else.
    pub fn open(bytes: &[u8], session: &Hash, key: &str, aircraft: &str, identity: &Identity) -> Option<Self> {
        if bytes.len() as u64 > MAX_SEALED {
            return None;
        }
        let (heartbeat, rest): (Self, _) = postcard::take_from_bytes(bytes).ok()?;
        let (of, rest) = rest.split_first_chunk::<32>()?;
        let signature = SignatureBytes::try_from(rest).ok();
        let is_whole = signature.is_some() || rest.is_empty();
        let body = &bytes[..bytes.len() - rest.len()];
        let is_its = identity.verify(aircraft, Domain::Heartbeat, &signed(body, key), signature.as_ref()).is_ok();
        (heartbeat.version == VERSION && of == session && is_whole && is_its).then_some(heartbeat)
    }
}

fn signed(bytes: &[u8], key: &str) -> Vec<u8> {
    [key.as_bytes(), b"\0", bytes].concat()
}

/// The newest heartbeat of an aircraft, and when it came.
#[derive(Clone, Copy, Debug)]
pub struct Heard {
    /// When.
    pub at: Instant,
    /// What.
    pub heartbeat: Heartbeat,
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::keys::testing::identities;

    #[test]
    fn only_an_aircrafts_own_words_of_this_session_are_believed() {
        let all = identities(["a1", "a2"]);
        let [a1, a2, ground] = [&all[0], &all[1], &all[2]];
        let condition = Condition { battery_pct: Some(14), battery_low: true, ..Condition::default() };
        let heartbeat = Heartbeat::new(Order { flight: u64::MAX, counter: u64::MAX }, condition);
        let (now, before, key) = ([3; 32], [4; 32], "dgtr/m/a1/heartbeat");
        let bytes = heartbeat.seal(&now, key, a1);
        assert!(bytes.len() as u64 <= MAX_SEALED, "{}", bytes.len());
        assert_eq!(Heartbeat::open(&bytes, &now, key, "a1", ground), Some(heartbeat));
        assert_eq!(Heartbeat::open(&bytes, &before, key, "a1", ground), None, "of an earlier session");
        assert_eq!(Heartbeat::open(&bytes, &now, "dgtr/m/a2/heartbeat", "a2", ground), None, "under another's key");
        for forger in [a2, ground, &Identity::unsigned()] {
            assert_eq!(Heartbeat::open(&heartbeat.seal(&now, key, forger), &now, key, "a1", ground), None);
        }
        for cut in 0..bytes.len() {
            assert_eq!(Heartbeat::open(&bytes[..cut], &now, key, "a1", ground), None, "{cut} bytes");
        }
        let long = [&bytes[..], &[0; 100]].concat();
        assert_eq!(Heartbeat::open(&long, &now, key, "a1", ground), None);
        let nobody = Identity::unsigned();
        assert_eq!(Heartbeat::open(&heartbeat.seal(&now, key, &nobody), &now, key, "a1", &nobody), Some(heartbeat));
    }
}
