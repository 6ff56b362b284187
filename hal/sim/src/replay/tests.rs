//! Promises of the replays: what goes in as a pose comes out as that pose at the other end of a real serial line.

use std::path::PathBuf;

use config::link::LinkSettings;
use geometry::geodesy::{EnuFrame, Geodetic};
use glam::{DQuat, DVec3};

use super::*;
use crate::aircraft::angle_between;
use crate::companion::accompany;
use crate::reference::Lens;
use crate::world::WorldSettings;

use needs::shared;

const HOME: Geodetic = Geodetic { lat_deg: 28.04, lon_deg: -82.7, alt_m: -69.7 };

/// A zig-zag of tilted photographs, 6 s apart, with files in `folder`.
fn playlist(folder: &Path) -> Playlist {
    let frame = EnuFrame::new(HOME);
    let items = (0..9).map(|k| {
        let a = f64::from(k);
        let at = frame.to_geodetic(DVec3::new(14.0 * a, 20.0 * (1.3 * a).sin(), 60.0 + a));
        let picture = folder.join(format!("DJI_{:04}.jpg", 54 + 2 * k));
        image::RgbImage::from_pixel(64, 48, image::Rgb([k as u8 * 20; 3])).save(&picture).expect("picture");
        let heading = 93.0 + 40.0 * (a * 0.5).sin();
        PlaylistItem::from_angles(100.0 + 6.0 * a, at, [heading, -3.0, 4.0], [heading - 2.0, -75.1, 0.0], picture)
    });
    Playlist { home: HOME, items: items.collect() }
}

fn quick(speed: f64) -> ReplaySettings {
    let session = SessionSettings { speed, wait_for_peer_s: 20.0, settle_s: 2.5, linger_s: 1.5 };
    ReplaySettings { session, ..ReplaySettings::default() }
}

#[test]
fn every_photograph_arrives_with_its_own_pose() {
    let (source, folder) = (tempfile::tempdir().expect("folder"), tempfile::tempdir().expect("folder"));
    let list = playlist(source.path());
    let never = AtomicBool::new(false);
    let (report, companion) = accompany(HOME, folder.path(), LinkSettings::default(), |ready| {
        play(&list, &quick(8.0), &LinkAddress::Pty(None), Some(folder.path()), &never, ready).expect("played")
    });
    assert!(report.completed && report.peer && report.triggers == 9 && report.pictures.delivered == 9, "{report:?}");
    assert_eq!(companion.frames.len(), 9, "{:?} {:?}", companion.unmatched, companion.counters);
    let frame = EnuFrame::new(HOME);
    for item in &list.items {
        let name = item.picture.file_name().expect("name").to_string_lossy().into_owned();
        let got = companion.frame(&name).expect(&name);
        let (dp, dr) = (
            (got.pose.position - frame.to_enu(item.position)).length(),
            angle_between(got.pose.rotation, item.camera_to_enu()).to_degrees(),
        );
        assert!(dp < 0.15 && dr < 0.5, "{name}: {dp} m, {dr}°");
    }
    assert_eq!(companion.counters.link.damaged, 0);
}

#[test]
fn a_camera_pose_goes_through_the_gimbal_and_comes_back() {
    for k in 0..50 {
        let a = f64::from(k);
        let camera =
            DQuat::from_euler(glam::EulerRot::ZYX, 0.7 * a, 0.3 * (a * 0.9).sin(), 3.0 + 0.4 * (a * 1.1).cos());
        let item = PlaylistItem::from_camera(0.0, HOME, camera, PathBuf::from("a.jpg"));
        assert!(angle_between(item.camera_to_enu(), camera) < 1e-6);
        // The vehicle points where the upper edge of the picture does.
        let nose = item.vehicle * DVec3::X; // NED
        let up = camera * DVec3::NEG_Y;
        assert!(nose.x * up.y + nose.y * up.x > 0.0, "{nose} {up}");
    }
}

