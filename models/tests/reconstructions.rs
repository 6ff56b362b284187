//! Promises of the readers and writers of reconstructions: every format, in every place that its programs leave it.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic)] // a test may

use std::path::Path;

use geometry::geodesy::Geodetic;
use geometry::lens::Distortion;
use glam::{DQuat, DVec3};
use models::camera::{Intrinsics, Pose};
use models::formats::reconstruction::{CAMERA_MODELS, CameraModel, LensDescription, Reconstruction, Shot};
use models::formats::{colmap, mega_nerf, opensfm, transforms};
use survey::dataset::Dataset;

const ORIGIN: Geodetic = Geodetic { lat_deg: 46.8426, lon_deg: -91.9945, alt_m: 158.5 };

fn survey() -> Reconstruction {
    let lens = |width, height, distortion| {
        let k = Intrinsics { width, height, fx: 951.0, fy: 949.5, cx: 801.25, cy: 447.5 };
        LensDescription::new(&k, distortion)
    };
    let lenses = [
        lens(1600, 900, Distortion { k1: -0.0041, k2: 0.0153, p1: 4e-4, p2: 1e-4, ..Distortion::default() }),
        // A second camera, upright, a fisheye.
        lens(
            900,
            1600,
            Distortion { fisheye: true, k1: -0.03, k2: 6e-3, k3: -4e-3, k4: 7e-4, ..Distortion::default() },
        ),
    ];
    let shots = (0..5).map(|i| {
        let rotation =
            DQuat::from_rotation_z(0.7 * f64::from(i)) * DQuat::from_xyzw(0.99, 0.05, -0.02, 0.1).normalize();
        Shot {
            path: format!("DJI_{i:04}.JPG"),
            lens: lenses[i as usize % 2],
            pose: Pose { rotation, center: DVec3::new(f64::from(i) * 13.6, -3.0, 40.25) },
            mask: (i == 2).then(|| "masks/DJI_0002.JPG.png".to_owned()),
        }
    });
    Reconstruction { shots: shots.collect(), origin: Some(ORIGIN) }
}

fn assert_same(a: &Reconstruction, b: &Reconstruction, tolerance: f64) {
    assert_eq!(a.shots.len(), b.shots.len());
    for (a, b) in a.shots.iter().zip(&b.shots) {
        assert_eq!(a.path, b.path);
        assert!(a.pose.center.distance(b.pose.center) < tolerance, "{}", a.path);
        assert!(a.pose.rotation.dot(b.pose.rotation).abs() > 1.0 - tolerance, "{}", a.path);
        assert_eq!(a.lens.size, b.lens.size);
        let size = a.lens.size.unwrap();
        let (la, lb) = (a.lens.lens(size), b.lens.lens(size));
        for ray in [[0.0, 0.0, 1.0], [0.4, -0.3, 1.0], [-0.6, 0.2, 1.0]] {
            let (pa, pb) = (la.project(ray).unwrap(), lb.project(ray).unwrap());
            assert!((pa[0] - pb[0]).hypot(pa[1] - pb[1]) < 1e-6, "{}: {pa:?} {pb:?}", a.path);
        }
    }
    assert_eq!(a.origin, b.origin);
}

fn colmap_text(folder: &Path) {
    std::fs::create_dir_all(folder).unwrap();
    std::fs::write(
        folder.join("cameras.txt"),
        "# Camera list\n1 OPENCV 1600 900 951 949.5 801.25 447.5 -0.0041 0.0153 0.0004 0.0001\n2 SIMPLE_RADIAL 640 480 400 320 240 0.01\n",
    )
    .unwrap();
    let images = "# Image list\n1 0.5 0.5 0.5 0.5 1 2 3 1 second picture.jpg\n10.5 20.5 7 1.5 2.5 -1\n2 1 0 0 0 0 0 5 2 first.jpg\n\n";
    std::fs::write(folder.join("images.txt"), images).unwrap();
    std::fs::write(
        folder.join("points3D.txt"),
        "# points\n7 1.5 -2.5 0.25 10 20 30 0.5 1 0 2 3 1 4\n8 nan 0 0 1 2 3 0.1\n9 4 5 6 255 0 1 0.25\n",
    )
    .unwrap();
}

