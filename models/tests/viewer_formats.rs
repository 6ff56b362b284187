//! Promises of what goes to other viewers: SOG and glTF are read back by decoders of their own (zip and WebP crates, JSON), written
//! from the formats' specifications and not from our writers, and hold what was written within the formats' own steps.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic)] // a test may

use std::io::{Cursor, Read};
use std::path::Path;

use glam::{DQuat, DVec3};
use models::cloud::{GaussianCloud, sh_coefficients};
use models::formats::{gltf, sog};
use rand::{Rng, SeedableRng};
use serde_json::Value;

fn cloud(degree: u8, n: usize) -> GaussianCloud {
    let mut rng = rand_pcg::Pcg64Mcg::seed_from_u64(11);
    let mut cloud = GaussianCloud::with_capacity(degree, n);
    for _ in 0..n {
        let mut within = |a: f32| rng.random_range(-a..a);
        let mean = [1000.0 + within(60.0), within(80.0) - 300.0, within(9.0)];
        let log_scale = std::array::from_fn(|_| within(1.5) - 2.0);
        let rotation = std::array::from_fn(|_| within(1.0));
        let logit = within(4.0);
        let sh: Vec<f32> = (0..cloud.sh_stride()).map(|k| within(if k < 3 { 1.2 } else { 0.2 })).collect();
        cloud.push(mean, log_scale, rotation, logit, &sh);
    }
    cloud
}

fn turn(q: [f32; 4]) -> DQuat {
    DQuat::from_xyzw(q[1].into(), q[2].into(), q[3].into(), q[0].into()).normalize()
}

fn angle(a: [f32; 4], b: [f32; 4]) -> f64 {
    turn(a).angle_between(turn(b)).min(turn(a).angle_between(-turn(b)))
}

fn sigmoid(v: f32) -> f32 {
    1.0 / (1.0 + (-v).exp())
}

/// The texture `name` of an archive: width and RGBA.
fn texture(archive: &mut zip::ZipArchive<Cursor<Vec<u8>>>, name: &str) -> (usize, Vec<[u8; 4]>) {
    let mut bytes = Vec::new();
    archive.by_name(name).unwrap().read_to_end(&mut bytes).unwrap();
    let mut decoder = image_webp::WebPDecoder::new(Cursor::new(bytes)).unwrap();
    assert!(!decoder.is_lossy(), "{name}: a lossy picture would be another scene");
    let (width, _) = decoder.dimensions();
    let mut pixels = vec![0; decoder.output_buffer_size().unwrap()];
    decoder.read_image(&mut pixels).unwrap();
    let rgba = match decoder.has_alpha() {
        true => pixels.as_chunks::<4>().0.to_vec(),
        false => pixels.as_chunks::<3>().0.iter().map(|p| [p[0], p[1], p[2], 255]).collect(),
    };
    (width as usize, rgba)
}

