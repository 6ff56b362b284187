//! Between the capture thread and the job: key frames one way, words for the ground control station the other, and what
//! either has to know about the other without waiting for it.

use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};
use std::sync::mpsc::{Receiver, SyncSender, sync_channel};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Duration;

use hal::failsafe::Flags;
use hal::mavlink::dialect::MavSeverity;
use models::camera::PosedImage;

/// Decoded key frames in the channel.
const AHEAD: usize = 2;
/// Lines waiting to be said.
const WORDS: usize = 16;

#[derive(Default)]
struct Shared {
    waiting: AtomicUsize,
    stop: AtomicBool,
    over: AtomicBool,
    flags: Mutex<Flags>,
}

/// The job's end.
pub struct Handover {
    frames: Receiver<PosedImage>,
    words: SyncSender<(MavSeverity, String)>,
    shared: Arc<Shared>,
}

/// The capture's end.
pub(super) struct CaptureEnd {
    pub(super) frames: SyncSender<PosedImage>,
    pub(super) words: Receiver<(MavSeverity, String)>,
    shared: Arc<Shared>,
}

/// Both ends.
pub(super) fn handover() -> (Handover, CaptureEnd) {
    let (to, frames) = sync_channel(AHEAD);
    let (words, inbox) = sync_channel(WORDS);
    let shared = Arc::new(Shared::default());
    (Handover { frames, words, shared: shared.clone() }, CaptureEnd { frames: to, words: inbox, shared })
}

impl Handover {
    /// The next key frame if one is ready, waiting `timeout` at most.
    pub fn next(&self, timeout: Duration) -> Option<PosedImage> {
        let frame = self.frames.recv_timeout(timeout).ok()?;
        self.shared.waiting.fetch_sub(1, Ordering::AcqRel);
        Some(frame)
    }

    /// Key frames that wait to be taken.
    pub fn waiting(&self) -> usize {
        self.shared.waiting.load(Ordering::Acquire)
    }

    /// What the HAL saw last, for the failsafe ladder.
    pub fn flags(&self) -> Flags {
        *self.shared.flags.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Whether capture goes on.
    pub fn is_flying(&self) -> bool {
        !self.shared.over.load(Ordering::Acquire)
    }

    /// Says a line to the ground control station (STATUSTEXT); dropped when the link cannot keep up.
    pub fn say(&self, severity: MavSeverity, text: String) {
        let _ = self.words.try_send((severity, text));
    }

    /// Asks capture to end.
    pub fn stop(&self) {
        self.shared.stop.store(true, Ordering::Relaxed);
    }
}

impl CaptureEnd {
    /// One key frame more, or one less, waits to be taken.
    pub(super) fn count(&self, more: bool) {
        if more {
            self.shared.waiting.fetch_add(1, Ordering::AcqRel);
        } else {
            self.shared.waiting.fetch_sub(1, Ordering::AcqRel);
        }
    }

    pub(super) fn set_flags(&self, flags: Flags) {
        *self.shared.flags.lock().unwrap_or_else(PoisonError::into_inner) = flags;
    }

    pub(super) fn stop_asked(&self) -> bool {
        self.shared.stop.load(Ordering::Relaxed)
    }
}

/// However capture ends, the job must not wait for it.
impl Drop for CaptureEnd {
    fn drop(&mut self) {
        self.shared.over.store(true, Ordering::Release);
    }
}
