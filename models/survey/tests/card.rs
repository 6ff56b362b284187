//! Promises of a card: what pictures say of themselves becomes priors, and what is wrong with them becomes one line.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic)] // a test may

use std::path::Path;

use geometry::geodesy::{EnuFrame, Geodetic};
use glam::DVec3;
use image::{Rgb, RgbImage};
use models::formats::reconstruction::Focal;
use survey::card::write::{DJI, PIX4D, Tags};
use survey::card::{
    AttitudeSource, Card, CardError, CardOptions, CardPicture, Exposure, Fix, FlightLog, Series, Source,
};
use survey::dataset::{Dataset, PoseSource};

use needs::shared;

const HOME: Geodetic = Geodetic { lat_deg: 46.8426, lon_deg: -91.9945, alt_m: 158.5 };
const START_NS: u64 = 1_466_699_519_000_000_000;

fn jpeg(w: u32, h: u32, shade: u8) -> Vec<u8> {
    let image = RgbImage::from_fn(w, h, |x, y| Rgb([(x * 255 / w) as u8, (y * 255 / h) as u8, shade]));
    let mut bytes = std::io::Cursor::new(Vec::new());
    image.write_to(&mut bytes, image::ImageFormat::Jpeg).unwrap();
    bytes.into_inner()
}

fn save(path: &Path, size: (u32, u32), shade: u8, tags: &Tags) {
    std::fs::create_dir_all(path.parent().unwrap()).unwrap();
    std::fs::write(path, tags.into_jpeg(&jpeg(size.0, size.1, shade)).unwrap()).unwrap();
}

/// Picture `i` of a line to the east, 10 m and 2 s apart, 40 m above the take-off.
fn tags(i: u32) -> Tags {
    let at = EnuFrame::new(HOME).to_geodetic(DVec3::new(10.0 * f64::from(i), 0.0, 40.0));
    Tags {
        camera: Some(("DJI".into(), "FC300S".into())),
        time_ns: Some(START_NS + u64::from(i) * 2_000_000_000),
        position: Some(at),
        focal_35mm: Some(20),
        ..Tags::default()
    }
}

fn survey(folder: &Path, n: u32, of: impl Fn(u32) -> Tags) {
    for i in 0..n {
        save(&folder.join(format!("DCIM/100MEDIA/DJI_{i:04}.JPG")), (48, 36), i as u8, &of(i));
    }
}

fn open(folder: &Path) -> Card {
    Card::open(&[folder.to_owned()], &CardOptions::default()).unwrap()
}

fn picture<'c>(card: &'c Card, name: &str) -> &'c CardPicture {
    card.pictures
        .iter()
        .find(|p| p.name.ends_with(name))
        .unwrap_or_else(|| panic!("{name} is not used: {:?}", card.notes))
}

#[track_caller]
fn assert_note(card: &Card, parts: &[&str]) {
    let found = card.notes.iter().filter(|n| parts.iter().all(|p| n.contains(p))).count();
    assert_eq!(found, 1, "{parts:?} in {:#?}", card.notes);
    assert!(card.notes.iter().all(|n| !n.contains('\n')));
}

#[test]
fn exif_and_dji_xmp_become_a_pose_above_the_take_off_with_its_covariance() {
    let dir = tempfile::tempdir().unwrap();
    survey(dir.path(), 5, |i| Tags { dop: Some(1.2), ..tags(i) }.with_dji([90.0, -75.0, 0.0], 40.0));
    let card = open(dir.path());
    assert_eq!((card.pictures.len(), card.found, card.notes.len()), (5, 5, 0), "{:?}", card.notes);
    assert!((card.origin.unwrap().alt_m - HOME.alt_m).abs() < 0.01, "{:?}", card.origin);
    let p = &card.pictures[2];
    assert!((p.prior.pose.center - DVec3::new(0.0, 0.0, 40.0)).length() < 0.02, "{}", p.prior.pose.center);
    let forward = p.prior.pose.forward();
    assert!(
        (forward - DVec3::new(15f64.to_radians().sin(), 0.0, -15f64.to_radians().cos())).length() < 1e-6,
        "{forward}"
    );
    assert!((p.prior.sigma.position_m[0] - 1.8).abs() < 1e-6, "1.5 m × DOP");
    assert_eq!(p.prior.time_ns, START_NS + 4_000_000_000);
    // 20 mm on film: of the diagonal of a 4:3 picture of 48 × 36.
    assert!(matches!(p.lens.focal, Focal::Pixels(f, _) if (f - 20.0 / 43.2666 * 60.0).abs() < 1e-3));
    assert_eq!(p.focal_sigma, 0.1);
}

