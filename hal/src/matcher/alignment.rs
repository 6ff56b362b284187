//! Which pictures belong to which exposures, all of a stretch of flight at once: an assignment that keeps their order, with gaps
//! on both sides and a latency that nobody knows. Beside the best assignment stands, for every picture, how much dearer the best
//! one is that says something else of it: their distance is the confidence.
//!
//! A chain over the pictures (Viterbi's algorithm, forwards and backwards): the cost of an assignment is the negative logarithm
//! of its likelihood. It pays for exposures and pictures that stay alone, for latencies that change, for numbers that do not
//! follow the exposures and for a camera's clock that runs otherwise than the autopilot's.

use crate::traits::PictureClues;
use crate::trigger::Trigger;

/// Exposures may be announced this much after the picture was complete (clock mapping and link delay).
pub(super) const EARLY_NS: i64 = 300_000_000;
/// Dearer than every assignment.
const NEVER: f32 = 1e9;
/// So many pictures in a row may stay alone without breaking the chain.
const JUMP: usize = 5;
/// A chain that breaks begins anew at this cost.
const BREAK: f32 = 12.0;
/// Exposures at the beginning or the end without any picture cost no more together: the camera was not ready.
const UNREADY: f32 = 10.0;
/// The first picture or exposure that stays alone at the beginning or the end costs no more, however rarely one does in between: that
/// is where cameras and links are started and stopped. One in ten.
const AT_THE_END: f32 = 2.3;
/// Latencies are expected to lie this far from the mission's, and what the unlikeliest costs.
const LATENCY_SCALE_NS: f32 = 2.0e9;
const UNLIKELY_LATENCY: f32 = 8.0;
/// What a latency costs that jumps to another one, and for each second of the jump.
const JUMP_NS: f32 = 0.25e9;
/// What a latency costs that falls while the numbers go on: a computer has caught up.
const CAUGHT_UP_NS: f32 = 1e9;
const JUMPED: f32 = 2.5;
/// What a latency costs at most that is not the usual one, and how far from it is unusual, ns.
const UNUSUAL: f32 = 0.3;
const USUAL_NS: f32 = 0.15e9;
/// A single picture that is late, by its number or its clock, and what it costs for each second. Late ones come at any moment; that one
/// comes just when the next exposure's picture would is a coincidence (see [`chance`]).
const LATE: f32 = 2.0;
const LATE_NS: f32 = 8e9;
/// A picture that stays alone although it is, by its number or its clock, that of an announced exposure.
const DISOWNED: f32 = 4.0;
/// A number that does not follow the exposures: the camera skipped one, or was released by hand.
const SKIPPED: f32 = 3.0;
const BY_HAND: f32 = 3.0;
const MISCOUNTED_MOST: f32 = 8.0;
/// A number that explains a gap leaves this of what the missing picture costs.
const COUNTED_GAP: f32 = 0.5;
/// A camera's clock that runs otherwise than the autopilot's.
const MISTIMED: f32 = 5.0;
/// Two clocks over a few exposures.
const CLOCK_SLACK_NS: u64 = 60_000_000;
/// A picture whose exposure may still be announced costs this while it waits.
const STILL_OPEN: f32 = 0.3;
/// An exposure's picture is overdue when so much more than the latency has passed.
const OVERDUE_NS: i64 = 500_000_000;
/// A margin of its root is as likely right as wrong: the model is never as right as its likelihoods say. Of two thousand flights by seed
/// (DGTR_FLIGHTS=2000, tests/flights_by_seed.rs) no wrong pair has a confidence above 0.9 with it.
const DOUBT: f32 = 9.0;

/// An exposure on the list.
#[derive(Clone, Copy, Debug)]
pub(super) struct Slot {
    pub trigger: Trigger,
    /// Companion time at which it was announced.
    pub heard_ns: u64,
    /// False for one that only the counter tells of: its announcement was lost.
    pub announced: bool,
}

