use rand::{Rng, SeedableRng};
use rand_pcg::Pcg64Mcg;

use super::*;
use crate::ground::Ring;
use crate::ground::tests::rectangle;
use crate::pace::Pace;

fn manner() -> Manner {
    Manner { spacing_m: 18.0, beyond_m: 8.0, height_m: 60.0, pace: Pace::new(8.0, 4.0, 15.0).expect("a pace") }
}

fn fleet(count: usize, home: DVec2) -> Vec<Craft> {
    let craft = |k| Craft { id: format!("a{}", k + 1), home, battery_s: 900.0, crossing_m: 65.0 + 5.0 * k as f64 };
    (0..count).map(craft).collect()
}

fn polygon(corners: &[[f64; 2]]) -> Ring {
    corners.iter().map(|c| DVec2::from(*c)).collect()
}

/// A convex field of 20 ha, an L with a hole, and three kilometres of a river that bends.
pub(super) fn areas() -> [(&'static str, Ground); 3] {
    let convex = polygon(&[[0.0, 0.0], [420.0, -40.0], [560.0, 180.0], [380.0, 400.0], [60.0, 330.0]]);
    let l = polygon(&[[0.0, 0.0], [600.0, 0.0], [600.0, 200.0], [220.0, 200.0], [220.0, 500.0], [0.0, 500.0]]);
    let middle = |k: f64| DVec2::new(k * 2600.0, 420.0 * (k * 5.0).sin());
    let bank = |k: i32, side: f64| {
        let (a, b) = (middle(f64::from(k) / 40.0), middle((f64::from(k) + 0.5) / 40.0));
        a + (b - a).normalize().perp() * side
    };
    let river = (0..=40).map(|k| bank(k, -60.0)).chain((0..=40).rev().map(|k| bank(k, 60.0))).collect();
    let ground = |outside, holes: &[Ring]| Ground::new(outside, holes).expect("ground");
    [
        ("convex", ground(convex, &[])),
        ("L with a hole", ground(l, &[rectangle(80.0, 80.0, 70.0, 50.0)])),
        ("river", ground(river, &[])),
    ]
}

/// What every fleet must be: `deal` has checked that regions are the area; here by other means.
fn promised(name: &str, ground: &Ground, obstacles: &Obstacles, craft: &[Craft], shares: &[Share]) {
    let sum: f64 = shares.iter().map(|s| s.ground.area_m2()).sum();
    assert!((sum / ground.area_m2() - 1.0).abs() < 1e-3, "{name}: {sum} m²");
    let [low, high] = ground.bounds();
    let (mut inside, mut wrong) = (0, 0);
    for k in 0..4000u32 {
        // Hammersley points.
        let p =
            low + (high - low) * DVec2::new(f64::from(k) / 4000.0, f64::from(k.reverse_bits()) / f64::from(u32::MAX));
        let owners = shares.iter().filter(|s| s.ground.contains(p)).count();
        inside += usize::from(ground.contains(p));
        wrong += usize::from(owners != usize::from(ground.contains(p)));
    }
    assert!(wrong * 1000 <= inside, "{name}: {wrong} of {inside} places have no owner or several");
    let seconds: Vec<f64> = shares.iter().map(Share::seconds).collect();
    assert!(unequal(&seconds) <= UNEQUAL, "{name}: {seconds:.0?}");
    for (share, craft) in shares.iter().zip(craft) {
        assert!(share.sorties.iter().all(|s| s.seconds <= craft.battery_s + 1e-6), "{name}");
        assert!(share.spacing_m <= manner().spacing_m + 1e-9, "{name}");
        for path in share.sorties.iter().map(|s| s.path(craft.home)) {
            let over = path.windows(2).flat_map(|w| (0..=20).map(|k| w[0].lerp(w[1], f64::from(k) / 20.0)));
            assert_eq!(over.filter(|p| obstacles.hold(*p)).count(), 0, "{name}: places too near to a hole");
        }
    }
}

#[test]
fn three_areas_are_dealt_to_one_three_and_eight_aircraft_once_and_equally() {
    for (name, ground) in areas() {
        let home = ground.bounds()[0];
        for count in [1, 3, 8] {
            let craft = fleet(count, home);
            let holes: Vec<Ring> = ground.parts[0][1..].to_vec();
            let obstacles = Obstacles::new(&holes, 10.0).expect("obstacles");
            let shares =
                deal(&ground, &obstacles, &craft, &manner()).unwrap_or_else(|e| panic!("{name}, {count}: {e}"));
            promised(name, &ground, &obstacles, &craft, &shares);
            let seconds: Vec<f64> = shares.iter().map(Share::seconds).collect();
            println!(
                "{name} {:.1} ha, {count}: {seconds:.0?} {:.1} %",
                ground.area_m2() / 1e4,
                100.0 * unequal(&seconds)
            );
        }
    }
}

/// A star around a place; its sides do not cross.
fn star(random: &mut Pcg64Mcg, middle: DVec2, size: f64) -> Ring {
    let corners = random.random_range(3..14u32);
    let corner =
        |k: u32, far: f64| middle + DVec2::from_angle(std::f64::consts::TAU * f64::from(k) / f64::from(corners)) * far;
    (0..corners).map(|k| corner(k, size * random.random_range(0.25..1.0))).collect()
}

#[test]
fn a_hundred_areas_by_seed_are_dealt_once_and_equally_or_refused() {
    let mut dealt = 0;
    for seed in 0..100 {
        let random = &mut Pcg64Mcg::seed_from_u64(seed);
        let size = random.random_range(120.0..900.0);
        let outside = star(random, DVec2::new(300.0, -200.0), size);
        let count = random.random_range(0..3);
        let holes: Vec<Ring> = (0..count)
            .map(|_| {
                let at = DVec2::new(300.0, -200.0)
                    + DVec2::from_angle(random.random_range(0.0..6.0)) * random.random_range(0.0..size / 2.0);
                star(random, at, size / 8.0)
            })
            .collect();
        let Ok(ground) = Ground::new(outside, &holes) else { continue };
        let obstacles = Obstacles::new(&holes, random.random_range(2.0..8.0)).expect("obstacles");
        let mut homes = DVec2::new(random.random_range(-600.0..600.0), random.random_range(-600.0..600.0));
        while obstacles.hold(homes) {
            homes.x -= 50.0;
        }
        let craft = fleet(random.random_range(1..9), homes);
        match deal(&ground, &obstacles, &craft, &manner()) {
            Ok(shares) => {
                promised(&format!("seed {seed}"), &ground, &obstacles, &craft, &shares);
                dealt += 1;
            }
            Err(e) => println!("seed {seed}: {:.1} ha, {} aircraft: {e}", ground.area_m2() / 1e4, craft.len()),
        }
    }
    println!("{dealt} dealt");
    assert!(dealt >= 80, "{dealt} of 100");
}

#[test]
fn lines_are_never_further_apart_than_asked() {
    let narrow = Manner { spacing_m: 0.5, beyond_m: 0.5, ..manner() };
    let wide = Ground::new(rectangle(0.0, 0.0, 3000.0, 3000.0), &[]).expect("ground");
    let refused =
        deal(&wide, &Obstacles::default(), &fleet(1, DVec2::ZERO), &narrow).expect_err("6000 lines").to_string();
    assert!(refused.contains("too wide for lines 0.50 m apart"), "{refused}");
    // Along its length a strip is narrow enough.
    let long = Ground::new(rectangle(0.0, 0.0, 3000.0, 20.0), &[]).expect("ground");
    let craft = [Craft { battery_s: 1e9, ..fleet(1, DVec2::ZERO)[0].clone() }];
    let shares = deal(&long, &Obstacles::default(), &craft, &narrow).expect("40 lines");
    assert!(shares[0].spacing_m <= 0.5 + 1e-9 && shares[0].sorties[0].lines.len() == 40, "{}", shares[0].spacing_m);
}
