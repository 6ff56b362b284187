//! Durable writes: the one way anything is kept. A file is written under a temporary name in its own folder, synced, renamed,
//! and the folder synced, so that a reader, a full disk or a power cut never sees half of it.
//!
//! [`Disk`] is a handle over [`Operations`]: the machine's own file system, one bounded to a number of bytes
//! ([`bounded::Bounded`]), or a test's that records every operation and cuts the power between any two.

use std::fmt;
use std::fs::File;
use std::hash::{BuildHasher, RandomState};
use std::io::{self, BufRead, BufReader, BufWriter, ErrorKind, Write};
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicU32, Ordering};

pub mod bounded;
mod lines;
mod lock;
mod operations;
pub mod plan;
pub mod regular;
mod remedy;
mod shown;
pub mod table;

pub use lines::Lines;
pub use lock::FolderLock;
pub use operations::{Operations, Output, System};
pub use remedy::{Told, told};
pub use shown::{Escaping, escaped};

/// What every temporary file's name begins with.
const TEMPORARY: &str = ".dgtr-";
/// Damaged files of one name that are kept apart; the last one is replaced by further ones.
const MAX_DAMAGED: u32 = 99;

/// What failed, and the system's word on it.
#[derive(Debug, thiserror::Error)]
#[error("{action} failed: {source}")]
pub struct DiskError {
    /// What was tried.
    pub action: &'static str,
    /// Why it failed.
    pub source: io::Error,
}

impl From<DiskError> for io::Error {
    fn from(e: DiskError) -> Self {
        e.source
    }
}

fn while_doing(action: &'static str) -> impl FnOnce(io::Error) -> DiskError {
    move |source| DiskError { action, source }
}

/// Whether the error says that there is no room: a full disk, a quota, a limit on the size of files.
pub fn is_full(e: &io::Error) -> bool {
    matches!(e.kind(), ErrorKind::StorageFull | ErrorKind::QuotaExceeded | ErrorKind::FileTooLarge)
}

/// Whether waiting, removing or remounting may mend the error: no room, a medium that has become read-only (as ext4 does after
/// an error) or that cannot be written for now. Not a wrong path.
pub fn may_pass(e: &io::Error) -> bool {
    // 5 = EIO, which has no kind of its own.
    is_full(e) || e.kind() == ErrorKind::ReadOnlyFilesystem || e.raw_os_error() == Some(5)
}

/// A handle to whatever files are written to.
#[derive(Clone, Debug)]
pub struct Disk(Arc<dyn Operations>);

impl Default for Disk {
    fn default() -> Self {
        Self::new(System)
    }
}

impl Disk {
    /// A handle to `operations`.
    pub fn new(operations: impl Operations + 'static) -> Self {
        Self(Arc::new(operations))
    }

    /// Takes so many bytes of a bound on the disk for a file without a name.
    ///
    /// # Errors
    /// There is a bound and it does not leave them.
    pub fn reserve(&self, bytes: u64) -> io::Result<()> {
        self.0.reserve(bytes)
    }

    /// Writes a whole file: whatever happens, the name holds the old content or the new.
    ///
    /// # Errors
    /// [`DiskError`] with the step that failed; the old content is untouched then.
    pub fn replace(&self, path: &Path, fill: impl FnOnce(&mut dyn Write) -> io::Result<()>) -> Result<(), DiskError> {
        let temporary = self.written_aside(path, fill)?;
        self.take_place(&temporary, path)
    }

    /// As [`Disk::replace`], if `check` has nothing against the file under its temporary name.
    ///
    /// # Errors
    /// As [`Disk::replace`]; inside, what `check` has against it. The old content is untouched either way.
    pub fn replace_checked<E>(
        &self,
        path: &Path,
        fill: impl FnOnce(&mut dyn Write) -> io::Result<()>,
        check: impl FnOnce(&Path) -> Result<(), E>,
    ) -> Result<Result<(), E>, DiskError> {
        let temporary = self.written_aside(path, fill)?;
        match check(&temporary) {
            Ok(()) => self.take_place(&temporary, path).map(Ok),
            Err(why) => {
                // Swept at the next start if it cannot be removed now.
                let _ = self.0.remove(&temporary);
                Ok(Err(why))
            }
        }
    }

