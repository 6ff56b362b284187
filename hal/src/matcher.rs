//! Which picture belongs to which announced exposure.
//!
//! Three clues, none of them reliable alone: when the picture was complete (its latency is about constant), its number
//! (gaps when the camera skips an exposure), its own camera's clock (offset unknown, often whole seconds). All that came lately is
//! aligned at once (module `alignment`): a picture is matched when the best assignment is better than every other one by a margin, which
//! is its confidence. Fixed memory; what cannot be matched is returned with the reason, never dropped silently.

mod alignment;
#[cfg(feature = "std")]
mod doubled;
#[cfg(feature = "std")]
pub mod landing;
#[cfg(feature = "std")]
pub mod reconcile;

use heapless::{HistoryBuf, Vec};

use crate::traits::PictureClues;
use crate::trigger::{Source, Trigger};
use alignment::{Band, Chain, Model, Rows, Slot, Verdict, confidence};

/// Exposures that are kept, and pictures, those that are matched with those that wait.
const EXPOSURES: usize = 128;
const PICTURES: usize = 48;
/// Exposures that come into question for one picture.
const WIDTH: usize = 64;
/// Numbers of matched pictures remembered, to know a duplicate.
const REMEMBERED: usize = 64;
/// The newest pictures are aligned again with everything that comes, however sure they were.
const FRESH: usize = 12;
/// A camera's clock that goes back by more was set.
const LATEST_NS: u64 = 60_000_000_000;
/// Announcements missing by their counter that are put on the list at most.
const GAP: u32 = 8;
/// What is less sure than this waits for the landing, which knows more.
const LEAST_IN_FLIGHT: f32 = 0.49;
/// What is less sure than this at the landing has no exposure.
pub const LEAST_CONFIDENCE: f32 = 0.465;
/// A confidence above this is sure.
#[cfg(feature = "std")]
pub const SURE: f32 = 0.9;
/// While something waits and nothing comes, it is aligned again after this.
const AGAIN_NS: u64 = 100_000_000;
/// Announcements that came late by some time may come this much later.
const LATER: f64 = 1.25;
/// Least and greatest variance of the difference of two latencies, and that before any was measured, ns².
const JITTER_NS2: core::ops::RangeInclusive<f32> = 2.5e15..=1.6e17;
const FIRST_JITTER_NS2: f32 = 4e16;
/// Weight of the newest latency.
const BLEND: f32 = 0.1;

/// What the matcher may assume.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct MatcherSettings {
    /// Expected time from exposure to complete picture, before any was measured, ns.
    pub latency_ns: u64,
    /// Pictures and exposures are given up after this, ns.
    pub patience_ns: u64,
    /// A picture waits this long for announcements still on their way, ns.
    pub settle_ns: u64,
}

impl Default for MatcherSettings {
    fn default() -> Self {
        Self { latency_ns: 200_000_000, patience_ns: 15_000_000_000, settle_ns: 250_000_000 }
    }
}

/// Why a picture or an exposure stayed alone.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Reason {
    /// No exposure was announced that could be this picture's.
    NoTrigger,
    /// No picture came for this exposure.
    NoPicture,
    /// A picture that was there before.
    Duplicate,
    /// Its number says one exposure, its time another, and no later picture settled it.
    Contradictory,
    /// More waited than there is room for.
    Overflow,
}

/// What became of a picture or an exposure.
#[derive(Clone, Debug, PartialEq)]
pub enum Outcome<P> {
    /// They belong together.
    Matched {
        /// The exposure.
        trigger: Trigger,
        /// The picture.
        picture: P,
        /// Its clues.
        clues: PictureClues,
        /// The picture came after one of a later exposure.
        late: bool,
        /// 0 … 1: by how much it is likelier than any other exposure.
        confidence: f32,
    },
    /// A picture without an exposure.
    Picture {
        /// The picture.
        picture: P,
        /// Its clues.
        clues: PictureClues,
        /// Why.
        reason: Reason,
    },
    /// An exposure without a picture.
    Trigger {
        /// The exposure.
        trigger: Trigger,
        /// Why.
        reason: Reason,
    },
}

/// What became of an exposure on the list.
#[derive(Clone, Copy, PartialEq)]
enum Fate {
    Waits,
    Matched,
    /// Its picture did not come in time.
    Missed,
}