/// What is assumed of this flight.
#[derive(Clone, Copy, Debug)]
pub(super) struct Model {
    /// Negative logarithm of how often an announced exposure brings no picture, and a picture has no announced exposure.
    pub exposure_alone: f32,
    pub picture_alone: f32,
    /// Variance of the difference of two pictures' latencies, ns².
    pub jitter_ns2: f32,
    /// The mission's latency.
    pub latency_ns: i64,
    /// The latency of most pictures so far, when it is known.
    pub usual_ns: Option<i64>,
    /// Longest latency that comes into question.
    pub reach_ns: i64,
    /// Numbers from one picture to the next.
    pub stride: u64,
    /// Pictures that came after this may belong to exposures that were not announced yet.
    pub horizon_ns: u64,
    /// Exposures are overdue by this time; the end of the flight: all are.
    pub now_ns: u64,
}

/// What a picture is said to be.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Verdict {
    /// Its exposure's place on the list; `None` when it has none.
    pub exposure: Option<usize>,
    /// How much dearer the best assignment is that says otherwise.
    pub margin: f32,
    /// The best exposure otherwise.
    pub other: Option<usize>,
}

/// Confidence of a margin, 0 … 1.
pub(super) fn confidence(margin: f32) -> f32 {
    let m = margin.max(0.0) * margin.max(0.0);
    m / (m + DOUBT)
}

/// A time that may be subtracted from any other; no clock here runs for seventy years.
fn signed(ns: u64) -> i64 {
    ns.min(i64::MAX as u64 / 4) as i64
}

/// Where a picture's row of costs begins on the list of exposures, and how many it holds.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct Band {
    pub from: usize,
    pub len: usize,
}

/// The chain's working memory: one row of `width` costs a picture, forwards and backwards.
pub(super) struct Rows<'a> {
    pub width: usize,
    pub bands: &'a mut [Band],
    pub ahead: &'a mut [f32],
    pub behind: &'a mut [f32],
}

pub(super) struct Chain<'a> {
    pub model: Model,
    pub exposures: &'a [Slot],
    pub pictures: &'a [PictureClues],
}

