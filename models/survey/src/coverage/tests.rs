//! Promises of the map: what is seen is counted where it lies, what is not is found, and nothing else is.

use geometry::geodesy::Geodetic;
use glam::{DQuat, DVec2, DVec3};
use serde_json::Value;

use super::gaps::{self, GapKind};
use super::reflight;
use super::testing::{LENS, map, rectangle, survey, view};
use super::*;

const SIZE: DVec2 = DVec2::new(120.0, 90.0);

fn seen(map: &CoverageMap, views: &[View]) -> CoverageMap {
    let mut map = map.clone();
    views.iter().for_each(|v| map.add(v));
    map
}

/// The square around (east, north).
fn at(map: &CoverageMap, p: DVec2) -> CellReport {
    let place = (p - map.grid().corner) / map.grid().side_m;
    map.cell(place.x as usize, place.y as usize).expect("in the region")
}

#[test]
fn a_whole_survey_has_no_gap_and_needs_no_other_flight() {
    for pitch in [-90.0, -60.0] {
        let flown = survey(DVec2::ZERO - 25.0, SIZE + 50.0, pitch);
        let map = seen(&map(&rectangle(DVec2::ZERO, SIZE)), &flown);
        assert_eq!((map.covered_share(), gaps::find(&map)), (1.0, vec![]), "{pitch}");
        assert_eq!(reflight::plan(&map, &[], &flown, 5.0), None);
    }
}

#[test]
fn pictures_are_counted_where_their_ground_lies_however_large_the_coordinates() {
    for base in [DVec2::ZERO, DVec2::new(691_000.0, 5_334_000.0), DVec2::new(-2e7, 9e6)] {
        let region = rectangle(base, DVec2::new(100.0, 100.0));
        let map = seen(&map(&region), &[view((base + 50.0).extend(40.0), 0.0, -90.0)]);
        // North is up in the picture: 48 m from west to east, 36 m from south to north.
        for (x, y, pictures) in [(50.0, 50.0, 1), (72.0, 50.0, 1), (76.0, 50.0, 0), (50.0, 66.0, 1), (50.0, 70.0, 0)] {
            assert_eq!(at(&map, base + DVec2::new(x, y)).pictures, pictures, "{x} {y} from {base}");
        }
        let share = 48.0 * 36.0 / map.grid().cell_m2();
        let count = (0..map.grid().rows).flat_map(|r| (0..map.grid().columns).map(move |c| (c, r)));
        let count = count.filter(|&(c, r)| map.cell(c, r).is_some_and(|c| c.pictures == 1)).count() as f64;
        assert!((count / share - 1.0).abs() < 0.1, "{count} squares of {share}");
    }
}

#[test]
fn high_ground_is_seen_less_far_and_from_wider_apart() {
    let region = rectangle(DVec2::ZERO - 50.0, DVec2::splat(100.0));
    let hill = |p: DVec2| if p.x > 0.0 { 20.0 } else { 0.0 };
    let pair = [view(DVec3::new(-4.0, 0.0, 40.0), 0.0, -90.0), view(DVec3::new(4.0, 0.0, 40.0), 0.0, -90.0)];
    let map = seen(&map(&region).over(hill), &pair);
    // Half the height above the hill: 12 m to each side of a camera instead of 24.
    let counts = [-19.0, -27.0, 7.0, 13.0, 17.0].map(|x| at(&map, DVec2::new(x, 0.5)).pictures);
    assert_eq!(counts, [2, 1, 2, 1, 0]);
    let (low, high) = (at(&map, DVec2::new(-1.0, 0.5)), at(&map, DVec2::new(1.0, 0.5)));
    assert!((low.angle_deg - 11.4).abs() < 0.3 && (high.angle_deg - 22.6).abs() < 0.5, "{low:?} {high:?}");
    assert!((low.gsd_m.expect("seen") / high.gsd_m.expect("seen") - 2.0).abs() < 0.05);
    // Ground above the camera is not below it.
    let over = map.over(|_| 60.0);
    assert_eq!(at(&seen(&over, &pair), DVec2::new(1.0, 0.5)).pictures, 0);
}

#[test]
fn an_oblique_picture_sees_ahead_and_one_with_the_horizon_in_it_no_further_than_rays_count() {
    let region = rectangle(DVec2::new(-100.0, -50.0), DVec2::new(200.0, 400.0));
    let ahead = seen(&map(&region), &[view(DVec3::new(0.0, 0.0, 40.0), 0.0, -45.0)]);
    // 45° ± 24.4°: from 15 m to 106 m ahead.
    let counts = [10.0, 20.0, 100.0, 112.0].map(|y| at(&ahead, DVec2::new(0.0, y)).pictures);
    assert_eq!(counts, [0, 1, 1, 0]);
    // The horizon is in the picture; 75.5° from the vertical is 155 m away.
    let level = seen(&map(&region), &[view(DVec3::new(0.0, 0.0, 40.0), 0.0, -20.0)]);
    let counts = [35.0, 50.0, 152.0, 160.0, 300.0].map(|y| at(&level, DVec2::new(0.0, y)).pictures);
    assert_eq!(counts, [0, 1, 1, 0, 0]);
    let up = seen(&map(&region), &[view(DVec3::new(0.0, 0.0, 40.0), 0.0, 45.0)]);
    assert_eq!((up.pictures(), up.covered_share()), ((1, 0), 0.0));
    assert!(gaps::find(&up).iter().all(|g| g.unseen_m2 == g.area_m2), "nothing of it is ground");
}

