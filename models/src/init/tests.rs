//! The whole way from pictures to Gaussians over a textured plane: by matching, with a network that is told the poses, and with a
//! randomly initialised network of Splatt3R's signature.

use super::*;
use crate::camera::{Intrinsics, Pose, PoseSigma, PosedImage, View};
use crate::mask::Mask;
use config::init::InitSettings;
use glam::{DQuat, DVec3};
use image::{Rgb, RgbImage};

fn texture(x: f64, y: f64) -> u8 {
    let cell = |s: f64| {
        let (i, j) = ((x / s).floor() as i64 as u64, (y / s).floor() as i64 as u64);
        (i.wrapping_mul(0x9E37_79B9_7F4A_7C15) ^ j.wrapping_mul(0xC2B2_AE3D_27D4_EB4F))
            .wrapping_mul(0x1656_67B1_9E37_79F9)
            >> 57
    };
    (cell(1.7) + cell(4.1)) as u8
}

/// A nadir picture of the plane z = 0 from 50 m.
fn picture(i: usize, x: f64, y: f64) -> PosedImage {
    let intrinsics = Intrinsics { width: 192, height: 144, fx: 144.0, fy: 144.0, cx: 96.0, cy: 72.0 };
    let pose = Pose { rotation: DQuat::from_rotation_x(std::f64::consts::PI), center: DVec3::new(x, y, 50.0) };
    let image = RgbImage::from_fn(192, 144, |u, v| {
        let ray =
            pose.rotation * DVec3::new((f64::from(u) + 0.5 - 96.0) / 144.0, (f64::from(v) + 0.5 - 72.0) / 144.0, 1.0);
        let p = pose.center + ray * (50.0 / -ray.z);
        Rgb([texture(p.x, p.y), texture(p.y + 100.0, p.x), 90])
    });
    let sigma = PoseSigma { position_m: [0.0; 3], rotation_rad: [0.0; 3] };
    PosedImage { name: format!("{i}"), time_ns: 0, image, view: View { intrinsics, pose }, mask: None, sigma }
}

fn no_runtime() -> bool {
    let missing = crate::onnx::session::find_library().is_err();
    if missing {
        needs::missing(needs::Need::OnnxRuntime, "no ONNX Runtime");
    }
    missing
}

fn settings() -> InitSettings {
    InitSettings { threads: 1, ..InitSettings::default() }
}

fn no_prior(_: &str, _: crate::camera::DepthPrior) {}

#[test]
fn frames_that_wait_in_a_file_give_the_same_bits_and_one_that_is_cut_is_an_error() {
    if no_runtime() {
        return;
    }
    let run = |file: Option<&std::fs::File>| {
        let mut init = Initialiser::open(&settings(), None).unwrap();
        if let Some(file) = file {
            init.keep_frames_in(file.try_clone().unwrap());
        }
        for i in 0..5 {
            init.add(&picture(i, 12.0 * i as f64, 0.0)).unwrap();
            init.advance(1).unwrap();
        }
        let mut priors = Vec::new();
        let cloud = init.build(3000, &mut |name, prior| priors.push((name.to_owned(), prior))).unwrap().cloud;
        // A depth that is made again lies where the old one lay.
        let mut moved = picture(4, 48.0, 0.0).view.pose;
        moved.center.x += 2.0;
        init.update_pose("4", &moved);
        let again = init.build(3000, &mut no_prior).unwrap().cloud;
        (init, cloud, priors, again)
    };
    let (_, cloud, priors, again) = run(None);
    let file = tempfile::tempfile().unwrap();
    let (mut init, same_cloud, same_priors, same_again) = run(Some(&file));
    assert_eq!((same_cloud, same_again), (cloud, again));
    assert_eq!(same_priors, priors);
    let size = file.metadata().unwrap().len();
    let planned = init.frame_bytes_at(picture(0, 0.0, 0.0).image.dimensions());
    assert!(size > 4 * planned && size <= 5 * planned, "{size} of {planned} each");
    file.set_len(size / 2).unwrap();
    let cut = init.build(3000, &mut no_prior).unwrap_err();
    assert!(matches!(cut, super::InitError::FrameFile(_)) && cut.to_string().lines().count() == 1, "{cut}");
}

