//! Why a folder is no card.

use std::path::PathBuf;

use config::error::{Error, ErrorKind};

use models::formats::FormatError;

/// Why a folder is no card.
#[derive(Debug, thiserror::Error)]
pub enum CardError {
    /// A file of positions is bad.
    #[error(transparent)]
    Format(#[from] FormatError),
    /// The folder cannot be read.
    #[error("{}: cannot be read: {source}; is the card mounted, and may you read it?", path.display())]
    Folder {
        /// The folder.
        path: PathBuf,
        /// The operating system's word.
        source: std::io::Error,
    },
    /// No picture is of the band that was asked for.
    #[error("{}: has no pictures of a band called {wanted:?}; there are: {known}", path.display())]
    NoBand {
        /// The first folder.
        path: PathBuf,
        /// The band.
        wanted: String,
        /// Bands with their number of pictures.
        known: String,
    },
    /// Nothing to use.
    #[error("{}: no picture in it can be used ({why}); give a folder that holds JPEG, PNG, TIFF or WebP files", path.display())]
    NoPictures {
        /// The first folder.
        path: PathBuf,
        /// What was found instead.
        why: String,
    },
}

impl Error for CardError {
    fn kind(&self) -> ErrorKind {
        match self {
            Self::Format(e) => e.kind(),
            _ => ErrorKind::Input,
        }
    }
}
