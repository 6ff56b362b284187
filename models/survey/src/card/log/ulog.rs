//! Exposures out of a PX4 log (`.ulg`, ULog 1): `camera_capture` (an exposure with its place), else `camera_trigger` (a command or a pulse
//! of the hot-shoe), placed between what `vehicle_global_position`, else the receiver, and `vehicle_attitude` say. The format's
//! description: <https://docs.px4.io/main/en/dev_log/ulog_file_format>. The crates that read it panic on cut messages or end at the
//! first damaged one; a log of a power cut has both.

use std::collections::{BTreeMap, HashMap};
use std::io::{BufReader, Read, Seek, SeekFrom};
use std::path::Path;

use geometry::geodesy::Geodetic;
use glam::DQuat;
use models::formats::FormatError;

use super::number::Number;
use super::{MAX_EXPOSURES, SIGMA_M, Series, Source, by_time, camera_attitude, too_many};
use crate::card::exposures::Exposure;
use crate::card::record::Fix;

/// What a log begins with; its version and the start's time stamp follow.
pub(super) const MAGIC: [u8; 7] = [0x55, 0x4C, 0x6F, 0x67, 0x01, 0x12, 0x35];
const HEADER: u64 = 16;
/// A message of this content stands between others, so that a reader finds the next one after damage.
const SYNC: [u8; 11] = [8, 0, b'S', 0x2F, 0x73, 0x13, 0x20, 0x25, 0x0C, 0xBB, 0x12];
/// All kinds of messages.
const KINDS: &[u8] = b"BFIMPQARDLCSO";
/// Bytes of descriptions of messages, all together.
const MAX_DESCRIBED: usize = 4 << 20;
/// Types within types.
const DEEPEST: usize = 8;
/// Subscriptions to the topics below, repeated ones included: more than any autopilot has cameras, receivers and estimators.
const MAX_SUBSCRIBED: usize = 1024;
/// The fields that are read.
const FIELDS: [&str; 10] =
    ["timestamp", "lat", "latitude_deg", "lon", "longitude_deg", "alt", "altitude_msl_m", "q", "result", "feedback"];
/// Places and attitudes between which exposures are placed: ten a second for five hours.
const MAX_SAMPLES: usize = 200_000;
const SAMPLE_US: u64 = 100_000;
/// A place farther from a sample than this is not told by it, microseconds.
const NEAR_US: u64 = 1_000_000;
/// A hundred years since the autopilot's start.
const MAX_TIME_US: u64 = 100 * 366 * 86_400 * 1_000_000;

/// Type, elements (0 where it is no array) and name of a field.
type Field = (String, usize, String);

/// Where a message's fields stand.
struct Topic {
    kind: Kind,
    instance: u8,
    /// Where a field begins and what its elements are, of those that are read.
    fields: HashMap<String, (usize, Number)>,
}

#[derive(Clone, Copy, PartialEq, Eq)]
enum Kind {
    Capture,
    Trigger,
    Place,
    Receiver,
    Attitude,
}

impl Kind {
    fn named(topic: &str) -> Option<Self> {
        Some(match topic {
            "camera_capture" => Self::Capture,
            "camera_trigger" => Self::Trigger,
            "vehicle_global_position" => Self::Place,
            "vehicle_gps_position" => Self::Receiver,
            "vehicle_attitude" => Self::Attitude,
            _ => return None,
        })
    }
}

impl Topic {
    /// An element of a field as a number.
    fn number(&self, data: &[u8], name: &str, element: usize) -> Option<f64> {
        let (at, number) = *self.fields.get(name)?;
        number.read(data, at + element * number.size())
    }

    fn quaternion(&self, data: &[u8]) -> Option<DQuat> {
        let q = |i| self.number(data, "q", i);
        Some(DQuat::from_xyzw(q(1)?, q(2)?, q(3)?, q(0)?)).filter(|q| (0.9..1.1).contains(&q.length()))
    }
}

fn simple(kind: &str) -> Option<Number> {
    Some(match kind {
        "int8_t" => Number::I8,
        "uint8_t" | "bool" | "char" => Number::U8,
        "int16_t" => Number::I16,
        "uint16_t" => Number::U16,
        "int32_t" => Number::I32,
        "uint32_t" => Number::U32,
        "int64_t" => Number::I64,
        "uint64_t" => Number::U64,
        "float" => Number::F32,
        "double" => Number::F64,
        _ => return None,
    })
}

/// Samples by time, microseconds since the start.
struct Track<T> {
    samples: Vec<(u64, T)>,
}

