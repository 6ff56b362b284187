//! Key frames outlive restarts, damage and full disks.

use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};

use config::disk::System;
use config::disk::bounded::{Bounded, bytes_below};
use glam::{DQuat, DVec3};

use super::*;

fn frame(name: &str, x: f64) -> PosedImage {
    PosedImage {
        name: name.into(),
        time_ns: 7,
        image: image::RgbImage::from_fn(4, 3, |x, y| image::Rgb([x as u8, y as u8, 9])),
        view: View {
            intrinsics: Intrinsics { width: 4, height: 3, fx: 3.0, fy: 3.0, cx: 2.0, cy: 1.5 },
            pose: Pose { rotation: DQuat::from_rotation_x(3.0), center: DVec3::new(x, 2.0, 40.0) },
        },
        sigma: PoseSigma { position_m: [1.0; 3], rotation_rad: [f32::INFINITY; 3] },
    }
}

const ORIGIN: Geodetic = Geodetic { lat_deg: 46.0, lon_deg: 7.0, alt_m: 500.0 };

#[test]
fn a_restarted_flight_finds_its_key_frames_as_they_were() {
    let dir = tempfile::tempdir().expect("tempdir");
    let intrinsics = frame("a.jpg", 0.0).view.intrinsics;
    let mut store = KeyframeStore::open(&Disk::default(), dir.path(), &intrinsics, ORIGIN).expect("new");
    store.add(&frame("a.jpg", 5.0)).expect("add");
    let again =
        KeyframeStore::open(&Disk::default(), dir.path(), &intrinsics, ORIGIN).expect("again").load(0).expect("load");
    let (stored, first) = (again.view, frame("a.jpg", 5.0));
    assert_eq!((stored, again.sigma, again.image), (first.view, first.sigma, first.image));
}

/// A store of `n` key frames along a line, 5 m apart.
fn line(disk: &Disk, folder: &Path, n: u32) -> KeyframeStore {
    let mut store = KeyframeStore::open(disk, folder, &frame("0.jpg", 0.0).view.intrinsics, ORIGIN).expect("new");
    for i in store.len() as u32..n {
        store.add(&frame(&format!("{i}.jpg"), 5.0 * f64::from(i))).expect("add");
    }
    store
}

fn names(store: &mut KeyframeStore) -> Vec<String> {
    (0..).map_while(|i| store.sound(i)).map(|frame| frame.name).collect()
}

#[test]
fn half_a_picture_is_set_aside_and_the_flight_goes_on_with_the_others() {
    let dir = tempfile::tempdir().expect("tempdir");
    line(&Disk::default(), dir.path(), 4);
    let picture = dir.path().join("images/1.png");
    let whole = std::fs::read(&picture).expect("picture");
    std::fs::write(&picture, &whole[..whole.len() / 2]).expect("cut");
    std::fs::remove_file(dir.path().join("images/2.png")).expect("lost");
    let mut store = line(&Disk::default(), dir.path(), 4);
    assert_eq!(names(&mut store), ["0.png", "3.png"]);
    assert!(dir.path().join("images/1.damaged-1.png").is_file());
    // Once and for all: the next start reads a list without them.
    assert_eq!(line(&Disk::default(), dir.path(), 0).len(), 2);
}

#[test]
fn a_damaged_list_is_set_aside_and_the_one_before_is_used() {
    let dir = tempfile::tempdir().expect("tempdir");
    line(&Disk::default(), dir.path(), 4);
    let list = dir.path().join("transforms.json");
    let whole = std::fs::read(&list).expect("list");
    std::fs::write(&list, &whole[..whole.len() / 2]).expect("cut");
    let mut store = line(&Disk::default(), dir.path(), 0);
    assert_eq!(names(&mut store), ["0.png", "1.png", "2.png"]);
    assert!(dir.path().join("transforms.damaged-1.json").is_file());
    store.add(&frame("3.jpg", 15.0)).expect("goes on");
    std::fs::write(&list, b"").expect("emptied");
    std::fs::write(previous(&list), b"{").expect("cut");
    assert!(line(&Disk::default(), dir.path(), 0).is_empty(), "with neither it starts anew");
}

#[test]
fn a_full_disk_refuses_one_key_frame_and_keeps_all_others() {
    let dir = tempfile::tempdir().expect("tempdir");
    let limit = Arc::new(AtomicU64::new(u64::MAX));
    let disk = Disk::new(Bounded::new(System, dir.path(), limit.clone()));
    let mut store = line(&disk, dir.path(), 20);
    limit.store(bytes_below(dir.path()) + 10, Ordering::Relaxed);
    let e = store.add(&frame("20.jpg", 100.0)).expect_err("no room");
    assert!(e.may_pass() && e.to_string().contains("20.png"), "{e}");
    assert_eq!((store.len(), line(&Disk::default(), dir.path(), 0).len()), (20, 20));
    let mut relieve = |relief| store.relieve(relief, &dir.path().join("model.dgtr"));
    assert!(relieve(Relief::OldCheckpoints) && !relieve(Relief::OldCheckpoints));
    let gone = store.thin_out();
    assert!((6..=12).contains(&gone), "{gone} of 20 on an even line");
    store.add(&frame("20.jpg", 100.0)).expect("room again");
    let kept = names(&mut line(&Disk::default(), dir.path(), 0));
    assert_eq!(kept.len(), 21 - gone);
    // Never both of a pair.
    let places: Vec<i32> = kept.iter().map(|n| n.trim_end_matches(".png").parse().expect("number")).collect();
    assert!(places.windows(2).all(|p| p[1] - p[0] <= 2), "{places:?}");
}

#[test]
fn the_store_is_a_data_set() {
    let dir = tempfile::tempdir().expect("tempdir");
    let intrinsics = frame("a.jpg", 0.0).view.intrinsics;
    let mut store = KeyframeStore::open(&Disk::default(), dir.path(), &intrinsics, ORIGIN).expect("new");
    for i in 0..9 {
        store.add(&frame(&format!("{i}.jpg"), f64::from(i))).expect("add");
    }
    let again = KeyframeStore::open(&Disk::default(), dir.path(), &intrinsics, ORIGIN).expect("again");
    assert_eq!(again.len(), 9);
    let loaded = again.load(3).expect("load");
    assert_eq!((loaded.name.as_str(), loaded.view.pose.center.x, loaded.time_ns), ("3.png", 3.0, 7));
    let set = models::dataset::Dataset::open(dir.path()).expect("a data set");
    assert_eq!(set.frames.len(), 9);
    assert!((set.frames[3].view.pose.center - loaded.view.pose.center).length() < 1e-9);
    assert_eq!(set.origin, Some(ORIGIN));
}
