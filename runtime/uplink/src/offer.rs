//! What an aircraft says about a model it holds, and the model file cut into content-hashed chunks.
//!
//! The offer is the only thing the ground has to believe before it can check everything else: each field is bounded
//! when it arrives, the chunk list must add up to the stated size, and the aircraft's signature covers every byte.
//!
//! ```text
//! version u8 · mission · aircraft · flight · counter · finished · size · chunk bytes · model · chunks   (postcard)
//! versions 3, 5: bytes of each chunk (postcard)
//! versions 4, 5: number of the ground's session (32)
//! Ed25519 signature of "dgtr offer\0" and everything before (64; absent in missions without keys)
//! ```
//!
//! A model in cells is cut where its cells end (version 3), so that a cell that did not change is a chunk the ground has; its
//! first chunk is its index, coarse layers and cells follow by importance, small ones together. Any other file is cut evenly (version 2).
//! Where the aircraft knows the ground's session, the offer is bound to it (versions 4 and 5).

use std::fs::File;
use std::io::Read;
use std::os::unix::fs::FileExt;
use std::path::Path;

use serde::{Deserialize, Serialize};

use config::upload::UploadSettings;
use models::formats::model;

use super::Source;
use crate::keys::{Domain, Identity, SignatureBytes, SignatureError};

/// Versions of the wire format; another one is refused, not guessed at. 1 was unsigned and ordered by the wall clock.
const EVEN: u8 = 2;
/// With chunks of different lengths.
const PIECES: u8 = 3;
/// An offer bound to a session of the ground.
const EVEN_BOUND: u8 = 4;
const PIECES_BOUND: u8 = 5;
/// A chunk's length takes so many bytes at most.
const MAX_SIZE: u64 = 3;
/// Longest mission or aircraft name on the wire (the mission file allows 32).
const MAX_NAME: usize = 64;

/// blake3 of a chunk or a whole model.
pub type Hash = [u8; 32];

/// Lower-case hexadecimal, as used in keys and file names.
pub use config::keys::to_hex as hex;

/// The order of one aircraft's models. Clocks do not enter: one that went back would hide every model that follows.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
pub struct Order {
    /// Number of the flight, counted on the aircraft and kept over restarts.
    pub flight: u64,
    /// Number of the offer within the flight.
    pub counter: u64,
}

/// One model on offer.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Offer {
    version: u8,
    /// Mission the model belongs to.
    pub mission: String,
    /// Aircraft that made it.
    pub aircraft: String,
    /// Larger = newer, per aircraft.
    pub order: Order,
    /// No further model of this flight will follow.
    pub finished: bool,
    /// Bytes of the model file.
    pub size: u64,
    /// Bytes of every chunk but the last; where they differ, of the largest.
    pub chunk_bytes: u32,
    /// blake3 of the whole file.
    pub model: Hash,
    /// blake3 of each chunk, in file order.
    pub chunks: Vec<Hash>,
    /// Bytes of each chunk where they differ.
    #[serde(skip)]
    sizes: Vec<u32>,
    /// The session of the ground that it was made for, if the aircraft knew it.
    #[serde(skip)]
    pub session: Option<Hash>,
    /// The aircraft's signature of all the above.
    #[serde(skip)]
    pub signature: Option<SignatureBytes>,
}

/// Why an offer was not accepted.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum OfferError {
    /// Cut short, garbled, or longer than any valid offer.
    #[error("offer is damaged: {0}")]
    Damaged(String),
    /// Made by a different version of this program.
    #[error("offer has format {0}, this program reads {EVEN} to {PIECES_BOUND}; update the older side")]
    Version(u8),
    /// Another mission on the same link.
    #[error("offer belongs to mission {0:?}")]
    ForeignMission(String),
    /// Not one of the mission's aircraft.
    #[error("offer is from aircraft {0:?}, which the mission does not know")]
    UnknownAircraft(String),
    /// Made by somebody else than it says.
    #[error("offer in the name of {aircraft:?} {source}")]
    Forged {
        /// The name it was made in.
        aircraft: String,
        /// What is wrong.
        source: SignatureError,
    },
    /// Above `upload.max_model_mib`.
    #[error("model of {size} bytes is above the limit of {limit} (upload.max_model_mib)")]
    Oversize {
        /// Stated size.
        size: u64,
        /// Accepted size.
        limit: u64,
    },
}

/// Whether a name is safe as a path component and as a part of a zenoh key.
pub fn is_safe_name(name: &str) -> bool {
    !name.is_empty()
        && name.len() <= MAX_NAME
        && name.bytes().all(|b| b.is_ascii_alphanumeric() || b == b'-' || b == b'_')
}

impl Offer {
    /// Most bytes an encoded offer can have under these settings.
    pub fn max_encoded(settings: &UploadSettings) -> u64 {
        352 + 2 * MAX_NAME as u64 + (32 + MAX_SIZE) * settings.max_chunks()
    }

