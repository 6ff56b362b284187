//! Where the plan of a merge, the models' bytes and the cells lie: a folder that all workers reach, or a bucket.
//!
//! Names say what the content is made of, so that whoever writes a name writes the same bytes, and nothing is ever half there.

use std::io::{self, Write};
use std::path::Path;

use config::error::{Error, ErrorKind};

mod folder;
#[cfg(feature = "s3")]
mod s3;

/// What begins the place of a bucket.
const BUCKET: &str = "s3://";

/// Why something could not be kept or had back.
#[derive(Debug, thiserror::Error)]
pub enum StoreError {
    /// The operating system said no.
    #[error("{name}: {action} failed: {}", disk::told(source))]
    Disk {
        /// The file.
        name: String,
        /// What was tried.
        action: &'static str,
        /// The system's word.
        source: io::Error,
    },
    /// No place that can be understood.
    #[error("--store {place}: {why}")]
    Place {
        /// As it was given.
        place: String,
        /// What is wrong with it and how to mend it.
        why: String,
    },
    /// The object store, or the way to it.
    #[error("{name}: {action} failed: {why}; check AWS_ENDPOINT_URL, the bucket and the rights on it")]
    Request {
        /// The object.
        name: String,
        /// What was tried.
        action: &'static str,
        /// What came back.
        why: String,
    },
    /// Something is there, but not as it was written.
    #[error("{name}: {what} (damaged?); remove it, and the same command makes it anew")]
    Damaged {
        /// The file or object.
        name: String,
        /// What is wrong with it.
        what: &'static str,
    },
    /// Something that should be there is not.
    #[error("{0}: is not there; run `dgtr ground plan` with the same models first")]
    Missing(String),
}

impl Error for StoreError {
    fn kind(&self) -> ErrorKind {
        match self {
            Self::Disk { source, .. } => Error::kind(source),
            Self::Place { .. } | Self::Missing(_) => ErrorKind::Input,
            Self::Request { .. } | Self::Damaged { .. } => ErrorKind::Failed,
        }
    }
}

/// What fills an object; asked once, or again when it has to be sent again.
pub type Fill<'a> = &'a dyn Fn(&mut dyn Write) -> io::Result<()>;

/// Such a place.
pub enum Store {
    /// A folder.
    Folder(folder::Folder),
    /// A bucket of an object store that speaks S3.
    #[cfg(feature = "s3")]
    Bucket(Box<s3::Bucket>),
}

impl Store {
    /// The place that `--store` names: a folder, or `s3://BUCKET/PREFIX`.
    ///
    /// # Errors
    /// [`StoreError::Place`].
    pub fn open(place: &str) -> Result<Self, StoreError> {
        match place.strip_prefix(BUCKET) {
            None => Ok(Self::folder(Path::new(place))),
            #[cfg(feature = "s3")]
            Some(bucket) => s3::Bucket::open(place, bucket).map(|b| Self::Bucket(Box::new(b))),
            #[cfg(not(feature = "s3"))]
            Some(_) => {
                let why = "this dgtr is built without the feature s3; give a folder".into();
                Err(StoreError::Place { place: place.into(), why })
            }
        }
    }

    /// A folder, which is made when there is something to put into it.
    pub fn folder(path: &Path) -> Self {
        Self::Folder(folder::Folder::new(path))
    }

    /// The folder, where it is one.
    pub fn path(&self) -> Option<&Path> {
        match self {
            Self::Folder(folder) => Some(folder.path()),
            #[cfg(feature = "s3")]
            Self::Bucket(_) => None,
        }
    }

    /// Removes what killed workers left half written, a day ago or earlier.
    pub fn sweep(&self) {
        match self {
            Self::Folder(folder) => folder.sweep(folder::ABANDONED),
            // What is not whole is not there.
            #[cfg(feature = "s3")]
            Self::Bucket(_) => {}
        }
    }

    /// Leaves in its folder `within` only what `is_kept` holds for. Nobody else may be working there; a bucket, which others do, is left
    /// as it is.
    pub fn keep_only(&self, within: &str, is_kept: &dyn Fn(&str) -> bool) {
        match self {
            Self::Folder(folder) => {
                folder.keep_only(within, is_kept);
                folder.sweep(std::time::Duration::ZERO);
            }
            #[cfg(feature = "s3")]
            Self::Bucket(_) => {}
        }
    }

    /// Bytes of what lies under a name; None: nothing.
    ///
    /// # Errors
    /// The system's or the object store's.
    pub fn size(&self, name: &str) -> Result<Option<u64>, StoreError> {
        match self {
            Self::Folder(folder) => folder.size(name),
            #[cfg(feature = "s3")]
            Self::Bucket(bucket) => bucket.size(name),
        }
    }

    /// `bytes` bytes of it, which the caller has bounded, from byte `from` on.
    ///
    /// # Errors
    /// It is not there or ends before them; the system's or the object store's.
    pub fn range(&self, name: &str, from: u64, bytes: u64) -> Result<Vec<u8>, StoreError> {
        if bytes == 0 {
            return Ok(Vec::new());
        }
        match self {
            Self::Folder(folder) => folder.range(name, from, bytes),
            #[cfg(feature = "s3")]
            Self::Bucket(bucket) => bucket.range(name, from, bytes),
        }
    }

    /// Puts something there, whole or not at all; what was there is replaced.
    ///
    /// # Errors
    /// The system's or the object store's.
    pub fn put(&self, name: &str, fill: Fill<'_>) -> Result<(), StoreError> {
        match self {
            Self::Folder(folder) => folder.put(name, fill),
            #[cfg(feature = "s3")]
            Self::Bucket(bucket) => bucket.put(name, fill),
        }
    }

    /// Removes something; what is not there is removed already.
    ///
    /// # Errors
    /// The system's or the object store's.
    pub fn remove(&self, name: &str) -> Result<(), StoreError> {
        match self {
            Self::Folder(folder) => folder.remove(name),
            #[cfg(feature = "s3")]
            Self::Bucket(bucket) => bucket.remove(name),
        }
    }
}

#[cfg(test)]
mod tests;
