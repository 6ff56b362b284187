//! Models travel from the aircraft to the ground as content-hashed chunks: over the network (zenoh on TCP or TLS,
//! feature `zenoh`), through a folder (a USB stick after landing), or both.
//!
//! [`Offerer`] is the aircraft's side and runs in a thread of its own, so that neither a slow link nor a missing
//! stick ever delays capture or training. [`receive::Receiver`] is the ground's.

pub mod folder;
#[cfg(feature = "zenoh")]
pub mod network;
pub mod offer;
mod offerer;
pub mod receive;
pub mod store;
pub mod transport;

pub use offerer::{Offerer, OffererStatus};

/// Why upload or reception could not start or continue.
#[derive(Debug, thiserror::Error)]
pub enum UploadError {
    /// `[upload]` itself.
    #[error("mission: {0}")]
    Settings(#[from] config::upload::UploadSettingsError),
    /// Neither transport is configured on this end.
    #[error("mission: [upload] has neither folder nor {0}; set one of them")]
    NoTransport(&'static str),
    /// Endpoints in the mission, but no zenoh in the program.
    #[error("this build has no network transport; use upload.folder, or build with --features zenoh")]
    NoNetwork,
    /// The network refused from the start (port in use, unreadable certificate).
    #[error(transparent)]
    Transport(#[from] transport::TransportError),
    /// The ground's disk.
    #[error(transparent)]
    Store(#[from] store::StoreError),
    /// The background thread could not be started.
    #[error("upload thread: {0}")]
    Thread(std::io::Error),
}
