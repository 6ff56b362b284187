//! Identities: an Ed25519 key per aircraft and one for the ground. An address or a certificate says how bytes came here,
//! only a signature says whose they are.

use std::collections::HashMap;
use std::fs::File;
use std::io::{Read, Write};
use std::os::unix::fs::MetadataExt;
use std::path::{Path, PathBuf};

use config::error::{Error, ErrorKind};
use config::keys::{PublicKey, from_hex, to_hex};
use config::mission::Mission;
use config::settings::SettingError;
use ed25519_dalek::{Signature, Signer, SigningKey, VerifyingKey};

/// First word of a private key's file, so that it is not pasted into a mission file by mistake.
const PRIVATE: &str = "dgtr-private-key";
/// Name of the ground's key.
pub const GROUND: &str = "ground";

/// Bytes of an Ed25519 signature.
pub type SignatureBytes = [u8; 64];

/// Why keys cannot be used.
#[derive(Debug, thiserror::Error)]
pub enum KeyError {
    /// The mission's keys or endpoints do not fit together.
    #[error("mission: {0}")]
    Mission(#[from] SettingError),
    /// A file of keys.
    #[error("{}: {source}; `dgtr keys` makes it, and [upload] keys says where it lies", path.display())]
    Io {
        /// The file.
        path: PathBuf,
        /// The system's reason.
        source: std::io::Error,
    },
    /// Others could sign in our name.
    #[error("{}: readable by others (mode {mode:o}); chmod 600 it, or make a new key if somebody may have read it", path.display())]
    Permissions {
        /// The file.
        path: PathBuf,
        /// Its permissions.
        mode: u32,
    },
    /// Not what `dgtr keys` writes.
    #[error("{}: not a private key of dgtr; `dgtr keys` makes one", .0.display())]
    Format(PathBuf),
    /// The mission knows another key under this name.
    #[error("{}: belongs to public key {found}, the mission has another one for {id}; paste this one into the mission file of all, or copy the right key", path.display())]
    Mismatch {
        /// The file.
        path: PathBuf,
        /// Whose it should be.
        id: String,
        /// What it is.
        found: PublicKey,
    },
    /// 32 bytes that no Ed25519 key has.
    #[error("mission: public_key {0} of {1} is no Ed25519 key; run `dgtr keys` again")]
    NoKey(PublicKey, String),
}

impl Error for KeyError {
    fn kind(&self) -> ErrorKind {
        match self {
            Self::Io { source, .. } => Error::kind(source),
            _ => ErrorKind::Input,
        }
    }
}

/// The file of a private key.
pub fn private_path(folder: &Path, id: &str) -> PathBuf {
    folder.join(format!("{id}.key"))
}

/// Makes a private key in `folder`, or finds the one that is there. Returns the public half and whether it is new.
///
/// # Errors
/// The folder cannot be written to, or what lies there is not a private key.
pub fn make(folder: &Path, id: &str) -> Result<(PublicKey, bool), KeyError> {
    let path = private_path(folder, id);
    let io = |source| KeyError::Io { path: path.clone(), source };
    std::fs::create_dir_all(folder).map_err(io)?;
    if path.exists() {
        return Ok((public(&read_private(&path)?), false));
    }
    let seed = random().map_err(io)?;
    // Temporary files are made with mode 0600.
    let mut file = tempfile::Builder::new().prefix(".tmp-").tempfile_in(folder).map_err(io)?;
    writeln!(file, "{PRIVATE} {}", to_hex(&seed)).and_then(|()| file.as_file().sync_all()).map_err(io)?;
    file.persist_noclobber(&path).map_err(|e| io(e.error))?;
    File::open(folder).and_then(|f| f.sync_all()).map_err(io)?;
    Ok((public(&SigningKey::from_bytes(&seed)), true))
}

/// 32 bytes that nobody can guess.
pub(crate) fn random() -> std::io::Result<[u8; 32]> {
    let (mut bytes, mut filled) = ([0; 32], 0);
    while filled < bytes.len() {
        filled += rustix::rand::getrandom(&mut bytes[filled..], rustix::rand::GetRandomFlags::empty())?;
    }
    Ok(bytes)
}

fn public(key: &SigningKey) -> PublicKey {
    PublicKey(key.verifying_key().to_bytes())
}

fn read_private(path: &Path) -> Result<SigningKey, KeyError> {
    let io = |source| KeyError::Io { path: path.into(), source };
    let file = disk::regular::open(path).map_err(io)?;
    let mode = file.metadata().map_err(io)?.mode() & 0o777;
    if mode & 0o077 != 0 {
        return Err(KeyError::Permissions { path: path.into(), mode });
    }
    let mut text = String::new();
    file.take(256).read_to_string(&mut text).map_err(io)?;
    let seed = text.trim().strip_prefix(PRIVATE).and_then(|rest| from_hex(rest.trim()));
    // Zeros are what a disk gives that lost the key.
    let seed = seed.filter(|s| *s != [0; 32]);
    seed.map(|s| SigningKey::from_bytes(&s)).ok_or_else(|| KeyError::Format(path.into()))
}

/// What a signature is about; the bytes of one kind can never pass as another's.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Domain {
    /// An aircraft offers a model.
    Offer,
    /// The ground says what it has.
    Receipt,
    /// An aircraft has taken note of a receipt.
    Acknowledgement,
    /// The ground asks an aircraft.
    Request,
    /// The ground names its session.
    Session,
    /// An aircraft says how it is.
    Heartbeat,
}