#[test]
fn poses_and_lenses_that_are_no_numbers_are_counted_and_dropped() {
    let good = view(DVec3::new(0.0, 0.0, 40.0), 0.0, -90.0);
    let mut bad = [good; 4];
    bad[0].pose.center.x = f64::NAN;
    bad[1].pose.rotation = DQuat::from_xyzw(0.0, 0.0, 0.0, 0.0);
    bad[2].intrinsics.fx = f32::NAN;
    bad[3].pose.center.z = f64::INFINITY;
    let empty = map(&rectangle(DVec2::ZERO - 10.0, DVec2::splat(20.0)));
    let map = seen(&empty, &bad);
    assert_eq!((map.pictures(), map.covered_share()), ((0, 4), 0.0));
    assert!(bad.iter().all(|v| !map.wants(v)) && map.wants(&good));
    assert_eq!(reflight::plan(&map, &gaps::find(&map), &bad, 5.0), None);
}

#[test]
fn regions_without_area_are_refused_and_all_others_fit_the_memory_set_aside() {
    let line =
        |k: f64| vec![DVec2::new(5e6, 4e6), DVec2::new(5e6 + k, 4e6 + k), DVec2::new(5e6 + 2.0 * k, 4e6 + 2.0 * k)];
    for corners in [vec![], line(0.0), line(100.0), vec![DVec2::NAN; 3], vec![DVec2::ZERO, DVec2::X]] {
        assert_eq!(CoverageRegion::new(corners.clone()), Err(CoverageError::NoArea), "{corners:?}");
    }
    for size in [DVec2::new(1.0, 1.0), DVec2::new(5000.0, 3.0), DVec2::new(3e4, 2e4), DVec2::new(1e6, 0.5)] {
        let map = map(&rectangle(DVec2::new(5e5, 5e6), size));
        let grid = map.grid();
        assert!(grid.columns * grid.rows <= MAX_CELLS && map.area_m2() > 0.5 * size.x * size.y, "{size} {grid:?}");
    }
    assert!(std::mem::size_of::<Cell>() * MAX_CELLS <= 3 << 20);
}

/// σ_z = GSD · √2 σ_px / (base / height), the normal case of photogrammetry.
#[test]
fn the_expected_error_of_two_pictures_straight_down_is_that_of_the_normal_case() {
    let region = rectangle(DVec2::ZERO - 10.0, DVec2::splat(20.0));
    for base in [4.0, 8.0, 16.0] {
        let pair = [-0.5, 0.5].map(|k| view(DVec3::new(k * base, 0.0, 40.0), 0.0, -90.0));
        let found = at(&seen(&map(&region), &pair), DVec2::new(0.5, 0.5)).sigma_z_m.expect("settled");
        let expected = 40.0 / 66.0 * 2f64.sqrt() * 0.5 / (base / 40.0);
        assert!((found / expected - 1.0).abs() < 0.05, "{base} m: {found} instead of {expected}");
    }
    let alone = seen(&map(&region), &[view(DVec3::new(3.0, 0.0, 40.0), 0.0, -90.0); 5]);
    assert_eq!(at(&alone, DVec2::new(0.5, 0.5)).sigma_z_m, None, "five times the same ray");
}

#[test]
fn ground_seen_often_from_one_side_is_thin_and_the_flight_that_mends_it_looks_from_another() {
    let flown: Vec<View> = (0..5).map(|k| view(DVec3::new(0.0, 0.3 * f64::from(k), 40.0), 0.0, -90.0)).collect();
    let map = seen(&map(&rectangle(DVec2::ZERO - 6.0, DVec2::splat(12.0))), &flown);
    let [gap] = gaps::find(&map).try_into().expect("one");
    assert_eq!((gap.kind, gap.pictures, gap.unseen_m2, gap.area_m2), (GapKind::Thin, 5, 0.0, 144.0));
    assert!(gap.angle_deg < 3.0);
    let more = reflight::plan(&map, &[gap], &flown, 5.0).expect("a flight");
    assert!(more.stations.len() <= 4, "{more:?}");
    let again: Vec<View> = more.stations.iter().map(|s| view(s.center, 77.0, more.pitch_deg)).collect();
    assert_eq!(gaps::find(&seen(&map, &again)), []);
}

