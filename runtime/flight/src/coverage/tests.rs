//! The promise of the whole, on simulated flights over known ground, poses only: holes that were put in are found and no
//! others, and the flight that is written closes them.

use config::coverage::CoverageSettings;
use glam::DVec2;
use models::camera::{Intrinsics, Pose};
use models::formats::flight_plan;
use sim::SessionSettings;
use sim::SimSettings;
use sim::aircraft::Imperfections;
use sim::autopilot::AutopilotSettings;
use sim::reference::{Lens, flown_views};
use sim::survey::SurveySettings;
use sim::world::{World, WorldSettings};
use survey::coverage::CoverageRegion;

use super::*;

const ORIGIN: Geodetic = Geodetic { lat_deg: 47.4, lon_deg: 8.5, alt_m: 430.0 };
const REGION: [[f64; 2]; 4] = [[-140.0, -100.0], [140.0, -100.0], [140.0, 100.0], [-140.0, 100.0]];
const LENS: Lens = Lens { width: 80, height: 60, fx: 66.0, fy: 66.0, cx: 40.0, cy: 30.0 };
/// Least distance of two key frames.
const LEAST_M: f64 = 5.0;

/// A survey of more than the region, so that its border is seen as often as its middle.
fn settings(pitch_deg: f64) -> SimSettings {
    SimSettings {
        world_seed: 3,
        seed: 7,
        world: WorldSettings { relief_m: 12.0, ..WorldSettings::default() },
        origin: ORIGIN,
        lens: LENS,
        region: REGION.map(|c| c.map(|v| v * 1.35)).to_vec(),
        survey: SurveySettings {
            gimbal_pitch_deg: pitch_deg,
            margin_m: 20.0,
            speed_ms: 10.0,
            ..SurveySettings::default()
        },
        route: None,
        imperfections: Imperfections::default(),
        autopilot: AutopilotSettings::default(),
        session: SessionSettings::default(),
        prefix: String::new(),
    }
}

/// The true views of a flight's pictures.
fn flown(settings: &SimSettings) -> Vec<View> {
    let lens = Intrinsics {
        width: LENS.width,
        height: LENS.height,
        fx: LENS.fx as f32,
        fy: LENS.fy as f32,
        cx: LENS.cx as f32,
        cy: LENS.cy as f32,
    };
    let flight = settings.flight().expect("a flight");
    let view =
        |v: sim::world::PinholeView| View { intrinsics: lens, pose: Pose { rotation: v.rotation, center: v.position } };
    flown_views(&flight, &settings.lens).into_iter().map(view).collect()
}

/// What views see of the region over the world's ground.
fn found(world: &World, views: &[View]) -> Coverage {
    let region = CoverageRegion::new(REGION.map(DVec2::from).to_vec()).expect("an area");
    let map = CoverageMap::new(&region, 0.0, CoverageSettings::default()).expect("a map");
    let mut map = map.over(|p| world.ground_height(p.x, p.y));
    views.iter().for_each(|v| map.add(v));
    Coverage::of(map, Some(ORIGIN)).with_reflight(views, LEAST_M, 0.0)
}

/// Where a picture's middle lies on the plane z = 0.
fn looks_at(v: &View) -> DVec2 {
    let (center, forward) = (v.pose.center, v.pose.forward());
    center.truncate() + forward.truncate() * (center.z / -forward.z)
}

#[test]
fn a_complete_flight_over_hills_has_no_hole_and_writes_no_other_flight() {
    for pitch in [-90.0, -65.0] {
        let settings = settings(pitch);
        let world = World::new(settings.world_seed, &settings.world);
        let whole = found(&world, &flown(&settings));
        assert_eq!((whole.percent(), whole.gaps.len(), &whole.reflight), (100, 0, &None), "{pitch}");
        assert_eq!(whole.map.covered_share(), 1.0);
        assert_eq!(whole.line(), "dgtr: covered 100 %, 0 holes");
        let out = tempfile::tempdir().expect("a folder");
        std::fs::write(out.path().join(REFLIGHT), "of an earlier flight").expect("written");
        let files = whole.write(&Disk::default(), out.path()).expect("written");
        assert_eq!(files, [GAPS, RASTER].map(|name| out.path().join(name)));
        assert!(!out.path().join(REFLIGHT).exists(), "nobody needs it any more");
    }
}

