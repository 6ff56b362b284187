use super::*;
use rand::{Rng, SeedableRng};

/// Matches of a nearly flat scene 40 m below a nadir camera that moved by `baseline` and turned by `turn`.
pub(crate) fn scene(baseline: DVec3, turn: DQuat, good: usize, wrong: usize, seed: u64) -> Vec<RayPair> {
    let mut rng = rand_pcg::Pcg64Mcg::seed_from_u64(seed);
    let mut noise = move |s: f64| rng.random_range(-s..s);
    let ray = |p: DVec3| p / p.z;
    let mut out = Vec::new();
    for _ in 0..good {
        let p = DVec3::new(noise(25.0), noise(18.0), 40.0 + noise(1.0));
        let b = ray(turn * (p - baseline));
        let jitter = DVec3::new(noise(1.0), noise(1.0), 0.0) / 400.0;
        out.push(RayPair { a: ray(p), b: b + jitter });
    }
    for _ in 0..wrong {
        let a = DVec3::new(noise(0.6), noise(0.45), 1.0);
        out.push(RayPair { a, b: DVec3::new(noise(0.6), noise(0.45), 1.0) });
    }
    out
}

const LIMITS: TwoViewLimits = TwoViewLimits {
    threshold: 2.0 / 400.0,
    min_inliers: 16,
    any_heading: false,
    rotation_sigma: 0.1,
    direction_sigma: 0.3,
    rounds: ROUNDS,
};
/// Nothing is believed but that the camera looks down.
const WIDE: TwoViewLimits = TwoViewLimits { any_heading: true, rotation_sigma: 0.3, direction_sigma: 2.0, ..LIMITS };

pub(crate) fn angle(a: DQuat, b: DQuat) -> f64 {
    so3::log(a.conjugate() * b).length().to_degrees()
}

#[test]
fn a_flat_scene_with_40_percent_wrong_matches_gives_the_pose_within_its_ambiguity() {
    for seed in 0..20 {
        let (baseline, turn) = (DVec3::new(10.0, 1.0, 0.3), so3::exp(DVec3::new(0.05, -0.04, 0.07)));
        let matches = scene(baseline, turn, 180, 120, seed);
        let prior = RelativePose { rotation: DQuat::IDENTITY, translation: -DVec3::X };
        let found = verify(&matches, prior, LIMITS).unwrap();
        assert!(angle(found.pose.rotation, turn) < 1.5, "{}", angle(found.pose.rotation, turn));
        let direction = (turn * -baseline).normalize();
        assert!(found.pose.translation.dot(direction).acos().to_degrees() < 7.0);
        assert!(found.inliers.iter().filter(|i| **i < 180).count() > 170);
        assert!(!found.rotation_only);
    }
}

#[test]
fn a_heading_that_is_off_by_half_a_turn_is_found_when_asked_for() {
    let (baseline, turn) = (DVec3::new(8.0, 0.0, 0.0), DQuat::from_rotation_z(3.1));
    let matches = scene(baseline, turn, 150, 60, 5);
    let prior = RelativePose { rotation: DQuat::IDENTITY, translation: -DVec3::X };
    let found = verify(&matches, prior, WIDE).unwrap();
    assert!(angle(found.pose.rotation, turn) < 1.5, "{}", angle(found.pose.rotation, turn));
}

#[test]
fn pure_rotation_is_verified_and_marked_as_without_baseline() {
    let turn = so3::exp(DVec3::new(0.1, 0.05, 0.1));
    let matches = scene(DVec3::ZERO, turn, 150, 40, 7);
    let prior = RelativePose { rotation: DQuat::IDENTITY, translation: -DVec3::X };
    let found = verify(&matches, prior, LIMITS).unwrap();
    assert!(found.rotation_only, "{}", found.inliers.len());
    assert!(angle(found.pose.rotation, turn) < 0.2);
}

#[test]
fn a_duplicate_picture_is_a_pair_without_baseline() {
    let matches: Vec<_> =
        scene(DVec3::X, DQuat::IDENTITY, 100, 0, 1).iter().map(|m| RayPair { a: m.a, b: m.a }).collect();
    let found = verify(&matches, RelativePose { rotation: DQuat::IDENTITY, translation: DVec3::X }, LIMITS).unwrap();
    assert!(found.rotation_only && found.inliers.len() == 100);
    assert!(angle(found.pose.rotation, DQuat::IDENTITY) < 1e-6);
}

#[test]
fn all_wrong_matches_are_not_verified() {
    for seed in 0..20 {
        let matches = scene(DVec3::X, DQuat::IDENTITY, 0, 300, seed);
        let prior = RelativePose { rotation: DQuat::IDENTITY, translation: DVec3::X };
        assert!(verify(&matches, prior, LIMITS).is_none());
        assert!(verify(&matches, prior, WIDE).is_none());
    }
}

#[test]
fn too_few_matches_are_no_pair() {
    let matches = scene(DVec3::X, DQuat::IDENTITY, 5, 0, 1);
    let prior = RelativePose { rotation: DQuat::IDENTITY, translation: DVec3::X };
    assert!(verify(&matches, prior, LIMITS).is_none() && verify(&[], prior, LIMITS).is_none());
}
