//! A vehicle whose autopilot is silent and whose pictures bring their own pose.

use std::path::Path;
use std::sync::Arc;
use std::time::{Duration, SystemTime};

use config::geodesy::Geodetic;
use config::link::LinkSettings;
use config::mission::{CameraSettings, MountSettings};
use exif::experimental::Writer;
use exif::{Field, In, Rational, Tag, Value};

use super::*;
use crate::camera::FolderCamera;
use crate::link::{LinkAddress, WireLink};
use crate::mavlink::Framer;
use crate::mavlink::dialect::STATUSTEXT_DATA;
use crate::time::ManualClock;
use crate::traits::Received;

const ORIGIN: Geodetic = Geodetic { lat_deg: 46.84, lon_deg: -91.99, alt_m: 200.0 };
const LENS: CameraSettings = CameraSettings {
    width: 32,
    height: 24,
    fx: 25.0,
    fy: 25.0,
    cx: 16.0,
    cy: 12.0,
    distortion: [0.0; 4],
    exposure_delay_ms: 0.0,
};

fn settings() -> VehicleSettings {
    VehicleSettings {
        address: LinkAddress::Pty(None),
        patient: false,
        system_id: 1,
        link: LinkSettings::default(),
        camera: None,
        pictures_since: None,
        lens: LENS,
        mount: MountSettings::default(),
        origin: ORIGIN,
    }
}

/// One segment of a JPEG file.
fn app1(contents: &[u8]) -> Vec<u8> {
    let length = u16::try_from(contents.len() + 2).expect("short");
    [&[0xFF, 0xE1][..], &length.to_be_bytes(), contents].concat()
}

/// A photograph as a drone's camera tags it: GPS position in EXIF, gimbal angles in DJI's XMP.
fn photograph(path: &Path, at: Geodetic, light: u8) {
    let sixtieths = |degrees: f64| {
        let whole = |v: f64| Rational { num: v as u32, denom: 1 };
        let minutes = degrees.fract() * 60.0;
        let seconds = Rational { num: (minutes.fract() * 60.0 * 1e4).round() as u32, denom: 10_000 };
        Value::Rational(vec![whole(degrees.trunc()), whole(minutes.trunc()), seconds])
    };
    let field = |tag, value| Field { tag, ifd_num: In::PRIMARY, value };
    let ascii = |text: &str| Value::Ascii(vec![text.as_bytes().to_vec()]);
    let fields = [
        field(Tag::GPSLatitudeRef, ascii(if at.lat_deg < 0.0 { "S" } else { "N" })),
        field(Tag::GPSLatitude, sixtieths(at.lat_deg.abs())),
        field(Tag::GPSLongitudeRef, ascii(if at.lon_deg < 0.0 { "W" } else { "E" })),
        field(Tag::GPSLongitude, sixtieths(at.lon_deg.abs())),
        field(Tag::GPSAltitudeRef, Value::Byte(vec![0])),
        field(Tag::GPSAltitude, Value::Rational(vec![Rational { num: (at.alt_m * 1e3) as u32, denom: 1000 }])),
    ];
    let mut writer = Writer::new();
    fields.iter().for_each(|f| writer.push_field(f));
    let mut tags = std::io::Cursor::new(Vec::new());
    writer.write(&mut tags, false).expect("EXIF");
    let xmp = b"http://ns.adobe.com/xap/1.0/\0<rdf:Description drone-dji:GimbalRollDegree=\"+0.00\" \
        drone-dji:GimbalPitchDegree=\"-90.00\" drone-dji:GimbalYawDegree=\"+30.00\"/>";
    let mut jpeg = std::io::Cursor::new(Vec::new());
    let pixel = |x: u32, y: u32| image::Rgb([((x * 9 + y * 5) % 120 * u32::from(light)).min(255) as u8; 3]);
    let picture = image::RgbImage::from_fn(LENS.width, LENS.height, pixel);
    picture.write_to(&mut jpeg, image::ImageFormat::Jpeg).expect("JPEG");
    let jpeg = jpeg.into_inner();
    let tagged = [&jpeg[..2], &app1(&[b"Exif\0\0", &tags.into_inner()[..]].concat()), &app1(xmp), &jpeg[2..]].concat();
    std::fs::write(path, tagged).expect("written");
}

type Still = Vehicle<WireLink, FolderCamera, Arc<ManualClock>>;

/// Ten seconds of a vehicle that hears nothing; the other end of its line is returned so that it stays open.
fn ten_seconds(vehicle: &mut Still, clock: &ManualClock) -> Vec<Event> {
    let mut events = Vec::new();
    for turn in 0..500u64 {
        clock.set(turn * 20_000_000);
        while let Some(event) = vehicle.poll(Duration::ZERO).expect("a wire does not fail") {
            events.push(event);
        }
    }
    events
}

fn still(folder: &Path, since: Option<SystemTime>, clock: &Arc<ManualClock>) -> Still {
    overheard(folder, since, clock).0
}

/// As [`still`], with the other end of its line.
fn overheard(folder: &Path, since: Option<SystemTime>, clock: &Arc<ManualClock>) -> (Still, WireLink) {
    let camera = FolderCamera::open_since(folder, since).expect("the folder").on_simulated_clock();
    let (line, other) = WireLink::pair();
    (Vehicle::new(line, camera, clock.clone(), &settings()).expect("a vehicle"), other)
}

