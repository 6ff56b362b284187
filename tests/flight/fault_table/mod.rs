//! Every fault of the simulator, one at a time: what happened, what the HAL reported, and what the mission ended with. The
//! flights are rehearsed at real-time rates on a simulated clock, so that every figure follows from the seed.

mod rows;

use std::fmt::Write as _;
use std::sync::Arc;
use std::time::Duration;

use config::faults::FaultSettings;
use config::link::LinkSettings;
use config::mission::CameraSettings;
use disk::Disk;
use geometry::geodesy::Geodetic;
use hal::link::LinkAddress;
use hal::vehicle::VehicleSettings;
use sim::SessionSettings;
use sim::SimSettings;
use sim::aircraft::Imperfections;
use sim::autopilot::AutopilotSettings;
use sim::reference::Lens;
use sim::survey::SurveySettings;
use sim::world::{World, WorldSettings};

use super::intake::EndOfFlight;
use super::rehearsal::{Rehearsed, Script, rehearse};
use rows::{End, KEY, ROWS, Row};

pub(super) const ORIGIN: Geodetic = Geodetic { lat_deg: 47.4, lon_deg: 8.5, alt_m: 430.0 };
/// The flight in which nothing goes wrong.
pub(super) fn usual() -> Script {
    script(&ROWS[0])
}

fn script(row: &Row) -> Script {
    let mut faults = FaultSettings::default();
    for (name, value) in row.settings {
        faults.set(name, *value).expect(name);
    }
    let sim = SimSettings {
        world_seed: 3,
        seed: 7,
        world: WorldSettings { half_extent_m: 80.0, ..WorldSettings::default() },
        origin: ORIGIN,
        lens: Lens { width: 64, height: 48, fx: 50.0, fy: 50.0, cx: 32.0, cy: 24.0 },
        region: vec![[-20.0, -15.0], [20.0, -15.0], [20.0, 15.0], [-20.0, 15.0]],
        survey: SurveySettings::default(),
        route: None,
        imperfections: Imperfections::default(),
        autopilot: AutopilotSettings { unix_us: Some(1_790_000_000_000_000), faults, ..AutopilotSettings::default() },
        session: SessionSettings { linger_s: 15.0, ..SessionSettings::default() },
        prefix: "IMG_".into(),
    };
    let vehicle = VehicleSettings {
        link: LinkSettings { battery_swap_s: 0.0, ..LinkSettings::default() },
        ..VehicleSettings::new(
            LinkAddress::Pty(None),
            CameraSettings { exposure_delay_ms: 60.0, ..CameraSettings::pinhole(64, 48, 50.0) },
            ORIGIN,
        )
    };
    let end = EndOfFlight { silence: Duration::from_secs(20), patience: Some(Duration::from_secs(120)) };
    let mut script = Script {
        ground: sim.region.clone(),
        sim,
        vehicle,
        end,
        earlier_names: Vec::new(),
        interrupt_at: None,
        disk: |_| Disk::default(),
        before: |_| {},
    };
    (row.also)(&mut script);
    script
}

fn fly(row: &Row, world: &Arc<World>) -> Rehearsed {
    let folder = tempfile::tempdir().expect("folder");
    let mut script = script(row);
    if script.sim.autopilot.signing_key.is_some() {
        let key = folder.path().join("key");
        std::fs::write(&key, KEY).expect("key");
        std::fs::set_permissions(&key, std::os::unix::fs::PermissionsExt::from_mode(0o600)).expect("its own");
        script.vehicle.link.signing_key = Some(key);
    }
    rehearse(&script, world.clone(), folder.path())
}

/// The fields of a counter struct's debug text that are not 0, without those that count what is well.
fn noteworthy(counters: &str) -> String {
    const USUAL: [&str; 10] = [
        "frames:",
        "sent:",
        "positions:",
        "attitudes:",
        "gimbals:",
        "triggers:",
        "pictures:",
        "posed_frames:",
        "delivered:",
        "foreign:",
    ];
    // Counters are grouped by what they count.
    let field = |f: &'_ str| f.rsplit('{').next().unwrap_or_default().trim_matches([' ', '}']).to_owned();
    let told = |f: &String| !f.is_empty() && !f.ends_with(": 0") && !USUAL.iter().any(|u| f.starts_with(u));
    counters
        .split(',')
        .map(field)
        .filter(told)
        .map(|f| f.replace(": ", " ").replace('_', " "))
        .collect::<Vec<_>>()
        .join(", ")
}