impl Chain<'_> {
    fn latency(&self, picture: usize, exposure: usize) -> i64 {
        signed(self.pictures[picture].arrived_ns) - signed(self.exposures[exposure].trigger.time_ns)
    }

    fn alone(&self, picture: usize) -> f32 {
        if self.pictures[picture].arrived_ns > self.model.horizon_ns { STILL_OPEN } else { self.model.picture_alone }
    }

    fn alone_between(&self, from: usize, to: usize) -> f32 {
        (from..to).map(|p| self.alone(p)).sum()
    }

    /// For pictures before the first one that has an exposure.
    fn alone_before(&self, from: usize, to: usize) -> f32 {
        let dearest = (from..to).map(|p| self.alone(p)).fold(0.0, f32::max);
        self.alone_between(from, to) - (dearest - AT_THE_END).max(0.0)
    }

    /// For pictures behind the last one. In flight none is the last.
    fn alone_behind(&self, from: usize, to: usize) -> f32 {
        if self.is_over() { self.alone_before(from, to) } else { self.alone_between(from, to) }
    }

    fn is_over(&self) -> bool {
        self.model.now_ns == u64::MAX
    }

    /// What exposures without a picture before the first or behind the last one cost.
    fn unready(&self, exposures: usize, at_an_end: bool) -> f32 {
        let each = self.model.exposure_alone;
        let spared = if exposures == 0 || !at_an_end { 0.0 } else { (each - AT_THE_END).max(0.0) };
        (exposures as f32 * each - spared).min(UNREADY)
    }

    /// Announced exposures in a stretch of the list.
    fn announced(&self, from: usize, to: usize) -> usize {
        self.exposures[from.min(to)..to].iter().filter(|e| e.announced).count()
    }

    /// The band of exposures that come into question for a picture.
    pub fn band(&self, picture: usize, width: usize) -> Band {
        let arrived = signed(self.pictures[picture].arrived_ns);
        let from =
            self.exposures.partition_point(|e| signed(e.trigger.time_ns) < arrived.saturating_sub(self.model.reach_ns));
        let to = self.exposures.partition_point(|e| signed(e.trigger.time_ns) <= arrived.saturating_add(EARLY_NS));
        Band { from: from.max(to.saturating_sub(width)), len: (to - from).min(width) }
    }

    /// The picture is the first one that has an exposure.
    fn begin(&self, picture: usize, exposure: usize) -> f32 {
        let off = self.latency(picture, exposure).saturating_sub(self.model.latency_ns).unsigned_abs() as f32
            / LATENCY_SCALE_NS;
        off.min(UNLIKELY_LATENCY) + self.unready(self.announced(0, exposure), true)
    }

    /// The picture is the last one that has an exposure.
    fn end(&self, picture: usize, exposure: usize) -> f32 {
        let latency = self.latency(picture, exposure);
        let overdue = |e: &&Slot| {
            let due = signed(e.trigger.time_ns).saturating_add(latency.max(0)).saturating_add(OVERDUE_NS);
            e.announced && due < signed(self.model.now_ns)
        };
        self.unready(self.exposures[exposure + 1..].iter().filter(overdue).count(), self.is_over())
    }

    /// From one picture with its exposure to the next one that has one by its latency; those in between stay alone, or are late.
    fn step(&self, a: (usize, usize), b: (usize, usize)) -> f32 {
        let (x, y) = (&self.pictures[a.0], &self.pictures[b.0]);
        let (d, e) = (&self.exposures[a.1].trigger, &self.exposures[b.1].trigger);
        let off = (self.latency(b.0, b.1) - self.latency(a.0, a.1)) as f32;
        let own = (d.sigma_ns as f32) * (d.sigma_ns as f32) + (e.sigma_ns as f32) * (e.sigma_ns as f32);
        let counted = self.counted(x, y).map(|counted| counted - (i64::from(e.sequence) - i64::from(d.sequence)));
        let per_ns = if off < 0.0 && counted == Some(0) { CAUGHT_UP_NS } else { JUMP_NS };
        let changed = (off * off / (2.0 * (self.model.jitter_ns2 + own))).min(JUMPED + off.abs() / per_ns);
        // Only what jumps: of a flight that is wrong as a whole every latency is the usual one.
        let mut cost = changed + if off.abs() > USUAL_NS { self.unusual(b.0, b.1) } else { 0.0 };
        let mut skipped = self.announced(a.1 + 1, b.1) as f32;
        for p in a.0 + 1..b.0 {
            match self.late(a, p, b.1) {
                Some((_, late)) => {
                    cost += late;
                    skipped -= 1.0;
                }
                None => cost += self.alone(p) + self.disowned(a, p, b.1),
            }
        }
        skipped = skipped.max(0.0) * self.model.exposure_alone;
        cost += match counted {
            Some(0) => COUNTED_GAP * skipped,
            Some(more) if more == (b.0 - a.0 - 1) as i64 => skipped,
            Some(more) => {
                let each = if more > 0 { BY_HAND } else { SKIPPED };
                skipped + (each * more.unsigned_abs() as f32).min(MISCOUNTED_MOST)
            }
            None => skipped,
        };
        if self.clock_agrees(a, b) == Some(false) {
            cost += MISTIMED;
        }
        cost.min(4.0 * BREAK)
    }

    fn unusual(&self, picture: usize, exposure: usize) -> f32 {
        let Some(usual_ns) = self.model.usual_ns else { return 0.0 };
        let off = self.latency(picture, exposure).saturating_sub(usual_ns) as f32 / USUAL_NS;
        (off * off).min(1.0) * UNUSUAL
    }

    /// Whether the camera's clock went on as the autopilot's did.
    fn clock_agrees(&self, a: (usize, usize), b: (usize, usize)) -> Option<bool> {
        let (x, y) = (&self.pictures[a.0], &self.pictures[b.0]);
        let (from, to) = (x.camera_ns?, y.camera_ns?);
        let resolution = x.camera_resolution_ns.max(y.camera_resolution_ns).saturating_add(CLOCK_SLACK_NS);
        let flown = signed(self.exposures[b.1].trigger.boot_ns) - signed(self.exposures[a.1].trigger.boot_ns);
        Some((signed(to) - signed(from) - flown).unsigned_abs() <= resolution)
    }

    /// The exposure of a picture that comes late behind `a`, by its number or its clock, before exposure `end`; and what that costs.
    fn late(&self, a: (usize, usize), picture: usize, end: usize) -> Option<(usize, f32)> {
        let counted = self.counted(&self.pictures[a.0], &self.pictures[picture]);
        let mut fitting = (a.1 + 1..end).filter(|e| match counted {
            Some(counted) => self.sequences(a.1, *e) == counted && self.clock_agrees(a, (picture, *e)) != Some(false),
            None => self.clock_agrees(a, (picture, *e)) == Some(true),
        });
        let exposure = fitting.next().filter(|e| self.exposures[*e].announced)?;
        let behind = self.latency(picture, exposure) - self.latency(a.0, a.1);
        let cost = LATE + chance(LATE_NS, self.model.jitter_ns2) + behind.max(0) as f32 / LATE_NS;
        let possible = behind > 0 && self.latency(picture, exposure) <= self.model.reach_ns;
        (possible && fitting.next().is_none() && cost < self.alone(picture) + DISOWNED).then_some((exposure, cost))
    }

    /// What it costs to leave a picture behind `a` alone, beside that it is: its number may be that of an exposure before `end`.
    fn disowned(&self, a: (usize, usize), picture: usize, end: usize) -> f32 {
        let Some(counted) = self.counted(&self.pictures[a.0], &self.pictures[picture]) else { return 0.0 };
        let is_its = |e: usize| self.exposures[e].announced && self.sequences(a.1, e) == counted;
        if (a.1 + 1..end).any(is_its) { DISOWNED } else { 0.0 }
    }

    /// Announcements from one exposure to the other.
    fn sequences(&self, from: usize, to: usize) -> i64 {
        self.exposures[to].trigger.sequence.wrapping_sub(self.exposures[from].trigger.sequence).into()
    }

    /// Exposures from one picture to the other by their numbers.
    fn counted(&self, x: &PictureClues, y: &PictureClues) -> Option<i64> {
        let step = y.number?.checked_sub(x.number?).filter(|step| *step > 0 && *step < 64 * self.model.stride)?;
        (step % self.model.stride == 0).then_some((step / self.model.stride) as i64)
    }

    /// What lies behind a picture with which a chain begins.
    fn anew(&self, rows: &Rows<'_>, first: usize, picture: usize) -> f32 {
        let none_before = self.alone_before(0, picture);
        let Some(last) = first.checked_sub(1) else { return none_before };
        let at = last * rows.width;
        let stands = rows.ahead[at..at + rows.bands[last].len].iter().copied().fold(NEVER, f32::min);
        none_before.min(stands + BREAK + self.alone_between(first, picture))
    }

    /// Fills the rows from `first` on; those before it stand.
    pub fn run(&self, rows: &mut Rows<'_>, first: usize) {
        let (n, w) = (self.pictures.len(), rows.width);
        for p in first..n {
            let band = self.band(p, w);
            rows.bands[p] = band;
            let anew = self.anew(rows, first, p);
            for i in 0..band.len {
                let e = band.from + i;
                let mut best = self.begin(p, e) + self.unusual(p, e) + anew;
                for q in p.saturating_sub(JUMP)..p {
                    let from = rows.bands[q];
                    for k in 0..from.len.min(e.saturating_sub(from.from)) {
                        let so_far = rows.ahead[q * w + k];
                        if so_far < best {
                            best = best.min(so_far + self.step((q, from.from + k), (p, e)));
                        }
                    }
                }
                rows.ahead[p * w + i] = best;
            }
        }
        for p in (first..n).rev() {
            let band = rows.bands[p];
            let after = self.alone_behind(p + 1, n);
            for i in 0..band.len {
                let e = band.from + i;
                let mut best = self.end(p, e) + after;
                for q in p + 1..n.min(p + 1 + JUMP) {
                    let to = rows.bands[q];
                    for k in (e + 1).saturating_sub(to.from)..to.len {
                        let rest = rows.behind[q * w + k];
                        if rest < best {
                            best = best.min(rest + self.step((p, e), (q, to.from + k)));
                        }
                    }
                }
                rows.behind[p * w + i] = best;
            }
        }
    }

    /// What the chain says of a picture.
    pub fn verdict(&self, rows: &Rows<'_>, first: usize, picture: usize) -> Verdict {
        let w = rows.width;
        let mut best = Best { first: (NEVER, None), second: (NEVER, None) };
        self.without(rows, first, picture, &mut best);
        let band = rows.bands[picture];
        for i in 0..band.len {
            best.take(rows.ahead[picture * w + i] + rows.behind[picture * w + i], Some(band.from + i));
        }
        Verdict { exposure: best.first.1, margin: best.second.0 - best.first.0, other: best.second.1 }
    }

    /// The best assignments in which a picture stays alone, or is late.
    fn without(&self, rows: &Rows<'_>, first: usize, picture: usize, best: &mut Best) {
        let (n, w) = (self.pictures.len(), rows.width);
        if first == 0 {
            best.take(self.alone_between(0, n), None);
        }
        for q in picture.saturating_sub(JUMP)..picture {
            let from = rows.bands[q];
            for k in 0..from.len {
                let so_far = rows.ahead[q * w + k];
                if so_far >= best.second.0 {
                    continue;
                }
                let a = (q, from.from + k);
                best.take(so_far + self.alone_behind(q + 1, n) + self.end(a.0, a.1), None);
                for p in picture + 1..n.min(q + 1 + JUMP) {
                    let to = rows.bands[p];
                    for l in (a.1 + 1).saturating_sub(to.from)..to.len {
                        let rest = rows.behind[p * w + l];
                        if so_far + rest < best.second.0 {
                            let total = so_far + rest + self.step(a, (p, to.from + l));
                            let late = self.late(a, picture, to.from + l).map(|late| late.0);
                            best.take(total, late);
                            if late.is_some() {
                                // About what it costs to leave it alone instead.
                                let alone =
                                    self.alone(picture) + DISOWNED - LATE + COUNTED_GAP * self.model.exposure_alone;
                                best.take(total + alone.max(0.0), None);
                            }
                        }
                    }
                }
            }
        }
        for p in picture + 1..n {
            let to = rows.bands[p];
            let before = self.anew(rows, first, p);
            for l in 0..to.len {
                let e = to.from + l;
                best.take(before + self.begin(p, e) + self.unusual(p, e) + rows.behind[p * w + l], None);
            }
        }
    }
}

