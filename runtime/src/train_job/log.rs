//! A flight log beside a card: the exposures that the autopilot reported while it flew.

use std::collections::{BTreeMap, HashSet};
use std::io::Read;
use std::path::Path;

use geometry::geodesy::Geodetic;
use glam::DQuat;
use hal::mavlink::dialect::{CAMERA_FEEDBACK_DATA, CAMERA_IMAGE_CAPTURED_DATA, MavBool};
use hal::mavlink::{Frame, Framer};
use models::formats::FormatError;
use survey::card::log::{MAX_EXPOSURES, SIGMA_M};
use survey::card::{Attitude, AttitudeSource, Exposure, Fix, FlightLog, Series, Source, log, nadir_rotation};

use crate::error::JobError;

/// Cameras that one log reports.
const MAX_CAMERAS: usize = 64;
/// A time stamp stands before each frame of a log: microseconds since 1970, the first byte first.
const STAMP: usize = 8;
/// No link delays one message by so much more than another, microseconds.
const JUMP_US: f64 = 60e6;

/// Exposures of a MAVLink log (`.tlog`), of an ArduPilot log (`.BIN`, or as text) or of a PX4 log (`.ulg`), told by their content.
///
/// # Errors
/// The file cannot be read, or reports no exposures.
pub fn read(path: &Path, system: Option<u8>, camera: Option<u8>) -> Result<FlightLog, JobError> {
    let series = match log::read(path)? {
        Some(series) => series,
        None => of_mavlink(path)?,
    };
    Ok(FlightLog { path: path.to_owned(), series, system, camera })
}

/// The message that a series is made of: a camera may be told of by two.
#[derive(Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
enum Told {
    Feedback,
    Captured,
}

/// An exposure as a frame tells it.
struct Report {
    /// The sender's time, microseconds; 0 where it has none.
    time_us: u64,
    number: i64,
    exposure: Exposure,
}

/// What one source reported.
#[derive(Default)]
struct Reports {
    seen: HashSet<(u64, i64, [u64; 3])>,
    /// Exposures, the sender's times and the log's.
    list: Vec<(Exposure, u64, Option<u64>)>,
}

impl Reports {
    /// A log of two links holds every message twice: the same in time, place and number.
    fn take(&mut self, report: Report, received_us: Option<u64>) -> bool {
        let p = report.exposure.fix.position;
        let place = [p.lat_deg, p.lon_deg, p.alt_m].map(f64::to_bits);
        let is_new = self.seen.insert((report.time_us, report.number, place));
        if is_new {
            self.list.push((report.exposure, report.time_us, received_us));
        }
        is_new
    }

    /// By the sender's clock; where that says nothing or jumps, by when the log received them. What has no time then is left out.
    fn exposures(self) -> Vec<Exposure> {
        let late = self.list.iter().filter(|r| r.1 > 0).filter_map(|r| Some(r.2? as f64 - r.1 as f64));
        let (first, last) =
            late.fold((f64::INFINITY, f64::NEG_INFINITY), |(least, most), us| (least.min(us), most.max(us)));
        let told = self.list.iter().filter(|r| r.1 > 0).count();
        let received = self.list.iter().filter(|r| r.2.is_some()).count();
        // A log of frames alone has no clock but the sender's, or only an order. A damaged stamp takes nothing from the rest.
        let by_sender = received == 0 || (last - first <= JUMP_US && told >= received);
        let time_us = |r: &(Exposure, u64, Option<u64>)| {
            if by_sender { Some(r.1).filter(|us| *us > 0 || told == 0) } else { r.2 }
        };
        let timed = self.list.iter().filter_map(|r| Some(Exposure { time_s: time_us(r)? as f64 * 1e-6, ..r.0 }));
        let mut exposures: Vec<Exposure> = timed.collect();
        exposures.sort_by(|a, b| a.time_s.total_cmp(&b.time_s));
        exposures
    }
}