/// Decodes SOG as PlayCanvas' specification says.
fn read_sog(bytes: &[u8]) -> (Value, GaussianCloud) {
    let mut archive = zip::ZipArchive::new(Cursor::new(bytes.to_vec())).unwrap();
    let mut meta = String::new();
    archive.by_name("meta.json").unwrap().read_to_string(&mut meta).unwrap();
    let meta: Value = serde_json::from_str(&meta).unwrap();
    assert_eq!(meta["version"], 2);
    let mut file = |v: &Value| texture(&mut archive, v.as_str().unwrap());
    let numbers = |v: &Value| v.as_array().unwrap().iter().map(|v| v.as_f64().unwrap() as f32).collect::<Vec<f32>>();
    let (low, high) = (file(&meta["means"]["files"][0]).1, file(&meta["means"]["files"][1]).1);
    let (mins, maxs) = (numbers(&meta["means"]["mins"]), numbers(&meta["means"]["maxs"]));
    let (scale, quats, sh0) =
        (file(&meta["scales"]["files"][0]).1, file(&meta["quats"]["files"][0]).1, file(&meta["sh0"]["files"][0]).1);
    let (scale_book, color_book) = (numbers(&meta["scales"]["codebook"]), numbers(&meta["sh0"]["codebook"]));
    assert_eq!((scale_book.len(), color_book.len()), (256, 256));
    let harmonics = meta.get("shN").map(|n| {
        let bands = n["bands"].as_u64().unwrap() as u8;
        (bands, file(&n["files"][0]), file(&n["files"][1]).1, numbers(&n["codebook"]), n["count"].as_u64().unwrap())
    });
    let degree = harmonics.as_ref().map_or(0, |h| h.0);
    let mut cloud = GaussianCloud::with_capacity(degree, 0);
    for i in 0..meta["count"].as_u64().unwrap() as usize {
        let mean = [0, 1, 2].map(|k| {
            let q = f32::from(low[i][k]) + 256.0 * f32::from(high[i][k]);
            let n = mins[k] + (maxs[k] - mins[k]) * (q / 65_535.0);
            n.signum() * (n.abs().exp() - 1.0)
        });
        let tag = usize::from(quats[i][3] - 252);
        let mut q = [0.0f32; 4];
        let part = |v: u8| (f32::from(v) / 255.0 - 0.5) * 2.0 / 2.0f32.sqrt();
        let others: Vec<usize> = (0..4).filter(|k| *k != tag).collect();
        others.iter().enumerate().for_each(|(k, o)| q[*o] = part(quats[i][k]));
        q[tag] = (1.0 - q.iter().map(|v| v * v).sum::<f32>()).max(0.0).sqrt();
        let alpha = (f32::from(sh0[i][3]) / 255.0).clamp(1e-6, 1.0 - 1e-6);
        let mut sh: Vec<f32> = (0..3).map(|k| color_book[usize::from(sh0[i][k])]).collect();
        if let Some((bands, (width, centroids), labels, book, count)) = &harmonics {
            let coefficients = sh_coefficients(*bands) - 1;
            let label = usize::from(labels[i][0]) + 256 * usize::from(labels[i][1]);
            assert!((label as u64) < *count);
            for j in 0..coefficients {
                let (u, v) = ((label % 64) * coefficients + j, label / 64);
                sh.extend((0..3).map(|c| book[usize::from(centroids[u + v * width][c])]));
            }
        }
        let scale = [0, 1, 2].map(|k| scale_book[usize::from(scale[i][k])]);
        cloud.push(mean, scale, q, (alpha / (1.0 - alpha)).ln(), &sh);
    }
    (meta, cloud)
}

/// The row of `of` whose mean is nearest: SOG sorts its Gaussians.
fn nearest(of: &GaussianCloud, to: DVec3) -> usize {
    let far = |m: &[f32; 3]| DVec3::from_array(m.map(f64::from)).distance_squared(to);
    (0..of.len()).min_by(|a, b| far(&of.means[*a]).total_cmp(&far(&of.means[*b]))).unwrap()
}

