//! Two dates of one place: what came and went is found with its volume, and where nothing changed nothing is.

#![allow(clippy::expect_used, clippy::unwrap_used, reason = "a test fails by panicking")]

use glam::{DVec2, DVec3};
use measure::change::{Change, Dated, find};
use measure::heights::Heights;

const GSD: f64 = 0.1;
const SIDE: usize = 800;

/// Numbers of one seed, normal, agreeing within a box.
fn noise(seed: u64, blur: usize, sigma: f64) -> Vec<f64> {
    let mut state = seed.wrapping_mul(0x9e37_79b9_7f4a_7c15) | 1;
    let mut uniform = move || {
        state ^= state << 13;
        state ^= state >> 7;
        state ^= state << 17;
        (state >> 11) as f64 / (1u64 << 53) as f64
    };
    let padded = SIDE + 2 * blur;
    let white: Vec<f64> =
        (0..padded * padded).map(|_| (0..6).map(|_| uniform() - 0.5).sum::<f64>() * 2f64.sqrt()).collect();
    let side = 2 * blur + 1;
    let rows: Vec<f64> =
        (0..padded * SIDE).map(|i| (0..side).map(|k| white[i / SIDE * padded + i % SIDE + k]).sum()).collect();
    let scale = sigma / side as f64;
    (0..SIDE * SIDE).map(|i| (0..side).map(|k| rows[(i / SIDE + k) * SIDE + i % SIDE]).sum::<f64>() * scale).collect()
}

/// Hills, six houses, rough bushes.
fn ground(p: DVec2) -> f64 {
    let hills = 1.5 * (p.x / 11.0).sin() + 1.0 * (p.y / 7.0 + p.x / 23.0).cos();
    let house = |at: DVec2| if (p - at).abs().max_element() < 4.0 { 5.0 } else { 0.0 };
    let houses: f64 = [[15.0, 15.0], [35.0, 15.0], [60.0, 20.0], [20.0, 60.0], [62.0, 62.0], [45.0, 42.0]]
        .map(|c| house(c.into()))
        .iter()
        .sum();
    let bush = if p.distance(DVec2::new(70.0, 40.0)) < 5.0 { 1.0 + (p.x * 5.0).sin() * (p.y * 6.0).cos() } else { 0.0 };
    hills + houses + bush
}

/// A cone of a volume, as high as a third of its radius.
fn heap(p: DVec2, at: [f64; 2], m3: f64) -> f64 {
    let radius = (9.0 * m3 / std::f64::consts::PI).cbrt();
    (radius / 3.0 * (1.0 - p.distance(at.into()) / radius)).max(0.0)
}

fn map(seed: u64, blur: usize, sigma: f64, shift: DVec3, of: impl Fn(DVec2) -> f64) -> Dated {
    let errors = noise(seed, blur, sigma);
    let corner = DVec2::new(0.0, SIDE as f64 * GSD);
    let value = |i: usize| {
        let p = corner + DVec2::new((i % SIDE) as f64 + 0.5, -((i / SIDE) as f64) - 0.5) * GSD;
        (of(p - shift.truncate()) + shift.z + errors[i]) as f32
    };
    let heights = Heights::new(corner, GSD, [SIDE, SIDE], (0..SIDE * SIDE).map(value).collect()).unwrap();
    Dated { heights, sigmas: None }
}

/// The standard deviations of a map, by place.
fn sigmas(of: impl Fn(DVec2) -> f64) -> Option<Heights> {
    let corner = DVec2::new(0.0, SIDE as f64 * GSD);
    let place = |i: usize| corner + DVec2::new((i % SIDE) as f64 + 0.5, -((i / SIDE) as f64) - 0.5) * GSD;
    Heights::new(corner, GSD, [SIDE, SIDE], (0..SIDE * SIDE).map(|i| of(place(i)) as f32).collect())
}

fn at(change: &Change, place: [f64; 2]) -> Option<&measure::change::spots::Spot> {
    change.spots.iter().find(|s| s.middle.distance(place.into()) < 1.5)
}

#[test]
fn heaps_a_house_a_trench_and_a_tree_that_went_are_found_with_their_volumes_and_nothing_else() {
    let shift = DVec3::new(1.6, -1.1, 2.0);
    let (mut within, mut heaps) = (0, 0);
    for seed in 0..4 {
        let before = |p: DVec2| ground(p) + if p.distance(DVec2::new(30.0, 40.0)) < 1.5 { 6.0 } else { 0.0 };
        let after = |p: DVec2| {
            let house = if (p - DVec2::new(50.0, 65.0)).abs().max_element() < 3.0 { 4.0 } else { 0.0 };
            let trench = if (p.x - 25.0).abs() < 0.25 && (p.y - 30.0).abs() < 5.0 { -0.5 } else { 0.0 };
            ground(p) + heap(p, [45.0, 28.0], 40.0) + heap(p, [8.0, 40.0], 4.0) + house + trench
        };
        let old = map(2 * seed + 1, 2, 0.04, DVec3::ZERO, before);
        let new = map(2 * seed + 2, 2, 0.04, shift, after);
        let change = find(&old, &new).unwrap();
        let moved = DVec3::from(change.registration.shift_m);
        assert!((moved - shift).abs().max_element() < 0.05, "{:?}", change.registration);
        let moved = |x: f64, y: f64| [x + shift.x, y + shift.y];
        for (place, m3) in [(moved(45.0, 28.0), 40.0), (moved(8.0, 40.0), 4.0)] {
            let spot = at(&change, place).unwrap_or_else(|| panic!("{seed}: no heap of {m3} m³"));
            heaps += 1;
            within += u32::from((spot.volume_m3.value - m3).abs() <= 2.0 * spot.volume_m3.sigma);
            assert!(
                (spot.volume_m3.value / m3 - 1.0).abs() < 0.15 && spot.volume_m3.sigma < 0.25 * m3,
                "{seed}: {spot:?}"
            );
        }
        let house = at(&change, moved(50.0, 65.0)).expect("the house");
        assert!(
            (house.volume_m3.value / 144.0 - 1.0).abs() < 0.1 && (house.area_m2 / 36.0 - 1.0).abs() < 0.15,
            "{house:?}"
        );
        let tree = at(&change, moved(30.0, 40.0)).expect("the tree");
        assert!(tree.volume_m3.value < -30.0, "{tree:?}");
        let all: Vec<_> = change.spots.iter().map(|s| (s.middle, s.volume_m3)).collect();
        assert!(
            at(&change, moved(25.0, 30.0)).is_some_and(|t| t.volume_m3.value < -1.5),
            "{seed}: the trench: {all:?} {:?}",
            change.registration
        );
        let found: Vec<_> = change.spots.iter().map(|s| (s.middle, s.volume_m3)).collect();
        assert_eq!(found.len(), 5, "{seed}: {found:?}");
    }
    assert!(within * 20 >= 19 * heaps - 20, "{within} of {heaps} within two standard deviations");
}