fn of_mavlink(path: &Path) -> Result<Vec<Series>, JobError> {
    let mut file = disk::regular::open(path).map_err(JobError::io(path))?;
    let (mut framer, mut stamps) = (Framer::new(), Stamps::default());
    let mut found = BTreeMap::<(Source, Told), Reports>::new();
    let (mut frames, mut count) = (0u64, 0);
    loop {
        let space = framer.space();
        let read = file.read(space).map_err(JobError::io(path))?;
        stamps.read(&space[..read]);
        if read == 0 {
            framer.end();
        }
        framer.filled(read);
        while let Some(frame) = framer.next_frame() {
            frames += 1;
            let received_us = stamps.before(frame.bytes());
            let Some((camera, told, report)) = report(&frame) else { continue };
            let source =
                Source { system: Some(frame.system()), component: Some(frame.component()), camera: Some(camera) };
            let is_known = found.contains_key(&(source, told));
            if count >= MAX_EXPOSURES || (found.len() >= MAX_CAMERAS && !is_known) {
                let what = format!("reports more than {MAX_EXPOSURES} exposures or {MAX_CAMERAS} cameras");
                return Err(FormatError::Invalid { path: path.to_owned(), what }.into());
            }
            count += usize::from(found.entry((source, told)).or_default().take(report, received_us));
        }
        if read == 0 {
            break;
        }
    }
    let mut series: Vec<Series> =
        found.into_iter().map(|((source, _), reports)| Series { source, exposures: reports.exposures() }).collect();
    series.retain(|s| !s.exposures.is_empty());
    let what = match (series.is_empty(), frames) {
        (false, _) => return Ok(series),
        (true, 0) => {
            "is no flight log: neither MAVLink's (.tlog, with CAMERA_FEEDBACK or CAMERA_IMAGE_CAPTURED), ArduPilot's (.BIN, or text with FMT lines) nor PX4's (.ulg)"
        }
        (true, _) => {
            "reports no exposures (CAMERA_FEEDBACK or CAMERA_IMAGE_CAPTURED); was the camera triggered by the autopilot?"
        }
    };
    Err(FormatError::Invalid { path: path.to_owned(), what: what.to_owned() }.into())
}

/// The bytes that a framer still works on, to find what stands before a frame.
#[derive(Default)]
struct Stamps {
    bytes: Vec<u8>,
}

impl Stamps {
    /// More than a framer holds back.
    const KEPT: usize = 1 << 13;

    fn read(&mut self, bytes: &[u8]) {
        if self.bytes.len() > 2 * Self::KEPT {
            self.bytes.drain(..self.bytes.len() - Self::KEPT);
        }
        self.bytes.extend_from_slice(bytes);
    }

    /// The time stamp before the next `frame`; what came before it is done with.
    fn before(&mut self, frame: &[u8]) -> Option<u64> {
        let at = self.bytes.windows(frame.len()).position(|w| w == frame)?;
        let stamp =
            at.checked_sub(STAMP).map(|from| u64::from_be_bytes(self.bytes[from..at].try_into().unwrap_or_default()));
        self.bytes.drain(..at + frame.len());
        // Between 2000 and 2100: a file without stamps has something else there.
        stamp.filter(|us| (946_684_800_000_000..4_102_444_800_000_000).contains(us))
    }
}

/// The exposure that a frame tells of, and of which camera.
fn report(frame: &Frame<'_>) -> Option<(u8, Told, Report)> {
    if let Some(f) = frame.message::<CAMERA_FEEDBACK_DATA>() {
        let position = place([f.lat, f.lng], f.alt_msl.into())?;
        // The angles are the vehicle's, degrees, whatever carries the camera.
        let attitude = airframe([f.yaw, f.pitch, f.roll].map(f64::from));
        let report = Report { time_us: f.time_usec, number: f.img_idx.into(), exposure: exposure(position, attitude) };
        return Some((f.cam_idx, Told::Feedback, report));
    }
    let f = frame.message::<CAMERA_IMAGE_CAPTURED_DATA>()?;
    // 0: the camera says that it took none; −1: nobody knows.
    if f.capture_result == MavBool::MAV_BOOL_FALSE {
        return None;
    }
    let position = place([f.lat, f.lon], f64::from(f.alt) * 1e-3)?;
    let time_us = if f.time_utc > 0 { f.time_utc } else { u64::from(f.time_boot_ms) * 1000 };
    let [w, x, y, z] = f.q.map(f64::from);
    let attitude = log::camera_attitude(DQuat::from_xyzw(x, y, z, w));
    let report = Report { time_us, number: f.image_index.into(), exposure: exposure(position, attitude) };
    Some((f.camera_id, Told::Captured, report))
}

fn place([lat, lon]: [i32; 2], alt_m: f64) -> Option<Geodetic> {
    let position = Geodetic { lat_deg: f64::from(lat) * 1e-7, lon_deg: f64::from(lon) * 1e-7, alt_m };
    (position.is_valid() && (lat, lon) != (0, 0)).then_some(position)
}

fn airframe([yaw, pitch, roll]: [f64; 3]) -> Option<Attitude> {
    let rotation = nadir_rotation(yaw, pitch, roll);
    rotation.is_finite().then_some(Attitude { rotation, source: AttitudeSource::Airframe })
}

fn exposure(position: Geodetic, attitude: Option<Attitude>) -> Exposure {
    Exposure { time_s: 0.0, fix: Fix { position, sigma_m: SIGMA_M }, attitude }
}

