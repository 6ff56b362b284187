//! Clouds of Gaussians in the forms that other programs write: the same Gaussians from each. Files that other
//! programs wrote are the need `cases` of `tests/needs`.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic)] // a test may

use std::fmt::Write as _;
use std::path::Path;

use models::cloud::GaussianCloud;
use models::formats::splats::{self, Splats};
use models::formats::spz::{Axes, SpzOptions};
use models::formats::{gltf, ply, sog, spz};

fn read(path: &Path) -> Splats {
    splats::read(path, Axes::Rub).unwrap()
}

fn cloud(n: usize) -> GaussianCloud {
    let mut state = 7u64;
    let mut number = || {
        state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        (state >> 40) as f32 / (1u64 << 23) as f32 - 1.0
    };
    let mut cloud = GaussianCloud::with_capacity(2, n);
    for _ in 0..n {
        let sh: Vec<f32> = (0..27).map(|_| 0.5 * number()).collect();
        let mean = [(); 3].map(|()| 5.0 * number());
        cloud.push(mean, [(); 3].map(|()| number() - 3.0), [(); 4].map(|()| number()), number(), &sh);
    }
    cloud
}

/// A PLY of `cloud` in another encoding.
fn ply_as(cloud: &GaussianCloud, format: &str, without: &[&str], before: &str) -> Vec<u8> {
    let names = "x y z scale_0 scale_1 scale_2 rot_0 rot_1 rot_2 rot_3 opacity f_dc_0 f_dc_1 f_dc_2".split(' ');
    let rest = (0..24).map(|i| format!("f_rest_{i}"));
    let names: Vec<String> = names.map(str::to_owned).chain(rest).filter(|n| !without.contains(&n.as_str())).collect();
    let mut head = format!("ply\nformat {format} 1.0\n{before}element vertex {}\n", cloud.len());
    names.iter().for_each(|n| writeln!(head, "property float {n}").unwrap());
    head.push_str("end_header\n");
    let mut bytes = head.into_bytes();
    if !before.is_empty() {
        bytes.extend(if format == "ascii" { b"1 2\n".to_vec() } else { vec![0; 8] });
    }
    for i in 0..cloud.len() {
        let (m, s, q, sh) = (cloud.means[i], cloud.log_scales[i], cloud.rotations[i], &cloud.sh[27 * i..27 * i + 27]);
        let mut row: Vec<(String, f32)> = Vec::new();
        (0..3).for_each(|k| row.extend([(["x", "y", "z"][k].into(), m[k]), (format!("scale_{k}"), s[k])]));
        (0..4).for_each(|k| row.push((format!("rot_{k}"), q[k])));
        row.push(("opacity".into(), cloud.opacity_logits[i]));
        (0..3).for_each(|c| row.push((format!("f_dc_{c}"), sh[c])));
        (0..24).for_each(|j| row.push((format!("f_rest_{j}"), sh[3 * (j % 8 + 1) + j / 8])));
        let value = |name: &String| row.iter().find(|(n, _)| n == name).unwrap().1;
        for name in &names {
            match format {
                "ascii" => bytes.extend(format!("{:?} ", value(name)).into_bytes()),
                "binary_big_endian" => bytes.extend(value(name).to_be_bytes()),
                _ => bytes.extend(value(name).to_le_bytes()),
            }
        }
        if format == "ascii" {
            bytes.push(b'\n');
        }
    }
    bytes
}

/// Largest differences of means, log scales, rotations (1 - |cos| of half the angle), opacities and SH.
fn differences(a: &GaussianCloud, b: &GaussianCloud) -> [f32; 5] {
    assert_eq!((a.len(), a.sh_degree), (b.len(), b.sh_degree));
    let most = |d: &mut dyn Iterator<Item = f32>| {
        d.fold(0.0f32, |m, v| if v.is_nan() { f32::INFINITY } else { m.max(v.abs()) })
    };
    let flat =
        |a: &[[f32; 3]], b: &[[f32; 3]]| most(&mut a.iter().flatten().zip(b.iter().flatten()).map(|(a, b)| a - b));
    let unit = |q: [f32; 4]| glam::Quat::from_xyzw(q[1], q[2], q[3], q[0]).normalize();
    let opacity = |v: &f32| 1.0 / (1.0 + (-v).exp());
    [
        flat(&a.means, &b.means),
        flat(&a.log_scales, &b.log_scales),
        most(&mut a.rotations.iter().zip(&b.rotations).map(|(a, b)| 1.0 - unit(*a).dot(unit(*b)).abs())),
        most(&mut a.opacity_logits.iter().zip(&b.opacity_logits).map(|(a, b)| opacity(a) - opacity(b))),
        most(&mut a.sh.iter().zip(&b.sh).map(|(a, b)| a - b)),
    ]
}

