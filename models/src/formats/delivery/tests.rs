use super::*;
use crate::cloud::sh_coefficients;
use rand::{Rng, SeedableRng};
use rand_pcg::Pcg64;

/// Gaussians on a hilly ground, coloured by place, with a little of everything.
pub(super) fn ground(n: usize, degree: u8) -> GaussianCloud {
    let mut rng = Pcg64::seed_from_u64(1);
    let mut cloud = GaussianCloud { sh_degree: degree, ..Default::default() };
    for _ in 0..n {
        let (x, y) = (rng.random_range(-40.0f32..40.0), rng.random_range(-40.0f32..40.0));
        let size: f32 = rng.random_range(-3.5..-1.0);
        let mut sh = vec![0.0; 3 * sh_coefficients(degree)];
        for (c, v) in sh[..3].iter_mut().enumerate() {
            *v = (0.1 * x + c as f32).sin() + 0.1 * rng.random_range(-1.0f32..1.0);
        }
        sh[3..].iter_mut().for_each(|v| *v = 0.05 * rng.random_range(-1.0f32..1.0));
        cloud.push(
            [x, y, (0.2 * x).sin() + (0.15 * y).cos()],
            std::array::from_fn(|_| size + rng.random_range(-0.8f32..0.8)),
            std::array::from_fn(|_| rng.random_range(-1.0f32..1.0)),
            rng.random_range(-2.0f32..4.0),
            &sh,
        );
    }
    cloud
}

/// The words of the cloud as one cell, and how many Gaussians they hold.
fn encode(cloud: &GaussianCloud, views: &[View], rounding: &Rounding) -> Result<(Vec<u32>, usize), Garbled> {
    let scope = Scope::of(cloud, rounding);
    Layer::of(cloud, views, rounding, &scope, &scope.rows).map(|layer| (layer.words, layer.count as usize))
}

fn there_and_back(cloud: &GaussianCloud, rounding: &Rounding) -> GaussianCloud {
    let (words, n) = encode(cloud, &[], rounding).unwrap();
    decode(words, n, cloud.sh_degree).unwrap()
}

/// The row of `cloud` nearest to each mean of `rounded`.
fn matched(cloud: &GaussianCloud, rounded: &GaussianCloud) -> Vec<usize> {
    let points: Vec<Vec3> = cloud.means.iter().map(|m| Vec3::from(*m)).collect();
    let tree = crate::align::nearest::KdTree::new(&points);
    let nearest = |m: &[f32; 3]| {
        let mut found = [(0.0, 0)];
        tree.nearest(Vec3::from(*m), None, &mut found);
        found[0].1 as usize
    };
    rounded.means.iter().map(nearest).collect()
}

#[test]
fn a_cloud_comes_back_within_its_steps() {
    let cloud = ground(3000, 2);
    let fine = Rounding {
        position: 0.01,
        shape: ShapeSteps { log_scale: 0.01, rotation_bits: 10, opacity_bits: 10 },
        color: ColorSteps { luma: 1e-3, chroma: 1.0, variation: 1e-3, by_importance: 0.0, rounding: 0.5 },
        ..Rounding::default()
    };
    let rounded = there_and_back(&cloud, &fine);
    assert_eq!(rounded.len(), 3000);
    let stride = cloud.sh_stride();
    for (to, from) in matched(&cloud, &rounded).into_iter().enumerate() {
        let apart = Vec3::from(rounded.means[to]).distance(Vec3::from(cloud.means[from]));
        assert!(apart < 0.01, "{apart} m");
        let sorted = |mut s: [f32; 3]| {
            s.sort_unstable_by(f32::total_cmp);
            s
        };
        let (a, b) = (sorted(rounded.log_scales[to]), sorted(cloud.log_scales[from]));
        assert!(a.iter().zip(b).all(|(a, b)| (a - b).abs() < 0.011), "{a:?} {b:?}");
        let opacity = |v: f32| 1.0 / (1.0 + (-v).exp());
        assert!((opacity(rounded.opacity_logits[to]) - opacity(cloud.opacity_logits[from])).abs() < 0.002);
        for (a, b) in rounded.sh[to * stride..(to + 1) * stride].iter().zip(&cloud.sh[from * stride..]) {
            assert!((a - b).abs() < 0.02, "{a} {b}");
        }
    }
}

#[test]
fn noise_in_every_coefficient_takes_less_than_fourteen_bytes_per_gaussian() {
    let cloud = ground(20_000, 3);
    let (words, n) = encode(&cloud, &[], &Rounding::default()).unwrap();
    assert_eq!(n, 20_000);
    // 236 bytes exact; a trained scene's take 6 to 9 (tests/BENCHMARKS.md).
    assert!(4 * words.len() < 20_000 * 14, "{} bytes per Gaussian", 4.0 * words.len() as f64 / 20_000.0);
}

#[test]
fn a_cloud_of_equal_gaussians_is_filled_up_to_what_its_reader_takes() {
    let mut cloud = GaussianCloud::with_capacity(0, 20_000);
    for _ in 0..20_000 {
        cloud.push([1.0, 2.0, 3.0], [-2.0; 3], [1.0, 0.0, 0.0, 0.0], 1.0, &[0.2; 3]);
    }
    let (words, n) = encode(&cloud, &[], &Rounding::default()).unwrap();
    assert!(n as u64 <= most_gaussians(4 * words.len() as u64), "{n} Gaussians in {} words", words.len());
    assert_eq!(decode(words, n, 0).unwrap().len(), n);
}

