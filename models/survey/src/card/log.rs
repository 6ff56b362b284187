//! A flight log beside the card: who exposed, where and when. Logs of fleets and of several cameras hold exposures of others, too:
//! each source is matched for itself, and the one that the pictures fit is taken.

use std::io::Read;
use std::path::{Path, PathBuf};

use geometry::geodesy::EnuFrame;
use geometry::median;
use glam::{DQuat, DVec3, EulerRot};
use models::formats::FormatError;
use models::formats::telemetry::dji_rotation;

use super::exposures::{Exposure, Matching, match_exposures};
use super::record::{Attitude, AttitudeSource, Record, in_order, nadir_rotation};

pub mod dataflash;
mod number;
pub mod ulog;

/// Bytes at the beginning of a file by which its format is told.
const HEAD: usize = 64 << 10;
/// Exposures of one log: more than any card holds.
pub const MAX_EXPOSURES: usize = 200_000;
/// What the autopilot's estimate is worth at an exposure, horizontal and vertical, metres (a recorded survey: 0.17 m against the truth at
/// most, GPS itself 1.5 m).
pub const SIGMA_M: [f64; 2] = [1.5, 2.0];
/// Log-likelihood by which a source must fit better than another (a thousand to one).
const DECISIVE: f64 = 7.0;
/// What a picture without exposure and an exposure without picture cost, log-likelihood (one in fifty, one in twenty).
const LONE_PICTURE: f64 = 4.0;
const LONE_EXPOSURE: f64 = 3.0;
/// Standard deviation of a shutter's lag, seconds.
const LAG_S: f64 = 0.05;
/// Standard deviations by which the exposures' places may differ from the pictures' own.
const FAR: f64 = 5.0;

/// A multicopter with a camera below it leans no further, a gimbal that looks down is turned further; degrees.
const LEANS_DEG: f64 = 30.0;
const LOOKS_DOWN_DEG: f64 = -60.0;

/// What took the exposures of a series.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord)]
pub struct Source {
    /// MAVLink system, where the log tells it.
    pub system: Option<u8>,
    /// MAVLink component, where the log tells it.
    pub component: Option<u8>,
    /// Number of the camera, where the log tells it.
    pub camera: Option<u8>,
}

impl std::fmt::Display for Source {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let named = [("system", self.system), ("component", self.component), ("camera", self.camera)];
        let parts: Vec<String> = named.iter().filter_map(|(what, n)| Some(format!("{what} {}", (*n)?))).collect();
        f.write_str(if parts.is_empty() { "its camera" } else { "" })?;
        f.write_str(&parts.join(", "))
    }
}

/// Exposures of one camera, in order.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Series {
    /// What took them.
    pub source: Source,
    /// Exposures, by time.
    pub exposures: Vec<Exposure>,
}

/// A log, and whose exposures are asked for.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct FlightLog {
    /// Where it lies.
    pub path: PathBuf,
    /// All that it holds.
    pub series: Vec<Series>,
    /// Only of this system.
    pub system: Option<u8>,
    /// Only of this camera.
    pub camera: Option<u8>,
}

/// Reads the log at `path`, whatever it is called: ArduPilot's (binary or text) or PX4's. `None` where it is neither; it may be MAVLink.
///
/// # Errors
/// The file cannot be read, or holds no exposures.
pub fn read(path: &Path) -> Result<Option<Vec<Series>>, FormatError> {
    let file = disk::regular::open(path).map_err(|e| FormatError::io(path, "opening", e))?;
    let mut head = Vec::with_capacity(HEAD);
    file.take(HEAD as u64).read_to_end(&mut head).map_err(|e| FormatError::io(path, "reading", e))?;
    let named = |extension: &str| path.extension().is_some_and(|e| e.eq_ignore_ascii_case(extension));
    // A time stamp of eight bytes, then a frame: log files that came over the link lie within.
    let is_mavlink = head.first() == Some(&0) && matches!(head.get(8), Some(0xFD | 0xFE));
    Ok(match () {
        () if head.starts_with(&ulog::MAGIC) => Some(ulog::read(path)?),
        () if is_mavlink => None,
        () if dataflash::is_binary(&head) => Some(dataflash::read(path)?),
        () if dataflash::is_text(&head) => Some(dataflash::read_text(path)?),
        () if named("bin") => Some(dataflash::read(path)?),
        () if named("ulg") => Some(ulog::read(path)?),
        () => None,
    })
}

/// Exposures by time, which the log has in the order in which they were written.
///
/// # Errors
/// The clock starts again among them: nothing tells how much later.
fn by_time(path: &Path, mut exposures: Vec<Exposure>) -> Result<Vec<Exposure>, FormatError> {
    // Two before and two after: one damaged time stamp is no start.
    let starts = |w: &[Exposure]| w[0].time_s.min(w[1].time_s) > w[2].time_s.max(w[3].time_s);
    if let Some(at) = exposures.windows(4).position(starts) {
        let what = format!(
            "its clock starts again after {} exposures: it holds more than one flight; give the log of one",
            at + 2
        );
        return Err(FormatError::invalid(path, what));
    }
    exposures.sort_by(|a, b| a.time_s.total_cmp(&b.time_s));
    Ok(exposures)
}

