//! Real photographs with real telemetry (a DJI flight of 86 pictures, taken every 12 s, with a battery change between), played as
//! an autopilot and a camera at many times their speed: every picture must get its own pose. Also a cable that is pulled.
#![allow(clippy::expect_used, clippy::panic, reason = "a test fails by panicking")]

use std::path::{Path, PathBuf};
use std::sync::atomic::AtomicBool;
use std::sync::mpsc::channel;
use std::time::{Duration, Instant};

use config::link::LinkSettings;
use config::mission::{CameraSettings, CameraSource, MountAttitude, MountSettings};
use geometry::geodesy::{EnuFrame, Geodetic};
use hal::link::{LinkAddress, PtyLink};
use hal::mavlink::Signer;
use hal::mavlink::channel::Channel;
use hal::mavlink::dialect::{HEARTBEAT_DATA, MavAutopilot};
use hal::vehicle::{Event, PosedPicture, Vehicle, VehicleSettings};
use sim::replay::{Playlist, PlaylistItem, ReplaySettings, play};

use needs::shared;

const LENS: CameraSettings = CameraSettings {
    width: 640,
    height: 480,
    fx: 385.3,
    fy: 384.63,
    cx: 320.0,
    cy: 240.5,
    distortion: [0.0; 4],
    exposure_delay_ms: 0.0,
    index: None,
};

/// The data set's folder, if the shared data is there.
fn sheffield() -> Option<PathBuf> {
    shared("data/sheffield_cross")
}

/// Seconds of the day of an EXIF time.
fn seconds(time: &str) -> f64 {
    let parts: Vec<f64> = time[11..].split(':').map(|p| p.parse().expect("digits")).collect();
    parts[0] * 3600.0 + parts[1] * 60.0 + parts[2]
}

fn playlist(folder: &Path) -> Playlist {
    let table = std::fs::read_to_string(folder.join("gps.csv")).expect("gps.csv");
    let items: Vec<PlaylistItem> = table
        .lines()
        .skip(1)
        .map(|line| {
            let cells: Vec<&str> = line.split(',').collect();
            let number = |i: usize| cells[i].parse::<f64>().expect("a number");
            let position = Geodetic { lat_deg: number(2), lon_deg: number(3), alt_m: number(4) };
            let (vehicle, gimbal) = ([number(6), number(7), number(8)], [number(9), number(10), number(11)]);
            PlaylistItem::from_angles(
                seconds(cells[1]),
                position,
                vehicle,
                gimbal,
                folder.join("images").join(cells[0]),
            )
        })
        .collect();
    Playlist { home: items[0].position, items }
}

