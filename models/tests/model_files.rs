//! Promises of the model file and the 3DGS PLY: what was written comes back bit by bit, and no damage goes unseen.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic)] // a test may

use std::path::Path;

use geometry::geodesy::Geodetic;
use glam::{DQuat, DVec3};
use models::camera::{Intrinsics, Pose, View};
use models::cloud::{GaussianCloud, sh_coefficients};
use models::formats::model::{self, ModelHeader};
use models::formats::reconstruction::LocalFrame;
use models::formats::{FormatError, ply};
use models::light::PictureLight;
use proptest::prelude::*;

fn header(views: usize) -> ModelHeader {
    let intrinsics = Intrinsics { width: 64, height: 48, fx: 40.0, fy: 41.0, cx: 32.0, cy: 24.5 };
    let view = View { intrinsics, pose: Pose { rotation: DQuat::IDENTITY, center: DVec3::new(1.0, -2.5, 60.0) } };
    ModelHeader {
        mission: "park".into(),
        aircraft: "a1".into(),
        origin: Some(Geodetic { lat_deg: 28.041587945090438, lon_deg: -82.69757095122739, alt_m: -69.7477176767264 }),
        region: vec![[0.0, 0.0], [1.0, 0.0], [1.0, 1.0]],
        views: (0..views).map(|i| (format!("v{i}.jpg"), view)).collect(),
        steps: 300,
        reserved: [0; 8],
        seed: 7,
        finished: true,
        lights: vec![PictureLight { gain: [0.2, -0.1, 0.0], falloff: [-0.3, 0.1, 0.0], reach: 0.9 }; views],
        thinned: true,
        local: Some(LocalFrame { shift: [500_000.0, 4_000_000.0, 100.0], scale: 0.1 }),
    }
}

#[test]
fn a_frame_that_is_no_shift_and_scale_is_not_written() {
    let odd = ModelHeader { local: Some(LocalFrame { shift: [0.0; 3], scale: 0.0 }), ..header(1) };
    assert!(model::encode_header(Path::new("m.dgtr"), &odd).is_err());
}

#[test]
fn a_header_without_a_frame_may_end_before_it_and_no_earlier() {
    let path = Path::new("m.dgtr");
    let own = ModelHeader { thinned: false, local: None, ..header(2) };
    let bytes = model::encode_header(path, &own).unwrap();
    assert_eq!(model::decode_header(path, &bytes[..bytes.len() - 1]).unwrap(), own);
    assert!(model::decode_header(path, &bytes[..bytes.len() - 2]).is_err());
}

fn cloud() -> impl Strategy<Value = GaussianCloud> {
    (0u8..=3, 0usize..6).prop_flat_map(|(degree, n)| {
        let finite = || prop::num::f32::NORMAL | prop::num::f32::ZERO | prop::num::f32::SUBNORMAL;
        let stride = sh_coefficients(degree) * 3;
        (
            prop::collection::vec(prop::array::uniform3(finite()), n),
            prop::collection::vec(prop::array::uniform3(finite()), n),
            prop::collection::vec(prop::array::uniform4(0.1f32..1.0), n),
            prop::collection::vec(finite(), n),
            prop::collection::vec(finite(), n * stride),
        )
            .prop_map(move |(means, log_scales, rotations, opacity_logits, sh)| GaussianCloud {
                sh_degree: degree,
                means,
                log_scales,
                rotations,
                opacity_logits,
                sh,
            })
    })
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(64))]

    #[test]
    fn a_model_comes_back_bit_by_bit(cloud in cloud(), views in 0usize..3) {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("m.dgtr");
        model::write(&path, &header(views), &cloud).unwrap();
        let (head, back) = model::read(&path).unwrap();
        prop_assert_eq!(head, header(views));
        prop_assert_eq!(&back, &cloud);
        prop_assert_eq!(model::read_header(&path).unwrap(), (header(views), cloud.len()));
    }

    #[test]
    fn a_ply_comes_back_bit_by_bit_with_its_origin(cloud in cloud()) {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("m.ply");
        ply::write(&path, &cloud, header(0).origin).unwrap();
        let back = ply::read(&path).unwrap();
        prop_assert_eq!(&back.cloud, &cloud);
        prop_assert_eq!((back.origin, back.dropped), (header(0).origin, 0));
    }

    #[test]
    fn arbitrary_bytes_are_an_error_and_never_a_panic(bytes in prop::collection::vec(any::<u8>(), 0..200), with_magic: bool) {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("m");
        let model = if with_magic { [b"dgtr\r\n\x1a\n\x01\0\0\0".as_slice(), &bytes].concat() } else { bytes.clone() };
        std::fs::write(&path, model).unwrap();
        prop_assert!(model::read(&path).is_err());
        let text = if with_magic { [b"ply\nformat binary_little_endian 1.0\nelement vertex 3\n".as_slice(), &bytes].concat() } else { bytes };
        std::fs::write(&path, text).unwrap();
        prop_assert!(ply::read(&path).is_err());
    }
}

