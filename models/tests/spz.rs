//! Promises of SPZ: what is written comes back within the format's rounding, another implementation reads the same
//! numbers and is read, and no file takes more memory than it has content.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic)] // a test may

use std::io::Write;
use std::path::Path;

use flate2::write::GzEncoder;
use models::cloud::GaussianCloud;
use models::formats::FormatError;
use models::formats::spz::{self as format, Axes, SpzModel, SpzOptions, SpzWritten};
use rand::{Rng, SeedableRng};

fn cloud(degree: u8, n: usize, extent: f32) -> GaussianCloud {
    let mut rng = rand_pcg::Pcg64Mcg::seed_from_u64(5);
    let mut cloud = GaussianCloud::with_capacity(degree, n);
    for _ in 0..n {
        let mut within = |a: f32| rng.random_range(-a..a);
        let mean = std::array::from_fn(|_| within(extent));
        let log_scale = std::array::from_fn(|_| within(4.0) - 1.0);
        let rotation = std::array::from_fn(|_| within(1.0));
        let logit = within(4.0);
        let sh: Vec<f32> = (0..cloud.sh_stride()).map(|_| within(0.9)).collect();
        cloud.push(mean, log_scale, rotation, logit, &sh);
    }
    cloud
}

/// The largest difference of each column, as (means, log scales, angle, opacity, DC, SH above).
fn differences(a: &GaussianCloud, b: &GaussianCloud) -> [f32; 6] {
    assert_eq!((a.len(), a.sh_degree), (b.len(), b.sh_degree));
    let far = |x: &[f32], y: &[f32]| x.iter().zip(y).fold(0.0f32, |m, (x, y)| m.max((x - y).abs()));
    let sigmoid = |v: &[f32]| v.iter().map(|v| 1.0 / (1.0 + (-v).exp())).collect::<Vec<_>>();
    let turn = |q: &[f32; 4]| glam::DQuat::from_xyzw(q[1].into(), q[2].into(), q[3].into(), q[0].into()).normalize();
    let angle = a
        .rotations
        .iter()
        .zip(&b.rotations)
        .fold(0.0f64, |m, (x, y)| m.max(turn(x).angle_between(turn(y)).min(turn(x).angle_between(-turn(y)))));
    let (mut dc, mut rest) = (0.0f32, 0.0f32);
    for (x, y) in a.sh.chunks_exact(a.sh_stride()).zip(b.sh.chunks_exact(b.sh_stride())) {
        dc = dc.max(far(&x[..3], &y[..3]));
        rest = rest.max(far(&x[3..], &y[3..]));
    }
    [
        far(a.means.as_flattened(), b.means.as_flattened()),
        far(a.log_scales.as_flattened(), b.log_scales.as_flattened()),
        angle as f32,
        far(&sigmoid(&a.opacity_logits), &sigmoid(&b.opacity_logits)),
        dc,
        rest,
    ]
}

/// Half a step of every column: 12 bits of a metre, 1/16, nine bits of 1/√2, 1/255, 1/(0.15 · 255), eighths after 128ths.
const ROUNDING: [f32; 6] = [1.23e-4, 0.0313, 0.004, 0.002, 0.0132, 0.0665];

/// In the model's own axes, so that numbers can be compared.
fn write(path: &Path, cloud: &GaussianCloud) -> Result<SpzWritten, FormatError> {
    format::write(path, cloud, SpzOptions { axes: Axes::Own, is_latest: false })
}

fn read(path: &Path) -> Result<SpzModel, FormatError> {
    format::read(path, Axes::Own)
}

fn within_rounding(a: &GaussianCloud, b: &GaussianCloud) {
    let d = differences(a, b);
    assert!(d.iter().zip(ROUNDING).all(|(d, limit)| *d <= limit), "{d:?}");
}

#[test]
fn what_is_written_comes_back_within_the_rounding_of_the_format() {
    let dir = tempfile::tempdir().unwrap();
    for degree in 0..=3 {
        let cloud = cloud(degree, 300, 500.0);
        let path = dir.path().join("m.spz");
        write(&path, &cloud).unwrap();
        let back = read(&path).unwrap();
        assert_eq!(back.dropped, 0);
        within_rounding(&cloud, &back.cloud);
        for options in [SpzOptions::default(), SpzOptions { axes: Axes::Rub, is_latest: true }] {
            assert_eq!(format::write(&path, &cloud, options).unwrap(), SpzWritten::default());
            within_rounding(&cloud, &format::read(&path, Axes::Rub).unwrap().cloud);
            let turned = format::read(&path, Axes::Own).unwrap().cloud;
            assert!((turned.means[7][1] + cloud.means[7][1]).abs() < 2e-4, "y points the other way");
        }
    }
    let empty = dir.path().join("none.spz");
    write(&empty, &GaussianCloud::with_capacity(2, 0)).unwrap();
    assert!(read(&empty).unwrap().cloud.is_empty());
}

#[test]
fn another_implementation_reads_the_same_numbers_and_is_read() {
    let dir = tempfile::tempdir().unwrap();
    let (ours, theirs) = (dir.path().join("ours.spz"), dir.path().join("theirs.spz"));
    let cloud = cloud(3, 200, 100.0);
    write(&ours, &cloud).unwrap();
    let splat = spz::GaussianSplat::load_packed_from_file(&ours, &spz::UnpackOptions::builder().build()).unwrap();
    let mut heard = GaussianCloud::with_capacity(3, 200);
    for i in 0..200 {
        let of = |column: &[f32], k: usize, width: usize| column[i * width + k];
        let (s, mut sh) = (&splat, Vec::new());
        sh.extend((0..3).map(|k| of(&s.colors, k, 3)));
        sh.extend((0..45).map(|k| of(&s.spherical_harmonics, k, 45)));
        let turn = [3, 0, 1, 2].map(|k| of(&s.rotations, k, 4));
        let three = |column: &[f32]| std::array::from_fn(|k| of(column, k, 3));
        heard.push(three(&s.positions), three(&s.scales), turn, s.alphas[i], &sh);
    }
    within_rounding(&cloud, &heard);
    splat.save_as_packed(&theirs, &spz::PackOptions::builder().build()).unwrap();
    let back = read(&theirs).unwrap().cloud;
    // Rounded twice: their buckets of SH end where ours have their middle.
    let d = differences(&heard, &back);
    assert!(d[..5].iter().zip(ROUNDING).all(|(d, limit)| *d <= limit) && d[5] <= 0.133, "{d:?}");
}

