use super::*;
use crate::card::record::{AttitudeSource, nadir_rotation};
use glam::DVec3;

fn message(kind: u8, content: &[u8]) -> Vec<u8> {
    [&(content.len() as u16).to_le_bytes()[..], &[kind], content].concat()
}

fn topic(id: u16, instance: u8, name: &str) -> Vec<u8> {
    message(b'A', &[&[instance][..], &id.to_le_bytes(), name.as_bytes()].concat())
}

fn data(id: u16, parts: &[&[u8]]) -> Vec<u8> {
    message(b'D', &[&id.to_le_bytes()[..], &parts.concat()].concat())
}

/// Flag bits that promise nothing, and what PX4 1.14 says of its topics, a type within a type included.
fn head() -> Vec<u8> {
    let mut log = [&MAGIC[..], &[1], &7u64.to_le_bytes()].concat();
    log.extend(message(b'B', &[0; 40]));
    for format in [
        "camera_capture:uint64_t timestamp;uint64_t timestamp_utc;double lat;double lon;uint32_t seq;float alt;float ground_distance;float[4] q;int8_t result;uint8_t[3] _padding0;",
        "camera_trigger:uint64_t timestamp;uint64_t timestamp_utc;uint32_t seq;bool feedback;uint8_t[3] _padding0;",
        "covariance:float[6] values;",
        "vehicle_global_position:uint64_t timestamp;covariance[2] c;double lat;double lon;float alt;",
        "vehicle_gps_position:uint64_t timestamp;int32_t lat;int32_t lon;int32_t alt;",
        "vehicle_attitude:uint64_t timestamp;float[4] q;",
    ] {
        log.extend(message(b'F', format.as_bytes()));
    }
    log.extend(message(b'I', b"\x10char[3] sys_namePX4"));
    for (id, name) in [
        (0, "camera_capture"),
        (1, "camera_trigger"),
        (2, "vehicle_global_position"),
        (3, "vehicle_attitude"),
        (4, "vehicle_gps_position"),
    ] {
        log.extend(topic(id, 0, name));
    }
    log
}

fn time(s: f64) -> [u8; 8] {
    ((s * 1e6) as u64).to_le_bytes()
}

fn q(yaw_deg: f64, pitch_deg: f64) -> Vec<u8> {
    let q = DQuat::from_rotation_z(yaw_deg.to_radians()) * DQuat::from_rotation_y(pitch_deg.to_radians());
    [q.w, q.x, q.y, q.z].iter().flat_map(|v| (*v as f32).to_le_bytes()).collect()
}

fn capture(s: f64, lat: f64, q: &[u8], result: i8) -> Vec<u8> {
    let (lat, lon) = (lat.to_le_bytes(), (-91.9945f64).to_le_bytes());
    let (seq, alt, ground) = (1u32.to_le_bytes(), 198.5f32.to_le_bytes(), f32::NAN.to_le_bytes());
    data(0, &[&time(s), &[0; 8], &lat, &lon, &seq, &alt, &ground, q, &result.to_le_bytes(), &[0; 3]])
}

/// A second of flight to the north at 1e-5 degrees a second, at 10 Hz.
fn flown(s: u32, log: &mut Vec<u8>) {
    for tenth in 0..10 {
        let t = f64::from(s) + f64::from(tenth) * 0.1;
        let (lat, lon, alt) = ((46.0 + 1e-5 * t).to_le_bytes(), 7f64.to_le_bytes(), 400f32.to_le_bytes());
        log.extend(data(2, &[&time(t), &[0; 48], &lat, &lon, &alt]));
        log.extend(data(3, &[&time(t), &q(90.0, 2.0)]));
    }
}

fn read_bytes(log: &[u8]) -> Result<Vec<Series>, FormatError> {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("flight.log");
    std::fs::write(&path, log).unwrap();
    super::super::read(&path).map(Option::unwrap)
}

#[test]
fn captures_of_a_px4_log_have_place_time_and_the_airframes_or_the_gimbals_attitude() {
    let mut log = head();
    log.extend(capture(10.0, 46.8426, &q(90.0, 3.0), 1));
    log.extend(capture(12.5, 46.8427, &q(45.0, -90.0), -1));
    log.extend(capture(14.0, 46.8428, &q(45.0, 0.0), 0));
    log.extend(capture(15.0, 46.8429, &q(0.0, 0.0), 1));
    let series = read_bytes(&log).unwrap();
    let [Series { exposures, .. }] = series.as_slice() else { panic!("{series:?}") };
    let times: Vec<f64> = exposures.iter().map(|e| e.time_s).collect();
    assert_eq!(times, [10.0, 12.5, 15.0], "the camera says that it took no third one");
    assert_eq!(exposures[0].fix.position, Geodetic { lat_deg: 46.8426, lon_deg: -91.9945, alt_m: 198.5 });
    for (e, source, forward_at_most) in [(0, AttitudeSource::Airframe, -0.99), (1, AttitudeSource::Gimbal, -0.9999)] {
        let attitude = exposures[e].attitude.unwrap();
        let forward = attitude.rotation * DVec3::Z;
        assert!(attitude.source == source && forward.z < forward_at_most, "{e}: {attitude:?} {forward}");
    }
    assert!(exposures[2].attitude.is_none(), "the identity says nothing");
}