#[test]
fn a_ply_says_the_same_in_either_byte_order_and_in_words() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("a.spz");
    let cloud = cloud(40);
    for format in ["binary_little_endian", "binary_big_endian", "ascii"] {
        for before in ["", "element extrinsic 1\nproperty float a\nproperty float b\n"] {
            std::fs::write(&path, ply_as(&cloud, format, &[], before)).unwrap();
            let found = read(&path);
            assert_eq!((found.form, found.dropped, &found.cloud), ("PLY", 0, &cloud), "{format} {before}");
        }
    }
    // Rows of nothing are none.
    let empty = "element none 9000000000000000000\n";
    let bytes = ply_as(&cloud, "binary_little_endian", &[], empty);
    let head = bytes.windows(11).position(|w| w == b"end_header\n").unwrap() + 11;
    std::fs::write(&path, [&bytes[..head], &bytes[head + 8..]].concat()).unwrap();
    assert_eq!(read(&path).cloud, cloud);
    let whole = ply_as(&cloud, "ascii", &[], "");
    std::fs::write(&path, &whole[..whole.len() * 2 / 3]).unwrap();
    let error = splats::read(&path, Axes::Rub).unwrap_err().to_string();
    assert!(error.contains("a.spz") && !error.contains('\n'), "{error}");
}

#[test]
fn two_scales_are_a_flat_gaussian_and_infinities_are_what_they_mean() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("a.ply");
    let mut cloud = cloud(10);
    std::fs::write(&path, ply_as(&cloud, "binary_little_endian", &["scale_2"], "")).unwrap();
    let flat = read(&path).cloud;
    assert_eq!((&flat.means, flat.len()), (&cloud.means, 10));
    assert!(flat.log_scales.iter().all(|s| s[2].is_finite() && s[2] < -15.0));
    cloud.log_scales[1][2] = f32::NEG_INFINITY;
    (cloud.opacity_logits[2], cloud.opacity_logits[3]) = (f32::INFINITY, f32::NEG_INFINITY);
    cloud.log_scales[4][0] = f32::INFINITY;
    ply::write(&path, &cloud, None).unwrap();
    let found = read(&path);
    assert_eq!((found.dropped, found.cloud.len()), (1, 9), "no Gaussian is everywhere");
    assert!(found.cloud.log_scales[1][2] < -15.0 && found.cloud.opacity_logits[2] > 10.0);
    assert!(found.cloud.opacity_logits[3] < -10.0);
}

#[test]
fn our_own_exports_come_back_whatever_they_are_called() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("scene.bin");
    let cloud = cloud(500);
    gltf::write(&path, &cloud).unwrap();
    let found = read(&path);
    assert_eq!((found.form, &found.cloud.means, &found.cloud.sh), ("glTF", &cloud.means, &cloud.sh));
    assert!(
        differences(&cloud, &found.cloud)[..4].iter().all(|d| *d < 1e-5),
        "{:?}",
        differences(&cloud, &found.cloud)
    );
    for is_latest in [false, true] {
        spz::write(&path, &cloud, SpzOptions { axes: Axes::Rub, is_latest }).unwrap();
        let found = read(&path);
        let d = differences(&cloud, &found.cloud);
        assert!(found.form == "SPZ" && d[0] < 2e-4 && d[4] < 0.07, "{d:?}");
    }
    let shift = sog::write(&path, &cloud).unwrap().shift;
    let mut found = read(&path);
    assert_eq!((found.form, found.dropped), ("SOG", 0));
    found.cloud.means.iter_mut().for_each(|m| *m = [0, 1, 2].map(|k| m[k] + shift[k]));
    // Rows come in Morton order: each has its like among ours.
    for i in (0..500).step_by(25) {
        let away = |j: usize| (0..3).map(|k| (found.cloud.means[i][k] - cloud.means[j][k]).abs()).fold(0.0, f32::max);
        let j = (0..500).min_by(|a, b| away(*a).total_cmp(&away(*b))).unwrap();
        let d = differences(&cloud.rows(&[j as u32]), &found.cloud.rows(&[i as u32]));
        assert!(d[0] < 1e-3 && d[1] < 0.05 && d[2] < 1e-3 && d[3] < 0.01, "{i}: {d:?}");
        let plain = |c: &GaussianCloud, i: usize| [0, 1, 2].map(|k| c.sh[27 * i + k]);
        assert!(plain(&cloud, j).iter().zip(plain(&found.cloud, i)).all(|(a, b)| (a - b).abs() < 0.02));
    }
}

