//! TLS without certificates to hand out: each end makes its own certificate from the key that it signs with, and believes
//! those of the keys in the mission file. Nothing but what `dgtr keys` made has to be copied.

use std::fs::File;
use std::io::{Error, ErrorKind, Read};
use std::path::Path;

use base64::Engine;
use base64::engine::general_purpose::STANDARD;
use config::upload::TlsSettings;
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

/// Bound on a file of certificates: some hundred of them.
const MOST_BYTES: u64 = 1 << 20;
const TOO_LONG: &str = "is longer than any file of certificates; name another one in [upload.tls]";

/// zenoh's TLS settings with the certificates of the user's own authority.
///
/// # Errors
/// A file is not there, is no regular one, is too long, or is a private key that others may read.
pub(super) fn of_files(tls: &TlsSettings) -> Result<serde_json::Value, TransportError> {
    let read = |path: &Path, file: std::io::Result<File>| {
        let mut bytes = Vec::new();
        let read = file.and_then(|file| file.take(MOST_BYTES + 1).read_to_end(&mut bytes));
        match read.map_err(TransportError::io(path))? as u64 <= MOST_BYTES {
            true => Ok(STANDARD.encode(bytes)),
            false => Err(TransportError::io(path)(Error::new(ErrorKind::InvalidInput, TOO_LONG))),
        }
    };
    let public = |path: &Path| read(path, disk::regular::open(path));
    let (certificate, key) = (public(&tls.certificate)?, read(&tls.key, disk::regular::open_secret(&tls.key))?);
    Ok(serde_json::json!({
        "root_ca_certificate_base64": public(&tls.authority)?,
        "enable_mtls": true,
        "listen_certificate_base64": certificate,
        "listen_private_key_base64": key,
        "connect_certificate_base64": certificate,
        "connect_private_key_base64": key,
    }))
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

#[cfg(test)]
mod tests {
    use std::fs::Permissions;
    use std::os::unix::fs::PermissionsExt;

    use super::*;

    #[test]
    fn a_certificates_key_that_others_may_read_and_a_pipe_in_the_place_of_a_file_are_refused_in_one_line() {
        let dir = tempfile::tempdir().expect("a folder");
        let at = |name: &str| dir.path().join(name);
        let tls = TlsSettings { authority: at("ca.pem"), certificate: at("own.pem"), key: at("own.key") };
        let files = [&tls.authority, &tls.certificate, &tls.key];
        let refused = |what: &str, file: &Path| {
            let line = of_files(&tls).expect_err(what).to_string();
            let named = line.contains(&*file.to_string_lossy()) && line.contains(what);
            assert!(named && !line.contains('\n'), "{line}");
        };
        files.iter().for_each(|file| std::fs::write(file, b"x").expect("written"));
        let mode = |mode| std::fs::set_permissions(&tls.key, Permissions::from_mode(mode)).expect("its own");
        mode(0o644);
        refused("chmod 600", &tls.key);
        mode(0o600);
        assert_eq!(of_files(&tls).expect("settings")["connect_private_key_base64"], STANDARD.encode(b"x"));
        for file in files {
            let whole = std::fs::read(file).expect("read");
            std::fs::remove_file(file).expect("removed");
            refused("No such file", file);
            rustix::fs::mknodat(rustix::fs::CWD, file, rustix::fs::FileType::Fifo, 0o600.into(), 0).expect("a pipe");
            refused("no regular file", file);
            std::fs::remove_file(file).expect("removed");
            std::fs::write(file, vec![b'x'; MOST_BYTES as usize + 1]).expect("written");
            mode(0o600);
            refused("is longer", file);
            std::fs::write(file, whole).expect("written");
        }
    }
}
