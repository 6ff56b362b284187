//! Between the capture thread and the job: key frames one way, words for the ground control station the other, and what
//! either has to know about the other without waiting for it.

use std::collections::VecDeque;
use std::path::PathBuf;
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};
use std::sync::mpsc::{Receiver, SyncSender, sync_channel};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::{Duration, Instant};

use engine::PictureSource;
use engine::error::EngineError;
use hal::failsafe::{Action, Flags};
use hal::mavlink::dialect::MavSeverity;
use hal::mavlink_camera::Activity;
use image::RgbImage;
use models::camera::{Pose, PosedImage};
use models::mask::Mask;
use uplink::heartbeat::Condition;

use crate::keyframe_store::{KeyFrame, KeyframeStore, Relief, StoreError};

/// Decoded key frames in the channel.
pub(super) const AHEAD: usize = 2;
/// Lines waiting to be said.
const WORDS: usize = 16;

/// What the job says of itself, for the ground station.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct Told {
    pub(super) activity: Activity,
    /// The rung of the failsafe ladder.
    pub(super) rung: Action,
    pub(super) key_frames: u32,
    pub(super) gaussians: u32,
    /// Share of the schedule that is over, 0…1.
    pub(super) progress: f32,
    /// Loss of the newest step.
    pub(super) loss: f32,
    /// Nothing is trained any more in this flight.
    pub(super) training_over: bool,
}

/// What capture sees of the flight, for the ground.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct Seen {
    /// Charge of the battery, percent.
    pub(super) battery_pct: Option<u8>,
    /// How much of the region was covered when that was last looked at, percent.
    pub(super) covered_pct: Option<u32>,
}

#[derive(Default)]
struct Shared {
    waiting: AtomicUsize,
    /// When those that wait came.
    came: Mutex<VecDeque<Instant>>,
    stop: AtomicBool,
    over: AtomicBool,
    flags: Mutex<Flags>,
    seen: Mutex<Seen>,
    told: Mutex<Told>,
    /// Training time that the ground station asks for; `None`: nothing new, `Some(None)`: the steps alone decide.
    seconds: Mutex<Option<Option<f64>>>,
}

/// The job's end: an aircraft as a [`PictureSource`].
pub struct Handover {
    /// Where key frames are kept before they are used, and the checkpoint that shares the disk with them.
    store: Option<(KeyframeStore, PathBuf)>,
    /// Key frames of earlier runs that were taken up again, while there are more.
    taken_up: Option<usize>,
    /// Key frames that were used without being kept: the disk had no room.
    without_room: u64,
    /// Whether the last one was kept.
    room: bool,
    /// When those came that are not in the model yet.
    taken: Vec<Instant>,
    /// Seconds that each took from its arrival into the model.
    waited_s: Vec<f64>,
    frames: Receiver<KeyFrame>,
    words: SyncSender<(MavSeverity, String)>,
    shared: Arc<Shared>,
}

/// The capture's end.
pub(super) struct CaptureEnd {
    pub(super) frames: SyncSender<KeyFrame>,
    pub(super) words: Receiver<(MavSeverity, String)>,
    shared: Arc<Shared>,
}

/// Both ends.
pub(super) fn handover() -> (Handover, CaptureEnd) {
    let (to, frames) = sync_channel(AHEAD);
    let (words, inbox) = sync_channel(WORDS);
    let shared = Arc::new(Shared::default());
    (
        Handover {
            store: None,
            taken_up: None,
            without_room: 0,
            room: true,
            taken: Vec::new(),
            waited_s: Vec::new(),
            frames,
            words,
            shared: shared.clone(),
        },
        CaptureEnd { frames: to, words: inbox, shared },
    )
}

impl Handover {
    /// Keeps every key frame in `store` from now on, beside the checkpoint `model`. Those already there come first: the capture
    /// listens meanwhile.
    pub fn keep_in(&mut self, store: KeyframeStore, model: PathBuf) {
        self.taken_up = (!store.is_empty()).then_some(0);
        self.store = Some((store, model));
    }

    /// Key frames of earlier runs still to be taken up again.
    pub fn earlier_left(&self) -> usize {
        let all = self.store.as_ref().map_or(0, |(store, _)| store.len());
        self.taken_up.map_or(0, |taken| all.saturating_sub(taken))
    }

    fn take_up(&mut self) -> Option<PosedImage> {
        let (taken, (store, _)) = (self.taken_up?, self.store.as_mut()?);
        let frame = store.sound(taken);
        self.taken_up = (frame.is_some() && taken + 1 < store.len()).then_some(taken + 1);
        frame
    }

    /// Makes room on the disk; false when there was nothing to give up.
    pub fn relieve(&mut self, relief: Relief) -> bool {
        if relief == Relief::CoveredPictures && self.taken_up.is_some() {
            return false;
        }
        self.store.as_mut().is_some_and(|(store, model)| store.relieve(relief, model))
    }

    /// Key frames that were used without being kept, for want of room.
    pub fn without_room(&self) -> u64 {
        self.without_room
    }

