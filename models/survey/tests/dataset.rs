//! Promises of the data set loader, on small sets written here and, where they are, on the reference sets.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic)] // a test may

use std::path::Path;

use glam::{DQuat, DVec3};
use image::{Rgb, RgbImage};
use models::camera::Pose;
use models::formats::transforms::{opengl_to_pose, pose_to_opengl};
use survey::dataset::{Dataset, DatasetError, PoseSource};

use needs::shared;

fn picture(path: &Path, w: u32, h: u32) {
    std::fs::create_dir_all(path.parent().unwrap()).unwrap();
    RgbImage::from_fn(w, h, |x, y| Rgb([(x * 10) as u8, (y * 10) as u8, 50])).save(path).unwrap();
}

/// Looks straight down from `height`, the top of the picture to the north.
fn nadir(east: f64, height: f64) -> Pose {
    Pose { rotation: DQuat::from_xyzw(1.0, 0.0, 0.0, 0.0), center: DVec3::new(east, 0.0, height) }
}

fn write_transforms(root: &Path, n: usize, extra: &str) {
    let frames: Vec<String> = (0..n)
        .map(|i| {
            picture(&root.join(format!("images/f{i:02}.png")), 16, 12);
            let m = pose_to_opengl(&nadir(i as f64, 30.0));
            format!(r#"{{"file_path":"images/f{i:02}.png","transform_matrix":{m:?}}}"#)
        })
        .collect();
    let text = format!(
        r#"{{"fl_x":14.0,"fl_y":15.0,"cx":8.0,"cy":6.5,"w":16,"h":12,{extra}"frames":[{}]}}"#,
        frames.join(",")
    );
    std::fs::write(root.join("transforms.json"), text).unwrap();
}

fn le(values: &[f64]) -> Vec<u8> {
    values.iter().flat_map(|v| v.to_le_bytes()).collect()
}

fn write_colmap(root: &Path, poses: &[Pose]) {
    let folder = root.join("sparse/0");
    std::fs::create_dir_all(&folder).unwrap();
    let mut cameras = 1u64.to_le_bytes().to_vec();
    cameras.extend([7u32.to_le_bytes(), 1u32.to_le_bytes()].concat());
    cameras.extend([16u64.to_le_bytes(), 12u64.to_le_bytes()].concat());
    cameras.extend(le(&[14.0, 15.0, 8.0, 6.5]));
    std::fs::write(folder.join("cameras.bin"), cameras).unwrap();
    let mut images = (poses.len() as u64).to_le_bytes().to_vec();
    for (i, pose) in poses.iter().enumerate() {
        let r = pose.rotation.conjugate();
        let t = -(r * pose.center);
        images.extend((i as u32 + 1).to_le_bytes());
        images.extend(le(&[r.w, r.x, r.y, r.z, t.x, t.y, t.z]));
        images.extend(7u32.to_le_bytes());
        images.extend(format!("f{i:02}.png\0").bytes());
        images.extend(1u64.to_le_bytes());
        images.extend(le(&[3.0, 4.0]));
        images.extend(5u64.to_le_bytes());
    }
    std::fs::write(folder.join("images.bin"), images).unwrap();
    let mut points = 1u64.to_le_bytes().to_vec();
    points.extend(5u64.to_le_bytes());
    points.extend(le(&[1.0, 2.0, 3.0]));
    points.extend([9, 8, 7]);
    points.extend(le(&[0.5]));
    points.extend(2u64.to_le_bytes());
    for id in [2u32, 1] {
        points.extend([id.to_le_bytes(), 0u32.to_le_bytes()].concat());
    }
    std::fs::write(folder.join("points3D.bin"), points).unwrap();
}

#[test]
fn opengl_matrices_and_poses_are_inverse_of_each_other() {
    let pose =
        Pose { rotation: DQuat::from_xyzw(0.1, -0.7, 0.3, 0.5).normalize(), center: DVec3::new(1.0, -2.0, 60.0) };
    let rows: Vec<Vec<f64>> = pose_to_opengl(&pose).iter().map(|r| r.to_vec()).collect();
    let back = opengl_to_pose(&rows).unwrap();
    assert!(back.center.distance(pose.center) < 1e-12 && back.rotation.dot(pose.rotation).abs() > 1.0 - 1e-12);
    // OpenGL's camera looks along its −z: the third column is minus the optical axis.
    let forward = DVec3::new(-rows[0][2], -rows[1][2], -rows[2][2]);
    assert!((forward - pose.forward()).length() < 1e-12);
}

#[test]
fn scaled_matrices_and_mirrors_are_refused() {
    let rows = |s: f64, m: f64| vec![vec![s * m, 0.0, 0.0, 0.0], vec![0.0, s, 0.0, 0.0], vec![0.0, 0.0, s, 0.0]];
    assert!(opengl_to_pose(&rows(1.0, 1.0)).is_ok());
    assert!(opengl_to_pose(&rows(1.1, 1.0)).is_err());
    assert!(opengl_to_pose(&rows(1.0, -1.0)).is_err());
    assert!(opengl_to_pose(&[vec![f64::NAN; 4], vec![0.0; 4], vec![0.0; 4]]).is_err());
}

#[test]
fn every_eighth_picture_by_name_is_held_out_without_a_split_file() {
    let dir = tempfile::tempdir().unwrap();
    write_transforms(dir.path(), 17, "");
    let set = Dataset::open(dir.path()).unwrap();
    assert_eq!(set.select("test", None).unwrap(), [0, 8, 16]);
    assert_eq!(set.select("train", None).unwrap().len(), 14);
    assert_eq!(set.select("all", None).unwrap().len(), 17);
    assert!(matches!(set.select("valid", None), Err(DatasetError::Unknown { kind: "split", .. })));
    assert!(matches!(set.select("test", Some("0")), Err(DatasetError::Unknown { kind: "region", .. })));
}

#[test]
fn a_loaded_picture_and_its_intrinsics_are_scaled_alike() {
    let dir = tempfile::tempdir().unwrap();
    write_transforms(dir.path(), 1, "");
    let set = Dataset::open(dir.path()).unwrap();
    let full = set.load(0, 1.0).unwrap();
    assert_eq!(full.image.get_pixel(3, 2), &Rgb([30, 20, 50]));
    let half = set.load(0, 0.5).unwrap();
    let k = half.view.intrinsics;
    assert_eq!((k.width, k.height, half.image.width(), half.image.height()), (8, 6, 8, 6));
    assert_eq!((k.fx, k.fy, k.cx, k.cy), (7.0, 7.5, 4.0, 3.25));
    // Area kept: pixel (2, 2) of the half covers x 4…5 and y 4…5 of the full picture.
    assert!(half.image.get_pixel(2, 2)[0].abs_diff(45) <= 1 && half.image.get_pixel(2, 2)[1].abs_diff(45) <= 1);
    for scale in [0.0, -1.0, 1.5, f64::NAN] {
        assert!(matches!(set.load(0, scale), Err(DatasetError::Request(_))));
    }
    assert_eq!(set.load(0, 1e-9).unwrap().image.dimensions(), (1, 1));
}

#[test]
fn regions_have_their_own_lists() {
    let dir = tempfile::tempdir().unwrap();
    write_transforms(dir.path(), 4, "");
    let split = r#"{"train":["f00.png","f03.png"],"train_dense":["f00.png","f02.png","f03.png"],"test":["f01.png"],"test_every":8,
        "regions":[{"id":0,"bbox_min_xy":[-1,-2],"bbox_max_xy":[3,4],"images":["f00.png","f02.png"],"train":["f00.png"],"test":["f01.png"]}]}"#;
    std::fs::write(dir.path().join("split.json"), split).unwrap();
    let set = Dataset::open(dir.path()).unwrap();
    assert_eq!(set.select("train", None).unwrap(), [0, 3]);
    assert_eq!(set.select("train", Some("0")).unwrap(), [0]);
    assert_eq!(set.select("train_dense", Some("0")).unwrap(), [0, 2]);
    assert_eq!(set.select("test", Some("0")).unwrap(), [1]);
    assert_eq!(set.select("all", Some("0")).unwrap(), [0, 1, 2]);
    assert_eq!(set.region("0").unwrap().polygon[2], [3.0, 4.0]);
    std::fs::write(dir.path().join("split.json"), split.replace("f02", "nowhere")).unwrap();
    let error = Dataset::open(dir.path()).unwrap_err().to_string();
    assert!(error.contains("split.json") && error.contains("nowhere.png"), "{error}");
}

