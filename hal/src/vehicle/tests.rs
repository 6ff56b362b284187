//! A vehicle whose autopilot is silent and whose pictures bring their own pose; and one that a stranger talks to.

use std::path::Path;
use std::sync::Arc;
use std::time::{Duration, SystemTime};

use exif::experimental::Writer;
use exif::{Field, In, Rational, Tag, Value};
use geometry::geodesy::Geodetic;

#[path = "../../tests/rig/lens.rs"]
mod lens;

use super::*;
use crate::camera::FolderCamera;
use crate::link::{LinkAddress, UdpLink, WireLink};
use crate::mavlink::dialect::{
    GLOBAL_POSITION_INT_DATA, HEARTBEAT_DATA, MavAutopilot, MavModeFlag, PARAM_REQUEST_READ_DATA, PARAM_VALUE_DATA,
    STATUSTEXT_DATA,
};
use crate::mavlink::{Encoder, Framer};
use crate::time::ManualClock;
use crate::traits::Received;
use lens::LENS;

const ORIGIN: Geodetic = Geodetic { lat_deg: 46.84, lon_deg: -91.99, alt_m: 200.0 };

fn settings() -> VehicleSettings {
    VehicleSettings::new(LinkAddress::Pty(None), LENS, ORIGIN)
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
            // Nobody speaks on this line.
            if !matches!(event, Event::Complaint { .. }) {
                events.push(event);
            }
        }
    }
    events
}

fn still(folder: &Path, since: Option<SystemTime>, clock: &Arc<ManualClock>) -> Still {
    with_line(folder, since, clock).0
}

/// As [`still`], with the other end of its line.
fn with_line(folder: &Path, since: Option<SystemTime>, clock: &Arc<ManualClock>) -> (Still, WireLink) {
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
    let [Event::Posed(frame)] = &events[..] else { panic!("{events:?}") };
    assert!((frame.pose.position - glam::DVec3::new(12.0, -7.0, 40.0)).length() < 0.01, "{}", frame.pose.position);
    assert!((frame.pose.rotation * glam::DVec3::Z + glam::DVec3::Z).length() < 1e-6, "looks straight down");
    let up = frame.pose.rotation * -glam::DVec3::Y;
    assert!((up.x.atan2(up.y).to_degrees() - 30.0).abs() < 1e-6, "its upper edge towards the yaw");
    assert_eq!((vehicle.counters().exif_poses, vehicle.counters().pictures.pictures_unmatched), (1, 0));

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
        let Event::Posed(frame) = event else { panic!("{event:?}") };
        let loaded = vehicle.load(frame);
        assert_eq!(loaded.is_ok(), flags.len() == 3, "{loaded:?}");
        flags.push(vehicle.flags().pictures_poor);
    }
    assert_eq!(flags, [false, false, true, false]);
    assert_eq!(vehicle.counters().pictures.pictures_black, 3);
}