/// Every text the ground control station was told.
fn texts(line: &mut WireLink) -> Vec<(MavSeverity, String)> {
    let (mut framer, mut texts, mut bytes) = (Framer::new(), Vec::new(), [0; 256]);
    while let Ok(Received { bytes: count @ 1.., .. }) = line.read(&mut bytes, Duration::ZERO) {
        framer.push(&bytes[..count]);
        while let Some(frame) = framer.next_frame() {
            let Some(said) = frame.message::<STATUSTEXT_DATA>() else { continue };
            let text = said.text.to_str().expect("UTF-8").to_owned();
            texts.push((said.severity, text));
        }
    }
    texts
}

#[test]
fn a_continued_flight_takes_pictures_it_missed_with_the_pose_in_their_own_data() {
    let folder = tempfile::tempdir().expect("a folder");
    let stopped = SystemTime::now() - Duration::from_secs(60);
    let there = EnuFrame::new(ORIGIN).to_geodetic(glam::DVec3::new(12.0, -7.0, 40.0));
    photograph(&folder.path().join("DJI_0007.jpg"), there, 2);
    let clock = Arc::new(ManualClock::default());
    let mut vehicle = still(folder.path(), Some(stopped), &clock);
    let events = ten_seconds(&mut vehicle, &clock);
    let [Event::Frame(frame)] = &events[..] else { panic!("{events:?}") };
    assert!((frame.pose.position - glam::DVec3::new(12.0, -7.0, 40.0)).length() < 0.01, "{}", frame.pose.position);
    assert!((frame.pose.rotation * glam::DVec3::Z + glam::DVec3::Z).length() < 1e-6, "looks straight down");
    let up = frame.pose.rotation * -glam::DVec3::Y;
    assert!((up.x.atan2(up.y).to_degrees() - 30.0).abs() < 1e-6, "its upper edge towards the yaw");
    assert_eq!((vehicle.counters().exif_poses, vehicle.counters().pictures_unmatched), (1, 0));

    let mut fresh = still(folder.path(), None, &Arc::new(ManualClock::default()));
    assert!(ten_seconds(&mut fresh, &ManualClock::default()).is_empty(), "an earlier flight's picture");
}

#[test]
fn three_black_pictures_are_counted_refused_and_raise_the_flag() {
    let folder = tempfile::tempdir().expect("a folder");
    let clock = Arc::new(ManualClock::default());
    let mut vehicle = still(folder.path(), None, &clock);
    for (k, light) in [0, 0, 0, 2].into_iter().enumerate() {
        photograph(&folder.path().join(format!("DJI_{k}.jpg")), ORIGIN, light);
    }
    let events = ten_seconds(&mut vehicle, &clock);
    let mut flags = Vec::new();
    for event in &events {
        let Event::Frame(frame) = event else { panic!("{event:?}") };
        let loaded = vehicle.load(frame);
        assert_eq!(loaded.is_ok(), flags.len() == 3, "{loaded:?}");
        flags.push(vehicle.flags().pictures_poor);
    }
    assert_eq!(flags, [false, false, true, false]);
    assert_eq!(vehicle.counters().pictures_black, 3);
}

#[test]
fn bursts_of_black_and_overexposed_pictures_are_told_once_each_with_their_count() {
    let folder = tempfile::tempdir().expect("a folder");
    let clock = Arc::new(ManualClock::default());
    let (mut vehicle, mut line) = overheard(folder.path(), None, &clock);
    // Four black ones, a good one, three overexposed ones, a good one.
    let lights = [0, 0, 0, 0, 2, 255, 255, 255, 2];
    for (k, light) in lights.into_iter().enumerate() {
        photograph(&folder.path().join(format!("DJI_{k}.jpg")), ORIGIN, light);
    }
    let events = ten_seconds(&mut vehicle, &clock);
    let _ = texts(&mut line);
    let mut said = Vec::new();
    for (k, event) in events.iter().enumerate() {
        let Event::Frame(frame) = event else { panic!("{event:?}") };
        // A picture every two seconds: a burst lasts longer than complaints are kept back.
        clock.set(20_000_000_000 + k as u64 * 2_000_000_000);
        assert_eq!(vehicle.load(frame).is_ok(), lights[k] == 2);
        said.extend(texts(&mut line).into_iter().map(|(severity, text)| (k, severity, text)));
    }
    let (warning, info) = (MavSeverity::MAV_SEVERITY_WARNING, MavSeverity::MAV_SEVERITY_INFO);
    let expected = [
        (0, warning, "dgtr: DJI_0.jpg is black, left out"),
        (4, info, "dgtr: pictures are good again, 4 were not"),
        (5, warning, "dgtr: DJI_5.jpg is overexposed, left out"),
        (8, info, "dgtr: pictures are good again, 3 were not"),
    ];
    assert_eq!(said, expected.map(|(k, severity, text)| (k, severity, text.to_owned())));
    assert_eq!((vehicle.counters().pictures_black, vehicle.counters().pictures_overexposed), (4, 3));
}