#[test]
fn colmaps_text_is_read_with_its_empty_lines_spaces_in_names_and_tracks() {
    let dir = tempfile::tempdir().unwrap();
    colmap_text(&dir.path().join("sparse/0"));
    let set = Dataset::open(dir.path()).unwrap();
    let names: Vec<&str> = set.frames.iter().map(|f| f.name.as_str()).collect();
    assert_eq!(names, ["first.jpg", "second picture.jpg"]);
    assert_eq!(set.frames[0].view.pose.center, DVec3::new(0.0, 0.0, -5.0));
    assert_eq!((set.frames[0].distortion.k1, set.frames[1].distortion.p2), (0.01, 0.0001));
    assert_eq!(set.frames[0].view.intrinsics.width, 640);
    let points = set.sparse_points().unwrap();
    assert_eq!(points.len(), 2, "the one at NaN is left out");
    assert_eq!(
        (points[0].position, points[0].color, points[0].frames.as_slice()),
        ([1.5, -2.5, 0.25], [10, 20, 30], [0, 1].as_slice())
    );
    assert!(points[1].frames.is_empty());
}

#[test]
fn bad_lines_of_colmaps_text_are_named_by_number() {
    let dir = tempfile::tempdir().unwrap();
    let folder = dir.path().join("sparse/0");
    for (file, line, expected) in [
        ("cameras.txt", "1 PINHOLE 640 480 400 400 320\n", "line 1: PINHOLE takes 4 parameters, not 3"),
        ("cameras.txt", "#\n1 FOV 640 480 400 400 320 240 1\n", "line 2: camera model FOV is not supported"),
        ("cameras.txt", "1 PINHOLE 0 480 400 400 320 240\n", "line 1"),
        ("images.txt", "1 0 0 0 0 1 2 3 1 a.jpg\n\n", "no usable pose"),
        ("images.txt", "1 1 0 0 0 1 2 3 9 a.jpg\n\n", "camera 9"),
        ("points3D.txt", "1 2 3\n", "line 1"),
    ] {
        colmap_text(&folder);
        std::fs::write(folder.join(file), line).unwrap();
        let error = Dataset::open(dir.path()).and_then(|d| d.sparse_points()).unwrap_err().to_string();
        assert!(error.contains(file) && error.contains(expected) && !error.contains('\n'), "{file}: {error}");
    }
}

#[test]
fn a_model_is_found_where_colmap_nerfstudio_and_others_leave_it() {
    for place in ["sparse/0", "sparse", "colmap/sparse/0", "colmap/sparse", "."] {
        let dir = tempfile::tempdir().unwrap();
        colmap::write(&dir.path().join(place), &survey(), &[]).unwrap();
        assert_eq!(Dataset::open(dir.path()).unwrap().frames.len(), 5, "{place} binary");
        let dir = tempfile::tempdir().unwrap();
        colmap_text(&dir.path().join(place));
        assert_eq!(Dataset::open(dir.path()).unwrap().frames.len(), 2, "{place} text");
    }
}

#[test]
fn the_largest_of_several_models_is_taken_and_half_of_one_is_no_card() {
    let dir = tempfile::tempdir().unwrap();
    let small = Reconstruction { shots: survey().shots[..2].to_vec(), ..survey() };
    colmap::write(&dir.path().join("sparse/0"), &small, &[]).unwrap();
    colmap::write(&dir.path().join("sparse/1"), &survey(), &[]).unwrap();
    assert_eq!(Dataset::open(dir.path()).unwrap().frames.len(), 5);
    let said = colmap::Model::find(dir.path()).unwrap().unwrap().said().unwrap();
    assert!(said.contains("sparse/1 of 5") && said.contains("sparse/0 of 2") && !said.contains('\n'), "{said}");
    // A broken one is named, whichever it is.
    std::fs::write(dir.path().join("sparse/1/images.bin"), [9; 20]).unwrap();
    let model = colmap::Model::find(dir.path()).unwrap().unwrap();
    assert!(model.file("images").ends_with("sparse/0/images.bin"));
    assert!(model.said().unwrap().contains("sparse/1/images.bin"));
    std::fs::remove_dir_all(dir.path().join("sparse/1")).unwrap();
    std::fs::remove_file(dir.path().join("sparse/0/images.bin")).unwrap();
    image::RgbImage::new(16, 16).save(dir.path().join("a.png")).unwrap();
    let error = Dataset::open(dir.path()).unwrap_err().to_string();
    assert!(error.contains("sparse/0") && error.contains("images") && !error.contains('\n'), "{error}");
}

