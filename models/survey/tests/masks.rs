//! Masks: found where people leave them, brought into the picture that is learnt from, and obeyed by what learns.

#![allow(clippy::unwrap_used)] // a test may

use std::path::Path;

use image::{GrayImage, Luma, Rgb, RgbImage};
use serde_json::json;
use survey::card::CardOptions;
use survey::dataset::Dataset;

const SIZE: (u32, u32) = (80, 60);

fn save(path: &Path, image: &GrayImage) {
    std::fs::create_dir_all(path.parent().unwrap()).unwrap();
    image.save(path).unwrap();
}

/// Black on the left third of a picture.
fn left((w, h): (u32, u32)) -> GrayImage {
    GrayImage::from_fn(w, h, |x, _| Luma([if x < w / 3 { 0 } else { 255 }]))
}

/// Four pictures in `root/images` with a transforms.json; `more` is added to the lens.
fn survey(root: &Path, more: &serde_json::Value) {
    std::fs::create_dir_all(root.join("images")).unwrap();
    let mut frames = Vec::new();
    for i in 0..4u8 {
        let name = format!("images/DJI_{i:04}.jpg");
        RgbImage::from_fn(SIZE.0, SIZE.1, |x, y| Rgb([x as u8, y as u8, i])).save(root.join(&name)).unwrap();
        let matrix = [[1, 0, 0, i32::from(i)], [0, 1, 0, 0], [0, 0, 1, 40], [0, 0, 0, 1]];
        frames.push(json!({ "file_path": name, "transform_matrix": matrix }));
    }
    let mut file = json!({ "frames": frames, "w": SIZE.0, "h": SIZE.1, "fl_x": 70.0, "cx": 40.0, "cy": 30.0 });
    for (key, value) in more.as_object().unwrap() {
        file[key] = value.clone();
    }
    std::fs::write(root.join("transforms.json"), file.to_string()).unwrap();
}

#[test]
fn a_mask_is_found_by_opendronemaps_colmaps_and_nerfstudios_names() {
    for place in [
        "images/DJI_0001_mask.png",
        "images/DJI_0001_MASK.JPG",
        "images/masks/DJI_0001_mask.png",
        "images/masks/DJI_0001.png",
        "masks/DJI_0001.jpg.png",
        "masks/DJI_0001.jpg",
        "masks/images/DJI_0001.jpg.png",
    ] {
        let dir = tempfile::tempdir().unwrap();
        survey(dir.path(), &json!({}));
        save(&dir.path().join(place), &left(SIZE));
        let set = Dataset::open(dir.path()).unwrap();
        let with: Vec<bool> = set.frames.iter().map(|f| f.mask.is_some()).collect();
        assert_eq!(with, [false, true, false, false], "{place}");
        let (masked, plain) = (set.load(1, 0.5).unwrap(), set.load(0, 0.5).unwrap());
        let mask = masked.mask.unwrap();
        assert_eq!((mask.dimensions(), plain.mask), ((40, 30), None));
        assert!(!mask.keeps(12, 20) && mask.keeps(13, 20), "{place}");
    }
    let dir = tempfile::tempdir().unwrap();
    survey(dir.path(), &json!({}));
    save(&dir.path().join("elsewhere/m.png"), &left(SIZE));
    let file = dir.path().join("transforms.json");
    let mut text: serde_json::Value = serde_json::from_slice(&std::fs::read(&file).unwrap()).unwrap();
    text["frames"][2]["mask_path"] = "elsewhere/m.png".into();
    std::fs::write(&file, text.to_string()).unwrap();
    let set = Dataset::open(dir.path()).unwrap();
    assert!(set.load(2, 1.0).unwrap().mask.is_some() && set.load(1, 1.0).unwrap().mask.is_none());
    // What is settled is written down with its mask.
    assert!(set.reconstruction().shots[2].mask.as_ref().unwrap().ends_with("elsewhere/m.png"));
}

#[test]
fn a_mask_of_another_size_is_scaled_and_one_of_another_shape_is_refused_in_one_line() {
    for (size, fits) in [((160, 120), true), ((40, 30), true), ((60, 80), false), ((80, 58), false)] {
        let dir = tempfile::tempdir().unwrap();
        survey(dir.path(), &json!({}));
        save(&dir.path().join("masks/DJI_0003.png"), &left(size));
        match Dataset::open(dir.path()) {
            Ok(set) => {
                let mask = set.load(3, 1.0).unwrap().mask.unwrap();
                assert!(fits && mask.dimensions() == SIZE && !mask.keeps(24, 9) && mask.keeps(28, 9), "{size:?}");
            }
            Err(e) => {
                let e = e.to_string();
                assert!(!fits && e.contains("DJI_0003.png") && e.contains("shape") && !e.contains('\n'), "{e}");
            }
        }
    }
    let dir = tempfile::tempdir().unwrap();
    survey(dir.path(), &json!({}));
    std::fs::create_dir(dir.path().join("masks")).unwrap();
    std::fs::write(dir.path().join("masks/DJI_0003.png"), "no picture").unwrap();
    let e = Dataset::open(dir.path()).unwrap_err().to_string();
    assert!(e.contains("DJI_0003.png") && e.contains("mask") && !e.contains('\n'), "{e}");
}