impl Domain {
    fn message(self, bytes: &[u8]) -> Vec<u8> {
        let domain: &[u8] = match self {
            Self::Offer => b"dgtr offer\0",
            Self::Receipt => b"dgtr receipt\0",
            Self::Acknowledgement => b"dgtr acknowledgement\0",
            Self::Request => b"dgtr request\0",
            Self::Session => b"dgtr session\0",
            Self::Heartbeat => b"dgtr heartbeat\0",
        };
        [domain, bytes].concat()
    }
}

/// Why a message is not believed.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
pub enum SignatureError {
    /// No signature where the mission has a key.
    #[error("carries no signature")]
    Missing,
    /// A signature by another key, or of other bytes.
    #[error("has a signature that is not by its key")]
    Wrong,
    /// No key under this name.
    #[error("nobody of this name has a key")]
    Unknown,
}

/// In whose name one end signs, and whom it believes.
#[derive(Clone, Default)]
pub struct Identity {
    own: Option<SigningKey>,
    keys: HashMap<String, VerifyingKey>,
}

impl Identity {
    /// Signs nothing and believes everybody: for missions without keys, whose endpoints stay on one machine.
    pub fn unsigned() -> Self {
        Self::default()
    }

    /// The identity of an aircraft, or of [`GROUND`].
    ///
    /// # Errors
    /// The mission may not be flown unsigned ([`Mission::check_trust`]), or the private key is missing, readable by
    /// others, or not the one whose public half the mission has.
    pub fn of(mission: &Mission, id: &str) -> Result<Self, KeyError> {
        if !mission.check_trust()? {
            return Ok(Self::unsigned());
        }
        let aircraft = mission.aircraft.iter().map(|a| (a.id.as_str(), a.public_key));
        let mut keys = HashMap::new();
        for (name, key) in aircraft.chain([(GROUND, mission.ground.public_key)]) {
            let Some(key) = key else { continue };
            let verifying = VerifyingKey::from_bytes(&key.0).map_err(|_| KeyError::NoKey(key, name.into()))?;
            keys.insert(name.to_owned(), verifying);
        }
        let path = private_path(&mission.upload.keys, id);
        let own = read_private(&path)?;
        if keys.get(id) != Some(&own.verifying_key()) {
            return Err(KeyError::Mismatch { path, id: id.into(), found: public(&own) });
        }
        Ok(Self { own: Some(own), keys })
    }

    /// Whether messages are signed at all.
    pub fn is_signed(&self) -> bool {
        self.own.is_some()
    }

    /// The private key's 32 bytes; `None` in a mission without keys.
    #[cfg(feature = "zenoh")]
    pub(crate) fn seed(&self) -> Option<[u8; 32]> {
        self.own.as_ref().map(SigningKey::to_bytes)
    }

    /// Everybody's name and public key.
    #[cfg(feature = "zenoh")]
    pub(crate) fn public_keys(&self) -> impl Iterator<Item = (&str, [u8; 32])> {
        self.keys.iter().map(|(id, key)| (id.as_str(), key.to_bytes()))
    }

    /// The public key of `id` in hexadecimal; empty in a mission without keys.
    pub fn key_of(&self, id: &str) -> String {
        self.keys.get(id).map_or(String::new(), |key| to_hex(key.as_bytes()))
    }

    /// Signs in our own name; None in a mission without keys.
    pub fn sign(&self, domain: Domain, bytes: &[u8]) -> Option<SignatureBytes> {
        Some(self.own.as_ref()?.sign(&domain.message(bytes)).to_bytes())
    }

    /// Whether `signer` signed these bytes as this kind of message. In a mission without keys everybody is believed.
    ///
    /// # Errors
    /// What is wrong with the signature.
    pub fn verify(
        &self,
        signer: &str,
        domain: Domain,
        bytes: &[u8],
        signature: Option<&SignatureBytes>,
    ) -> Result<(), SignatureError> {
        if !self.is_signed() {
            return Ok(());
        }
        let key = self.keys.get(signer).ok_or(SignatureError::Unknown)?;
        let signature = signature.ok_or(SignatureError::Missing)?;
        // Strict: one message has one signature, and none is accepted under a key of small order.
        key.verify_strict(&domain.message(bytes), &Signature::from_bytes(signature)).map_err(|_| SignatureError::Wrong)
    }
}

#[cfg(test)]
pub(crate) mod testing;
#[cfg(test)]
mod tests;
