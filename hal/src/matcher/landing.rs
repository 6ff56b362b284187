//! The whole flight aligned at once when it is over: both ends are there then, and they tell a latency of one exposure more from
//! one less.

use super::alignment::{Band, Chain, Model, Rows, Slot, chance, confidence, interval, stride};
use std::collections::HashSet;

use super::doubled;
use super::reconcile::Pairing;
use super::{FIRST_JITTER_NS2, JITTER_NS2, LEAST_CONFIDENCE, MatcherSettings, SURE, rarity};
use crate::traits::PictureClues;
use crate::trigger::Trigger;

/// Exposures that come into question for one picture.
const WIDTH: usize = 96;

/// Median confidence up to which the second assignment of a flight is nearly as likely as the best. Nearly all flights whose rhythm tells
/// lie above it, nearly all of an even rhythm that lack something at one end below (`tests/flights_by_seed.rs` counts both).
const NEARLY_AS_LIKELY: f32 = 0.6;
/// A camera may be this many times later than in flight: pictures were copied at the landing.
const REACH: u64 = 4;

/// What is said of a picture when all is known.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Answer {
    /// Index of its exposure.
    pub exposure: Option<usize>,
    /// 0 … 1: by how much that is likelier than anything else.
    pub confidence: f32,
    /// Index of the exposure that is next likely.
    pub other: Option<usize>,
}

/// Of every picture the exposure that it belongs to; exposures by their time, pictures in the order in which they were taken.
pub fn align(exposures: &[Trigger], pictures: &[PictureClues], settings: MatcherSettings) -> Vec<Answer> {
    let slots: Vec<Slot> = with_gaps(exposures);
    let places: Vec<usize> = (0..slots.len()).filter(|k| slots[*k].announced).collect();
    let by_chance = chance(interval(&slots), FIRST_JITTER_NS2);
    let mut model = Model {
        exposure_alone: rarity(0.0, 0.0),
        picture_alone: rarity(0.0, 0.0) + by_chance,
        jitter_ns2: FIRST_JITTER_NS2,
        latency_ns: settings.latency_ns as i64,
        usual_ns: None,
        reach_ns: settings.patience_ns.saturating_mul(REACH).min(i64::MAX as u64) as i64,
        stride: stride(pictures),
        horizon_ns: u64::MAX,
        now_ns: u64::MAX,
    };
    let mut bands = vec![Band::default(); pictures.len()];
    let (mut ahead, mut behind) = (vec![0.0; pictures.len() * WIDTH], vec![0.0; pictures.len() * WIDTH]);
    let mut answers = Vec::new();
    // Twice: the first time says how much of this flight was lost, and how even its latency is.
    for _ in 0..2 {
        let chain = Chain { model, exposures: &slots, pictures };
        let mut rows = Rows { width: WIDTH, bands: &mut bands, ahead: &mut ahead, behind: &mut behind };
        chain.run(&mut rows, 0);
        answers = (0..pictures.len()).map(|p| chain.verdict(&rows, 0, p)).collect();
        let announced = |e: &usize| slots[*e].announced;
        let matched = answers.iter().filter(|v| v.exposure.is_some_and(|e| announced(&e))).count();
        let mut latencies: Vec<i64> = answers
            .iter()
            .zip(pictures)
            .filter_map(|(v, clues)| Some(clues.arrived_ns.wrapping_sub(slots[v.exposure?].trigger.time_ns) as i64))
            .collect();
        model.jitter_ns2 = jitter_ns2(&latencies);
        latencies.sort_unstable();
        model.usual_ns = latencies.get(latencies.len() / 2).copied();
        let lost = |all: usize| rarity(all.saturating_sub(matched) as f32, matched as f32);
        (model.exposure_alone, model.picture_alone) = (lost(exposures.len()), lost(pictures.len()) + by_chance);
    }
    let index = |slot: Option<usize>| slot.and_then(|slot| places.binary_search(&slot).ok());
    let answer = |v: &super::Verdict| Answer {
        exposure: index(v.exposure),
        confidence: confidence(v.margin),
        other: index(v.other),
    };
    answers.iter().map(answer).collect()
}

/// Variance of the difference of two latencies, as the middle one of all neighbours in the flight tells it: most of them are right.
fn jitter_ns2(latencies: &[i64]) -> f32 {
    const SIGMAS: f32 = 1.4826; // of a normal distribution, by the median distance from its middle
    let mut off: Vec<u64> = latencies.windows(2).map(|w| w[1].abs_diff(w[0])).collect();
    off.sort_unstable();
    let Some(middle) = off.get(off.len() / 2) else { return FIRST_JITTER_NS2 };
    let sigma = SIGMAS * *middle as f32;
    (sigma * sigma).clamp(*JITTER_NS2.start(), *JITTER_NS2.end())
}

