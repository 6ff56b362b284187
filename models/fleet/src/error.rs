//! Why an area cannot be flown.

use config::error::{Error, ErrorKind};

/// Why an area cannot be flown.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum FleetError {
    /// The area itself.
    #[error("the area {0}")]
    Area(String),
    /// A setting.
    #[error("{what} {value}: must be {wanted}")]
    Setting {
        /// Which, as the command line calls it.
        what: &'static str,
        /// What was given.
        value: String,
        /// What can be flown with.
        wanted: String,
    },
    /// Batteries do not reach.
    #[error("{0}")]
    Reach(String),
    /// Regions that are not equal enough, or not what they must be.
    #[error("{0}")]
    Deal(String),
}

impl Error for FleetError {
    fn kind(&self) -> ErrorKind {
        ErrorKind::Input
    }
}
