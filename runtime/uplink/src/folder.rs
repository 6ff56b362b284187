//! The folder transport: a USB stick carried over after landing, or a directory both ends mount.
//!
//! `<folder>/<mission>/<aircraft>/offer`, `…/chunk/<blake3>` and the ground's `…/receipt`: the same names and bytes as on the
//! network. The ground's `<folder>/<mission>/ground.session` says what offers are to be bound to. Every file is written aside, synced and
//! renamed; chunks come before the offer that names them, so a reader never sees an offer whose chunks were not yet complete.

use std::path::{Path, PathBuf};
use std::sync::Arc;

use config::mission::MAX_AIRCRAFT;
use disk::Disk;

use super::Source;
use super::binding;
use super::medium::Medium;
use super::offer::{Hash, Offer, OfferedModel, hex, is_safe_name};
use super::receipt::{Delivery, MAX_ENCODED, Receipt};
use super::transport::{Inlet, Outlet, Patience, TransportError};
use crate::keys::{Domain, Identity};

/// Most aircraft folders visited; more than any mission has.
const MAX_ENTRIES: usize = 4 * MAX_AIRCRAFT;

/// The ground's word on its session, beside the aircraft's folders, none of which can have this name.
const SESSION: &str = "ground.session";

/// Writes a file so that it is either absent, old, or complete.
pub(super) fn write_whole(path: &Path, bytes: &[u8]) -> std::io::Result<()> {
    Ok(Disk::default().replace(path, |out| out.write_all(bytes))?)
}

/// Reads a file of at most `limit` bytes that is no link.
pub(super) fn read_not_linked(path: &Path, limit: u64) -> Result<Vec<u8>, TransportError> {
    let file = disk::regular::open_not_linked(path).map_err(TransportError::io(path))?;
    let read = disk::regular::read_at_most(file, limit).map_err(TransportError::io(path))?;
    read.map_err(|bytes| TransportError::TooLong { what: path.display().to_string(), bytes, limit })
}

/// Whether a name is that of a chunk: 64 hexadecimal digits.
pub(crate) fn is_hash(name: &str) -> bool {
    name.len() == 64 && name.bytes().all(|b| b.is_ascii_hexdigit())
}

/// Nothing between `root` and `path` is a link: whoever prepares a stick must not choose what is written or removed elsewhere.
fn without_links(root: &Path, path: &Path) -> std::io::Result<()> {
    let below = path.ancestors().take_while(|p| *p != root && p.starts_with(root));
    for part in below {
        match std::fs::symlink_metadata(part) {
            Ok(m) if m.is_symlink() => {
                let what = format!("{} is a link and is not followed; remove it", part.display());
                return Err(std::io::Error::other(what));
            }
            Err(e) if e.kind() != std::io::ErrorKind::NotFound => return Err(e),
            _ => {}
        }
    }
    Ok(())
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
    /// The ground's session that it is bound to.
    session: Option<Hash>,
    /// Bytes written to it.
    sent: u64,
}

impl FolderOutlet {
    /// Offers below `root`; nothing is touched before the first offer.
    pub fn new(root: &Path, source: Source) -> Self {
        let dir = root.join(&source.mission).join(&source.aircraft);
        let (root, medium) = (root.into(), Medium::of(root));
        Self { root, medium, dir, source, previous: Vec::new(), current: None, session: None, sent: 0 }
    }

    /// The session that the ground has written down here.
    fn session(&self) -> Option<Hash> {
        let path = self.dir.with_file_name(SESSION);
        let bytes = read_not_linked(&path, binding::MAX_SEALED).ok()?;
        let Source { identity, mission, .. } = &self.source;
        let session = binding::open(&bytes, mission, Domain::Session, identity);
        if session.is_none() {
            tracing::debug!("upload: {}: not signed by the ground; not used", path.display());
        }
        session
    }

    fn write_offer(&mut self, offer: &Offer, session: Option<Hash>) -> Result<(), TransportError> {
        let (path, bytes) = (self.dir.join("offer"), self.source.bind(offer, session).encode());
        write_whole(&path, &bytes).map_err(TransportError::io(&path))?;
        self.sent += bytes.len() as u64;
        self.session = session;
        Ok(())
    }