#[test]
fn a_colmap_model_alone_is_a_data_set_with_points_and_tracks() {
    let dir = tempfile::tempdir().unwrap();
    let poses: Vec<Pose> = (0..3).map(|i| nadir(f64::from(i), 20.0)).collect();
    write_colmap(dir.path(), &poses);
    picture(&dir.path().join("images/f02.png"), 16, 12);
    let set = Dataset::open(dir.path()).unwrap();
    assert_eq!(set.frames.len(), 3);
    assert!(set.frames[2].view.pose.center.distance(poses[2].center) < 1e-12);
    assert!(set.load(2, 1.0).is_ok());
    let points = set.sparse_points().unwrap();
    assert_eq!(
        (points[0].position, points[0].color, points[0].frames.as_slice()),
        ([1.0, 2.0, 3.0], [9, 8, 7], [0, 1].as_slice())
    );
    assert_eq!(set.sparse_points_of(&[0, 1]).unwrap().len(), 1);
    assert_eq!(set.sparse_points_of(&[1, 2]).unwrap().len(), 0);
}

#[test]
fn like_named_pictures_of_two_folders_keep_their_tracks_and_their_lists() {
    let dir = tempfile::tempdir().unwrap();
    let model = dir.path().join("sparse/0");
    std::fs::create_dir_all(&model).unwrap();
    std::fs::write(model.join("cameras.txt"), "1 PINHOLE 16 12 14 15 8 6.5\n").unwrap();
    let mut images = String::new();
    for (i, name) in ["test/r_0.png", "train/r_0.png", "train/r_1.png"].iter().enumerate() {
        picture(&dir.path().join("images").join(name), 16, 12);
        images += &format!("{} 0 1 0 0 {i} 0 30 1 {name}\n1 1 1\n", i + 1);
    }
    std::fs::write(model.join("images.txt"), images).unwrap();
    std::fs::write(model.join("points3D.txt"), "1 0 0 0 9 8 7 0.5 1 0 2 0\n2 1 0 0 9 8 7 0.5 2 0 3 0\n").unwrap();
    std::fs::write(
        dir.path().join("split.json"),
        r#"{"train":["train/r_0.png","train/r_1.png"],"test":["test/r_0.png"]}"#,
    )
    .unwrap();
    let set = Dataset::open(dir.path()).unwrap();
    assert_eq!(set.select("test", None).unwrap(), [0]);
    let tracks: Vec<Vec<u32>> = set.sparse_points().unwrap().into_iter().map(|p| p.frames).collect();
    assert_eq!(tracks, [vec![0, 1], vec![1, 2]]);
    // What a held-out picture saw with one other is not known to training.
    assert_eq!(set.sparse_points_of(&set.select("train", None).unwrap()).unwrap().len(), 1);
}

