//! Which of an aircraft's cameras takes the pictures that come here: the mission says, or the one whose exposures have the rhythm
//! of the pictures. Exposures of several are never mixed: while it is not known, exposures and pictures wait.

use heapless::{Deque, Vec};

use crate::camera::Picture;
use crate::traits::PictureClues;
use crate::trigger::{Source, Trigger, TriggerKind};

/// Cameras told apart, and exposures of all of them that wait for the decision.
const CAMERAS: usize = 8;
const TRIGGERS: usize = 256;
/// Pictures that wait for the decision; with so many, it is made.
const PICTURES: usize = 32;
/// A rhythm shows in so many pictures at least; with `ENOUGH` they have said what they can.
const LEAST: usize = 4;
const ENOUGH: usize = 16;
/// A picture may be complete this much earlier or later than the others, after its exposure.
const JITTER_NS: i64 = 250_000_000;
/// Latencies that come into question, as in the matcher.
const EARLY_NS: i64 = 300_000_000;
/// The best camera must explain this many pictures and exposures more than the next, or this share of the pictures.
const MARGIN: f64 = 1.5;
const MARGIN_SHARE: f64 = 0.2;
/// Exposures of two cameras this close together are one for the pose: at 20 m/s a metre.
const SAME_NS: u64 = 50_000_000;
const SAME_SHARE: f64 = 0.8;
/// For two cameras of one rhythm, of both of which a fifth may be lost.
const ECHO_SHARE: f64 = 0.6;
/// Of fewer exposures nobody can say whether two cameras have one rhythm.
const TELLING: usize = 8;
/// Confidence of pictures whose camera could not be told.
const UNDECIDED: f32 = 0.5;

/// What to do with an exposure or a picture.
#[derive(Debug, PartialEq)]
pub(super) enum Passage<T> {
    /// It goes to the matcher.
    Through(T),
    /// It waits until the camera is known.
    Waits,
    /// It is another camera's.
    Other,
}

/// The camera that was decided for.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Decision {
    pub(super) source: Source,
    pub(super) confidence: f32,
}

/// The cameras heard.
pub(super) struct Cameras {
    /// Index of the mission.
    index: Option<u8>,
    decided: Option<Decision>,
    heard: Vec<Source, CAMERAS>,
    /// The newest exposures of all.
    triggers: Deque<Trigger, TRIGGERS>,
    /// Pictures that wait, and when earlier ones came.
    pictures: Deque<(PictureClues, Picture), PICTURES>,
    patience_ns: u64,
}

impl Cameras {
    pub(super) fn new(index: Option<u8>, patience_ns: u64) -> Self {
        Self { index, decided: None, heard: Vec::new(), triggers: Deque::new(), pictures: Deque::new(), patience_ns }
    }

    /// How sure it is that exposures are of the right camera.
    pub(super) fn confidence(&self) -> f32 {
        self.decided.map_or(1.0, |d| d.confidence)
    }

    /// Cameras heard so far.
    pub(super) fn heard(&self) -> &[Source] {
        &self.heard
    }

    fn waits(&self) -> bool {
        self.decided.is_none() && self.heard.len() > 1
    }

    /// An exposure. What passed before a second camera was heard stays with the first, and is judged with the rest.
    pub(super) fn take_trigger(&mut self, trigger: Trigger) -> Passage<Trigger> {
        let source = trigger.source;
        // Our own exposures have no index.
        let wanted = self.index.is_none_or(|index| index == source.camera) || trigger.kind == TriggerKind::Command;
        if !wanted || self.decided.is_some_and(|d| d.source != source) {
            return Passage::Other;
        }
        if !self.heard.contains(&source) && self.heard.push(source).is_err() {
            return Passage::Other; // a ninth camera
        }
        if self.decided.is_some() {
            return Passage::Through(trigger);
        }
        if self.triggers.is_full() {
            self.triggers.pop_front();
        }
        let _ = self.triggers.push_back(trigger);
        if self.waits() { Passage::Waits } else { Passage::Through(trigger) }
    }

    /// A picture.
    pub(super) fn take_picture(&mut self, clues: PictureClues, picture: Picture) -> Passage<(PictureClues, Picture)> {
        if !self.waits() {
            return Passage::Through((clues, picture));
        }
        match self.pictures.push_back((clues, picture)) {
            Ok(()) => Passage::Waits,
            Err(back) => Passage::Through(back),
        }
    }

