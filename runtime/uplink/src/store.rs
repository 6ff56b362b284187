//! What the ground has on disk of one aircraft: chunks as they arrive, then the verified model.
//!
//! `<dir>/chunk/<blake3>` survive a restart, so an interrupted transfer continues where it was; the finished model is
//! `<dir>/model.dgtr` with the offer it came from beside it; until then `<dir>/preview.dgtr` is what has come of it, to be looked at.
//! Chunks of a complete model are not fetched again for the next one: a cell that did not change is taken from where it lies. The model is replaced by renaming only after every chunk and the whole
//! have the promised hashes.

use std::collections::HashMap;
use std::io::{Read, Write};
use std::os::unix::fs::FileExt;
use std::path::{Path, PathBuf};

use config::error::{Error, ErrorKind};
use config::upload::UploadSettings;
use disk::Disk;

use super::admission::{Admission, ModelRefusal};
use super::disk_error::{DiskError, io};
use super::folder::{is_hash, read_not_linked};
use super::offer::{Hash, Offer, hex};

/// The offer of the model that lies complete.
const NOTE: &str = "offer";
/// That of the model which is just taking its place.
const NEXT_NOTE: &str = "offer.next";

/// One aircraft's models and chunks on the ground.
#[derive(Debug)]
pub struct Store {
    disk: Disk,
    dir: PathBuf,
    /// The offer of the model that lies complete in `dir`.
    complete: Option<Offer>,
    /// Its chunks, and their places in it.
    held: HashMap<Hash, (u64, u64)>,
}

/// Why a model could not be put together.
#[derive(Debug, thiserror::Error)]
pub enum StoreError {
    /// Disk trouble on the ground.
    #[error(transparent)]
    Disk(#[from] DiskError),
    /// A chunk does not have the bytes its name promises.
    #[error("chunk {index} of {aircraft}'s model is corrupt and will be fetched again")]
    Corrupt {
        /// Whose model.
        aircraft: String,
        /// Which chunk.
        index: usize,
    },
    /// Whole, but it may not count.
    #[error("{aircraft}'s model does not count: {why}")]
    Refused {
        /// Whose model.
        aircraft: String,
        /// What is wrong with it.
        why: ModelRefusal,
    },
    /// Every chunk is right but the whole is not: the offer itself is wrong.
    #[error("{0}'s model does not have the hash its offer promised; offer refused")]
    WrongWhole(String),
}

impl Error for StoreError {
    fn kind(&self) -> ErrorKind {
        match self {
            Self::Disk(e) => e.kind(),
            Self::Corrupt { .. } | Self::Refused { .. } | Self::WrongWhole(_) => ErrorKind::Failed,
        }
    }
}

/// The chunks of a model and their places in it: start and length.
fn chunks_of(offer: &Offer) -> HashMap<Hash, (u64, u64)> {
    let mut start = 0;
    let place = |(i, hash): (usize, &Hash)| {
        let from = start;
        start += offer.chunk_len(i);
        (*hash, (from, offer.chunk_len(i)))
    };
    offer.chunks.iter().enumerate().map(place).collect()
}

impl Store {
    /// Opens the folder of one aircraft, which is made when there is something to put into it, and remembers a model received
    /// earlier if it is still whole and its offer is still believed (keys may have changed since).
    pub fn open(disk: &Disk, dir: &Path, settings: &UploadSettings, admission: &Admission) -> Self {
        let mut store = Self { disk: disk.clone(), dir: dir.into(), complete: None, held: HashMap::new() };
        for folder in [dir, &dir.join("chunk")] {
            disk.sweep(folder);
        }
        let note = |name: &str| {
            let bytes = read_not_linked(&dir.join(name), Offer::max_encoded(settings)).ok()?;
            admission.offer(&bytes, settings).ok()
        };
        if let Some(model) = store.hash_of_model() {
            store.complete = [NOTE, NEXT_NOTE].into_iter().filter_map(note).find(|offer| offer.model == model);
            store.held = store.complete.as_ref().map(chunks_of).unwrap_or_default();
            if store.complete.as_ref().is_some_and(|offer| offer.finished) {
                // Nothing follows: what is left of the transfer was in the way of a kill or a power cut.
                store.keep_only(None);
            }
            if store.complete.is_none() {
                tracing::warn!(
                    "serve: {} is not what was received; it will be fetched again",
                    store.model_path().display()
                );
            }
        }
        store
    }

