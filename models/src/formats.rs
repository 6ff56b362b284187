//! Files this project reads and writes. Everything that comes from outside is bounded before memory is taken
//! for it, and every error is one line: which file, what is wrong with it, how to mend it.

use std::fs::File;
use std::io::Read;
use std::path::{Path, PathBuf};

pub mod colmap;
pub mod model;
pub mod ply;
pub mod split;
pub mod spz;
pub mod telemetry;
pub mod transforms;

/// Why a file could not be read or written.
#[derive(Debug, thiserror::Error)]
pub enum FormatError {
    /// The operating system said no.
    #[error("{}: {action} failed: {source}; check the path, its permissions and the free space", path.display())]
    Io {
        /// The file.
        path: PathBuf,
        /// What was tried.
        action: &'static str,
        /// The operating system's word.
        source: std::io::Error,
    },
    /// More bytes, or more items, than the format's bound.
    #[error("{}: {what} is {size}, at most {limit} can be taken; is it the right file?", path.display())]
    TooLarge {
        /// The file.
        path: PathBuf,
        /// What is too large.
        what: &'static str,
        /// What the file says.
        size: u64,
        /// The bound.
        limit: u64,
    },
    /// The file ends too early.
    #[error("{}: ends at byte {at} in the middle of {what}; copy or write it again", path.display())]
    Truncated {
        /// The file.
        path: PathBuf,
        /// Where it ends.
        at: u64,
        /// What was being read.
        what: &'static str,
    },
    /// The content hash does not fit the content.
    #[error("{}: its content does not match its checksum (damaged in storage or transfer); copy it again", path.display())]
    Damaged {
        /// The file.
        path: PathBuf,
    },
    /// The content makes no sense.
    #[error("{}: {what}", path.display())]
    Invalid {
        /// The file.
        path: PathBuf,
        /// What, where and how to mend.
        what: String,
    },
}

impl FormatError {
    pub(crate) fn invalid(path: &Path, what: impl Into<String>) -> Self {
        Self::Invalid { path: path.to_owned(), what: what.into() }
    }

    pub(crate) fn io(path: &Path, action: &'static str, source: std::io::Error) -> Self {
        Self::Io { path: path.to_owned(), action, source }
    }

    /// The file the error is about.
    pub fn path(&self) -> &Path {
        match self {
            Self::Io { path, .. }
            | Self::TooLarge { path, .. }
            | Self::Truncated { path, .. }
            | Self::Damaged { path }
            | Self::Invalid { path, .. } => path,
        }
    }
}

/// The whole of a file of at most `limit` bytes. The bound holds also for files that grow while being read and
/// for pipes, whose length is not known beforehand.
pub fn read_bounded(path: &Path, limit: u64) -> Result<Vec<u8>, FormatError> {
    let file = File::open(path).map_err(|e| FormatError::io(path, "opening", e))?;
    let size = file.metadata().map_err(|e| FormatError::io(path, "reading", e))?.len();
    let too_large = |size| FormatError::TooLarge { path: path.to_owned(), what: "its size in bytes", size, limit };
    if size > limit {
        return Err(too_large(size));
    }
    let mut bytes = Vec::with_capacity(size as usize);
    file.take(limit + 1).read_to_end(&mut bytes).map_err(|e| FormatError::io(path, "reading", e))?;
    if bytes.len() as u64 > limit {
        return Err(too_large(bytes.len() as u64));
    }
    Ok(bytes)
}