    /// What is signed.
    fn signed_bytes(&self) -> Vec<u8> {
        // Plain integers, strings and byte arrays: serialising into a growing vector has no way to fail.
        let mut bytes = postcard::to_allocvec(self).unwrap_or_default();
        if self.is_in_pieces() {
            bytes.extend(postcard::to_allocvec(&self.sizes).unwrap_or_default());
        }
        bytes.extend(self.session.iter().flatten());
        bytes
    }

    /// Returns this offer for a session of the ground, signed anew.
    pub fn bound_to(&self, session: &Hash, identity: &Identity) -> Self {
        let version = if self.is_in_pieces() { PIECES_BOUND } else { EVEN_BOUND };
        let mut bound = Self { version, session: Some(*session), ..self.clone() };
        bound.signature = identity.sign(Domain::Offer, &bound.signed_bytes());
        bound
    }

    /// Wire bytes.
    pub fn encode(&self) -> Vec<u8> {
        let mut bytes = self.signed_bytes();
        bytes.extend(self.signature.iter().flatten());
        bytes
    }

    /// What tells this offer from every other one.
    pub fn digest(&self) -> Hash {
        *blake3::hash(&self.encode()).as_bytes()
    }

    /// Wire bytes → an offer whose every field is within bounds. Whether it concerns us is [`Offer::check`]'s job.
    ///
    /// # Errors
    /// The bytes are no offer of this version.
    pub fn decode(bytes: &[u8], settings: &UploadSettings) -> Result<Self, OfferError> {
        let damaged = |what: &str| Err(OfferError::Damaged(what.into()));
        if bytes.len() as u64 > Self::max_encoded(settings) {
            return damaged("longer than any valid one");
        }
        match bytes.first() {
            Some(&(EVEN..=PIECES_BOUND)) => {}
            Some(&other) => return Err(OfferError::Version(other)),
            None => return damaged("empty"),
        }
        let unreadable = |e: postcard::Error| OfferError::Damaged(e.to_string());
        let (mut offer, mut rest): (Self, _) = postcard::take_from_bytes(bytes).map_err(unreadable)?;
        if offer.is_in_pieces() {
            (offer.sizes, rest) = postcard::take_from_bytes(rest).map_err(unreadable)?;
        }
        if matches!(offer.version, EVEN_BOUND | PIECES_BOUND) {
            let Some((session, behind)) = rest.split_first_chunk() else { return damaged("ends before its session") };
            (offer.session, rest) = (Some(*session), behind);
        }
        match SignatureBytes::try_from(rest) {
            Ok(signature) => offer.signature = Some(signature),
            Err(_) if rest.is_empty() => {}
            Err(_) => return damaged("bytes after its end"),
        }
        if !is_safe_name(&offer.mission) || !is_safe_name(&offer.aircraft) {
            return damaged("mission or aircraft name");
        }
        let limit = settings.max_model_bytes();
        if offer.size > limit {
            return Err(OfferError::Oversize { size: offer.size, limit });
        }
        let kib = config::upload::CHUNK_KIB;
        if offer.size == 0 || !(kib.start() * 1024..=kib.end() * 1024).contains(&offer.chunk_bytes) {
            return damaged("size of model or chunk");
        }
        let adds_up = match offer.is_in_pieces() {
            false => offer.chunks.len() as u64 == offer.size.div_ceil(u64::from(offer.chunk_bytes)),
            true => {
                offer.sizes.len() == offer.chunks.len()
                    && offer.chunks.len() as u64 <= settings.max_chunks()
                    && offer.sizes.iter().all(|n| (1..=offer.chunk_bytes).contains(n))
                    && offer.sizes.iter().map(|n| u64::from(*n)).sum::<u64>() == offer.size
            }
        };
        if adds_up { Ok(offer) } else { damaged("number of chunks does not match the size") }
    }

    /// Whether the offer concerns this mission, comes from one of its aircraft, and from nobody else.
    ///
    /// # Errors
    /// The first of these that does not hold.
    pub fn check(&self, mission: &str, aircraft: &[String], identity: &Identity) -> Result<(), OfferError> {
        if self.mission != mission {
            return Err(OfferError::ForeignMission(self.mission.clone()));
        }
        if !aircraft.contains(&self.aircraft) {
            return Err(OfferError::UnknownAircraft(self.aircraft.clone()));
        }
        // Encoded anew, so that an offer has one encoding only.
        identity
            .verify(&self.aircraft, Domain::Offer, &self.signed_bytes(), self.signature.as_ref())
            .map_err(|source| OfferError::Forged { aircraft: self.aircraft.clone(), source })
    }

    /// Whether its chunks are the pieces of a model in cells.
    pub fn is_in_pieces(&self) -> bool {
        matches!(self.version, PIECES | PIECES_BOUND)
    }