impl<T> Default for Track<T> {
    fn default() -> Self {
        Self { samples: Vec::new() }
    }
}

impl<T: Copy> Track<T> {
    /// A damaged time stamp far ahead keeps none of the later samples out.
    fn add(&mut self, time_us: u64, value: T) {
        let due = self.samples.last().is_none_or(|last| time_us.abs_diff(last.0) >= SAMPLE_US);
        if due && self.samples.len() < MAX_SAMPLES {
            self.samples.push((time_us, value));
        }
    }

    fn in_order(&mut self) {
        self.samples.sort_by_key(|s| s.0);
    }

    /// The samples on both sides of `time_us` and the share of the second one; `None` where either is far.
    fn around(&self, time_us: u64) -> Option<(T, T, f64)> {
        let after = self.samples.partition_point(|s| s.0 < time_us);
        let (a, b) = (self.samples.get(after.saturating_sub(1))?, self.samples.get(after).or(self.samples.last())?);
        if time_us.abs_diff(a.0) > NEAR_US || time_us.abs_diff(b.0) > NEAR_US {
            return None;
        }
        let share = if b.0 > a.0 { time_us.saturating_sub(a.0) as f64 / (b.0 - a.0) as f64 } else { 0.0 };
        Some((a.1, b.1, share.min(1.0)))
    }
}

/// What a log says of one exposure.
struct Event {
    time_us: u64,
    fix: Option<Geodetic>,
    camera: Option<DQuat>,
    is_pulse: bool,
}

/// What a log holds.
#[derive(Default)]
struct Found {
    captures: BTreeMap<u8, Vec<Event>>,
    triggers: BTreeMap<u8, Vec<Event>>,
    count: usize,
    places: Track<Geodetic>,
    receiver: Track<Geodetic>,
    attitudes: Track<DQuat>,
}

impl Found {
    fn take(&mut self, topic: &Topic, data: &[u8]) -> Option<()> {
        let of = |name: &str| topic.number(data, name, 0);
        let time_us = of("timestamp").filter(|t| (0.0..MAX_TIME_US as f64).contains(t))? as u64;
        // Degrees and metres; whole numbers are ten millionths of a degree and thousandths of a metre.
        let scaled = |name: &str, whole: f64| {
            let (_, number) = *topic.fields.get(name)?;
            Some(of(name)? * if number == Number::I32 { whole } else { 1.0 })
        };
        let place = || {
            let position = Geodetic {
                lat_deg: scaled("latitude_deg", 1.0).or_else(|| scaled("lat", 1e-7))?,
                lon_deg: scaled("longitude_deg", 1.0).or_else(|| scaled("lon", 1e-7))?,
                alt_m: scaled("altitude_msl_m", 1.0).or_else(|| scaled("alt", 1e-3))?,
            };
            (position.is_valid() && (position.lat_deg, position.lon_deg) != (0.0, 0.0)).then_some(position)
        };
        match topic.kind {
            Kind::Place => self.places.add(time_us, place()?),
            Kind::Receiver => self.receiver.add(time_us, place()?),
            Kind::Attitude => self.attitudes.add(time_us, topic.quaternion(data)?),
            Kind::Capture | Kind::Trigger => {
                // 0: the camera says that it took none.
                let failed = topic.kind == Kind::Capture && of("result") == Some(0.0);
                if failed {
                    return None;
                }
                self.count += 1;
                if self.count > MAX_EXPOSURES {
                    return None;
                }
                let list = if topic.kind == Kind::Capture { &mut self.captures } else { &mut self.triggers };
                let camera = topic.quaternion(data);
                let is_pulse = of("feedback") == Some(1.0);
                list.entry(topic.instance).or_default().push(Event { time_us, fix: place(), camera, is_pulse });
            }
        }
        Some(())
    }

    fn placed(&self, event: &Event) -> Option<Exposure> {
        let between = |track: &Track<Geodetic>| {
            let (a, b, share) = track.around(event.time_us)?;
            let mix = |a: f64, b: f64| a + (b - a) * share;
            Some(Geodetic {
                lat_deg: mix(a.lat_deg, b.lat_deg),
                lon_deg: mix(a.lon_deg, b.lon_deg),
                alt_m: mix(a.alt_m, b.alt_m),
            })
        };
        let position = event.fix.or_else(|| between(&self.places)).or_else(|| between(&self.receiver))?;
        let own = event.camera.and_then(camera_attitude);
        let attitude = own.or_else(|| {
            let (a, b, share) = self.attitudes.around(event.time_us)?;
            camera_attitude(a.slerp(b, share))
        });
        Some(Exposure { time_s: event.time_us as f64 * 1e-6, fix: Fix { position, sigma_m: SIGMA_M }, attitude })
    }