#[test]
fn images_without_lines_of_keypoints_and_marks_before_the_text_lose_nothing() {
    let dir = tempfile::tempdir().unwrap();
    colmap_text(dir.path());
    let bare = "\u{feff}1 1 0 0 0 0 0 30 7 a b.jpg\n2 1 0 0 0 1 0 30 7 2.jpg\n3 1 0 0 0 2 0 30 7 c.jpg\n";
    let spaced = bare.replace(".jpg\n", ".jpg\n\n");
    let full = bare.replace(".jpg\n", ".jpg\n10.5 20.5 -1 3 4 7\n");
    for text in [bare, &spaced, &full] {
        std::fs::write(dir.path().join("images.txt"), text).unwrap();
        let names: Vec<String> =
            colmap::read_images(&dir.path().join("images.txt")).unwrap().into_iter().map(|i| i.name).collect();
        assert_eq!(names, ["a b.jpg", "2.jpg", "c.jpg"], "{text}");
    }
    let file = dir.path().join("transforms.json");
    transforms::write(&file, &survey()).unwrap();
    let marked = [b"\xEF\xBB\xBF".to_vec(), std::fs::read(&file).unwrap()].concat();
    std::fs::write(&file, marked).unwrap();
    assert_eq!(transforms::read(&file).unwrap().shots.len(), 5);
}

#[test]
fn what_is_written_for_colmap_nerfstudio_and_opensfm_is_read_back() {
    let dir = tempfile::tempdir().unwrap();
    let survey = survey();
    let points = [colmap::Point { position: [1.0, 2.0, 3.0], color: [4, 5, 6] }];
    colmap::write(&dir.path().join("c"), &survey, &points).unwrap();
    let model = colmap::Model::find(&dir.path().join("c")).unwrap().unwrap();
    assert_same(&model.read().unwrap(), &survey, 1e-12);
    let mut read = Vec::new();
    assert_eq!(model.points(&mut |p| read.push((p.position.to_array(), p.color))).unwrap(), 0);
    assert_eq!(read, [([1.0, 2.0, 3.0], [4, 5, 6])]);
    let file = dir.path().join("transforms.json");
    transforms::write(&file, &survey).unwrap();
    assert_same(&transforms::read(&file).unwrap(), &survey, 1e-9);
    opensfm::write(&dir.path().join("opensfm"), &survey).unwrap();
    assert_same(&opensfm::read(&opensfm::find(dir.path()).unwrap()).unwrap(), &survey, 1e-9);
}

/// In `images.bin` it would end the name, and the next view would be read out of the rest.
#[test]
fn a_name_with_a_zero_character_is_not_written_for_colmap() {
    let dir = tempfile::tempdir().unwrap();
    let mut survey = survey();
    survey.shots[1].path = "a\0b.jpg".into();
    let refused = colmap::write(&dir.path().join("c"), &survey, &[]).unwrap_err().to_string();
    assert!(refused.contains("a\\u0000b.jpg: a name for COLMAP holds no zero character"), "{refused}");
    assert!(!dir.path().join("c/images.bin").exists());
}

#[test]
fn every_camera_model_of_colmap_is_read_and_the_smallest_that_holds_a_lens_is_written() {
    for model in CAMERA_MODELS {
        let values: Vec<f64> = model
            .parameters
            .iter()
            .enumerate()
            .map(|(i, name)| match *name {
                "f" | "fx" | "fy" => 900.0 + i as f64,
                "cx" | "cy" => 400.0 + i as f64,
                _ => 1e-3 * (i as f64 + 1.0),
            })
            .collect();
        let lens = model.describe((800, 800), &values).unwrap().lens((800, 800));
        let (smallest, written) = CameraModel::holding(&lens).unwrap();
        let again = smallest.describe((800, 800), &written).unwrap().lens((800, 800));
        assert_eq!(again, lens, "{} as {}", model.name, smallest.name);
        assert!(smallest.parameters.len() <= model.parameters.len().max(8), "{}", model.name);
    }
}