#[test]
fn a_picture_whose_mask_is_black_all_over_is_not_used_and_the_lists_go_on_with_the_rest() {
    let dir = tempfile::tempdir().unwrap();
    survey(dir.path(), &json!({}));
    let split = json!({ "train": ["DJI_0000.jpg", "DJI_0002.jpg", "DJI_0003.jpg"], "test": ["DJI_0001.jpg"] });
    std::fs::write(dir.path().join("split.json"), split.to_string()).unwrap();
    save(&dir.path().join("masks/DJI_0002.png"), &GrayImage::new(SIZE.0, SIZE.1));
    let set = Dataset::open(dir.path()).unwrap();
    let names = |list: &str| -> Vec<&str> {
        set.select(list, None).unwrap().iter().map(|i| set.frames[*i].name.as_str()).collect()
    };
    assert_eq!(names("train"), ["DJI_0000.jpg", "DJI_0003.jpg"]);
    assert_eq!(names("test"), ["DJI_0001.jpg"]);
    for i in [0, 1, 3] {
        save(&dir.path().join(format!("masks/DJI_000{i}.png")), &GrayImage::new(SIZE.0, SIZE.1));
    }
    let e = Dataset::open(dir.path()).unwrap_err().to_string();
    assert!(e.contains("mask is black"), "{e}");
}

#[test]
fn a_mask_is_undistorted_with_its_picture() {
    let dir = tempfile::tempdir().unwrap();
    survey(dir.path(), &json!({ "k1": -0.15, "p1": 0.01, "camera_model": "OPENCV" }));
    // A picture that is its own mask: dark where nothing is to be learnt.
    let disc = |x: u32, y: u32| (f64::from(x) - 62.0).hypot(f64::from(y) - 14.0) > 9.0;
    let dark = RgbImage::from_fn(SIZE.0, SIZE.1, |x, y| Rgb([if disc(x, y) { 250 } else { 5 }; 3]));
    dark.save(dir.path().join("images/DJI_0000.png")).unwrap();
    std::fs::rename(dir.path().join("images/DJI_0000.png"), dir.path().join("images/DJI_0000.jpg")).unwrap();
    save(
        &dir.path().join("masks/DJI_0000.png"),
        &GrayImage::from_fn(SIZE.0, SIZE.1, |x, y| Luma([u8::from(disc(x, y))])),
    );
    let picture = Dataset::open(dir.path()).unwrap().load(0, 1.0).unwrap();
    let mask = picture.mask.unwrap();
    let differ = picture.image.enumerate_pixels().filter(|(x, y, p)| mask.keeps(*x, *y) != (p.0[0] > 127)).count();
    assert!(mask.count() < 80 * 60 - 200 && differ < 60, "{differ} pixels at the edge of the disc");
    // It moved: the same pixels of the stored mask say otherwise.
    let moved = (0..60).flat_map(|y| (0..80).map(move |x| (x, y))).filter(|(x, y)| mask.keeps(*x, *y) != disc(*x, *y));
    assert!(moved.count() > 2 * differ);
}

#[test]
fn masks_beside_a_cards_pictures_are_masks_and_turned_with_them() {
    let dir = tempfile::tempdir().unwrap();
    let folder = dir.path().join("DCIM/100MEDIA");
    std::fs::create_dir_all(&folder).unwrap();
    let mut tags = "EPSG:4326\n".to_owned();
    for i in 0..3u8 {
        let name = format!("DJI_{i:04}.jpg");
        RgbImage::from_pixel(SIZE.0, SIZE.1, Rgb([i; 3])).save(folder.join(&name)).unwrap();
        tags += &format!("{name} 7.000{i} 46.0 500\n");
    }
    std::fs::write(folder.join("geo.txt"), tags).unwrap();
    left(SIZE).save(folder.join("DJI_0001_mask.png")).unwrap();
    // No picture is called that: it is one itself.
    RgbImage::from_pixel(SIZE.0, SIZE.1, Rgb([9; 3])).save(folder.join("old_mask.jpg")).unwrap();
    let mut set = Dataset::open_card(&[dir.path().to_owned()], &CardOptions::default()).unwrap();
    let names: Vec<&str> = set.frames.iter().map(|f| f.name.as_str()).collect();
    assert_eq!(names, ["DJI_0000.jpg", "DJI_0001.jpg", "DJI_0002.jpg", "old_mask.jpg"]);
    // As EXIF's tag 6 has it, the left of the stored picture comes to lie at the top.
    set.frames[1].orientation = models::picture::Orientation::from_exif(6);
    let lens = &mut set.frames[1].view.intrinsics;
    *lens = lens.resized(60, 80);
    let mask = set.load(1, 1.0).unwrap().mask.unwrap();
    assert_eq!(mask.dimensions(), (60, 80));
    assert!(!mask.keeps(50, 25) && mask.keeps(50, 28) && mask.keeps(2, 60));
}