    fn series(mut self, path: &Path) -> Result<Vec<Series>, FormatError> {
        if self.count > MAX_EXPOSURES {
            return Err(too_many(path));
        }
        self.places.in_order();
        self.receiver.in_order();
        self.attitudes.in_order();
        let triggers: usize = self.triggers.values().map(Vec::len).sum();
        let mut lists = std::mem::take(&mut self.captures);
        if lists.is_empty() {
            lists = std::mem::take(&mut self.triggers);
            for list in lists.values_mut() {
                // A pulse of the hot-shoe is the exposure, the command is not.
                if list.iter().any(|e| e.is_pulse) {
                    list.retain(|e| e.is_pulse);
                }
            }
        }
        let of = |(camera, list): (u8, Vec<Event>)| {
            let exposures = list.iter().filter_map(|e| self.placed(e)).collect();
            Ok(Series {
                source: Source { camera: Some(camera), ..Source::default() },
                exposures: by_time(path, exposures)?,
            })
        };
        let mut series = lists.into_iter().map(of).collect::<Result<Vec<Series>, FormatError>>()?;
        series.retain(|s| !s.exposures.is_empty());
        let what = match (series.is_empty(), triggers) {
            (false, _) => return Ok(series),
            (true, 0) => {
                "holds no exposures (topics camera_capture or camera_trigger); was the camera triggered by the autopilot, and does SDLOG_PROFILE log it?"
            }
            (true, _) => {
                "holds exposures without a place: neither camera_capture nor vehicle_global_position or vehicle_gps_position gives one"
            }
        };
        Err(FormatError::invalid(path, what))
    }
}

/// Messages of a file, one after the other, past damage and to where appended ones begin.
struct Messages<'p, R> {
    path: &'p Path,
    reader: R,
    at: u64,
    /// Where data begin that were appended after a crash.
    appended: Vec<u64>,
    message: Vec<u8>,
}

impl<R: Read + Seek> Messages<'_, R> {
    /// Fills `message` with `len` bytes, or fewer at the end of the file.
    fn fill(&mut self, len: usize) -> Result<bool, FormatError> {
        self.message.clear();
        let read = self.reader.by_ref().take(len as u64).read_to_end(&mut self.message);
        let read = read.map_err(|e| FormatError::io(self.path, "reading", e))?;
        self.at += read as u64;
        Ok(read == len)
    }

    /// The kind of the next message, whose content is then in `message`.
    fn next(&mut self) -> Result<Option<u8>, FormatError> {
        loop {
            if !self.fill(3)? {
                return Ok(None);
            }
            let (size, kind) = (usize::from(u16::from_le_bytes([self.message[0], self.message[1]])), self.message[2]);
            let (start, end) = (self.at - 3, self.at + size as u64);
            // What was written when the power failed is cut off where the appended data begin.
            if let Some(cut) = self.appended.iter().position(|to| start < *to && *to < end) {
                self.at = self.appended.swap_remove(cut);
                self.reader.seek(SeekFrom::Start(self.at)).map_err(|e| FormatError::io(self.path, "reading", e))?;
                continue;
            }
            match () {
                () if KINDS.contains(&kind) => return Ok(self.fill(size)?.then_some(kind)),
                () => {
                    if !self.after_sync()? {
                        return Ok(None);
                    }
                }
            }
        }
    }

    /// Passes over everything up to the end of the next mark.
    fn after_sync(&mut self) -> Result<bool, FormatError> {
        let mut last = [0u8; SYNC.len()];
        while last != SYNC {
            if !self.fill(1)? {
                return Ok(false);
            }
            last.rotate_left(1);
            last[SYNC.len() - 1] = self.message[0];
        }
        Ok(true)
    }
}

