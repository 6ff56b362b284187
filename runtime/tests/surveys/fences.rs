//! Surveys of an area that is a fence: nothing that flies leaves it.

use super::*;

/// Corners around a middle as far away as chance has it: any of them may point inwards. The same ones for the same seed.
fn star(seed: u64, middle: DVec2, corners: u32, [least_m, most_m]: [f64; 2]) -> Vec<DVec2> {
    let chance = |k: u32| {
        let mixed = (seed * 1000 + u64::from(k) + 1).wrapping_mul(0x9E37_79B9_7F4A_7C15);
        ((mixed ^ (mixed >> 29)).wrapping_mul(0xBF58_476D_1CE4_E5B9) >> 11) as f64 / (1u64 << 53) as f64
    };
    let corner = |k: u32| {
        let angle = std::f64::consts::TAU * f64::from(k) / f64::from(corners);
        middle + DVec2::from_angle(angle) * (least_m + (most_m - least_m) * chance(k))
    };
    (0..corners).map(corner).collect()
}

/// An inclusion fence and an exclusion fence in it as a plan.
fn fences(inside: &[DVec2], outside: &[DVec2]) -> String {
    let ring = |corners: &[DVec2]| degrees(corners).into_iter().map(|[lon, lat]| [lat, lon]).collect::<Vec<_>>();
    let [inside, outside] = [inside, outside].map(ring);
    format!(
        r#"{{"fileType":"Plan","geoFence":{{"circles":[],"polygons":[{{"inclusion":true,"polygon":{inside:?},"version":1}},
            {{"inclusion":false,"polygon":{outside:?},"version":1}}],"version":2}}}}"#
    )
}

/// The plan's ways from take-off to landing, every metre or so, in metres around [`PLACE`].
fn way(plan: &Path) -> Vec<DVec2> {
    let plan = flight_plan::read(plan).expect("a plan");
    let frame = EnuFrame::new(PLACE);
    let ways = std::iter::once(plan.home).chain(plan.waypoints.iter().map(|w| w.position)).chain(plan.landing);
    let ways: Vec<DVec2> = ways.map(|at| frame.to_enu(at).truncate()).collect();
    let leg = |w: &[DVec2]| {
        let (from, to) = (w[0], w[1]);
        let steps = from.distance(to).ceil().max(1.0);
        (0..=steps as usize).map(move |k| from.lerp(to, k as f64 / steps))
    };
    ways.windows(2).flat_map(leg).collect()
}

#[test]
fn no_flight_leaves_a_fence_by_seed_nor_does_one_that_gets_what_another_left() {
    let folder = tempfile::tempdir().expect("a folder");
    let (mut planned, mut dealt) = (0, 0);
    for seed in 0..12 {
        let inside = star(seed, DVec2::ZERO, 5 + (seed % 9) as u32, [90.0, 420.0]);
        let hole = star(seed + 100, DVec2::splat(15.0), 4, [10.0, 40.0]);
        let at = |what: &str| folder.path().join(format!("{seed}-{what}"));
        std::fs::write(at("area.plan"), fences(&inside, &hole)).expect("written");
        let asked = request(&at("area.plan"), 2 + (seed % 2) as usize);
        // No flight is right where there is none: necks that are too narrow are refused.
        let first = match survey_job::run(&asked, &at("first")) {
            Ok(first) => first,
            Err(e) => {
                println!("seed {seed}: {e}");
                continue;
            }
        };
        planned += 1;
        let keeps = |plan: &Path| {
            for p in way(plan) {
                assert!(polygon::contains(&inside, p), "seed {seed}: {p} is outside of {inside:?}: {}", plan.display());
                assert!(off_m(&hole, p) > CLEARANCE_M - 0.05, "seed {seed}: {p} is near {hole:?}: {}", plan.display());
            }
        };
        first.rows.iter().for_each(|row| keeps(&row.plan));
        let mission = Mission::read(&at("first").join(MISSION)).expect("a mission");
        assert!(mission.survey.as_ref().is_some_and(|survey| survey.fence && survey.outside_enu.len() == inside.len()));
        for (k, row) in first.rows.iter().enumerate() {
            let mut views = flown(&row.plan, &mission, k as u64);
            if row.aircraft == "a2" {
                views.truncate(views.len() / 3);
            }
            delivered(&at("ground"), &mission, &row.aircraft, &views, row.aircraft != "a2");
        }
        // A small fence may be covered after a third of it.
        let Ok(rest) = Rest::of(&at("first").join(MISSION), &at("ground"), &["a2".into()]) else { continue };
        let (aircraft, camera) = (rest.aircraft(), rest.camera());
        let source = Source::Rest(Box::new(rest));
        let more = match survey_job::run(&Request { source, aircraft, camera, ..asked }, &at("second")) {
            Ok(more) => more,
            Err(e) => {
                // Too little is left for all of the others.
                println!("seed {seed}: {e}");
                continue;
            }
        };
        more.rows.iter().for_each(|row| keeps(&row.plan));
        assert_eq!(more.beyond_m, None);
        dealt += more.rows.len();
    }
    assert!(planned >= 10 && dealt >= 10, "{planned} planned, {dealt} more flights");
}
