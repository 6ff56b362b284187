//! A folder that one process at a time writes to.

use std::fs::File;
use std::io;
use std::path::Path;

use rustix::fs::{FlockOperation, flock};
use rustix::io::Errno;

/// The right to write to a folder. It ends when this is dropped, and with the process at the latest.
///
/// The folder itself is locked (`flock(2)`): no file is left, and the kernel unlocks it however the process ends.
#[derive(Debug)]
pub struct FolderLock {
    folder: File,
    held: bool,
}

impl FolderLock {
    /// Takes `folder`; `None` where another process, or another lock of this one, has it.
    /// A file system without locks gives a lock that is not [`held`](Self::held).
    ///
    /// # Errors
    /// The folder cannot be opened.
    pub fn take(folder: &Path) -> io::Result<Option<Self>> {
        let folder = File::open(folder)?;
        match flock(&folder, FlockOperation::NonBlockingLockExclusive) {
            Ok(()) => Ok(Some(Self { folder, held: true })),
            Err(Errno::WOULDBLOCK) => Ok(None),
            Err(_) => Ok(Some(Self { folder, held: false })),
        }
    }

    /// Whether the file system keeps others out; some network file systems have no locks.
    pub fn held(&self) -> bool {
        self.held
    }
}

impl Drop for FolderLock {
    fn drop(&mut self) {
        // Closing alone is not enough: a program that is being started holds a copy of every open file until its `exec`.
        if self.held {
            let _ = flock(&self.folder, FlockOperation::Unlock);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_dropped_lock_is_free_although_a_copy_of_the_file_is_still_open() {
        let dir = tempfile::tempdir().expect("folder");
        let first = FolderLock::take(dir.path()).expect("opened").expect("free");
        assert!(first.held() && FolderLock::take(dir.path()).expect("opened").is_none());
        let copy = first.folder.try_clone().expect("copied");
        drop(first);
        assert!(FolderLock::take(dir.path()).expect("opened").is_some());
        drop(copy);
    }
}