#[test]
fn bursts_of_black_and_overexposed_pictures_are_told_once_each_with_their_count() {
    let folder = tempfile::tempdir().expect("a folder");
    let clock = Arc::new(ManualClock::default());
    let (mut vehicle, mut line) = with_line(folder.path(), None, &clock);
    // Four black ones, a good one, three overexposed ones, a good one.
    let lights = [0, 0, 0, 0, 2, 255, 255, 255, 2];
    for (k, light) in lights.into_iter().enumerate() {
        photograph(&folder.path().join(format!("DJI_{k}.jpg")), ORIGIN, light);
    }
    let events = ten_seconds(&mut vehicle, &clock);
    let _ = texts(&mut line);
    let mut said = Vec::new();
    for (k, event) in events.iter().enumerate() {
        let Event::Posed(frame) = event else { panic!("{event:?}") };
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
    assert_eq!((vehicle.counters().pictures.pictures_black, vehicle.counters().pictures.pictures_overexposed), (4, 3));
}

/// A sender with the autopilot's ids.
struct Speaker {
    socket: std::net::UdpSocket,
    encoder: Encoder,
}

impl Speaker {
    fn to(port: std::net::SocketAddr) -> Self {
        let socket = std::net::UdpSocket::bind("127.0.0.1:0").expect("a port");
        socket.connect(port).expect("connects");
        Self { socket, encoder: Encoder::new(1, 1) }
    }

    fn heartbeat(&mut self, armed: bool) {
        let mut message =
            HEARTBEAT_DATA { autopilot: MavAutopilot::MAV_AUTOPILOT_ARDUPILOTMEGA, ..HEARTBEAT_DATA::default() };
        message.base_mode.set(MavModeFlag::MAV_MODE_FLAG_SAFETY_ARMED, armed);
        self.socket.send(self.encoder.encode(&message, None)).expect("sent");
    }

    fn position(&mut self, time_boot_ms: u32, height_m: i32, speed_m_s: i16) {
        let (lat, lon) = ((ORIGIN.lat_deg * 1e7) as i32, (ORIGIN.lon_deg * 1e7) as i32);
        let (relative_alt, vx) = (height_m * 1000, speed_m_s * 100);
        let message = GLOBAL_POSITION_INT_DATA { time_boot_ms, lat, lon, relative_alt, vx, ..Default::default() };
        self.socket.send(self.encoder.encode(&message, None)).expect("sent");
    }
}

#[test]
fn a_stranger_who_says_disarmed_from_another_address_ends_no_flight() {
    let folder = tempfile::tempdir().expect("a folder");
    let clock = Arc::new(ManualClock::default());
    let link = UdpLink::listen("127.0.0.1:0").expect("a port");
    let port = link.local().expect("its port");
    let camera = FolderCamera::open(folder.path()).expect("the folder").on_simulated_clock();
    let mut vehicle = Vehicle::new(link, camera, clock.clone(), &settings()).expect("a vehicle");
    let (mut autopilot, mut stranger) = (Speaker::to(port), Speaker::to(port));
    let mut landed_s = None;
    for tenth in 0..700u32 {
        clock.set(u64::from(tenth) * 100_000_000);
        let s = tenth / 10;
        let aloft = (5..50).contains(&s);
        autopilot.position(30_000 + tenth * 100, if aloft { 40 } else { 0 }, if aloft { 5 } else { 0 });
        if tenth % 10 == 0 {
            autopilot.heartbeat((2..52).contains(&s));
            if s >= 15 {
                // As often as the autopilot, and with a position to match.
                stranger.heartbeat(false);
                stranger.position(30_000 + tenth * 100 + 50, 0, 0);
            }
        }
        // Each takes one datagram at most, and waits for it: those that were sent, and one more.
        for _ in 0..if tenth % 10 == 0 { 5 } else { 2 } {
            let _ = vehicle.poll(Duration::ZERO).expect("a socket does not fail");
        }
        if vehicle.autopilot().landed {
            landed_s.get_or_insert(s);
        }
    }
    assert_eq!(landed_s, Some(55), "three seconds after the autopilot itself has said so");
    assert_eq!(vehicle.counters().link.refused_peers, 2 * 55);
}

/// Ten seconds of a vehicle with `settings` on a line on which `speak` says something every second; what it complains of, and all
/// that it told the ground station.
fn complaints(
    settings: &VehicleSettings,
    folder: &Path,
    speak: &mut dyn FnMut(u64, &mut WireLink),
) -> (Vec<Complaint>, String) {
    let clock = Arc::new(ManualClock::default());
    let camera = FolderCamera::open(folder).expect("a folder, or none yet").on_simulated_clock();
    let (line, mut other) = WireLink::pair();
    let mut vehicle = Vehicle::new(line, camera, clock.clone(), settings).expect("a vehicle");
    let (mut told, mut found) = (String::new(), Vec::<(Complaint, String)>::new());
    for s in 0..10 {
        speak(s, &mut other);
        for tenth in 0..10 {
            clock.set((s * 10 + tenth) * 100_000_000);
            while let Some(event) = vehicle.poll(Duration::ZERO).expect("a wire does not fail") {
                let Event::Complaint { what, line } = event else { continue };
                found.retain(|f| f.0 != what);
                found.extend(line.map(|line| (what, line)));
            }
        }
        told.extend(texts(&mut other).into_iter().map(|(_, text)| text));
    }
    for (complaint, line) in &found {
        assert!(told.contains(complaint.name()), "{complaint:?} in {told}");
        assert!(line.contains("; ") && !line.contains('\n'), "{line}");
    }
    (found.into_iter().map(|f| f.0).collect(), told)
}

fn heartbeat_of(system: u8, autopilot: MavAutopilot, line: &mut WireLink) {
    let message = HEARTBEAT_DATA { autopilot, ..HEARTBEAT_DATA::default() };
    line.write(Encoder::new(system, 1).encode(&message, None)).expect("written");
}

/// The parameter is this, whoever asks.
fn parameter(name: &str, param_value: f32, line: &mut WireLink) {
    let message = PARAM_VALUE_DATA { param_id: name.into(), param_value, ..PARAM_VALUE_DATA::default() };
    line.write(Encoder::new(1, 1).encode(&message, None)).expect("written");
}

/// As [`complaints`], with the usual settings and a camera that works.
fn complaints_of(speak: &mut dyn FnMut(u64, &mut WireLink)) -> (Vec<Complaint>, String) {
    let folder = tempfile::tempdir().expect("a folder");
    complaints(&settings(), folder.path(), speak)
}

#[test]
fn a_port_on_which_no_autopilot_speaks_is_named_within_ten_seconds() {
    assert_eq!(complaints_of(&mut |_, _| {}).0, [Complaint::Nobody]);
    let ground_station = MavAutopilot::MAV_AUTOPILOT_INVALID;
    let (found, told) = complaints_of(&mut |_, line| heartbeat_of(255, ground_station, line));
    assert!(found == [Complaint::Nobody] && told.contains("messages of others"), "{told}");
}

#[test]
fn a_line_that_carries_no_mavlink_is_named_within_ten_seconds() {
    assert_eq!(complaints_of(&mut |_, line| line.write(&[0xFD; 300]).expect("written")).0, [Complaint::Noise]);
}

#[test]
fn a_wrong_system_id_is_named_within_ten_seconds_beside_those_that_are_heard() {
    let kind = MavAutopilot::MAV_AUTOPILOT_ARDUPILOTMEGA;
    let (found, told) = complaints_of(&mut |_, line| heartbeat_of(7, kind, line));
    assert!(found == [Complaint::OtherSystem] && told.contains("7, not system_id = 1"), "{told}");
    assert_eq!(complaints_of(&mut |_, line| heartbeat_of(1, kind, line)).0, []);
}

#[test]
fn an_autopilot_that_triggers_no_camera_is_named_within_ten_seconds_beside_its_parameter() {
    let (ardupilot, px4) = (MavAutopilot::MAV_AUTOPILOT_ARDUPILOTMEGA, MavAutopilot::MAV_AUTOPILOT_PX4);
    for (kind, name) in [(ardupilot, "CAM1_TYPE"), (px4, "TRIG_MODE")] {
        let speak = |value: f32| {
            complaints_of(&mut |_, line| {
                heartbeat_of(1, kind, line);
                parameter(name, value, line);
            })
        };
        let (found, told) = speak(0.0);
        assert!(found == [Complaint::NoTrigger] && told.contains(&format!("{name} is 0")), "{told}");
        assert_eq!(speak(1.0).0, []);
    }
}

#[test]
fn the_parameter_of_the_trigger_is_asked_for_and_not_for_ever() {
    let folder = tempfile::tempdir().expect("a folder");
    let clock = Arc::new(ManualClock::default());
    let (mut vehicle, mut line) = with_line(folder.path(), None, &clock);
    let mut asked = Vec::new();
    for s in 0..20 {
        heartbeat_of(1, MavAutopilot::MAV_AUTOPILOT_ARDUPILOTMEGA, &mut line);
        clock.set(s * 1_000_000_000);
        while vehicle.poll(Duration::ZERO).expect("a wire does not fail").is_some() {}
        let (mut framer, mut bytes) = (Framer::new(), [0; 256]);
        while let Ok(Received { bytes: count @ 1.., .. }) = line.read(&mut bytes, Duration::ZERO) {
            framer.push(&bytes[..count]);
            while let Some(frame) = framer.next_frame() {
                let request = frame.message::<PARAM_REQUEST_READ_DATA>();
                asked.extend(request.map(|r| (r.param_id.to_str().expect("UTF-8").to_owned(), r.param_index)));
            }
        }
    }
    assert_eq!(asked, vec![("CAM1_TYPE".to_owned(), -1); 3]);
}

#[test]
fn signing_that_the_autopilot_does_not_do_is_named() {
    let folder = tempfile::tempdir().expect("a folder");
    let key = folder.path().join("link.key");
    std::fs::write(&key, [7; 32]).expect("written");
    std::fs::set_permissions(&key, std::os::unix::fs::PermissionsExt::from_mode(0o600)).expect("its own");
    let mut settings = settings();
    settings.link.signing = config::link::Signing::Require;
    settings.link.signing_key = Some(key);
    let kind = MavAutopilot::MAV_AUTOPILOT_ARDUPILOTMEGA;
    let (found, told) = complaints(&settings, folder.path(), &mut |_, line| heartbeat_of(1, kind, line));
    assert!(found == [Complaint::Signing] && told.contains(" messages unsigned"), "{found:?} {told}");
}

#[test]
fn a_missing_camera_folder_and_pictures_that_nobody_announces_are_named() {
    let above = tempfile::tempdir().expect("a folder");
    let folder = above.path().join("camera");
    let of = VehicleSettings { camera: Some(config::mission::CameraSource::Folder(folder.clone())), ..settings() };
    let kind = MavAutopilot::MAV_AUTOPILOT_ARDUPILOTMEGA;
    let (found, told) = complaints(&of, &folder, &mut |_, line| heartbeat_of(1, kind, line));
    assert!(found == [Complaint::NoFolder] && told.contains(&folder.display().to_string()), "{told}");
    // It comes while the vehicle listens, and pictures with it, of which no exposure is announced.
    let (found, told) = complaints(&of, &folder, &mut |s, line| {
        heartbeat_of(1, kind, line);
        std::fs::create_dir_all(&folder).expect("a folder");
        if s < 3 {
            let path = folder.join(format!("DJI_{s}.jpg"));
            photograph(&path, ORIGIN, 2);
            // The file system's clock is a coarse one: none of them is as old as the listening.
            let file = std::fs::File::options().write(true).open(&path).expect("a file");
            file.set_modified(SystemTime::now() + Duration::from_secs(1)).expect("a time");
        }
    });
    assert!(found == [Complaint::Unannounced] && told.contains(" pictures; check"), "{found:?} {told}");
}

#[test]
fn a_serial_port_that_is_not_there_yet_is_waited_for_and_named_at_once() {
    let folder = tempfile::tempdir().expect("a folder");
    let port = folder.path().join("ttyACM0");
    let settings = VehicleSettings {
        address: LinkAddress::Serial { path: port.clone(), baud: 57_600 },
        patient: true,
        ..settings()
    };
    let mut vehicle: Vehicle = Vehicle::open(&settings).expect("it is waited for");
    assert_eq!(vehicle.poll(Duration::ZERO).expect("silence"), Some(Event::LinkLost));
    let event = vehicle.poll(Duration::ZERO).expect("silence");
    let Some(Event::Complaint { what: Complaint::Closed, line: Some(line) }) = event else { panic!("{event:?}") };
    assert!(line.contains("ttyACM0") && line.contains("waited for") && !line.contains('\n'), "{line}");
}