/// A picture in the window.
struct Shot<P> {
    /// `None` once it was given out.
    picture: Option<P>,
    /// Compared with the numbers of earlier ones.
    checked: bool,
    verdict: Option<Verdict>,
}

/// The chain's rows.
struct Stored {
    bands: [Band; PICTURES],
    ahead: [f32; PICTURES * WIDTH],
    behind: [f32; PICTURES * WIDTH],
}

/// Matches pictures `P` (paths, handles) to exposures.
pub struct Matcher<P> {
    settings: MatcherSettings,
    exposures: Vec<Slot, EXPOSURES>,
    fates: Vec<Fate, EXPOSURES>,
    clues: Vec<PictureClues, PICTURES>,
    shots: Vec<Shot<P>, PICTURES>,
    rows: Stored,
    /// Pictures at the beginning of the window whose rows stand.
    settled: usize,
    numbers: HistoryBuf<u64, REMEMBERED>,
    newest_matched_ns: u64,
    latencies: HistoryBuf<i64, FRESH>,
    jitter_ns2: f32,
    /// Matched, exposures that stayed alone, pictures that stayed alone.
    counted: [f32; 3],
    /// Something came since the last look, and when to look again if nothing does.
    changed: bool,
    next_look_ns: u64,
}

impl<P> Matcher<P> {
    /// An empty matcher.
    pub fn new(settings: MatcherSettings) -> Self {
        Self {
            settings,
            exposures: Vec::new(),
            fates: Vec::new(),
            clues: Vec::new(),
            shots: Vec::new(),
            rows: Stored {
                bands: [Band::default(); PICTURES],
                ahead: [0.0; PICTURES * WIDTH],
                behind: [0.0; PICTURES * WIDTH],
            },
            settled: 0,
            numbers: HistoryBuf::new(),
            newest_matched_ns: 0,
            latencies: HistoryBuf::new(),
            jitter_ns2: FIRST_JITTER_NS2,
            counted: [0.0; 3],
            changed: false,
            next_look_ns: 0,
        }
    }

    /// What it may assume.
    pub fn settings(&self) -> MatcherSettings {
        self.settings
    }

    /// Adds an announced exposure; returns the oldest one when there is no more room.
    pub fn push_trigger(&mut self, trigger: Trigger) -> Option<Outcome<P>> {
        self.changed = true;
        let at = self.exposures.partition_point(|e| e.trigger.time_ns <= trigger.time_ns);
        let before = at.checked_sub(1).and_then(|at| self.exposures.get(at)).map(|e| e.trigger);
        let after = self.exposures.get(at).map(|e| e.trigger);
        // Its place was kept.
        let kept = [at.checked_sub(1), Some(at)]
            .into_iter()
            .flatten()
            .find(|at| self.exposures.get(*at).is_some_and(|e| !e.announced && e.trigger.sequence == trigger.sequence));
        if let Some(kept) = kept {
            self.exposures[kept] = Slot { trigger, heard_ns: 0, announced: true };
            return None;
        }
        // What the counter says was announced in between and did not come.
        if let Some(before) = before.filter(|_| after.is_none()) {
            for trigger in missing(&before, &trigger) {
                // Room for the one that was announced.
                if self.exposures.len() + 1 < EXPOSURES {
                    let end = self.exposures.len();
                    self.insert(end, Slot { trigger, heard_ns: 1, announced: false });
                }
            }
        }
        let evicted = if self.exposures.is_full() { self.forget_exposure() } else { None };
        let at = self.exposures.partition_point(|e| e.trigger.time_ns <= trigger.time_ns);
        self.insert(at, Slot { trigger, heard_ns: 0, announced: true });
        evicted.map(|trigger| Outcome::Trigger { trigger, reason: Reason::Overflow })
    }

    fn insert(&mut self, at: usize, slot: Slot) {
        let full = self.exposures.insert(at, slot).is_err() || self.fates.insert(at, Fate::Waits).is_err();
        debug_assert!(!full, "there is room");
        // Rows that stand are aligned with the list.
        for p in 0..self.settled {
            let band = &mut self.rows.bands[p];
            if band.from >= at {
                band.from += 1;
            } else if at < band.from + band.len {
                self.settled = p;
                break;
            }
        }
    }