#[test]
fn rtk_accuracies_and_a_makers_calibration_are_believed_as_stated() {
    let dir = tempfile::tempdir().unwrap();
    let dji = |name: &str, value: &str| (DJI.to_owned(), name.to_owned(), value.to_owned());
    survey(dir.path(), 3, |i| {
        let mut tags = tags(i).with_dji([0.0, -90.0, 0.0], 40.0);
        tags.xmp.push(dji("RtkFlag", "50"));
        tags.xmp.push(dji("DewarpData", "2018-09-04;36.5,36.4,0.75,-0.5,-0.27,0.11,0.0004,-0.0003,-0.02"));
        if i == 1 {
            tags.xmp.extend([dji("RtkStdLat", "0.011"), dji("RtkStdLon", "0.012"), dji("RtkStdHgt", "0.024")]);
            tags.xmp.push(dji("DewarpFlag", "1"));
        }
        tags
    });
    let card = open(dir.path());
    let [a, b] = [&card.pictures[0], &card.pictures[1]];
    assert_eq!((a.prior.sigma.position_m, b.prior.sigma.position_m), ([0.03, 0.03, 0.06], [0.012, 0.012, 0.024]));
    assert_eq!(
        (a.lens.focal, a.lens.principal, a.focal_sigma),
        (Focal::Pixels(36.5, 36.4), Some((24.75, 17.5)), 0.005)
    );
    assert_eq!((a.lens.distortion.k1, a.lens.distortion.p2, a.lens.distortion.k3), (-0.27, -0.0003, -0.02));
    assert!(b.lens.distortion.is_none() && b.lens.principal == Some((24.0, 18.0)), "undistorted by the camera");
}

#[test]
fn pix4ds_angles_count_from_nadir_and_senseflys_roll_the_other_way() {
    let dir = tempfile::tempdir().unwrap();
    let camera = |name: &str, value: &str| (PIX4D.to_owned(), name.to_owned(), value.to_owned());
    let angles =
        |p: &str| vec![camera("Yaw", "90"), camera("Pitch", p), camera("Roll", "10"), camera("GPSXYAccuracy", "0.5")];
    survey(dir.path(), 3, |i| Tags {
        camera: Some((["senseFly", "Parrot", "Autel Robotics"][i as usize].into(), "x".into())),
        xmp: angles(["0", "0", "-80"][i as usize]),
        ..tags(i)
    });
    let card = open(dir.path());
    let looks = |i: usize| card.pictures[i].prior.pose.forward();
    // Flying east with the right wing down the camera looks north (left); senseFly's sign is the other one.
    assert!(looks(1).y > 0.17 && looks(0).y < -0.17, "{} {}", looks(0), looks(1));
    assert!(looks(2).x > 0.15, "Autel counts from the horizon: {}", looks(2));
    assert_eq!(card.pictures[0].prior.sigma.position_m[0], 0.5);
}

