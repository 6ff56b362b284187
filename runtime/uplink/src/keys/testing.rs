//! Identities for tests of the links.

use super::*;

/// The identities of `ids`, which all know each other; the last one is the ground's.
pub(crate) fn identities<const N: usize>(ids: [&str; N]) -> Vec<Identity> {
    let own = |i: usize| SigningKey::from_bytes(&[i as u8 + 1; 32]);
    let names = ids.into_iter().chain([GROUND]).enumerate();
    let keys: HashMap<String, VerifyingKey> = names.map(|(i, id)| (id.to_owned(), own(i).verifying_key())).collect();
    (0..=N).map(|i| Identity { own: Some(own(i)), keys: keys.clone() }).collect()
}

#[cfg(feature = "zenoh")]
impl Identity {
    /// Somebody with a key that nobody knows, who knows the mission file and so answers its ground.
    pub(crate) fn stranger(one: &Self) -> Self {
        Self { own: Some(SigningKey::from_bytes(&[0xfe; 32])), keys: one.keys.clone() }
    }
}