    /// Bytes of chunk `index`.
    pub fn chunk_len(&self, index: usize) -> u64 {
        if self.is_in_pieces() {
            return self.sizes.get(index).copied().unwrap_or(0).into();
        }
        let chunk = u64::from(self.chunk_bytes);
        self.size.saturating_sub(index as u64 * chunk).min(chunk)
    }

    /// Where chunk `index` begins in the file.
    pub fn chunk_start(&self, index: usize) -> u64 {
        if self.is_in_pieces() {
            return self.sizes.iter().take(index).map(|n| u64::from(*n)).sum();
        }
        index as u64 * u64::from(self.chunk_bytes)
    }
}

/// A model file held open for the ground to fetch. Model files are replaced by renaming, so the open file keeps
/// the very bytes that were hashed even while training writes newer ones.
#[derive(Debug)]
pub struct OfferedModel {
    /// What is said about it.
    pub offer: Offer,
    file: File,
}

impl OfferedModel {
    /// Opens, hashes and signs a model file. Reads it once, with one chunk in memory.
    ///
    /// # Errors
    /// The file cannot be read, is empty, or is larger than `max_model_mib`.
    pub fn open(
        path: &Path,
        settings: &UploadSettings,
        source: &Source,
        order: Order,
        finished: bool,
    ) -> std::io::Result<Self> {
        let mut file = disk::regular::open(path)?;
        let size = file.metadata()?.len();
        if size == 0 || size > settings.max_model_bytes() {
            return Err(std::io::Error::other(format!(
                "{} has {size} bytes; a model has 1 to {} (upload.max_model_mib)",
                path.display(),
                settings.max_model_bytes()
            )));
        }
        let chunk_bytes = settings.chunk_bytes();
        // What is no model in cells is cut evenly, whatever it is: the ground says what it thinks of it.
        let pieces = model::pieces(path).ok().flatten().filter(|p| p.iter().sum::<u64>() == size);
        let version = if pieces.is_some() { PIECES } else { EVEN };
        let cut = |piece: u64| {
            (0..piece.div_ceil(u64::from(chunk_bytes)))
                .map(move |i| (piece - i * u64::from(chunk_bytes)).min(u64::from(chunk_bytes)) as u32)
        };
        let sizes: Vec<u32> = pieces.unwrap_or(vec![size]).into_iter().flat_map(cut).collect();
        let mut whole = blake3::Hasher::new();
        let mut chunks = Vec::with_capacity(sizes.len());
        let mut buffer = vec![0; chunk_bytes as usize];
        for take in &sizes {
            let chunk = &mut buffer[..*take as usize];
            file.read_exact(chunk)?;
            whole.update(chunk);
            chunks.push(*blake3::hash(chunk).as_bytes());
        }
        let offer = Offer {
            version,
            mission: source.mission.clone(),
            aircraft: source.aircraft.clone(),
            order,
            finished,
            size,
            chunk_bytes,
            model: *whole.finalize().as_bytes(),
            chunks,
            sizes: if version == PIECES { sizes } else { Vec::new() },
            session: None,
            signature: None,
        };
        Ok(Self { offer, file }.signed(&source.identity))
    }

    fn signed(mut self, identity: &Identity) -> Self {
        self.offer.signature = identity.sign(Domain::Offer, &self.offer.signed_bytes());
        self
    }

    /// Numbers this model anew.
    ///
    /// # Errors
    /// The open file cannot be shared.
    pub fn renumbered(&self, order: Order, identity: &Identity) -> std::io::Result<Self> {
        let offer = Offer { order, ..self.offer.clone() };
        Ok(Self { offer, file: self.file.try_clone()? }.signed(identity))
    }

    /// Bytes of chunk `index`, out of the open file.
    ///
    /// # Errors
    /// The model file cannot be read back.
    pub fn chunk(&self, index: usize) -> std::io::Result<Vec<u8>> {
        let mut bytes = vec![0; self.offer.chunk_len(index) as usize];
        self.file.read_exact_at(&mut bytes, self.offer.chunk_start(index))?;
        Ok(bytes)
    }

    /// Index of the chunk with this hash.
    pub fn find(&self, hash: &Hash) -> Option<usize> {
        self.offer.chunks.iter().position(|c| c == hash)
    }
}

#[cfg(test)]
pub(super) mod testing {
    use super::*;

    /// An unsigned offer of a small model in flight 1.
    pub(crate) fn offer(mission: &str, aircraft: &str, counter: u64) -> Offer {
        let order = Order { flight: 1, counter };
        let (mission, aircraft) = (mission.into(), aircraft.into());
        let (model, chunks) = ([counter as u8; 32], vec![[counter as u8; 32]]);
        let (size, chunk_bytes) = (100, 16 << 10);
        Offer {
            version: EVEN,
            mission,
            aircraft,
            order,
            finished: true,
            size,
            chunk_bytes,
            model,
            chunks,
            sizes: Vec::new(),
            session: None,
            signature: None,
        }
    }
}

#[cfg(test)]
mod tests;
