//! The exposures of a flight with their poses, and the pictures that found none of them.

use std::collections::VecDeque;

use super::{PENDING, PendingPicture};
use crate::camera::Picture;
use crate::matcher::reconcile::{Pairing, reconcile};
use crate::matcher::{Matcher, MatcherSettings, Outcome, Reason, landing};
use crate::mavlink::dialect::MavSeverity;
use crate::pose::{BodyPose, PoseError};
use crate::traits::PictureClues;
use crate::trigger::Trigger;
use crate::vehicle::Event;
use crate::vehicle::cameras::{Cameras, Decision};

/// Exposures of one flight that are kept with their pose, and pictures put aside: an hour at one a second.
pub(super) const EXPOSURES: usize = 4096;
pub(super) const PUT_ASIDE: usize = 4096;

/// Confidence of a match by vote at most.
const BY_VOTE: f32 = 0.85;
/// In flight votes count beside so many pictures that were matched.
const LEAST_KNOWN: usize = 8;

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

/// What the whole flight says when it is over.
pub(super) struct Landing {
    /// Pictures put aside that found their exposure, with the confidence of it.
    pub(super) pairs: Vec<(Trigger, PutAside, f32)>,
    /// Pictures found in flight that it says another exposure of.
    revised: usize,
    /// Pictures that have an exposure, those of them that fit another one nearly as well, and whether that is the flight as a whole.
    posed: usize,
    doubtful: usize,
    is_ambiguous: bool,
    /// All of them may belong to exposures one earlier or later.
    may_be_shifted: bool,
}

impl Landing {
    /// What the pilot is told where poses are in doubt, and how urgently; the log says more.
    pub(super) fn doubts(&self) -> impl Iterator<Item = (MavSeverity, String)> + use<> {
        let Self { revised, posed, doubtful, .. } = *self;
        if revised > 0 {
            tracing::warn!("the whole flight says another exposure of {revised} pictures that were posed in flight");
        }
        let many = format!("{doubtful} of {posed} pictures fit other exposures nearly as well");
        if self.is_ambiguous {
            tracing::warn!(
                "the flight is ambiguous: {many}; geotags.csv holds their confidence \
                 (link.picture_latency_ms, numbers in file names or EXIF times tell them apart)"
            );
        } else if doubtful > 0 {
            tracing::warn!("ambiguous: {many}; geotags.csv holds their confidence");
        }
        let ambiguous = format!("dgtr: ambiguous flight, {doubtful} of {posed} unsure");
        let ambiguous = match (self.is_ambiguous, self.may_be_shifted) {
            (true, _) => Some((MavSeverity::MAV_SEVERITY_WARNING, ambiguous)),
            // A whole flight of an even rhythm looks like that as well.
            (false, true) => Some((MavSeverity::MAV_SEVERITY_NOTICE, ambiguous)),
            (false, false) => None,
        };
        let other = || format!("dgtr: {revised} pictures may have another exposure's pose");
        let other = (revised > 0).then(|| (MavSeverity::MAV_SEVERITY_WARNING, other()));
        ambiguous.into_iter().chain(other)
    }
}

/// The exposures of the flight, and the pictures that found none.
pub(in crate::vehicle) struct Exposures {
    pub(super) all: VecDeque<Exposure>,
    pub(super) aside: Vec<PutAside>,
    /// Clues of pictures that were reported as having no exposure, the first [`PUT_ASIDE`].
    alone: Vec<PictureClues>,
    pub(super) next_reconcile_ns: u64,
    /// Matched pictures that wait for their pose.
    pub(in crate::vehicle) pending: VecDeque<PendingPicture>,
    /// Whose they are.
    pub(in crate::vehicle) cameras: Cameras,
    /// Decided at the end of the flight and not reported yet.
    pub(super) closing: VecDeque<Event>,
}

impl Exposures {
    /// None yet.
    pub(in crate::vehicle) fn new(cameras: Cameras) -> Self {
        Self {
            cameras,
            all: VecDeque::with_capacity(EXPOSURES),
            aside: Vec::with_capacity(PUT_ASIDE),
            alone: Vec::with_capacity(PUT_ASIDE),
            next_reconcile_ns: 0,
            pending: VecDeque::with_capacity(PENDING),
            closing: VecDeque::new(),
        }
    }
}

