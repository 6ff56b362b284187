//! Models travel from the aircraft to the ground as content-hashed chunks: over the network (zenoh on TCP or TLS,
//! feature `zenoh`), through a folder (a USB stick after landing), or both.
//!
//! [`Offerer`] is the aircraft's side and runs in a thread of its own, so that neither a slow link nor a missing
//! stick ever delays capture or training. [`receive::Receiver`] is the ground's.

use std::path::{Path, PathBuf};

use config::mission::Mission;
use disk::Disk;

use crate::keys::{Identity, KeyError};

pub mod admission;
pub mod binding;
#[cfg(test)]
#[cfg(feature = "zenoh")]
#[path = "../../../tests/uplink/chaos.rs"]
mod chaos;
pub mod disk_error;
pub mod flight_number;
pub mod folder;
pub mod heartbeat;
pub mod keys;
mod medium;
pub mod memory;
#[cfg(feature = "zenoh")]
pub mod network;
pub mod offer;
mod offerer;
pub mod polygon;
#[cfg(test)]
#[path = "../../../tests/power_cut/mod.rs"]
#[allow(dead_code, reason = "all of it is used where flights are cut")]
mod power_cut;
pub mod receipt;
pub mod receive;
#[cfg(test)]
#[cfg(feature = "zenoh")]
#[path = "../../../tests/uplink/slow_link.rs"]
mod slow_link;
pub mod store;
mod territory;
#[cfg(test)]
#[path = "../../../tests/bad_link.rs"]
#[cfg_attr(not(feature = "zenoh"), allow(dead_code, reason = "bad links are the network's"))]
mod testing;
pub mod transport;

use config::error::{Error, ErrorKind};

pub use offerer::{Offerer, OffererStatus};
pub use territory::Territory;

/// Whose models are offered, and in what name they are signed.
#[derive(Clone)]
pub struct Source {
    /// Name of the mission.
    pub mission: String,
    /// Id of the aircraft.
    pub aircraft: String,
    /// Its key, and the ground's.
    pub identity: Identity,
    /// Where the number of the last flight is kept; None = every start is flight 1.
    pub flight_number: Option<PathBuf>,
    /// The session that the mission names; `None`: the ground says which.
    pub session: Option<offer::Hash>,
    /// Where what is made for delivery is written.
    pub disk: Disk,
    /// The ground it answers for; `None`: all.
    pub territory: Option<Territory>,
}

impl Source {
    /// An aircraft of a mission; the number of its last flight lies in the state folder, without one
    /// beside its key, without keys in `out`.
    ///
    /// # Errors
    /// The mission may not be flown unsigned, or the private key is not usable.
    pub fn of(mission: &Mission, aircraft: &str, out: &Path) -> Result<Self, KeyError> {
        let identity = Identity::of(mission, aircraft)?;
        let (keys, name) = (&mission.upload.keys, format!("{aircraft}.flight"));
        let folder = if identity.is_signed() { config::state::folder(keys) } else { out.into() };
        let flight_number = Some(folder.join(&name));
        if let Some(now) = flight_number.as_deref().filter(|now| identity.is_signed() && !now.exists()) {
            flight_number::take_over(&keys.join(&name), now);
        }
        Ok(Self {
            mission: mission.name.clone(),
            aircraft: aircraft.into(),
            identity,
            flight_number,
            session: mission.upload.session.as_deref().map(binding::named),
            disk: Disk::default(),
            territory: Territory::of(mission, aircraft),
        })
    }

    /// The offer as it is shown to a ground whose session is `session`, if that is known.
    pub(crate) fn bind(&self, offer: &offer::Offer, session: Option<offer::Hash>) -> offer::Offer {
        let session = self.session.or(session);
        session.map_or_else(|| offer.clone(), |session| offer.bound_to(&session, &self.identity))
    }

    /// For tests of what does not depend on keys.
    #[cfg(test)]
    pub(crate) fn unsigned(mission: &str, aircraft: &str) -> Self {
        Self {
            mission: mission.into(),
            aircraft: aircraft.into(),
            identity: Identity::unsigned(),
            flight_number: None,
            session: None,
            disk: Disk::default(),
            territory: None,
        }
    }
}

/// Why upload or reception could not start or continue.
#[derive(Debug, thiserror::Error)]
pub enum UploadError {
    /// `[upload]` itself.
    #[error("mission: [upload] {0}")]
    Settings(#[from] config::settings::SettingError),
    /// Neither transport is configured on this end.
    #[error("mission: [upload] has neither folder nor {0}; set one of them")]
    NoTransport(&'static str),
    /// Endpoints in the mission, but no zenoh in the program.
    #[error("this build has no network transport; use upload.folder, or build with --features zenoh")]
    NoNetwork,
    /// The network refused from the start (port in use, unreadable certificate).
    #[error(transparent)]
    Transport(#[from] transport::TransportError),
    /// Identities.
    #[error(transparent)]
    Keys(#[from] KeyError),
    /// The ground's disk.
    #[error(transparent)]
    Store(#[from] store::StoreError),
    /// The system has no random numbers.
    #[error("drawing the session's number: {0}")]
    Random(std::io::Error),
    /// The background thread could not be started.
    #[error("upload thread: {0}")]
    Thread(std::io::Error),
}

impl Error for UploadError {
    fn kind(&self) -> ErrorKind {
        match self {
            Self::Settings(_) | Self::NoTransport(_) | Self::NoNetwork => ErrorKind::Input,
            Self::Transport(e) => e.kind(),
            Self::Keys(e) => e.kind(),
            Self::Store(e) => e.kind(),
            Self::Random(_) | Self::Thread(_) => ErrorKind::Failed,
        }
    }
}
