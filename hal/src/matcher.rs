//! Which picture belongs to which announced exposure.
//!
//! Three clues, none of them reliable alone: when the picture was complete (its latency is about constant), its number
//! (gaps when the camera skips an exposure), its own camera's clock (offset unknown, often whole seconds). Offsets are
//! learnt from pictures that were certain and dropped when they stop fitting. Fixed memory; what cannot be matched is
//! returned with the reason, never dropped silently.

mod clues;
#[cfg(feature = "std")]
pub mod reconcile;

use heapless::{Deque, HistoryBuf};

use crate::traits::PictureClues;
use crate::trigger::{Source, Trigger};
use clues::{Choice, Learnt, WITNESSES};

/// Exposures waiting for their picture.
const TRIGGERS: usize = 64;
/// Pictures waiting for their exposure.
const PICTURES: usize = 32;
/// Numbers of matched pictures remembered, to know a duplicate.
const REMEMBERED: usize = 64;
/// Before anything is learnt: so many older exposures without a picture mean that pictures may be late by any time.
const UNSURE: usize = 3;

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
    /// The same picture again.
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

struct Waiting<P> {
    clues: PictureClues,
    picture: P,
}

/// Matches pictures `P` (paths, handles) to exposures.
pub struct Matcher<P> {
    settings: MatcherSettings,
    triggers: Deque<Trigger, TRIGGERS>,
    pictures: Deque<Waiting<P>, PICTURES>,
    numbers: HistoryBuf<u64, REMEMBERED>,
    learnt: Learnt,
    newest_matched: Option<u32>,
    /// Newest exposure that was given up.
    given_up: Option<u32>,
}

enum Decision {
    Wait,
    Match(usize),
    /// As `Match`; the camera's numbers mean other exposures from here on.
    Shift(usize),
    Alone(Reason),
    /// As `Alone` without an exposure, because its number stands for this one.
    Absent(u64),
}

impl<P> Matcher<P> {
    /// An empty matcher.
    pub fn new(settings: MatcherSettings) -> Self {
        Self {
            settings,
            triggers: Deque::new(),
            pictures: Deque::new(),
            numbers: HistoryBuf::new(),
            learnt: Learnt::new(settings.latency_ns),
            newest_matched: None,
            given_up: None,
        }
    }

    /// Adds an announced exposure; returns the oldest one when there is no more room.
    pub fn push_trigger(&mut self, trigger: Trigger) -> Option<Outcome<P>> {
        let evicted = if self.triggers.is_full() { self.triggers.pop_front() } else { None };
        let _ = self.triggers.push_back(trigger);
        evicted.map(|trigger| Outcome::Trigger { trigger, reason: Reason::Overflow })
    }

    /// Takes out the exposures of all cameras but this one, and what was learnt from them.
    pub fn keep_only(&mut self, source: Source) {
        let others = self.triggers.iter().any(|t| t.source != source);
        for _ in 0..self.triggers.len() {
            if let Some(trigger) = self.triggers.pop_front().filter(|t| t.source == source) {
                let _ = self.triggers.push_back(trigger);
            }
        }
        if others {
            self.learnt = Learnt::new(self.settings.latency_ns);
            (self.newest_matched, self.given_up) = (None, None);
        }
    }

    /// Whether this exposure waits for its picture.
    pub fn awaits(&self, trigger: &Trigger) -> bool {
        self.triggers.iter().any(|t| t == trigger)
    }

    /// Adds a complete picture; returns the oldest one when there is no more room.
    pub fn push_picture(&mut self, clues: PictureClues, picture: P) -> Option<Outcome<P>> {
        let evicted = if self.pictures.is_full() { self.pictures.pop_front() } else { None };
        let _ = self.pictures.push_back(Waiting { clues, picture });
        evicted.map(|w| Outcome::Picture { picture: w.picture, clues: w.clues, reason: Reason::Overflow })
    }

    /// The next thing that can be decided at `now_ns`; call until `None`.
    pub fn poll(&mut self, now_ns: u64) -> Option<Outcome<P>> {
        for _ in 0..self.pictures.len() {
            let waiting = self.pictures.pop_front()?;
            match self.decide(&waiting.clues, now_ns) {
                Decision::Wait => {
                    // Same length as before the pop: there is room.
                    let _ = self.pictures.push_back(waiting);
                }
                Decision::Match(index) => return Some(self.matched(index, waiting)),
                Decision::Shift(index) => {
                    if let Some(trigger) = self.triggers.iter().nth(index) {
                        self.learnt.shifted(&waiting.clues, trigger);
                    }
                    return Some(self.matched(index, waiting));
                }
                Decision::Absent(sequence) => {
                    let given_up = self.given_up.is_some_and(|newest| sequence <= u64::from(newest))
                        && self.newest_matched.is_none_or(|newest| sequence > u64::from(newest));
                    if !given_up {
                        self.learnt.doubt_numbers();
                    }
                    let (picture, clues) = (waiting.picture, waiting.clues);
                    return Some(Outcome::Picture { picture, clues, reason: Reason::NoTrigger });
                }
                Decision::Alone(reason) => {
                    return Some(Outcome::Picture { picture: waiting.picture, clues: waiting.clues, reason });
                }
            }
        }
        let expired =
            self.triggers.front().is_some_and(|t| now_ns.saturating_sub(t.time_ns) > self.settings.patience_ns);
        let trigger = if expired { self.triggers.pop_front() } else { None };
        self.given_up = trigger.map(|t| t.sequence).or(self.given_up);
        trigger.map(|trigger| Outcome::Trigger { trigger, reason: Reason::NoPicture })
    }

