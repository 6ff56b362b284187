//! Announced exposures: three messages in three time bases, each exposure exactly once.

use heapless::{Deque, HistoryBuf, Vec};

use super::Autopilot;
use crate::mavlink::Frame;
use crate::mavlink::dialect::{CAMERA_FEEDBACK_DATA, CAMERA_IMAGE_CAPTURED_DATA, CAMERA_TRIGGER_DATA, MavBool};
use crate::trigger::{Source, Trigger, TriggerKind};

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

/// Cameras whose announcements are told apart, and announcements of each that are remembered to know one that is repeated.
const SOURCES: usize = 8;
const RECENT: usize = 8;
/// An announcement without a time stamp is a repetition only when it comes this soon.
const REPEATED_NS: u64 = 200_000_000;
/// A counter that jumps by more than this was set anew, or is none.
const LARGEST_GAP: i64 = 1000;

/// What a message says of an exposure: the same twice is the same exposure.
#[derive(Clone, Copy, PartialEq)]
struct Said {
    number: u32,
    stamp: u64,
    place: [i32; 3],
}

/// One camera's announcements.
struct Heard {
    source: Source,
    last: Trigger,
    last_number: u32,
    recent: HistoryBuf<(Said, u64), RECENT>,
}

/// What is remembered between announcements.
#[derive(Default)]
pub(super) struct Announcements {
    waiting: Deque<Trigger, WAITING>,
    /// The message by which the autopilot announces, and when it last did.
    believed: Option<(TriggerKind, u64)>,
    /// When anybody last announced an exposure.
    announced_ns: Option<u64>,
    heard: Vec<Heard, SOURCES>,
    own: Option<(u32, u64)>,
}

impl Announcements {
    pub(super) fn next(&mut self) -> Option<Trigger> {
        self.waiting.pop_front()
    }

    /// The boot clock restarted: counters may go on, times do not compare.
    pub(super) fn clear_times(&mut self) {
        for heard in &mut self.heard {
            heard.last.boot_ns = 0;
        }
    }
}

impl Autopilot {
    pub(super) fn on_feedback(&mut self, frame: &Frame<'_>, now_ns: u64) {
        if let Some(m) = frame.message::<CAMERA_FEEDBACK_DATA>() {
            let said = Said {
                number: m.img_idx.into(),
                stamp: m.time_usec,
                place: [m.lat, m.lng, m.alt_msl.to_bits() as i32],
            };
            let source = Source { component: frame.component(), camera: m.cam_idx };
            self.announce(source, TriggerKind::Feedback, said, self.place_us(m.time_usec), now_ns);
        }
    }

    pub(super) fn on_camera_trigger(&mut self, frame: &Frame<'_>, now_ns: u64) {
        if let Some(m) = frame.message::<CAMERA_TRIGGER_DATA>() {
            let said = Said { number: m.seq, stamp: m.time_usec, place: [0; 3] };
            let source = Source { component: frame.component(), camera: 0 };
            self.announce(source, TriggerKind::CameraTrigger, said, self.place_us(m.time_usec), now_ns);
        }
    }

    pub(super) fn on_image_captured(&mut self, frame: &Frame<'_>, now_ns: u64) {
        let Some(m) = frame.message::<CAMERA_IMAGE_CAPTURED_DATA>() else { return };
        if m.capture_result == MavBool::MAV_BOOL_FALSE {
            return;
        }
        // A camera with a component of its own has a boot clock of its own, but knows Unix time.
        let (stamp, boot_ns) = if frame.component() == self.ids.autopilot {
            (m.time_boot_ms.into(), Some(self.stamp(m.time_boot_ms, now_ns)))
        } else {
            (m.time_utc, self.place_us(m.time_utc))
        };
        let said = Said { number: m.image_index.max(0).unsigned_abs(), stamp, place: [m.lat, m.lon, m.alt] };
        let source = Source { component: frame.component(), camera: m.camera_id };
        self.announce(source, TriggerKind::ImageCaptured, said, boot_ns, now_ns);
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
        let said = Said { number: sequence, stamp: made_ns, place: [0; 3] };
        let source = Source { component: self.ids.autopilot, camera: 0 };
        self.announce(source, TriggerKind::Command, said, boot_ns, now_ns);
    }