#[test]
fn without_an_attitude_the_camera_looks_down_along_the_course_and_is_little_believed() {
    let dir = tempfile::tempdir().unwrap();
    survey(dir.path(), 6, tags);
    let card = open(dir.path());
    for p in &card.pictures {
        let top = p.prior.pose.rotation * -DVec3::Y;
        assert!((top - DVec3::X).length() < 0.01, "{}: the top of the picture is {top}", p.name);
        assert!((p.prior.pose.forward() + DVec3::Z).length() < 1e-6);
        let [x, y, z] = p.prior.sigma.rotation_rad.map(|s| s.to_degrees());
        assert!((x - 10.0).abs() < 0.1 && (y - 10.0).abs() < 0.1 && (z - 30.0).abs() < 0.1, "{x} {y} {z}");
    }
    assert_note(&card, &["6 pictures", "no attitude"]);
    assert!(card.origin.unwrap().alt_m < HOME.alt_m + 0.1, "a typical height above unknown ground: {:?}", card.origin);
}

#[test]
fn what_is_wrong_with_a_file_is_one_line_and_the_rest_is_used() {
    let dir = tempfile::tempdir().unwrap();
    let dcim = dir.path().join("DCIM/100MEDIA");
    survey(dir.path(), 9, |i| tags(i).with_dji([90.0, -90.0, 0.0], 40.0));
    std::fs::write(dcim.join("notes.jpg"), "these are notes about the flight, not a picture").unwrap();
    std::fs::write(dcim.join("empty.JPG"), "").unwrap();
    let whole = std::fs::read(dcim.join("DJI_0003.JPG")).unwrap();
    std::fs::write(dcim.join("DJI_0003.JPG"), &whole[..whole.len() - 200]).unwrap();
    std::fs::copy(dcim.join("DJI_0004.JPG"), dcim.join("DJI_0004 (1).JPG")).unwrap();
    let nowhere = Tags { position: Some(Geodetic { lat_deg: 0.0, lon_deg: 0.0, alt_m: 0.0 }), ..tags(5) };
    save(&dcim.join("DJI_0005.JPG"), (48, 36), 5, &nowhere.with_dji([90.0, -90.0, 0.0], 40.0));
    // Another camera, and one that was held upright.
    save(&dcim.join("DJI_0006.JPG"), (96, 54), 6, &tags(6).with_dji([90.0, -90.0, 0.0], 40.0));
    let upright = Tags { orientation: Some(6), ..tags(7) };
    save(&dcim.join("DJI_0007.JPG"), (48, 36), 7, &upright.with_dji([90.0, -90.0, 0.0], 40.0));
    let card = open(dir.path());
    let names: Vec<&str> = card.pictures.iter().map(|p| p.name.as_str()).collect();
    assert_eq!((names.len(), card.found), (8, 12), "{names:?}");
    assert_note(&card, &["notes.jpg", "no JPEG, PNG, TIFF or WebP"]);
    assert_note(&card, &["empty.JPG", "is empty"]);
    assert_note(&card, &["DJI_0003.JPG", "cut off"]);
    assert_note(&card, &["the same file as another one"]);
    assert_note(&card, &["DJI_0005.JPG", "no GPS position (or 0, 0)"]);
    let beside = (picture(&card, "0004.JPG").prior.pose.center + picture(&card, "0006.JPG").prior.pose.center) * 0.5;
    let filled = picture(&card, "0005.JPG").prior;
    assert!(filled.pose.center.distance(beside) < 0.1 && filled.sigma.position_m[0] >= 3.0, "{filled:?}");
    assert_eq!(picture(&card, "0006.JPG").lens.size, Some((96, 54)));
    let upright = picture(&card, "0007.JPG");
    assert_eq!(upright.lens.size, Some((36, 48)));
    // The sensor's top looks east; the picture's, a quarter turn clockwise of it, does not.
    let top = upright.prior.pose.rotation * -DVec3::Y;
    assert!((top - DVec3::Y).length() < 1e-6, "{top}");
    let set = Dataset::open(dir.path()).unwrap();
    for i in 0..set.frames.len() {
        let loaded = set.load_posed(i, 0.5, PoseSource::Telemetry).unwrap();
        assert_eq!(loaded.image.dimensions(), (loaded.view.intrinsics.width, loaded.view.intrinsics.height));
    }
}

