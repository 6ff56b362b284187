//! Exposures out of an ArduPilot log ("DataFlash"), binary or as text: messages that describe themselves (FMT), of which CAM (an exposure
//! with the camera's feedback) or else TRIG (the command to take one) say where and how the aircraft was.

use std::collections::{BTreeMap, HashMap};
use std::io::{BufRead, BufReader, Read};
use std::path::Path;

use geometry::geodesy::Geodetic;
use models::formats::FormatError;

use super::number::Number;
use super::{MAX_EXPOSURES, SIGMA_M, Series, Source, by_time, too_many};
use crate::card::exposures::Exposure;
use crate::card::record::{Attitude, AttitudeSource, Fix, nadir_rotation};

const HEADER: [u8; 2] = [0xA3, 0x95];
/// Type and length of the message that describes messages.
const FMT: (u8, usize) = (128, 89);
/// Longest line of a log in text.
const MAX_LINE: u64 = 4096;

/// A hundred years after the autopilot's start: no log is longer, and what is further off is damaged.
const MAX_TIME_US: f64 = 100.0 * 366.0 * 86_400.0 * 1e6;
const WEEK_S: f64 = 604_800.0;

struct Format {
    length: usize,
    name: String,
    /// Type letter, offset in the message and label of every field.
    fields: Vec<(u8, usize, String)>,
}

/// Whether a file that begins with `head` is a binary log.
pub(super) fn is_binary(head: &[u8]) -> bool {
    head.starts_with(&HEADER) || head.windows(3).any(|w| w == [HEADER[0], HEADER[1], FMT.0])
}

/// Whether a file that begins with `head` is a log in text: a line of it describes messages.
pub(super) fn is_text(head: &[u8]) -> bool {
    !head.contains(&0) && head.split(|b| *b == b'\n').any(|line| line.trim_ascii_start().starts_with(b"FMT,"))
}

/// Reads the exposures of the binary log at `path`; CAM messages when there are any of a camera, else TRIG.
///
/// # Errors
/// The file cannot be read, is no such log, or holds neither message.
pub fn read(path: &Path) -> Result<Vec<Series>, FormatError> {
    let file = disk::regular::open(path).map_err(|e| FormatError::io(path, "opening", e))?;
    let mut bytes = BufReader::with_capacity(1 << 16, file).bytes();
    let mut next = || bytes.next().transpose().map_err(|e| FormatError::io(path, "reading", e));
    let mut formats: HashMap<u8, Format> = HashMap::new();
    let mut found = Found::default();
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
            found.take(&format.name, &|names| format.number(&message, names));
        }
    }
    if formats.is_empty() {
        return Err(FormatError::invalid(path, "not an ArduPilot log (.BIN): it describes no messages"));
    }
    found.series(path)
}

/// Reads the exposures of a log that a program wrote out as text: lines of comma-separated cells, of which FMT name the columns.
///
/// # Errors
/// The file cannot be read, or holds no exposures.
pub fn read_text(path: &Path) -> Result<Vec<Series>, FormatError> {
    let file = disk::regular::open(path).map_err(|e| FormatError::io(path, "opening", e))?;
    let mut reader = BufReader::with_capacity(1 << 16, file);
    let mut labels: HashMap<String, Vec<String>> = HashMap::new();
    let (mut found, mut line, mut within) = (Found::default(), Vec::new(), false);
    loop {
        line.clear();
        let read = reader.by_ref().take(MAX_LINE).read_until(b'\n', &mut line);
        if read.map_err(|e| FormatError::io(path, "reading", e))? == 0 {
            break;
        }
        // The rest of a line that is too long begins no other.
        let begins = !std::mem::replace(&mut within, line.last() != Some(&b'\n'));
        let text = String::from_utf8_lossy(&line);
        let mut cells = text.split(',').map(str::trim);
        let name = cells.next().filter(|_| begins).unwrap_or_default();
        if name == "FMT" {
            // FMT, type, length, name, letters, labels.
            let described = cells.nth(2).unwrap_or_default().to_owned();
            if is_exposure(&described) {
                labels.insert(described, cells.skip(1).map(str::to_owned).collect());
            }
        } else if let Some(labels) = labels.get(name) {
            let cells: Vec<&str> = cells.collect();
            found.take(name, &|names| {
                let at = labels.iter().position(|label| names.contains(&label.as_str()))?;
                cells.get(at)?.parse::<f64>().ok().filter(|v| v.is_finite())
            });
        }
    }
    found.series(path)
}