#[test]
fn the_same_cloud_gives_the_same_words() {
    let cloud = ground(1000, 1);
    let encoded = encode(&cloud, &[], &Rounding::default()).unwrap();
    assert_eq!(encoded, encode(&cloud, &[], &Rounding::default()).unwrap());
}

/// Squared error of the colours that the Gaussians show to a camera straight above them.
fn error_from_above(cloud: &GaussianCloud, rounded: &GaussianCloud) -> f64 {
    let up = crate::cloud::sh_basis([0.0, 0.0, -1.0]);
    let stride = cloud.sh_stride();
    let shown = |sh: &[f32], c: usize| {
        let varies: f64 = up.iter().zip(sh[3..].chunks_exact(3)).map(|(b, k)| b * f64::from(k[c])).sum();
        f64::from(crate::cloud::SH_C0) * f64::from(sh[c]) + varies
    };
    let of = |(to, from): (usize, usize)| {
        let (a, b) = (&rounded.sh[to * stride..(to + 1) * stride], &cloud.sh[from * stride..(from + 1) * stride]);
        (0..3).map(|c| (shown(a, c) - shown(b, c)).powi(2)).sum::<f64>()
    };
    matched(cloud, rounded).into_iter().enumerate().map(of).sum()
}

#[test]
fn colours_are_truest_from_where_the_scene_was_seen_and_cost_no_more() {
    use crate::camera::{Intrinsics, Pose};
    let cloud = ground(4000, 3);
    let intrinsics = Intrinsics { width: 640, height: 480, fx: 800.0, fy: 800.0, cx: 320.0, cy: 240.0 };
    let rotation = glam::DQuat::from_rotation_x(std::f64::consts::PI);
    let above = |i: u32| {
        let center = glam::DVec3::new(f64::from(i % 3) * 40.0 - 40.0, f64::from(i / 3) * 40.0 - 40.0, 100.0);
        View { intrinsics, pose: Pose { rotation, center } }
    };
    let views: Vec<View> = (0..9).map(above).collect();
    let rounding = Rounding { position: 0.01, ..Rounding::default() };
    let [seen, unseen] = [&views[..], &[]].map(|views| {
        let (words, n) = encode(&cloud, views, &rounding).unwrap();
        (words.len(), error_from_above(&cloud, &decode(words, n, 3).unwrap()))
    });
    assert!(seen.1 < 0.5 * unseen.1, "squared error {} with views, {} without", seen.1, unseen.1);
    assert!(seen.0 < unseen.0, "{} words with views, {} without", seen.0, unseen.0);
}

#[test]
fn degenerate_clouds_come_back_whole() {
    let empty = GaussianCloud { sh_degree: 3, ..Default::default() };
    assert!(there_and_back(&empty, &Rounding::default()).is_empty());

    let mut same = GaussianCloud::default();
    (0..500).for_each(|_| same.push([5e6, -3e6, 10.0], [-2.0; 3], [1.0, 0.0, 0.0, 0.0], 0.0, &[0.5; 3]));
    let rounded = there_and_back(&same, &Rounding::default());
    assert_eq!(rounded.len(), 500);
    assert!(rounded.means.iter().all(|m| Vec3::from(*m).distance(Vec3::new(5e6, -3e6, 10.0)) <= 1.0));

    let mut odd = ground(400, 0);
    odd.means[7] = [f32::NAN; 3];
    odd.rotations[8] = [0.0; 4];
    odd.means[9] = [3e9, 0.0, 0.0];
    odd.log_scales[10] = [80.0, -80.0, 0.0];
    odd.opacity_logits[11] = 300.0;
    odd.sh[3 * 12] = 1e30;
    let rounded = there_and_back(&odd, &Rounding::default());
    assert_eq!(rounded.len(), 398, "two rows have no place");
    assert!((0..398).all(|i| rounded.is_valid(i)));
    assert!(rounded.means.contains(&[3e9, 0.0, 0.0]), "an outlier keeps its place, and costs the others nothing");
    let far = rounded.means.iter().filter(|m| m.iter().any(|v| v.abs() > 41.0)).count();
    assert_eq!(far, 1);
}

#[test]
fn garbled_words_are_refused_or_give_a_cloud_of_the_stated_size() {
    let (words, n) = encode(&ground(300, 1), &[], &Rounding::default()).unwrap();
    let mut rng = Pcg64::seed_from_u64(2);
    let mut refused = 0;
    for _ in 0..300 {
        let mut damaged = words.clone();
        match rng.random_range(0..3) {
            0 => damaged.truncate(rng.random_range(0..words.len())),
            1 => damaged[rng.random_range(0..words.len())] ^= 1 << rng.random_range(0..32),
            _ => damaged.iter_mut().for_each(|w| *w = rng.random()),
        }
        match decode(damaged, n, 1) {
            Ok(cloud) => assert_eq!(cloud.len(), n),
            Err(Garbled) => refused += 1,
        }
    }
    assert!(refused > 20, "{refused}");
}