#[test]
fn a_folder_of_ten_thousand_names_makes_one_line() {
    let dir = tempfile::tempdir().unwrap();
    survey(dir.path(), 3, |i| tags(i).with_dji([90.0, -90.0, 0.0], 40.0));
    for i in 0..10_000 {
        std::fs::write(dir.path().join(format!("x{i:05}.jpg")), "no picture").unwrap();
    }
    let card = open(dir.path());
    assert_eq!((card.pictures.len(), card.found, card.notes.len()), (3, 10_003, 1));
    assert!(card.notes[0].len() < 400 && card.notes[0].contains("10000 pictures"), "{}", card.notes[0]);
}

#[test]
fn heights_that_contradict_each_other_are_named_corrected_and_weigh_less() {
    let dir = tempfile::tempdir().unwrap();
    survey(dir.path(), 12, |i| {
        let mut tags = tags(i).with_dji([90.0, -90.0, 0.0], 40.0);
        if i == 4 {
            tags.position.as_mut().unwrap().alt_m += 100.0;
        }
        tags
    });
    let card = open(dir.path());
    assert_note(&card, &["DJI_0004.JPG", "height", "100 m"]);
    let wrong = picture(&card, "0004.JPG").prior;
    assert!((wrong.pose.center.z - 40.0).abs() < 0.1 && wrong.sigma.position_m[2] >= 3.0, "{wrong:?}");
    // Without heights above take-off the neighbours alone tell.
    let dir = tempfile::tempdir().unwrap();
    survey(dir.path(), 12, |i| {
        let mut tags = tags(i);
        if i == 7 {
            tags.position.as_mut().unwrap().alt_m -= 100.0;
        }
        tags
    });
    let card = open(dir.path());
    assert_note(&card, &["DJI_0007.JPG", "height is 100 m off"]);
    let z = |name| picture(&card, name).prior.pose.center.z;
    assert!((z("0007.JPG") - z("0008.JPG")).abs() < 0.1);
}

#[test]
fn a_position_that_nobody_can_have_flown_to_is_taken_from_its_neighbours() {
    let dir = tempfile::tempdir().unwrap();
    survey(dir.path(), 12, |i| {
        let mut tags = tags(i).with_dji([90.0, -90.0, 0.0], 40.0);
        if i == 6 {
            tags.position.as_mut().unwrap().lat_deg += 0.05;
        }
        tags
    });
    let card = open(dir.path());
    assert_note(&card, &["DJI_0006.JPG", "from its neighbours'"]);
    let wrong = picture(&card, "0006.JPG").prior;
    let between = picture(&card, "0005.JPG").prior.pose.center.lerp(picture(&card, "0007.JPG").prior.pose.center, 0.5);
    assert!(wrong.pose.center.distance(between) < 15.0 && wrong.sigma.position_m[0] > 50.0, "{wrong:?} {between}");
}

#[test]
fn a_step_in_height_between_two_flights_is_taken_out_and_said() {
    let dir = tempfile::tempdir().unwrap();
    survey(dir.path(), 20, |i| {
        let mut tags = tags(i).with_dji([90.0, -90.0, 0.0], 40.0);
        if i >= 12 {
            tags.time_ns = tags.time_ns.map(|t| t + 900_000_000_000);
            tags.position.as_mut().unwrap().alt_m += 12.0;
        }
        tags
    });
    let card = open(dir.path());
    assert_note(&card, &["8 pictures", "+12 m", "same take-off"]);
    for p in &card.pictures {
        assert!((p.prior.pose.center.z - 40.0).abs() < 0.1, "{}: {}", p.name, p.prior.pose.center.z);
    }
    assert!(picture(&card, "0015.JPG").prior.sigma.position_m[2] >= 12.0);
}