fn sample() -> GaussianCloud {
    let mut cloud = GaussianCloud::with_capacity(1, 2);
    for i in 0..2 {
        let sh: Vec<f32> = (0..12).map(|k| (100 * i + k) as f32).collect();
        cloud.push([i as f32, 2.0, 3.0], [-1.0, -2.0, -3.0], [0.5, 0.1, 0.2, 0.3], 0.7, &sh);
    }
    cloud
}

#[test]
fn a_model_with_any_bit_flipped_or_any_byte_missing_is_refused() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("m.dgtr");
    model::write(&path, &header(1), &sample()).unwrap();
    let whole = std::fs::read(&path).unwrap();
    for n in 0..whole.len() {
        std::fs::write(&path, &whole[..n]).unwrap();
        assert!(model::read(&path).is_err(), "cut to {n} bytes");
        let mut flipped = whole.clone();
        flipped[n] ^= 1 << (n % 8);
        std::fs::write(&path, &flipped).unwrap();
        assert!(model::read(&path).is_err(), "bit flipped in byte {n}");
    }
    std::fs::write(&path, [whole.as_slice(), b"x"].concat()).unwrap();
    assert!(model::read(&path).unwrap_err().to_string().contains("longer"));
    let last = whole.len() - 40;
    let mut flipped = whole.clone();
    flipped[last] ^= 1;
    std::fs::write(&path, &flipped).unwrap();
    assert!(matches!(model::read(&path), Err(FormatError::Damaged { .. })));
    std::fs::write(&path, &whole[..60]).unwrap();
    assert!(matches!(model::read(&path), Err(FormatError::Truncated { .. })));
}

#[test]
fn a_count_beyond_the_file_is_refused_before_memory_is_taken() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("m.dgtr");
    model::write(&path, &header(0), &sample()).unwrap();
    let mut bytes = std::fs::read(&path).unwrap();
    bytes[16..24].fill(0xff);
    std::fs::write(&path, &bytes).unwrap();
    assert!(matches!(model::read(&path), Err(FormatError::Truncated { .. })));
    bytes[12..16].fill(0xff);
    std::fs::write(&path, &bytes).unwrap();
    assert!(matches!(model::read(&path), Err(FormatError::TooLarge { .. })));
    let text =
        "ply\nformat binary_little_endian 1.0\nelement vertex 18446744073709551615\nproperty float x\nend_header\n";
    std::fs::write(&path, text).unwrap();
    assert!(ply::read(&path).is_err());
}

#[test]
fn gaussians_that_are_not_finite_are_dropped_on_reading() {
    let dir = tempfile::tempdir().unwrap();
    let mut cloud = sample();
    cloud.means[0][1] = f32::NAN;
    let path = dir.path().join("m.dgtr");
    model::write(&path, &header(0), &cloud).unwrap();
    assert_eq!(model::read(&path).unwrap().1.len(), 1);
    let path = dir.path().join("m.ply");
    ply::write(&path, &cloud, None).unwrap();
    let back = ply::read(&path).unwrap();
    assert_eq!((back.cloud.len(), back.dropped, back.origin), (1, 1, None));
}

#[test]
fn writing_over_a_model_replaces_it_and_leaves_no_other_file() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("deep/m.dgtr");
    model::write(&path, &header(0), &sample()).unwrap();
    model::write(&path, &header(2), &GaussianCloud::default()).unwrap();
    assert_eq!(model::read_header(&path).unwrap().1, 0);
    assert_eq!(std::fs::read_dir(path.parent().unwrap()).unwrap().count(), 1);
    let error = model::write(std::path::Path::new("/proc/m.dgtr"), &header(0), &sample()).unwrap_err().to_string();
    assert!(error.contains("/proc/m.dgtr") && !error.contains('\n'), "{error}");
}

#[test]
fn the_ply_has_the_names_and_the_channel_order_of_3dgs() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("m.ply");
    ply::write(&path, &sample(), None).unwrap();
    let bytes = std::fs::read(&path).unwrap();
    let end = bytes.windows(11).position(|w| w == b"end_header\n").unwrap() + 11;
    let names: Vec<&str> =
        std::str::from_utf8(&bytes[..end]).unwrap().lines().filter_map(|l| l.strip_prefix("property float ")).collect();
    let expected = "x y z nx ny nz f_dc_0 f_dc_1 f_dc_2 f_rest_0 f_rest_1 f_rest_2 f_rest_3 f_rest_4 f_rest_5 f_rest_6 \
                    f_rest_7 f_rest_8 opacity scale_0 scale_1 scale_2 rot_0 rot_1 rot_2 rot_3";
    assert_eq!(names.join(" "), expected);
    let row: Vec<f32> =
        bytes[end..end + 4 * names.len()].as_chunks().0.iter().map(|b| f32::from_le_bytes(*b)).collect();
    // Coefficients 1…3 of red, then of green, then of blue.
    assert_eq!(row[6..18], [0.0, 1.0, 2.0, 3.0, 6.0, 9.0, 4.0, 7.0, 10.0, 5.0, 8.0, 11.0]);
    assert_eq!(row[18..26], [0.7, -1.0, -2.0, -3.0, 0.5, 0.1, 0.2, 0.3]);
}

