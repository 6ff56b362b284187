//! A flight log beside the card: exposures on the autopilot's clock, pictures on the camera's. Both count in the same
//! order; the offset of the clocks is what most pictures agree on.

use std::collections::HashMap;

use super::record::{Attitude, Fix};

/// An exposure that a log reports.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Exposure {
    /// Seconds on the log's own clock.
    pub time_s: f64,
    /// Where the aircraft was.
    pub fix: Fix,
    /// How it, or its gimbal, was turned.
    pub attitude: Option<Attitude>,
}

/// Which exposure each picture is.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Matching {
    /// Index of the exposure, per picture.
    pub exposure: Vec<Option<usize>>,
    /// The camera's clock minus the log's, seconds; `None` where the pictures have no times and were counted.
    pub offset_s: Option<f64>,
    /// Root mean square of what is left, seconds.
    pub rms_s: f64,
    /// What each other offset would give that explains as many pictures nearly as well: evenly spaced exposures can be counted from
    /// either end, or from anywhere between.
    pub rivals: Vec<Vec<Option<usize>>>,
}

/// Offsets that are tried in full.
const TRIED: usize = 64;
/// Width of the vote's bins and the tolerance beyond the clock's resolution, seconds: shutter lag and writing.
const SLACK_S: f64 = 0.4;

/// Matches pictures (in order, times in seconds and their resolution) to exposures by order and time. Without times, and
/// with as many pictures as exposures, they are counted.
pub fn match_exposures(pictures: &[Option<(f64, f64)>], exposures: &[f64]) -> Matching {
    let timed: Vec<(usize, f64)> = pictures.iter().enumerate().filter_map(|(i, t)| Some((i, (*t)?.0))).collect();
    if timed.len() < 2 || exposures.len() < 2 {
        let counted = pictures.len() == exposures.len();
        let exposure = (0..pictures.len()).map(|i| counted.then_some(i)).collect();
        return Matching { exposure, ..Matching::default() };
    }
    let resolution = pictures.iter().flatten().map(|t| t.1).fold(0.0, f64::max);
    let tolerance = SLACK_S + 0.5 * resolution;
    // A clock that cuts off to whole seconds is late by half a second on average.
    let (bin, mut votes) = (tolerance, HashMap::<i64, u32>::new());
    let stride = (timed.len() * exposures.len() / 4_000_000).max(1);
    for (_, t) in timed.iter().step_by(stride) {
        for e in exposures {
            let at = ((t - e) / bin).floor() as i64;
            for b in [at, at + 1] {
                *votes.entry(b).or_default() += 1;
            }
        }
    }
    let mut bins: Vec<(i64, u32)> = votes.into_iter().collect();
    bins.sort_by(|a, b| b.1.cmp(&a.1).then(a.0.cmp(&b.0)));
    let mut tried: Vec<(Vec<Option<usize>>, usize, f64, f64)> = Vec::new();
    for (b, _) in bins.into_iter().take(TRIED) {
        let mut offset = b as f64 * bin;
        let mut found = pair(&timed, exposures, offset, 2.0 * tolerance);
        for _ in 0..3 {
            let away: Vec<f64> = found.iter().map(|(i, j)| timed[*i].1 - exposures[*j]).collect();
            if away.is_empty() {
                break;
            }
            offset = away.iter().sum::<f64>() / away.len() as f64;
            found = pair(&timed, exposures, offset, tolerance);
        }
        let mut exposure = vec![None; pictures.len()];
        found.iter().for_each(|(i, j)| exposure[timed[*i].0] = Some(*j));
        let squares: f64 = found.iter().map(|(i, j)| (timed[*i].1 - exposures[*j] - offset).powi(2)).sum();
        tried.push((exposure, found.len(), (squares / found.len().max(1) as f64).sqrt(), offset));
    }
    tried.sort_by(|a, b| b.1.cmp(&a.1).then(a.2.total_cmp(&b.2)));
    let Some(best) = tried.first() else {
        return Matching { exposure: vec![None; pictures.len()], ..Matching::default() };
    };
    let mut rivals: Vec<Vec<Option<usize>>> = Vec::new();
    for (exposure, pairs, rms_s, _) in &tried[1..] {
        let fits_as_well = *pairs == best.1 && *rms_s < 1.2 * best.2 + 0.02;
        if fits_as_well && *exposure != best.0 && !rivals.contains(exposure) {
            rivals.push(exposure.clone());
        }
    }
    Matching { exposure: best.0.clone(), offset_s: Some(best.3), rms_s: best.2, rivals }
}

