//! Sources of position judged against one another, before any of them is believed: what contradicts the pictures' own word is refused or
//! left out, and named once.

use std::path::Path;

use geometry::geodesy::{EnuFrame, Geodetic};
use geometry::median;

use super::control::SurveyedPoint;
use super::notes::{Notes, name_list};
use super::record::{Record, UNKNOWN_HEIGHT_SIGMA_M};
use models::formats::FormatError;

/// A file of positions farther from the pictures' own GPS than this is of another place, metres: receivers err by tens.
const FAR_M: f64 = 2000.0;
/// Surveyed points lie no farther outside of the pictures' positions than this, metres: no mapping camera sees farther to the side.
const BESIDE_M: f64 = 3000.0;
/// Heights above the ellipsoid and above the sea differ by up to 107 m (EGM2008), metres.
const GEOID_M: f64 = 110.0;
/// No mapping flight is higher above its ground, metres.
const ABOVE_M: f64 = 1500.0;
/// What terrain and the scale of heights may differ by from the take-off, metres.
const RELIEF_M: f64 = 300.0;
/// Positions nearer than this are one, metres.
const ONE_PLACE_M: f64 = 0.3;
/// So many pictures in a row at one place to the last digit are a receiver that stands still.
const STUCK: usize = 5;
/// How far they may be from there, metres.
const STUCK_SIGMA_M: f64 = 50.0;

/// Refuses positions that lie far from those that the same pictures state. `pairs` are the pictures' own and the file's.
pub(super) fn near_what_pictures_say(file: &Path, pairs: &[(Geodetic, Geodetic)]) -> Result<(), FormatError> {
    let Some((first, _)) = pairs.first() else { return Ok(()) };
    let frame = EnuFrame::new(*first);
    let moved = pairs.iter().any(|(own, _)| frame.to_enu(*own).truncate().length() > ONE_PLACE_M);
    // A receiver that never moved says nothing against anybody.
    if pairs.len() > 2 && !moved {
        return Ok(());
    }
    let away = |other: &dyn Fn(Geodetic) -> Geodetic| {
        let distance =
            |(own, theirs): &(Geodetic, Geodetic)| EnuFrame::new(*own).to_enu(other(*theirs)).truncate().length();
        median(&mut pairs.iter().map(distance).collect::<Vec<_>>()).unwrap_or_default()
    };
    let off = away(&|p| p);
    if off <= FAR_M {
        return Ok(());
    }
    let swapped = away(&|p| Geodetic { lat_deg: p.lon_deg.clamp(-90.0, 90.0), lon_deg: p.lat_deg, alt_m: p.alt_m });
    let mend = match swapped <= FAR_M {
        true => "write longitude before latitude",
        false => "mend the reference system in its first line, or the order of coordinates",
    };
    let what = format!("its positions lie {:.0} km from what the pictures themselves say; {mend}", off / 1000.0);
    Err(FormatError::invalid(file, what))
}

/// Where the pictures' own positions say that surveyed points can lie.
struct Reach {
    frame: EnuFrame,
    /// Distance from the middle, metres.
    horizontal: f64,
    /// Heights of the lowest and the highest picture, and of the take-off.
    heights: [f64; 2],
    ground: Option<f64>,
}

impl Reach {
    fn of(records: &[Record]) -> Option<Self> {
        let fixes: Vec<Geodetic> = records.iter().filter_map(|r| Some(r.fix?.position)).collect();
        let middle = |f: fn(&Geodetic) -> f64| median(&mut fixes.iter().map(f).collect::<Vec<_>>());
        let frame = EnuFrame::new(Geodetic {
            lat_deg: middle(|p| p.lat_deg)?,
            lon_deg: middle(|p| p.lon_deg)?,
            alt_m: middle(|p| p.alt_m)?,
        });
        let mut away: Vec<f64> = fixes.iter().map(|p| frame.to_enu(*p).truncate().length()).collect();
        let mut heights: Vec<f64> = records
            .iter()
            .filter_map(|r| r.fix.filter(|f| f.sigma_m[1] < UNKNOWN_HEIGHT_SIGMA_M))
            .map(|f| f.position.alt_m)
            .collect();
        away.sort_by(f64::total_cmp);
        heights.sort_by(f64::total_cmp);
        // One in twenty may be wrong itself.
        let most = |of: &[f64]| of.get((of.len() * 19 / 20).min(of.len().saturating_sub(1))).copied();
        let least = heights.get(heights.len() / 20).copied().unwrap_or(f64::NEG_INFINITY);
        let above = records.iter().filter_map(|r| Some(r.fix?.position.alt_m - r.relative_alt_m?));
        let ground = median(&mut above.collect::<Vec<_>>());
        Some(Self {
            frame,
            horizontal: most(&away)? + BESIDE_M,
            heights: [least, most(&heights).unwrap_or(f64::INFINITY)],
            ground,
        })
    }