#[test]
fn a_plane_comes_out_flat_within_the_budget_and_the_same_every_time() {
    if no_runtime() {
        return;
    }
    let run = || {
        let mut init = Initialiser::open(&settings(), None).unwrap();
        for i in 0..5 {
            init.add(&picture(i, 12.0 * i as f64, 0.0)).unwrap();
            init.advance(1).unwrap();
        }
        let mut priors = 0;
        let made = init.build(5000, &mut |_, _| priors += 1).unwrap();
        (made, priors)
    };
    let (a, priors) = run();
    assert!(a.cloud.len() <= 5000 && a.cloud.len() > 2000, "{:?}", a.report);
    // 3 % of the height is a third of a pixel of the coarse level at this size.
    let near = a.cloud.means.iter().filter(|m| m[2].abs() < 1.5).count();
    assert!(near as f64 > 0.8 * a.cloud.len() as f64, "{near} of {} within 1.5 m", a.cloud.len());
    assert_eq!(priors, 5);
    assert_eq!(a.cloud, run().0.cloud);
}

#[test]
fn what_a_mask_leaves_out_becomes_no_gaussian_and_no_depth_prior() {
    if no_runtime() {
        return;
    }
    // A leg of the aircraft, which every picture shows at the same place.
    let leg = |x: u32, y: u32| x >= 120 && y >= 80;
    let run = |masked: bool| {
        let mut init = Initialiser::open(&settings(), None).unwrap();
        for i in 0..5 {
            let mut p = picture(i, 12.0 * i as f64, 0.0);
            for (x, y, color) in p.image.enumerate_pixels_mut().filter(|(x, y, _)| leg(*x, *y)) {
                *color = Rgb([250, 10 + ((x * 7 + y * 3) % 11 * 4) as u8, 250]);
            }
            p.mask = masked.then(|| Mask::from_fn(192, 144, |x, y| !leg(x, y)));
            init.add(&p).unwrap();
        }
        let mut under = 0;
        let made = init.build(5000, &mut |_, prior| {
            let at = |i: usize| {
                [(i as u32 % prior.width) * 192 / prior.width, (i as u32 / prior.width) * 144 / prior.height]
            };
            let sure = (0..prior.confidence.len()).filter(|i| prior.confidence[*i] > 0.0);
            under += sure.filter(|i| leg(at(*i)[0] + 1, at(*i)[1] + 1)).count();
        });
        let cloud = made.unwrap().cloud;
        // The ground's blue is 90 everywhere, the leg's 250.
        let blue = |i: usize| cloud.sh[i * cloud.sh.len() / cloud.len() + 2] > 0.0;
        let of_leg = (0..cloud.len()).filter(|i| blue(*i)).count();
        (cloud.len(), of_leg, under)
    };
    let ((all, seen, under), (left, none, nowhere)) = (run(false), run(true));
    assert!(seen > 100 && under > 100, "{seen} and {under} of {all}");
    assert_eq!((none, nowhere), (0, 0), "of {left}");
    assert!(left > 2000);
}

#[test]
fn only_depths_whose_poses_moved_are_made_again() {
    if no_runtime() {
        return;
    }
    let mut init = Initialiser::open(&settings(), None).unwrap();
    for i in 0..8 {
        init.add(&picture(i, 12.0 * i as f64, 0.0)).unwrap();
    }
    assert_eq!(init.build(3000, &mut no_prior).unwrap().report.runs, 8);
    assert_eq!(init.build(1000, &mut no_prior).unwrap().report.runs, 8);
    let mut moved = picture(7, 84.0, 0.0).view.pose;
    moved.center.x += 2.0;
    init.update_pose("7", &moved);
    let runs = init.build(1000, &mut no_prior).unwrap().report.runs;
    assert!(runs > 8 && runs < 14, "{runs}");
}