    /// Where the model lies once complete.
    pub fn model_path(&self) -> PathBuf {
        self.dir.join("model.dgtr")
    }

    /// The offer of the complete model, if there is one.
    pub fn complete(&self) -> Option<&Offer> {
        self.complete.as_ref()
    }

    fn hash_of_model(&self) -> Option<Hash> {
        let mut file = disk::regular::open(&self.model_path()).ok()?;
        let mut hasher = blake3::Hasher::new();
        let mut buffer = vec![0; 1 << 20];
        loop {
            match file.read(&mut buffer).ok()? {
                0 => return Some(*hasher.finalize().as_bytes()),
                n => hasher.update(&buffer[..n]),
            };
        }
    }

    fn chunk_path(&self, hash: &Hash) -> PathBuf {
        self.dir.join("chunk").join(hex(hash))
    }

    /// Indices of the chunks that are still to be fetched, each content once.
    pub fn missing(&self, offer: &Offer) -> Vec<usize> {
        let mut seen = std::collections::HashSet::new();
        (0..offer.chunks.len())
            .filter(|&i| seen.insert(offer.chunks[i]))
            .filter(|&i| {
                let (hash, length) = (&offer.chunks[i], offer.chunk_len(i));
                let is_held = self.held.get(hash).is_some_and(|(_, held)| *held == length);
                !is_held && !std::fs::metadata(self.chunk_path(hash)).is_ok_and(|m| m.len() == length)
            })
            .collect()
    }

    /// The bytes of a chunk, out of the complete model or its own file, if they are what its hash says.
    fn chunk(&self, hash: &Hash, length: u64) -> Option<Vec<u8>> {
        let right = |bytes: &Vec<u8>| bytes.len() as u64 == length && blake3::hash(bytes).as_bytes() == hash;
        let held = self.held.get(hash).filter(|(_, held)| *held == length).and_then(|(start, _)| {
            let mut bytes = vec![0; length as usize];
            disk::regular::open(&self.model_path()).ok()?.read_exact_at(&mut bytes, *start).ok()?;
            Some(bytes)
        });
        held.filter(right).or_else(|| read_not_linked(&self.chunk_path(hash), length).ok().filter(right))
    }

    /// Keeps one chunk, whose hash has been checked.
    ///
    /// # Errors
    /// The disk.
    pub fn put(&self, offer: &Offer, index: usize, bytes: &[u8]) -> Result<(), StoreError> {
        let path = self.chunk_path(&offer.chunks[index]);
        self.disk.replace(&path, |out| out.write_all(bytes)).map_err(|e| io(&path)(e.into()).into())
    }

    /// Writes what has come of a model in cells, up to the first chunk that is missing, as [`Self::preview_path`]: something to look at
    /// while a slow link brings the rest. Gives its bytes; nothing is written while that is not a quarter more than `before`.
    ///
    /// # Errors
    /// The disk.
    pub fn preview(&self, offer: &Offer, before: u64) -> Result<u64, StoreError> {
        let missing = self.missing(offer).into_iter().min().unwrap_or(0);
        let bytes = (0..missing).map(|i| offer.chunk_len(i)).sum::<u64>();
        if !offer.is_in_pieces() || bytes <= before + before / 4 {
            return Ok(before);
        }
        let path = self.preview_path();
        let fill = |out: &mut dyn Write| {
            // One that went bad ends it; `assemble` sees to it.
            let mut chunks = (0..missing).map_while(|i| self.chunk(&offer.chunks[i], offer.chunk_len(i)));
            chunks.try_for_each(|chunk| out.write_all(&chunk))
        };
        self.disk.replace(&path, fill).map_err(|e| io(&path)(e.into()))?;
        Ok(bytes)
    }

