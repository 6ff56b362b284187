//! Announced exposures: three messages in three time bases, each exposure exactly once.

use heapless::Deque;

use super::Autopilot;
use crate::mavlink::Frame;
use crate::mavlink::dialect::{CAMERA_FEEDBACK_DATA, CAMERA_IMAGE_CAPTURED_DATA, CAMERA_TRIGGER_DATA, MavBool};
use crate::trigger::{Trigger, TriggerKind};

/// Announcements waiting to be fetched.
const WAITING: usize = 32;
/// The message that came first is the one that is believed, until it is silent for this long: PX4 and ArduPilot announce
/// one exposure by several messages.
const HOLD_NS: u64 = 10_000_000_000;
/// A time stamp this far in the past or future of the newest boot time is wrong (an exposure is announced within
/// seconds), e.g. Unix time before the clock was set.
const MAX_PAST_NS: u64 = 10_000_000_000;
const MAX_FUTURE_NS: u64 = 2_000_000_000;
/// Uncertainty of an announced time, and of an arrival taken for it.
const STAMPED_SIGMA_NS: u64 = 2_000_000;
const ARRIVAL_SIGMA_NS: u64 = 50_000_000;

/// Our own exposure waits this long for the autopilot's announcement of it.
const OWN_WAIT_NS: u64 = 400_000_000;

/// What is remembered between announcements.
#[derive(Default)]
pub(super) struct Announcements {
    waiting: Deque<Trigger, WAITING>,
    believed: Option<(TriggerKind, u64)>,
    last: Option<Trigger>,
    own: Option<(u32, u64)>,
}

impl Announcements {
    pub(super) fn next(&mut self) -> Option<Trigger> {
        self.waiting.pop_front()
    }

    /// The boot clock restarted: counters may go on, times do not compare.
    pub(super) fn clear_times(&mut self) {
        self.last = None;
    }
}

impl Autopilot {
    pub(super) fn on_feedback(&mut self, frame: &Frame<'_>, now_ns: u64) {
        if let Some(m) = frame.message::<CAMERA_FEEDBACK_DATA>() {
            // 16 bits on the wire; the matcher wants a counter that does not wrap.
            let last = self.announcements.last.filter(|t| t.kind == TriggerKind::Feedback);
            let sequence = last.map_or(m.img_idx.into(), |last| {
                let step = m.img_idx.wrapping_sub(last.sequence as u16) as i16;
                last.sequence.saturating_add_signed(step.into())
            });
            self.announce(TriggerKind::Feedback, sequence, self.place_us(m.time_usec), now_ns);
        }
    }

    pub(super) fn on_camera_trigger(&mut self, frame: &Frame<'_>, now_ns: u64) {
        if let Some(m) = frame.message::<CAMERA_TRIGGER_DATA>() {
            self.announce(TriggerKind::CameraTrigger, m.seq, self.place_us(m.time_usec), now_ns);
        }
    }

    pub(super) fn on_image_captured(&mut self, frame: &Frame<'_>, now_ns: u64) {
        let Some(m) = frame.message::<CAMERA_IMAGE_CAPTURED_DATA>() else { return };
        if m.capture_result == MavBool::MAV_BOOL_FALSE {
            return;
        }
        // A camera with a component of its own has a boot clock of its own, but knows Unix time.
        let boot_ns = if frame.component() == self.ids.autopilot {
            Some(self.stamp(m.time_boot_ms, now_ns))
        } else {
            self.place_us(m.time_utc)
        };
        self.announce(TriggerKind::ImageCaptured, m.image_index.max(0).unsigned_abs(), boot_ns, now_ns);
    }

    /// An exposure that we made ourselves on command, at `now_ns`. The autopilot usually announces it as well, with a
    /// better time: [`Autopilot::settle_own`] decides.
    pub fn announce_own(&mut self, sequence: u32, now_ns: u64) {
        self.announcements.own = Some((sequence, now_ns));
    }

    /// Announces our own exposure when nobody else did.
    pub fn settle_own(&mut self, now_ns: u64) {
        let Some((sequence, made_ns)) = self.announcements.own else { return };
        if now_ns.saturating_sub(made_ns) < OWN_WAIT_NS {
            return;
        }
        self.announcements.own = None;
        let boot_ns = self.clock.to_boot_ns(made_ns);
        self.announce(TriggerKind::Command, sequence, boot_ns, now_ns);
    }

    fn announce(&mut self, kind: TriggerKind, sequence: u32, boot_ns: Option<u64>, now_ns: u64) {
        // A stamped announcement is always better than our own.
        let own = TriggerKind::Command;
        let other = self
            .announcements
            .believed
            .is_some_and(|(k, t)| k != kind && k != own && now_ns.saturating_sub(t) < HOLD_NS);
        if other {
            self.counters.trigger_duplicates += 1;
            return;
        }
        let plausible = |t: &u64| {
            let newest = self.boot.newest_ns().unwrap_or(*t);
            *t + MAX_PAST_NS > newest && *t < newest + MAX_FUTURE_NS
        };
        let (boot_ns, sigma_ns) = match boot_ns.filter(plausible) {
            Some(boot_ns) => (boot_ns, STAMPED_SIGMA_NS),
            None => {
                self.counters.trigger_times_mended += 1;
                let arrival = self.clock.to_boot_ns(now_ns).or(self.boot.newest_ns());
                (arrival.unwrap_or(now_ns), ARRIVAL_SIGMA_NS)
            }
        };
        if let Some(last) = self.announcements.last.filter(|t| t.kind == kind) {
            // The counter decides; it may restart with the camera, which a later time stamp shows.
            if sequence == last.sequence || (sequence < last.sequence && boot_ns <= last.boot_ns) {
                self.counters.trigger_duplicates += 1;
                return;
            }
            self.counters.trigger_gaps += u64::from(sequence.saturating_sub(last.sequence).saturating_sub(1).min(1000));
        }
        let time_ns = self.clock.to_companion_ns(boot_ns).unwrap_or(now_ns);
        let trigger = Trigger { sequence, boot_ns, time_ns, sigma_ns, kind };
        self.announcements.believed = Some((kind, now_ns));
        self.announcements.last = Some(trigger);
        self.counters.triggers += 1;
        self.landing.on_exposure();
        if self.announcements.waiting.is_full() {
            self.announcements.waiting.pop_front();
            self.counters.triggers_unmatched += 1;
        }
        let _ = self.announcements.waiting.push_back(trigger);
    }
}
