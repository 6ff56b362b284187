//! Why a data set cannot be used.

use std::path::PathBuf;

use config::error::{Error, ErrorKind};

use crate::card::CardError;
use models::formats::FormatError;
use models::picture::PictureError;

/// Why a data set cannot be used.
#[derive(Debug, thiserror::Error)]
pub enum DatasetError {
    /// One of its files is missing or wrong.
    #[error(transparent)]
    Format(#[from] FormatError),
    /// Not a data set at all.
    #[error("{}: neither transforms.json, nor a COLMAP model (sparse/0, sparse, colmap/sparse/0, .), nor opensfm/reconstruction.json, nor a JPEG, PNG or TIFF picture is there; give the folder that holds one of them", .0.display())]
    NotADataset(PathBuf),
    /// A picture is missing, unreadable or not what its description says.
    #[error(transparent)]
    Picture(#[from] PictureError),
    /// Pictures without a reconstruction that are no card either.
    #[error(transparent)]
    Card(#[from] CardError),
    /// A split, region or picture of this name does not exist.
    #[error("{}: no {kind} named {name:?}; there are: {known}", root.display())]
    Unknown {
        /// The data set.
        root: PathBuf,
        /// `split`, `region` or `picture`.
        kind: &'static str,
        /// What was asked for.
        name: String,
        /// What exists.
        known: String,
    },
    /// The caller asked for something impossible.
    #[error("{0}")]
    Request(String),
}

impl Error for DatasetError {
    fn kind(&self) -> ErrorKind {
        match self {
            Self::Format(e) => e.kind(),
            Self::Card(e) => e.kind(),
            _ => ErrorKind::Input,
        }
    }
}