    /// As [`Disk::replace`], and the content before stays under [`previous`], the older generation.
    ///
    /// # Errors
    /// As [`Disk::replace`].
    pub fn replace_keeping(
        &self,
        path: &Path,
        fill: impl FnOnce(&mut dyn Write) -> io::Result<()>,
    ) -> Result<(), DiskError> {
        let temporary = self.written_aside(path, fill)?;
        if path.is_file() {
            // A second name first, so that there is no moment without the first; where links are unknown (FAT) there is one.
            let (second, earlier) = (temporary_beside(path), previous(path));
            let linked = self.0.link(path, &second).and_then(|()| self.0.rename(&second, &earlier));
            // Of two names of one file (a power cut may have left them so) the first stays when it is renamed to the second.
            let _ = self.0.remove(&second);
            linked.or_else(|_| self.0.rename(path, &earlier)).map_err(while_doing("keeping the earlier one"))?;
        }
        self.take_place(&temporary, path)
    }

    /// Writes and syncs a temporary file beside `path`.
    fn written_aside(
        &self,
        path: &Path,
        fill: impl FnOnce(&mut dyn Write) -> io::Result<()>,
    ) -> Result<PathBuf, DiskError> {
        self.make_folders(folder_of(path)).map_err(while_doing("making its folder"))?;
        let temporary = temporary_beside(path);
        let mut file = self.0.create(&temporary).map_err(while_doing("writing"))?;
        let mut out = BufWriter::with_capacity(1 << 16, &mut file);
        let written = fill(&mut out).and_then(|()| out.flush()).map_err(while_doing("writing"));
        // Taken apart: dropping it would write what is left once more.
        drop(out.into_parts());
        match written.and_then(|()| file.sync().map_err(while_doing("syncing"))) {
            Ok(()) => Ok(temporary),
            Err(e) => {
                // What was in the way is what the error says; half a file would only take more room.
                let _ = self.0.remove(&temporary);
                Err(e)
            }
        }
    }

    fn take_place(&self, temporary: &Path, path: &Path) -> Result<(), DiskError> {
        if let Err(e) = self.0.rename(temporary, path) {
            let _ = self.0.remove(temporary);
            return Err(while_doing("renaming")(e));
        }
        // The rename itself is durable only once the folder is.
        self.0.sync_folder(folder_of(path)).map_err(while_doing("syncing"))
    }

    /// Makes a folder and those above it, each name durable in its parent.
    ///
    /// # Errors
    /// The system's.
    pub fn make_folders(&self, path: &Path) -> io::Result<()> {
        if path.is_dir() {
            return Ok(());
        }
        let parent = folder_of(path);
        self.make_folders(parent)?;
        match self.0.make_folder(path) {
            Err(e) if e.kind() == ErrorKind::AlreadyExists && path.is_dir() => Ok(()),
            other => other.and_then(|()| self.0.sync_folder(parent)),
        }
    }

    /// Opens a file of lines to write behind its end. A last line that a power cut tore is taken off first.
    ///
    /// # Errors
    /// The system's.
    pub fn append_lines(&self, path: &Path) -> io::Result<Lines> {
        let torn = match regular::open(path) {
            Ok(file) => file.metadata()?.len() - whole_lines(&file)?,
            Err(e) if e.kind() == ErrorKind::NotFound => {
                self.make_folders(folder_of(path))?;
                0
            }
            Err(e) => return Err(e),
        };
        let mut lines = Lines::new(self.0.append(path)?, torn);
        lines.take_off_what_is_torn()?;
        Ok(lines)
    }

    /// Removes a file; one that is not there is removed already.
    ///
    /// # Errors
    /// The system's.
    pub fn remove(&self, path: &Path) -> io::Result<()> {
        match self.0.remove(path) {
            Err(e) if e.kind() == ErrorKind::NotFound => Ok(()),
            other => other,
        }
    }

    /// Moves a file or a folder to another name, durably.
    ///
    /// # Errors
    /// The system's.
    pub fn rename(&self, from: &Path, to: &Path) -> io::Result<()> {
        self.0.rename(from, to)?;
        self.0.sync_folder(folder_of(to))?;
        if folder_of(from) == folder_of(to) { Ok(()) } else { self.0.sync_folder(folder_of(from)) }
    }

    /// Sets a damaged file aside, so that the next start does not trip over it; returns its new name
    /// (`model.damaged-1.dgtr`).
    ///
    /// # Errors
    /// The system's.
    pub fn set_aside(&self, path: &Path) -> io::Result<PathBuf> {
        let mut aside = (1..=MAX_DAMAGED).map(|n| tagged(path, &format!("damaged-{n}")));
        let aside = aside.clone().find(|p| !p.exists()).or_else(|| aside.next_back()).unwrap_or_else(|| path.into());
        self.rename(path, &aside)?;
        Ok(aside)
    }