    /// Takes the oldest exposure off the list; returns it when it still waited.
    fn forget_exposure(&mut self) -> Option<Trigger> {
        let (slot, fate) = (self.exposures.remove(0), self.fates.remove(0));
        for p in 0..self.settled {
            let band = &mut self.rows.bands[p];
            if band.from > 0 {
                band.from -= 1;
            } else if band.len > 0 {
                self.rows.ahead.copy_within(p * WIDTH + 1..p * WIDTH + band.len, p * WIDTH);
                band.len -= 1;
            }
        }
        for shot in &mut self.shots {
            if let Some(verdict) = &mut shot.verdict {
                verdict.exposure = verdict.exposure.and_then(|e| e.checked_sub(1));
                verdict.other = verdict.other.and_then(|e| e.checked_sub(1));
            }
        }
        (fate == Fate::Waits && slot.announced).then_some(slot.trigger)
    }

    /// Takes out the exposures of all cameras but this one, and what was learnt from them.
    pub fn keep_only(&mut self, source: Source) {
        if self.exposures.iter().all(|e| e.trigger.source == source) {
            return;
        }
        let mut kept = self.exposures.iter().map(|e| e.trigger.source == source);
        self.fates.retain(|_| kept.next().unwrap_or(false));
        drop(kept);
        self.exposures.retain(|e| e.trigger.source == source);
        // Pictures that were matched stand for nothing any more.
        let mut waits = self.shots.iter().map(|s| s.picture.is_some());
        self.clues.retain(|_| waits.next().unwrap_or(false));
        drop(waits);
        self.shots.retain(|s| s.picture.is_some());
        (self.settled, self.newest_matched_ns, self.latencies) = (0, 0, HistoryBuf::new());
        (self.jitter_ns2, self.counted, self.changed) = (FIRST_JITTER_NS2, [0.0; 3], true);
    }

    /// Whether this exposure waits for its picture.
    pub fn awaits(&self, trigger: &Trigger) -> bool {
        self.exposures.iter().zip(&self.fates).any(|(e, fate)| e.trigger == *trigger && *fate == Fate::Waits)
    }

    /// Adds a complete picture; returns the oldest one when there is no more room.
    pub fn push_picture(&mut self, clues: PictureClues, picture: P) -> Option<Outcome<P>> {
        self.changed = true;
        let evicted = if self.shots.is_full() { self.forget_picture() } else { None };
        // In the order in which they were taken.
        let mut at = self.clues.len();
        while at > 0 && is_late(&self.clues[at - 1], &clues) {
            at -= 1;
        }
        self.settled = self.settled.min(at);
        let shot = Shot { picture: Some(picture), checked: false, verdict: None };
        let full = self.clues.insert(at, clues).is_err() || self.shots.insert(at, shot).is_err();
        debug_assert!(!full, "there is room");
        evicted
    }

    fn forget_picture(&mut self) -> Option<Outcome<P>> {
        let (clues, shot) = (self.clues.remove(0), self.shots.remove(0));
        self.rows.bands.copy_within(1.., 0);
        self.rows.ahead.copy_within(WIDTH.., 0);
        self.settled = self.settled.saturating_sub(1);
        shot.picture.map(|picture| Outcome::Picture { picture, clues, reason: Reason::Overflow })
    }

    /// The next thing that can be decided at `now_ns`; call until `None`.
    pub fn poll(&mut self, now_ns: u64) -> Option<Outcome<P>> {
        for slot in self.exposures.iter_mut().filter(|e| e.heard_ns == 0) {
            slot.heard_ns = now_ns.max(1);
        }
        if let Some(duplicate) = self.duplicate() {
            return Some(duplicate);
        }
        if self.changed || now_ns >= self.next_look_ns {
            self.look(now_ns);
        }
        for p in 0..self.shots.len() {
            if let Some(outcome) = self.decide(p, now_ns) {
                return Some(outcome);
            }
        }
        let patience = self.settings.patience_ns;
        let expired = |(e, fate): (&Slot, &Fate)| {
            e.announced && *fate == Fate::Waits && now_ns.saturating_sub(e.trigger.time_ns) > patience
        };
        let at = self.exposures.iter().zip(&self.fates).position(expired)?;
        self.fates[at] = Fate::Missed;
        self.counted[1] += 1.0;
        Some(Outcome::Trigger { trigger: self.exposures[at].trigger, reason: Reason::NoPicture })
    }

