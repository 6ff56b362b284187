//! TLS without certificates to hand out: each end makes its own certificate from the key that it signs with, and believes
//! those of the keys in the mission file. Nothing but what `dgtr keys` made has to be copied.

use base64::Engine;
use base64::engine::general_purpose::STANDARD;
use rcgen::{
    CertificateParams, DistinguishedName, DnType, Issuer, KeyPair, PKCS_ED25519, PublicKeyData, SignatureAlgorithm,
    date_time_ymd,
};

use super::network;
use crate::keys::{GROUND, Identity};
use crate::transport::TransportError;

/// What a private Ed25519 key's 32 bytes have before them in PKCS #8 (RFC 8410, section 7).
const PKCS8: [u8; 16] = [0x30, 0x2e, 2, 1, 0, 0x30, 5, 6, 3, 0x2b, 0x65, 0x70, 4, 0x22, 4, 0x20];

/// A public key without its private one.
struct Public([u8; 32]);

impl PublicKeyData for Public {
    fn der_bytes(&self) -> &[u8] {
        &self.0
    }

    fn algorithm(&self) -> &'static SignatureAlgorithm {
        &PKCS_ED25519
    }
}

/// A certificate's contents for the name `id`; valid at any time, as companion computers may not know it.
fn contents(id: &str) -> Result<CertificateParams, rcgen::Error> {
    let mut contents = CertificateParams::new(Vec::new())?;
    contents.distinguished_name = DistinguishedName::new();
    contents.distinguished_name.push(DnType::CommonName, id);
    (contents.not_before, contents.not_after) = (date_time_ymd(1970, 1, 1), date_time_ymd(9999, 12, 31));
    Ok(contents)
}

/// zenoh's TLS settings for the end called `id`: an aircraft believes the ground, the ground every aircraft. `None` in a mission
/// without keys.
///
/// # Errors
/// The key cannot be used so.
pub(super) fn settings(identity: &Identity, id: &str) -> Result<Option<serde_json::Value>, TransportError> {
    let Some(seed) = identity.seed() else { return Ok(None) };
    let key = KeyPair::try_from([&PKCS8[..], &seed].concat()).map_err(network)?;
    let own = contents(id).map_err(network)?;
    let certificate = own.self_signed(&key).map_err(network)?.pem();
    let issuer = Issuer::from_params(&own, &key);
    // Only name and key of these count: that we signed them ourselves says nothing and is not checked.
    let believed = identity.public_keys().filter(|(name, _)| (*name == GROUND) != (id == GROUND));
    let anchor = |(name, key)| contents(name)?.signed_by(&Public(key), &issuer).map(|c| c.pem());
    let anchors: String = believed.map(anchor).collect::<Result<_, rcgen::Error>>().map_err(network)?;
    let (private, certificate) = (STANDARD.encode(key.serialize_pem()), STANDARD.encode(certificate));
    Ok(Some(serde_json::json!({
        "root_ca_certificate_base64": STANDARD.encode(anchors),
        "enable_mtls": true,
        // Whoever has the ground's key is the ground, at whatever address.
        "verify_name_on_connect": false,
        "listen_certificate_base64": certificate,
        "listen_private_key_base64": private,
        "connect_certificate_base64": certificate,
        "connect_private_key_base64": private,
    })))
}