/// The exposures, and between them those that the counter says were announced and did not come.
fn with_gaps(exposures: &[Trigger]) -> Vec<Slot> {
    let mut slots: Vec<Slot> = Vec::with_capacity(exposures.len());
    for trigger in exposures {
        if let Some(before) = slots.last().map(|s| s.trigger) {
            slots.extend(super::missing(&before, trigger).map(|trigger| Slot {
                trigger,
                heard_ns: 1,
                announced: false,
            }));
        }
        slots.push(Slot { trigger: *trigger, heard_ns: 1, announced: true });
    }
    slots
}

/// What the whole flight says when it is over.
#[derive(Clone, Debug, Default)]
pub struct Settled {
    /// Pictures that found no exposure in flight, with the one that is theirs.
    pub pairs: Vec<Pairing>,
    /// Which of the known ones it says another exposure of.
    pub revised: Vec<usize>,
    /// Pictures that have an exposure.
    pub posed: usize,
    /// How many of these fit another one nearly as well.
    pub doubtful: usize,
    /// Pictures whose second exposure is as many exposures earlier or later as that of most others.
    pub shifted: usize,
    /// The median of their confidences: by how much this assignment of the flight is likelier than the second.
    pub confidence: f32,
}

impl Settled {
    /// The second assignment of the flight is nearly as likely as the best: it says otherwise of most pictures.
    pub fn is_ambiguous(&self) -> bool {
        self.posed > 0 && self.confidence <= NEARLY_AS_LIKELY
    }

    /// No picture is sure, and one shift leads to the second exposure of nearly all: as where both ends of an even flight lack something.
    pub fn may_be_shifted(&self) -> bool {
        self.posed > 0 && self.doubtful == self.posed && self.shifted * 10 >= self.posed * 9
    }
}

/// Pairs pictures that found no exposure in flight when it is over; `known` were matched in flight.
pub fn settle(
    exposures: &[Trigger],
    pictures: &[PictureClues],
    known: &[(Trigger, PictureClues)],
    settings: MatcherSettings,
) -> Settled {
    // Of every picture its clues, and where it is on its list.
    let waiting = pictures.iter().enumerate().map(|(k, clues)| (*clues, Err(k)));
    let mut all: Vec<(PictureClues, Result<usize, usize>)> =
        known.iter().enumerate().map(|(k, pair)| (pair.1, Ok(k))).chain(waiting).collect();
    in_order(&mut all);
    let clues: Vec<PictureClues> = all.iter().map(|a| a.0).collect();
    let answers = align_shutters(exposures, &clues, settings);
    let mut sorted: Vec<f32> = answers.iter().filter(|a| a.exposure.is_some()).map(|a| a.confidence).collect();
    sorted.sort_by(f32::total_cmp);
    let (posed, doubtful) = (sorted.len(), sorted.partition_point(|confidence| *confidence <= SURE));
    let confidence = sorted.get(posed / 2).copied().unwrap_or(1.0);
    let mut away: Vec<i64> =
        answers.iter().filter_map(|a| Some(a.other? as i64 - a.exposure? as i64)).filter(|n| *n != 0).collect();
    away.sort_unstable();
    let shifted = away.chunk_by(|a, b| a == b).map(<[i64]>::len).max().unwrap_or(0);
    let (mut taken, mut revised) = (HashSet::new(), Vec::new());
    for (answer, (_, place)) in answers.iter().zip(&all) {
        let Ok(k) = *place else { continue };
        let flown = exposures.iter().position(|e| *e == known[k].0);
        if answer.exposure == flown || answer.confidence < LEAST_CONFIDENCE {
            taken.extend(flown);
        } else {
            revised.push(k);
        }
    }
    let mut pairs = Vec::new();
    for (answer, (_, place)) in answers.iter().zip(&all) {
        let (Err(picture), Some(exposure)) = (*place, answer.exposure) else { continue };
        if answer.confidence >= LEAST_CONFIDENCE && taken.insert(exposure) {
            pairs.push(Pairing { exposure, picture, confidence: answer.confidence });
        }
    }
    Settled { pairs, revised, posed, doubtful, shifted, confidence }
}

/// As [`align`], with the shutter's announcements alone where each picture is announced twice.
fn align_shutters(exposures: &[Trigger], pictures: &[PictureClues], settings: MatcherSettings) -> Vec<Answer> {
    let Some(shutters) = doubled::shutters(exposures, pictures.len()) else {
        return align(exposures, pictures, settings);
    };
    // The counter counts both: what is left out is no gap.
    let numbered = (0..).zip(&shutters).map(|(sequence, k)| Trigger { sequence, ..exposures[*k] });
    let mut answers = align(&numbered.collect::<Vec<_>>(), pictures, settings);
    for answer in &mut answers {
        answer.exposure = answer.exposure.map(|k| shutters[k]);
        answer.other = answer.other.map(|k| shutters[k]);
    }
    answers
}

/// Sorts pictures as they were taken: as they came, but by their numbers where one came late.
fn in_order<T>(pictures: &mut [(PictureClues, T)]) {
    pictures.sort_by_key(|p| p.0.arrived_ns);
    for at in 1..pictures.len() {
        let mut own = at;
        while own > 0 && super::is_late(&pictures[own - 1].0, &pictures[own].0) {
            pictures.swap(own - 1, own);
            own -= 1;
        }
    }
}