/// Writes a file so that a reader, a full disc or a power cut never sees half of it: to a temporary name in the
/// same folder, synced, renamed, and the folder synced.
pub fn write_atomic(
    path: &Path,
    fill: impl FnOnce(&mut std::io::BufWriter<&mut File>) -> std::io::Result<()>,
) -> Result<(), FormatError> {
    let err = |action| move |e| FormatError::io(path, action, e);
    let folder = match path.parent() {
        Some(p) if !p.as_os_str().is_empty() => p,
        _ => Path::new("."),
    };
    std::fs::create_dir_all(folder).map_err(err("making its folder"))?;
    let mut temporary = tempfile::Builder::new().prefix(".dgtr-").tempfile_in(folder).map_err(err("writing"))?;
    {
        let mut out = std::io::BufWriter::with_capacity(1 << 16, temporary.as_file_mut());
        fill(&mut out).map_err(err("writing"))?;
        std::io::Write::flush(&mut out).map_err(err("writing"))?;
    }
    temporary.as_file().sync_all().map_err(err("syncing"))?;
    set_readable(temporary.as_file()).map_err(err("writing"))?;
    temporary.persist(path).map_err(|e| FormatError::io(path, "renaming", e.error))?;
    // The rename itself is durable only once the folder is.
    File::open(folder).and_then(|f| f.sync_all()).map_err(err("syncing"))
}

/// Temporary files are made private; results are for everybody, as any file written by name.
fn set_readable(file: &File) -> std::io::Result<()> {
    #[cfg(unix)]
    {
        use std::os::unix::fs::PermissionsExt;
        file.set_permissions(std::fs::Permissions::from_mode(0o644))?;
    }
    #[cfg(not(unix))]
    let _ = file;
    Ok(())
}

/// A cursor over a file's bytes that knows the file's name and never reads past its end.
pub(crate) struct Bytes<'a> {
    path: &'a Path,
    all: &'a [u8],
    at: usize,
}

impl<'a> Bytes<'a> {
    pub(crate) fn new(path: &'a Path, all: &'a [u8]) -> Self {
        Self { path, all, at: 0 }
    }

    pub(crate) fn take(&mut self, n: usize, what: &'static str) -> Result<&'a [u8], FormatError> {
        match self.at.checked_add(n).and_then(|end| self.all.get(self.at..end)) {
            Some(bytes) => {
                self.at += n;
                Ok(bytes)
            }
            None => Err(FormatError::Truncated { path: self.path.to_owned(), at: self.all.len() as u64, what }),
        }
    }

    fn array<const N: usize>(&mut self, what: &'static str) -> Result<[u8; N], FormatError> {
        let mut out = [0; N];
        out.copy_from_slice(self.take(N, what)?);
        Ok(out)
    }

    pub(crate) fn u8(&mut self, what: &'static str) -> Result<u8, FormatError> {
        Ok(self.array::<1>(what)?[0])
    }

    pub(crate) fn u32(&mut self, what: &'static str) -> Result<u32, FormatError> {
        Ok(u32::from_le_bytes(self.array(what)?))
    }

    pub(crate) fn u64(&mut self, what: &'static str) -> Result<u64, FormatError> {
        Ok(u64::from_le_bytes(self.array(what)?))
    }

    pub(crate) fn f64(&mut self, what: &'static str) -> Result<f64, FormatError> {
        Ok(f64::from_le_bytes(self.array(what)?))
    }

    /// A count of items of at least `each` bytes: never more than the rest of the file can hold.
    pub(crate) fn count(&mut self, each: usize, what: &'static str) -> Result<usize, FormatError> {
        let size = self.u64(what)?;
        let limit = ((self.all.len() - self.at) / each) as u64;
        if size > limit {
            return Err(FormatError::TooLarge { path: self.path.to_owned(), what, size, limit });
        }
        Ok(size as usize)
    }

    /// Up to the next zero byte.
    pub(crate) fn c_str(&mut self, what: &'static str) -> Result<&'a str, FormatError> {
        let rest = &self.all[self.at..];
        let Some(n) = rest.iter().position(|&b| b == 0) else {
            return Err(FormatError::Truncated { path: self.path.to_owned(), at: self.all.len() as u64, what });
        };
        self.at += n + 1;
        std::str::from_utf8(&rest[..n]).map_err(|_| FormatError::invalid(self.path, format!("{what} is not UTF-8")))
    }
}
