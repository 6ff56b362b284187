//! The exposures of a flight with their poses, and the pictures that found none of them.

use std::collections::VecDeque;

use crate::camera::Picture;
use crate::matcher::Reason;
use crate::matcher::reconcile::{Pairing, reconcile};
use crate::pose::{BodyPose, PoseError};
use crate::traits::PictureClues;
use crate::trigger::Trigger;
use crate::vehicle::Event;

/// Exposures of one flight that are kept with their pose, and pictures put aside: an hour at one a second.
pub(super) const EXPOSURES: usize = 4096;
pub(super) const PUT_ASIDE: usize = 4096;

/// What an exposure waits for.
#[derive(Clone, Copy, PartialEq)]
pub(super) enum Partner {
    /// Its picture.
    Awaited,
    /// Nothing: pictures of this camera are posed by their own time.
    Unneeded,
    /// Nothing: this was its picture.
    Found(PictureClues),
}

#[derive(Clone, Copy)]
pub(super) struct Exposure {
    pub(super) trigger: Trigger,
    /// Middle of the exposure, boot clock.
    pub(super) mid_boot_ns: u64,
    pub(super) heard_ns: u64,
    pub(super) pose: Option<Result<BodyPose, PoseError>>,
    pub(super) partner: Partner,
}

/// A picture that found no exposure yet.
pub(super) struct PutAside {
    pub(super) clues: PictureClues,
    pub(super) picture: Picture,
    pub(super) reason: Reason,
}

/// The exposures of the flight, and the pictures that found none.
pub(in crate::vehicle) struct Exposures {
    pub(super) all: VecDeque<Exposure>,
    pub(super) aside: Vec<PutAside>,
    pub(super) next_reconcile_ns: u64,
    /// Decided at the end of the flight and not reported yet.
    pub(super) closing: VecDeque<Event>,
}

impl Default for Exposures {
    fn default() -> Self {
        Self {
            all: VecDeque::with_capacity(EXPOSURES),
            aside: Vec::with_capacity(PUT_ASIDE),
            next_reconcile_ns: 0,
            closing: VecDeque::new(),
        }
    }
}

impl Exposures {
    /// One more exposure; the oldest one without a picture when there is no more room.
    pub(in crate::vehicle) fn push(
        &mut self,
        trigger: Trigger,
        mid_boot_ns: u64,
        heard_ns: u64,
        awaits_picture: bool,
    ) -> Option<Trigger> {
        let evicted = if self.all.len() >= EXPOSURES { self.all.pop_front() } else { None };
        let partner = if awaits_picture { Partner::Awaited } else { Partner::Unneeded };
        self.all.push_back(Exposure { trigger, mid_boot_ns, heard_ns, pose: None, partner });
        evicted.filter(|e| e.partner == Partner::Awaited).map(|e| e.trigger)
    }

    pub(super) fn find(&mut self, trigger: &Trigger) -> Option<&mut Exposure> {
        let same = |e: &&mut Exposure| e.trigger.sequence == trigger.sequence && e.trigger.boot_ns == trigger.boot_ns;
        self.all.iter_mut().rev().find(same)
    }

    pub(super) fn awaited(&self) -> impl Iterator<Item = &Exposure> {
        self.all.iter().filter(|e| e.partner == Partner::Awaited)
    }

    /// Whether pictures are still to come.
    pub(in crate::vehicle) fn await_pictures(&self) -> bool {
        self.awaited().next().is_some()
    }

    /// Everything is decided and reported.
    pub(in crate::vehicle) fn is_closed(&self) -> bool {
        self.closing.is_empty()
    }

    /// Pictures put aside and their exposures, all with all: those paired with at least this confidence.
    pub(super) fn reconcile(&mut self, least: f32) -> Vec<(Trigger, PutAside, f32)> {
        let triggers: Vec<Trigger> = self.awaited().map(|e| e.trigger).collect();
        let clues: Vec<PictureClues> = self.aside.iter().map(|a| a.clues).collect();
        let found = |e: &Exposure| if let Partner::Found(clues) = e.partner { Some((e.trigger, clues)) } else { None };
        let known: Vec<(Trigger, PictureClues)> = self.all.iter().filter_map(found).collect();
        let mut pairs = reconcile(&triggers, &clues, &known);
        pairs.retain(|p| p.confidence >= least);
        // From the back, so that indices stay valid.
        pairs.sort_unstable_by_key(|p| std::cmp::Reverse(p.picture));
        let take = |p: &Pairing| (triggers[p.exposure], self.aside.remove(p.picture), p.confidence);
        let mut taken: Vec<(Trigger, PutAside, f32)> = pairs.iter().map(take).collect();
        taken.sort_by_key(|t| t.0.boot_ns);
        taken
    }
}