#[test]
fn a_plain_point_cloud_is_told_from_a_gaussian_model() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("m.ply");
    let names = "x y z scale_0 scale_1 scale_2 rot_0 rot_1 rot_2 rot_3 opacity";
    let properties: String = names.split(' ').map(|n| format!("property float {n}\n")).collect();
    std::fs::write(&path, format!("ply\nformat binary_little_endian 1.0\nelement vertex 0\n{properties}end_header\n"))
        .unwrap();
    assert!(ply::read(&path).unwrap_err().to_string().contains("not a Gaussian model"));
    std::fs::write(&path, "ply\nformat ascii 1.0\nend_header\n").unwrap();
    assert!(ply::read(&path).unwrap_err().to_string().contains("no vertices"));
}

#[test]
fn a_header_that_would_size_or_place_nonsense_is_refused_by_reader_and_writer() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("m.dgtr");
    let cloud = GaussianCloud::with_capacity(0, 0);
    let good = header(1);
    model::write(&path, &good, &cloud).unwrap();
    // What a stranger may send: the writer's own bytes with another header and a true checksum.
    let forged = |header: &ModelHeader| {
        let head = postcard::to_allocvec(header).unwrap();
        let mut bytes = std::fs::read(&path).unwrap()[..28].to_vec();
        bytes[12..16].copy_from_slice(&(head.len() as u32).to_le_bytes());
        bytes.extend(head);
        bytes.extend_from_slice(blake3::hash(&bytes).as_bytes());
        let file = dir.path().join("forged.dgtr");
        std::fs::write(&file, bytes).unwrap();
        file
    };
    assert_eq!(model::read(&forged(&good)).unwrap().0, good);
    let refuse = |header: ModelHeader, words: &str| {
        let file = forged(&header);
        for e in [
            model::read(&file).unwrap_err(),
            model::read_header(&file).unwrap_err(),
            model::write(&dir.path().join("own.dgtr"), &header, &cloud).unwrap_err(),
        ] {
            let e = e.to_string();
            assert!(e.contains(words) && !e.contains('\n'), "{e}");
        }
    };
    let view = |change: fn(&mut View)| {
        let mut header = good.clone();
        change(&mut header.views[0].1);
        header
    };
    // This one ended `dgtr serve` with a panic.
    let huge: u32 = (1 << 31) - 1;
    refuse(view(|v| (v.intrinsics.width, v.intrinsics.height) = ((1 << 31) - 1, (1 << 31) - 1)), &huge.to_string());
    refuse(view(|v| (v.intrinsics.width, v.intrinsics.height) = (16_384, 16_384)), "16384 x 16384");
    refuse(view(|v| v.intrinsics.width = 0), "0 x 48");
    refuse(view(|v| v.intrinsics.fx = 0.0), "v0.jpg");
    refuse(view(|v| v.intrinsics.cy = f32::NAN), "v0.jpg");
    refuse(view(|v| v.pose.center.z = f64::INFINITY), "v0.jpg");
    refuse(view(|v| v.pose.rotation = DQuat::from_xyzw(0.0, 0.0, 0.0, 0.0)), "v0.jpg");
    refuse(ModelHeader { region: vec![[0.0; 2]; 5000], ..good.clone() }, "5000 corners");
    refuse(ModelHeader { region: vec![[f64::NAN, 0.0]], ..good.clone() }, "region");
    refuse(ModelHeader { lights: vec![good.lights[0]; 3], ..good.clone() }, "the light of 3 of 1 views");
    let blinding = PictureLight { gain: [90.0; 3], ..good.lights[0] };
    refuse(ModelHeader { lights: vec![blinding], ..good.clone() }, "the light of 1 of 1 views");
    let origin = Some(Geodetic { lat_deg: 91.0, lon_deg: 0.0, alt_m: 0.0 });
    refuse(ModelHeader { origin, ..good.clone() }, "origin");
}

#[test]
fn a_ply_whose_numbers_are_bytes_is_refused_rather_than_blown_up() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("m.ply");
    ply::write(&path, &GaussianCloud::with_capacity(0, 0), None).unwrap();
    let bytes = std::fs::read(&path).unwrap();
    let text = String::from_utf8(bytes).unwrap().replace("property float opacity", "property uchar opacity");
    std::fs::write(&path, text).unwrap();
    let e = ply::read(&path).unwrap_err().to_string();
    assert!(e.contains("\"opacity\" is no float"), "{e}");
}

#[test]
fn a_ply_that_claims_more_vertices_than_it_holds_is_refused_before_memory_is_taken() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("m.ply");
    ply::write(&path, &GaussianCloud::with_capacity(0, 0), None).unwrap();
    let text = String::from_utf8(std::fs::read(&path).unwrap()).unwrap();
    for claimed in ["1", "4000000000", "9000000000000000000"] {
        let bomb = text.replace("element vertex 0", &format!("element vertex {claimed}"));
        assert_ne!(bomb, text);
        std::fs::write(&path, bomb).unwrap();
        let e = ply::read(&path).unwrap_err().to_string();
        assert!(e.contains("its vertices"), "{claimed}: {e}");
    }
}