#[test]
fn a_scene_wider_than_two_kilometres_gives_up_precision_not_gaussians() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("wide.spz");
    let wide = cloud(0, 100, 50_000.0);
    write(&path, &wide).unwrap();
    assert!(differences(&wide, &read(&path).unwrap().cloud)[0] <= 0.5 / 128.0 + 0.01);
    let beyond = cloud(0, 100, 1e8);
    let said = write(&dir.path().join("no.spz"), &beyond).unwrap_err().to_string();
    assert!(said.contains("no.spz") && said.contains("ply"), "{said}");
    assert!(!dir.path().join("no.spz").exists());
}

#[test]
fn a_stray_gaussian_and_a_far_origin_cost_nobody_any_precision() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("m.spz");
    let mut scene = cloud(1, 300, 10.0);
    scene.means[5] = [2e5, -8e4, 1.6e5];
    let written = write(&path, &scene).unwrap();
    let near: Vec<u32> = (0..300).filter(|i| *i != 5).collect();
    let mut moved = read(&path).unwrap().cloud;
    moved.means.iter_mut().flatten().zip(written.shift.iter().cycle()).for_each(|(v, s)| *v += s);
    assert_eq!(written.strays, 1);
    within_rounding(&scene.rows(&near), &moved);
    // A map's easting and northing; single precision has them to 0.25 m.
    let mut far = cloud(1, 300, 10.0);
    far.means.iter_mut().for_each(|m| *m = [m[0] + 500_000.0, m[1] + 4_000_000.0, m[2] + 100.0]);
    let written = write(&path, &far).unwrap();
    assert!(written.strays == 0 && written.shift[1] > 3.9e6, "{written:?}");
    let back = read(&path).unwrap().cloud;
    let off = |i: usize, k: usize| (back.means[i][k] + written.shift[k] - far.means[i][k]).abs();
    assert!((0..300).all(|i| off(i, 0) < 0.04 && off(i, 1) < 0.3 && off(i, 2) < 2e-4));
}

fn packed(path: &Path, bytes: &[u8]) {
    let mut out = GzEncoder::new(std::fs::File::create(path).unwrap(), flate2::Compression::fast());
    out.write_all(bytes).unwrap();
    out.finish().unwrap();
}

#[test]
fn damage_is_one_line_that_names_the_file() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("m.spz");
    write(&path, &cloud(3, 50, 10.0)).unwrap();
    let whole = std::fs::read(&path).unwrap();
    let bad = dir.path().join("bad.spz");
    let refuse = |why: &str| {
        let said = read(&bad).expect_err(why).to_string();
        assert!(said.contains("bad.spz") && !said.contains('\n'), "{why}: {said}");
    };
    for cut in [0, 5, 40, whole.len() / 2] {
        std::fs::write(&bad, &whole[..cut]).unwrap();
        refuse("cut short");
    }
    std::fs::write(&bad, b"ply\nformat binary_little_endian 1.0\n").unwrap();
    refuse("no gzip");
    let head = |magic: u32, version: u32, count: u32, degree: u8, bits: u8| {
        [&magic.to_le_bytes()[..], &version.to_le_bytes(), &count.to_le_bytes(), &[degree, bits, 0, 0]].concat()
    };
    let magic = 0x5053_474E;
    for (bytes, why) in [
        (head(1, 3, 1, 0, 12), "another format"),
        (head(magic, 9, 1, 0, 12), "a version to come"),
        (head(magic, 3, 1, 7, 12), "an SH degree that is none"),
        (head(magic, 3, 1, 0, 40), "more bits than there are"),
        (head(magic, 3, u32::MAX, 3, 12), "more Gaussians than can be"),
        (head(magic, 3, 9_000_000, 3, 12), "Gaussians that are not there"),
    ] {
        packed(&bad, &bytes);
        refuse(why);
    }
}

#[test]
fn a_small_file_that_claims_and_holds_millions_of_gaussians_is_refused_before_it_is_unpacked() {
    // Ten million rows of zeros: 632 kB that became 2.96 GB.
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("bomb.spz");
    let mut out = GzEncoder::new(std::fs::File::create(&path).unwrap(), flate2::Compression::best());
    let count = 10_000_000u32;
    out.write_all(&0x5053_474E_u32.to_le_bytes()).unwrap();
    out.write_all(&3u32.to_le_bytes()).unwrap();
    out.write_all(&count.to_le_bytes()).unwrap();
    out.write_all(&[3, 12, 0, 0]).unwrap();
    let zeros = vec![0u8; 1 << 20];
    let body = 65 * count as usize;
    for at in (0..body).step_by(zeros.len()) {
        out.write_all(&zeros[..zeros.len().min(body - at)]).unwrap();
    }
    out.finish().unwrap();
    let size = std::fs::metadata(&path).unwrap().len();
    assert!(size < 1 << 20, "{size}");
    let e = read(&path).unwrap_err().to_string();
    assert!(e.contains("10000000") && e.contains(&size.to_string()), "{e}");
}