#[test]
fn triggers_are_placed_between_positions_and_pulses_of_the_hot_shoe_count_more_than_commands() {
    let of = |pulses: bool| {
        let mut log = head();
        for s in 5..9 {
            flown(s, &mut log);
            let trigger = |t: f64, pulse: bool| data(1, &[&time(t), &[0; 8], &[0; 4], &[pulse.into()], &[0; 3]]);
            log.extend(trigger(f64::from(s) + 0.25, false));
            if pulses {
                log.extend(trigger(f64::from(s) + 0.35, true));
            }
        }
        read_bytes(&log).unwrap().remove(0).exposures
    };
    for (pulses, after) in [(false, 0.25), (true, 0.35)] {
        let exposures = of(pulses);
        assert_eq!(exposures.len(), 4, "{pulses}");
        for (s, e) in (5..9).zip(&exposures) {
            let t = f64::from(s) + after;
            assert!((e.time_s - t).abs() < 1e-6 && (e.fix.position.lat_deg - 46.0 - 1e-5 * t).abs() < 1e-8, "{e:?}");
            let turned = e.attitude.unwrap().rotation.angle_between(nadir_rotation(90.0, 2.0, 0.0));
            assert!(turned < 1e-3, "{turned}");
        }
    }
}

#[test]
fn without_an_estimate_the_receiver_places_triggers_and_without_either_the_log_says_what_it_lacks() {
    let trigger = |t: f64| data(1, &[&time(t), &[0; 8], &[0; 4], &[0], &[0; 3]]);
    let mut log = [head(), trigger(5.2), trigger(5.4)].concat();
    let error = read_bytes(&log).unwrap_err().to_string();
    assert!(error.contains("without a place") && !error.contains('\n'), "{error}");
    for (t, lat) in [(5.0, 460_000_000i32), (6.0, 460_001_000)] {
        log.extend(data(4, &[&time(t), &lat.to_le_bytes(), &70_000_000i32.to_le_bytes(), &400_500i32.to_le_bytes()]));
    }
    let found = read_bytes(&log).unwrap().remove(0).exposures;
    assert_eq!((found.len(), found[0].fix.position.alt_m), (2, 400.5));
    assert!((found[0].fix.position.lat_deg - 46.000_02).abs() < 1e-9, "{found:?}");
    let error = read_bytes(&head()).unwrap_err().to_string();
    assert!(error.contains("camera_capture") && !error.contains('\n'), "{error}");
}

#[test]
fn damage_costs_what_it_hit_and_data_appended_after_a_crash_are_read() {
    let north = q(0.0, 3.0);
    let captures = |from: i32| -> Vec<u8> {
        (from..from + 3).flat_map(|s| capture(f64::from(s), 46.0 + 1e-4 * f64::from(s), &north, 1)).collect()
    };
    let holed = [head(), captures(1), vec![0xFF; 100], SYNC.to_vec(), captures(11)].concat();
    assert_eq!(read_bytes(&holed).unwrap()[0].exposures.len(), 6);
    let mut appended = [head(), captures(1)].concat();
    let whole = appended.len();
    appended.extend(&capture(9.0, 46.0, &north, 1)[..20]);
    let at = appended.len() as u64;
    appended.extend(captures(11));
    let flags = (HEADER as usize + 3)..(HEADER as usize + 43);
    appended[flags][16..24].copy_from_slice(&at.to_le_bytes());
    assert_eq!(read_bytes(&appended).unwrap()[0].exposures.len(), 6, "{whole} {at}");
    for len in 0..whole {
        if len >= MAGIC.len() {
            assert!(read_bytes(&appended[..len]).map_or(true, |s| s[0].exposures.len() <= 3), "{len}");
        }
    }
}