#[cfg(test)]
#[allow(clippy::unwrap_used)] // a test may
mod tests {
    use super::*;
    use hal::mavlink::Encoder;

    const START_US: u64 = 1_466_699_519_000_000;

    /// A log as a ground station writes it.
    #[derive(Default)]
    struct Written(Vec<u8>);

    impl Written {
        fn add<M: hal::mavlink::MessageData>(&mut self, s: f64, from: (u8, u8), message: &M) {
            let mut encoder = Encoder::new(from.0, from.1);
            self.0.extend((START_US + (s * 1e6) as u64).to_be_bytes());
            self.0.extend_from_slice(encoder.encode(message, None));
        }

        fn read(&self) -> Result<Vec<Series>, JobError> {
            let dir = tempfile::tempdir().unwrap();
            let path = dir.path().join("a.tlog");
            std::fs::write(&path, &self.0).unwrap();
            Ok(read(&path, None, None)?.series)
        }
    }

    fn feedback(i: u16, s: f64, camera: u8) -> CAMERA_FEEDBACK_DATA {
        CAMERA_FEEDBACK_DATA {
            time_usec: START_US + (s * 1e6) as u64,
            cam_idx: camera,
            img_idx: i,
            lat: 468_426_000 + i32::from(i) * 1000,
            lng: -919_945_000,
            alt_msl: 198.5,
            yaw: 90.0,
            ..CAMERA_FEEDBACK_DATA::default()
        }
    }

