//! Promises of the recording.

use super::*;

const ORIGIN: Geodetic = Geodetic { lat_deg: 46.0, lon_deg: 7.0, alt_m: 500.0 };

/// Topic, schema and content of every message. (What Foxglove's own reader finds: `tests/gcs.sh`.)
fn read(path: &Path) -> Vec<(&'static str, &'static str, Value)> {
    let bytes = std::fs::read(path).expect("the file");
    let magic = b"\x89MCAP0\r\n";
    assert!(bytes.starts_with(magic) && bytes.ends_with(magic), "whole");
    let records = mcap::split(&bytes[magic.len()..]);
    // Times, sizes, checksum and the empty name of the compression.
    let chunks = records.filter(|r| r[0] == mcap::CHUNK).flat_map(|r| mcap::split(&r[9 + 3 * 8 + 4 + 4 + 8..]));
    let messages = chunks.filter(|r| r[0] == mcap::MESSAGE).map(|r| {
        let channel = &CHANNELS[usize::from(u16::from_le_bytes([r[9], r[10]])) - 1];
        (channel.topic, channel.name, serde_json::from_slice(&r[9 + 2 + 4 + 8 + 8..]).expect("JSON"))
    });
    messages.collect()
}

fn pose(east_m: f64) -> Entry {
    Entry::Pose(PoseReport {
        time_ns: 0,
        position: DVec3::new(east_m, 0.0, 40.0),
        velocity: DVec3::ZERO,
        rotation: DQuat::IDENTITY,
        position_sigma_m: [0.5, 0.5, 1.0],
    })
}

#[test]
fn what_happened_is_read_back_by_topic_with_foxgloves_schemas() {
    let folder = tempfile::tempdir().expect("a folder");
    let path = folder.path().join("flight.mcap");
    let (recording, mut recorder) = Recording::create(&path, ORIGIN).expect("a file");
    recorder.set_clock(5_000_000_000);
    recorder.note(5_000_000_000, pose(100.0));
    recorder.note(6_000_000_000, Entry::Exposure(7));
    let key = Pose { rotation: DQuat::IDENTITY, center: DVec3::ZERO };
    recorder.note(6_500_000_000, Entry::KeyFrame(key, Some(RgbImage::from_pixel(192, 144, image::Rgb([9, 99, 200])))));
    recorder.note(
        7_000_000_000,
        Entry::State(Told { key_frames: 3, ..Told::default() }, Seen { pictures: 4, covered: 50 }),
    );
    recorder.note(8_000_000_000, Entry::Words(MavSeverity::MAV_SEVERITY_WARNING, "dgtr: warn".into()));
    drop(recorder);
    drop(recording);
    let all = read(&path);
    let topics: Vec<_> = all.iter().map(|(topic, schema, _)| (*topic, *schema)).collect();
    assert_eq!(
        topics,
        [
            ("/aircraft/pose", "foxglove.PoseInFrame"),
            ("/aircraft/fix", "foxglove.LocationFix"),
            ("/exposure", "dgtr.Exposure"),
            ("/keyframe/pose", "foxglove.PoseInFrame"),
            ("/keyframe/image", "foxglove.CompressedImage"),
            ("/state", "dgtr.State"),
            ("/log", "foxglove.Log"),
        ]
    );
    let of = |topic: &str| &all.iter().find(|m| m.0 == topic).expect(topic).2;
    let seconds = |topic: &str| of(topic)["timestamp"]["sec"].as_u64().expect("a time");
    assert_eq!(seconds("/log") - seconds("/aircraft/fix"), 3);
    assert!(seconds("/log") > 1_600_000_000, "Unix time");
    let fix = of("/aircraft/fix");
    assert!((fix["longitude"].as_f64().expect("a number") - 7.0013).abs() < 1e-4, "{fix}");
    let picture = of("/keyframe/image")["data"].as_str().expect("base64");
    assert!(BASE64_STANDARD.decode(picture).expect("base64").starts_with(&[0xFF, 0xD8]));
    assert_eq!((&of("/state")["key_frames"], &of("/log")["level"]), (&json!(3), &json!(3)));
}

#[test]
fn a_recording_stops_at_its_bound_and_is_whole_up_to_there() {
    let folder = tempfile::tempdir().expect("a folder");
    let path = folder.path().join("flight.mcap");
    let limit = SUMMARY + (200 << 10);
    let (mut recording, recorder) = Recording::bounded(&path, ORIGIN, limit).expect("a file");
    for k in 0..2000 {
        // As slowly as the writer takes them, until it takes no more.
        while recorder
            .to
            .as_ref()
            .is_some_and(|to| matches!(to.try_send((k, pose(k as f64))), Err(std::sync::mpsc::TrySendError::Full(_))))
        {
            std::thread::yield_now();
        }
    }
    drop(recorder);
    let ended = recording.thread.take().map(|thread| thread.join().expect("no panic"));
    assert!(ended.is_some_and(|ended| ended.is_err()), "it says that it ended early");
    assert!(path.metadata().expect("its size").len() <= limit);
    let count = read(&path).len();
    assert!((100..3000).contains(&count), "{count} messages");
}

#[test]
fn a_recording_that_cannot_be_written_is_refused_at_the_start() {
    let refused = Recording::create(Path::new("/nonexistent/flight.mcap"), ORIGIN).expect_err("no such folder");
    assert_eq!(refused.kind(), ErrorKind::Input);
    assert!(refused.to_string().contains("/nonexistent/flight.mcap"));
}

#[test]
fn a_recording_in_the_flight_s_own_folder_is_part_of_its_disk_plan_and_another_is_not() {
    let (own, other) = (tempfile::tempdir().unwrap(), tempfile::tempdir().unwrap());
    std::fs::create_dir(own.path().join("log")).unwrap();
    let most = |path: PathBuf| Recording::most_bytes_below(&path, own.path());
    assert_eq!(most(own.path().join("flight.mcap")), LIMIT);
    assert_eq!(most(own.path().join("log/../log/flight.mcap")), LIMIT);
    assert_eq!((most(other.path().join("flight.mcap")), most(own.path().join("missing/flight.mcap"))), (0, 0));
}