#[test]
fn nerfstudios_frames_may_each_have_their_own_lens_and_model() {
    let dir = tempfile::tempdir().unwrap();
    let file = dir.path().join("transforms.json");
    let m = "[[1,0,0,0],[0,1,0,0],[0,0,1,0],[0,0,0,1]]";
    let text = format!(
        r#"{{"camera_model":"OPENCV_FISHEYE","fl_x":500,"fl_y":501,"cx":320,"cy":240,"w":640,"h":480,"k1":0.1,"k4":0.02,
        "frames":[{{"file_path":"a.jpg","transform_matrix":{m}}},
        {{"file_path":"b.jpg","transform_matrix":{m},"camera_model":"FULL_OPENCV","fl_x":900,"w":1280,"h":960,"k4":0.3,"k6":0.01}},
        {{"file_path":"c.jpg","transform_matrix":{m},"camera_model":"OPENCV","k4":-0.003}}]}}"#
    );
    std::fs::write(&file, &text).unwrap();
    let shots = transforms::read(&file).unwrap().shots;
    let d = shots[0].lens.distortion;
    assert_eq!((d.fisheye, d.k1, d.k4, d.q1), (true, 0.1, 0.02, 0.0));
    let d = shots[1].lens.distortion;
    assert_eq!((d.fisheye, d.k1, d.k4, d.q1, d.q3), (false, 0.1, 0.0, 0.3, 0.01));
    assert_eq!((shots[1].lens.size, shots[1].lens.lens((1280, 960)).focal), (Some((1280, 960)), [900.0, 501.0]));
    assert_eq!(shots[2].lens.distortion.k4, -0.003);
    std::fs::write(&file, text.replace("OPENCV_FISHEYE", "EQUIRECTANGULAR")).unwrap();
    assert!(transforms::read(&file).unwrap_err().to_string().contains("EQUIRECTANGULAR"));
}

