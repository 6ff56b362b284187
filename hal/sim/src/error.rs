//! What can go wrong with simulators and replays.

use std::path::PathBuf;

use config::error::{Error, ErrorKind};

use hal::error::HalError;

/// One line each: what, where, how to mend.
#[derive(Debug, thiserror::Error)]
pub enum SimError {
    /// The link to the companion.
    #[error(transparent)]
    Link(#[from] HalError),
    /// A file or folder that cannot be written or read.
    #[error("{}: {}", path.display(), disk::told(source))]
    Folder {
        /// Where.
        path: PathBuf,
        /// The system's reason.
        source: std::io::Error,
    },
    /// A picture that cannot be made.
    #[error("picture {name}: {why}")]
    Picture {
        /// Which.
        name: String,
        /// Why.
        why: String,
    },
    /// The camera's thread ended early.
    #[error("the simulated camera stopped after {made} pictures")]
    CameraStopped {
        /// Pictures made before.
        made: usize,
    },
    /// Settings that allow no flight.
    #[error("{what}: {why}")]
    Settings {
        /// Which.
        what: &'static str,
        /// What is wrong and what would be right.
        why: String,
    },
}

impl Error for SimError {
    fn kind(&self) -> ErrorKind {
        match self {
            Self::Link(e) => Error::kind(e),
            Self::Folder { source, .. } => Error::kind(source),
            Self::Settings { .. } => ErrorKind::Input,
            Self::Picture { .. } | Self::CameraStopped { .. } => ErrorKind::Failed,
        }
    }
}
