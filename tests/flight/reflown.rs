//! A region that one flight leaves half undone: the aircraft says so, writes what is missing, and the same job, flown as written,
//! completes it. Everything but the reconstruction is the real thing.

use std::sync::Arc;

use disk::Disk;
use models::formats::flight_plan;
use sim::world::World;

use super::fault_table::{ORIGIN, usual};
use super::rehearsal::rehearse;
use crate::coverage::{REFLIGHT, route};

#[test]
fn a_region_half_flown_is_told_to_the_ground_and_completed_by_the_flight_that_is_written() {
    let folder = tempfile::tempdir().expect("a folder");
    let out = folder.path().join("out");
    let mut script = usual();
    // The first flight is one of 40 m by 30 m.
    script.ground = vec![[-20.0, -15.0], [80.0, -15.0], [80.0, 15.0], [-20.0, 15.0]];
    let world = Arc::new(World::new(script.sim.world_seed, &script.sim.world));
    let first = rehearse(&script, world.clone(), folder.path());
    let before = first.counters.coverage.expect("a map");
    assert!((30..90).contains(&before.percent()) && !before.gaps.is_empty(), "{}", before.line());
    assert!(first.happened.texts.contains(&before.line()), "{:?}", first.happened.texts);
    // Whoever looked at the page has seen as much.
    let (craft, ground) = (&first.page.aircraft[0], &first.page.ground);
    assert_eq!((craft.state, craft.link), ("trained", "the flight is over"));
    assert_eq!((craft.covered, craft.key_frames), (Some(before.percent()), Some(first.names.len() as u64)));
    assert_eq!((ground.shots.len(), craft.thumbnail.serial as usize), (first.names.len(), first.names.len()));
    assert!(craft.at.is_some_and(|p| p[0].abs() < 60.0 && p[1].abs() < 40.0), "near the region: {:?}", craft.at);
    assert!(
        craft.schedule.steps > Some(0) && craft.plot.curve.points().len() as u64 <= craft.schedule.steps.unwrap_or(0)
    );
    before.write(&Disk::default(), &out).expect("written");
    let plan = flight_plan::read(&out.join(REFLIGHT)).expect("a plan");
    assert!((plan.home.alt_m - ORIGIN.alt_m).abs() < 1.0, "home is where the autopilot says");

    script.sim.route = Some(route(&plan, ORIGIN, -90.0));
    (script.sim.seed, script.sim.prefix) = (8, "AGAIN_".into());
    script.earlier_names = first.names;
    let second = rehearse(&script, world, folder.path());
    let after = second.counters.coverage.expect("a map");
    assert_eq!(after.line(), "dgtr: covered 100 %, 0 holes");
    assert!(second.happened.texts.contains(&after.line()), "{:?}", second.happened.texts);
    // Where others had brought what it was planned for, a picture from an old place is skipped.
    let k = second.counters.keyframes;
    assert_eq!((k.key + k.covered) as usize, before.more_pictures(), "{k:?}");
    assert!(k.key > k.covered, "{k:?}");
    after.write(&Disk::default(), &out).expect("written");
    assert!(!out.join(REFLIGHT).exists());
}
