//! What can be wrong with a mission file, each as one line: what, where, how to mend.

use std::path::{Path, PathBuf};

use crate::settings::{SettingError, SyntaxError};

/// Why a mission file was refused.
#[derive(Debug, thiserror::Error)]
pub enum MissionError {
    /// The file could not be read.
    #[error("mission file {}: {source}; check the path given to --mission", path.display())]
    Unreadable {
        /// The file.
        path: PathBuf,
        /// The system's reason.
        source: std::io::Error,
    },
    /// The file is larger than any mission can be.
    #[error("mission file {}: {bytes} bytes, at most {limit} are read; is this the right file?", path.display())]
    TooLarge {
        /// The file.
        path: PathBuf,
        /// Its size.
        bytes: u64,
        /// The bound.
        limit: u64,
    },
    /// Not TOML, an unknown setting, or a wrong type.
    #[error(transparent)]
    Syntax(#[from] SyntaxError),
    /// A value that cannot be flown with.
    #[error(transparent)]
    Setting(#[from] SettingError),
    /// One of the above, in a file.
    #[error("mission file {}, {inner}", path.display())]
    InFile {
        /// The file.
        path: PathBuf,
        /// What is wrong in it.
        inner: Box<MissionError>,
    },
    /// The mission has several aircraft and none was named.
    #[error("the mission has several aircraft; choose one with --aircraft ({known})")]
    WhichAircraft {
        /// The ids there are.
        known: String,
    },
    /// No aircraft of that name.
    #[error("no aircraft '{id}' in the mission; it has {known}")]
    NoSuchAircraft {
        /// The id asked for.
        id: String,
        /// The ids there are.
        known: String,
    },
}

impl MissionError {
    pub(super) fn in_file(self, path: &Path) -> Self {
        Self::InFile { path: path.into(), inner: Box::new(self) }
    }
}