#[test]
fn sog_comes_back_within_the_steps_of_the_format() {
    for degree in 0..=3 {
        let cloud = cloud(degree, 500);
        let packed = sog::encode(Path::new("m.sog"), &cloud).unwrap();
        let (_, back) = read_sog(&packed.bytes);
        assert_eq!((back.len(), back.sh_degree, packed.count), (500, degree, 500));
        let mut seen = vec![false; 500];
        for i in 0..500 {
            let place = [0, 1, 2].map(|k| f64::from(back.means[i][k]) + f64::from(packed.shift[k]));
            let j = nearest(&cloud, place.into());
            assert!(!std::mem::replace(&mut seen[j], true), "two became one");
            // Half a step of 2 · ln(1 + 80 m) / 65,535 at 80 m from the middle.
            for k in 0..3 {
                assert!((place[k] - f64::from(cloud.means[j][k])).abs() < 0.006, "{} {}", place[k], cloud.means[j][k]);
                assert!((back.log_scales[i][k] - cloud.log_scales[j][k]).abs() < 0.02, "256 values for 3 of range");
            }
            // Half a byte of ±1/√2 in each of three components, and what that does to the fourth.
            assert!(angle(back.rotations[i], cloud.rotations[j]) < 0.02);
            assert!((sigmoid(back.opacity_logits[i]) - sigmoid(cloud.opacity_logits[j])).abs() < 0.0021);
            let stride = cloud.sh_stride();
            let (x, y) = (&back.sh[i * stride..(i + 1) * stride], &cloud.sh[j * stride..(j + 1) * stride]);
            assert!(x[..3].iter().zip(y).all(|(x, y)| (x - y).abs() < 0.015), "plain colours");
            // 256 rows stand for 500: a directional colour is rough, and nearer than none at all.
            let (error, size): (f32, f32) =
                x[3..].iter().zip(&y[3..]).fold((0.0, 0.0), |(e, s), (x, y)| (e + (x - y) * (x - y), s + y * y));
            assert!(degree == 0 || error < size, "{error} of {size}");
        }
    }
}

#[test]
fn directional_colours_are_exact_to_their_codebook_where_the_palette_holds_them_all() {
    // 64 different rows, 1,000 Gaussians.
    let mut cloud = cloud(2, 1000);
    let stride = cloud.sh_stride();
    for i in 64..1000 {
        let (head, tail) = cloud.sh.split_at_mut(i * stride);
        tail[3..stride].copy_from_slice(&head[(i % 64) * stride + 3..(i % 64 + 1) * stride]);
    }
    let packed = sog::encode(Path::new("m.sog"), &cloud).unwrap();
    let (meta, back) = read_sog(&packed.bytes);
    assert!(meta["shN"]["count"].as_u64().unwrap() <= 512);
    for i in 0..1000 {
        let j = nearest(&cloud, [0, 1, 2].map(|k| f64::from(back.means[i][k] + packed.shift[k])).into());
        let worst = (3..stride).map(|k| (back.sh[i * stride + k] - cloud.sh[j * stride + k]).abs()).fold(0.0, f32::max);
        assert!(worst < 0.004, "{worst}: 256 values for 0.4 of range");
    }
}

#[test]
fn the_same_cloud_gives_the_same_sog_and_what_cannot_be_packed_is_refused() {
    let cloud = cloud(1, 300);
    let path = Path::new("m.sog");
    assert_eq!(sog::encode(path, &cloud).unwrap().bytes, sog::encode(path, &cloud).unwrap().bytes);
    let mut broken = cloud.clone();
    broken.means[7][1] = f32::NAN;
    for bad in [GaussianCloud::with_capacity(0, 0), broken] {
        let dir = tempfile::tempdir().unwrap();
        assert!(sog::encode(path, &bad).is_err_and(|e| e.to_string().starts_with("m.sog: ")));
        assert!(gltf::write(&dir.path().join("m.glb"), &bad).is_err());
        assert_eq!(std::fs::read_dir(dir.path()).unwrap().count(), 0, "nothing half-written");
    }
}

#[test]
fn a_single_gaussian_is_a_scene() {
    let one = cloud(3, 1);
    let packed = sog::encode(Path::new("m.sog"), &one).unwrap();
    let (_, back) = read_sog(&packed.bytes);
    for k in 0..3 {
        assert!((back.means[0][k] + packed.shift[k] - one.means[0][k]).abs() < 1e-3);
    }
}