#[test]
fn hovering_alone_and_too_many_pictures_are_one_clear_line() {
    if no_runtime() {
        return;
    }
    let known = InitSettings { depth_m: Some([40.0, 60.0]), max_pictures: 3, ..settings() };
    let mut init = Initialiser::open(&known, None).unwrap();
    for i in 0..3 {
        init.add(&picture(i, 0.0, 0.0)).unwrap();
    }
    assert!(init.add(&picture(3, 9.0, 0.0)).unwrap_err().to_string().contains("max_pictures"));
    let e = init.build(100, &mut no_prior).unwrap_err().to_string();
    assert!(e.contains("none of 3 pictures has a partner"), "{e}");
    let mut blind = Initialiser::open(&settings(), None).unwrap();
    blind.add(&picture(0, 0.0, 0.0)).unwrap();
    assert!(blind.build(100, &mut no_prior).unwrap_err().to_string().contains("depth_m"));
}

#[test]
fn two_places_and_a_picture_taken_twice_become_one_cloud_and_useless_pairs_are_counted() {
    if no_runtime() {
        return;
    }
    let known = InitSettings { depth_m: Some([40.0, 60.0]), ..settings() };
    let mut init = Initialiser::open(&known, None).unwrap();
    for (i, x) in [0.0, 12.0, 12.0, 5000.0, 5012.0].into_iter().enumerate() {
        init.add(&picture(i, x, 0.0)).unwrap();
    }
    let mut priors = 0;
    let out = init.build(6000, &mut |_, _| priors += 1).unwrap();
    // The copy has its depth from the picture beside it; with its original it has no baseline.
    assert_eq!((out.report.runs, priors), (5, 5), "{:?}", out.report);
    assert_eq!((out.report.skipped.no_baseline, out.report.skipped.too_wide), (1, 3), "{:?}", out.report.skipped);
    let here = out.cloud.means.iter().filter(|m| m[0] < 100.0).count();
    let there = out.cloud.means.iter().filter(|m| m[0] > 4900.0).count();
    assert!(here > 500 && there > 500 && here + there == out.cloud.len(), "{here} {there}");
}

#[test]
fn a_network_that_is_told_the_poses_finds_the_plane_as_the_matching_does() {
    if no_runtime() {
        return;
    }
    let manifest = std::path::Path::new(env!("CARGO_MANIFEST_DIR")).join("networks/plane_sweep.toml");
    let known = InitSettings { depth_m: Some([40.0, 60.0]), ..settings() };
    for (manifest, name) in [(Some(manifest.as_path()), "plane-sweep"), (None, "semi-global-matching")] {
        let mut init = Initialiser::open(&known, manifest).unwrap();
        for i in 0..4 {
            init.add(&picture(i, 12.0 * i as f64, 0.0)).unwrap();
        }
        let made = init.build(5000, &mut no_prior).unwrap();
        assert_eq!((made.report.network.as_str(), made.report.runs), (name, 4));
        let near = made.cloud.means.iter().filter(|m| m[2].abs() < 1.5).count();
        assert!(near as f64 > 0.8 * made.cloud.len() as f64, "{name}: {near} of {}", made.cloud.len());
    }
}

