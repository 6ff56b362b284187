//! Why something cannot be measured.

use config::error::{Error, ErrorKind};
use models::formats::FormatError;

/// Why something cannot be measured.
#[derive(Debug, thiserror::Error)]
pub enum MeasureError {
    /// A file.
    #[error(transparent)]
    File(#[from] FormatError),
    /// What was asked for.
    #[error("{0}")]
    Request(String),
}

impl Error for MeasureError {
    fn kind(&self) -> ErrorKind {
        match self {
            Self::File(e) => e.kind(),
            Self::Request(_) => ErrorKind::Input,
        }
    }
}
