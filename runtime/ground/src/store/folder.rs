//! A folder that all workers reach: a disk, NFS.

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

    /// Removes what `is_kept` does not hold of a folder of it. Only for a folder that nobody else works in.
    pub fn keep_only(&self, folder: &str, is_kept: &dyn Fn(&str) -> bool) {
        let Ok(entries) = std::fs::read_dir(self.path.join(folder)) else { return };
        for entry in entries.flatten() {
            if !entry.file_name().to_str().is_some_and(is_kept) {
                // Left over it costs room, nothing else.
                let _ = self.disk.remove(&entry.path());
            }
        }
    }

    /// Removes what was left half written so long ago.
    pub fn sweep(&self, left: Duration) {
        let Ok(entries) = std::fs::read_dir(self.path.join(WRITING)) else { return };
        let is_old = |at: SystemTime| at.elapsed().is_ok_and(|age| age >= left);
        for entry in entries.flatten() {
            let changed = entry.metadata().and_then(|m| m.modified());
            if entry.path() != self.aside && changed.is_ok_and(is_old) {
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

/// A number that no other worker has.
fn own_number() -> u64 {
    let mut bytes = [0; 8];
    match getrandom(&mut bytes[..], GetRandomFlags::empty()) {
        Ok(n) if n == bytes.len() => u64::from_le_bytes(bytes),
        // Without it two machines may meet under one name; this process's number is what there is.
        _ => u64::from(std::process::id()),
    }
}
