//! Exposures out of an ArduPilot log (`.BIN`, "DataFlash"): messages that describe themselves (FMT), of which CAM (an exposure
//! with the camera's feedback) or else TRIG (the command to take one) say where and how the aircraft was.

use std::collections::HashMap;
use std::io::{BufReader, Read};
use std::path::Path;

use geometry::geodesy::Geodetic;

use super::exposures::Exposure;
use super::record::{Attitude, AttitudeSource, Fix, nadir_rotation};
use models::formats::FormatError;

const HEADER: [u8; 2] = [0xA3, 0x95];
/// Type and length of the message that describes messages.
const FMT: (u8, usize) = (128, 89);
/// Exposures of one log: more than any card holds.
const MAX_EXPOSURES: usize = 200_000;
/// What the autopilot's estimate is worth at an exposure, metres (a recorded survey: 0.17 m against the truth at most, GPS
/// itself 1.5 m).
const SIGMA_M: [f64; 2] = [1.5, 2.0];

/// A hundred years after the autopilot's start: no log is longer, and what is further off is damaged.
const MAX_TIME_US: f64 = 100.0 * 366.0 * 86_400.0 * 1e6;

struct Format {
    length: usize,
    name: String,
    /// Type letter, offset in the message and label of every field.
    fields: Vec<(u8, usize, String)>,
}

/// Reads the exposures of the log at `path`, in order; CAM messages when there are any, else TRIG.
///
/// # Errors
/// The file cannot be read, is no such log, or holds neither message.
pub fn read(path: &Path) -> Result<Vec<Exposure>, FormatError> {
    let file = disk::regular::open(path).map_err(|e| FormatError::io(path, "opening", e))?;
    let mut bytes = BufReader::with_capacity(1 << 16, file).bytes();
    let mut next = || bytes.next().transpose().map_err(|e| FormatError::io(path, "reading", e));
    let mut formats: HashMap<u8, Format> = HashMap::new();
    let (mut feedback, mut triggers) = (Vec::new(), Vec::new());
    let (mut message, mut last) = (Vec::with_capacity(256), 0);
    // Bytes that belong to no message are passed over: logs of a power cut have holes.
    while let Some(byte) = next()? {
        let begins = [last, byte] == HEADER;
        last = byte;
        if !begins {
            continue;
        }
        let Some(kind) = next()? else { break };
        last = kind;
        let length = if kind == FMT.0 { FMT.1 } else { formats.get(&kind).map_or(0, |f| f.length) };
        if length < 3 {
            continue;
        }
        message.clear();
        while message.len() < length - 3 {
            match next()? {
                Some(b) => message.push(b),
                None => break,
            }
        }
        if message.len() < length - 3 {
            break;
        }
        last = 0;
        if kind == FMT.0 {
            if let Some((id, format)) = described(&message) {
                formats.insert(id, format);
            }
        } else if let Some(format) = formats.get(&kind) {
            let list = match format.name.as_str() {
                "CAM" => &mut feedback,
                "TRIG" => &mut triggers,
                _ => continue,
            };
            if list.len() < MAX_EXPOSURES {
                list.extend(exposure(format, &message));
            }
        }
    }
    if formats.is_empty() {
        return Err(FormatError::invalid(path, "not an ArduPilot log (.BIN): it describes no messages"));
    }
    match [feedback, triggers].into_iter().find(|l| !l.is_empty()) {
        Some(list) => Ok(list),
        None => Err(FormatError::invalid(
            path,
            "holds no exposures (messages CAM or TRIG); was the camera triggered by the autopilot?",
        )),
    }
}

/// `type, length, name[4], format[16], labels[64]`.
fn described(message: &[u8]) -> Option<(u8, Format)> {
    let text = |b: &[u8]| String::from_utf8_lossy(b).trim_end_matches('\0').to_owned();
    let (id, length) = (*message.first()?, usize::from(*message.get(1)?));
    let (letters, labels) = (text(message.get(6..22)?), text(message.get(22..86)?));
    let (mut at, mut fields) = (0, Vec::new());
    for (letter, label) in letters.bytes().zip(labels.split(',')) {
        fields.push((letter, at, label.to_owned()));
        at += size(letter)?;
    }
    (at + 3 <= length).then(|| (id, Format { length, name: text(&message[2..6]), fields }))
}

fn size(letter: u8) -> Option<usize> {
    Some(match letter {
        b'b' | b'B' | b'M' => 1,
        b'h' | b'H' | b'c' | b'C' | b'g' => 2,
        b'i' | b'I' | b'e' | b'E' | b'L' | b'f' | b'n' => 4,
        b'q' | b'Q' | b'd' => 8,
        b'N' => 16,
        b'Z' | b'a' => 64,
        _ => return None,
    })
}

impl Format {
    /// A field as a number, by any of its names.
    fn number(&self, message: &[u8], names: &[&str]) -> Option<f64> {
        let (letter, at, _) = self.fields.iter().find(|f| names.contains(&f.2.as_str()))?;
        let b = message.get(*at..at + size(*letter)?)?;
        let value = match letter {
            b'b' => f64::from(b[0] as i8),
            b'B' | b'M' => f64::from(b[0]),
            b'h' => f64::from(i16::from_le_bytes(b.try_into().ok()?)),
            b'H' => f64::from(u16::from_le_bytes(b.try_into().ok()?)),
            b'c' => f64::from(i16::from_le_bytes(b.try_into().ok()?)) / 100.0,
            b'C' => f64::from(u16::from_le_bytes(b.try_into().ok()?)) / 100.0,
            b'i' => f64::from(i32::from_le_bytes(b.try_into().ok()?)),
            b'I' => f64::from(u32::from_le_bytes(b.try_into().ok()?)),
            b'e' => f64::from(i32::from_le_bytes(b.try_into().ok()?)) / 100.0,
            b'E' => f64::from(u32::from_le_bytes(b.try_into().ok()?)) / 100.0,
            b'L' => f64::from(i32::from_le_bytes(b.try_into().ok()?)) / 1e7,
            b'f' => f64::from(f32::from_le_bytes(b.try_into().ok()?)),
            b'd' => f64::from_le_bytes(b.try_into().ok()?),
            b'q' => i64::from_le_bytes(b.try_into().ok()?) as f64,
            b'Q' => u64::from_le_bytes(b.try_into().ok()?) as f64,
            _ => return None,
        };
        value.is_finite().then_some(value)
    }
}