    /// The camera, when what waits says which; at the end of a flight in any case.
    pub(super) fn decide(&mut self, at_end: bool) -> Option<Decision> {
        if !self.waits() || (self.pictures.len() < LEAST && !at_end) {
            return None;
        }
        let mut arrived: Vec<u64, PICTURES> = self.pictures.iter().map(|(clues, _)| clues.arrived_ns).collect();
        arrived.sort_unstable();
        let mut ranked: Vec<(f64, Source), CAMERAS> =
            self.heard.iter().map(|source| (self.misfit(*source, &arrived), *source)).collect();
        ranked.sort_unstable_by(|a, b| a.0.total_cmp(&b.0).then(a.1.cmp(&b.1)));
        let (best, mut source) = *ranked.first()?;
        let margin = MARGIN.max(MARGIN_SHARE * arrived.len() as f64);
        let mut certain = true;
        for (misfit, other) in &ranked[1..] {
            // Two that expose together give the same poses: the first one's count.
            if self.expose_together(source, *other) {
                source = source.min(*other);
            } else {
                certain &= misfit - best >= margin && !self.is_echo(source, *other);
            }
        }
        if !certain && arrived.len() < ENOUGH && !at_end {
            return None;
        }
        let decision = Decision { source, confidence: if certain { 1.0 } else { UNDECIDED } };
        self.decided = Some(decision);
        Some(decision)
    }

    /// The next of what waited for the decision.
    pub(super) fn next_trigger(&mut self) -> Option<Trigger> {
        self.triggers.pop_front()
    }

    /// As [`Cameras::next_trigger`]; exposures are to be fetched first.
    pub(super) fn next_picture(&mut self) -> Option<(PictureClues, Picture)> {
        self.pictures.pop_front()
    }

    fn times(&self, source: Source) -> Vec<u64, TRIGGERS> {
        let mut times: Vec<u64, TRIGGERS> =
            self.triggers.iter().filter(|t| t.source == source).map(|t| t.time_ns).collect();
        times.sort_unstable();
        times
    }

    fn expose_together(&self, a: Source, b: Source) -> bool {
        let (a, b) = (self.times(a), self.times(b));
        let near = |of: &u64, among: &[u64]| among.iter().any(|t| t.abs_diff(*of) <= SAME_NS);
        let share = |of: &[u64], among: &[u64]| {
            of.iter().filter(|t| near(t, among)).count() as f64 >= SAME_SHARE * of.len() as f64
        };
        share(&a, &b) && share(&b, &a)
    }

    /// Two of the same rhythm, one so much later than the other: what was lost of each says nothing of whose the pictures are.
    fn is_echo(&self, a: Source, b: Source) -> bool {
        let (a, b) = (self.times(a), self.times(b));
        let (fewer, more) = (a.len().min(b.len()), a.len().max(b.len()));
        if fewer < TELLING {
            return more <= 2 * fewer;
        }
        let near = |at: i64, among: &[u64]| among.iter().any(|t| (*t as i64 - at).unsigned_abs() <= SAME_NS);
        let share = |of: &[u64], among: &[u64], later: i64| {
            of.iter().filter(|t| near(**t as i64 + later, among)).count() as f64 >= ECHO_SHARE * of.len() as f64
        };
        let shifts = a.iter().take(LEAST).flat_map(|from| b.iter().map(move |to| *to as i64 - *from as i64));
        let possible = shifts.filter(|later| later.unsigned_abs() <= self.patience_ns);
        possible.into_iter().any(|later| share(&a, &b, later) && share(&b, &a, -later))
    }

    /// How many pictures and exposures stay alone when the pictures are this camera's, at the latency that suits it best.
    fn misfit(&self, source: Source, arrived: &[u64]) -> f64 {
        let times = self.times(source);
        let pairs = arrived.iter().take(LEAST).flat_map(|at| times.iter().map(move |t| at.wrapping_sub(*t) as i64));
        let possible = pairs.filter(|latency| (-EARLY_NS..=self.patience_ns as i64).contains(latency));
        possible.map(|latency| alone(&times, arrived, latency)).fold(2.0 * arrived.len() as f64, f64::min)
    }
}

/// Pictures and exposures that stay alone at this latency, and a little for what the others are off.
fn alone(times: &[u64], arrived: &[u64], latency: i64) -> f64 {
    let (Some(first), Some(last)) = (arrived.first(), arrived.last()) else { return 0.0 };
    let exposed = |at: u64| at as i64 - latency;
    let within = |t: &u64| (exposed(*first) - JITTER_NS..=exposed(*last) + JITTER_NS).contains(&(*t as i64));
    let expected = times.iter().filter(|t| within(t)).count();
    let (mut next, mut matched, mut off) = (0, 0usize, 0.0);
    for at in arrived {
        let at = exposed(*at);
        while times.get(next).is_some_and(|t| (*t as i64) < at - JITTER_NS) {
            next += 1;
        }
        if let Some(t) = times.get(next).filter(|t| (**t as i64) <= at + JITTER_NS) {
            off += (*t as i64 - at).abs() as f64 / JITTER_NS as f64;
            matched += 1;
            next += 1;
        }
    }
    (arrived.len() - matched) as f64 + expected.saturating_sub(matched) as f64 + off / arrived.len() as f64
}

#[cfg(test)]
mod tests;
