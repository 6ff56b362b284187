//! Exposures and pictures that did not find each other in flight, compared once more, all with all: by the cameras' clocks,
//! by their numbers, and where nothing else is left by their order. Late pictures have lost the one clue that serves in flight,
//! when they came; the others they still have.
//!
//! Each clue is put to the vote: every pair proposes an offset (of a clock, of the numbers), and the offset that most
//! exposures and most pictures agree on is taken. How far the runner-up lies behind says how sure the answer is.

use std::collections::{HashMap, HashSet};

use crate::traits::PictureClues;
use crate::trigger::Trigger;

/// Exposures may be announced this much after the picture was complete (clock mapping and link delay).
const EARLY_NS: u64 = 300_000_000;
/// Two clocks drift apart by this much in an hour (50 ppm).
const DRIFT_NS: u64 = 200_000_000;
/// What is certain to have been written when it was taken: the camera's own work takes about as long every time.
const WRITING_NS: u64 = 500_000_000;
/// Pairs put to the vote at most; of more pictures only every second, third … votes.
const MAX_PAIRS: usize = 1 << 22;
/// Pictures of one camera count in steps of one, or of few (raw and JPEG, brackets).
const STRIDES: std::ops::RangeInclusive<i64> = 1..=4;
/// How likely it is that a single picture has no exposure of its own: what the runner-up has to explain that often.
const STRAY: f32 = 0.1;
/// Confidence of a match by order alone.
const BY_ORDER: f32 = 0.5;

/// An exposure and a picture that belong together.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Pairing {
    /// Index of the exposure.
    pub exposure: usize,
    /// Index of the picture.
    pub picture: usize,
    /// 0 … 1: how sure.
    pub confidence: f32,
}

/// A pair for the vote: the offset it proposes, its exposure and its picture.
type Ballot = (i128, usize, usize);

/// Pairs `pictures` with `exposures`; `known` pairs are certain and vote with them. Nobody is paired twice, no picture with an
/// exposure after it.
pub fn reconcile(exposures: &[Trigger], pictures: &[PictureClues], known: &[(Trigger, PictureClues)]) -> Vec<Pairing> {
    let mut desk = Desk { exposures, pictures, known, pairs: Vec::new() };
    // The clock in the picture is read at the exposure; that of the file when it was written.
    for (clock, slack_ns) in [(camera_clock as Clock, 0), (written_clock, WRITING_NS)] {
        let resolution = pictures.iter().filter_map(clock).map(|c| c.1).max().unwrap_or(0);
        let width = i128::from(resolution.saturating_add(slack_ns).saturating_add(DRIFT_NS));
        desk.pair_by(width, |exposure| Some(exposure.boot_ns.into()), |clues| Some(clock(clues)?.0.into()));
    }
    let votes = STRIDES.map(|stride| (desk.elect(0, &by_sequence(stride), &by_number), stride));
    if let Some((_, stride)) =
        votes.max_by_key(|(e, stride)| (e.as_ref().map_or((0, 0), |e| (e.votes, e.margin)), -stride))
    {
        desk.pair_by(0, by_sequence(stride), by_number);
    }
    desk.pair_by_order();
    desk.pairs
}

type Clock = fn(&PictureClues) -> Option<(u64, u64)>;

fn camera_clock(clues: &PictureClues) -> Option<(u64, u64)> {
    Some((clues.camera_ns?, clues.camera_resolution_ns))
}

fn written_clock(clues: &PictureClues) -> Option<(u64, u64)> {
    Some((clues.written_ns?, 0))
}

fn by_number(clues: &PictureClues) -> Option<i128> {
    clues.number.map(i128::from)
}

fn by_sequence(stride: i64) -> impl Fn(&Trigger) -> Option<i128> {
    move |exposure| Some(i128::from(exposure.sequence) * i128::from(stride))
}

/// The offset that won.
struct Elected {
    offset: i128,
    votes: usize,
    /// Votes before the runner-up.
    margin: usize,
    /// Votes of those that could have voted for it, 0 … 1: where a camera skips exposures no single offset holds for all.
    share: f32,
}

