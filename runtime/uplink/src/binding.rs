//! What binds an offer to the ground's session: a number that the ground draws, or a word in the mission, which the aircraft signs
//! into its offers. A model of an earlier flight, on a stick that nobody cleared or kept by somebody and sent again, carries
//! another one.
//!
//! The aircraft learns it from the question for its offer, or from the file `ground.session` that the ground writes on a stick:
//! 32 bytes, then in missions with keys the ground's signature of the mission's name and them.

use super::offer::Hash;
use crate::keys::{Domain, GROUND, Identity, SignatureBytes};

/// Bytes of a sealed number at most.
pub const MAX_SEALED: u64 = 32 + 64;

/// The number of the session that the mission names.
pub fn named(word: &str) -> Hash {
    blake3::derive_key("dgtr 2026 session named in the mission", word.as_bytes())
}

/// A session's number with the ground's signature for `about`: a mission's name, or the key of a question.
pub fn seal(session: &Hash, about: &str, domain: Domain, ground: &Identity) -> Vec<u8> {
    let mut bytes = session.to_vec();
    bytes.extend(ground.sign(domain, &signed(session, about)).iter().flatten());
    bytes
}

/// The number of a session that the ground sealed for `about`; None for anything else.
pub fn open(bytes: &[u8], about: &str, domain: Domain, identity: &Identity) -> Option<Hash> {
    let (session, rest) = bytes.split_first_chunk::<32>()?;
    let signature = SignatureBytes::try_from(rest).ok();
    let is_whole = signature.is_some() || rest.is_empty();
    let is_the_grounds = identity.verify(GROUND, domain, &signed(session, about), signature.as_ref()).is_ok();
    (is_whole && is_the_grounds).then_some(*session)
}

fn signed(session: &Hash, about: &str) -> Vec<u8> {
    [about.as_bytes(), session].concat()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::keys::testing::identities;

    #[test]
    fn only_the_grounds_own_session_for_this_mission_is_believed() {
        let all = identities(["a1", "a2"]);
        let [a1, a2, ground] = [&all[0], &all[1], &all[2]];
        let (mine, other) = (named("monday"), named("tuesday"));
        assert_ne!(mine, other);
        let bytes = seal(&mine, "m", Domain::Session, ground);
        assert_eq!(open(&bytes, "m", Domain::Session, a1), Some(mine));
        assert_eq!(open(&bytes, "n", Domain::Session, a1), None, "another mission's");
        assert_eq!(open(&bytes, "m", Domain::Request, a1), None, "another kind of message");
        assert_eq!(open(&[&other[..], &bytes[32..]].concat(), "m", Domain::Session, a1), None);
        for forger in [a1, a2, &Identity::unsigned()] {
            assert_eq!(open(&seal(&mine, "m", Domain::Session, forger), "m", Domain::Session, a1), None);
        }
        for cut in 0..bytes.len() {
            assert_eq!(open(&bytes[..cut], "m", Domain::Session, a1), None, "{cut} bytes");
        }
        let nobody = Identity::unsigned();
        assert_eq!(open(&seal(&mine, "m", Domain::Session, &nobody), "m", Domain::Session, &nobody), Some(mine));
    }
}