fn is_exposure(message: &str) -> bool {
    matches!(message, "CAM" | "TRIG")
}

/// An exposure on the clocks that its message has.
struct Stamped {
    since_boot_s: Option<f64>,
    gps_s: Option<f64>,
    exposure: Exposure,
}

/// What a log holds, by camera.
#[derive(Default)]
struct Found {
    feedback: BTreeMap<Option<u8>, Vec<Stamped>>,
    triggers: BTreeMap<Option<u8>, Vec<Stamped>>,
    count: usize,
}

impl Found {
    /// A message whose fields `of` gives by any of their names.
    fn take(&mut self, message: &str, of: &dyn Fn(&[&str]) -> Option<f64>) {
        let list = match message {
            "CAM" => &mut self.feedback,
            "TRIG" => &mut self.triggers,
            _ => return,
        };
        let Some(stamped) = stamped(of) else { return };
        self.count += 1;
        if self.count <= MAX_EXPOSURES {
            // Older ArduPilots number no cameras.
            let camera = of(&["I", "Instance"]).filter(|n| (0.0..256.0).contains(n)).map(|n| n as u8);
            list.entry(camera).or_default().push(stamped);
        }
    }

    fn series(mut self, path: &Path) -> Result<Vec<Series>, FormatError> {
        if self.count > MAX_EXPOSURES {
            return Err(too_many(path));
        }
        self.triggers.retain(|camera, _| !self.feedback.contains_key(camera));
        let of = |(camera, list): (Option<u8>, Vec<Stamped>)| {
            // ArduPilot before 3.3 logs no time since its start.
            let boot = list.iter().all(|s| s.since_boot_s.is_some());
            let time = |s: &Stamped| if boot { s.since_boot_s } else { s.gps_s };
            let timed = list.iter().filter_map(|s| Some(Exposure { time_s: time(s)?, ..s.exposure }));
            let exposures = by_time(path, timed.collect())?;
            Ok(Series { source: Source { camera, ..Source::default() }, exposures })
        };
        let all = self.feedback.into_iter().chain(self.triggers);
        let mut series = all.map(of).collect::<Result<Vec<Series>, FormatError>>()?;
        series.retain(|s| !s.exposures.is_empty());
        match series.is_empty() {
            false => Ok(series),
            true => Err(FormatError::invalid(
                path,
                "holds no exposures (messages CAM or TRIG with time and place); was the camera triggered by the autopilot?",
            )),
        }
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

/// How a letter stores its numbers, and what they are divided by.
fn number(letter: u8) -> Option<(Number, f64)> {
    Some(match letter {
        b'b' => (Number::I8, 1.0),
        b'B' | b'M' => (Number::U8, 1.0),
        b'h' => (Number::I16, 1.0),
        b'H' => (Number::U16, 1.0),
        b'c' => (Number::I16, 100.0),
        b'C' => (Number::U16, 100.0),
        b'i' => (Number::I32, 1.0),
        b'I' => (Number::U32, 1.0),
        b'e' => (Number::I32, 100.0),
        b'E' => (Number::U32, 100.0),
        b'L' => (Number::I32, 1e7),
        b'f' => (Number::F32, 1.0),
        b'd' => (Number::F64, 1.0),
        b'q' => (Number::I64, 1.0),
        b'Q' => (Number::U64, 1.0),
        _ => return None,
    })
}

fn size(letter: u8) -> Option<usize> {
    Some(match letter {
        b'n' => 4,
        b'N' => 16,
        b'Z' | b'a' => 64,
        // A float of 16 bits.
        b'g' => 2,
        _ => number(letter)?.0.size(),
    })
}

impl Format {
    /// A field as a number, by any of its names.
    fn number(&self, message: &[u8], names: &[&str]) -> Option<f64> {
        let (letter, at, _) = self.fields.iter().find(|f| names.contains(&f.2.as_str()))?;
        let (number, divisor) = number(*letter)?;
        Some(number.read(message, *at)? / divisor)
    }
}

fn stamped(of: &dyn Fn(&[&str]) -> Option<f64>) -> Option<Stamped> {
    let position = Geodetic { lat_deg: of(&["Lat"])?, lon_deg: of(&["Lng", "Lon"])?, alt_m: of(&["Alt"])? };
    if !position.is_valid() || (position.lat_deg, position.lon_deg) == (0.0, 0.0) {
        return None;
    }
    let angles = of(&["Y", "Yaw"]).zip(of(&["P", "Pitch"])).zip(of(&["R", "Roll"]));
    let attitude = angles.map(|((yaw, pitch), roll)| Attitude {
        rotation: nadir_rotation(yaw, pitch, roll),
        source: AttitudeSource::Airframe,
    });
    let boot_us = of(&["TimeUS"]).or_else(|| Some(of(&["TimeMS"])? * 1e3));
    let since_boot_s = boot_us.filter(|us| (0.0..MAX_TIME_US).contains(us)).map(|us| us * 1e-6);
    // Milliseconds of a week.
    let gps = of(&["GPSWeek"]).zip(of(&["GPSTime"]).map(|ms| ms * 1e-3));
    let gps_s = gps.filter(|(w, s)| (1.0..10_000.0).contains(w) && (0.0..WEEK_S).contains(s));
    let exposure = Exposure { time_s: 0.0, fix: Fix { position, sigma_m: SIGMA_M }, attitude };
    let gps_s = gps_s.map(|(week, s)| week * WEEK_S + s);
    (since_boot_s.is_some() || gps_s.is_some()).then_some(Stamped { since_boot_s, gps_s, exposure })
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
        let series = read(&path).unwrap();
        assert_eq!((series.len(), series[0].exposures.len()), (1, 5));
        let e = series[0].exposures[2];
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
        let times: Vec<f64> = read(&path).unwrap()[0].exposures.iter().map(|e| e.time_s).collect();
        assert_eq!(times, [2.0, 3.0]);
    }

    #[test]
    fn a_log_cut_anywhere_gives_what_came_before_and_no_log_is_an_error() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("1.BIN");
        let whole = log(3);
        for len in 0..whole.len() {
            std::fs::write(&path, &whole[..len]).unwrap();
            assert!(read(&path).is_err() || read(&path).unwrap()[0].exposures.len() <= 3, "{len}");
        }
        std::fs::write(&path, fmt(200, 11, "XYZ", "Q", "TimeUS")).unwrap();
        assert!(read(&path).unwrap_err().to_string().contains("CAM or TRIG"));
        std::fs::write(&path, "not a log").unwrap();
        assert!(read(&path).unwrap_err().to_string().contains("not an ArduPilot log"));
    }