    /// At the end of a mission: everything that waits is decided now; call until `None`.
    pub fn flush(&mut self) -> Option<Outcome<P>> {
        let end = u64::MAX;
        if let Some(outcome) = self.poll(end) {
            return Some(outcome);
        }
        if let Some(Waiting { picture, clues }) = self.pictures.pop_front() {
            return Some(Outcome::Picture { picture, clues, reason: Reason::NoTrigger });
        }
        // Exposures whose time lies in a future that will not come.
        let trigger = self.triggers.pop_front()?;
        Some(Outcome::Trigger { trigger, reason: Reason::NoPicture })
    }

    fn decide(&self, clues: &PictureClues, now_ns: u64) -> Decision {
        if clues.number.is_some_and(|n| self.numbers.as_slice().contains(&n)) {
            return Decision::Alone(Reason::Duplicate);
        }
        let age = now_ns.saturating_sub(clues.arrived_ns);
        match self.learnt.choose(clues, &self.triggers, self.settings.patience_ns) {
            Choice::Exposure { index, certain: false }
                if self.learnt.is_new() && (index >= UNSURE || self.given_up.is_some()) =>
            {
                // Taken for the newest exposure's, a late picture would shift all that follow.
                if age >= self.settings.settle_ns { Decision::Alone(Reason::NoTrigger) } else { Decision::Wait }
            }
            Choice::Exposure { index, certain } if certain || age >= self.settings.settle_ns => Decision::Match(index),
            Choice::Exposure { .. } => Decision::Wait,
            Choice::Contradiction { by_number, by_time, shift } => {
                let (agree, differ) = self.witnesses(shift);
                match () {
                    () if differ > 0 => Decision::Match(by_number),
                    // The picture asked about is out of the queue.
                    () if agree + 1 >= WITNESSES => Decision::Shift(by_time),
                    () if age > self.settings.patience_ns / 2 => Decision::Alone(Reason::Contradictory),
                    () => Decision::Wait,
                }
            }
            // An announcement may be late, but not much.
            Choice::Absent { sequence, by_time } if age > 4 * self.settings.settle_ns => {
                let newest = self.triggers.iter().map(|t| t.sequence).chain(self.newest_matched).max();
                match by_time {
                    // A number beyond everything announced: the camera was also released by hand.
                    Some(index) if newest.is_none_or(|n| sequence > u64::from(n)) => Decision::Shift(index),
                    // Its own exposure's announcement was lost or has been given up; no other one's place is taken.
                    _ => Decision::Absent(sequence),
                }
            }
            Choice::Absent { .. } => Decision::Wait,
            Choice::None if age > 4 * self.settings.settle_ns => Decision::Alone(Reason::NoTrigger),
            Choice::None => Decision::Wait,
        }
    }

    /// How many waiting pictures say that the camera skipped `shift` exposures, and how many say something else.
    fn witnesses(&self, shift: u64) -> (usize, usize) {
        let (mut agree, mut differ) = (0, 0);
        for waiting in &self.pictures {
            match self.learnt.choose(&waiting.clues, &self.triggers, self.settings.patience_ns) {
                Choice::Contradiction { shift: other, .. } if other == shift => agree += 1,
                Choice::None | Choice::Absent { .. } => {}
                _ => differ += 1,
            }
        }
        (agree, differ)
    }

    fn matched(&mut self, index: usize, waiting: Waiting<P>) -> Outcome<P> {
        // Once round the ring keeps the order of the others.
        let mut found = None;
        for i in 0..self.triggers.len() {
            match self.triggers.pop_front() {
                Some(trigger) if i == index => found = Some(trigger),
                Some(trigger) => drop(self.triggers.push_back(trigger)),
                None => {}
            }
        }
        let Some(trigger) = found else {
            return Outcome::Picture { picture: waiting.picture, clues: waiting.clues, reason: Reason::NoTrigger };
        };
        let late = self.newest_matched.is_some_and(|newest| trigger.sequence < newest);
        self.newest_matched = Some(self.newest_matched.unwrap_or(0).max(trigger.sequence));
        if let Some(number) = waiting.clues.number {
            self.numbers.write(number);
        }
        self.learnt.learn(&waiting.clues, &trigger, late);
        Outcome::Matched { trigger, picture: waiting.picture, clues: waiting.clues, late }
    }
}

#[cfg(test)]
mod tests;
