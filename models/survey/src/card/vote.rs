//! What the pictures of a card say of one another: positions and heights that cannot be true beside their neighbours' are
//! found by vote, corrected from them where that is possible, down-weighted, and named. Attitudes are checked later, by
//! the pictures themselves.

use geometry::geodesy::EnuFrame;
use geometry::median;
use glam::DVec3;

use super::notes::Notes;
use super::record::{Fix, GPS_SIGMA_M, Record};

/// A pause longer than this separates two flights, nanoseconds (five minutes: a change of battery).
const PAUSE_NS: u64 = 300_000_000_000;
/// Neighbours on either side that vote.
const WINDOW: usize = 3;
/// What a barometer drifts within a flight, metres: brighton_beach's heights lie 0.16 m rms from its reconstruction's,
/// three times that for longer flights.
const BAROMETER_M: f64 = 0.5;
/// Deviations from the neighbours, metres, below which nobody is accused whatever the statistics say.
const MIN_JUMP_M: f64 = 30.0;
/// Deviations beyond this many times the usual one are contradictions.
const OUTLIER: f64 = 6.0;
/// No aircraft that maps is faster, m/s.
const MAX_SPEED_M_S: f64 = 70.0;
/// Barometers of two flights from one place differ by less than this, metres.
const SAME_TAKE_OFF_M: f64 = 5.0;

/// Pictures in a row without a position that may be placed between those before and after.
const FEW: f64 = 3.0;
/// What is known of where others were taken, at the least, metres.
const ANYWHERE_M: f64 = 100.0;

pub(super) fn settle(records: &mut [Record], notes: &mut Notes) {
    for flight in flights(records) {
        heights(&mut records[flight.clone()], notes);
        jumps(&mut records[flight], notes);
    }
    steps(records, notes);
    fill(records, notes);
}

/// Ranges of pictures without a pause between them.
pub(super) fn flights(records: &[Record]) -> Vec<std::ops::Range<usize>> {
    let mut flights: Vec<std::ops::Range<usize>> = Vec::new();
    for i in 0..records.len() {
        let pause = i > 0
            && match (records[i - 1].time_ns, records[i].time_ns) {
                (Some(a), Some(b)) => b.0.abs_diff(a.0) > PAUSE_NS,
                _ => records[i - 1].path.parent() != records[i].path.parent(),
            };
        match flights.last_mut() {
            Some(last) if !pause => last.end = i + 1,
            _ => flights.push(i..i + 1),
        }
    }
    flights
}

/// Median and median absolute deviation as a standard deviation.
fn spread(values: &[f64]) -> Option<(f64, f64)> {
    let center = median(&mut values.to_vec())?;
    let mut away: Vec<f64> = values.iter().map(|v| (v - center).abs()).collect();
    Some((center, 1.4826 * median(&mut away)?))
}

/// GPS height against the height above take-off: their difference is one number for a flight. Where a picture's is
/// another, the one of the two that is further from the flight's own is wrong.
fn heights(flight: &mut [Record], notes: &mut Notes) {
    let gps = |r: &Record| r.fix.map(|f| f.position.alt_m);
    let difference = |r: &Record| Some(gps(r)? - r.relative_alt_m?);
    let all: Vec<f64> = flight.iter().filter_map(difference).collect();
    let Some((usual, sigma)) = spread(&all).filter(|_| all.len() >= 3) else { return };
    let usual_gps = median(&mut flight.iter().filter_map(gps).collect::<Vec<_>>()).unwrap_or_default();
    let limit = (OUTLIER * sigma).max(MIN_JUMP_M);
    for r in flight.iter_mut() {
        let (Some(off), Some(above)) = (difference(r).map(|d| d - usual), r.relative_alt_m) else { continue };
        let Some(fix) = r.fix.as_mut() else { continue };
        if off.abs() <= limit {
            // Against the others of its flight, the picture's height is the barometer's.
            fix.sigma_m[1] = fix.sigma_m[1].min(BAROMETER_M.max(sigma));
            continue;
        }
        let gps_is_wrong = (fix.position.alt_m - usual_gps).abs() >= (above - (usual_gps - usual)).abs();
        let [wrong, taken] = match gps_is_wrong {
            true => ["GPS height", "height above take-off"],
            false => ["height above take-off", "GPS height"],
        };
        notes.add(
            format!("its {wrong} contradicts its {taken} by {:.0} m; the latter is taken", off.abs()),
            r.name.clone(),
        );
        match gps_is_wrong {
            true => fix.position.alt_m = usual + above,
            false => r.relative_alt_m = Some(fix.position.alt_m - usual),
        }
        fix.sigma_m[1] = fix.sigma_m[1].max(GPS_SIGMA_M);
    }
}

