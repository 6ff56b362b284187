//! Every fault of the simulator, one at a time: what happened, what the HAL reported, and what the mission ended with. The
//! flights are rehearsed at real-time rates on a simulated clock, so that every figure follows from the seed.

use std::fmt::Write as _;
use std::sync::Arc;
use std::time::Duration;

use config::faults::FaultSettings;
use config::geodesy::Geodetic;
use config::link::{LinkSettings, Signing};
use config::mission::{CameraSettings, MountSettings};
use hal::counters::HalCounters;
use hal::failsafe::Action;
use hal::link::LinkAddress;
use hal::sim::SimSettings;
use hal::sim::aircraft::Imperfections;
use hal::sim::autopilot::{Announcing, AutopilotSettings};
use hal::sim::reference::Lens;
use hal::sim::survey::SurveySettings;
use hal::sim::world::{World, WorldSettings};
use hal::sim::{SessionReport, SessionSettings};
use hal::vehicle::VehicleSettings;

use super::flight::EndOfFlight;
use super::rehearsal::{Rehearsed, Script, rehearse};

const ORIGIN: Geodetic = Geodetic { lat_deg: 47.4, lon_deg: 8.5, alt_m: 430.0 };
const KEY: [u8; 32] = [7; 32];
/// Exposures of the flight: two lines of five.
const EXPOSURES: u64 = 10;

/// One row: what is set, what must have happened and been noticed, and what must remain.
struct Row {
    fault: &'static str,
    settings: &'static [(&'static str, f32)],
    /// What else is unlike the usual flight.
    also: fn(&mut Script),
    noticed: fn(&HalCounters, &SessionReport) -> bool,
    /// Views of the finished model, fewest and most; none for a mission without a model.
    views: Option<(usize, usize)>,
    /// The highest rung of the failsafe ladder.
    rung: Action,
}

const USUAL: Row = Row {
    fault: "none",
    settings: &[],
    also: |_| {},
    noticed: |c, _| c.damaged + c.lost + c.link_losses + c.pictures_unmatched + c.triggers_unmatched == 0,
    views: Some((10, 10)),
    rung: Action::Nominal,
};

fn px4(announcing: Announcing, script: &mut Script) {
    script.sim.autopilot.announcing = announcing;
}

