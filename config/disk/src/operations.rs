//! What a file system is asked to do, and the machine's own.

use std::fmt;
use std::fs::File;
use std::io::{self, Seek, SeekFrom, Write};
use std::path::Path;

use crate::regular;

/// What a file system is asked to do. Reading is done directly: it changes nothing.
pub trait Operations: fmt::Debug + Send + Sync {
    /// Makes one folder, whose parent is there.
    ///
    /// # Errors
    /// The system's.
    fn make_folder(&self, path: &Path) -> io::Result<()>;
    /// Opens a new, empty file for writing; what has that name already, a link too, is an error.
    ///
    /// # Errors
    /// The system's.
    fn create(&self, path: &Path) -> io::Result<Box<dyn Output>>;
    /// Opens a file for writing behind its end, made if absent.
    ///
    /// # Errors
    /// The system's.
    fn append(&self, path: &Path) -> io::Result<Box<dyn Output>>;
    /// Gives a file a second name.
    ///
    /// # Errors
    /// The system's; FAT has no links.
    fn link(&self, from: &Path, to: &Path) -> io::Result<()>;
    /// Moves a file or folder within the file system, in place of a file of the new name.
    ///
    /// # Errors
    /// The system's.
    fn rename(&self, from: &Path, to: &Path) -> io::Result<()>;
    /// Removes a file.
    ///
    /// # Errors
    /// The system's.
    fn remove(&self, path: &Path) -> io::Result<()>;
    /// Makes the names in a folder durable.
    ///
    /// # Errors
    /// The system's.
    fn sync_folder(&self, path: &Path) -> io::Result<()>;
    /// Takes so many bytes of a bound for a file that is not written through these operations.
    ///
    /// # Errors
    /// There is a bound and it does not leave them.
    fn reserve(&self, _bytes: u64) -> io::Result<()> {
        Ok(())
    }
}

/// A file being written.
pub trait Output: Write + fmt::Debug + Send {
    /// Makes the content durable.
    ///
    /// # Errors
    /// The system's: the disk may report only here that it is full or broken.
    fn sync(&mut self) -> io::Result<()>;
    /// Takes the last bytes off again.
    ///
    /// # Errors
    /// The system's.
    fn take_off(&mut self, bytes: u64) -> io::Result<()>;
}

impl Output for File {
    fn sync(&mut self) -> io::Result<()> {
        self.sync_all()
    }

    fn take_off(&mut self, bytes: u64) -> io::Result<()> {
        let length = self.metadata()?.len().saturating_sub(bytes);
        self.set_len(length)?;
        // One that is not opened to append would leave a hole.
        self.seek(SeekFrom::Start(length)).map(drop)
    }
}

/// The machine's own file system.
#[derive(Clone, Copy, Debug)]
pub struct System;

impl Operations for System {
    fn make_folder(&self, path: &Path) -> io::Result<()> {
        std::fs::create_dir(path)
    }

    fn create(&self, path: &Path) -> io::Result<Box<dyn Output>> {
        Ok(Box::new(File::create_new(path)?))
    }

    fn append(&self, path: &Path) -> io::Result<Box<dyn Output>> {
        Ok(Box::new(regular::append(path)?))
    }

    fn link(&self, from: &Path, to: &Path) -> io::Result<()> {
        std::fs::hard_link(from, to)
    }

    fn rename(&self, from: &Path, to: &Path) -> io::Result<()> {
        std::fs::rename(from, to)
    }

    fn remove(&self, path: &Path) -> io::Result<()> {
        std::fs::remove_file(path)
    }

    fn sync_folder(&self, path: &Path) -> io::Result<()> {
        File::open(path)?.sync_all()
    }
}
