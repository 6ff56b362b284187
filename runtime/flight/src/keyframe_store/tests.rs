//! Key frames outlive restarts, damage and full disks.

use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};

use disk::System;
use disk::bounded::{Bounded, bytes_below};
use glam::{DQuat, DVec3};

use models::camera::PoseSigma;

use super::*;

const CAMERA: CameraSettings = CameraSettings::pinhole(4, 3, 3.0);
const LENS: Intrinsics = Intrinsics { width: 4, height: 3, fx: 3.0, fy: 3.0, cx: 2.0, cy: 1.5 };

fn open(disk: &Disk, folder: &Path) -> KeyframeStore {
    KeyframeStore::open(disk, folder, &CAMERA, &LENS, ORIGIN).expect("opens")
}

fn frame(name: &str, x: f64) -> KeyFrame {
    let posed = PosedImage {
        name: name.into(),
        time_ns: 7,
        image: image::RgbImage::from_fn(4, 3, |x, y| image::Rgb([x as u8, y as u8, 9])),
        view: View {
            intrinsics: LENS,
            pose: Pose { rotation: DQuat::from_rotation_x(3.0), center: DVec3::new(x, 2.0, 40.0) },
        },
        mask: None,
        sigma: PoseSigma { position_m: [1.0; 3], rotation_rad: [f32::INFINITY; 3] },
    };
    KeyFrame { file: Picture::Rgb(posed.image.clone()), posed }
}

const ORIGIN: Geodetic = Geodetic { lat_deg: 46.0, lon_deg: 7.0, alt_m: 500.0 };

#[test]
fn a_restarted_flight_finds_its_key_frames_as_they_were() {
    let dir = tempfile::tempdir().expect("tempdir");
    let mut store = open(&Disk::default(), dir.path());
    store.add(&frame("a.png", 5.0)).expect("add");
    let again = open(&Disk::default(), dir.path()).load(0).expect("load");
    let (stored, first) = (again.view, frame("a.png", 5.0).posed);
    assert_eq!((stored, again.sigma, again.image), (first.view, first.sigma, first.image));
}