/// The row of the table in Markdown.
fn written(row: &Row, r: &Rehearsed) -> String {
    let or = |text: String, none: &str| if text.is_empty() { none.to_owned() } else { text };
    let settings: Vec<String> = row.settings.iter().map(|(name, value)| format!("{name} {value}")).collect();
    let mut happened: Vec<String> = [format!("{:?}", r.happened.line), format!("{:?}", r.happened.pictures)]
        .iter()
        .map(|c| noteworthy(c))
        .collect();
    happened.retain(|h| !h.is_empty());
    if r.happened.triggers_lost > 0 {
        happened.push(format!("triggers lost {}", r.happened.triggers_lost));
    }
    let mut ladder: Vec<String> = r.rungs.iter().map(|(action, why)| format!("{} ({why})", action.name())).collect();
    if r.without_room > 0 {
        ladder.push(format!("{} key frames not kept (disk)", r.without_room));
    }
    let model = match &r.model {
        Ok((views, true)) => format!("model of {views} views"),
        Ok((views, false)) => format!("checkpoint of {views} views"),
        Err((keyframes, cause)) => format!("no model, {keyframes} key frames: {cause}"),
    };
    format!(
        "| {} | {} | {} | {} | {} | {model} |",
        row.fault,
        or(settings.join(", "), "–"),
        or(happened.join(", "), "–"),
        or(noteworthy(&format!("{:?}", r.counters.hal)), "–"),
        or(ladder.join(", "), "nominal"),
    )
}

fn verdict(row: &Row, r: &Rehearsed) -> Vec<String> {
    let mut wrong = Vec::new();
    if !r.happened.completed && !matches!(row.end, End::Checkpoint(..)) {
        wrong.push("the aircraft did not finish".to_owned());
    }
    if !(row.noticed)(&r.counters.hal, &r.happened) {
        wrong.push("not noticed".to_owned());
    }
    if (r.without_room > 0) != row.fault.starts_with("disk") {
        wrong.push(format!("{} key frames found no room", r.without_room));
    }
    let views_fit = match (&row.end, &r.model) {
        (End::Model(fewest, most), Ok((views, true))) | (End::Checkpoint(fewest, most), Ok((views, false))) => {
            (fewest..=most).contains(&views)
        }
        (End::Nothing(why), Err((_, cause))) => cause.contains(why),
        _ => false,
    };
    if !views_fit {
        wrong.push(format!("ended with {:?} ({:?})", r.model, r.ended));
    }
    let highest = r.rungs.iter().map(|rung| rung.0).max().unwrap_or_default();
    if highest != row.rung {
        wrong.push(format!("climbed to {highest:?}"));
    }
    wrong.iter().map(|w| format!("{}: {w}", row.fault)).collect()
}

#[test]
fn every_fault_is_survived_and_noticed_and_the_mission_ends_as_promised() {
    let world = Arc::new(World::new(3, &WorldSettings { half_extent_m: 80.0, ..WorldSettings::default() }));
    let mut table = String::from(
        "| fault | set | what happened | what the HAL reported | failsafe | the mission ended with |\n|---|---|---|---|---|---|\n",
    );
    let mut wrong = Vec::new();
    for rows in ROWS.chunks(4) {
        let flown: Vec<Rehearsed> = std::thread::scope(|scope| {
            let flights: Vec<_> = rows.iter().map(|row| scope.spawn(|| fly(row, &world))).collect();
            flights.into_iter().map(|f| f.join().expect("no panic")).collect()
        });
        for (row, r) in rows.iter().zip(&flown) {
            let _ = writeln!(table, "{}", written(row, r));
            wrong.extend(verdict(row, r));
        }
    }
    println!("{table}");
    assert!(wrong.is_empty(), "{wrong:#?}\n{table}");
}

#[test]
fn a_rehearsed_flight_follows_from_its_seed() {
    let world = Arc::new(World::new(3, &WorldSettings { half_extent_m: 80.0, ..WorldSettings::default() }));
    for fault in ["bytes lost", "pictures 6 s late", "boot clock jumps by 500 s"] {
        let row = ROWS.iter().find(|r| r.fault == fault).expect("a row");
        let (a, b) = (fly(row, &world), fly(row, &world));
        assert_eq!(written(row, &a), written(row, &b));
        assert_eq!(a.counters.hal, b.counters.hal);
    }
}

/// A pipe's pictures are numbered by process, a card's by camera: the second run's are not the first one's.
#[test]
fn a_camera_that_counts_anew_after_a_restart_replaces_no_key_frame() {
    let world = Arc::new(World::new(3, &WorldSettings { half_extent_m: 80.0, ..WorldSettings::default() }));
    let usual = &ROWS[0];
    let first = fly(usual, &world).names;
    let folder = tempfile::tempdir().expect("folder");
    let second = rehearse(&Script { earlier_names: first.clone(), ..script(usual) }, world, folder.path()).names;
    assert_eq!((first.len(), second.len()), (10, 10));
    assert!(second.iter().all(|name| !first.contains(name)), "{first:?} {second:?}");
    let distinct: std::collections::HashSet<&String> = second.iter().collect();
    assert_eq!(distinct.len(), second.len());
}

#[test]
fn a_flight_decodes_every_key_frame_once_and_no_other_picture() {
    let world = Arc::new(World::new(3, &WorldSettings { half_extent_m: 80.0, ..WorldSettings::default() }));
    for row in &ROWS[..2] {
        let counters = fly(row, &world).counters;
        let k = counters.keyframes;
        assert!(k.key > 0);
        assert_eq!(counters.decoded, k.key + k.unusable, "{}: {counters:?}", row.fault);
    }
}