#[test]
fn damaged_colmap_files_are_errors_at_every_length() {
    let dir = tempfile::tempdir().unwrap();
    write_colmap(dir.path(), &[nadir(0.0, 20.0), nadir(1.0, 20.0)]);
    for name in ["cameras.bin", "images.bin", "points3D.bin"] {
        let path = dir.path().join("sparse/0").join(name);
        let whole = std::fs::read(&path).unwrap();
        let open = || Dataset::open(dir.path()).and_then(|d| d.sparse_points());
        for n in 0..whole.len() {
            std::fs::write(&path, &whole[..n]).unwrap();
            assert!(open().is_err(), "{name} cut to {n} bytes");
        }
        // A count of 2⁶⁴−1 must not be believed.
        let mut huge = whole.clone();
        huge[..8].fill(255);
        std::fs::write(&path, &huge).unwrap();
        assert!(open().unwrap_err().to_string().contains("at most"), "{name}");
        std::fs::write(&path, &whole).unwrap();
        assert!(open().is_ok());
    }
}

#[test]
fn errors_name_the_file_and_what_is_wrong() {
    let dir = tempfile::tempdir().unwrap();
    let error = Dataset::open(dir.path()).unwrap_err().to_string();
    assert!(error.contains("transforms.json") && !error.contains('\n'), "{error}");
    write_transforms(dir.path(), 2, r#""k1":0.0,"#);
    std::fs::write(dir.path().join("images/f01.png"), b"no picture").unwrap();
    let set = Dataset::open(dir.path()).unwrap();
    assert!(set.load(1, 1.0).unwrap_err().to_string().contains("f01.png"));
    std::fs::remove_file(dir.path().join("images/f01.png")).unwrap();
    assert!(set.load(1, 1.0).unwrap_err().to_string().contains("f01.png"));
    picture(&dir.path().join("images/f01.png"), 16, 16);
    assert!(set.load(1, 1.0).unwrap_err().to_string().contains("16 x 16"));
    assert!(set.load_posed(0, 1.0, PoseSource::Telemetry).unwrap_err().to_string().contains("gps.csv"));
    std::fs::write(dir.path().join("transforms.json"), "{}").unwrap();
    assert!(Dataset::open(dir.path()).unwrap_err().to_string().contains("frames"));
}

#[test]
fn reference_transforms_and_colmap_agree() {
    for name in ["sheffield_cross", "fox", "brighton_beach"] {
        let Some(root) = shared(&format!("data/{name}")) else { return };
        let set = Dataset::open(&root).unwrap();
        let images = models::formats::colmap::read_images(&root.join("sparse/0/images.bin")).unwrap();
        assert_eq!(images.len(), set.frames.len());
        for image in images {
            let frame = set.frames.iter().find(|f| f.name == image.name).unwrap();
            assert!(frame.view.pose.center.distance(image.pose.center) < 1e-9, "{name} {}", image.name);
            assert!(frame.view.pose.rotation.dot(image.pose.rotation).abs() > 1.0 - 1e-12);
        }
    }
}

#[test]
fn reference_points_project_onto_their_own_colour() {
    let Some(root) = shared("data/sheffield_cross") else { return };
    let set = Dataset::open(&root).unwrap();
    let points = set.sparse_points().unwrap();
    assert_eq!(points.len(), 15_000);
    let picture = set.load(10, 1.0).unwrap();
    let (k, view) = (picture.view.intrinsics, picture.view.pose.viewmat());
    let (mut n, mut error) = (0, 0.0);
    for p in points.iter().filter(|p| p.frames.contains(&10)) {
        let c = view.transform_point3(glam::DVec3::from_array(p.position).as_vec3());
        let (u, v) = (k.fx * c.x / c.z + k.cx, k.fy * c.y / c.z + k.cy);
        // A keypoint near the border may reproject a pixel or two outside.
        assert!(c.z > 0.0 && (-5.0..645.0).contains(&u) && (-5.0..485.0).contains(&v), "{c} {u} {v}");
        let pixel = picture.image.get_pixel((u as u32).min(639), (v as u32).min(479));
        error += (0..3).map(|i| f64::from(pixel[i].abs_diff(p.color[i]))).sum::<f64>() / 3.0;
        n += 1;
    }
    assert!(n > 300 && error / f64::from(n) < 20.0, "{n} points, mean colour difference {}", error / f64::from(n));
}

#[test]
fn reference_telemetry_is_near_the_reconstruction() {
    for (name, bound_m, bound_deg) in [("sheffield_cross", 2.0, 6.0), ("brighton_beach", 2.0, 7.0)] {
        let Some(root) = shared(&format!("data/{name}")) else { return };
        let set = Dataset::open(&root).unwrap();
        let mut worst = (0.0f64, 0.0f64);
        for frame in &set.frames {
            let t = frame.prior.expect("every picture has its row");
            worst.0 = worst.0.max(t.pose.center.distance(frame.view.pose.center));
            worst.1 = worst.1.max(t.pose.rotation.angle_between(frame.view.pose.rotation).to_degrees());
        }
        assert!(worst.0 < bound_m && worst.1 < bound_deg, "{name}: {worst:?}");
    }
}

/// A ring of cameras that look at its middle, as OpenGL matrices.
fn ring(n: usize, scale: f64, shift: DVec3) -> Vec<[[f64; 4]; 4]> {
    let of = |i: usize| {
        let angle = std::f64::consts::TAU * i as f64 / n as f64;
        let ahead = -DVec3::new(angle.cos(), angle.sin(), 0.3).normalize();
        let right = DVec3::new(-angle.sin(), angle.cos(), 0.0);
        let rotation = DQuat::from_mat3(&glam::DMat3::from_cols(right, ahead.cross(right), ahead));
        pose_to_opengl(&Pose { rotation, center: -ahead * 4.0 * scale + shift })
    };
    (0..n).map(of).collect()
}

fn write_ring(root: &Path, file: &str, names: &[String], matrices: &[[[f64; 4]; 4]], extra: &str) {
    let frame = |(name, m): (&String, &[[f64; 4]; 4])| format!(r#"{{"file_path":"{name}","transform_matrix":{m:?}}}"#);
    let frames: Vec<String> = names.iter().zip(matrices).map(frame).collect();
    let text = format!(r#"{{"camera_angle_x":0.7,{extra}"frames":[{}]}}"#, frames.join(","));
    std::fs::write(root.join(file), text).unwrap();
}

fn names(list: &str, n: usize) -> Vec<String> {
    (0..n).map(|i| format!("./{list}/r_{i}")).collect()
}

#[test]
fn blenders_lists_are_one_data_set_whose_test_pictures_are_held_out() {
    let dir = tempfile::tempdir().unwrap();
    for (list, n) in [("train", 6), ("val", 3), ("test", 4)] {
        (0..n).for_each(|i| picture(&dir.path().join(format!("{list}/r_{i}.png")), 16, 12));
        write_ring(dir.path(), &format!("transforms_{list}.json"), &names(list, n), &ring(n, 1.0, DVec3::ZERO), "");
    }
    let set = Dataset::open(dir.path()).unwrap();
    assert_eq!((set.frames.len(), set.split.lists["train"].len(), set.split.lists["test"].len()), (10, 6, 4));
    let held_out = &set.frames[set.split.lists["test"][0]];
    assert!(held_out.name == "test/r_0.png" && held_out.path.ends_with("test/r_0.png"), "{}", held_out.name);
    assert!(set.load(0, 1.0).is_ok());
}

#[test]
fn pictures_are_found_whatever_the_case_accents_and_dots_of_their_names() {
    let dir = tempfile::tempdir().unwrap();
    let on_disc = ["images/A.PNG", "images/Ho\u{308}he.png", "images/c.v1.2.png", "images/d e.png"];
    on_disc.iter().for_each(|name| picture(&dir.path().join(name), 16, 12));
    let described = ["images/a.png", "images/H\u{f6}he.png", "images/c.v1.2", r"images\\d e.png"].map(str::to_owned);
    write_ring(dir.path(), "transforms.json", &described, &ring(4, 1.0, DVec3::ZERO), "");
    let set = Dataset::open(dir.path()).unwrap();
    for (i, name) in on_disc.iter().enumerate() {
        assert!(set.frames[i].path.is_file() && set.load(i, 1.0).is_ok(), "{name}: {}", set.frames[i].path.display());
    }
}

#[test]
fn a_number_that_is_none_is_named_with_its_frame_and_a_byte_order_mark_is_no_fault() {
    let dir = tempfile::tempdir().unwrap();
    write_ring(dir.path(), "transforms.json", &names("train", 3), &ring(3, 1.0, DVec3::ZERO), r#""aabb_scale":NaN,"#);
    (0..3).for_each(|i| picture(&dir.path().join(format!("train/r_{i}.png")), 16, 12));
    let file = dir.path().join("transforms.json");
    let text = std::fs::read_to_string(&file).unwrap();
    std::fs::write(&file, format!("\u{feff}{text}")).unwrap();
    assert_eq!(Dataset::open(dir.path()).unwrap().frames.len(), 3, "a NaN that nobody needs");
    for word in ["NaN", "-Infinity", "null"] {
        let at = text.rfind("\"transform_matrix\":[[").unwrap() + "\"transform_matrix\":[[".len();
        let end = at + text[at..].find(',').unwrap();
        std::fs::write(&file, format!("{}{word}{}", &text[..at], &text[end..])).unwrap();
        let error = Dataset::open(dir.path()).unwrap_err().to_string();
        assert!(error.contains("train/r_2") && error.contains("NaN") && !error.contains('\n'), "{word}: {error}");
    }
}

#[test]
fn points_of_a_ply_and_of_a_colmap_model_in_another_frame_lie_before_the_cameras() {
    let dir = tempfile::tempdir().unwrap();
    (0..6).for_each(|i| picture(&dir.path().join(format!("train/r_{i}.png")), 16, 12));
    let ply = "ply\nformat ascii 1.0\nelement vertex 2\nproperty double x\nproperty double y\nproperty double z\nproperty uchar red\nproperty uchar green\nproperty uchar blue\nend_header\n0.5 0 0 255 0 7\n0 0.25 0 1 2 3\n";
    std::fs::write(dir.path().join("pc.ply"), ply).unwrap();
    write_ring(
        dir.path(),
        "transforms.json",
        &names("train", 6),
        &ring(6, 1.0, DVec3::ZERO),
        r#""ply_file_path":"pc.ply","#,
    );
    let points = Dataset::open(dir.path()).unwrap().sparse_points().unwrap();
    assert_eq!((points.len(), points[0].position, points[0].color), (2, [0.5, 0.0, 0.0], [255, 0, 7]));
    // nerfstudio turned and scaled the poses after COLMAP.
    write_colmap(dir.path(), &[nadir(0.0, 30.0), nadir(1.0, 30.0)]);
    let untouched = {
        let of = r#""applied_transform":[[1,0,0,0],[0,1,0,0],[0,0,1,0]],"#;
        write_ring(dir.path(), "transforms.json", &names("train", 6), &ring(6, 1.0, DVec3::ZERO), of);
        Dataset::open(dir.path()).unwrap().sparse_points().unwrap()
    };
    let of = r#""applied_scale":0.5,"applied_transform":[[1,0,0,0],[0,0,1,0],[0,-1,0,2]],"#;
    write_ring(dir.path(), "transforms.json", &names("train", 6), &ring(6, 1.0, DVec3::ZERO), of);
    let points = Dataset::open(dir.path()).unwrap().sparse_points().unwrap();
    let [x, y, z] = untouched[0].position;
    assert_eq!(points[0].position, [0.5 * x, 0.5 * z, 0.5 * (2.0 - y)]);
}

#[test]
fn poses_in_other_axes_are_refused_where_points_lie_behind_them() {
    let dir = tempfile::tempdir().unwrap();
    (0..6).for_each(|i| picture(&dir.path().join(format!("train/r_{i}.png")), 16, 12));
    let ply = "ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nproperty float y\nproperty float z\nend_header\n0 0 0\n";
    std::fs::write(dir.path().join("pc.ply"), ply).unwrap();
    let mut opencv = ring(6, 1.0, DVec3::ZERO);
    opencv.iter_mut().flatten().for_each(|row| (row[1], row[2]) = (-row[1], -row[2]));
    write_ring(dir.path(), "transforms.json", &names("train", 6), &opencv, r#""ply_file_path":"pc.ply","#);
    let error = Dataset::open(dir.path()).unwrap_err().to_string();
    assert!(error.contains("OpenCV") && error.contains("look away") && !error.contains('\n'), "{error}");
    // Without points it may be a walk that looks outward: said, not refused.
    write_ring(dir.path(), "transforms.json", &names("train", 6), &opencv, "");
    assert!(Dataset::open(dir.path()).is_ok());
}

#[test]
fn a_scene_in_a_maps_coordinates_or_of_an_odd_size_is_brought_near_and_its_poses_go_back_as_they_came() {
    for (scale, shift) in [(10.0, DVec3::new(500_000.0, 4_000_000.0, 100.0)), (1e-4, DVec3::ZERO), (1e6, DVec3::ZERO)] {
        let dir = tempfile::tempdir().unwrap();
        (0..8).for_each(|i| picture(&dir.path().join(format!("train/r_{i}.png")), 16, 12));
        write_ring(
            dir.path(),
            "transforms.json",
            &names("train", 8),
            &ring(8, scale, shift),
            r#""ply_file_path":"pc.ply","#,
        );
        let ply = format!(
            "ply\nformat ascii 1.0\nelement vertex 1\nproperty double x\nproperty double y\nproperty double z\nend_header\n{} {} {}\n",
            shift.x, shift.y, shift.z
        );
        std::fs::write(dir.path().join("pc.ply"), ply).unwrap();
        let set = Dataset::open(dir.path()).unwrap();
        assert!(set.local.is_some(), "{scale}");
        let point = DVec3::from_array(set.sparse_points().unwrap()[0].position);
        for (frame, back) in set.frames.iter().zip(set.reconstruction().shots) {
            let away = frame.view.pose.center.distance(point);
            assert!((0.3..100.0).contains(&away), "{scale}: {away}");
            let stated = opengl_to_pose(&ring(8, scale, shift)[frame_number(&frame.name)].map(|r| r.to_vec())).unwrap();
            assert!(back.pose.center.distance(stated.center) < 1e-8 * (scale + shift.length()), "{scale}");
        }
    }
    let dir = tempfile::tempdir().unwrap();
    write_transforms(dir.path(), 9, "");
    assert_eq!(Dataset::open(dir.path()).unwrap().local, None);
}

fn frame_number(name: &str) -> usize {
    name.trim_end_matches(".png").rsplit('_').next().unwrap().parse().unwrap()
}

#[test]
fn a_picture_that_is_not_what_its_description_says_is_refused_before_it_is_decoded() {
    let folder = tempfile::tempdir().unwrap();
    write_transforms(folder.path(), 3, "");
    let set = Dataset::open(folder.path()).unwrap();
    let path = folder.path().join("images/f01.png");
    let small = std::fs::read(&path).unwrap();
    // The size in the head of a PNG, and the checksum of the head behind it; no pixel follows that could be decoded.
    for (w, h) in [(16_384u32, 16_384u32), (16_000, 12_000)] {
        let mut head = small[..16].to_vec();
        head.extend([w.to_be_bytes(), h.to_be_bytes()].concat());
        head.extend([8, 0, 0, 0, 0]);
        let checksum = crc(&head[12..]);
        head.extend(checksum.to_be_bytes());
        head.extend([0, 0, 0, 0]);
        head.extend(b"IDAT");
        std::fs::write(&path, head).unwrap();
        let said = set.load(1, 1.0).unwrap_err().to_string();
        assert!(said.contains(&format!("is {w} x {h}, its description says 16 x 12")), "{said}");
    }
}

/// CRC-32 as PNG has it.
fn crc(bytes: &[u8]) -> u32 {
    !bytes.iter().fold(!0u32, |sum, byte| {
        (0..8).fold(sum ^ u32::from(*byte), |sum, _| if sum & 1 == 1 { sum >> 1 ^ 0xedb8_8320 } else { sum >> 1 })
    })
}
