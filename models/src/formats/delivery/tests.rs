use super::*;
use crate::cloud::sh_coefficients;
use rand::{Rng, SeedableRng};
use rand_pcg::Pcg64;

/// Gaussians on a hilly ground, coloured by place, with a little of everything.
fn ground(n: usize, degree: u8) -> GaussianCloud {
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
        keep: 1.0,
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
fn the_default_rounding_takes_a_thirtieth_of_the_exact_columns() {
    let cloud = ground(20_000, 3);
    let (words, n) = encode(&cloud, &[], &Rounding::default()).unwrap();
    assert_eq!(n, 19_000, "the faintest twentieth is left out");
    // 236 bytes exact; noise in every coefficient costs more than a trained scene's.
    assert!(4 * words.len() < 20_000 * 14, "{} bytes per Gaussian", 4.0 * words.len() as f64 / 20_000.0);
}

#[test]
fn the_same_cloud_gives_the_same_words_and_rounding_twice_changes_little() {
    let cloud = ground(1000, 1);
    let encoded = encode(&cloud, &[], &Rounding::default()).unwrap();
    assert_eq!(encoded, encode(&cloud, &[], &Rounding::default()).unwrap());
    let once = decode(encoded.0, encoded.1, 1).unwrap();
    let twice = there_and_back(&once, &Rounding { keep: 1.0, ..Rounding::default() });
    assert_eq!(twice.len(), once.len());
}

#[test]
fn degenerate_clouds_come_back_whole() {
    let empty = GaussianCloud { sh_degree: 3, ..Default::default() };
    assert!(there_and_back(&empty, &Rounding::default()).is_empty());

    let mut same = GaussianCloud::default();
    (0..500).for_each(|_| same.push([5e6, -3e6, 10.0], [-2.0; 3], [1.0, 0.0, 0.0, 0.0], 0.0, &[0.5; 3]));
    let rounded = there_and_back(&same, &Rounding { keep: 1.0, ..Rounding::default() });
    assert_eq!(rounded.len(), 500);
    assert!(rounded.means.iter().all(|m| Vec3::from(*m).distance(Vec3::new(5e6, -3e6, 10.0)) <= 1.0));

    let mut odd = ground(400, 0);
    odd.means[7] = [f32::NAN; 3];
    odd.rotations[8] = [0.0; 4];
    odd.means[9] = [3e9, 0.0, 0.0];
    odd.log_scales[10] = [80.0, -80.0, 0.0];
    odd.opacity_logits[11] = 300.0;
    odd.sh[3 * 12] = 1e30;
    let rounded = there_and_back(&odd, &Rounding { keep: 1.0, ..Rounding::default() });
    assert_eq!(rounded.len(), 398, "two rows have no place");
    assert!((0..398).all(|i| rounded.is_valid(i)));
    assert!(rounded.means.contains(&[3e9, 0.0, 0.0]), "a stray one keeps its place, and costs the others nothing");
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