    fn announce(&mut self, source: Source, kind: TriggerKind, said: Said, boot_ns: Option<u64>, now_ns: u64) {
        let held = |at_ns: u64| now_ns.saturating_sub(at_ns) < HOLD_NS;
        let own = TriggerKind::Command;
        let of_autopilot = source.component == self.ids.autopilot;
        // A stamped announcement is always better than our own.
        let told = if kind == own {
            self.announcements.announced_ns.is_some_and(held)
        } else {
            of_autopilot && self.announcements.believed.is_some_and(|(k, t)| k != kind && held(t))
        };
        if told {
            self.counters.exposures.trigger_duplicates += 1;
            return;
        }
        let plausible = |t: &u64| {
            let newest = self.boot.newest_ns().unwrap_or(*t);
            *t + MAX_PAST_NS > newest && *t < newest + MAX_FUTURE_NS
        };
        let placed = boot_ns.filter(plausible);
        let arrival = self.clock.to_boot_ns(now_ns).or(self.boot.newest_ns());
        let (boot_ns, sigma_ns) = match placed {
            Some(boot_ns) => (boot_ns, STAMPED_SIGMA_NS),
            None => (arrival.unwrap_or(now_ns), ARRIVAL_SIGMA_NS),
        };
        let time_ns = self.clock.to_companion_ns(boot_ns).unwrap_or(now_ns);
        let mut trigger = Trigger { source, sequence: said.number, boot_ns, time_ns, sigma_ns, kind };
        let announcements = &mut self.announcements;
        match announcements.heard.iter_mut().find(|h| h.source == source && h.last.kind == kind) {
            Some(heard) => {
                let same = |(before, at): &(Said, u64)| {
                    *before == said && (said.stamp != 0 || now_ns.saturating_sub(*at) < REPEATED_NS)
                };
                if heard.recent.as_slice().iter().any(same) {
                    self.counters.exposures.trigger_duplicates += 1;
                    return;
                }
                let step = if kind == TriggerKind::Feedback {
                    // 16 bits on the wire; the matcher wants a counter that does not wrap.
                    i64::from((said.number as u16).wrapping_sub(heard.last_number as u16) as i16)
                } else {
                    i64::from(said.number) - i64::from(heard.last_number)
                };
                let last = heard.last.sequence;
                let earlier = placed.is_some() && boot_ns < heard.last.boot_ns;
                let reordered = step < 0 && earlier && -step < LARGEST_GAP;
                trigger.sequence = match step {
                    // It was overtaken on the way.
                    _ if reordered => last.saturating_sub(step.unsigned_abs() as u32),
                    1..=LARGEST_GAP => last.saturating_add(step as u32),
                    // It does not count, or counts anew: one more.
                    _ => last.saturating_add(1),
                };
                heard.recent.write((said, now_ns));
                if !reordered {
                    self.counters.exposures.trigger_gaps += (step - 1).clamp(0, LARGEST_GAP).unsigned_abs();
                    (heard.last, heard.last_number) = (trigger, said.number);
                }
            }
            None => {
                let mut recent = HistoryBuf::new();
                recent.write((said, now_ns));
                if announcements.heard.is_full() {
                    announcements.heard.remove(0);
                }
                let _ = announcements.heard.push(Heard { source, last: trigger, last_number: said.number, recent });
            }
        }
        if placed.is_none() {
            self.counters.exposures.trigger_times_mended += 1;
        }
        if of_autopilot {
            announcements.believed = Some((kind, now_ns));
        }
        if kind != own {
            announcements.announced_ns = Some(now_ns);
        }
        self.counters.exposures.triggers += 1;
        self.landing.on_exposure();
        if announcements.waiting.is_full() {
            announcements.waiting.pop_front();
            self.counters.exposures.triggers_unmatched += 1;
        }
        let _ = announcements.waiting.push_back(trigger);
    }
}