fn is_same(a: &Trigger, b: &Trigger) -> bool {
    (a.source, a.sequence, a.boot_ns) == (b.source, b.sequence, b.boot_ns)
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
        self.all.iter_mut().rev().find(|e| is_same(&e.trigger, trigger))
    }

    /// Whether this exposure waits for its picture.
    fn awaits(&self, trigger: &Trigger) -> bool {
        self.awaited().any(|e| is_same(&e.trigger, trigger))
    }

    /// Several cameras are heard: what waited goes to the matcher as soon as it is known whose pictures come. Returned is what
    /// the matcher had no room for.
    pub(in crate::vehicle) fn choose_camera(
        &mut self,
        matcher: &mut Matcher<Picture>,
        at_end: bool,
    ) -> Vec<Outcome<Picture>> {
        let mut crowded_out = Vec::new();
        let Some(Decision { source, confidence }) = self.cameras.decide(at_end) else { return crowded_out };
        let others = self.cameras.heard().iter().filter(|s| **s != source);
        let others = others.map(ToString::to_string).collect::<Vec<_>>().join(", ");
        if confidence < 1.0 {
            tracing::warn!(
                "pictures fit {source} as well as {others}; they are posed by the first with confidence {confidence:.1} \
                 ([camera] index says which)"
            );
        } else {
            tracing::info!("pictures are those of {source}; exposures of {others} are left out");
        }
        matcher.keep_only(source);
        let other = |e: &&mut Exposure| e.trigger.source != source && e.partner == Partner::Awaited;
        self.all.iter_mut().filter(other).for_each(|e| e.partner = Partner::Unneeded);
        while let Some(trigger) = self.cameras.next_trigger() {
            if trigger.source == source && self.awaits(&trigger) && !matcher.awaits(&trigger) {
                crowded_out.extend(matcher.push_trigger(trigger));
            }
        }
        while let Some((clues, picture)) = self.cameras.next_picture() {
            crowded_out.extend(matcher.push_picture(clues, picture));
        }
        crowded_out
    }

    pub(super) fn awaited(&self) -> impl Iterator<Item = &Exposure> {
        self.all.iter().filter(|e| e.partner == Partner::Awaited)
    }

    /// Remembers a picture that is reported as having no exposure: at the landing it shows where the flight's pictures begin and end.
    pub(super) fn stays_alone(&mut self, clues: PictureClues) {
        if self.alone.len() < PUT_ASIDE {
            self.alone.push(clues);
        }
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
        // Half a flight alone tells no offset: what is matched must agree on it.
        if least > 0.0 && known.len() < LEAST_KNOWN {
            return Vec::new();
        }
        let mut pairs = reconcile(&triggers, &clues, &known);
        // Behind the newest match a number may stand for another exposure: one that was not heard of, after one that was not taken.
        let newest =
            if least > 0.0 { known.iter().filter_map(|(_, clues)| clues.number).max() } else { Some(u64::MAX) };
        pairs.retain(|p| {
            p.confidence >= least && clues[p.picture].number.is_none_or(|n| newest.is_some_and(|newest| n < newest))
        });
        // A vote between clocks or numbers cannot tell one interval from the next where the rhythm is regular.
        pairs.iter_mut().for_each(|p| p.confidence = p.confidence.min(BY_VOTE));
        self.take(&triggers, pairs)
    }

    /// Aligns the whole flight at its end.
    pub(super) fn align(&mut self, settings: MatcherSettings) -> Landing {
        let paired = self.all.iter().filter(|e| e.partner != Partner::Unneeded);
        let mut triggers: Vec<Trigger> = paired.map(|e| e.trigger).collect();
        triggers.sort_by_key(|t| t.time_ns);
        let aside = self.aside.iter().map(|a| a.clues);
        let clues: Vec<PictureClues> = aside.chain(self.alone.iter().copied()).collect();
        let found = |e: &Exposure| if let Partner::Found(clues) = e.partner { Some((e.trigger, clues)) } else { None };
        let known: Vec<(Trigger, PictureClues)> = self.all.iter().filter_map(found).collect();
        let mut settled = landing::settle(&triggers, &clues, &known, settings);
        settled.pairs.retain(|pair| pair.picture < self.aside.len());
        let (revised, posed, doubtful) = (settled.revised.len(), settled.posed, settled.doubtful);
        let (is_ambiguous, may_be_shifted) = (settled.is_ambiguous(), settled.may_be_shifted());
        let pairs = self.take(&triggers, settled.pairs);
        Landing { pairs, revised, posed, doubtful, is_ambiguous, may_be_shifted }
    }

    fn take(&mut self, triggers: &[Trigger], mut pairs: Vec<Pairing>) -> Vec<(Trigger, PutAside, f32)> {
        // From the back, so that indices stay valid.
        pairs.sort_unstable_by_key(|p| std::cmp::Reverse(p.picture));
        let take = |p: &Pairing| (triggers[p.exposure], self.aside.remove(p.picture), p.confidence);
        let mut taken: Vec<(Trigger, PutAside, f32)> = pairs.iter().map(take).collect();
        taken.sort_by_key(|t| t.0.boot_ns);
        taken
    }
}
