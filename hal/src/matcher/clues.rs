//! What is learnt about a camera from certain matches: its latency, how its numbers follow the exposures, and the offset
//! of its clock; and the choice of an exposure for a picture from all three.

use heapless::Deque;

use crate::traits::PictureClues;
use crate::trigger::Trigger;

/// A relation that held this often in a row is believed.
const BELIEVED: u8 = 3;
/// Exposures may be announced this much after the picture (clock mapping and link delay).
const EARLY_NS: i64 = 300_000_000;
/// Least spread of latencies assumed, before and after learning.
const FIRST_SPREAD_NS: f64 = 1e9;
const LEAST_SPREAD_NS: f64 = 0.1e9;
/// So many pictures in a row must agree before their times overrule their numbers.
pub(super) const WITNESSES: usize = 3;
/// Weight of the newest latency.
const BLEND: f64 = 0.2;

/// What the clues of one picture say.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Choice {
    /// The exposure at this index; `certain` enough not to wait for more announcements.
    Exposure { index: usize, certain: bool },
    /// Number and time of arrival contradict each other: either pictures come late (a busy computer), or the camera
    /// skipped exposures without leaving a gap in its numbers. The pictures that follow can tell.
    Contradiction { by_number: usize, by_time: usize, shift: u64 },
    /// Its number stands for this exposure, which does not wait for a picture (any more); its time fits `by_time`.
    Absent { sequence: u64, by_time: Option<usize> },
    /// No exposure fits.
    None,
}

/// The relations learnt so far.
pub(super) struct Learnt {
    latency_ns: f64,
    spread_ns: f64,
    matches: u32,
    last: Option<(PictureClues, Trigger)>,
    /// number = stride · sequence + constant.
    stride: u64,
    number_held: u8,
    /// camera clock − boot clock, ns.
    camera_offset_ns: i128,
    camera_held: u8,
}

impl Learnt {
    pub(super) fn new(latency_ns: u64) -> Self {
        Self {
            latency_ns: latency_ns as f64,
            spread_ns: FIRST_SPREAD_NS,
            matches: 0,
            last: None,
            stride: 0,
            number_held: 0,
            camera_offset_ns: 0,
            camera_held: 0,
        }
    }

    /// Which exposure a picture with these clues belongs to.
    pub(super) fn choose<const N: usize>(
        &self,
        clues: &PictureClues,
        triggers: &Deque<Trigger, N>,
        patience_ns: u64,
    ) -> Choice {
        let latency = |t: &Trigger| clues.arrived_ns.wrapping_sub(t.time_ns) as i64;
        let possible = |t: &Trigger| (-EARLY_NS..=patience_ns as i64).contains(&latency(t));
        let off = |t: &Trigger| (latency(t) as f64 - self.latency_ns).abs();
        let by_time = triggers
            .iter()
            .enumerate()
            .filter(|(_, t)| possible(t))
            .min_by(|(_, a), (_, b)| off(a).total_cmp(&off(b)))
            .map(|(i, t)| (i, off(t), latency(t), u64::from(t.sequence)));

        // The camera's own clock, once its offset is known, is decisive: it was read at the exposure.
        if let (Some(camera_ns), true) = (clues.camera_ns, self.camera_held >= BELIEVED) {
            let resolution = clues.camera_resolution_ns.max(50_000_000) as i128;
            let error = |t: &Trigger| (i128::from(camera_ns) - i128::from(t.boot_ns) - self.camera_offset_ns).abs();
            let mut fitting = triggers.iter().enumerate().filter(|(_, t)| possible(t) && error(t) <= resolution);
            if let (Some((index, _)), None) = (fitting.next(), fitting.next()) {
                return Choice::Exposure { index, certain: true };
            }
        }
        if let Some((sequence, behind)) = self.sequence_of(clues) {
            let found = triggers.iter().position(|t| u64::from(t.sequence) == sequence && possible(t));
            match (found, by_time) {
                // A number out of order belongs to a late picture: its time says nothing, its number does.
                (Some(index), _) if behind => return Choice::Exposure { index, certain: true },
                (None, _) if behind => return Choice::Absent { sequence, by_time: None },
                (Some(index), Some((timed, ..))) if index == timed => return Choice::Exposure { index, certain: true },
                (Some(by_number), Some((by_time, off, _, timed))) => {
                    // Only where latencies scatter less than the exposures lie apart can a skip be told from lateness.
                    let apart = |a: usize, b: usize| {
                        let time = |i| triggers.iter().nth(i).map_or(0.0, |t: &Trigger| t.time_ns as f64);
                        time(b) - time(a)
                    };
                    let told = 6.0 * self.spread_ns < apart(by_number, by_time);
                    let fits = timed > sequence && off < 3.0 * self.spread_ns && told;
                    return if fits {
                        Choice::Contradiction { by_number, by_time, shift: timed - sequence }
                    } else {
                        // No skipped exposure explains that time: the picture is late.
                        Choice::Exposure { index: by_number, certain: true }
                    };
                }
                (None, near) => {
                    let fitting = near.filter(|(_, off, ..)| *off < 3.0 * self.spread_ns);
                    return Choice::Absent { sequence, by_time: fitting.map(|(index, ..)| index) };
                }
                (Some(_), None) => {}
            }
        }
        let Some((index, off, latency, _)) = by_time else { return Choice::None };
        let certain = self.matches > 2 && off < 3.0 * self.spread_ns && latency >= 0;
        Choice::Exposure { index, certain }
    }

