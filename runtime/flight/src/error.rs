//! Why a flight's job stopped.

use std::path::{Path, PathBuf};

use config::error::{Error, ErrorKind};
use engine::error::EngineError;
use hal::error::HalError;
use uplink::UploadError;

use crate::keyframe_store::StoreError;

/// Every variant's text is one line that says what, where and how to mend it.
#[derive(Debug, thiserror::Error)]
pub enum FlightError {
    /// Training.
    #[error(transparent)]
    Engine(#[from] EngineError),
    /// Link or camera.
    #[error(transparent)]
    Hal(#[from] HalError),
    /// Stored key frames.
    #[error(transparent)]
    Store(#[from] StoreError),
    /// Upload settings.
    #[error(transparent)]
    Upload(#[from] UploadError),
    /// A file or folder that no format owns.
    #[error("{}: {}", path.display(), disk::told(source))]
    Io {
        /// Where.
        path: PathBuf,
        /// The system's reason.
        source: std::io::Error,
    },
    /// The disk has no room for what the mission may write.
    #[error("{0}")]
    Disk(String),
    /// The capture thread could not be started, or ended abnormally.
    #[error("{0}")]
    Capture(String),
    /// The flight ended before there was anything to build from.
    #[error("only {keyframes} key frames, nothing to build a model from: {cause}")]
    TooFewKeyframes {
        /// How many there were.
        keyframes: usize,
        /// The most likely cause by what was counted, and the remedy.
        cause: String,
    },
}

impl FlightError {
    /// For `map_err` on file operations.
    pub fn io(path: &Path) -> impl FnOnce(std::io::Error) -> Self + '_ {
        move |source| Self::Io { path: path.to_owned(), source }
    }
}

impl Error for FlightError {
    fn kind(&self) -> ErrorKind {
        match self {
            Self::Engine(e) => e.kind(),
            Self::Hal(e) => e.kind(),
            Self::Store(e) => e.kind(),
            Self::Upload(e) => e.kind(),
            Self::Io { source, .. } => Error::kind(source),
            Self::Disk(_) | Self::TooFewKeyframes { .. } => ErrorKind::Input,
            Self::Capture(_) => ErrorKind::Failed,
        }
    }
}