/// A store of `n` key frames along a line, 5 m apart.
fn line(disk: &Disk, folder: &Path, n: u32) -> KeyframeStore {
    let mut store = open(disk, folder);
    for i in store.len() as u32..n {
        store.add(&frame(&format!("{i}.png"), 5.0 * f64::from(i))).expect("add");
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

/// A decoder fills up with grey what is missing of a JPEG.
#[test]
fn a_jpeg_that_is_cut_anywhere_is_set_aside() {
    let dir = tempfile::tempdir().expect("tempdir");
    let mut jpeg = Vec::new();
    let noise = image::RgbImage::from_fn(4, 3, |x, y| image::Rgb([(91 * x) as u8, (77 * y) as u8, (13 * x * y) as u8]));
    noise.write_to(&mut std::io::Cursor::new(&mut jpeg), image::ImageFormat::Jpeg).expect("encoded");
    for cut in 2..30 {
        let folder = dir.path().join(cut.to_string());
        let mut store = open(&Disk::default(), &folder);
        store.add(&KeyFrame { file: Picture::Jpeg(jpeg.clone()), ..frame("a.jpg", 5.0) }).expect("add");
        assert!(store.load(0).is_ok());
        let picture = folder.join(&store.list.frames[0].file_path);
        let whole = std::fs::read(&picture).expect("picture");
        std::fs::write(&picture, &whole[..whole.len() - cut]).expect("cut");
        assert!(store.load(0).is_err_and(|e| e.to_string().contains("cut off")), "{cut}");
        // Whatever ends it.
        let scan = whole.windows(2).rposition(|w| w == [0xFF, 0xDA]).expect("a scan") + 14;
        let ended = [&whole[..scan + (whole.len() - scan) / 4], &[0xFF, 0xD9]].concat();
        std::fs::write(&picture, ended).expect("cut");
        assert!(store.load(0).is_err_and(|e| e.to_string().contains("cut off")), "an end");
        std::fs::write(&picture, &whole[..whole.len() - cut]).expect("cut");
        assert!(store.sound(0).is_none());
    }
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
    store.add(&frame("3.png", 15.0)).expect("goes on");
    std::fs::write(&list, b"").expect("emptied");
    std::fs::write(previous(&list), b"{").expect("cut");
    assert!(line(&Disk::default(), dir.path(), 0).is_empty(), "with neither it starts anew");
}

/// Pictures that are given up are removed: a damaged list must not say where.
#[test]
fn a_list_that_leads_out_of_its_folder_or_nowhere_in_the_world_counts_as_damaged() {
    let dir = tempfile::tempdir().expect("tempdir");
    line(&Disk::default(), dir.path(), 2);
    let list = dir.path().join("transforms.json");
    let whole = std::fs::read_to_string(&list).expect("list");
    let damaged = [
        whole.replace("images/1.png", "../../precious.png"),
        whole.replace("images/1.png", "/precious.png"),
        whole.replace("\"rotation\": [", "\"rotation\": [\n 1e9, 0, 0, 0], \"turned\": ["),
    ];
    for (n, damaged) in damaged.iter().enumerate() {
        assert_ne!(*damaged, whole, "{n}");
        std::fs::write(&list, damaged).expect("damaged");
        let left = names(&mut line(&Disk::default(), dir.path(), 0));
        assert_eq!(left, ["0.png"], "{n}: the list before");
        std::fs::copy(previous(&list), &list).expect("again");
    }
}

#[test]
fn a_full_disk_refuses_one_key_frame_and_keeps_all_others() {
    let dir = tempfile::tempdir().expect("tempdir");
    let limit = Arc::new(AtomicU64::new(u64::MAX));
    let disk = Disk::new(Bounded::new(System, dir.path(), limit.clone()));
    let mut store = line(&disk, dir.path(), 20);
    limit.store(bytes_below(dir.path()) + 10, Ordering::Relaxed);
    let e = store.add(&frame("20.png", 100.0)).expect_err("no room");
    assert!(e.may_pass() && e.to_string().contains("20.png"), "{e}");
    assert_eq!((store.len(), line(&Disk::default(), dir.path(), 0).len()), (20, 20));
    let mut relieve = |relief| store.relieve(relief, &dir.path().join("model.dgtr"));
    assert!(relieve(Relief::OldCheckpoints) && !relieve(Relief::OldCheckpoints));
    let gone = store.thin_out();
    assert!((6..=12).contains(&gone), "{gone} of 20 on an even line");
    store.add(&frame("20.png", 100.0)).expect("room again");
    let kept = names(&mut line(&Disk::default(), dir.path(), 0));
    assert_eq!(kept.len(), 21 - gone);
    // Never both of a pair.
    let places: Vec<i32> = kept.iter().map(|n| n.trim_end_matches(".png").parse().expect("number")).collect();
    assert!(places.windows(2).all(|p| p[1] - p[0] <= 2), "{places:?}");
}

#[test]
fn the_store_is_a_data_set() {
    let dir = tempfile::tempdir().expect("tempdir");
    let mut store = open(&Disk::default(), dir.path());
    for i in 0..9 {
        store.add(&frame(&format!("{i}.png"), f64::from(i))).expect("add");
    }
    let again = open(&Disk::default(), dir.path());
    assert_eq!(again.len(), 9);
    let loaded = again.load(3).expect("load");
    assert_eq!((loaded.name.as_str(), loaded.view.pose.center.x, loaded.time_ns), ("3.png", 3.0, 7));
    let set = survey::dataset::Dataset::open(dir.path()).expect("a data set");
    assert_eq!(set.frames.len(), 9);
    assert!((set.frames[3].view.pose.center - loaded.view.pose.center).length() < 1e-9);
    assert_eq!(set.origin, Some(ORIGIN));
}

#[test]
fn the_cameras_own_file_is_kept_and_read_again_as_it_is_trained_on() {
    let dir = tempfile::tempdir().expect("tempdir");
    let photo = image::RgbImage::from_fn(64, 48, |x, y| image::Rgb([(4 * x) as u8, (5 * y) as u8, (x * y) as u8]));
    let own = dir.path().join("DSC_7.JPG");
    photo.save_with_format(&own, image::ImageFormat::Jpeg).expect("jpeg");
    let camera = CameraSettings {
        width: 64,
        height: 48,
        fx: 50.0,
        fy: 50.0,
        cx: 32.0,
        cy: 24.0,
        distortion: [-0.1, 0.01, 0.0, 0.0],
        ..CAMERA
    };
    let lens = Intrinsics { width: 32, height: 24, fx: 25.0, fy: 25.0, cx: 16.0, cy: 12.0 };
    let file = Picture::Path(own.clone());
    let posed = PosedImage {
        name: file.file_name(3),
        image: picture::resized(file.load(&camera).expect("decodes"), (32, 24)),
        view: View { intrinsics: lens, pose: frame("a.png", 0.0).posed.view.pose },
        ..frame("a.png", 0.0).posed
    };
    let out = dir.path().join("keyframes");
    let mut store = KeyframeStore::open(&Disk::default(), &out, &camera, &lens, ORIGIN).expect("opens");
    store.add(&KeyFrame { posed: posed.clone(), file }).expect("kept");
    let bytes = |path: &Path| std::fs::read(path).expect("a file");
    assert_eq!(bytes(&out.join("images/DSC_7.JPG")), bytes(&own));
    let again = store.load(0).expect("loads");
    assert_eq!((again.name.as_str(), again.view, again.image), ("DSC_7.JPG", posed.view, posed.image));
    // Other programs learn of the camera with its distortion.
    let set = survey::dataset::Dataset::open(&out).expect("a data set");
    assert_eq!((set.frames[0].view.intrinsics.width, set.frames[0].view.intrinsics.fx), (64, 50.0));
    // A file that vanished before it was kept costs only itself.
    std::fs::remove_file(&own).expect("gone");
    let gone =
        KeyFrame { posed: PosedImage { name: "b.JPG".into(), ..frame("b.png", 9.0).posed }, file: Picture::Path(own) };
    assert!(matches!(store.add(&gone), Err(StoreError::Camera(_))));
    assert_eq!(store.len(), 1);
}
