//! How many may be connected at the same time, how many of them hear of changes, and when it is time to go.

use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};
use std::sync::{Arc, Condvar, Mutex, PoisonError};
use std::time::Duration;

/// Connections at the same time: a browser opens six to one host, and somebody else looks, too.
const CONNECTIONS: usize = 8;
/// Of them may hear of changes: the others stay for the page, its parts and whoever comes next.
const LISTENERS: usize = 5;
/// How many there are, and whether it is time to go.
#[derive(Default)]
pub(super) struct Room {
    connections: AtomicUsize,
    listeners: AtomicUsize,
    pub(super) closing: AtomicBool,
    bell: (Mutex<()>, Condvar),
}

/// Gives a listener's place back.
pub(super) struct Place<'a>(&'a AtomicUsize);

impl Drop for Place<'_> {
    fn drop(&mut self) {
        self.0.fetch_sub(1, Ordering::AcqRel);
    }
}

fn take(of: &AtomicUsize, most: usize) -> bool {
    of.fetch_update(Ordering::AcqRel, Ordering::Acquire, |n| (n < most).then_some(n + 1)).is_ok()
}

/// A connection's place, which goes with it into its thread.
pub(super) struct Seat(Arc<Room>);

impl Seat {
    /// `None` when all are taken.
    pub(super) fn take(room: &Arc<Room>) -> Option<Self> {
        take(&room.connections, CONNECTIONS).then(|| Self(room.clone()))
    }

    /// Where it stands.
    pub(super) fn room(&self) -> &Room {
        &self.0
    }
}

impl Drop for Seat {
    fn drop(&mut self) {
        self.0.connections.fetch_sub(1, Ordering::AcqRel);
    }
}

impl Room {
    /// A place among those who hear of changes.
    pub(super) fn listen(&self) -> Option<Place<'_>> {
        take(&self.listeners, LISTENERS).then_some(Place(&self.listeners))
    }

    /// Whether nobody is connected.
    pub(super) fn is_empty(&self) -> bool {
        self.connections.load(Ordering::Acquire) == 0
    }

    /// Waits, but not beyond the job's end.
    pub(super) fn pause(&self, time: Duration) {
        let guard = self.bell.0.lock().unwrap_or_else(PoisonError::into_inner);
        if !self.closing.load(Ordering::Relaxed) {
            // Woken or not, the caller looks again.
            drop(self.bell.1.wait_timeout(guard, time));
        }
    }

    /// Time to go.
    pub(super) fn close(&self) {
        let _guard = self.bell.0.lock().unwrap_or_else(PoisonError::into_inner);
        self.closing.store(true, Ordering::Relaxed);
        self.bell.1.notify_all();
    }
}

impl std::fmt::Debug for Room {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "{} connections", self.connections.load(Ordering::Relaxed))
    }
}