    #[test]
    fn a_log_without_exposures_is_one_line() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("a.tlog");
        for (bytes, expected) in
            [(vec![0xFD; 5000], "is no flight log"), (b"hello, world".to_vec(), "is no flight log")]
        {
            std::fs::write(&path, bytes).unwrap();
            let error = read(&path, None, None).unwrap_err().to_string();
            assert!(error.contains("a.tlog") && error.contains(expected) && !error.contains('\n'), "{error}");
        }
        assert!(read(&dir.path().join("no.tlog"), None, None).is_err());
        let mut log = Written::default();
        log.add(1.0, (1, 1), &hal::mavlink::dialect::HEARTBEAT_DATA::default());
        let error = log.read().unwrap_err().to_string();
        assert!(error.contains("reports no exposures (CAMERA_FEEDBACK or CAMERA_IMAGE_CAPTURED)"), "{error}");
    }

    #[test]
    fn a_recorded_survey_reports_its_forty_exposures() {
        let Some(log) = needs::shared("data/sitl/run8/survey.tlog") else { return };
        let found = read(&log, None, None).unwrap().series;
        let [Series { exposures, .. }] = found.as_slice() else { panic!("{} cameras", found.len()) };
        assert_eq!(exposures.len(), 40);
        assert!(exposures.windows(2).all(|w| w[0].time_s < w[1].time_s));
    }

    #[test]
    fn exposures_of_several_aircraft_and_cameras_are_kept_apart_and_a_second_link_counts_none_twice() {
        let mut log = Written::default();
        for i in 0..6 {
            let s = f64::from(i) * 3.0;
            for (system, camera) in [(1, 0), (1, 1), (2, 0)] {
                log.add(s, (system, 1), &feedback(i, s, camera));
                log.add(s + 0.2, (system, 1), &feedback(i, s, camera));
            }
        }
        let found: Vec<_> =
            log.read().unwrap().iter().map(|s| (s.source.system, s.source.camera, s.exposures.len())).collect();
        assert_eq!(found, [(Some(1), Some(0), 6), (Some(1), Some(1), 6), (Some(2), Some(0), 6)]);
    }

    #[test]
    fn what_has_no_time_of_its_own_or_one_that_jumps_has_the_time_of_the_log() {
        const WEEKS_US: u64 = 1024 * 7 * 86_400_000_000;
        let of = |i: u64| START_US + 3_000_000 * i;
        for stamps in
            [[0; 5], [of(0), of(1), of(2) - WEEKS_US, of(3) - WEEKS_US, of(4) - WEEKS_US], [1, 2, of(2), of(3), of(4)]]
        {
            let mut log = Written::default();
            // A counter that never counts, too.
            for (i, time_usec) in (0..5).zip(stamps) {
                let place = feedback(i, 0.0, 0);
                log.add(f64::from(i) * 3.0, (1, 1), &CAMERA_FEEDBACK_DATA { time_usec, img_idx: 0, ..place });
            }
            let exposures = log.read().unwrap().remove(0).exposures;
            let steps: Vec<f64> = exposures.windows(2).map(|w| w[1].time_s - w[0].time_s).collect();
            assert!(steps.len() == 4 && steps.iter().all(|s| (s - 3.0).abs() < 1e-5), "{stamps:?}: {steps:?}");
        }
    }

    #[test]
    fn one_damaged_stamp_of_the_log_and_one_impossible_time_cost_that_exposure_alone() {
        for time_usec in [0, 1 << 63, u64::MAX] {
            let mut log = Written::default();
            for i in 0..6u16 {
                let s = f64::from(i) * 3.0;
                let end = log.0.len();
                let time_usec = if time_usec == 0 || i == 4 { time_usec } else { START_US + (s * 1e6) as u64 };
                log.add(s, (1, 1), &CAMERA_FEEDBACK_DATA { time_usec, ..feedback(i, s, 0) });
                if i == 2 {
                    log.0[end..end + STAMP].fill(0xFF);
                }
            }
            let exposures = log.read().unwrap().remove(0).exposures;
            let lat = |e: &Exposure| (e.fix.position.lat_deg * 1e7).round() as i32 / 1000 - 468_426;
            let order: Vec<i32> = exposures.iter().map(lat).collect();
            assert_eq!(order, [0, 1, 3, 4, 5], "{time_usec}");
            let steps: Vec<f64> = exposures.windows(2).map(|w| w[1].time_s - w[0].time_s).collect();
            assert!(steps.iter().zip([3.0, 6.0, 3.0, 3.0]).all(|(a, b)| (a - b).abs() < 1e-5), "{steps:?}");
        }
    }

    #[test]
    fn captured_pictures_of_px4_are_exposures_unless_the_camera_says_that_it_took_none() {
        let mut log = Written::default();
        for (i, capture_result) in [1u8, 255, 0, 1].into_iter().enumerate() {
            let message = CAMERA_IMAGE_CAPTURED_DATA {
                time_boot_ms: 1000 + 3000 * i as u32,
                lat: 468_426_000 + i as i32,
                lon: -919_945_000,
                alt: 198_500,
                q: [0.0, 1.0, 0.0, 0.0],
                image_index: i as i32,
                capture_result: MavBool::from_bits_retain(capture_result),
                ..CAMERA_IMAGE_CAPTURED_DATA::default()
            };
            log.add(f64::from(i as u32), (1, 100), &message);
        }
        let exposures = log.read().unwrap().remove(0).exposures;
        let times: Vec<f64> = exposures.iter().map(|e| e.time_s).collect();
        assert_eq!((times.as_slice(), exposures[0].fix.position.alt_m), (&[1.0, 4.0, 10.0][..], 198.5));
        assert!(exposures[0].attitude.is_none(), "upside down is no attitude of a camera that maps");
    }

    #[test]
    fn a_log_of_two_flights_holds_the_exposures_of_both_in_their_order() {
        let Some(path) = needs::shared("field/mavlink/inputs/twoflights.tlog") else { return };
        let found = read(&path, None, None).unwrap().series;
        let [Series { exposures, .. }] = found.as_slice() else { panic!("{} series", found.len()) };
        let steps: Vec<f64> = exposures.windows(2).map(|w| w[1].time_s - w[0].time_s).collect();
        assert!(exposures.len() == 30 && steps.iter().all(|step| *step > 0.0), "{steps:?}");
        let between: Vec<usize> = (0..steps.len()).filter(|k| steps[*k] > 600.0).collect();
        assert_eq!(between, [11], "twelve of the first flight, whose counter starts anew");
        assert!(exposures[0].fix.position.lat_deg - exposures[12].fix.position.lat_deg > 0.009, "another place");
    }

    #[test]
    fn logs_of_ground_stations_as_others_wrote_them_are_told_apart_by_system() {
        for (name, systems) in [
            ("fb_ok", &[1][..]),
            ("time0", &[1]),
            ("px4_result1", &[1]),
            ("px4_minus1", &[1]),
            ("fleet", &[1, 2]),
            ("fleet_s1", &[1, 2]),
            ("fleet_s2", &[1, 2]),
            ("fleet_s4", &[1, 2]),
        ] {
            let Some(path) = needs::shared(&format!("field/mavlink/inputs/{name}.tlog")) else { return };
            let found = read(&path, None, None).unwrap().series;
            let by: Vec<_> = found.iter().map(|s| (s.source.system.unwrap_or(0), s.exposures.len())).collect();
            assert_eq!(by, systems.iter().map(|s| (*s, 18)).collect::<Vec<_>>(), "{name}");
            assert!(found.iter().all(|s| s.exposures.windows(2).all(|w| w[0].time_s < w[1].time_s)), "{name}");
        }
    }
}
