//! The folder transport: a USB stick carried over after landing, or a directory both ends mount.
//!
//! `<folder>/<mission>/<aircraft>/offer`, `…/chunk/<blake3>` and the ground's `…/receipt`: the same names and bytes as on the
//! network. Every file is written aside, synced and renamed; chunks come before the offer that names them, so a reader
//! never sees an offer whose chunks were not yet complete when it was written.

use std::fs::File;
use std::io::Read;
use std::os::unix::fs::OpenOptionsExt;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use config::disk::Disk;
use config::mission::MAX_AIRCRAFT;

use super::Source;
use super::medium::Medium;
use super::offer::{Hash, Offer, OfferedModel, hex, is_safe_name};
use super::receipt::{Delivery, MAX_ENCODED, Receipt};
use super::transport::{Inlet, Outlet, Patience, TransportError};

/// Most aircraft folders looked at; more than any mission has.
const MAX_ENTRIES: usize = 4 * MAX_AIRCRAFT;

/// Writes a file so that it is either absent, old, or complete.
pub(super) fn write_whole(path: &Path, bytes: &[u8]) -> std::io::Result<()> {
    Ok(Disk::default().replace(path, |out| out.write_all(bytes))?)
}

/// Reads a file of at most `limit` bytes.
pub(super) fn read_bounded(path: &Path, limit: u64) -> Result<Vec<u8>, TransportError> {
    // A pipe without a writer would block for ever.
    let flags = rustix::fs::OFlags::NONBLOCK.bits() as i32;
    let file = File::options().read(true).custom_flags(flags).open(path).map_err(TransportError::io(path))?;
    if !file.metadata().map_err(TransportError::io(path))?.is_file() {
        return Err(TransportError::io(path)(std::io::Error::other("not a regular file")));
    }
    let mut bytes = Vec::new();
    file.take(limit + 1).read_to_end(&mut bytes).map_err(TransportError::io(path))?;
    if bytes.len() as u64 > limit {
        return Err(TransportError::TooLong { what: path.display().to_string(), bytes: bytes.len() as u64, limit });
    }
    Ok(bytes)
}

/// The aircraft's end.
pub struct FolderOutlet {
    root: PathBuf,
    medium: Medium,
    dir: PathBuf,
    source: Source,
    /// Chunks of the offer before the current one, kept for a ground station that is just reading them.
    previous: Vec<Hash>,
    current: Option<(Hash, Vec<Hash>)>,
    /// Bytes written to it.
    sent: u64,
}

impl FolderOutlet {
    /// Offers below `root`; nothing is touched before the first offer.
    pub fn new(root: &Path, source: Source) -> Self {
        let dir = root.join(&source.mission).join(&source.aircraft);
        Self { root: root.into(), medium: Medium::of(root), dir, source, previous: Vec::new(), current: None, sent: 0 }
    }

    fn drop_stale_chunks(&self, offer: &Offer) {
        let Ok(entries) = std::fs::read_dir(self.dir.join("chunk")) else { return };
        let keep: std::collections::HashSet<String> = offer.chunks.iter().chain(&self.previous).map(hex).collect();
        for entry in entries.flatten() {
            if !entry.file_name().to_str().is_some_and(|name| keep.contains(name)) {
                // Left-overs cost room, nothing else; the next offer tries again.
                let _ = std::fs::remove_file(entry.path());
            }
        }
    }
}

impl Outlet for FolderOutlet {
    fn name(&self) -> String {
        format!("folder {}", self.root.display())
    }