#[test]
fn long_pauses_are_shortened_and_wrong_playlists_refused() {
    let folder = tempfile::tempdir().expect("folder");
    let mut list = playlist(folder.path());
    for item in list.items.iter_mut().skip(5) {
        item.time_s += 3600.0;
    }
    let flight = list.flight(&quick(1.0)).expect("a flight");
    assert!((flight.exposures[5].middle_s - flight.exposures[4].middle_s - 30.0).abs() < 1e-9);
    assert!((flight.exposures[1].middle_s - flight.exposures[0].middle_s - 6.0).abs() < 1e-9);
    let why = |list: &Playlist| list.flight(&quick(1.0)).expect_err("refused").to_string();
    assert!(why(&Playlist { home: HOME, items: vec![] }).contains("no pictures"));
    list.items.swap(1, 2);
    assert!(why(&list).contains("sort by time"));
    list = playlist(folder.path());
    list.items[3].position.lat_deg = f64::NAN;
    assert!(why(&list).contains("DJI_0060"));
}

#[test]
fn a_missing_photograph_is_named() {
    let (source, folder) = (tempfile::tempdir().expect("folder"), tempfile::tempdir().expect("folder"));
    let list = playlist(source.path());
    std::fs::remove_file(&list.items[0].picture).expect("removed");
    let never = AtomicBool::new(false);
    let mut settings = quick(50.0);
    (settings.session.wait_for_peer_s, settings.session.settle_s) = (0.0, 0.0);
    let failed = play(&list, &settings, &LinkAddress::Pty(None), Some(folder.path()), &never, &mut |_| {});
    assert!(failed.expect_err("missing").to_string().contains("DJI_0054.jpg"));
}

/// The recorded SITL flights, where they are on this machine.
fn recorded(name: &str) -> Option<PathBuf> {
    shared(&format!("data/sitl/{name}/survey.tlog"))
}

#[test]
fn recorded_survey_is_read_with_its_truth_and_its_forty_exposures() {
    let Some(path) = recorded("run8") else { return };
    let recording = Recording::read(&path).expect("reads");
    let truth = recording.truth.as_ref().expect("truth");
    assert_eq!((recording.exposures.len(), recording.damaged, recording.truncated), (40, 0, false));
    for (boot_s, _) in &recording.exposures {
        let s = truth.at(*boot_s);
        assert!((s.position.z - 40.0).abs() < 1.5, "40 m above home: {s:?}");
        assert!((s.gimbal * DVec3::X).z > 0.999, "the gimbal looks down");
    }
}

#[test]
fn recorded_survey_flies_again_and_all_forty_pictures_get_the_true_pose() {
    let Some(path) = recorded("run8") else { return };
    let folder = tempfile::tempdir().expect("folder");
    let recording = Recording::read(&path).expect("reads");
    let truth = recording.truth.clone().expect("truth");
    let settings = TlogSettings {
        seed: 5,
        world: WorldSettings { half_extent_m: 100.0, ..WorldSettings::default() },
        lens: Lens { width: 64, height: 48, fx: 50.0, fy: 50.0, cx: 32.0, cy: 24.0 },
        session: SessionSettings { speed: 2.0, wait_for_peer_s: 20.0, settle_s: 2.5, linger_s: 2.0 },
        faults: Default::default(),
    };
    let never = AtomicBool::new(false);
    let (report, companion) = accompany(recording.home, folder.path(), LinkSettings::default(), |ready| {
        play_tlog(&path, &settings, &LinkAddress::Pty(None), Some(folder.path()), None, &never, ready).expect("played")
    });
    assert!(report.completed && report.exposures == 40 && report.pictures.delivered == 40, "{report:?}");
    assert_eq!(companion.frames.len(), 40, "{:?} {:?}", companion.unmatched, companion.counters);
    let (mut metres, mut degrees) = (0.0, 0.0);
    for (boot_s, index) in &recording.exposures {
        let got = companion.frame(&format!("IMG_{index:04}.jpg")).expect("a frame");
        let s = truth.at(*boot_s);
        metres += (got.pose.position - s.position).length() / 40.0;
        degrees += angle_between(got.pose.rotation, crate::axes::camera_to_enu(s.gimbal)).to_degrees() / 40.0;
    }
    println!("run8: {metres:.3} m, {degrees:.2}° mean");
    assert!(metres < 0.25 && degrees < 1.5, "{metres} m, {degrees}°");
}