#[test]
fn where_nothing_changed_nothing_is_found_whatever_the_maps_are_off_by() {
    for (seed, blur, sigma) in [(1, 0, 0.03), (2, 2, 0.05), (3, 4, 0.05), (4, 2, 0.15)] {
        let shift = DVec3::new(-2.0, 1.3, -1.7);
        let old = map(10 * seed, blur, sigma, DVec3::ZERO, ground);
        let new = map(10 * seed + 1, blur, sigma, shift, ground);
        let change = find(&old, &new).unwrap();
        assert!(
            change.spots.is_empty(),
            "{seed}: {:?}",
            change.spots.iter().map(|s| (s.middle, s.volume_m3)).collect::<Vec<_>>()
        );
        assert!(change.registration.unchanged > 0.8, "{:?}", change.registration);
    }
}

#[test]
fn what_one_of_the_two_did_not_see_is_not_said_to_have_changed() {
    let old = map(1, 2, 0.04, DVec3::ZERO, |p| if p.x < 20.0 { f64::NAN } else { ground(p) });
    let new = map(2, 2, 0.04, DVec3::ZERO, |p| ground(p) + heap(p, [10.0, 40.0], 40.0) + heap(p, [50.0, 55.0], 40.0));
    let change = find(&old, &new).unwrap();
    assert_eq!(change.spots.len(), 1);
    assert!(at(&change, [50.0, 55.0]).is_some());
    let unseen = change.difference.metres.iter().filter(|m| m.is_nan()).count();
    assert!((198..=200).contains(&(unseen / SIDE)), "{unseen}");
}

#[test]
fn what_a_map_itself_doubts_or_does_not_vouch_for_is_no_change() {
    let [doubted, unknown, sure] = [[50.0, 55.0], [10.0, 40.0], [45.0, 28.0]];
    let heaps = |p: DVec2| [doubted, unknown, sure].map(|at| heap(p, at, 40.0)).iter().sum::<f64>();
    let near = |p: DVec2, at: [f64; 2]| p.distance(at.into()) < 6.0;
    let worth = |p: DVec2| if near(p, doubted) { 1.5 } else { 0.04 };
    let old = map(1, 2, 0.04, DVec3::ZERO, ground);
    let mut new = map(2, 2, 0.04, DVec3::ZERO, |p| ground(p) + heaps(p));
    assert_eq!(find(&old, &new).unwrap().spots.len(), 3);
    new.sigmas = sigmas(|p| if near(p, unknown) { f64::NAN } else { worth(p) });
    for old_says in [None, sigmas(|_| 0.04)] {
        let change = find(&Dated { heights: old.heights.clone(), sigmas: old_says }, &new).unwrap();
        let all: Vec<_> = change.spots.iter().map(|s| (s.middle, s.volume_m3)).collect();
        assert!(all.len() == 1 && at(&change, sure).is_some(), "{all:?}");
        let unseen = change.difference.metres.iter().filter(|m| m.is_nan()).count() as f64 * GSD * GSD;
        assert!((unseen / (36.0 * std::f64::consts::PI) - 1.0).abs() < 0.02, "{unseen} m²");
    }
    new.sigmas = sigmas(|_| f64::NAN);
    assert!(find(&old, &new).err().unwrap().to_string().contains("nothing vouches"));
}

#[test]
fn maps_of_two_places_are_refused() {
    let flat = map(1, 0, 0.03, DVec3::ZERO, |p| p.x * 0.01);
    let nothing = map(2, 0, 0.03, DVec3::ZERO, |_| f64::NAN);
    assert!(find(&flat, &nothing).err().unwrap().to_string().contains("too little ground in common"));
    let wild = map(3, 0, 30.0, DVec3::ZERO, |p| if (p.x * 3.0).sin() > 0.0 { 500.0 } else { 0.0 });
    let other = map(4, 0, 0.03, DVec3::ZERO, |p| if (p.x * 3.0).sin() > 0.2 { 0.0 } else { 300.0 });
    let change = find(&wild, &other);
    assert!(change.is_err() || change.unwrap().spots.is_empty());
}
