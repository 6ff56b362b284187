//! Between the caller and the thread that offers: the newest model, and what became of those before.

use std::path::PathBuf;
use std::sync::{Mutex, MutexGuard, PoisonError};
use std::time::Instant;

use crate::heartbeat::Condition;

/// What has become of the offers so far.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct OffererStatus {
    /// Models offered.
    pub offers: u64,
    /// Bytes of the newest one.
    pub bytes: u64,
    /// Bytes of offers and chunks that left the aircraft, those of models that were replaced included.
    pub sent: u64,
    /// Failed attempts, each of which is repeated.
    pub failures: u64,
    /// The newest model has arrived on the ground, or lies complete in the folder.
    pub delivered: bool,
    /// Why the ground will not take the newest model; empty while it has not said so.
    pub refused: String,
    /// Why the last attempt failed; empty once one worked.
    pub last_error: String,
}

/// What is handed over.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Kind {
    /// May wait for its turn.
    Checkpoint,
    /// May be the last one ever: the aircraft is in trouble.
    Urgent,
    /// The last one of this flight.
    Final,
}

/// What both sides know.
#[derive(Default)]
pub(super) struct Inbox {
    /// The newest model not yet taken up; an older one it replaces was never sent, which is as it should be.
    pub next: Option<(PathBuf, Kind)>,
    /// When the last model will be here, if anybody knows.
    pub last: Option<Instant>,
    /// How the aircraft is.
    pub condition: Condition,
    pub stop: bool,
    pub status: OffererStatus,
}

pub(super) fn locked(inbox: &Mutex<Inbox>) -> MutexGuard<'_, Inbox> {
    // Every critical section leaves the data whole, so a panic elsewhere does not make it wrong.
    inbox.lock().unwrap_or_else(PoisonError::into_inner)
}
