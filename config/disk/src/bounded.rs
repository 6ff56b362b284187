//! A bound on what a folder may take of the disk: the same errors as a full disk, before it is full.

use std::io::{self, ErrorKind, Write};
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};

use super::{Operations, Output};

/// Lets `inner` write until the files below a folder take so many bytes.
///
/// They are counted anew for every file that is opened, so that room which anybody makes counts at once.
#[derive(Debug)]
pub struct Bounded<T> {
    inner: T,
    root: PathBuf,
    limit: Arc<AtomicU64>,
}

impl<T: Operations> Bounded<T> {
    /// At most `limit` bytes below `root`; the limit may be changed at any time.
    pub fn new(inner: T, root: &Path, limit: Arc<AtomicU64>) -> Self {
        Self { inner, root: root.into(), limit }
    }

    fn bounded(&self, path: &Path, inner: Box<dyn Output>) -> Box<dyn Output> {
        if !path.starts_with(&self.root) {
            return inner;
        }
        let room = self.limit.load(Ordering::Relaxed).saturating_sub(bytes_below(&self.root));
        Box::new(BoundedOutput { inner, room })
    }
}

impl<T: Operations> Operations for Bounded<T> {
    fn make_folder(&self, path: &Path) -> io::Result<()> {
        self.inner.make_folder(path)
    }

    fn create(&self, path: &Path) -> io::Result<Box<dyn Output>> {
        Ok(self.bounded(path, self.inner.create(path)?))
    }

    fn append(&self, path: &Path) -> io::Result<Box<dyn Output>> {
        Ok(self.bounded(path, self.inner.append(path)?))
    }

    fn link(&self, from: &Path, to: &Path) -> io::Result<()> {
        self.inner.link(from, to)
    }

    fn rename(&self, from: &Path, to: &Path) -> io::Result<()> {
        self.inner.rename(from, to)
    }

    fn remove(&self, path: &Path) -> io::Result<()> {
        self.inner.remove(path)
    }

    fn sync_folder(&self, path: &Path) -> io::Result<()> {
        self.inner.sync_folder(path)
    }

    fn reserve(&self, bytes: u64) -> io::Result<()> {
        let used = bytes_below(&self.root);
        let rest = |limit: u64| limit.checked_sub(bytes).filter(|rest| *rest >= used);
        let taken = self.limit.fetch_update(Ordering::Relaxed, Ordering::Relaxed, rest);
        taken.map(drop).map_err(|_| ErrorKind::QuotaExceeded.into())
    }
}

#[derive(Debug)]
struct BoundedOutput {
    inner: Box<dyn Output>,
    room: u64,
}

impl Write for BoundedOutput {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        let n = bytes.len().min(usize::try_from(self.room).unwrap_or(usize::MAX));
        if n == 0 && !bytes.is_empty() {
            return Err(ErrorKind::QuotaExceeded.into());
        }
        let n = self.inner.write(&bytes[..n])?;
        self.room -= n as u64;
        Ok(n)
    }

    fn flush(&mut self) -> io::Result<()> {
        self.inner.flush()
    }
}

impl Output for BoundedOutput {
    fn sync(&mut self) -> io::Result<()> {
        self.inner.sync()
    }

    fn take_off(&mut self, bytes: u64) -> io::Result<()> {
        self.inner.take_off(bytes)?;
        self.room += bytes;
        Ok(())
    }
}

/// Bytes of all files below `folder`; what cannot be read counts nothing. Links are not followed.
pub fn bytes_below(folder: &Path) -> u64 {
    let entries = std::fs::read_dir(folder).into_iter().flatten().flatten();
    let bytes = entries.map(|e| match e.metadata() {
        Ok(m) if m.is_dir() => bytes_below(&e.path()),
        Ok(m) if m.is_file() => m.len(),
        _ => 0,
    });
    bytes.sum()
}
