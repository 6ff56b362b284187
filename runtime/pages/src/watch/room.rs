//! How many may be connected at the same time, how many of them hear of changes, and when it is time to go. Whoever has not said
//! what he wants takes nobody's place: the oldest of those goes when one more comes.

use std::collections::VecDeque;
use std::net::{Shutdown, TcpStream};
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};
use std::sync::{Arc, Condvar, Mutex, PoisonError};
use std::time::Duration;

/// Connections that are answered at the same time: a browser opens six to one host, and somebody else looks, too.
const CONNECTIONS: usize = 8;
/// Connections that have not said what they want, and all that have a thread: those that are ended take a moment.
const SILENT: usize = 32;
const THREADS: usize = 2 * (CONNECTIONS + SILENT);
/// Of them may hear of changes: the others stay for the page, its parts and whoever comes next.
const LISTENERS: usize = 5;
/// How many there are, and whether it is time to go.
#[derive(Default)]
pub(super) struct Room {
    connections: AtomicUsize,
    listeners: AtomicUsize,
    threads: AtomicUsize,
    silent: Mutex<VecDeque<(usize, TcpStream)>>,
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

/// The thread of a connection, which has not said yet what it wants.
pub(super) struct Guest {
    room: Arc<Room>,
    stream: usize,
}

impl Guest {
    /// `None` when there are too many threads. The oldest of too many that are silent is ended.
    pub(super) fn enter(room: &Arc<Room>, stream: &TcpStream) -> Option<Self> {
        take(&room.threads, THREADS).then_some(())?;
        let guest = Self { room: room.clone(), stream: std::os::fd::AsRawFd::as_raw_fd(stream) as usize };
        let mut silent = room.silent.lock().unwrap_or_else(PoisonError::into_inner);
        silent.push_back((guest.stream, stream.try_clone().ok()?));
        if silent.len() > SILENT
            && let Some((_, oldest)) = silent.pop_front()
        {
            // Its thread wakes and ends. One that has gone by itself does not mind.
            let _ = oldest.shutdown(Shutdown::Both);
        }
        drop(silent);
        Some(guest)
    }

    /// It has said what it wants.
    pub(super) fn has_spoken(&self) {
        let mut silent = self.room.silent.lock().unwrap_or_else(PoisonError::into_inner);
        silent.retain(|(stream, _)| *stream != self.stream);
    }

    /// A place to be answered at; `None` when all are taken.
    pub(super) fn seat(&self) -> Option<Seat> {
        Seat::take(&self.room)
    }
}

impl Drop for Guest {
    fn drop(&mut self) {
        self.has_spoken();
        self.room.threads.fetch_sub(1, Ordering::AcqRel);
    }
}

/// A connection's place, which goes with it into its thread.
pub(super) struct Seat(Arc<Room>);

impl Seat {
    /// `None` when all are taken.
    fn take(room: &Arc<Room>) -> Option<Self> {
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
        // Not `then_some`: a place that was made and let go would free somebody else's.
        take(&self.listeners, LISTENERS).then(|| Place(&self.listeners))
    }

    /// Whether nobody is connected.
    pub(super) fn is_empty(&self) -> bool {
        self.threads.load(Ordering::Acquire) == 0
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