#[test]
fn an_unposed_network_runs_the_whole_way_and_its_plane_is_put_at_its_height() {
    if no_runtime() {
        return;
    }
    // The network claims a plane at unit distance and a baseline of 0.24: with 12 m flown, σ is 50 and the plane z = 0.
    let manifest = std::path::Path::new(env!("CARGO_MANIFEST_DIR")).join("networks/random_pair.toml");
    let known = InitSettings { depth_m: Some([40.0, 60.0]), stride: 1, window: 1, covisible: 0, ..settings() };
    let mut init = Initialiser::open(&known, Some(&manifest)).unwrap();
    for i in 0..4 {
        init.add(&picture(i, 12.0 * i as f64, 0.0)).unwrap();
    }
    let out = init.build(4000, &mut no_prior).unwrap();
    assert!(out.cloud.len() > 500 && out.cloud.len() <= 4000, "{:?}", out.report);
    assert_eq!((out.report.alignment.components, out.report.alignment.edges_without_scale), (1, 0), "{:?}", out.report);
    assert_eq!(out.report.depth_m, [40.0, 60.0]);
    let mut heights: Vec<f32> = out.cloud.means.iter().map(|m| m[2]).collect();
    heights.sort_by(f32::total_cmp);
    println!("median height {} of {} Gaussians, {:?}", heights[heights.len() / 2], heights.len(), out.report);
    assert!(heights[heights.len() / 2].abs() < 1.0);
    assert!(out.cloud.log_scales.iter().flatten().all(|s| s.is_finite()));
}

#[test]
fn a_pair_network_that_is_not_what_its_manifest_says_is_refused_when_it_is_opened() {
    if no_runtime() {
        return;
    }
    let networks = std::path::Path::new(env!("CARGO_MANIFEST_DIR")).join("networks");
    let good = std::fs::read_to_string(networks.join("random_pair.toml")).unwrap();
    let good = good.replace("\"random_pair.onnx\"", &format!("{:?}", networks.join("random_pair.onnx")));
    let folder = tempfile::tempdir().unwrap();
    let open = |text: &str| {
        let path = folder.path().join("n.toml");
        std::fs::write(&path, text).unwrap();
        Initialiser::open(&settings(), Some(&path)).map(drop).map_err(|e| e.to_string())
    };
    open(&good).unwrap();
    let refused = |text: String, words: &str| {
        let e = open(&text).unwrap_err();
        assert!(e.contains(words) && !e.contains('\n'), "{e}");
    };
    refused(good.replace("sh_degree = 0", "sh_degree = 1"), "output `sh_1` is f32 [1,48,64,3,1]");
    refused(good.replace("contract = \"pair\"", "contract = \"metric\""), "is `metric`, needed is `pair`");
    refused(format!("sha256 = \"00\"\n{good}"), "sha256");
    let text: String = good.lines().filter(|l| !l.starts_with("blake3")).map(|l| format!("{l}\n")).collect();
    refused(text.replace("random_pair.onnx", "mean_square.onnx"), "input `img1` is missing (there are: a, b)");
}

#[test]
fn the_scale_switches_of_the_ablation_set_the_extent_of_the_gaussians() {
    if no_runtime() {
        return;
    }
    // All three from the same depths; the budget holds every voxel, so that merging widens nothing.
    let known = InitSettings { depth_m: Some([40.0, 60.0]), ..settings() };
    let mut init = Initialiser::open(&known, None).unwrap();
    for i in 0..3 {
        init.add(&picture(i, 12.0 * i as f64, 0.0)).unwrap();
    }
    let mut extent = |global: bool, local: bool| {
        init.reconfigure(&InitSettings { global_scale: global, local_scale: local, ..known.clone() }).unwrap();
        let cloud = init.build(60_000, &mut no_prior).unwrap().cloud;
        let mut longest: Vec<f32> = cloud.log_scales.iter().map(|s| s[0].exp()).collect();
        longest.sort_by(f32::total_cmp);
        (longest[longest.len() / 20], longest[longest.len() / 2])
    };
    // Without sᵍ a sample is as large as at depth 1; with it, at the typical depth; with sˡ, at its own.
    let (neither, global, both) = (extent(false, false), extent(true, false), extent(true, true));
    assert!((global.1 / neither.1 / 48.0 - 1.0).abs() < 0.02, "{neither:?} {global:?}");
    assert!((global.0 / global.1 - 1.0).abs() < 1e-3, "one extent for all: {global:?}");
    assert!(both.1 > global.1 && both.1 < 3.0 * global.1 && both.0 < 0.97 * both.1, "{global:?} {both:?}");
}