#[test]
fn a_card_without_a_picture_is_refused_and_one_without_positions_floats_and_says_so_in_one_line() {
    let dir = tempfile::tempdir().unwrap();
    let open = || Card::open(&[dir.path().to_owned()], &CardOptions::default());
    assert!(matches!(open(), Err(CardError::NoPictures { .. })));
    survey(dir.path(), 3, |i| Tags { position: None, ..tags(i) });
    let card = open().unwrap();
    assert_eq!((card.pictures.len(), card.origin), (3, None));
    assert!(card.pictures.iter().all(|p| p.prior.sigma.position_m == [f32::INFINITY; 3]));
    assert_note(&card, &["none of 3 pictures", "no scale", "--geotags"]);
    let missing = Card::open(&[dir.path().join("nowhere")], &CardOptions::default()).unwrap_err();
    assert!(matches!(missing, CardError::Folder { .. }) && missing.to_string().contains("nowhere"), "{missing}");
}

#[test]
fn geotags_and_a_flight_log_give_positions_to_a_dumb_camera() {
    let dir = tempfile::tempdir().unwrap();
    survey(dir.path(), 8, |i| Tags { position: None, ..tags(i) });
    let frame = EnuFrame::new(HOME);
    let at = |i: u32| frame.to_geodetic(DVec3::new(10.0 * f64::from(i), 3.0, 40.0));
    let log: Vec<Exposure> = (0..8)
        .map(|i| {
            // The line turns after the fifth: uneven spacing fixes the offset of the clocks.
            let time_s = 512.3 + 2.0 * f64::from(i);
            Exposure { time_s, fix: Fix { position: at(i), sigma_m: [1.5, 2.0] }, attitude: None }
        })
        .collect();
    let series = vec![Series { exposures: log, ..Series::default() }];
    let options = CardOptions { log: Some(FlightLog { series, ..FlightLog::default() }), ..CardOptions::default() };
    let card = Card::open(&[dir.path().to_owned()], &options).unwrap();
    assert_note(&card, &["flight log", "8 of 8 pictures matched to 8 exposures"]);
    let second = picture(&card, "0001.JPG").prior;
    assert!((EnuFrame::new(card.origin.unwrap()).to_enu(at(1)) - second.pose.center).length() < 1e-6);
    let text: String = std::iter::once("EPSG:4326\n".to_owned())
        .chain((0..7).map(|i| format!("DJI_{i:04}.JPG {:.9} {:.9} {:.3}\n", at(i).lon_deg, at(i).lat_deg, at(i).alt_m)))
        .collect();
    std::fs::write(dir.path().join("geo.txt"), text).unwrap();
    let card = open(dir.path());
    assert_note(&card, &["geo.txt", "7 of 8 pictures"]);
    assert_note(&card, &["DJI_0007.JPG", "no GPS"]);
}

#[test]
fn masks_beside_the_pictures_are_no_pictures() {
    let dir = tempfile::tempdir().unwrap();
    survey(dir.path(), 3, tags);
    let masks = dir.path().join("DCIM/100MEDIA/masks");
    std::fs::create_dir(&masks).unwrap();
    image::GrayImage::new(48, 36).save(masks.join("DJI_0001.png")).unwrap();
    let card = open(dir.path());
    assert_eq!(card.pictures.len(), 3);
}

/// It may lead to the whole disk, and its pictures are not this card's.
#[test]
fn a_card_with_links_to_folders_is_read_without_them_and_they_are_named() {
    let (card, elsewhere) = (tempfile::tempdir().unwrap(), tempfile::tempdir().unwrap());
    survey(card.path(), 3, tags);
    survey(elsewhere.path(), 4, tags);
    let link = |to: &Path, name: &str| std::os::unix::fs::symlink(to, card.path().join(name)).unwrap();
    link(Path::new("/"), "DCIM/100MEDIA/disk");
    link(elsewhere.path(), "DCIM/elsewhere");
    link(card.path(), "back");
    let read = open(card.path());
    assert_eq!((read.pictures.len(), read.found), (3, 3));
    assert_note(&read, &["a link to a folder", "not followed", "nor are 2 more"]);
    // Where nothing else is there, too.
    let only = tempfile::tempdir().unwrap();
    std::os::unix::fs::symlink(elsewhere.path(), only.path().join("DCIM")).unwrap();
    let refused = Card::open(&[only.path().to_owned()], &CardOptions::default()).unwrap_err().to_string();
    assert!(refused.contains("DCIM: a link to a folder") && !refused.contains('\n'), "{refused}");
    assert_eq!(Dataset::open(only.path()).unwrap_err().to_string(), refused);
    // By its name, and pictures by theirs, links are followed.
    assert_eq!(open(&only.path().join("DCIM")).pictures.len(), 4);
    std::os::unix::fs::symlink(elsewhere.path().join("DCIM/100MEDIA/DJI_0003.JPG"), card.path().join("own.jpg"))
        .unwrap();
    assert_eq!(open(card.path()).pictures.len(), 4);
    let twice = Card::open(&[card.path().to_owned(), card.path().join("DCIM")], &CardOptions::default()).unwrap();
    assert_eq!(twice.pictures.len(), 4);
}