fn too_many(path: &Path) -> FormatError {
    FormatError::invalid(path, format!("reports more than {MAX_EXPOSURES} exposures"))
}

/// A camera's attitude by its quaternion, body (front, right, down) to north-east-down: that of an airframe below which the camera looks
/// down, or of a gimbal that looks down along its front. `None` where it could be either, and for the identity, which stands for none.
pub fn camera_attitude(q: DQuat) -> Option<Attitude> {
    if !(0.9..1.1).contains(&q.length()) || q.abs_diff_eq(DQuat::IDENTITY, 1e-9) {
        return None;
    }
    let q = q.normalize();
    let (yaw, pitch, roll) = q.to_euler(EulerRot::ZYX);
    let [yaw, pitch, roll] = [yaw, pitch, roll].map(f64::to_degrees);
    let lean = (q * DVec3::Z).angle_between(DVec3::Z).to_degrees();
    match () {
        () if lean <= LEANS_DEG => {
            Some(Attitude { rotation: nadir_rotation(yaw, pitch, roll), source: AttitudeSource::Airframe })
        }
        () if pitch <= LOOKS_DOWN_DEG => {
            Some(Attitude { rotation: dji_rotation(yaw, pitch, roll), source: AttitudeSource::Gimbal })
        }
        () => None,
    }
}

/// How well a series explains the pictures.
struct Fit<'s> {
    series: &'s Series,
    matching: Matching,
    matched: usize,
    likelihood: f64,
    /// Median distance from the places that the pictures state, in standard deviations.
    away: Option<f64>,
}

impl<'s> Fit<'s> {
    fn of(series: &'s Series, records: &[Record], times: &[Option<(f64, f64)>]) -> Self {
        let log: Vec<f64> = series.exposures.iter().map(|e| e.time_s).collect();
        let matching = match_exposures(times, &log);
        let pairs = || matching.exposure.iter().enumerate().filter_map(|(i, j)| Some((i, (*j)?)));
        let matched = pairs().count();
        let mut away: Vec<f64> = pairs()
            .filter_map(|(i, j)| {
                let (own, logged) = (records[i].fix?, series.exposures[j].fix);
                let distance = EnuFrame::new(own.position).to_enu(logged.position).truncate().length();
                Some(distance / own.sigma_m[0].hypot(logged.sigma_m[0]))
            })
            .collect();
        let away = median(&mut away);
        Self { series, matching, matched, likelihood: f64::NEG_INFINITY, away }
    }

    /// Of the pictures' times with residuals of `sigma_s`, and of what has no partner between the first pair and the last.
    fn judge(&mut self, times: &[Option<(f64, f64)>], sigma_s: f64) {
        let found = self.matching.exposure.iter().flatten();
        let (first, last) = (found.clone().min(), found.max());
        let between = first.zip(last).map_or(0, |(a, b)| b + 1 - a);
        let offset = self.matching.offset_s.unwrap_or_default();
        let residual = |(t, j): (&Option<(f64, f64)>, &Option<usize>)| {
            Some((*t)?.0 - offset - self.series.exposures[(*j)?].time_s).filter(|_| self.matching.offset_s.is_some())
        };
        let squares: f64 = times.iter().zip(&self.matching.exposure).filter_map(residual).map(|r| r * r).sum();
        self.likelihood = -0.5 * squares / (sigma_s * sigma_s)
            - LONE_PICTURE * (times.len() - self.matched) as f64
            - LONE_EXPOSURE * between.saturating_sub(self.matched) as f64;
    }

    /// Whether both give every picture the same place: cameras that one shutter command fired.
    fn is_twin_of(&self, other: &Self) -> bool {
        let pairs = self.matching.exposure.iter().zip(&other.matching.exposure);
        pairs.into_iter().all(|pair| match pair {
            (Some(a), Some(b)) => {
                let (a, b) = (self.series.exposures[*a].fix, other.series.exposures[*b].fix);
                EnuFrame::new(a.position).to_enu(b.position).length() < a.sigma_m[0]
            }
            (None, None) => true,
            _ => false,
        })
    }

    fn named(&self) -> String {
        let Series { source, exposures } = self.series;
        let first = exposures.first().map(|e| e.fix.position);
        let place = first.map_or(String::new(), |p| format!(" from {:.5}, {:.5}", p.lat_deg, p.lon_deg));
        format!("{source} ({} exposures{place})", exposures.len())
    }
}