/// Positions that no aircraft can have flown to from those around them.
fn jumps(flight: &mut [Record], notes: &mut Notes) {
    let Some(first) = flight.iter().find_map(|r| r.fix) else { return };
    let frame = EnuFrame::new(first.position);
    let places: Vec<Option<DVec3>> = flight.iter().map(|r| r.fix.map(|f| frame.to_enu(f.position))).collect();
    let mut wrong = Vec::new();
    let off = |i: usize| -> Option<(DVec3, DVec3, f64)> {
        let place = places[i]?;
        let near = (i.saturating_sub(WINDOW)..(i + WINDOW + 1).min(places.len())).filter(|j| *j != i);
        let others: Vec<(usize, DVec3)> = near.filter_map(|j| Some((j, places[j]?))).collect();
        if others.len() < 3 {
            return None;
        }
        let axis = |f: fn(&DVec3) -> f64| median(&mut others.iter().map(|o| f(&o.1)).collect::<Vec<_>>());
        let center = DVec3::new(axis(|p| p.x)?, axis(|p| p.y)?, axis(|p| p.z)?);
        // What the neighbours themselves are away from their middle: the length of a leg is no contradiction.
        let mut reach: Vec<f64> = others.iter().map(|o| o.1.distance(center)).collect();
        reach.sort_by(f64::total_cmp);
        let reach = reach[reach.len() - 1 - usize::from(reach.len() > 3)];
        Some((place - center, center, reach))
    };
    for i in 0..flight.len() {
        let Some((away, center, reach)) = off(i) else { continue };
        let seconds = |j: usize| match (flight[i].time_ns, flight[j].time_ns) {
            (Some(a), Some(b)) => Some(a.0.abs_diff(b.0) as f64 * 1e-9 + 1.0),
            _ => None,
        };
        let too_fast = |j: usize| match (places[i], places[j], seconds(j)) {
            (Some(a), Some(b), Some(s)) => a.distance(b) > MAX_SPEED_M_S * s + MIN_JUMP_M,
            _ => true,
        };
        let beside = [i.checked_sub(1), Some(i + 1).filter(|j| *j < flight.len())];
        let horizontal = away.truncate().length() > OUTLIER * reach.max(0.5 * MIN_JUMP_M)
            && beside.into_iter().flatten().all(too_fast);
        let vertical = away.z.abs() > MIN_JUMP_M.max(OUTLIER * 0.5 * vertical_reach(&places, i, center.z));
        if horizontal || vertical {
            wrong.push((i, away, center, horizontal));
        }
    }
    for (i, away, center, horizontal) in wrong {
        let Some(fix) = &mut flight[i].fix else { continue };
        let what = match horizontal {
            true => {
                format!("its position lies {:.0} m from its neighbours'; taken from them", away.truncate().length())
            }
            false => format!("its height is {:.0} m off its neighbours'; taken from them", away.z.abs()),
        };
        let sigma = if horizontal { away.truncate().length().min(100.0) } else { fix.sigma_m[0] };
        let place = places[i].unwrap_or(center);
        let mended = if horizontal { center } else { DVec3::new(place.x, place.y, center.z) };
        *fix = Fix { position: frame.to_geodetic(mended), sigma_m: [sigma, fix.sigma_m[1].max(10.0)] };
        notes.add(what, flight[i].name.clone());
    }
}

fn vertical_reach(places: &[Option<DVec3>], i: usize, center: f64) -> f64 {
    let near = (i.saturating_sub(WINDOW)..(i + WINDOW + 1).min(places.len())).filter(|j| *j != i);
    let mut away: Vec<f64> = near.filter_map(|j| Some((places[j]?.z - center).abs())).collect();
    median(&mut away).unwrap_or(0.0)
}