    /// Reads the newest sound one of the two generations of `path` with `read`. What `read` refuses is set aside and named,
    /// and never keeps a job from starting.
    ///
    /// # Errors
    /// A damaged file could not be set aside.
    pub fn newest<T, E: fmt::Display>(
        &self,
        path: &Path,
        mut read: impl FnMut(&Path) -> Result<T, E>,
    ) -> io::Result<Newest<T>> {
        let mut newest = Newest { found: None, damaged: Vec::new() };
        for generation in [path.to_owned(), previous(path)] {
            if !generation.is_file() {
                continue;
            }
            match read(&generation) {
                Ok(content) => {
                    newest.found = Some(content);
                    break;
                }
                Err(e) => newest.damaged.push(Damaged { why: e.to_string(), aside: self.set_aside(&generation)? }),
            }
        }
        Ok(newest)
    }

    /// Removes the temporary files that a power cut or a kill left directly in `folder`, which nobody else may be writing
    /// to; returns how many. A folder that is not there holds none.
    pub fn sweep(&self, folder: &Path) -> usize {
        self.sweep_those(folder, |_| true)
    }

    /// As [`Disk::sweep`], where other processes write, too: only what those left that are no more.
    pub fn sweep_abandoned(&self, folder: &Path) -> usize {
        let processes = Path::new("/proc");
        let is_over = |maker: &str| maker.parse::<u32>().is_ok() && !processes.join(maker).exists();
        self.sweep_those(folder, |maker| processes.join("self").exists() && is_over(maker))
    }

    /// Removes the temporary files whose maker's process number `fits`.
    fn sweep_those(&self, folder: &Path, fits: impl Fn(&str) -> bool) -> usize {
        let Ok(entries) = std::fs::read_dir(folder) else { return 0 };
        let wanted = |entry: &std::fs::DirEntry| {
            let name = entry.file_name();
            let named = name.to_str().and_then(|n| n.strip_prefix(TEMPORARY));
            named.is_some_and(|n| fits(n.split('-').next().unwrap_or(n)))
                && entry.file_type().is_ok_and(|t| t.is_file())
        };
        entries.flatten().filter(wanted).filter(|e| self.0.remove(&e.path()).is_ok()).count()
    }
}

/// What [`Disk::newest`] found.
#[derive(Debug)]
pub struct Newest<T> {
    /// The newest content that could be read.
    pub found: Option<T>,
    /// The files that could not.
    pub damaged: Vec<Damaged>,
}

/// A damaged file, set aside.
#[derive(Clone, Debug, thiserror::Error)]
#[error("{why}; set aside as {}", aside.display())]
pub struct Damaged {
    /// What is wrong with it; names the file.
    pub why: String,
    /// Where it lies now.
    pub aside: PathBuf,
}

/// Where the generation before that of `path` is kept: `model.previous.dgtr`.
pub fn previous(path: &Path) -> PathBuf {
    tagged(path, "previous")
}

/// `model.dgtr` with `tag`: `model.tag.dgtr`.
fn tagged(path: &Path, tag: &str) -> PathBuf {
    let mut name = path.file_stem().unwrap_or_default().to_owned();
    name.push(format!(".{tag}"));
    if let Some(extension) = path.extension() {
        name.push(".");
        name.push(extension);
    }
    path.with_file_name(name)
}

/// A name that no other thread and no other process uses, and that nobody can guess to put a file or a link there first.
fn temporary_beside(path: &Path) -> PathBuf {
    static NEXT: AtomicU32 = AtomicU32::new(0);
    // The hasher's key is the system's random bytes.
    let unguessable = RandomState::new().hash_one(NEXT.fetch_add(1, Ordering::Relaxed));
    folder_of(path).join(format!("{TEMPORARY}{}-{unguessable:016x}", std::process::id()))
}

/// Bytes of the whole lines a file begins with. A hole that the file system left where lines should be ends them as well.
fn whole_lines(file: &File) -> io::Result<u64> {
    let (mut reader, mut at, mut whole) = (BufReader::new(file), 0, 0);
    loop {
        let bytes = reader.fill_buf()?;
        let hole = bytes.iter().position(|&b| b == 0);
        let sound = &bytes[..hole.unwrap_or(bytes.len())];
        if let Some(end) = sound.iter().rposition(|&b| b == b'\n') {
            whole = at + end as u64 + 1;
        }
        if hole.is_some() || bytes.is_empty() {
            return Ok(whole);
        }
        let read = bytes.len();
        at += read as u64;
        reader.consume(read);
    }
}

/// The folder a file lies in.
fn folder_of(path: &Path) -> &Path {
    path.parent().filter(|p| !p.as_os_str().is_empty()).unwrap_or(Path::new("."))
}

#[cfg(test)]
mod tests;