const ROWS: &[Row] = &[
    USUAL,
    Row {
        fault: "bytes lost",
        settings: &[("SIM_UART_LOSS", 0.3)],
        noticed: |c, r| r.line.bytes_lost > 100 && c.damaged > 50 && c.lost > 50,
        views: Some((7, 10)),
        ..USUAL
    },
    Row {
        fault: "bits flipped",
        settings: &[("SIM_UART_FLIP", 0.3)],
        noticed: |c, r| r.line.bytes_flipped > 100 && c.damaged > 50 && c.lost > 50,
        views: Some((7, 10)),
        ..USUAL
    },
    Row {
        fault: "frames lost",
        settings: &[("SIM_FRAME_LOSS", 20.0)],
        noticed: |c, r| r.line.frames_lost > 200 && c.lost > 200 && c.damaged == 0,
        views: Some((7, 10)),
        ..USUAL
    },
    Row {
        fault: "line silent for 12 s",
        settings: &[("SIM_LINK_PAUSE", 1.0), ("SIM_FLT_START", 12.0), ("SIM_FLT_LENGTH", 12.0)],
        noticed: |c, r| r.line.frames_paused > 300 && c.link_losses == 1 && c.pictures_unmatched > 0,
        views: Some((4, 8)),
        rung: Action::Warn,
        ..USUAL
    },
    Row {
        fault: "line silent for good",
        settings: &[("SIM_LINK_PAUSE", 1.0), ("SIM_FLT_START", 16.0)],
        also: |script| script.end.silence = Duration::from_secs(150),
        noticed: |c, _| c.link_losses == 1,
        views: Some((3, 6)),
        rung: Action::Hold,
    },
    Row {
        fault: "GPS lost",
        settings: &[("SIM_GPS1_ENABLE", 0.0), ("SIM_FLT_START", 8.0)],
        noticed: |c, _| c.posed_frames == EXPOSURES,
        views: Some((8, 10)),
        rung: Action::Warn,
        ..USUAL
    },
    Row {
        fault: "GPS glitch of 111 m for 5 s",
        settings: &[("SIM_GPS1_GLTCH_X", 0.001), ("SIM_FLT_START", 12.0), ("SIM_FLT_LENGTH", 5.0)],
        noticed: |c, _| c.position_steps > 0 && c.spikes > 0,
        views: Some((8, 10)),
        rung: Action::Warn,
        ..USUAL
    },
    Row {
        fault: "attitude spikes of 60°",
        settings: &[("SIM_ATT_SPK_PCT", 4.0), ("SIM_ATT_SPK_DEG", 60.0)],
        noticed: |c, _| c.spikes > 20,
        ..USUAL
    },
    Row { fault: "NaN in attitudes", settings: &[("SIM_NAN_PCT", 10.0)], noticed: |c, _| c.impossible > 100, ..USUAL },
    Row {
        fault: "boot clock jumps by 500 s",
        settings: &[("SIM_CLK_JUMP", 500.0), ("SIM_FLT_START", 15.0)],
        // A jump costs one exposure at most, the one whose pose was still being sought: the clock's rate outlives it, and
        // TIMESYNC is asked as often again as at the start.
        noticed: |c, _| c.clock_restarts == 1,
        views: Some((9, 10)),
        ..USUAL
    },
    Row {
        fault: "boot clock starts again (reboot)",
        settings: &[("SIM_CLK_JUMP", -40.0), ("SIM_FLT_START", 15.0)],
        noticed: |c, _| c.clock_restarts == 1,
        views: Some((9, 10)),
        ..USUAL
    },
    Row {
        fault: "no Unix time",
        settings: &[("SIM_UNIX_LOST", 1.0)],
        noticed: |c, _| c.trigger_times_mended == EXPOSURES,
        ..USUAL
    },
    Row {
        fault: "exposures suddenly in boot time",
        settings: &[("SIM_CAM_BOOTTIME", 1.0), ("SIM_FLT_START", 15.0)],
        noticed: |c, _| c.triggers == EXPOSURES && c.trigger_times_mended == 0,
        ..USUAL
    },
    Row {
        fault: "announcements lost",
        settings: &[("SIM_CAM_TRG_LOSS", 60.0)],
        noticed: |c, r| r.triggers_lost > 0 && c.trigger_gaps > 0 && c.pictures_unmatched == r.triggers_lost,
        views: Some((3, 9)),
        ..USUAL
    },
    Row {
        fault: "pictures lost",
        settings: &[("SIM_PIC_LOSS", 40.0)],
        noticed: |c, r| r.pictures.lost > 0 && c.triggers_unmatched == r.pictures.lost,
        views: Some((4, 9)),
        ..USUAL
    },
    Row {
        fault: "pictures twice",
        settings: &[("SIM_PIC_TWICE", 40.0)],
        noticed: |c, r| r.pictures.twice > 0 && c.picture_duplicates + c.pictures_unmatched == r.pictures.twice,
        ..USUAL
    },
    Row {
        fault: "pictures 6 s late",
        settings: &[("SIM_PIC_LATE", 40.0), ("SIM_PIC_LATE_S", 6.0)],
        noticed: |c, r| r.pictures.late > 0 && c.pictures_late > 0,
        views: Some((8, 10)),
        ..USUAL
    },
    Row {
        fault: "black pictures",
        settings: &[("SIM_PIC_BLACK", 40.0)],
        noticed: |c, r| r.pictures.spoiled > 0 && c.pictures_black == r.pictures.spoiled,
        views: Some((4, 9)),
        ..USUAL
    },
    Row {
        fault: "overexposed pictures",
        settings: &[("SIM_PIC_OVER", 100.0), ("SIM_FLT_START", 15.0)],
        noticed: |c, r| r.pictures.spoiled > 0 && c.pictures_overexposed == r.pictures.spoiled,
        views: Some((4, 9)),
        rung: Action::Warn,
        ..USUAL
    },
    Row {
        fault: "pictures cut off",
        settings: &[("SIM_PIC_CUT", 40.0)],
        noticed: |c, r| {
            r.pictures.cut > 0 && c.pictures_broken == r.pictures.cut && c.triggers_unmatched == r.pictures.cut
        },
        views: Some((4, 9)),
        ..USUAL
    },
    Row {
        fault: "signed with another key from 16 s on",
        settings: &[("SIM_SIGN_BAD", 1.0), ("SIM_FLT_START", 16.0)],
        also: signed,
        noticed: |c, _| c.wrong_key > 500 && c.link_losses == 1,
        views: Some((3, 6)),
        rung: Action::Warn,
    },
    Row {
        fault: "signed with another key from the start",
        settings: &[("SIM_SIGN_BAD", 1.0)],
        also: signed,
        noticed: |c, _| c.wrong_key > 500 && c.triggers == 0 && c.pictures_unmatched == EXPOSURES,
        views: None,
        rung: Action::Nominal,
    },
    Row {
        fault: "PX4: CAMERA_TRIGGER and two commands",
        also: |script| px4(Announcing::Trigger, script),
        noticed: |c, _| c.triggers == EXPOSURES && c.trigger_duplicates >= EXPOSURES && c.posed_frames == EXPOSURES,
        ..USUAL
    },
    Row {
        fault: "PX4: and CAMERA_IMAGE_CAPTURED",
        also: |script| px4(Announcing::TriggerAndCaptured, script),
        noticed: |c, _| c.triggers == EXPOSURES && c.trigger_duplicates >= 2 * EXPOSURES && c.posed_frames == EXPOSURES,
        ..USUAL
    },
    Row {
        fault: "CAMERA_IMAGE_CAPTURED alone",
        also: |script| px4(Announcing::Captured, script),
        noticed: |c, _| c.triggers == EXPOSURES && c.trigger_duplicates == 0 && c.posed_frames == EXPOSURES,
        ..USUAL
    },
    Row {
        fault: "camera 30° off the planned pitch, 20° allowed",
        also: |script| {
            script.sim.survey.gimbal_pitch_deg = -60.0;
            (script.vehicle.mount.rotation_deg, script.vehicle.mount.max_tilt_deg) = ([0.0, -90.0, 0.0], 20.0);
        },
        noticed: |c, r| r.triggers > 0 && c.exposures_tilted == r.triggers && c.posed_frames == 0,
        views: None,
        ..USUAL
    },
];