    /// Whether a chunk lies there whole. What was there before this start is read once: a power cut may have left half of it, or somebody
    /// something else.
    fn has(&self, path: &Path, hash: &Hash, bytes: u64) -> bool {
        match self.current {
            Some(_) => std::fs::symlink_metadata(path).is_ok_and(|m| m.is_file() && m.len() == bytes),
            None => read_not_linked(path, bytes).is_ok_and(|found| blake3::hash(&found) == *hash),
        }
    }

    fn drop_stale_chunks(&self, offer: &Offer) {
        let Ok(entries) = std::fs::read_dir(self.dir.join("chunk")) else { return };
        let keep: std::collections::HashSet<String> = offer.chunks.iter().chain(&self.previous).map(hex).collect();
        for entry in entries.flatten() {
            let name = entry.file_name();
            let is_ours = name.to_str().is_some_and(|name| is_hash(name) && !keep.contains(name));
            if is_ours && entry.file_type().is_ok_and(|t| t.is_file()) {
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
        without_links(&self.root, &self.dir.join("chunk")).map_err(TransportError::io(&self.dir))?;
        if self.current.is_none() {
            // The first of this start: what a kill left half written. Chunks are looked through below.
            Disk::default().sweep(&self.dir);
        }
        let chunks = self.dir.join("chunk");
        std::fs::create_dir_all(&chunks).map_err(TransportError::io(&chunks))?;
        for (index, hash) in model.offer.chunks.iter().enumerate() {
            let path = chunks.join(hex(hash));
            if !self.has(&path, hash, model.offer.chunk_len(index)) {
                let bytes = model.chunk(index).map_err(TransportError::io(&path))?;
                write_whole(&path, &bytes).map_err(TransportError::io(&path))?;
                self.sent += bytes.len() as u64;
            }
        }
        let session = self.session();
        self.write_offer(&model.offer, session)?;
        if let Some((_, chunks)) = self.current.replace((model.offer.model, model.offer.chunks.clone())) {
            self.previous = chunks;
        }
        self.drop_stale_chunks(&model.offer);
        Ok(())
    }

    /// On the stick is delivered, unless the ground has said otherwise there.
    fn delivery(&mut self, offer: &Offer) -> Delivery {
        let bytes = read_not_linked(&self.dir.join("receipt"), MAX_ENCODED).unwrap_or_default();
        let Source { identity, mission, aircraft, .. } = &self.source;
        let told = Receipt::open(&bytes, identity, mission, aircraft).and_then(|r| r.bearing(offer));
        let here = self.current.as_ref().is_some_and(|c| c.0 == offer.model);
        // A ground that came later has a session of its own.
        let session = self.session();
        if here
            && session.is_some()
            && session != self.session
            && let Err(e) = self.write_offer(offer, session)
        {
            tracing::debug!("upload: {e}");
            return Delivery::Waiting;
        }
        told.unwrap_or(if here { Delivery::Delivered } else { Delivery::Waiting })
    }

    fn sent(&self) -> u64 {
        self.sent
    }
}

/// The ground's end.
pub struct FolderInlet {
    root: PathBuf,
    dir: PathBuf,
    /// What says which session it is, as it lies there.
    session: Vec<u8>,
    max_offer: u64,
}

impl FolderInlet {
    /// Reads offers of `mission` below `root`, and says there that they are to be bound to `session`.
    pub fn new(root: &Path, mission: &str, session: &Hash, ground: &Identity, max_offer: u64) -> Self {
        let session = binding::seal(session, mission, Domain::Session, ground);
        Self { root: root.into(), dir: root.join(mission), session, max_offer }
    }

    /// Writes the session where aircraft read it. A medium that cannot be written to, or is not there, brings models all the same.
    fn say_session(&self) -> Result<(), TransportError> {
        let path = self.dir.join(SESSION);
        if read_not_linked(&path, binding::MAX_SEALED).is_ok_and(|bytes| bytes == self.session) {
            return Ok(());
        }
        let parent = self.root.parent().filter(|p| !p.as_os_str().is_empty()).unwrap_or(Path::new("."));
        std::fs::metadata(parent).map_err(TransportError::io(parent))?;
        Medium::of(&self.root).check().map_err(TransportError::io(&self.root))?;
        without_links(&self.root, &path).map_err(TransportError::io(&path))?;
        std::fs::create_dir_all(&self.dir).map_err(TransportError::io(&self.dir))?;
        write_whole(&path, &self.session).map_err(TransportError::io(&path))
    }
}

impl Inlet for FolderInlet {
    fn name(&self) -> String {
        format!("folder {}", self.dir.display())
    }

    fn offers(&self, _: Patience, see: &mut dyn FnMut(&[u8])) -> Result<(), TransportError> {
        if let Err(e) = self.say_session() {
            tracing::debug!("serve: {e}");
        }
        without_links(&self.root, &self.dir).map_err(TransportError::io(&self.dir))?;
        let entries = match std::fs::read_dir(&self.dir) {
            Ok(entries) => entries,
            // Nobody has offered anything yet, or the stick is not plugged in yet.
            Err(e) if e.kind() == std::io::ErrorKind::NotFound => return Ok(()),
            Err(e) => return Err(TransportError::io(&self.dir)(e)),
        };
        for entry in entries.flatten().take(MAX_ENTRIES) {
            let is_folder = entry.file_type().is_ok_and(|t| t.is_dir());
            if is_folder && entry.file_name().to_str().is_some_and(is_safe_name) {
                match read_not_linked(&entry.path().join("offer"), self.max_offer) {
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
        without_links(&self.root, &path).map_err(TransportError::io(&path))?;
        match read_not_linked(&path, offer.chunk_len(index)) {
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
        without_links(&self.root, &path).map_err(TransportError::io(&path))?;
        if let Err(e) = write_whole(&path, receipt) {
            tracing::debug!("serve: {}: {e}", path.display());
        }
        Ok(())
    }

    fn end_session(&self) {
        let path = self.dir.join(SESSION);
        if without_links(&self.root, &path).is_ok()
            && read_not_linked(&path, binding::MAX_SEALED).is_ok_and(|bytes| bytes == self.session)
            && let Err(e) = std::fs::remove_file(&path)
        {
            tracing::debug!("serve: {}: {e}", path.display());
        }
    }
}

#[cfg(test)]
mod tests {
    use std::os::unix::fs::symlink;

    use super::*;
    use crate::offer::Order;
    use crate::testing::noise;

    fn offered(dir: &Path, source: &Source) -> Arc<OfferedModel> {
        let path = dir.join("model");
        std::fs::write(&path, noise(40_000, 1)).expect("written");
        let order = Order { flight: 1, counter: 1 };
        let settings = config::upload::UploadSettings { chunk_kib: 16, ..Default::default() };
        Arc::new(OfferedModel::open(&path, &settings, source, order, true).expect("a model"))
    }

    #[test]
    fn a_stick_with_links_in_the_place_of_folders_gets_nothing_written_or_removed_elsewhere() {
        for linked in ["m", "m/a1", "m/a1/chunk"] {
            let dir = tempfile::tempdir().expect("a folder");
            let (stick, elsewhere) = (dir.path().join("stick"), dir.path().join("elsewhere"));
            std::fs::create_dir_all(elsewhere.join("a1/chunk")).expect("made");
            let keepsakes = [elsewhere.join("keepsake"), elsewhere.join("a1/chunk").join("a".repeat(64))];
            keepsakes.iter().for_each(|k| std::fs::write(k, b"mine").expect("written"));
            let link = stick.join(linked);
            std::fs::create_dir_all(link.parent().expect("a folder")).expect("made");
            symlink(&elsewhere, &link).expect("linked");
            let source = Source::unsigned("m", "a1");
            let mut outlet = FolderOutlet::new(&stick, source.clone());
            let error = outlet.offer(&offered(dir.path(), &source)).expect_err(linked).to_string();
            assert!(error.contains("is a link"), "{error}");
            assert!(keepsakes.iter().all(|k| std::fs::read(k).is_ok_and(|b| b == b"mine")), "{linked}");
            assert_eq!(std::fs::read_dir(&elsewhere).expect("there").count(), 2, "{linked}");
        }
    }

    #[test]
    fn of_a_stick_with_links_in_the_place_of_folders_the_ground_reads_nothing_and_writes_nothing_elsewhere() {
        for linked in ["m", "m/a1"] {
            let dir = tempfile::tempdir().expect("a folder");
            let (stick, elsewhere) = (dir.path().join("stick"), dir.path().join("elsewhere"));
            let source = Source::unsigned("m", "a1");
            let model = offered(dir.path(), &source);
            FolderOutlet::new(&dir.path().join("whole"), source).offer(&model).expect("offered");
            let link = stick.join(linked);
            std::fs::create_dir_all(link.parent().expect("a folder")).expect("made");
            std::fs::rename(dir.path().join("whole").join(linked), &elsewhere).expect("moved");
            symlink(&elsewhere, &link).expect("linked");
            let inlet = FolderInlet::new(&stick, "m", &[1; 32], &Identity::unsigned(), 4096);
            let stop = std::sync::atomic::AtomicBool::new(false);
            let patience = Patience { limit: std::time::Duration::ZERO, stop: &stop };
            let mut seen = 0;
            let read = inlet.offers(patience, &mut |_| seen += 1);
            assert!(seen == 0 && (read.is_err() || linked != "m"), "{linked}");
            assert!(inlet.chunk(&model.offer, 0, patience, &mut |_| true).is_err(), "{linked}");
            let refused = inlet.deliver_receipt("a1", b"it is here", patience, &mut |_| true).expect_err(linked);
            assert!(refused.to_string().contains("is a link"), "{refused}");
            let written = ["receipt", "a1/receipt", SESSION].map(|name| elsewhere.join(name).exists());
            assert_eq!(written, [false; 3], "{linked}");
        }
    }

    /// For the aircraft what lies on the stick is delivered; the ground refuses a chunk with other bytes.
    #[test]
    fn a_chunk_of_the_right_length_with_other_bytes_or_behind_a_link_is_written_anew() {
        let dir = tempfile::tempdir().expect("a folder");
        let (stick, source) = (dir.path().join("stick"), Source::unsigned("m", "a1"));
        let model = offered(dir.path(), &source);
        let chunks = stick.join("m/a1/chunk");
        let at = |index: usize| chunks.join(hex(&model.offer.chunks[index]));
        let whole = |index: usize| model.chunk(index).expect("a chunk");
        std::fs::create_dir_all(&chunks).expect("made");
        // As a power cut leaves a file: its length is there, its content is not.
        std::fs::write(at(0), vec![0; whole(0).len()]).expect("written");
        let away = dir.path().join("away");
        std::fs::write(&away, whole(1)).expect("written");
        symlink(&away, at(1)).expect("linked");
        FolderOutlet::new(&stick, source).offer(&model).expect("offered");
        for index in 0..model.offer.chunks.len() {
            assert!(!at(index).is_symlink() && std::fs::read(at(index)).is_ok_and(|b| b == whole(index)), "{index}");
        }
        assert_eq!(std::fs::read(&away).expect("read"), whole(1));
    }

    #[test]
    fn in_the_folder_of_chunks_only_chunks_are_removed() {
        let dir = tempfile::tempdir().expect("a folder");
        let source = Source::unsigned("m", "a1");
        let mut outlet = FolderOutlet::new(&dir.path().join("stick"), source.clone());
        let chunks = dir.path().join("stick/m/a1/chunk");
        std::fs::create_dir_all(chunks.join("b".repeat(64))).expect("made");
        for name in ["holiday.jpg", &"c".repeat(64)] {
            std::fs::write(chunks.join(name), b"x").expect("written");
        }
        outlet.offer(&offered(dir.path(), &source)).expect("offered");
        assert!(chunks.join("holiday.jpg").exists() && chunks.join("b".repeat(64)).exists());
        assert!(!chunks.join("c".repeat(64)).exists(), "a chunk of nothing on offer");
    }
}