/// The best assignment, and the best one that says otherwise.
struct Best {
    first: (f32, Option<usize>),
    second: (f32, Option<usize>),
}

impl Best {
    fn take(&mut self, cost: f32, exposure: Option<usize>) {
        if cost < self.first.0 {
            if exposure != self.first.1 || self.first.0 >= NEVER {
                self.second = self.first;
            }
            self.first = (cost, exposure);
        } else if exposure != self.first.1 && cost < self.second.0 {
            self.second = (cost, exposure);
        }
    }
}

/// Numbers from one picture to the next: cameras count in steps of one, or of few (raw and JPEG, brackets).
pub(super) fn stride(pictures: &[PictureClues]) -> u64 {
    let mut votes = [0u16; 4];
    for pair in pictures.windows(2) {
        let step = pair[1].number.zip(pair[0].number).and_then(|(to, from)| to.checked_sub(from));
        if let Some(votes) = step.and_then(|step| votes.get_mut((step as usize).checked_sub(1)?)) {
            *votes += 1;
        }
    }
    let most = votes.iter().max().copied().unwrap_or(0);
    votes.iter().position(|v| *v == most).map_or(1, |at| at as u64 + 1)
}

/// Exposures by which the usual interval is told.
const INTERVALS: usize = 32;

/// The middle one of the newest intervals between exposures, ns.
pub(super) fn interval(exposures: &[Slot]) -> f32 {
    let mut newest: heapless::Vec<u64, INTERVALS> = exposures
        .windows(2)
        .rev()
        .take(INTERVALS)
        .map(|pair| pair[1].trigger.time_ns.saturating_sub(pair[0].trigger.time_ns))
        .collect();
    newest.sort_unstable();
    newest.get(newest.len() / 2).map_or(0.0, |ns| *ns as f32)
}

/// How much less likely it is that a picture without an exposure comes as if it had one: the usual interval in spreads of the latency.
pub(super) fn chance(interval_ns: f32, jitter_ns2: f32) -> f32 {
    const GAUSS: f32 = 2.5; // √2π
    const MOST: f32 = 3.0;
    libm::logf((interval_ns / (GAUSS * libm::sqrtf(jitter_ns2))).max(1.0)).min(MOST)
}