    /// Keeps a key frame. On a full disk what costs least is given up first; after that key frames are used and not kept,
    /// each of which tries again, as room may have been made.
    fn keep(&mut self, frame: &KeyFrame) -> Result<(), StoreError> {
        let Some((store, model)) = &mut self.store else { return Ok(()) };
        let kept = store.add_with_relief(frame, model);
        let room = match kept {
            Ok(()) => true,
            Err(e) if e.may_pass() => {
                tracing::debug!("{}: {e}", frame.posed.name);
                self.without_room += 1;
                false
            }
            Err(StoreError::Camera(e)) => {
                tracing::warn!("{e}; the key frame is used and not kept");
                self.without_room += 1;
                self.room
            }
            Err(e) => return Err(e),
        };
        if std::mem::replace(&mut self.room, room) != room {
            let (severity, line) = match room {
                true => (MavSeverity::MAV_SEVERITY_INFO, "dgtr: room on disk again, key frames are kept"),
                false => (MavSeverity::MAV_SEVERITY_WARNING, "dgtr: no room on disk, key frames are not kept"),
            };
            tracing::warn!("{line}");
            self.say(severity, line.to_owned());
        }
        Ok(())
    }

    /// Poses of the key frames are known better: other programs that read the store should have them.
    ///
    /// # Errors
    /// The store cannot be written.
    pub fn refined(&mut self, pose: impl FnMut(&str) -> Option<Pose>) -> Result<(), StoreError> {
        match self.store.as_mut().map_or(Ok(()), |(store, _)| store.refine(pose)) {
            // For other programs only; written again with the next key frame.
            Err(e) if e.may_pass() => tracing::warn!("refined poses are not listed: {e}"),
            other => other?,
        }
        Ok(())
    }

    /// All key frames taken so far are in the model.
    pub(super) fn note_in_model(&mut self) {
        self.waited_s.extend(self.taken.drain(..).map(|came| came.elapsed().as_secs_f64()));
    }

    /// Seconds from the arrival of a picture until the model had it, in the order of the key frames.
    pub fn waited_s(&self) -> &[f64] {
        &self.waited_s
    }

    /// What the HAL saw last, for the failsafe ladder.
    pub fn flags(&self) -> Flags {
        *self.shared.flags.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// How the aircraft is, for the ground.
    pub(super) fn condition(&self) -> Condition {
        let (flags, seen) = (self.flags(), *self.shared.seen.lock().unwrap_or_else(PoisonError::into_inner));
        Condition {
            battery_pct: seen.battery_pct,
            battery_low: flags.battery_low,
            link_lost: flags.link_lost,
            landed: !self.is_open(),
            covered_pct: seen.covered_pct.map(|percent| percent.min(100) as u8),
        }
    }

    /// Says a line to the ground control station (STATUSTEXT); dropped when the link cannot keep up.
    pub fn say(&self, severity: MavSeverity, text: String) {
        let _ = self.words.try_send((severity, text));
    }

    /// Notes what the job does, for the ground station.
    pub(super) fn tell(&self, change: impl FnOnce(&mut Told)) {
        change(&mut self.shared.told.lock().unwrap_or_else(PoisonError::into_inner));
    }

    /// Training time that was asked for since the last call.
    pub(super) fn seconds_asked(&self) -> Option<Option<f64>> {
        self.shared.seconds.lock().unwrap_or_else(PoisonError::into_inner).take()
    }

    /// Asks capture to end.
    pub fn stop(&self) {
        self.shared.stop.store(true, Ordering::Relaxed);
    }
}

impl PictureSource for Handover {
    fn next(&mut self, patience: Duration) -> Result<Option<PosedImage>, EngineError> {
        if let Some(frame) = self.take_up() {
            return Ok(Some(frame));
        }
        let Ok(frame) = self.frames.recv_timeout(patience) else { return Ok(None) };
        self.shared.waiting.fetch_sub(1, Ordering::AcqRel);
        let came = self.shared.came.lock().unwrap_or_else(PoisonError::into_inner).pop_front();
        self.taken.extend(came);
        self.keep(&frame).map_err(|e| EngineError::Source(Box::new(e)))?;
        Ok(Some(frame.posed))
    }

    fn waiting(&self) -> usize {
        self.earlier_left() + self.shared.waiting.load(Ordering::Acquire)
    }

    fn size_of(&self, _name: &str) -> Option<(u32, u32)> {
        self.store.as_ref().map(|(store, _)| store.camera_size())
    }

    fn whole(&mut self, name: &str, scale: f64) -> Result<Option<(RgbImage, Option<Mask>)>, EngineError> {
        let Some((store, _)) = &self.store else { return Ok(None) };
        // What is damaged is set aside at the next start.
        let whole = store.whole(name, scale).unwrap_or_else(|e| {
            tracing::warn!("{e}; no crops of it");
            None
        });
        Ok(whole.map(|image| (image, None)))
    }

    fn is_open(&self) -> bool {
        !self.shared.over.load(Ordering::Acquire)
    }
}

impl CaptureEnd {
    /// One key frame more, or one less, waits to be taken.
    pub(super) fn count(&self, more: bool) {
        let mut came = self.shared.came.lock().unwrap_or_else(PoisonError::into_inner);
        if more {
            came.push_back(Instant::now());
            self.shared.waiting.fetch_add(1, Ordering::AcqRel);
        } else {
            came.pop_back();
            self.shared.waiting.fetch_sub(1, Ordering::AcqRel);
        }
    }

    pub(super) fn set_seen(&self, seen: Seen) {
        *self.shared.seen.lock().unwrap_or_else(PoisonError::into_inner) = seen;
    }

    pub(super) fn set_flags(&self, flags: Flags) {
        *self.shared.flags.lock().unwrap_or_else(PoisonError::into_inner) = flags;
    }

    /// What the job told last.
    pub(super) fn told(&self) -> Told {
        *self.shared.told.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Asks the job to train for so long; it looks before every turn.
    pub(super) fn ask_seconds(&self, seconds: Option<f64>) {
        *self.shared.seconds.lock().unwrap_or_else(PoisonError::into_inner) = Some(seconds);
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