    fn holds_height(&self, alt_m: f64) -> bool {
        let of_take_off = self.ground.is_none_or(|ground| (alt_m - ground).abs() <= RELIEF_M);
        of_take_off && alt_m <= self.heights[1] + GEOID_M && alt_m >= self.heights[0] - ABOVE_M - GEOID_M
    }
}

/// Leaves out surveyed points that lie nowhere near the pictures, and takes no heights from those whose heights cannot be; one line each.
///
/// # Errors
/// None of the points is near the pictures.
pub(super) fn judge_points(
    file: &Path,
    points: &mut Vec<SurveyedPoint>,
    records: &[Record],
    lines: &mut Vec<String>,
) -> Result<(), FormatError> {
    let Some(reach) = Reach::of(records) else { return Ok(()) };
    let names = |of: &[SurveyedPoint]| name_list_of(of.iter().map(|p| p.name.as_str()));
    let away = |p: &SurveyedPoint| reach.frame.to_enu(p.position).truncate().length();
    let all = points.len();
    let far: Vec<SurveyedPoint> = points.extract_if(.., |p| away(p) > reach.horizontal).collect();
    if let Some(km) = median(&mut far.iter().map(|p| away(p) / 1000.0).collect::<Vec<_>>()) {
        if far.len() == all {
            let what = format!(
                "its points lie {km:.0} km from where the pictures say they were taken; mend the zone, the hemisphere or the order of coordinates, or take the file away"
            );
            return Err(FormatError::invalid(file, what));
        }
        lines.push(format!(
            "{}: {} of {all} surveyed points ({}) lie {km:.0} km from the pictures; left out",
            file.display(),
            far.len(),
            names(&far)
        ));
    }
    let zero = points.iter().all(|p| p.position.alt_m == 0.0);
    let impossible: Vec<usize> =
        (0..points.len()).filter(|&i| zero || !reach.holds_height(points[i].position.alt_m)).collect();
    if impossible.is_empty() {
        return Ok(());
    }
    let in_metres = |alt_m: f64| reach.holds_height(alt_m * 0.3048);
    let why = match zero {
        true => "are all 0",
        false if impossible.iter().all(|&i| in_metres(points[i].position.alt_m)) => {
            "contradict the pictures' (are they in feet?)"
        }
        false => "contradict the pictures'",
    };
    lines.push(format!(
        "{}: the heights of {} of {all} surveyed points ({}) {why}; only their places are used",
        file.display(),
        impossible.len(),
        name_list_of(impossible.iter().map(|&i| points[i].name.as_str()))
    ));
    let [low, _] = reach.heights;
    let ground = reach.ground.unwrap_or(if low.is_finite() { low - 50.0 } else { 0.0 });
    for i in impossible {
        points[i].position.alt_m = ground;
        points[i].sigma_m[1] = UNKNOWN_HEIGHT_SIGMA_M;
    }
    Ok(())
}

fn name_list_of<'a>(names: impl Iterator<Item = &'a str>) -> String {
    let names: Vec<&str> = names.collect();
    let spelt = names.iter().take(8).copied().collect::<Vec<_>>().join(", ");
    if names.len() > 8 { format!("{spelt}, …") } else { spelt }
}

/// Takes a receiver that stood still at its word only where the aircraft can have: positions that are all one are none, and a long run of
/// equal ones among others is worth little.
pub(super) fn standing_still(records: &mut [Record], lines: &mut Vec<String>, notes: &mut Notes) {
    let stated: Vec<usize> = (0..records.len()).filter(|&i| records[i].fix.is_some()).collect();
    let place = |records: &[Record], i: usize| records[i].fix.map(|f| f.position);
    let Some(first) = stated.first().and_then(|&i| place(records, i)) else { return };
    let frame = EnuFrame::new(first);
    let near = |p: Option<Geodetic>| p.is_some_and(|p| frame.to_enu(p).truncate().length() < ONE_PLACE_M);
    if stated.len() >= 3 && stated.iter().all(|&i| near(place(records, i))) {
        let names: Vec<&String> = stated.iter().map(|&i| &records[i].name).collect();
        lines.push(format!(
            "{}: all state one position, which tells nothing of where each was taken; not used",
            name_list(&names)
        ));
        stated.iter().for_each(|&i| records[i].fix = None);
        return;
    }
    let same = |a: Option<Geodetic>, b: Option<Geodetic>| {
        a.zip(b).is_some_and(|(a, b)| (a.lat_deg, a.lon_deg) == (b.lat_deg, b.lon_deg))
    };
    let mut from = 0;
    while from < records.len() {
        let at = place(records, from);
        let to = (from + 1..records.len()).find(|&i| !same(at, place(records, i))).unwrap_or(records.len());
        if to - from >= STUCK && at.is_some() {
            for r in &mut records[from..to] {
                if let Some(fix) = &mut r.fix {
                    fix.sigma_m[0] = fix.sigma_m[0].max(STUCK_SIGMA_M);
                }
                notes.add(
                    "states the position of the pictures beside it to the last digit; believed within 50 m",
                    r.name.clone(),
                );
            }
        }
        from = to;
    }
}