impl Elected {
    fn confidence(&self) -> f32 {
        self.share * (1.0 - STRAY.powi(i32::try_from(self.margin).unwrap_or(i32::MAX).min(6)))
    }
}

struct Desk<'a> {
    exposures: &'a [Trigger],
    pictures: &'a [PictureClues],
    known: &'a [(Trigger, PictureClues)],
    pairs: Vec<Pairing>,
}

impl Desk<'_> {
    fn open(&self) -> (Vec<usize>, Vec<usize>) {
        let (exposures, pictures): (HashSet<_>, HashSet<_>) =
            self.pairs.iter().map(|p| (p.exposure, p.picture)).unzip();
        let left = |count: usize, taken: HashSet<usize>| (0..count).filter(|i| !taken.contains(i)).collect();
        (left(self.exposures.len(), exposures), left(self.pictures.len(), pictures))
    }

    fn is_possible(&self, exposure: usize, picture: usize) -> bool {
        self.pictures[picture].arrived_ns.saturating_add(EARLY_NS) >= self.exposures[exposure].time_ns
    }

    /// The known pairs, and those found so far.
    fn settled(&self) -> impl Iterator<Item = (&Trigger, &PictureClues)> {
        let found = self.pairs.iter().map(|p| (&self.exposures[p.exposure], &self.pictures[p.picture]));
        self.known.iter().map(|(exposure, clues)| (exposure, clues)).chain(found)
    }

    /// The offset between `of_picture` and `of_exposure` that most agree on, within `width`.
    fn elect(
        &self,
        width: i128,
        of_exposure: &impl Fn(&Trigger) -> Option<i128>,
        of_picture: &impl Fn(&PictureClues) -> Option<i128>,
    ) -> Option<Elected> {
        let (exposures, pictures) = self.open();
        let every = (exposures.len() * pictures.len()).div_ceil(MAX_PAIRS).max(1);
        let mut ballots: Vec<Ballot> = Vec::new();
        for &p in pictures.iter().step_by(every) {
            let Some(at) = of_picture(&self.pictures[p]) else { continue };
            let possible = exposures.iter().filter(|e| self.is_possible(**e, p));
            ballots.extend(possible.filter_map(|&e| Some((at - of_exposure(&self.exposures[e])?, e, p))));
        }
        if ballots.is_empty() {
            return None;
        }
        let settled = self.settled().enumerate().filter_map(|(k, (exposure, clues))| {
            let (e, p) = (self.exposures.len() + k, self.pictures.len() + k);
            Some((of_picture(clues)? - of_exposure(exposure)?, e, p))
        });
        ballots.extend(settled);
        ballots.sort_unstable();
        let best = window(&ballots, width, |_| true)?;
        let apart = |offset: i128| (offset - best.0).abs() > width;
        let second = window(&ballots, width, apart).map_or(0, |w| w.1);
        let margin = best.1.saturating_sub(second);
        let (exposures, pictures): (HashSet<_>, HashSet<_>) = ballots.iter().map(|b| (b.1, b.2)).unzip();
        let share = best.1 as f32 / exposures.len().min(pictures.len()).max(1) as f32;
        (best.1 >= 2 && margin > 0).then_some(Elected { offset: best.0, votes: best.1, margin, share: share.min(1.0) })
    }

    /// Pairs what the elected offset brings together, in order.
    fn pair_by(
        &mut self,
        width: i128,
        of_exposure: impl Fn(&Trigger) -> Option<i128>,
        of_picture: impl Fn(&PictureClues) -> Option<i128>,
    ) {
        let Some(elected) = self.elect(width, &of_exposure, &of_picture) else { return };
        let (exposures, pictures) = self.open();
        let mut times: Vec<(i128, usize)> =
            exposures.iter().filter_map(|&e| Some((of_exposure(&self.exposures[e])?, e))).collect();
        times.sort_unstable();
        let mut shots: Vec<(i128, usize)> =
            pictures.iter().filter_map(|&p| Some((of_picture(&self.pictures[p])? - elected.offset, p))).collect();
        shots.sort_unstable();
        let mut from = 0;
        for (at, picture) in shots {
            let start = from + times[from..].partition_point(|t| t.0 < at - width);
            let near = times[start..].iter().take_while(|t| t.0 <= at + width).enumerate();
            let mut near = near.filter(|(_, t)| self.is_possible(t.1, picture) && self.keeps_order(t.1, picture));
            // A clock that cannot tell two exposures apart says nothing of either.
            let (Some((k, &(_, exposure))), None) = (near.next(), near.next()) else { continue };
            let is_known = |(t, _): &(Trigger, _)| of_exposure(t).is_some_and(|known| (known - at).abs() <= width);
            if self.known.iter().any(is_known)
                || !self.agrees_with_neighbours(width, &of_exposure, &of_picture, (elected.offset, picture))
            {
                continue;
            }
            from = start + k + 1;
            self.pairs.push(Pairing { exposure, picture, confidence: elected.confidence() });
        }
    }

    /// The certain pairs whose numbers are next to a picture's have the same offset, if there are any: in between a camera may have
    /// skipped an exposure, or taken a picture by hand.
    fn agrees_with_neighbours(
        &self,
        width: i128,
        of_exposure: &impl Fn(&Trigger) -> Option<i128>,
        of_picture: &impl Fn(&PictureClues) -> Option<i128>,
        (offset, picture): (i128, usize),
    ) -> bool {
        let Some(own) = of_picture(&self.pictures[picture]) else { return false };
        let offsets =
            self.known.iter().filter_map(|(t, c)| Some((of_picture(c)? - own, of_picture(c)? - of_exposure(t)?)));
        let offsets: Vec<(i128, i128)> = offsets.collect();
        let before = offsets.iter().filter(|o| o.0 < 0).max();
        let after = offsets.iter().filter(|o| o.0 > 0).min();
        [before, after].into_iter().flatten().all(|o| (o.1 - offset).abs() <= width)
    }

    /// No certain pair says otherwise: a higher number is a later exposure.
    fn keeps_order(&self, exposure: usize, picture: usize) -> bool {
        let (trigger, clues) = (&self.exposures[exposure], &self.pictures[picture]);
        let Some(number) = clues.number else { return true };
        let crossed = |t: &Trigger, n: u64| (n < number) != (t.boot_ns < trigger.boot_ns) && n != number;
        let close = |n: u64| n.abs_diff(number) < 64; // a camera that starts to count anew crosses everything
        !self.known.iter().any(|(t, c)| c.number.is_some_and(|n| close(n) && crossed(t, n)))
    }

    /// Where as many pictures as exposures are left between two that are settled, they belong together in their order.
    fn pair_by_order(&mut self) {
        let (exposures, pictures) = self.open();
        let all = self.settled().map(|(_, c)| c).chain(pictures.iter().map(|&p| &self.pictures[p]));
        let numbers: Vec<Option<u64>> = all.map(|c| c.number).collect();
        let distinct: HashSet<u64> = numbers.iter().flatten().copied().collect();
        let numbered = distinct.len() == numbers.len();
        let order = |clues: &PictureClues| if numbered { clues.number.unwrap_or(0) } else { clues.arrived_ns };
        let mut settled: Vec<(u64, u64)> = self.settled().map(|(t, c)| (t.boot_ns, order(c))).collect();
        settled.sort_unstable();
        if settled.windows(2).any(|w| w[1].1 <= w[0].1) {
            return; // their order is not that of the exposures
        }
        let mut gaps: HashMap<usize, (Vec<usize>, Vec<usize>)> = HashMap::new();
        for &e in &exposures {
            let gap = settled.partition_point(|s| s.0 < self.exposures[e].boot_ns);
            gaps.entry(gap).or_default().0.push(e);
        }
        for &p in &pictures {
            let gap = settled.partition_point(|s| s.1 < order(&self.pictures[p]));
            gaps.entry(gap).or_default().1.push(p);
        }
        for (mut exposures, mut pictures) in gaps.into_values().filter(|(e, p)| e.len() == p.len()) {
            exposures.sort_unstable_by_key(|e| self.exposures[*e].boot_ns);
            pictures.sort_unstable_by_key(|p| order(&self.pictures[*p]));
            let pairs: Vec<(usize, usize)> = exposures.into_iter().zip(pictures).collect();
            if pairs.iter().all(|&(e, p)| self.is_possible(e, p)) {
                let paired = |(exposure, picture)| Pairing { exposure, picture, confidence: BY_ORDER };
                self.pairs.extend(pairs.into_iter().map(paired));
            }
        }
    }
}