#[test]
fn tiff_and_png_are_read_like_jpeg() {
    let dir = tempfile::tempdir().unwrap();
    for (i, extension) in ["tif", "png"].iter().enumerate() {
        let image = RgbImage::from_pixel(48, 36, Rgb([i as u8, 9, 9]));
        image.save(dir.path().join(format!("a{i}.{extension}"))).unwrap();
    }
    let lines = "picture,lat_deg,lon_deg,alt_m\na0.tif,46.8426,-91.9945,198\na1.png,46.8427,-91.9945,198\n";
    std::fs::write(dir.path().join("geotags.csv"), lines).unwrap();
    let set = Dataset::open(dir.path()).unwrap();
    assert_eq!(set.frames.len(), 2);
    for i in 0..2 {
        assert_eq!(set.load_posed(i, 1.0, PoseSource::Telemetry).unwrap().image.dimensions(), (48, 36));
    }
}

#[test]
fn a_real_card_has_its_eighteen_pictures_forty_metres_above_the_take_off() {
    let Some(root) = shared("data/brighton_beach_card") else { return };
    let card = open(&root);
    assert_eq!((card.pictures.len(), card.notes.len()), (18, 0), "{:?}", card.notes);
    for p in &card.pictures {
        assert!((p.prior.pose.center.z - 40.0).abs() < 1.0, "{}: {}", p.name, p.prior.pose.center);
        assert!(p.prior.pose.forward().z < -0.99);
        // The reference's focal length is 951 pixels at a width of 1600.
        assert!(matches!(p.lens.focal, Focal::Pixels(f, _) if (f / (951.0 * 2.5) - 1.0).abs() < 0.05), "{:?}", p.lens);
    }
    let turned = card.pictures.iter().filter(|p| (p.prior.pose.rotation * -DVec3::Y).x < 0.0).count();
    assert_eq!(turned, 6, "the line flown back");
}

#[test]
fn phantoms_maker_notes_have_the_gimbals_angles() {
    let Some(root) = shared("data/sheffield_cross") else { return };
    let card = open(&root.join("images"));
    assert_eq!(card.pictures.len(), 86);
    let tilted = card.pictures.iter().filter(|p| (-0.98..-0.95).contains(&p.prior.pose.forward().z)).count();
    println!("{tilted} of 86 tilted by 15 degrees; {:?}", card.notes);
    assert_eq!(tilted, 86);
}

#[test]
fn attitudes_are_worth_what_they_come_from() {
    assert!(AttitudeSource::Gimbal < AttitudeSource::Airframe && AttitudeSource::Heading < AttitudeSource::Course);
}

/// Pictures of a camera without GPS and of whole seconds, `steps` apart.
fn dumb_camera(steps: &[f64]) -> tempfile::TempDir {
    let dir = tempfile::tempdir().unwrap();
    survey(dir.path(), steps.len() as u32, |i| {
        let s: f64 = steps[..=i as usize].iter().sum();
        Tags { position: None, time_ns: Some(START_NS + s as u64 * 1_000_000_000), ..tags(i) }
    });
    dir
}