/// Pairs in order, each exposure once, within `tolerance` of the offset.
fn pair(timed: &[(usize, f64)], exposures: &[f64], offset: f64, tolerance: f64) -> Vec<(usize, usize)> {
    let mut pairs: Vec<(usize, usize)> = Vec::new();
    let mut from = 0;
    for (i, (_, t)) in timed.iter().enumerate() {
        let away = |j: usize| (t - offset - exposures[j]).abs();
        while from + 1 < exposures.len() && away(from + 1) <= away(from) {
            from += 1;
        }
        if from < exposures.len() && away(from) <= tolerance {
            match pairs.last_mut() {
                // Two pictures of one exposure: the nearer one is it.
                Some(last) if last.1 == from => {
                    if away(from) < (timed[last.0].1 - offset - exposures[from]).abs() {
                        last.0 = i;
                    }
                }
                _ => pairs.push((i, from)),
            }
        }
    }
    pairs
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A survey's exposures: every two seconds along lines, a pause at every turn.
    fn log() -> Vec<f64> {
        (0..60).map(|i| 100.0 + 2.0 * f64::from(i) + 7.3 * f64::from(i / 13)).collect()
    }

    #[test]
    fn the_offset_of_the_clocks_is_found_and_missing_pictures_do_not_shift_the_rest() {
        let offset = 1_525_000_000.0 - 37.4;
        // Whole seconds, as most cameras write; three pictures missing, one that the log does not know.
        let mut pictures: Vec<(usize, f64)> = log()
            .iter()
            .enumerate()
            .filter(|(i, _)| ![0, 20, 41].contains(i))
            .map(|(i, t)| (i, (t + offset).floor()))
            .collect();
        pictures.push((usize::MAX, pictures[56].1 + 30.0));
        let times: Vec<_> = pictures.iter().map(|(_, t)| Some((*t, 1.0))).collect();
        let matching = match_exposures(&times, &log());
        for ((i, _), found) in pictures.iter().zip(&matching.exposure) {
            assert_eq!(*found, (*i != usize::MAX).then_some(*i));
        }
        assert!((matching.offset_s.unwrap_or(0.0) - offset + 0.5).abs() < 0.2, "{:?}", matching.offset_s);
        assert!(matching.rivals.is_empty());
    }

    #[test]
    fn evenly_spaced_exposures_that_fit_twice_are_called_ambiguous() {
        let log: Vec<f64> = (0..30).map(|i| 2.0 * f64::from(i)).collect();
        let pictures: Vec<_> = (0..20).map(|i| Some((1000.0 + 2.0 * f64::from(i), 0.001))).collect();
        let matching = match_exposures(&pictures, &log);
        assert!(matching.exposure.iter().all(Option::is_some));
        let mut first: Vec<_> =
            matching.rivals.iter().chain([&matching.exposure]).map(|exposure| exposure[0]).collect();
        first.sort();
        assert_eq!(
            first,
            (0..11).map(Some).collect::<Vec<_>>(),
            "the first picture is any of the first eleven exposures"
        );
    }

    #[test]
    fn pictures_without_times_are_counted_only_when_none_is_missing() {
        assert_eq!(match_exposures(&[None; 60], &log()).exposure[59], Some(59));
        assert_eq!(match_exposures(&[None; 59], &log()).exposure, vec![None; 59]);
    }
}