/// Oblique cameras have to head the right way; the flight says which.
#[test]
fn gaps_of_an_oblique_flight_are_closed_by_pictures_with_headings() {
    let whole = survey(DVec2::ZERO - 25.0, SIZE + 50.0, -60.0);
    let hole = DVec2::new(60.0, 45.0);
    let looked = |v: &View| v.pose.center.truncate() + v.pose.forward().truncate() * (40.0 / -v.pose.forward().z);
    let flown: Vec<View> = whole.iter().filter(|v| looked(v).distance(hole) > 45.0).copied().collect();
    let map = seen(&map(&rectangle(DVec2::ZERO, SIZE)), &flown);
    let found = gaps::find(&map);
    assert_eq!(found.len(), 1);
    let more = reflight::plan(&map, &found, &flown, 5.0).expect("a flight");
    assert!((more.pitch_deg + 60.0).abs() < 1e-6 && more.gaps_left == 0);
    let again: Vec<View> =
        more.stations.iter().map(|s| view(s.center, s.yaw_deg.expect("a heading"), more.pitch_deg)).collect();
    assert_eq!(gaps::find(&seen(&map, &again)), []);
    assert!(
        again.len() < (whole.len() - flown.len()) * 2,
        "{} pictures for {}",
        again.len(),
        whole.len() - flown.len()
    );
}

#[test]
fn a_region_that_nobody_photographed_is_planned_in_a_moment_and_closed() {
    let size = DVec2::new(300.0, 250.0);
    let start = [view(DVec3::new(0.0, 0.0, 40.0), 0.0, -90.0)];
    let map = seen(&map(&rectangle(DVec2::ZERO, size)), &start);
    let begun = std::time::Instant::now();
    let more = reflight::plan(&map, &gaps::find(&map), &start, 5.0).expect("a flight");
    assert!(begun.elapsed().as_secs_f64() < 5.0, "{:?}", begun.elapsed());
    assert_eq!(more.gaps_left, 0);
    let again: Vec<View> = more.stations.iter().map(|s| view(s.center, 0.0, more.pitch_deg)).collect();
    assert_eq!(gaps::find(&seen(&map, &again)), []);
}

fn written(map: &CoverageMap, origin: Option<Geodetic>) -> Value {
    let mut out = Vec::new();
    geojson::write(&mut out, map, &gaps::find(map), origin).expect("memory");
    serde_json::from_slice(&out).expect("JSON")
}

#[test]
fn gaps_are_written_as_closed_rings_of_longitude_and_latitude_around_their_ground() {
    let half: Vec<View> = survey(DVec2::ZERO, SIZE, -90.0).into_iter().filter(|v| v.pose.center.x < 50.0).collect();
    let map = seen(&map(&rectangle(DVec2::ZERO, SIZE)), &half);
    let origin = Geodetic { lat_deg: 47.0, lon_deg: 8.0, alt_m: 400.0 };
    let file = written(&map, Some(origin));
    assert_eq!(file["type"], "FeatureCollection");
    let [feature] = file["features"].as_array().expect("a list").as_slice() else { panic!("one gap: {file}") };
    assert_eq!(
        (&feature["properties"]["kind"], &feature["geometry"]["type"]),
        (&"hole".into(), &"MultiPolygon".into())
    );
    let ring = feature["geometry"]["coordinates"][0][0].as_array().expect("a ring");
    let place = |p: &Value| DVec2::new(p[0].as_f64().expect("longitude"), p[1].as_f64().expect("latitude"));
    let ring: Vec<DVec2> = ring.iter().map(place).collect();
    assert_eq!(ring.first(), ring.last());
    // A degree is 111,165 m north and 76,060 m east at 47° (WGS-84).
    let metres: Vec<DVec2> =
        ring.iter().map(|p| (*p - DVec2::new(8.0, 47.0)) * DVec2::new(76_060.0, 111_165.0)).collect();
    let area = 0.5 * metres.windows(2).map(|w| w[0].perp_dot(w[1])).sum::<f64>();
    let stated = feature["properties"]["area_m2"].as_f64().expect("an area");
    assert!((area / stated - 1.0).abs() < 0.01, "counter-clockwise and as large as it says: {area} {stated}");
    assert!(metres.iter().all(|p| p.x > 45.0 && p.x < 121.0 && p.y > -1.0 && p.y < 91.0), "{metres:?}");
    let local = written(&map, None);
    assert!(local["axes"].is_string() && file["axes"].is_null());
    assert_eq!(local["features"][0]["geometry"]["coordinates"][0][0][0][1], 0.0, "metres north");
}

/// The lens of the tests sees what its comment says.
#[test]
fn the_lens_of_these_tests_spans_48_by_36_metres() {
    assert!(
        (40.0 * LENS.width as f32 / LENS.fx - 48.5).abs() < 0.1
            && (40.0 * LENS.height as f32 / LENS.fy - 36.4).abs() < 0.1
    );
}