/// The floats of an accessor, as glTF 2.0 says.
fn accessor(json: &Value, binary: &[u8], name: &str, width: usize) -> Vec<f32> {
    let primitive = &json["meshes"][0]["primitives"][0];
    let accessor = &json["accessors"][primitive["attributes"][name].as_u64().unwrap() as usize];
    let shape = ["", "SCALAR", "", "VEC3", "VEC4"][width];
    assert_eq!((accessor["type"].as_str(), accessor["componentType"].as_u64()), (Some(shape), Some(5126)), "{name}");
    let view = &json["bufferViews"][accessor["bufferView"].as_u64().unwrap() as usize];
    let (at, n) = (view["byteOffset"].as_u64().unwrap() as usize, accessor["count"].as_u64().unwrap() as usize);
    assert_eq!(at % 4, 0, "aligned");
    assert_eq!(view["byteLength"], 4 * width * n);
    let (words, _) = binary[at..at + 4 * width * n].as_chunks::<4>();
    words.iter().map(|w| f32::from_le_bytes(*w)).collect()
}

#[test]
fn gltf_holds_every_number_and_turns_up_to_y() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("m.glb");
    for degree in [0, 3] {
        let cloud = cloud(degree, 40);
        gltf::write(&path, &cloud).unwrap();
        let file = std::fs::read(&path).unwrap();
        let word = |i: usize| u32::from_le_bytes(file[i..i + 4].try_into().unwrap()) as usize;
        assert_eq!((&file[..4], word(4), word(8)), (&b"glTF"[..], 2, file.len()));
        let json_bytes = word(12);
        assert_eq!((&file[16..20], json_bytes % 4, word(20 + json_bytes) % 4), (&b"JSON"[..], 0, 0));
        let json: Value = serde_json::from_slice(&file[20..20 + json_bytes]).unwrap();
        let binary = &file[28 + json_bytes..];
        assert_eq!(json["buffers"][0]["byteLength"], binary.len());
        let primitive = &json["meshes"][0]["primitives"][0];
        assert_eq!((&json["extensionsUsed"][0], &primitive["mode"]), (&"KHR_gaussian_splatting".into(), &0.into()));
        let splats = &primitive["extensions"]["KHR_gaussian_splatting"];
        assert_eq!((&splats["kernel"], &splats["colorSpace"]), (&"ellipse".into(), &"srgb_rec709_display".into()));
        let own = |name: &str, width| accessor(&json, binary, &format!("KHR_gaussian_splatting:{name}"), width);
        assert_eq!(accessor(&json, binary, "POSITION", 3), cloud.means.as_flattened());
        let (rotations, scales, opacities) = (own("ROTATION", 4), own("SCALE", 3), own("OPACITY", 1));
        for i in 0..40 {
            let [x, y, z, w] = rotations[4 * i..4 * i + 4].try_into().unwrap();
            assert!(angle([w, x, y, z], cloud.rotations[i]) < 1e-3);
            assert!(((x * x + y * y + z * z + w * w) - 1.0).abs() < 1e-5, "of unit length");
            (0..3).for_each(|k| assert!((scales[3 * i + k].ln() - cloud.log_scales[i][k]).abs() < 1e-5));
            assert!((opacities[i] - sigmoid(cloud.opacity_logits[i])).abs() < 1e-6);
        }
        let stride = cloud.sh_stride();
        for d in 0..=degree {
            for n in 0..=2 * d {
                let k = usize::from(d * d + n);
                let coefficient = own(&format!("SH_DEGREE_{d}_COEF_{n}"), 3);
                let expected: Vec<f32> =
                    (0..40).flat_map(|i| (0..3).map(move |c| i * stride + 3 * k + c)).map(|at| cloud.sh[at]).collect();
                assert_eq!(coefficient, expected);
            }
        }
        let node: Vec<f64> =
            json["nodes"][0]["rotation"].as_array().unwrap().iter().map(|v| v.as_f64().unwrap()).collect();
        let node = DQuat::from_array(node.try_into().unwrap());
        assert!((node * DVec3::Z - DVec3::Y).length() < 1e-9, "up is y");
        assert!((node * DVec3::Y + DVec3::Z).length() < 1e-9, "north is −z");
        assert!((node * DVec3::X - DVec3::X).length() < 1e-9, "east is x");
    }
}