#[test]
fn a_type_says_the_unit_of_a_place_also_within_metres_of_the_equator() {
    let mut log = [head(), data(1, &[&time(5.5), &[0; 8], &[0; 4], &[0], &[0; 3]])].concat();
    for (t, lat) in [(5.0, 300i32), (6.0, 300)] {
        log.extend(data(4, &[&time(t), &lat.to_le_bytes(), &200i32.to_le_bytes(), &400_500i32.to_le_bytes()]));
    }
    let position = read_bytes(&log).unwrap()[0].exposures[0].fix.position;
    assert!((position.lat_deg - 3e-5).abs() < 1e-12 && (position.lon_deg - 2e-5).abs() < 1e-12, "{position:?}");
}

#[test]
fn a_damaged_time_stamp_among_the_places_costs_that_place_alone() {
    let mut log = head();
    let at = |t: f64, lat: f64| {
        data(2, &[&time(t), &[0; 48], &lat.to_le_bytes(), &7f64.to_le_bytes(), &400f32.to_le_bytes()])
    };
    flown(5, &mut log);
    log.extend(at(9e7, 12.0));
    flown(6, &mut log);
    log.extend(data(1, &[&time(6.25), &[0; 8], &[0; 4], &[0], &[0; 3]]));
    let found = read_bytes(&log).unwrap().remove(0).exposures;
    assert!((found[0].fix.position.lat_deg - 46.0 - 6.25e-5).abs() < 1e-8, "{found:?}");
}

#[test]
fn exposures_are_in_order_and_impossible_times_places_and_attitudes_are_left_out() {
    let mut log = head();
    flown(5, &mut log);
    log.extend(data(3, &[&time(6.0), &[0; 16]]));
    log.extend(data(2, &[&time(6.0), &[0; 48], &[0; 8], &[0; 8], &400f32.to_le_bytes()]));
    flown(6, &mut log);
    for s in [6.9, 6.05, 5.95, 6.7, 1e13] {
        log.extend(data(1, &[&time(s), &[0; 8], &[0; 4], &[0], &[0; 3]]));
    }
    let found = read_bytes(&log).unwrap().remove(0).exposures;
    assert_eq!(found.iter().map(|e| (e.time_s * 1e3).round()).collect::<Vec<_>>(), [5950.0, 6050.0, 6700.0, 6900.0]);
    for e in &found {
        assert!((e.fix.position.lat_deg - 46.0 - 1e-5 * e.time_s).abs() < 1e-8, "{e:?}");
        let turned = e.attitude.unwrap().rotation.angle_between(nadir_rotation(90.0, 2.0, 0.0));
        assert!(turned < 1e-3, "{e:?}");
    }
}

#[test]
fn what_looks_like_an_exposure_before_the_next_mark_is_part_of_the_damage() {
    let one = |s: f64| capture(s, 46.0, &q(0.0, 3.0), 1);
    let log = [head(), one(1.0), vec![0, 0, 0xFF], one(2.0), SYNC.to_vec(), one(3.0)].concat();
    let times: Vec<f64> = read_bytes(&log).unwrap()[0].exposures.iter().map(|e| e.time_s).collect();
    assert_eq!(times, [1.0, 3.0]);
}

#[test]
fn more_exposures_than_any_flight_has_are_refused() {
    let one = capture(1.0, 46.0, &q(0.0, 3.0), 1);
    let error = read_bytes(&[head(), one.repeat(MAX_EXPOSURES + 1)].concat()).unwrap_err().to_string();
    assert!(error.contains("more than") && !error.contains('\n'), "{error}");
}

#[test]
fn a_clock_that_starts_again_unknown_flags_and_subscriptions_without_end_are_refused_in_one_line() {
    let captures = |from: i32| -> Vec<u8> {
        (from..from + 3).flat_map(|s| capture(f64::from(s), 46.0 + 1e-4 * f64::from(s), &q(0.0, 3.0), 1)).collect()
    };
    let twice = [head(), captures(11), captures(1)].concat();
    let mut later = [head(), captures(1)].concat();
    later[HEADER as usize + 3 + 8] = 2;
    let many: Vec<u8> = (0..=MAX_SUBSCRIBED).flat_map(|_| topic(0, 0, "camera_capture")).collect();
    let many = [head(), many, captures(1)].concat();
    for (log, expected) in [(twice, "starts again after 3"), (later, "later edition"), (many, "subscribes")] {
        let error = read_bytes(&log).unwrap_err().to_string();
        assert!(error.contains(expected) && !error.contains('\n'), "{error}");
    }
}

#[test]
fn an_identifier_that_is_given_to_another_topic_is_no_exposure_any_more() {
    let one = capture(1.0, 46.0, &q(0.0, 3.0), 1);
    let log = [head(), one, topic(0, 0, "sensor_combined"), capture(2.0, 46.1, &q(0.0, 3.0), 1)].concat();
    assert_eq!(read_bytes(&log).unwrap()[0].exposures.len(), 1);
}