    fn offer(&mut self, model: &Arc<OfferedModel>) -> Result<(), TransportError> {
        // A stick that is not plugged in must fail, not fill the disk below its mount point.
        let parent = self.root.parent().filter(|p| !p.as_os_str().is_empty()).unwrap_or(Path::new("."));
        std::fs::metadata(parent).map_err(TransportError::io(parent))?;
        self.medium.check().map_err(TransportError::io(&self.root))?;
        if self.current.is_none() {
            // The first of this start: what a kill left half written. Chunks are looked through below.
            Disk::default().sweep(&self.dir);
        }
        let chunks = self.dir.join("chunk");
        std::fs::create_dir_all(&chunks).map_err(TransportError::io(&chunks))?;
        for (index, hash) in model.offer.chunks.iter().enumerate() {
            let path = chunks.join(hex(hash));
            let whole = std::fs::metadata(&path).is_ok_and(|m| m.len() == model.offer.chunk_len(index));
            if !whole {
                let bytes = model.chunk(index).map_err(TransportError::io(&path))?;
                write_whole(&path, &bytes).map_err(TransportError::io(&path))?;
                self.sent += bytes.len() as u64;
            }
        }
        let (path, offer) = (self.dir.join("offer"), model.offer.encode());
        write_whole(&path, &offer).map_err(TransportError::io(&path))?;
        self.sent += offer.len() as u64;
        if let Some((_, chunks)) = self.current.replace((model.offer.model, model.offer.chunks.clone())) {
            self.previous = chunks;
        }
        self.drop_stale_chunks(&model.offer);
        Ok(())
    }

    /// On the stick is delivered, unless the ground has said otherwise there.
    fn delivery(&mut self, offer: &Offer) -> Delivery {
        let bytes = read_bounded(&self.dir.join("receipt"), MAX_ENCODED).unwrap_or_default();
        let Source { identity, mission, aircraft, .. } = &self.source;
        let told = Receipt::open(&bytes, identity, mission, aircraft).and_then(|r| r.bearing(offer));
        let here = self.current.as_ref().is_some_and(|c| c.0 == offer.model);
        told.unwrap_or(if here { Delivery::Delivered } else { Delivery::Waiting })
    }

    fn sent(&self) -> u64 {
        self.sent
    }
}

/// The ground's end.
pub struct FolderInlet {
    dir: PathBuf,
    max_offer: u64,
}

impl FolderInlet {
    /// Reads offers of `mission` below `root`.
    pub fn new(root: &Path, mission: &str, max_offer: u64) -> Self {
        Self { dir: root.join(mission), max_offer }
    }
}

impl Inlet for FolderInlet {
    fn name(&self) -> String {
        format!("folder {}", self.dir.display())
    }

    fn offers(&self, _: Patience, see: &mut dyn FnMut(&[u8])) -> Result<(), TransportError> {
        let entries = match std::fs::read_dir(&self.dir) {
            Ok(entries) => entries,
            // Nobody has offered anything yet, or the stick is not plugged in yet.
            Err(e) if e.kind() == std::io::ErrorKind::NotFound => return Ok(()),
            Err(e) => return Err(TransportError::io(&self.dir)(e)),
        };
        for entry in entries.flatten().take(MAX_ENTRIES) {
            if entry.file_name().to_str().is_some_and(is_safe_name) {
                match read_bounded(&entry.path().join("offer"), self.max_offer) {
                    Ok(bytes) => see(&bytes),
                    Err(TransportError::Io { source, .. }) if source.kind() == std::io::ErrorKind::NotFound => {}
                    // One bad offer must not hide the others; an empty one is counted as damaged.
                    Err(e) => {
                        tracing::debug!("serve: {e}");
                        see(&[]);
                    }
                }
            }
        }
        Ok(())
    }

    fn chunk(
        &self,
        offer: &Offer,
        index: usize,
        _: Patience,
        accept: &mut dyn FnMut(&[u8]) -> bool,
    ) -> Result<Vec<u8>, TransportError> {
        let hash = offer.chunks[index];
        let path = self.dir.join(&offer.aircraft).join("chunk").join(hex(&hash));
        match read_bounded(&path, offer.chunk_len(index)) {
            Ok(bytes) if accept(&bytes) => Ok(bytes),
            Ok(_) => Err(TransportError::Corrupt(hash)),
            Err(TransportError::Io { source, .. }) if source.kind() == std::io::ErrorKind::NotFound => {
                Err(TransportError::NotHeld(hash))
            }
            Err(e) => Err(e),
        }
    }

    /// The stick carries it back; one that is read-only cannot, and for the aircraft a model on the stick is delivered.
    fn deliver_receipt(
        &self,
        aircraft: &str,
        receipt: &[u8],
        _: Patience,
        _: &mut dyn FnMut(&[u8]) -> bool,
    ) -> Result<(), TransportError> {
        let path = self.dir.join(aircraft).join("receipt");
        if let Err(e) = write_whole(&path, receipt) {
            tracing::debug!("serve: {}: {e}", path.display());
        }
        Ok(())
    }
}