    /// At the end of a mission: everything that waits is decided now; call until `None`.
    pub fn flush(&mut self) -> Option<Outcome<P>> {
        if let Some(outcome) = self.poll(u64::MAX) {
            return Some(outcome);
        }
        let waits = self.shots.iter().position(|s| s.picture.is_some());
        if let Some((picture, clues)) = waits.and_then(|p| Some((self.shots[p].picture.take()?, self.clues[p]))) {
            return Some(Outcome::Picture { picture, clues, reason: Reason::NoTrigger });
        }
        // Exposures whose time lies in a future that will not come.
        let at = self.exposures.iter().zip(&self.fates).position(|(e, fate)| e.announced && *fate == Fate::Waits)?;
        self.fates[at] = Fate::Missed;
        Some(Outcome::Trigger { trigger: self.exposures[at].trigger, reason: Reason::NoPicture })
    }

    /// A picture that came before.
    fn duplicate(&mut self) -> Option<Outcome<P>> {
        let at = self.shots.iter().position(|s| !s.checked)?;
        self.shots[at].checked = true;
        let number = self.clues[at].number;
        let again = |(p, c): (usize, &PictureClues)| p != at && self.shots[p].checked && c.number == number;
        let waits = number.is_some() && self.clues.iter().enumerate().any(again);
        if waits || number.is_some_and(|n| self.numbers.as_slice().contains(&n)) {
            let (clues, shot) = (self.clues.remove(at), self.shots.remove(at));
            self.settled = self.settled.min(at);
            let picture = shot.picture?;
            return Some(Outcome::Picture { picture, clues, reason: Reason::Duplicate });
        }
        self.duplicate()
    }

    fn model(&self, now_ns: u64) -> Model {
        let announced = self.exposures.iter().filter(|e| e.announced);
        let late_ns = announced.map(|e| e.heard_ns.saturating_sub(e.trigger.time_ns)).max();
        let open_ns =
            late_ns.map_or(u64::MAX, |late| ((late as f64 * LATER) as u64).saturating_add(self.settings.settle_ns));
        let patience = self.settings.patience_ns;
        Model {
            exposure_alone: rarity(self.counted[1], self.counted[0]),
            picture_alone: rarity(self.counted[2], self.counted[0])
                + alignment::chance(alignment::interval(&self.exposures), self.jitter_ns2),
            jitter_ns2: self.jitter_ns2,
            latency_ns: self.settings.latency_ns.min(i64::MAX as u64) as i64,
            usual_ns: self.usual(),
            reach_ns: patience.min(i64::MAX as u64) as i64,
            stride: alignment::stride(&self.clues),
            horizon_ns: if now_ns == u64::MAX { now_ns } else { now_ns.saturating_sub(open_ns.min(patience)) },
            now_ns,
        }
    }

    /// The middle one of the newest latencies.
    fn usual(&self) -> Option<i64> {
        let mut newest: Vec<i64, FRESH> = self.latencies.oldest_ordered().copied().collect();
        newest.sort_unstable();
        newest.get(newest.len() / 2).copied().filter(|_| newest.is_full())
    }

    /// Aligns what is on the lists anew.
    fn look(&mut self, now_ns: u64) {
        (self.changed, self.next_look_ns) = (false, now_ns.saturating_add(AGAIN_NS));
        if self.shots.iter().all(|s| s.picture.is_none()) {
            return;
        }
        let model = self.model(now_ns);
        let chain = Chain { model, exposures: &self.exposures, pictures: &self.clues };
        let Stored { bands, ahead, behind } = &mut self.rows;
        let mut rows = Rows { width: WIDTH, bands, ahead, behind };
        chain.run(&mut rows, self.settled);
        for (p, shot) in self.shots.iter_mut().enumerate().filter(|(_, s)| s.picture.is_some()) {
            shot.verdict = Some(chain.verdict(&rows, self.settled, p));
        }
        let decided = self.shots.iter().take_while(|s| s.picture.is_none()).count();
        self.settled = self.settled.max(decided.min(self.shots.len().saturating_sub(FRESH)));
    }