    /// No picture was matched yet.
    pub(super) fn is_new(&self) -> bool {
        self.matches == 0
    }

    /// A number stood for an exposure that never was: the camera may have started to count anew.
    pub(super) fn doubt_numbers(&mut self) {
        self.number_held = self.number_held.saturating_sub(1);
    }

    /// The camera skipped exposures, or took pictures nobody announced: from `clues` on its numbers mean other ones.
    pub(super) fn shifted(&mut self, clues: &PictureClues, trigger: &Trigger) {
        self.last = Some((*clues, *trigger));
    }

    /// The sequence that the picture's number stands for, and whether it lies behind the last one matched.
    fn sequence_of(&self, clues: &PictureClues) -> Option<(u64, bool)> {
        let (last, trigger) = self.last.as_ref()?;
        let (number, last) = (clues.number?, last.number?);
        if self.number_held < BELIEVED || self.stride == 0 || number.abs_diff(last) % self.stride != 0 {
            return None;
        }
        let steps = number.abs_diff(last) / self.stride;
        let sequence = u64::from(trigger.sequence);
        if number < last {
            Some((sequence.checked_sub(steps)?, true))
        } else {
            Some((sequence.saturating_add(steps), false))
        }
    }

    pub(super) fn learn(&mut self, clues: &PictureClues, trigger: &Trigger, late: bool) {
        if late {
            return; // its latency is no measure, its number is behind
        }
        let latency = clues.arrived_ns as f64 - trigger.time_ns as f64;
        self.matches += 1;
        let blend = if self.matches == 1 { 1.0 } else { BLEND };
        let error = latency - self.latency_ns;
        self.latency_ns += blend * error;
        let spread = if self.matches == 1 { FIRST_SPREAD_NS / 2.0 } else { error.abs() };
        self.spread_ns = (self.spread_ns + blend * (spread - self.spread_ns)).max(LEAST_SPREAD_NS);

        if let (Some(a), Some((last, b))) = (clues.number, &self.last)
            && let Some(last) = last.number
        {
            let (steps, sequences) = (a.saturating_sub(last), u64::from(trigger.sequence.saturating_sub(b.sequence)));
            let stride = if sequences > 0 && steps % sequences == 0 { steps / sequences } else { 0 };
            let holds = stride > 0 && (stride == self.stride || self.number_held == 0);
            if sequences > 0 {
                self.number_held =
                    if holds { (self.number_held + 1).min(BELIEVED + 2) } else { self.number_held.saturating_sub(2) };
            }
            if self.number_held <= 1 {
                self.stride = stride;
            }
        }
        if let Some(camera_ns) = clues.camera_ns {
            let offset = i128::from(camera_ns) - i128::from(trigger.boot_ns);
            let resolution = clues.camera_resolution_ns.max(50_000_000) as i128;
            let error = offset - self.camera_offset_ns;
            if self.camera_held > 0 && error.abs() <= resolution {
                self.camera_held = (self.camera_held + 1).min(BELIEVED + 2);
                // A clock cut to whole seconds is on average half of one behind.
                self.camera_offset_ns += error / 8;
            } else if self.camera_held <= 1 {
                self.camera_offset_ns = offset;
                self.camera_held = 1;
            } else {
                self.camera_held -= 1;
            }
        }
        self.last = Some((*clues, *trigger));
    }
}