fn exposure(format: &Format, message: &[u8]) -> Option<Exposure> {
    let of = |names: &[&str]| format.number(message, names);
    let position = Geodetic { lat_deg: of(&["Lat"])?, lon_deg: of(&["Lng"])?, alt_m: of(&["Alt"])? };
    if !position.is_valid() || (position.lat_deg, position.lon_deg) == (0.0, 0.0) {
        return None;
    }
    let angles = of(&["Y", "Yaw"]).zip(of(&["P", "Pitch"])).zip(of(&["R", "Roll"]));
    let attitude = angles.map(|((yaw, pitch), roll)| Attitude {
        rotation: nadir_rotation(yaw, pitch, roll),
        source: AttitudeSource::Airframe,
    });
    let time_s = of(&["TimeUS"]).filter(|us| (0.0..MAX_TIME_US).contains(us))? * 1e-6;
    Some(Exposure { time_s, fix: Fix { position, sigma_m: SIGMA_M }, attitude })
}

#[cfg(test)]
#[allow(clippy::unwrap_used)] // a test may
mod tests {
    use super::*;

    fn fmt(id: u8, length: u8, name: &str, format: &str, labels: &str) -> Vec<u8> {
        let mut m = vec![0xA3, 0x95, 128, id, length];
        for (text, size) in [(name, 4), (format, 16), (labels, 64)] {
            let mut field = text.as_bytes().to_vec();
            field.resize(size, 0);
            m.extend(field);
        }
        m
    }

    /// A log as ArduCopter 4 writes it: FMT of CAM and of something else, and garbage between.
    fn log(exposures: u32) -> Vec<u8> {
        let mut log = fmt(200, 11, "XYZ", "Q", "TimeUS");
        log.extend(fmt(201, 44, "CAM", "QBIHLLeeeccC", "TimeUS,I,GPSTime,GPSWeek,Lat,Lng,Alt,RelAlt,GPSAlt,R,P,Y"));
        for i in 0..exposures {
            log.extend([0xA3, 0x95, 200]);
            log.extend(7u64.to_le_bytes());
            log.extend([0xA3, 0x00, 0x95]);
            log.extend([0xA3, 0x95, 201]);
            log.extend((1_000_000 + 2_000_000 * u64::from(i)).to_le_bytes());
            log.push(0);
            log.extend([0; 6]);
            for v in [468_426_000 + i as i32, -919_945_000, 19_830, 4_000, 19_900] {
                log.extend(v.to_le_bytes());
            }
            log.extend(1000i16.to_le_bytes());
            log.extend((-500i16).to_le_bytes());
            log.extend(9000u16.to_le_bytes());
        }
        log
    }

    #[test]
    fn exposures_of_an_ardupilot_log_have_place_time_and_the_airframes_attitude() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("1.BIN");
        std::fs::write(&path, log(5)).unwrap();
        let read_ = read(&path).unwrap();
        assert_eq!(read_.len(), 5);
        let e = read_[2];
        assert_eq!((e.time_s, e.fix.position.alt_m), (5.0, 198.3));
        assert!((e.fix.position.lat_deg - 46.842_600_2).abs() < 1e-9);
        let expected = nadir_rotation(90.0, -5.0, 10.0);
        assert!(e.attitude.unwrap().rotation.angle_between(expected) < 1e-6);
    }

    #[test]
    fn an_exposure_before_all_time_is_damaged_and_left_out() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("1.BIN");
        let mut log = fmt(201, 23, "CAM", "dLLe", "TimeUS,Lat,Lng,Alt");
        for time in [2e6, -1e308, 1e308, 3e6] {
            log.extend([0xA3, 0x95, 201]);
            log.extend(f64::to_le_bytes(time));
            log.extend([468_426_000, -919_945_000, 19_830].iter().flat_map(|v: &i32| v.to_le_bytes()));
        }
        std::fs::write(&path, log).unwrap();
        let times: Vec<f64> = read(&path).unwrap().iter().map(|e| e.time_s).collect();
        assert_eq!(times, [2.0, 3.0]);
    }

    #[test]
    fn a_log_cut_anywhere_gives_what_came_before_and_no_log_is_an_error() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("1.BIN");
        let whole = log(3);
        for len in 0..whole.len() {
            std::fs::write(&path, &whole[..len]).unwrap();
            assert!(read(&path).is_err() || read(&path).unwrap().len() <= 3, "{len}");
        }
        std::fs::write(&path, fmt(200, 11, "XYZ", "Q", "TimeUS")).unwrap();
        assert!(read(&path).unwrap_err().to_string().contains("CAM or TRIG"));
        std::fs::write(&path, "not a log").unwrap();
        assert!(read(&path).unwrap_err().to_string().contains("not an ArduPilot log"));
    }
}
