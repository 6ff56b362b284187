//! What the ground has on disk of one aircraft: chunks as they arrive, then the verified model.
//!
//! `<dir>/chunk/<blake3>` survive a restart, so an interrupted transfer continues where it was; the finished model is
//! `<dir>/model.dgtr` with the offer it came from beside it. The model is replaced by renaming only after every
//! chunk and the whole have the promised hashes.

use std::fs::File;
use std::io::{Read, Write};
use std::path::{Path, PathBuf};

use config::upload::UploadSettings;

use super::folder::{read_bounded, write_whole};
use super::offer::{Hash, Offer, hex};

/// One aircraft's models and chunks on the ground.
#[derive(Debug)]
pub struct Store {
    dir: PathBuf,
    /// The offer of the model that lies complete in `dir`.
    complete: Option<Offer>,
}

/// Why a model could not be put together.
#[derive(Debug, thiserror::Error)]
pub enum StoreError {
    /// Disk trouble on the ground.
    #[error("{path}: {source}; is the disk full or read-only?")]
    Io {
        /// Where.
        path: String,
        /// The system's word on it.
        source: std::io::Error,
    },
    /// A chunk does not have the bytes its name promises.
    #[error("chunk {index} of {aircraft}'s model is corrupt and will be fetched again")]
    Corrupt {
        /// Whose model.
        aircraft: String,
        /// Which chunk.
        index: usize,
    },
    /// Every chunk is right but the whole is not: the offer itself is wrong.
    #[error("{0}'s model does not have the hash its offer promised; offer refused")]
    WrongWhole(String),
}

fn io(path: &Path) -> impl FnOnce(std::io::Error) -> StoreError + '_ {
    move |source| StoreError::Io { path: path.display().to_string(), source }
}

impl Store {
    /// Opens or creates the folder of one aircraft, and remembers a model received earlier if it is still whole.
    pub fn open(dir: &Path, settings: &UploadSettings) -> Result<Self, StoreError> {
        let chunks = dir.join("chunk");
        std::fs::create_dir_all(&chunks).map_err(io(&chunks))?;
        let mut store = Self { dir: dir.into(), complete: None };
        if let Ok(bytes) = read_bounded(&dir.join("offer"), Offer::max_encoded(settings))
            && let Ok(offer) = Offer::decode(&bytes, settings)
        {
            if store.hash_of_model().is_some_and(|h| h == offer.model) {
                store.complete = Some(offer);
            } else {
                tracing::warn!(
                    "serve: {} is not what was received; it will be fetched again",
                    store.model_path().display()
                );
            }
        }
        Ok(store)
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
        let mut file = File::open(self.model_path()).ok()?;
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
                !std::fs::metadata(self.chunk_path(&offer.chunks[i])).is_ok_and(|m| m.len() == offer.chunk_len(i))
            })
            .collect()
    }

    /// Checks and keeps one chunk.
    pub fn put(&self, offer: &Offer, index: usize, bytes: &[u8]) -> Result<(), StoreError> {
        let right =
            bytes.len() as u64 == offer.chunk_len(index) && blake3::hash(bytes).as_bytes() == &offer.chunks[index];
        if !right {
            return Err(StoreError::Corrupt { aircraft: offer.aircraft.clone(), index });
        }
        let path = self.chunk_path(&offer.chunks[index]);
        write_whole(&path, bytes).map_err(io(&path))
    }

    /// Puts the model together, verifies it, and makes it the complete one. Chunks that went bad on disk are
    /// removed, so that the next [`Store::missing`] names them.
    pub fn assemble(&mut self, offer: &Offer) -> Result<(), StoreError> {
        let path = self.model_path();
        let mut file = tempfile::Builder::new().prefix(".tmp-").tempfile_in(&self.dir).map_err(io(&self.dir))?;
        let mut whole = blake3::Hasher::new();
        for (index, hash) in offer.chunks.iter().enumerate() {
            let chunk = self.chunk_path(hash);
            let bytes = read_bounded(&chunk, offer.chunk_len(index)).unwrap_or_default();
            if bytes.len() as u64 != offer.chunk_len(index) || blake3::hash(&bytes).as_bytes() != hash {
                // Gone or unremovable: either way `missing` looks again.
                let _ = std::fs::remove_file(&chunk);
                return Err(StoreError::Corrupt { aircraft: offer.aircraft.clone(), index });
            }
            whole.update(&bytes);
            file.write_all(&bytes).map_err(io(&path))?;
        }
        if whole.finalize().as_bytes() != &offer.model {
            return Err(StoreError::WrongWhole(offer.aircraft.clone()));
        }
        file.as_file().sync_all().map_err(io(&path))?;
        // The old offer goes first: an offer must never vouch for a model it does not belong to.
        let note = self.dir.join("offer");
        match std::fs::remove_file(&note) {
            Err(e) if e.kind() != std::io::ErrorKind::NotFound => return Err(io(&note)(e)),
            _ => {}
        }
        file.persist(&path).map_err(|e| io(&path)(e.error))?;
        self.note(offer)?;
        self.keep_only(None);
        Ok(())
    }

    /// Writes down which offer the complete model came from (the same bytes may be offered again as final).
    pub fn note(&mut self, offer: &Offer) -> Result<(), StoreError> {
        let note = self.dir.join("offer");
        write_whole(&note, &offer.encode()).map_err(io(&note))?;
        self.complete = Some(offer.clone());
        Ok(())
    }

    /// Removes chunks that belong to no model being fetched.
    pub fn keep_only(&self, offer: Option<&Offer>) {
        let keep: std::collections::HashSet<String> = offer.iter().flat_map(|o| &o.chunks).map(hex).collect();
        let Ok(entries) = std::fs::read_dir(self.dir.join("chunk")) else { return };
        for entry in entries.flatten() {
            if !entry.file_name().to_str().is_some_and(|name| keep.contains(name)) {
                // Left-overs cost room, nothing else.
                let _ = std::fs::remove_file(entry.path());
            }
        }
    }
}