    /// A message of letters `format`, each value as its letter stores it.
    fn message(id: u8, format: &str, values: &[f64]) -> Vec<u8> {
        let mut m = vec![0xA3, 0x95, id];
        for (letter, v) in format.bytes().zip(values) {
            match letter {
                b'B' => m.push(*v as u8),
                b'H' => m.extend((*v as u16).to_le_bytes()),
                b'c' => m.extend(((v * 100.0).round() as i16).to_le_bytes()),
                b'C' => m.extend(((v * 100.0).round() as u16).to_le_bytes()),
                b'I' => m.extend((*v as u32).to_le_bytes()),
                b'e' => m.extend(((v * 100.0).round() as i32).to_le_bytes()),
                b'L' => m.extend(((v * 1e7).round() as i32).to_le_bytes()),
                b'Q' => m.extend((*v as u64).to_le_bytes()),
                other => panic!("{other}"),
            }
        }
        m
    }

    /// Exposure `i`: 3 s after the one before, to the north.
    fn place(i: u32) -> [f64; 3] {
        [46.8426 + 1e-4 * f64::from(i), -91.9945, 198.3]
    }

    #[test]
    fn layouts_of_every_age_are_read_by_what_the_log_says_of_them() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("1.BIN");
        // ArduCopter 3.2: no time since the start; 3.1: milliseconds; 4.5: number of camera and picture.
        type Layout<'l> = (&'l str, &'l str, &'l dyn Fn(u32) -> Vec<f64>);
        let layouts: [Layout<'_>; 3] = [
            ("IHLLeeccC", "GPSTime,GPSWeek,Lat,Lng,Alt,RelAlt,Roll,Pitch,Yaw", &|i| {
                let [lat, lng, alt] = place(i);
                vec![400_000_000.0 + 3000.0 * f64::from(i), 1902.0, lat, lng, alt, 40.0, 0.0, 0.0, 90.0]
            }),
            ("ILLecCc", "TimeMS,Lat,Lng,Alt,Pitch,Yaw,Roll", &|i| {
                let [lat, lng, alt] = place(i);
                vec![7000.0 + 3000.0 * f64::from(i), lat, lng, alt, 0.0, 90.0, 0.0]
            }),
            ("QBHIHLLeeeccC", "TimeUS,I,Img,GPSTime,GPSWeek,Lat,Lng,Alt,RelAlt,GPSAlt,R,P,Y", &|i| {
                let [lat, lng, alt] = place(i);
                let time = 7e6 + 3e6 * f64::from(i);
                vec![time, 0.0, f64::from(i), 0.0, 0.0, lat, lng, alt, 40.0, alt, 0.0, 0.0, 90.0]
            }),
        ];
        for (format, labels, of) in layouts {
            let length = message(43, format, &of(0)).len() as u8;
            let mut log = fmt(43, length, "CAM", format, labels);
            (0..4).for_each(|i| log.extend(message(43, format, &of(i))));
            std::fs::write(&path, log).unwrap();
            let series = read(&path).unwrap();
            let [Series { exposures, .. }] = series.as_slice() else { panic!("{labels}: {series:?}") };
            assert_eq!(exposures.len(), 4, "{labels}");
            for (i, e) in exposures.iter().enumerate() {
                let [lat, lng, alt] = place(i as u32);
                let p = e.fix.position;
                assert!((p.lat_deg - lat).abs() < 1e-7 && (p.lon_deg - lng).abs() < 1e-7 && p.alt_m == alt, "{p:?}");
                assert!((e.time_s - exposures[0].time_s - 3.0 * i as f64).abs() < 1e-6, "{labels}: {}", e.time_s);
                let turned = e.attitude.unwrap().rotation.angle_between(nadir_rotation(90.0, 0.0, 0.0));
                assert!(turned < 1e-6, "{labels}: {turned}");
            }
        }
    }

    #[test]
    fn a_log_as_text_says_what_the_binary_one_says_whatever_it_is_called() {
        let dir = tempfile::tempdir().unwrap();
        let (binary, text) = (dir.path().join("2026-11-01 10-00-00.log"), dir.path().join("flight.txt"));
        let (format, labels) = ("QBLLeccC", "TimeUS,I,Lat,Lng,Alt,R,P,Y");
        let of = |i: u32| {
            let [lat, lng, alt] = place(i);
            [7e6 + 3e6 * f64::from(i), 0.0, lat, lng, alt, 1.0, -2.0, 90.0]
        };
        let mut bytes = fmt(43, message(43, format, &of(0)).len() as u8, "CAM", format, labels);
        let mut lines = format!(
            "FMT, 128, 89, FMT, BBnNZ, Type,Length,Name,Format,Columns\r\nFMT, 43, 32, CAM, {format}, {labels}\r\n"
        );
        lines += &format!("MSG, {}\r\nCAM, damaged\r\n", "x".repeat(10_000));
        for i in 0..4 {
            bytes.extend(message(43, format, &of(i)));
            let cells: Vec<String> = of(i).iter().map(f64::to_string).collect();
            lines += &format!("CAM, {}\r\n", cells.join(", "));
        }
        std::fs::write(&binary, bytes).unwrap();
        std::fs::write(&text, lines).unwrap();
        let [a, b] = [&binary, &text].map(|path| super::super::read(path).unwrap().unwrap());
        assert_eq!((a.len(), a[0].exposures.len()), (1, 4));
        for (a, b) in a[0].exposures.iter().zip(&b[0].exposures) {
            assert!((a.time_s, a.fix.position.alt_m) == (b.time_s, b.fix.position.alt_m), "{a:?} {b:?}");
            assert!((a.fix.position.lat_deg - b.fix.position.lat_deg).abs() < 1e-7);
            assert!(a.attitude.unwrap().rotation.angle_between(b.attitude.unwrap().rotation) < 1e-6);
        }
    }

    #[test]
    fn two_cameras_are_two_series_and_a_command_counts_where_no_feedback_came() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("1.BIN");
        let (format, labels) = ("QBLLe", "TimeUS,Instance,Lat,Lng,Alt");
        let of = |i: u32, camera: f64| [7e6 + 3e6 * f64::from(i), camera, 46.0, 7.0, 400.0];
        let length = message(43, format, &of(0, 0.0)).len() as u8;
        let mut log = [fmt(43, length, "CAM", format, labels), fmt(44, length, "TRIG", format, labels)].concat();
        for i in 0..5 {
            log.extend(message(44, format, &of(i, 0.0)));
            log.extend(message(44, format, &of(i, 2.0)));
            if i < 3 {
                log.extend(message(43, format, &of(i, 0.0)));
            }
        }
        std::fs::write(&path, log).unwrap();
        let found: Vec<_> = read(&path).unwrap().iter().map(|s| (s.source.camera, s.exposures.len())).collect();
        assert_eq!(found, [(Some(0), 3), (Some(2), 5)]);
    }

    #[test]
    fn a_camera_that_the_log_numbers_keeps_its_number_and_a_clock_that_starts_again_is_refused() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("1.BIN");
        std::fs::write(&path, log(5)).unwrap();
        assert_eq!(read(&path).unwrap()[0].source.camera, Some(0));
        std::fs::write(&path, [log(5), log(4)].concat()).unwrap();
        let error = read(&path).unwrap_err().to_string();
        assert!(error.contains("starts again after 5 exposures") && !error.contains('\n'), "{error}");
    }

    #[test]
    fn gps_weeks_count_on_and_what_has_no_week_or_no_place_is_left_out() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("1.BIN");
        let mut bytes = fmt(43, 21, "CAM", "IHLLe", "GPSTime,GPSWeek,Lat,Lng,Alt");
        let end_ms = WEEK_S * 1e3;
        for (ms, week, lat) in [
            (end_ms - 4000.0, 1902.0, 46.0),
            (end_ms - 1000.0, 1902.0, 46.0),
            (2000.0, 1903.0, 46.0),
            (3000.0, 0.0, 46.0),
            (4000.0, 1903.0, 0.0),
        ] {
            let lng = if lat == 0.0 { 0.0 } else { 7.0 };
            bytes.extend(message(43, "IHLLe", &[ms, week, lat, lng, 400.0]));
        }
        std::fs::write(&path, bytes).unwrap();
        let exposures = read(&path).unwrap().remove(0).exposures;
        let since: Vec<f64> = exposures.iter().map(|e| e.time_s - exposures[0].time_s).collect();
        assert_eq!(since, [0.0, 3.0, 6.0]);
    }

    #[test]
    fn the_rest_of_a_line_that_is_too_long_is_no_exposure() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("flight.log");
        let long = format!("MSG, {}CAM, 2000000, 46.0, 7.0, 400\n", "x".repeat(MAX_LINE as usize - 5));
        let text = format!("FMT, 43, 23, CAM, QLLe, TimeUS,Lat,Lng,Alt\nCAM, 1000000, 46.0, 7.0, 400\n{long}");
        std::fs::write(&path, text).unwrap();
        assert_eq!(read_text(&path).unwrap()[0].exposures.len(), 1);
    }

    #[test]
    fn more_exposures_than_any_flight_has_are_refused() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("1.BIN");
        let one = message(43, "QLLe", &[7e6, 46.0, 7.0, 400.0]);
        let bytes = [fmt(43, 23, "CAM", "QLLe", "TimeUS,Lat,Lng,Alt"), one.repeat(MAX_EXPOSURES + 1)].concat();
        std::fs::write(&path, bytes).unwrap();
        let error = read(&path).unwrap_err().to_string();
        assert!(error.contains("more than") && !error.contains('\n'), "{error}");
    }

    #[test]
    fn a_layout_that_is_described_anew_counts_from_there() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("1.BIN");
        let mut bytes = Vec::new();
        for (from, format, labels) in [(0, "QLLe", "TimeUS,Lat,Lng,Alt"), (3, "QeLL", "TimeUS,Alt,Lng,Lat")] {
            bytes.extend(fmt(43, 23, "CAM", format, labels));
            for i in from..from + 3 {
                let ([lat, lng, alt], time) = (place(i), 7e6 + 3e6 * f64::from(i));
                let values = if from == 0 { [time, lat, lng, alt] } else { [time, alt, lng, lat] };
                bytes.extend(message(43, format, &values));
            }
        }
        std::fs::write(&path, bytes).unwrap();
        let exposures = read(&path).unwrap().remove(0).exposures;
        assert_eq!(exposures.len(), 6);
        for (i, e) in (0..).zip(&exposures) {
            let ([lat, lng, alt], p) = (place(i), e.fix.position);
            assert!((p.lat_deg - lat).abs() < 1e-7 && (p.lon_deg - lng).abs() < 1e-7 && p.alt_m == alt, "{i}: {p:?}");
        }
    }
}