/// The window of this width over sorted ballots that holds the most different exposures and pictures (the fewer of the two
/// count): its middle and its votes.
fn window(ballots: &[Ballot], width: i128, admitted: impl Fn(i128) -> bool) -> Option<(i128, usize)> {
    let (mut exposures, mut pictures): (HashMap<usize, usize>, HashMap<usize, usize>) = Default::default();
    let mut start = 0;
    let mut best: Option<(i128, usize)> = None;
    for end in 0..ballots.len() {
        *exposures.entry(ballots[end].1).or_default() += 1;
        *pictures.entry(ballots[end].2).or_default() += 1;
        while ballots[end].0 - ballots[start].0 > width {
            for (counts, key) in [(&mut exposures, ballots[start].1), (&mut pictures, ballots[start].2)] {
                if let Some(count) = counts.get_mut(&key) {
                    *count -= 1;
                    if *count == 0 {
                        counts.remove(&key);
                    }
                }
            }
            start += 1;
        }
        let middle = ballots[start].0 + (ballots[end].0 - ballots[start].0) / 2;
        let votes = exposures.len().min(pictures.len());
        if best.is_none_or(|b| votes > b.1) && admitted(middle) {
            best = Some((middle, votes));
        }
    }
    best
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::trigger::{Source, TriggerKind};

    const S: u64 = 1_000_000_000;

    /// Exposures of a survey: 2 s apart, 9 s where a line ends.
    fn exposures(n: u32) -> Vec<Trigger> {
        let at = |i: u32| (100 + 2 * u64::from(i) + 7 * u64::from(i / 8)) * S + u64::from(i % 3) * S / 20;
        (0..n)
            .map(|i| Trigger {
                source: Source::default(),
                sequence: i + 1,
                boot_ns: at(i),
                time_ns: at(i) - 90 * S,
                sigma_ns: 1,
                kind: TriggerKind::Feedback,
            })
            .collect()
    }

    /// The picture of an exposure, after everything is over, without any clue.
    fn bare(k: usize) -> PictureClues {
        PictureClues { arrived_ns: 10_000 * S + k as u64, ..PictureClues::default() }
    }

    /// How many were paired, and whether each with its own (`of[picture]` is its exposure).
    fn judge(pairs: &[Pairing], of: &[usize]) -> (usize, bool) {
        (pairs.len(), pairs.iter().all(|p| of[p.picture] == p.exposure))
    }

    #[test]
    fn forty_pictures_that_came_after_the_landing_find_their_exposures_by_any_one_clue() {
        let exposures = exposures(40);
        let of: Vec<usize> = (0..40).rev().collect();
        let camera = |e: &Trigger| Some((e.boot_ns + 7_777 * S) / S * S);
        type Clue = fn(&Trigger) -> PictureClues;
        let clues: [(&str, Clue); 3] = [
            ("number", |e| PictureClues { number: Some(500 + u64::from(e.sequence)), ..PictureClues::default() }),
            ("every other number", |e| PictureClues {
                number: Some(2 * u64::from(e.sequence)),
                ..PictureClues::default()
            }),
            ("file time", |e| PictureClues {
                written_ns: Some(e.boot_ns + 1_790_000_000 * S),
                ..PictureClues::default()
            }),
        ];
        for (name, clue) in clues {
            let pictures: Vec<PictureClues> =
                of.iter().map(|&e| PictureClues { arrived_ns: 10_000 * S, ..clue(&exposures[e]) }).collect();
            let pairs = reconcile(&exposures, &pictures, &[]);
            assert_eq!(judge(&pairs, &of), (40, true), "{name}: {pairs:?}");
            assert!(pairs.iter().all(|p| p.confidence >= 0.9), "{name}");
        }
        let pictures: Vec<PictureClues> = of
            .iter()
            .map(|&e| PictureClues { camera_ns: camera(&exposures[e]), camera_resolution_ns: S, ..bare(e) })
            .collect();
        assert_eq!(judge(&reconcile(&exposures, &pictures, &[]), &of), (40, true), "EXIF in whole seconds");
    }

    #[test]
    fn without_any_clue_their_order_decides_if_none_is_missing_and_nobody_guesses_if_one_is() {
        let exposures = exposures(40);
        let of: Vec<usize> = (0..40).collect();
        let pictures: Vec<PictureClues> = of.iter().map(|&k| bare(k)).collect();
        let pairs = reconcile(&exposures, &pictures, &[]);
        assert_eq!(judge(&pairs, &of), (40, true));
        assert!(pairs.iter().all(|p| p.confidence == BY_ORDER));
        assert!(reconcile(&exposures, &pictures[1..], &[]).is_empty());
    }

    #[test]
    fn missing_pictures_stay_missing_and_cost_no_other_one_its_place() {
        let exposures = exposures(40);
        let of: Vec<usize> = (0..40).filter(|k| ![3, 17, 18, 39].contains(k)).collect();
        let pictures: Vec<PictureClues> = of
            .iter()
            .enumerate()
            .map(|(k, &e)| PictureClues {
                // The camera skipped them: no gap in its numbers.
                number: Some(1 + k as u64),
                camera_ns: Some((exposures[e].boot_ns + 5 * S) / S * S),
                camera_resolution_ns: S,
                ..bare(k)
            })
            .collect();
        assert_eq!(judge(&reconcile(&exposures, &pictures, &[]), &of), (36, true));
        let numbered: Vec<PictureClues> =
            of.iter().map(|&e| PictureClues { number: Some(100 + e as u64), ..bare(e) }).collect();
        // By numbers alone they would fit one exposure later as well: the last one is missing.
        assert!(reconcile(&exposures, &numbered, &[]).is_empty());
        let known = [(exposures[39], PictureClues { number: Some(139), ..bare(39) })];
        assert_eq!(judge(&reconcile(&exposures[..39], &numbered, &known), &of), (36, true), "gaps in the numbers");
    }

    #[test]
    fn what_was_matched_in_flight_decides_where_the_rest_alone_could_not() {
        // Ten of forty are left, in the middle; five of their pictures came. Regular spacing: alone they fit anywhere.
        let exposures = exposures(40);
        let clues = |e: usize| PictureClues { number: Some(100 + e as u64), ..bare(e) };
        let known: Vec<(Trigger, PictureClues)> = (0..15).chain(25..40).map(|e| (exposures[e], clues(e))).collect();
        let pictures: Vec<PictureClues> = [16, 17, 19, 20, 24].map(clues).to_vec();
        let pairs = reconcile(&exposures[15..25], &pictures, &known);
        assert_eq!(judge(&pairs, &[1, 2, 4, 5, 9]), (5, true), "{pairs:?}");
        assert!(pairs.iter().all(|p| p.confidence > 0.999));
    }

    #[test]
    fn no_picture_is_paired_with_an_exposure_after_it() {
        let exposures = exposures(10);
        let pictures: Vec<PictureClues> = (0..10)
            .map(|k| PictureClues { arrived_ns: exposures[0].time_ns + S, number: Some(k), ..bare(0) })
            .collect();
        let pairs = reconcile(&exposures, &pictures, &[]);
        assert!(pairs.iter().all(|p| p.exposure == 0), "{pairs:?}");
        assert!(reconcile(&[], &pictures, &[]).is_empty() && reconcile(&exposures, &[], &[]).is_empty());
    }
}
