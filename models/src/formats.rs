//! Files this project reads and writes. Everything that comes from outside is bounded before memory is taken
//! for it, and every error is one line: which file, what is wrong with it, how to mend it.

use std::io::{Read, Write};
use std::path::{Path, PathBuf};

use config::error::{Error, ErrorKind};
use disk::{Disk, DiskError};

pub mod colmap;
pub mod delivery;
pub mod flight_plan;
pub mod gltf;
pub mod mega_nerf;
pub mod model;
pub mod opensfm;
pub mod ply;
pub mod reconstruction;
pub mod sog;
pub mod split;
pub mod spz;
mod stream;
pub mod telemetry;
pub mod torch;
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

impl Error for FormatError {
    fn kind(&self) -> ErrorKind {
        match self {
            Self::Io { source, .. } => Error::kind(source),
            _ => ErrorKind::Input,
        }
    }
}

impl FormatError {
    /// Content of `path` that makes no sense: what, where and how to mend.
    pub fn invalid(path: &Path, what: impl Into<String>) -> Self {
        Self::Invalid { path: path.to_owned(), what: what.into() }
    }

    /// What the operating system said to `action` on `path`.
    pub fn io(path: &Path, action: &'static str, source: std::io::Error) -> Self {
        Self::Io { path: path.to_owned(), action, source }
    }

    /// A durable write that failed.
    pub fn disk(path: &Path, e: DiskError) -> Self {
        Self::io(path, e.action, e.source)
    }

    /// Whether it is the disk's fault and room or a medium that comes back may mend it.
    pub fn may_pass(&self) -> bool {
        matches!(self, Self::Io { source, .. } if disk::may_pass(source))
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
///
/// # Errors
/// [`FormatError::TooLarge`], else the operating system's.
pub fn read_bounded(path: &Path, limit: u64) -> Result<Vec<u8>, FormatError> {
    let file = disk::regular::open(path).map_err(|e| FormatError::io(path, "opening", e))?;
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

/// What another library says, on one line: decoders' and ONNX Runtime's messages span several.
pub fn one_line(error: impl std::fmt::Display) -> String {
    error.to_string().split_whitespace().collect::<Vec<_>>().join(" ")
}

/// Writes a file whole or not at all, see [`Disk::replace`].
///
/// # Errors
/// [`FormatError::Io`] with the step that failed; what the file held before stays.
pub fn write_atomic(path: &Path, fill: impl FnOnce(&mut dyn Write) -> std::io::Result<()>) -> Result<(), FormatError> {
    Disk::default().replace(path, fill).map_err(|e| FormatError::disk(path, e))
}