#[test]
fn splat_files_are_told_from_others_of_that_name() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("a.splat");
    let mut bytes = Vec::new();
    for i in 0..20 {
        [i as f32, 1.0, -2.0, 0.1, 0.2, 0.0].iter().for_each(|v| bytes.extend(v.to_le_bytes()));
        bytes.extend([255, 128, 0, 200, 255, 128, 128, 128]);
    }
    std::fs::write(&path, &bytes).unwrap();
    let found = read(&path);
    assert_eq!((found.form, found.cloud.len(), found.cloud.means[3]), (".splat", 20, [3.0, 1.0, -2.0]));
    assert!((found.cloud.log_scales[0][1] - 0.2f32.ln()).abs() < 1e-6 && found.cloud.log_scales[0][2] < -15.0);
    assert!((found.cloud.color(0)[0] - 1.0).abs() < 1e-6 && found.cloud.rotations[0][0] > 0.99);
    for other in [b"not a splat file at all, but a text of 64 bytes that nobody reads!".to_vec(), vec![1, 2, 3], vec![]]
    {
        std::fs::write(&path, other).unwrap();
        let error = splats::read(&path, Axes::Rub).unwrap_err().to_string();
        assert!(error.contains("a.splat") && !error.contains('\n'), "{error}");
    }
}

#[test]
fn files_of_other_programs_hold_the_same_gaussians() {
    let Some(folder) = needs::shared("field/splats") else { return };
    let of = |name: &str| read(&folder.join(name));
    let reference = of("ref_le.ply").cloud;
    assert_eq!(of("big_endian.ply").cloud, reference);
    assert!(of("mip_comment.ply").is_antialiased && of("antialiased_flag.spz").is_antialiased);
    assert!(!of("ref_le.ply").is_antialiased && !of("st_ref_v3.spz").is_antialiased);
    let flat = of("2dgs_two_scales.ply");
    assert_eq!((flat.cloud.len(), &flat.cloud.means), (200, &reference.means));
    let limits = of("inf_scale_opacity.ply");
    assert_eq!((limits.cloud.len(), limits.dropped), (200, 0));
    // Written by splat-transform 2.7.1, which turns SPZ to right, up, back; rows come in another order.
    for (name, rounding) in [
        ("st_ref_v3.spz", [2e-4, 0.04, 2e-4, 0.005, 0.1]),
        ("spz_v4_from_splat-transform.spz", [2e-4, 0.04, 2e-4, 0.005, 0.1]),
        ("st_ref.compressed.ply", [6e-3, 0.01, 1e-5, 0.005, 0.02]),
    ] {
        let found = of(name).cloud;
        assert_eq!(found.len(), 200, "{name}");
        for i in 0..200 {
            let away = |j: usize| (0..3).map(|k| (found.means[i][k] - reference.means[j][k]).abs()).fold(0.0, f32::max);
            let j = (0..200).min_by(|a, b| away(*a).total_cmp(&away(*b))).unwrap();
            let d = differences(&reference.rows(&[j as u32]), &found.rows(&[i as u32]));
            assert!(d.iter().zip(rounding).all(|(d, most)| *d <= most), "{name} {i}: {d:?}");
        }
    }
}

/// What a stranger's file claims is held against its size before anything is allocated.
#[test]
fn a_small_sog_that_claims_a_city_is_refused() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("m.sog");
    sog::write(&path, &cloud(50)).unwrap();
    let mut entries = zip::ZipArchive::new(std::fs::File::open(&path).unwrap()).unwrap();
    let rewritten = |entries: &mut zip::ZipArchive<std::fs::File>, count: u64| {
        let mut out = zip::ZipWriter::new(std::io::Cursor::new(Vec::new()));
        for i in 0..entries.len() {
            let mut entry = entries.by_index(i).unwrap();
            let mut bytes = Vec::new();
            std::io::copy(&mut entry, &mut bytes).unwrap();
            if entry.name() == "meta.json" {
                let mut meta: serde_json::Value = serde_json::from_slice(&bytes).unwrap();
                meta["count"] = count.into();
                bytes = serde_json::to_vec(&meta).unwrap();
            }
            out.start_file(entry.name(), zip::write::SimpleFileOptions::default()).unwrap();
            std::io::Write::write_all(&mut out, &bytes).unwrap();
        }
        out.finish().unwrap().into_inner()
    };
    for (count, said) in [(9_000_000, "number of Gaussians"), (60_000, "too small")] {
        let other = dir.path().join("claims.sog");
        std::fs::write(&other, rewritten(&mut entries, count)).unwrap();
        let error = splats::read(&other, Axes::Rub).unwrap_err().to_string();
        assert!(error.contains(said) && !error.contains('\n'), "{error}");
    }
}

#[test]
fn rows_of_text_with_more_numbers_than_properties_or_without_end_are_refused() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("m.ply");
    let whole = String::from_utf8(ply_as(&cloud(3), "ascii", &[], "")).unwrap();
    for (line, said) in [("1 ".to_owned(), "numbers of"), (" ".repeat(10_000), "longer than")] {
        std::fs::write(&path, whole.replacen("end_header\n", &format!("end_header\n{line}"), 1)).unwrap();
        let error = splats::read(&path, Axes::Rub).unwrap_err().to_string();
        assert!(error.contains(said) && !error.contains('\n'), "{error}");
    }
}