/// The exposures of `steps`, `late_s` on another clock, `east_m` beside the card's line.
fn flown(source: Source, steps: &[f64], late_s: f64, east_m: f64) -> Series {
    let frame = EnuFrame::new(HOME);
    let mut time_s = 512.3 + late_s;
    let exposures = steps.iter().enumerate().map(|(i, step)| {
        time_s += step;
        let position = frame.to_geodetic(DVec3::new(10.0 * i as f64 + east_m, 3.0, 40.0));
        Exposure { time_s, fix: Fix { position, sigma_m: [1.5, 2.0] }, attitude: None }
    });
    Series { source, exposures: exposures.collect() }
}

fn of(system: u8, camera: u8) -> Source {
    Source { system: Some(system), component: Some(1), camera: Some(camera) }
}

fn matched(card: &Path, series: &[Series], system: Option<u8>, camera: Option<u8>) -> Result<Card, String> {
    let log = FlightLog { path: "fleet.tlog".into(), series: series.to_vec(), system, camera };
    let options = CardOptions { log: Some(log), ..CardOptions::default() };
    Card::open(&[card.to_owned()], &options).map_err(|e| e.to_string())
}

/// Metres between the third picture of a card and where it was taken.
fn off_m(card: &Card) -> f64 {
    let place = EnuFrame::new(card.origin.unwrap()).to_geodetic(picture(card, "0002.JPG").prior.pose.center);
    (EnuFrame::new(HOME).to_enu(place).truncate() - glam::DVec2::new(20.0, 3.0)).length()
}

const UNEVEN: [f64; 14] = [2.0, 3.0, 2.0, 7.0, 2.0, 4.0, 2.0, 2.0, 9.0, 3.0, 2.0, 5.0, 2.0, 3.0];
const OTHER: [f64; 14] = [3.0, 2.0, 8.0, 2.0, 5.0, 2.0, 4.0, 3.0, 2.0, 2.0, 6.0, 2.0, 4.0, 2.0];

#[test]
fn of_a_fleets_log_the_aircraft_whose_rhythm_the_pictures_have_is_taken_and_the_others_named() {
    let dir = dumb_camera(&UNEVEN);
    let fleet = [
        flown(of(1, 0), &OTHER, -8.0, 300.0),
        flown(of(2, 0), &UNEVEN, 4.0, 0.0),
        flown(of(3, 0), &OTHER, 3.0, -300.0),
    ];
    let card = matched(dir.path(), &fleet, None, None).unwrap();
    assert_note(&card, &["flight log: 14 of 14", "system 2", "not system", "system 1", "system 3"]);
    assert!(off_m(&card) < 0.01, "{}", off_m(&card));
}

#[test]
fn aircraft_of_one_rhythm_are_refused_with_the_candidates_until_one_is_named() {
    let dir = dumb_camera(&UNEVEN);
    let fleet = [flown(of(1, 0), &UNEVEN, -3.0, 300.0), flown(of(2, 0), &UNEVEN, 4.0, 0.0)];
    let error = matched(dir.path(), &fleet, None, None).unwrap_err();
    assert!(error.contains("fleet.tlog") && error.contains("--system N") && !error.contains('\n'), "{error}");
    assert!(error.contains("system 1") && error.contains("system 2"), "{error}");
    assert!(off_m(&matched(dir.path(), &fleet, Some(2), None).unwrap()) < 0.01);
    let error = matched(dir.path(), &fleet, Some(7), None).unwrap_err();
    assert!(error.contains("it holds system 1") && error.contains("system 2"), "{error}");
}

/// The camera's clock is unknown: how many pictures each flight explains tells.
#[test]
fn of_two_flights_in_one_log_the_pictures_are_those_of_the_one_that_has_all_of_them() {
    let dir = dumb_camera(&UNEVEN);
    let mut both = flown(of(1, 0), &UNEVEN[..9], -1800.0, 1000.0);
    both.exposures.extend(flown(of(1, 0), &UNEVEN, 0.0, 0.0).exposures);
    let card = matched(dir.path(), &[both], None, None).unwrap();
    assert_note(&card, &["14 of 14"]);
    assert!(off_m(&card) < 0.01, "{}", off_m(&card));
}

