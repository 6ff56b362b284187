//! What a way from the aircraft to the ground must be able to do. Transports move bytes and bound their length;
//! what the bytes mean and whether they are right is checked once, by the receiver.

use std::sync::Arc;
use std::sync::atomic::AtomicBool;
use std::time::Duration;

use config::error::{Error, ErrorKind};

use super::heartbeat::{Heard, Heartbeat};
use super::offer::{Hash, Offer, OfferedModel, hex};
use super::receipt::Delivery;

/// Why a transport could not do what was asked. All of these are worth another attempt.
#[derive(Debug, thiserror::Error)]
pub enum TransportError {
    /// A file or directory of the folder transport.
    #[error("{path}: {}", disk::told(source))]
    Io {
        /// What was read or written.
        path: String,
        /// The system's word on it.
        source: std::io::Error,
    },
    /// The other side does not hold this chunk (any more).
    #[error("chunk {} is not on offer (any more)", &hex(.0)[..12])]
    NotHeld(Hash),
    /// Every answer had other bytes than the offer promises.
    #[error("chunk {} came with other bytes than were promised", &hex(.0)[..12])]
    Corrupt(Hash),
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

impl Error for TransportError {
    /// What is said of the network itself is said at its start: a port in use, a certificate that cannot be read.
    fn kind(&self) -> ErrorKind {
        match self {
            Self::Io { source, .. } => Error::kind(source),
            Self::Network(_) => ErrorKind::Input,
            Self::NotHeld(_) | Self::Corrupt(_) | Self::TooLong { .. } => ErrorKind::Failed,
        }
    }
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
    ///
    /// # Errors
    /// The medium or the network refuses it; it is tried again.
    fn offer(&mut self, model: &Arc<OfferedModel>) -> Result<(), TransportError>;

    /// What has become of the model on offer.
    fn delivery(&mut self, offer: &Offer) -> Delivery;

    /// Bytes of offers and chunks that left the aircraft this way.
    fn sent(&self) -> u64;

    /// Says how the aircraft is, where anybody can hear it now; the next one follows one that does not arrive.
    fn say(&mut self, _heartbeat: &Heartbeat) {}
}

/// How long the ground waits for one answer.
#[derive(Clone, Copy)]
pub struct Patience<'a> {
    /// At most so long.
    pub limit: Duration,
    /// And not beyond this request to stop.
    pub stop: &'a AtomicBool,
}

/// The ground's end. Shared between the threads that fetch for different aircraft. Several peers may answer, and whoever
/// answers first may lie: every answer is shown to the caller, until one is accepted.
pub trait Inlet: Send + Sync {
    /// For log lines.
    fn name(&self) -> String;

    /// Shows every encoded offer that can be seen now, unchecked.
    ///
    /// # Errors
    /// The medium or the network fails.
    fn offers(&self, patience: Patience, see: &mut dyn FnMut(&[u8])) -> Result<(), TransportError>;

    /// The first answer that `accept` takes for chunk `index`; none is longer than the offer says.
    ///
    /// # Errors
    /// Nobody holds it, nobody answers in time, or no answer is accepted.
    fn chunk(
        &self,
        offer: &Offer,
        index: usize,
        patience: Patience,
        accept: &mut dyn FnMut(&[u8]) -> bool,
    ) -> Result<Vec<u8>, TransportError>;

    /// Gives the aircraft a receipt; `accept` says whether an answer proves that it was taken.
    ///
    /// # Errors
    /// Nobody takes it in time.
    fn deliver_receipt(
        &self,
        aircraft: &str,
        receipt: &[u8],
        patience: Patience,
        accept: &mut dyn FnMut(&[u8]) -> bool,
    ) -> Result<(), TransportError>;

    /// Forgets the session where aircraft would read of it after its end.
    fn end_session(&self) {}

    /// Returns the newest heartbeat of an aircraft, where heartbeats are heard.
    fn heard(&self, _aircraft: &str) -> Option<Heard> {
        None
    }
}