#[test]
fn holes_that_were_put_into_a_flight_are_found_and_the_written_flight_closes_them() {
    // Large and small ones in the middle, one at the border, one over a corner: where, and how far around pictures are missing.
    let holes = [((-60.0, 30.0), 45.0), ((60.0, -20.0), 32.0), ((20.0, 100.0), 34.0), ((140.0, -100.0), 38.0)];
    let holes = holes.map(|((x, y), radius)| (DVec2::new(x, y), radius));
    let begun = std::time::Instant::now();
    for pitch in [-90.0, -65.0] {
        let settings = settings(pitch);
        let world = World::new(settings.world_seed, &settings.world);
        let whole = flown(&settings);
        let lost = |v: &&View| holes.iter().any(|(at, radius)| looks_at(v).distance(*at) < *radius);
        let (missing, left): (Vec<View>, Vec<View>) = whole.iter().partition(lost);
        let before = found(&world, &left);
        assert_eq!(
            before.gaps.len(),
            holes.len(),
            "{pitch}: {:?}",
            before.gaps.iter().map(|g| g.middle).collect::<Vec<_>>()
        );
        for (at, radius) in holes {
            let gap = before.gaps.iter().find(|g| g.middle.distance(at) < radius).expect("found");
            assert_eq!(gap.kind, GapKind::Hole);
            // Not a square of it is further away than a missing picture shows.
            for &i in &gap.squares {
                let grid = before.map.grid();
                let middle = grid.middle(i as usize % grid.columns, i as usize / grid.columns);
                assert!(missing.iter().any(|v| looks_at(v).distance(middle) < 35.0), "{pitch}: {middle}");
            }
        }
        let out = tempfile::tempdir().expect("a folder");
        before.write(&Disk::default(), out.path()).expect("written");
        let plan = flight_plan::read(&out.path().join(REFLIGHT)).expect("a plan");
        let line = before.line();
        let n = plan.waypoints.iter().filter(|w| w.picture).count();
        assert_eq!(line, format!("dgtr: covered {} %, 4 holes, {n} more pictures", before.percent()));
        assert!(line.len() <= LINE && (50..97).contains(&before.percent()), "{line}");
        let heights = plan.waypoints.iter().map(|w| w.position.alt_m - plan.home.alt_m);
        assert!(heights.into_iter().all(|h| (h - 40.0).abs() < 1.0), "as high as the flight was");
        let again = flown(&SimSettings { route: Some(route(&plan, ORIGIN, -90.0)), seed: 8, ..settings });
        assert_eq!(again.len(), n, "one picture at each waypoint");
        let after = found(&world, &[left, again].concat());
        assert_eq!((after.percent(), after.line().as_str()), (100, "dgtr: covered 100 %, 0 holes"), "{pitch}");
        println!("{pitch}: {} of {} pictures left out, {line}", missing.len(), whole.len());
    }
    println!("{:.2} s", begun.elapsed().as_secs_f64());
}

#[test]
fn the_line_for_the_ground_control_station_fits_one_message_and_counts_in_words() {
    let world = World::new(3, &WorldSettings { half_extent_m: 20.0, relief_m: 0.0, density: 0.0 });
    let start = [flown(&settings(-90.0))[0]];
    let mut nothing = found(&world, &start);
    let n = nothing.more_pictures();
    assert_eq!(nothing.line(), format!("dgtr: covered 0 %, 1 hole, {n} more pictures"));
    let (gap, station) = (nothing.gaps[0].clone(), nothing.reflight.as_ref().expect("a flight").stations[0]);
    nothing.gaps = vec![gap; 999];
    nothing.reflight =
        Some(Reflight { stations: vec![station; reflight::MOST_STATIONS], pitch_deg: -90.0, gaps_left: 0 });
    assert!(nothing.line().len() <= LINE && nothing.line().ends_with("1000 more pictures"), "{}", nothing.line());
    nothing.reflight = Some(Reflight { stations: vec![station], pitch_deg: -90.0, gaps_left: 0 });
    assert!(nothing.line().ends_with("999 holes, 1 more picture"));
}