fn signed(script: &mut Script) {
    script.sim.autopilot.signing_key = Some(KEY);
    script.vehicle.link.signing = Signing::Require;
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
        imperfections: Imperfections::default(),
        autopilot: AutopilotSettings { unix_us: Some(1_790_000_000_000_000), faults, ..AutopilotSettings::default() },
        session: SessionSettings { linger_s: 15.0, ..SessionSettings::default() },
        prefix: "IMG_".into(),
    };
    let vehicle = VehicleSettings {
        address: LinkAddress::Pty(None),
        patient: false,
        system_id: 1,
        link: LinkSettings::default(),
        camera: None,
        pictures_since: None,
        lens: CameraSettings {
            width: 64,
            height: 48,
            fx: 50.0,
            fy: 50.0,
            cx: 32.0,
            cy: 24.0,
            distortion: [0.0; 4],
            exposure_delay_ms: 60.0,
        },
        mount: MountSettings::default(),
        origin: ORIGIN,
    };
    let end = EndOfFlight { silence: Duration::from_secs(20), patience: Some(Duration::from_secs(120)) };
    let mut script = Script { sim, vehicle, end };
    (row.also)(&mut script);
    script
}

fn fly(row: &Row, world: &Arc<World>) -> Rehearsed {
    let folder = tempfile::tempdir().expect("folder");
    let mut script = script(row);
    if script.sim.autopilot.signing_key.is_some() {
        let key = folder.path().join("key");
        std::fs::write(&key, KEY).expect("key");
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
    let inner = counters.split_once('{').map_or("", |c| c.1).trim_end_matches('}');
    let told = |f: &&str| !f.is_empty() && !f.ends_with(": 0") && !USUAL.iter().any(|u| f.starts_with(u));
    inner
        .split(',')
        .map(str::trim)
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
    let ladder: Vec<String> = r.rungs.iter().map(|(action, why)| format!("{} ({why})", action.name())).collect();
    let model = match r.model {
        Ok((views, true)) => format!("model of {views} views"),
        Ok((views, false)) => format!("checkpoint of {views} views"),
        Err(keyframes) => format!("no model, {keyframes} key frames"),
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
    if !r.happened.completed {
        wrong.push("the aircraft did not finish".to_owned());
    }
    if !(row.noticed)(&r.counters.hal, &r.happened) {
        wrong.push("not noticed".to_owned());
    }
    let views_fit = match (row.views, r.model) {
        (Some((fewest, most)), Ok((views, finished))) => finished && (fewest..=most).contains(&views),
        (None, Err(_)) => true,
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