    /// What becomes of a picture, when that is known.
    fn decide(&mut self, p: usize, now_ns: u64) -> Option<Outcome<P>> {
        let verdict = self.shots[p].verdict.filter(|_| self.shots[p].picture.is_some())?;
        let clues = self.clues[p];
        let (sure, age) = (confidence(verdict.margin), now_ns.saturating_sub(clues.arrived_ns));
        let open = clues.arrived_ns > self.model(now_ns).horizon_ns;
        match verdict.exposure.filter(|e| self.exposures[*e].announced) {
            // All pictures come too late, as it seems: the landing tells.
            _ if self.counted[0] == 0.0 && self.counted[1] > 0.0 && !open => self.alone(p, Reason::NoTrigger),
            Some(e) if self.fates[e] == Fate::Waits && sure >= LEAST_IN_FLIGHT => self.matched(p, e, sure),
            Some(_) if age > self.settings.patience_ns / 2 => self.alone(p, Reason::Contradictory),
            None if !open && age > self.settings.patience_ns / 2 => self.alone(p, Reason::NoTrigger),
            _ => None,
        }
    }

    fn alone(&mut self, p: usize, reason: Reason) -> Option<Outcome<P>> {
        self.counted[2] += 1.0;
        Some(Outcome::Picture { picture: self.shots[p].picture.take()?, clues: self.clues[p], reason })
    }

    fn matched(&mut self, p: usize, exposure: usize, confidence: f32) -> Option<Outcome<P>> {
        let (trigger, clues) = (self.exposures[exposure].trigger, self.clues[p]);
        let picture = self.shots[p].picture.take()?;
        self.fates[exposure] = Fate::Matched;
        self.counted[0] += 1.0;
        let late = trigger.time_ns < self.newest_matched_ns;
        self.newest_matched_ns = self.newest_matched_ns.max(trigger.time_ns);
        if let Some(number) = clues.number {
            self.numbers.write(number);
        }
        if !late {
            let latency = clues.arrived_ns.wrapping_sub(trigger.time_ns) as i64;
            if let Some(before) = self.latencies.recent() {
                let off = latency.saturating_sub(*before) as f32;
                let jitter = self.jitter_ns2 + BLEND * ((off * off).min(*JITTER_NS2.end()) - self.jitter_ns2);
                self.jitter_ns2 = jitter.clamp(*JITTER_NS2.start(), *JITTER_NS2.end());
            }
            self.latencies.write(latency);
        }
        Some(Outcome::Matched { trigger, picture, clues, late, confidence })
    }
}

/// Whether a picture was taken before one that came before it, by its number or the camera's clock.
fn is_late(before: &PictureClues, own: &PictureClues) -> bool {
    match before.number.zip(own.number) {
        Some((before, own)) => before.checked_sub(own).is_some_and(|behind| behind < PICTURES as u64),
        None => before.camera_ns.zip(own.camera_ns).is_some_and(|(before, at)| {
            let behind = before.saturating_sub(at);
            behind > own.camera_resolution_ns && behind < LATEST_NS
        }),
    }
}

/// Exposures between two that the counter tells of, at times in between: their announcements were lost.
fn missing(before: &Trigger, after: &Trigger) -> impl Iterator<Item = Trigger> {
    let (before, after) = (*before, *after);
    let missing = after.sequence.saturating_sub(before.sequence).saturating_sub(1);
    let missing = if missing < GAP { missing } else { 0 };
    (1..=missing).map(move |k| {
        let part = |from: u64, to: u64| from + to.saturating_sub(from) / u64::from(missing + 1) * u64::from(k);
        Trigger {
            sequence: before.sequence + k,
            boot_ns: part(before.boot_ns, after.boot_ns),
            time_ns: part(before.time_ns, after.time_ns),
            ..after
        }
    })
}

/// Negative logarithm of how often something stays alone, of which `alone` did and `matched` did not.
pub(crate) fn rarity(alone: f32, matched: f32) -> f32 {
    // Before anything is known: one in ten.
    -libm::logf(((alone + 0.7) / (alone + matched + 7.0)).clamp(0.01, 0.3))
}

#[cfg(test)]
mod tests;