/// A view whose focal length is no number, or none, was refused later without a word on which.
#[test]
fn a_lens_that_single_precision_cannot_hold_is_refused_with_its_picture() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("transforms.json");
    let read = |lens: &str| {
        let matrix = "[[1,0,0,0],[0,1,0,0],[0,0,1,0],[0,0,0,1]]";
        let frame = format!(r#"{{"file_path": "a.png", "transform_matrix": {matrix}, {lens}}}"#);
        std::fs::write(&path, format!(r#"{{"w": 64, "h": 48, "frames": [{frame}]}}"#)).unwrap();
        transforms::read(&path).map_err(|e| e.to_string())
    };
    for sound in
        [r#""fl_x": 1e9"#, r#""fl_x": 1e-9"#, r#""camera_angle_x": 3.14"#, r#""fl_x": 50, "cx": -1e6, "cy": 0"#]
    {
        let found = read(sound).unwrap();
        let k = found.shots[0].lens.intrinsics((64, 48));
        assert!([k.fx, k.fy].iter().all(|f| f.is_normal()) && k.cx.is_finite(), "{sound}: {k:?}");
    }
    let refused = [
        r#""fl_x": 1e300"#,
        r#""fl_x": 1e-300"#,
        r#""fl_x": 50, "fl_y": 4e38"#,
        r#""camera_angle_x": 1e-300"#,
        r#""fl_x": 50, "cx": 1e300, "cy": 24"#,
    ];
    for lens in refused {
        let why = read(lens).unwrap_err();
        assert!(why.contains("a.png") && why.contains("transforms.json") && !why.contains('\n'), "{lens}: {why}");
    }
    let simple = CAMERA_MODELS.iter().find(|m| m.name == "PINHOLE").unwrap();
    assert!(simple.describe((64, 48), &[1e300, 50.0, 32.0, 24.0]).is_err());
}

#[test]
fn opendronemaps_reconstruction_is_a_data_set_with_points_and_an_origin() {
    let dir = tempfile::tempdir().unwrap();
    let folder = dir.path().join("opensfm");
    std::fs::create_dir_all(&folder).unwrap();
    // As ODM 3 writes it: two parts, of which the second is the larger; a brown camera in units of the longer edge.
    let text = r#"[{"cameras":{},"shots":{},"points":{"1":{"color":[9,9,9],"coordinates":[0,0,0]}}},
     {"cameras":{"v2 dji fc300s 4000 2250 brown 0.55":{"projection_type":"brown","width":4000,"height":2250,"focal_x":0.6,
      "focal_y":0.601,"c_x":0.001,"c_y":-0.002,"k1":-0.01,"k2":0.02,"p1":0.0003,"p2":0.0001,"k3":-0.004}},
      "shots":{"DJI_0018.JPG":{"rotation":[3.141592653589793,0,0],"translation":[-10.0,20.0,40.0],
        "camera":"v2 dji fc300s 4000 2250 brown 0.55","orientation":1,"capture_time":0.0,"gps_dop":5.0}},
      "points":{"7":{"color":[1.0,2.0,300.0],"coordinates":[1.0,2.0,0.5]}},
      "biases":{},"reference_lla":{"latitude":46.8426,"longitude":-91.9945,"altitude":158.5}}]"#;
    std::fs::write(folder.join("reconstruction.json"), text).unwrap();
    let set = Dataset::open(dir.path()).unwrap();
    assert_eq!(set.origin, Some(ORIGIN));
    let frame = &set.frames[0];
    // Turned by 180° about x: a nadir camera, at −Rᵀ t.
    assert!((frame.view.pose.center - DVec3::new(10.0, 20.0, 40.0)).length() < 1e-9, "{}", frame.view.pose.center);
    assert!((frame.view.pose.forward() + DVec3::Z).length() < 1e-12);
    let k = frame.view.intrinsics;
    assert_eq!([k.fx, k.fy, k.cx, k.cy], [2400.0, 2404.0, 2004.0, 1117.0]);
    assert_eq!((frame.distortion.k3, frame.distortion.p1), (-0.004, 0.0003));
    let points = set.sparse_points().unwrap();
    assert_eq!((points.len(), points[0].position, points[0].color), (1, [1.0, 2.0, 0.5], [1, 2, 255]));
    std::fs::write(folder.join("reconstruction.json"), text.replace("[3.141592653589793,", "[1e308,")).unwrap();
    let said = Dataset::open(dir.path()).unwrap_err().to_string();
    assert!(said.contains("DJI_0018.JPG") && said.contains("pose is not a number"), "{said}");
    std::fs::write(folder.join("reconstruction.json"), text.replace("\"brown\"", "\"spherical\"")).unwrap();
    assert!(Dataset::open(dir.path()).unwrap_err().to_string().contains("spherical"));
}

/// Six pictures of `dgtr demo`, written in that form by PyTorch (tests/mega_nerf.py).
fn miniature() -> std::path::PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/data/mega_nerf")
}

#[test]
fn mill_19s_form_is_read_in_metres_with_what_its_authors_hold_out() {
    let set = Dataset::open(&miniature()).unwrap();
    let truth = transforms::read(&miniature().join("truth.json")).unwrap();
    let names: Vec<&str> = set.frames.iter().map(|f| f.name.as_str()).collect();
    assert_eq!(names, ["000000.jpg", "000001.jpg", "000002.jpg", "000003.jpg", "000004.jpg", "000005.jpg"]);
    assert_eq!(set.select("test", None).unwrap(), [0, 5]);
    assert_eq!(set.select("train", None).unwrap(), [1, 2, 3, 4]);
    // Single precision in units of 21 m, around the middle of the cameras.
    let shift = set.frames[0].view.pose.center - truth.shots[0].pose.center;
    for (frame, shot) in set.frames.iter().zip(&truth.shots) {
        let (read, true_pose) = (frame.view.pose, shot.pose);
        assert!((read.center - true_pose.center).distance(shift) < 1e-5, "{}", frame.name);
        assert!(read.rotation.dot(true_pose.rotation).abs() > 1.0 - 1e-9, "{}", frame.name);
        assert!((read.forward() + DVec3::Z).length() < 0.05, "{} looks down", frame.name);
        let k = frame.view.intrinsics;
        assert_eq!((k.width, k.height, k.fx, k.fy, k.cx, k.cy), (80, 60, 60.0, 60.0, 40.0, 30.0));
    }
    let picture = set.load(1, 1.0).unwrap().image;
    assert_eq!((picture.width(), picture.height()), (80, 60));
}

#[test]
fn mill_19s_form_with_a_damaged_file_is_refused_with_the_file_s_name() {
    let dir = tempfile::tempdir().unwrap();
    let copy = |name: &str| {
        let to = dir.path().join(name);
        std::fs::create_dir_all(to.parent().unwrap()).unwrap();
        std::fs::copy(miniature().join(name), to).unwrap();
    };
    let said = || mega_nerf::read(dir.path()).unwrap_err().to_string();
    assert!(mega_nerf::read(dir.path()).unwrap().is_none(), "another form");
    copy("coordinates.pt");
    assert!(Dataset::open(dir.path()).unwrap_err().to_string().contains("describes no pictures"));
    copy("train/metadata/000001.pt");
    let (found, held_out) = mega_nerf::read(dir.path()).unwrap().unwrap();
    assert_eq!((found.shots.len(), held_out.len()), (1, 0));
    std::fs::create_dir_all(dir.path().join("val/metadata")).unwrap();
    std::fs::copy(miniature().join("coordinates.pt"), dir.path().join("val/metadata/000002.pt")).unwrap();
    assert!(said().contains("000002.pt") && said().contains("c2w"), "{}", said());
    std::fs::rename(dir.path().join("val/metadata/000002.pt"), dir.path().join("val/metadata/000001.pt")).unwrap();
    assert!(said().contains("in train and in val"), "{}", said());
    std::fs::write(dir.path().join("coordinates.pt"), "PK").unwrap();
    assert!(said().contains("coordinates.pt: not a dictionary of torch.save"), "{}", said());
}