#[test]
fn places_that_the_pictures_state_tell_aircraft_of_one_rhythm_apart() {
    let dir = tempfile::tempdir().unwrap();
    let frame = EnuFrame::new(HOME);
    survey(dir.path(), 8, |i| Tags {
        position: Some(frame.to_geodetic(DVec3::new(10.0 * f64::from(i) + 2.0, 5.0, 40.0))),
        ..tags(i)
    });
    let steps = [2.0; 8];
    let fleet = [flown(of(1, 0), &steps, 0.0, 300.0), flown(of(2, 0), &steps, 0.0, 0.0)];
    assert!(off_m(&matched(dir.path(), &fleet, None, None).unwrap()) < 0.01);
    let error = matched(dir.path(), &fleet[..1], None, None).unwrap_err();
    assert!(error.contains("give the log of this flight") && !error.contains('\n'), "{error}");
}

#[test]
fn of_two_cameras_of_one_aircraft_the_one_that_the_pictures_fit_is_taken() {
    let dir = dumb_camera(&UNEVEN);
    let interval = flown(of(1, 1), &[0.7; 90], -5.0, 0.0);
    let card = matched(dir.path(), &[interval, flown(of(1, 0), &UNEVEN, 0.0, 0.0)], None, None).unwrap();
    assert_note(&card, &["14 of 14 pictures matched to 14 exposures", "camera 0"]);
    assert!(off_m(&card) < 0.01);
    // Fired together they say the same.
    let pair = [flown(of(1, 0), &UNEVEN, 0.0, 0.0), flown(of(1, 1), &UNEVEN, 0.001, 0.0)];
    assert!(off_m(&matched(dir.path(), &pair, None, None).unwrap()) < 0.01);
    // Apart, nobody can tell.
    let apart = [flown(of(1, 0), &UNEVEN, 0.0, 0.0), flown(of(1, 1), &UNEVEN, 1.0, 5.0)];
    let error = matched(dir.path(), &apart, None, None).unwrap_err();
    assert!(error.contains("--camera N"), "{error}");
    assert!(off_m(&matched(dir.path(), &apart, None, Some(0)).unwrap()) < 0.01);
}

#[test]
fn a_log_none_of_whose_exposures_is_matched_and_a_camera_that_it_does_not_hold_are_refused() {
    let dir = tempfile::tempdir().unwrap();
    survey(dir.path(), 5, |i| Tags { position: None, time_ns: None, ..tags(i) });
    let one = flown(Source { camera: Some(0), ..Source::default() }, &UNEVEN, 0.0, 0.0);
    let error = matched(dir.path(), std::slice::from_ref(&one), None, None).unwrap_err();
    assert!(error.contains("none of its exposures (14)") && !error.contains('\n'), "{error}");
    let dir = dumb_camera(&UNEVEN);
    let error = matched(dir.path(), std::slice::from_ref(&one), None, Some(2)).unwrap_err();
    assert!(error.contains("it holds camera 0 (14)") && !error.contains('\n'), "{error}");
    let card = matched(dir.path(), std::slice::from_ref(&one), None, Some(0)).unwrap();
    assert_note(&card, &["14 of 14 pictures", "; camera 0"]);
}

#[test]
fn where_the_count_may_begin_at_other_exposures_places_are_as_uncertain_as_the_way_to_the_farthest() {
    let even = [2.0; 14];
    let dir = dumb_camera(&even[..6]);
    let card = matched(dir.path(), &[flown(of(1, 0), &even, 0.0, 0.0)], None, None).unwrap();
    assert_note(&card, &["flight log", "other offsets that fit: 8"]);
    // Nine beginnings, 10 m apart.
    for p in &card.pictures {
        assert!(p.prior.sigma.position_m[0] >= 40.0, "{}: {:?}", p.name, p.prior.sigma);
    }
    assert!(card.pictures[0].prior.sigma.position_m[0] <= 81.0);
}