#[test]
fn every_real_photograph_gets_its_own_pose() {
    let Some(folder) = sheffield() else { return };
    let playlist = playlist(&folder);
    let camera = tempfile::tempdir().expect("a folder");
    let mut settings = ReplaySettings::default();
    (settings.session.speed, settings.session.settle_s, settings.session.linger_s) = (40.0, 3.0, 1.5);
    let (stop, (tell, told)) = (AtomicBool::new(false), channel());
    let frames: Vec<PosedPicture> = std::thread::scope(|scope| {
        let playing = scope.spawn(|| {
            let ready = &mut |path: Option<&Path>| tell.send(path.expect("a pty").to_path_buf()).expect("told");
            play(&playlist, &settings, &LinkAddress::Pty(None), Some(camera.path()), &stop, ready)
        });
        let path = told.recv_timeout(Duration::from_secs(30)).expect("ready");
        let mut vehicle = Vehicle::open(&VehicleSettings {
            link: LinkSettings { exif_pose: false, ..LinkSettings::default() },
            camera: Some(CameraSource::Folder(camera.path().into())),
            ..VehicleSettings::new(LinkAddress::Serial { path, baud: 921_600 }, LENS, playlist.home)
        })
        .expect("opens");
        let mut frames = Vec::new();
        while !playing.is_finished() {
            match vehicle.poll(Duration::from_millis(20)).expect("a link") {
                Some(Event::Posed(frame)) => frames.push(frame),
                Some(Event::Unmatched(unmatched)) => println!("{unmatched}"),
                _ => {}
            }
        }
        // What still waits is told by the whole flight.
        vehicle.finish();
        for _ in 0..1000 {
            match vehicle.poll(Duration::from_millis(1)) {
                Ok(Some(Event::Posed(frame))) => frames.push(frame),
                Ok(Some(Event::Unmatched(unmatched))) => println!("{unmatched}"),
                _ if vehicle.is_finished() => break,
                _ => {}
            }
        }
        println!("{:?}", vehicle.counters());
        let image = vehicle.load(&frames[0]).expect("a picture");
        assert_eq!(image.dimensions(), (640, 480));
        frames
    });
    let world = EnuFrame::new(playlist.home);
    let errors: Vec<(f64, f64)> = frames
        .iter()
        .map(|frame| {
            let name = frame.picture.name();
            let item = playlist.items.iter().find(|i| i.picture.file_name() == name.file_name()).expect("of the list");
            let off = (frame.pose.position - world.to_enu(item.position)).length();
            (off, frame.pose.rotation.angle_between(item.camera_to_enu()).to_degrees())
        })
        .collect();
    let worst = errors.iter().fold((0.0f64, 0.0f64), |w, e| (w.0.max(e.0), w.1.max(e.1)));
    println!("{} of {} pictures, worst {worst:.3?} (m, degrees)", frames.len(), playlist.items.len());
    assert_eq!(frames.len(), playlist.items.len());
    // At 40 × a millisecond of the companion is 40 ms of flight.
    assert!(worst.0 < 0.5 && worst.1 < 1.0, "{worst:?}");
}

/// One heartbeat over the cable, and what the vehicle makes of it.
fn beat(channel: &mut Channel<PtyLink>, vehicle: &mut Vehicle) -> Option<Event> {
    let autopilot = MavAutopilot::MAV_AUTOPILOT_ARDUPILOTMEGA;
    channel.send(&HEARTBEAT_DATA { autopilot, ..HEARTBEAT_DATA::default() }).expect("a pty");
    // What the vehicle sends must be taken off the line.
    channel.fill(Duration::from_millis(1)).expect("a pty");
    while channel.next_frame().is_some() {}
    vehicle.poll(Duration::from_millis(50)).expect("it reconnects")
}

#[test]
fn a_pulled_cable_is_reported_and_plugged_in_again() {
    let folder = tempfile::tempdir().expect("a folder");
    let alias = folder.path().join("ttyAMA0");
    let plug = || Channel::new(PtyLink::create(Some(&alias)).expect("a pty"), 1, 1, Signer::off());
    let mut channel = plug();
    let mut vehicle = Vehicle::open(&VehicleSettings {
        patient: true,
        link: LinkSettings { heartbeat_timeout_s: 2.0, ..LinkSettings::default() },
        mount: MountSettings { attitude: MountAttitude::Fixed, ..MountSettings::default() },
        ..VehicleSettings::new(
            LinkAddress::Serial { path: alias.clone(), baud: 921_600 },
            LENS,
            Geodetic { lat_deg: 46.0, lon_deg: 7.0, alt_m: 0.0 },
        )
    })
    .expect("opens");
    while vehicle.autopilot().heartbeat_ns.is_none() {
        beat(&mut channel, &mut vehicle);
    }
    drop(channel);
    let begun = Instant::now();
    while vehicle.poll(Duration::from_millis(50)).expect("it reconnects") != Some(Event::LinkLost) {
        assert!(begun.elapsed() < Duration::from_secs(20), "not noticed");
    }
    let mut channel = plug();
    let begun = Instant::now();
    while beat(&mut channel, &mut vehicle) != Some(Event::LinkBack) {
        assert!(begun.elapsed() < Duration::from_secs(20), "not back: {:?}", vehicle.link().last_error());
    }
    assert_eq!((vehicle.counters().link.link_losses, vehicle.is_link_lost()), (1, false));
}
