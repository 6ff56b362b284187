//! Cuts the power, in tests, between any two operations on the disk: a [`Recorder`] writes down what a job does to a folder,
//! and [`states`] says what may be on the medium afterwards.
//!
//! The model of the disk is pessimistic where file systems differ (Pillai et al., *All File Systems Are Not Created Equal*,
//! OSDI 2014): content is there only once its file was synced, a name only once its folder was; until then any of the pending
//! names may be there without the others, and a file may be empty, torn, or as long as it should be and full of zeros.

use std::collections::HashMap;
use std::io::{self, Write};
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use disk::{Operations, Output, System};

pub mod states;

/// A file, whatever names it has.
pub type FileId = usize;

/// What was done.
#[derive(Clone, Debug, PartialEq)]
pub enum Done<P> {
    /// Names that changed in one step, each to a file, to a folder (`Some(None)`) or to nothing.
    Names(Vec<(PathBuf, Option<Option<FileId>>)>),
    /// Bytes written behind the end of a file.
    Wrote(FileId, Vec<u8>),
    /// So many bytes taken off the end of a file.
    TookOff(FileId, usize),
    /// A file's content was synced.
    Synced(FileId),
    /// A folder's names were synced.
    SyncedFolder(PathBuf),
    /// What the program believes to be durable from now on.
    Promised(P),
}

#[derive(Debug)]
struct Log<P> {
    done: Vec<Done<P>>,
    files: HashMap<PathBuf, FileId>,
    next: FileId,
    /// Syncing is forgotten, to see whether anybody notices.
    careless: bool,
}

/// The machine's file system, with everything that is done to it written down.
#[derive(Debug)]
pub struct Recorder<P>(Arc<Mutex<Log<P>>>);

impl<P> Clone for Recorder<P> {
    fn clone(&self) -> Self {
        Self(Arc::clone(&self.0))
    }
}

impl<P> Recorder<P> {
    /// With `careless`, syncs of files are not written down: as if the program had left them out.
    pub fn new(careless: bool) -> Self {
        Self(Arc::new(Mutex::new(Log { done: Vec::new(), files: HashMap::new(), next: 0, careless })))
    }

    fn log(&self) -> MutexGuard<'_, Log<P>> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Notes what the program believes to be durable.
    pub fn promise(&self, promise: P) {
        self.log().done.push(Done::Promised(promise));
    }

    /// All that was done so far.
    pub fn take(&self) -> Vec<Done<P>> {
        std::mem::take(&mut self.log().done)
    }

    fn name(&self, path: &Path) -> FileId {
        let mut log = self.log();
        let id = log.next;
        log.next += 1;
        log.files.insert(path.into(), id);
        log.done.push(Done::Names(vec![(path.into(), Some(Some(id)))]));
        id
    }
}

impl<P: std::fmt::Debug + Send + 'static> Operations for Recorder<P> {
    fn make_folder(&self, path: &Path) -> io::Result<()> {
        System.make_folder(path)?;
        self.log().done.push(Done::Names(vec![(path.into(), Some(None))]));
        Ok(())
    }

    fn create(&self, path: &Path) -> io::Result<Box<dyn Output>> {
        let inner = System.create(path)?;
        Ok(Box::new(Recorded { file: self.name(path), inner, to: self.clone() }))
    }

    fn append(&self, path: &Path) -> io::Result<Box<dyn Output>> {
        let inner = System.append(path)?;
        let known = self.log().files.get(path).copied();
        Ok(Box::new(Recorded { file: known.unwrap_or_else(|| self.name(path)), inner, to: self.clone() }))
    }

    fn link(&self, from: &Path, to: &Path) -> io::Result<()> {
        System.link(from, to)?;
        let mut log = self.log();
        let file = log.files[from];
        log.files.insert(to.into(), file);
        log.done.push(Done::Names(vec![(to.into(), Some(Some(file)))]));
        Ok(())
    }

    fn rename(&self, from: &Path, to: &Path) -> io::Result<()> {
        System.rename(from, to)?;
        let mut log = self.log();
        if let Some(file) = log.files.remove(from) {
            log.files.insert(to.into(), file);
            log.done.push(Done::Names(vec![(from.into(), None), (to.into(), Some(Some(file)))]));
        }
        Ok(())
    }

    fn remove(&self, path: &Path) -> io::Result<()> {
        System.remove(path)?;
        let mut log = self.log();
        log.files.remove(path);
        log.done.push(Done::Names(vec![(path.into(), None)]));
        Ok(())
    }

    fn sync_folder(&self, path: &Path) -> io::Result<()> {
        self.log().done.push(Done::SyncedFolder(path.into()));
        Ok(())
    }
}

#[derive(Debug)]
struct Recorded<P> {
    file: FileId,
    inner: Box<dyn Output>,
    to: Recorder<P>,
}

impl<P: std::fmt::Debug + Send> Write for Recorded<P> {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        let n = self.inner.write(bytes)?;
        self.to.log().done.push(Done::Wrote(self.file, bytes[..n].to_vec()));
        Ok(n)
    }

    fn flush(&mut self) -> io::Result<()> {
        self.inner.flush()
    }
}

impl<P: std::fmt::Debug + Send> Output for Recorded<P> {
    fn sync(&mut self) -> io::Result<()> {
        let mut log = self.to.log();
        if !log.careless {
            log.done.push(Done::Synced(self.file));
        }
        Ok(())
    }

    fn take_off(&mut self, bytes: u64) -> io::Result<()> {
        self.inner.take_off(bytes)?;
        self.to.log().done.push(Done::TookOff(self.file, bytes as usize));
        Ok(())
    }
}
