//! Trouble of the disk that holds what was received: which file, and what the system said.

use std::path::Path;

use config::error::{Error, ErrorKind};

/// A file or folder could not be read or written.
#[derive(Debug, thiserror::Error)]
#[error("{path}: {}", disk::told(source))]
pub struct DiskError {
    /// The file or folder.
    path: String,
    /// The system's word on it.
    source: std::io::Error,
}

impl Error for DiskError {
    fn kind(&self) -> ErrorKind {
        Error::kind(&self.source)
    }
}

/// Names `path` in an error of the system.
pub(crate) fn io(path: &Path) -> impl FnOnce(std::io::Error) -> DiskError + '_ {
    move |source| DiskError { path: path.display().to_string(), source }
}
