//! A folder that all workers reach: a disk, NFS.

use std::fs::DirEntry;
use std::io::{self, ErrorKind, Read, Seek, SeekFrom};
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicU32, Ordering};
use std::time::{Duration, SystemTime};

use disk::Disk;
use rustix::rand::{GetRandomFlags, getrandom};

use super::{Fill, StoreError};

/// Where files are written before they get their names.
const WRITING: &str = "writing";
/// What lies there for so long was left by a worker that is no more.
pub const ABANDONED: Duration = Duration::from_secs(24 * 3600);

pub struct Folder {
    disk: Disk,
    path: PathBuf,
    /// This handle's own: processes of two machines may have the same number.
    aside: PathBuf,
    next: AtomicU32,
}

impl Folder {
    pub fn new(path: &Path) -> Self {
        let aside = path.join(WRITING).join(format!("{:016x}", own_number()));
        Self { disk: Disk::default(), path: path.into(), aside, next: AtomicU32::new(0) }
    }

    pub fn path(&self) -> &Path {
        &self.path
    }

    fn failed(&self, name: &str, action: &'static str, source: io::Error) -> StoreError {
        StoreError::Disk { name: self.path.join(name).display().to_string(), action, source }
    }

    pub fn size(&self, name: &str) -> Result<Option<u64>, StoreError> {
        match std::fs::metadata(self.path.join(name)) {
            Ok(file) => Ok(Some(file.len())),
            Err(e) if e.kind() == ErrorKind::NotFound => Ok(None),
            Err(e) => Err(self.failed(name, "reading", e)),
        }
    }

    pub fn range(&self, name: &str, from: u64, bytes: u64) -> Result<Vec<u8>, StoreError> {
        let read = || {
            let mut file = disk::regular::open(&self.path.join(name))?;
            file.seek(SeekFrom::Start(from))?;
            let mut buffer = Vec::new();
            file.take(bytes).read_to_end(&mut buffer)?;
            io::Result::Ok(buffer)
        };
        let display = || self.path.join(name).display().to_string();
        match read() {
            Ok(found) if found.len() as u64 == bytes => Ok(found),
            Ok(_) => Err(StoreError::Damaged { name: display(), what: "it ends too early" }),
            Err(e) if e.kind() == ErrorKind::NotFound => Err(StoreError::Missing(display())),
            Err(e) => Err(self.failed(name, "reading", e)),
        }
    }

    pub fn put(&self, name: &str, fill: Fill<'_>) -> Result<(), StoreError> {
        let n = self.next.fetch_add(1, Ordering::Relaxed);
        let (aside, to) = (self.aside.join(n.to_string()), self.path.join(name));
        self.disk.replace(&aside, fill).map_err(|e| self.failed(name, e.action, e.source))?;
        let folder = to.parent().unwrap_or(&self.path);
        let placed = self.disk.make_folders(folder).and_then(|()| self.disk.rename(&aside, &to));
        placed.map_err(|e| self.failed(name, "renaming", e))
    }

    pub fn remove(&self, name: &str) -> Result<(), StoreError> {
        self.disk.remove(&self.path.join(name)).map_err(|e| self.failed(name, "removing", e))
    }

    /// What lies in a folder of it. Nothing behind a link: whoever reaches the store would choose what is removed elsewhere.
    fn within(&self, folder: &str) -> impl Iterator<Item = DirEntry> + use<> {
        let path = self.path.join(folder);
        let is_its_own = std::fs::symlink_metadata(&path).is_ok_and(|m| m.is_dir());
        is_its_own.then(|| std::fs::read_dir(path).ok()).flatten().into_iter().flatten().flatten()
    }

    /// Removes what is named by a hash in a folder of it and `is_kept` does not hold of. Only for a folder that nobody else works in.
    pub fn keep_only(&self, folder: &str, is_kept: &dyn Fn(&str) -> bool) {
        for entry in self.within(folder) {
            if entry.file_name().to_str().is_some_and(|name| is_digits(name, 64) && !is_kept(name)) {
                // Left over it costs room, nothing else.
                let _ = self.disk.remove(&entry.path());
            }
        }
    }

    /// Removes what was left half written so long ago.
    pub fn sweep(&self, left: Duration) {
        let is_old = |at: SystemTime| at.elapsed().is_ok_and(|age| age >= left);
        for entry in self.within(WRITING) {
            let changed = entry.metadata().and_then(|m| m.modified());
            let is_a_workers = entry.file_name().to_str().is_some_and(|name| is_digits(name, 16));
            if is_a_workers && entry.path() != self.aside && changed.is_ok_and(is_old) {
                let _ = std::fs::remove_dir_all(entry.path());
            }
        }
    }
}

impl Drop for Folder {
    fn drop(&mut self) {
        // Only when it is empty; the one above it may be wanted by others this very moment.
        let _ = std::fs::remove_dir(&self.aside);
    }
}

/// Whether a name has so many hexadecimal digits and nothing else: 16 that of a worker's folder, 64 what is named by a hash.
fn is_digits(name: &str, count: usize) -> bool {
    name.len() == count && name.bytes().all(|b| b.is_ascii_hexdigit())
}

/// A number that no other worker has.
fn own_number() -> u64 {
    let mut bytes = [0; 8];
    match getrandom(&mut bytes[..], GetRandomFlags::empty()) {
        Ok(n) if n == bytes.len() => u64::from_le_bytes(bytes),
        // Without it two machines may meet under one name; this process's number is what there is.
        _ => u64::from(std::process::id()),
    }
}