/// Two flights with a step in height: the same take-off, by the height above it, and another GPS height.
fn steps(records: &mut [Record], notes: &mut Notes) {
    let offset_of = |r: &Record| Some(r.fix?.position.alt_m - r.relative_alt_m?);
    let ranges = flights(records);
    let offsets: Vec<Option<f64>> = ranges
        .iter()
        .map(|range| median(&mut records[range.clone()].iter().filter_map(offset_of).collect::<Vec<_>>()))
        .collect();
    let Some((largest, reference)) =
        ranges.iter().zip(&offsets).filter_map(|(r, o)| Some((r.len(), (*o)?))).max_by_key(|l| l.0)
    else {
        return;
    };
    if largest < 3 {
        return;
    }
    for (range, offset) in ranges.into_iter().zip(offsets) {
        let Some(step) = offset.map(|o| o - reference) else { continue };
        // Up to 200 m it is the receiver's or the barometer's; more may be another hill to start from.
        if step.abs() <= SAME_TAKE_OFF_M || step.abs() > 200.0 {
            continue;
        }
        for r in &mut records[range] {
            if let Some(fix) = &mut r.fix {
                fix.position.alt_m -= step;
                // The take-off may have been another: the step itself is how far the height may be off.
                fix.sigma_m[1] = fix.sigma_m[1].max(step.abs());
            }
            notes.add(
                format!("a flight whose GPS heights lie {step:+.0} m off the others' over the same take-off; moved"),
                r.name.clone(),
            );
        }
    }
}

/// Largest horizontal distance of a position from the first, metres.
fn extent(records: &[Record]) -> f64 {
    let Some(first) = records.iter().find_map(|r| r.fix) else { return 0.0 };
    let frame = EnuFrame::new(first.position);
    let away = records.iter().filter_map(|r| Some(frame.to_enu(r.fix?.position).truncate().length()));
    away.fold(0.0, f64::max)
}

/// Pictures without a position take it from those before and after: between these where they are few, else somewhere on the card.
fn fill(records: &mut [Record], notes: &mut Notes) {
    let known: Vec<usize> = (0..records.len()).filter(|&i| records[i].fix.is_some()).collect();
    if known.is_empty() {
        return;
    }
    // Anywhere that the others were.
    let anywhere_m = extent(records).max(ANYWHERE_M);
    for i in 0..records.len() {
        if records[i].fix.is_some() {
            continue;
        }
        let after = known.partition_point(|k| *k < i);
        let (before, after) = (after.checked_sub(1).map(|k| known[k]), known.get(after).copied());
        let fix = |j: Option<usize>| j.and_then(|j| records[j].fix);
        let filled = match (fix(before), fix(after)) {
            (Some(a), Some(b)) => {
                let time = |j: Option<usize>| j.and_then(|j| records[j].time_ns).map(|t| t.0 as f64);
                let (from, to) = (before.unwrap_or(i) as f64, after.unwrap_or(i) as f64);
                let share = match (time(before), time(Some(i)), time(after)) {
                    (Some(s), Some(t), Some(e)) if e > s => (t - s) / (e - s),
                    _ => (i as f64 - from) / (to - from),
                };
                let frame = EnuFrame::new(a.position);
                let way = frame.to_enu(b.position);
                let position = frame.to_geodetic(way * share);
                match to - from <= FEW + 1.0 {
                    true => Fix { position, sigma_m: [(0.5 * way.length()).max(GPS_SIGMA_M); 2] },
                    false => Fix { position, sigma_m: [anywhere_m, 30.0] },
                }
            }
            (Some(a), None) | (None, Some(a)) => Fix { sigma_m: [anywhere_m, 30.0], ..a },
            (None, None) => continue,
        };
        let what = match filled.sigma_m[0] >= anywhere_m {
            true => format!(
                "has no GPS position (or 0, 0), nor have those beside it; within {anywhere_m:.0} m, for the pictures to tell (--geotags or --log would say)"
            ),
            false => "has no GPS position (or 0, 0); taken from the pictures beside it".to_owned(),
        };
        records[i].fix = Some(filled);
        notes.add(what, records[i].name.clone());
    }
}