/// Gives the pictures the places and attitudes of their exposures; one line about it.
///
/// # Errors
/// No source of the log is the one asked for, none fits the pictures, or several fit equally well.
pub(super) fn apply(log: &FlightLog, records: &mut [Record]) -> Result<String, FormatError> {
    in_order(records);
    let refuse = |what: String| FormatError::invalid(&log.path, what);
    let asked = |s: &&Series| {
        let is = |asked: Option<u8>, source: Option<u8>| asked.is_none() || source.is_none() || asked == source;
        is(log.system, s.source.system) && is(log.camera, s.source.camera)
    };
    let times: Vec<Option<(f64, f64)>> =
        records.iter().map(|r| r.time_ns.map(|(t, resolution)| (t as f64 * 1e-9, resolution as f64 * 1e-9))).collect();
    let mut fits: Vec<Fit<'_>> = log.series.iter().filter(asked).map(|s| Fit::of(s, records, &times)).collect();
    if fits.is_empty() {
        let all: Vec<String> = log.series.iter().map(|s| format!("{} ({})", s.source, s.exposures.len())).collect();
        return Err(refuse(format!(
            "holds no exposures of what --system and --camera ask for; it holds {}",
            all.join("; ")
        )));
    }
    let resolution = times.iter().flatten().map(|t| t.1).fold(0.0, f64::max);
    // Times cut off to whole units are evenly spread over one.
    let least = LAG_S.hypot(resolution / 12f64.sqrt());
    let most = fits.iter().map(|f| f.matched).max().unwrap_or(0);
    let rms = fits.iter().filter(|f| f.matched == most).map(|f| f.matching.rms_s).fold(f64::INFINITY, f64::min);
    fits.iter_mut().for_each(|f| f.judge(&times, rms.clamp(least, 2.0 * least)));
    let near = fits.iter().filter_map(|f| f.away).fold(f64::INFINITY, f64::min);
    if near.is_finite() && near > FAR {
        return Err(refuse(format!(
            "its exposures lie {near:.0} standard deviations from where the pictures say they were taken; give the log of this flight"
        )));
    }
    let (mut fitting, far): (Vec<Fit<'_>>, Vec<Fit<'_>>) =
        fits.into_iter().partition(|f| !near.is_finite() || f.away.is_some_and(|a| a <= FAR));
    // The first of equal ones: the order of the log.
    fitting.sort_by(|a, b| b.likelihood.total_cmp(&a.likelihood));
    let Some(best) = fitting.first().filter(|f| f.matched > 0) else {
        let counts: Vec<String> = log.series.iter().map(|s| s.exposures.len().to_string()).collect();
        return Err(refuse(format!(
            "none of its exposures ({}) is matched to any of {} pictures: those without times are matched only where both are as many",
            counts.join("; "),
            records.len()
        )));
    };
    let rivals: Vec<&Fit<'_>> = fitting[1..]
        .iter()
        .filter(|f| f.matched > 0 && best.likelihood - f.likelihood < DECISIVE && !f.is_twin_of(best))
        .collect();
    if !rivals.is_empty() {
        let all: Vec<String> = std::iter::once(best).chain(rivals.iter().copied()).map(Fit::named).collect();
        let several = rivals.iter().any(|f| f.series.source.system != best.series.source.system);
        let choice = if several { "--system N" } else { "--camera N" };
        return Err(refuse(format!(
            "the pictures fit exposures of several equally well: {}; choose with {choice}",
            all.join("; ")
        )));
    }
    let others: Vec<String> = fitting[1..].iter().filter(|f| !f.is_twin_of(best)).chain(&far).map(Fit::named).collect();
    Ok(give(best, &others, log.system.is_some() || log.camera.is_some(), records))
}

fn give(best: &Fit<'_>, others: &[String], is_asked: bool, records: &mut [Record]) -> String {
    let (exposures, matching) = (&best.series.exposures, &best.matching);
    for (i, r) in records.iter_mut().enumerate() {
        let Some(e) = matching.exposure[i].map(|j| exposures[j]) else { continue };
        let mut fix = e.fix;
        // Where the count may begin elsewhere, each place is as uncertain as the farthest that it would be then.
        let mut away = [0.0f64; 2];
        for other in matching.rivals.iter().filter_map(|rival| Some(exposures[(*rival.get(i)?)?].fix)) {
            let way = EnuFrame::new(fix.position).to_enu(other.position);
            away = [away[0].max(way.truncate().length()), away[1].max(way.z.abs())];
        }
        fix.sigma_m = [fix.sigma_m[0].hypot(away[0]), fix.sigma_m[1].hypot(away[1])];
        r.fix = Some(fix);
        r.relative_alt_m = None;
        r.attitude = e.attitude.or(r.attitude);
    }
    let how = match matching.offset_s {
        Some(offset) => {
            format!("the camera's clock is {offset:+.2} s off the log's, {:.2} s rms remain", matching.rms_s)
        }
        None => "counted, because the pictures have no times".to_owned(),
    };
    let doubt = match matching.rivals.len() {
        0 => String::new(),
        n => format!(
            "; the count may begin elsewhere, too (other offsets that fit: {n}), so that each place is as uncertain as the way to the farthest: check the first picture"
        ),
    };
    let whose = match (best.series.source, others) {
        (source, []) if source.system.is_none() && !is_asked => String::new(),
        (source, []) => format!("; {source}"),
        (source, others) => format!("; {source}, not {}", others.join("; ")),
    };
    format!(
        "flight log: {} of {} pictures matched to {} exposures ({how}{doubt}{whose})",
        best.matched,
        records.len(),
        exposures.len()
    )
}