    /// Where [`Self::preview`] lies until the model is complete, refused or overtaken.
    pub fn preview_path(&self) -> PathBuf {
        self.dir.join("preview.dgtr")
    }

    /// Puts the model together, verifies it, and makes it the complete one if it may count; else the one before stays.
    /// Chunks that went bad on disk are removed, so that the next [`Store::missing`] names them.
    ///
    /// # Errors
    /// The disk, a chunk or the whole with other bytes than promised, or a model that does not count.
    pub fn assemble(&mut self, offer: &Offer, admission: &Admission) -> Result<(), StoreError> {
        let path = self.model_path();
        let mut whole = blake3::Hasher::new();
        let mut wrong = None;
        let fill = |out: &mut dyn Write| {
            for (index, hash) in offer.chunks.iter().enumerate() {
                let Some(bytes) = self.chunk(hash, offer.chunk_len(index)) else {
                    // Gone or unremovable: either way `missing` looks again.
                    let _ = self.disk.remove(&self.chunk_path(hash));
                    wrong = Some((StoreError::Corrupt { aircraft: offer.aircraft.clone(), index }, Some(*hash)));
                    return Err(std::io::ErrorKind::InvalidData.into());
                };
                whole.update(&bytes);
                out.write_all(&bytes)?;
            }
            if whole.finalize().as_bytes() != &offer.model {
                wrong = Some((StoreError::WrongWhole(offer.aircraft.clone()), None));
                return Err(std::io::ErrorKind::InvalidData.into());
            }
            Ok(())
        };
        // The new model's note is there before the model, and takes its name after it: at any moment one of the two notes
        // belongs to the model that is there.
        let check = |model: &Path| match admission.model(&offer.aircraft, model) {
            Ok(()) => self.write_note(NEXT_NOTE, offer),
            Err(why) => {
                self.keep_only(None);
                Err(StoreError::Refused { aircraft: offer.aircraft.clone(), why })
            }
        };
        let written = self.disk.replace_checked(&path, fill, check);
        if let Some((wrong, spoilt)) = wrong {
            spoilt.map(|hash| self.held.remove(&hash));
            return Err(wrong);
        }
        written.map_err(|e| io(&path)(e.into()))??;
        self.note(offer)?;
        self.keep_only(None);
        Ok(())
    }

    /// Writes down which offer the complete model came from (the same bytes may be offered again as final).
    ///
    /// # Errors
    /// The disk cannot be written to.
    pub fn note(&mut self, offer: &Offer) -> Result<(), StoreError> {
        self.write_note(NOTE, offer)?;
        // Left behind it vouches for the same model.
        let _ = self.disk.remove(&self.dir.join(NEXT_NOTE));
        self.held = chunks_of(offer);
        self.complete = Some(offer.clone());
        Ok(())
    }

    fn write_note(&self, name: &str, offer: &Offer) -> Result<(), StoreError> {
        let note = self.dir.join(name);
        self.disk.replace(&note, |out| out.write_all(&offer.encode())).map_err(|e| io(&note)(e.into()).into())
    }

    /// Removes chunks that belong to no model being fetched, and the preview of the one that was.
    pub fn keep_only(&self, offer: Option<&Offer>) {
        // There may be none.
        let _ = self.disk.remove(&self.preview_path());
        let keep: std::collections::HashSet<String> = offer.iter().flat_map(|o| &o.chunks).map(hex).collect();
        let chunks = self.dir.join("chunk");
        if !std::fs::symlink_metadata(&chunks).is_ok_and(|m| m.is_dir()) {
            return;
        }
        let Ok(entries) = std::fs::read_dir(chunks) else { return };
        for entry in entries.flatten() {
            if entry.file_name().to_str().is_some_and(|name| is_hash(name) && !keep.contains(name)) {
                // Left-overs cost room, nothing else.
                let _ = self.disk.remove(&entry.path());
            }
        }
    }
}

#[cfg(test)]
mod tests;
