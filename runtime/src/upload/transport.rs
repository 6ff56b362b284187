//! What a way from the aircraft to the ground must be able to do. Transports move bytes and bound their length;
//! what the bytes mean and whether they are right is checked once, by the receiver.

use std::sync::Arc;

use super::offer::{Hash, Offer, OfferedModel, hex};

/// Why a transport could not do what was asked. All of these are worth another attempt.
#[derive(Debug, thiserror::Error)]
pub enum TransportError {
    /// A file or directory of the folder transport.
    #[error("{path}: {source}")]
    Io {
        /// What was read or written.
        path: String,
        /// The system's word on it.
        source: std::io::Error,
    },
    /// The other side does not hold this chunk (any more).
    #[error("chunk {} is not on offer (any more)", &hex(.0)[..12])]
    NotHeld(Hash),
    /// Longer than what was announced.
    #[error("{what} has {bytes} bytes, at most {limit} were expected")]
    TooLong {
        /// What it was.
        what: String,
        /// How long it was.
        bytes: u64,
        /// How long it may be.
        limit: u64,
    },
    /// The network layer's own message.
    #[error("network: {0}")]
    Network(String),
}

impl TransportError {
    /// For `map_err` on file operations.
    pub fn io(path: &std::path::Path) -> impl FnOnce(std::io::Error) -> Self + '_ {
        move |source| Self::Io { path: path.display().to_string(), source }
    }
}

/// The aircraft's end.
pub trait Outlet: Send {
    /// For log lines.
    fn name(&self) -> String;

    /// Makes a model available in place of the one before. Chunks of the one before stay available for a ground
    /// station that is just fetching them.
    fn offer(&mut self, model: &Arc<OfferedModel>) -> Result<(), TransportError>;

    /// Whether the model with this hash has arrived where nothing can be lost any more.
    fn is_delivered(&self, model: &Hash) -> bool;
}

/// The ground's end. Shared between the threads that fetch for different aircraft.
pub trait Inlet: Send + Sync {
    /// For log lines.
    fn name(&self) -> String;

    /// The encoded offers that can be seen now, unchecked, at most one per aircraft.
    fn offers(&self) -> Result<Vec<Vec<u8>>, TransportError>;

    /// The bytes of one chunk, unchecked but not longer than the offer says.
    fn chunk(&self, offer: &Offer, index: usize) -> Result<Vec<u8>, TransportError>;

    /// Tells the aircraft that its model has been received and verified.
    fn confirm(&self, offer: &Offer) -> Result<(), TransportError>;
}