/// Reads the exposures of the log at `path`.
///
/// # Errors
/// The file cannot be read, is no such log, describes more messages than any log, or holds no exposures that it places.
pub fn read(path: &Path) -> Result<Vec<Series>, FormatError> {
    let file = disk::regular::open(path).map_err(|e| FormatError::io(path, "opening", e))?;
    let reader = BufReader::with_capacity(1 << 16, file);
    let mut messages = Messages { path, reader, at: 0, appended: Vec::new(), message: Vec::with_capacity(1 << 16) };
    if !messages.fill(HEADER as usize)? || !messages.message.starts_with(&MAGIC) {
        return Err(FormatError::invalid(path, "not a PX4 log (.ulg)"));
    }
    let (mut formats, mut described) = (HashMap::<String, Vec<Field>>::new(), 0);
    let (mut topics, mut subscribed, mut found) = (HashMap::<u16, Topic>::new(), 0, Found::default());
    while let Some(kind) = messages.next()? {
        let data = messages.message.as_slice();
        match kind {
            b'B' => {
                // One bit is known: data are appended. What others mean a reader cannot guess (the format's description).
                if data.get(8..16).is_some_and(|flags| flags[0] & !1 != 0 || flags[1..].iter().any(|f| *f != 0)) {
                    return Err(FormatError::invalid(
                        path,
                        "is of a later edition of PX4's logs than this build knows",
                    ));
                }
                let offsets = data.get(16..40).unwrap_or_default().chunks_exact(8);
                let offsets = offsets.filter_map(|b| Some(u64::from_le_bytes(b.try_into().ok()?)));
                messages.appended = offsets.filter(|at| *at > HEADER).collect();
            }
            b'F' => {
                described += data.len();
                if described > MAX_DESCRIBED {
                    return Err(FormatError::invalid(path, "describes more messages than any PX4 log does"));
                }
                formats.extend(format(data));
            }
            b'A' => {
                let (Some(instance), Some(id), Some(name)) = (data.first(), data.get(1..3), data.get(3..)) else {
                    continue;
                };
                let id = u16::from_le_bytes([id[0], id[1]]);
                let name = String::from_utf8_lossy(name);
                let name = name.trim_end_matches('\0');
                let Some(kind) = Kind::named(name) else {
                    topics.remove(&id);
                    continue;
                };
                subscribed += 1;
                if subscribed > MAX_SUBSCRIBED {
                    return Err(FormatError::invalid(path, "subscribes to more topics than any PX4 log does"));
                }
                let fields = fields(&formats, name).unwrap_or_default();
                topics.insert(id, Topic { kind, instance: *instance, fields });
            }
            b'D' => {
                let Some((id, data)) = data.split_first_chunk::<2>() else { continue };
                if let Some(topic) = topics.get(&u16::from_le_bytes(*id)) {
                    found.take(topic, data);
                }
            }
            _ => {}
        }
    }
    found.series(path)
}

/// `name:type field;type[3] field;…`.
fn format(message: &[u8]) -> Option<(String, Vec<Field>)> {
    let text = std::str::from_utf8(message).ok()?;
    let (name, fields) = text.split_once(':')?;
    let field = |text: &str| {
        let (kind, name) = text.trim().split_once(' ')?;
        let (kind, elements) = match kind.split_once('[') {
            Some((kind, n)) => (kind, n.strip_suffix(']')?.parse().ok().filter(|n| (1..=65_535).contains(n))?),
            None => (kind, 0),
        };
        Some((kind.to_owned(), elements, name.to_owned()))
    };
    let fields: Option<Vec<Field>> = fields.split(';').filter(|f| !f.trim().is_empty()).map(field).collect();
    Some((name.to_owned(), fields?))
}

/// Where the fields of `name` begin and what their elements are, of those that are read.
fn fields(formats: &HashMap<String, Vec<Field>>, name: &str) -> Option<HashMap<String, (usize, Number)>> {
    let (mut at, mut fields) = (0usize, HashMap::new());
    for (kind, elements, field) in formats.get(name)? {
        if let Some(number) = simple(kind).filter(|_| FIELDS.contains(&field.as_str())) {
            fields.insert(field.clone(), (at, number));
        }
        at = at.checked_add(size_of(formats, kind, DEEPEST)?.checked_mul((*elements).max(1))?)?;
        if at > usize::from(u16::MAX) {
            return None;
        }
    }
    Some(fields)
}

fn size_of(formats: &HashMap<String, Vec<Field>>, kind: &str, deep: usize) -> Option<usize> {
    if let Some(number) = simple(kind) {
        return Some(number.size());
    }
    let mut size = 0usize;
    for (kind, elements, _) in formats.get(kind).filter(|_| deep > 0)? {
        size = size.checked_add(size_of(formats, kind, deep - 1)?.checked_mul((*elements).max(1))?)?;
        if size > usize::from(u16::MAX) {
            return None;
        }
    }
    // A type of nothing could be nested without end.
    (size > 0).then_some(size)
}

#[cfg(test)]
#[allow(clippy::unwrap_used)] // a test may
mod tests;
