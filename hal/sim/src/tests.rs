//! Promises of the simulated aircraft, heard from the other end of a pseudo-terminal.

use std::collections::BTreeMap;
use std::sync::atomic::Ordering;
use std::sync::mpsc::channel;
use std::time::{Duration, Instant};

use config::faults::FaultSettings;
use geometry::geodesy::EnuFrame;
use glam::DVec3;

use super::*;
use hal::link::SerialLink;
use hal::mavlink::channel::Channel;
use hal::mavlink::dialect::*;
use hal::mavlink::{MessageData, Signer};

/// A quick flight with small pictures over a small world.
pub(super) fn quick() -> SimSettings {
    SimSettings {
        world_seed: 3,
        seed: 7,
        world: WorldSettings { half_extent_m: 80.0, ..WorldSettings::default() },
        origin: Geodetic { lat_deg: 47.4, lon_deg: 8.5, alt_m: 430.0 },
        lens: Lens { width: 64, height: 48, fx: 50.0, fy: 50.0, cx: 32.0, cy: 24.0 },
        region: vec![[-20.0, -15.0], [20.0, -15.0], [20.0, 15.0], [-20.0, 15.0]],
        survey: SurveySettings::default(),
        route: None,
        imperfections: Imperfections::default(),
        autopilot: AutopilotSettings { unix_us: Some(1_790_000_000_000_000), ..AutopilotSettings::default() },
        session: SessionSettings { speed: 20.0, wait_for_peer_s: 10.0, settle_s: 0.0, linger_s: 0.0 },
        prefix: "IMG_".into(),
    }
}

/// What a companion heard.
#[derive(Default)]
pub(super) struct Handled {
    pub counts: BTreeMap<u32, usize>,
    pub boot_ms: Vec<u32>,
    pub positions: Vec<GLOBAL_POSITION_INT_DATA>,
    pub feedbacks: Vec<CAMERA_FEEDBACK_DATA>,
    pub attitudes: Vec<ATTITUDE_QUATERNION_DATA>,
    pub gimbals: Vec<GIMBAL_DEVICE_ATTITUDE_STATUS_DATA>,
    pub gps: Vec<GPS_RAW_INT_DATA>,
    pub parameters: Vec<PARAM_VALUE_DATA>,
    pub acks: Vec<COMMAND_ACK_DATA>,
    pub times: Vec<TIMESYNC_DATA>,
    pub damaged: u64,
    pub wrong_key: u64,
}

/// Runs a simulation with a companion that speaks once (so that the flight starts) and may send more by `speak`.
pub(super) fn fly_and_listen(
    settings: SimSettings,
    folder: &Path,
    reference: Option<&Path>,
    signer: Signer,
    speak: impl FnOnce(&mut Channel<SerialLink>),
) -> (SessionReport, Handled) {
    let (tell, told) = channel();
    let stop = AtomicBool::new(false);
    std::thread::scope(|scope| {
        let running = scope.spawn(|| {
            run(&settings, &LinkAddress::Pty(None), folder, reference, &stop, &mut |path| {
                tell.send(path.expect("a pty").to_path_buf()).expect("told");
            })
        });
        let path = told.recv().expect("ready");
        let mut line = Channel::new(SerialLink::open(&path, 921_600).expect("opens"), 1, 191, signer);
        line.send(&HEARTBEAT_DATA::default()).expect("sent");
        speak(&mut line);
        let mut heard = Handled::default();
        let begun = Instant::now();
        while !running.is_finished() && begun.elapsed() < Duration::from_secs(60) {
            if !line.fill(Duration::from_millis(20)).unwrap_or(false) {
                continue;
            }
            while let Some(frame) = line.next_frame() {
                *heard.counts.entry(frame.id()).or_default() += 1;
                heard.feedbacks.extend(frame.message::<CAMERA_FEEDBACK_DATA>());
                heard.attitudes.extend(frame.message::<ATTITUDE_QUATERNION_DATA>());
                heard.gimbals.extend(frame.message::<GIMBAL_DEVICE_ATTITUDE_STATUS_DATA>());
                heard.gps.extend(frame.message::<GPS_RAW_INT_DATA>());
                heard.parameters.extend(frame.message::<PARAM_VALUE_DATA>());
                heard.acks.extend(frame.message::<COMMAND_ACK_DATA>());
                heard.times.extend(frame.message::<TIMESYNC_DATA>());
                if let Some(m) = frame.message::<GLOBAL_POSITION_INT_DATA>() {
                    heard.boot_ms.push(m.time_boot_ms);
                    heard.positions.push(m);
                }
            }
        }
        stop.store(true, Ordering::Relaxed);
        let counters = line.counters();
        (heard.damaged, heard.wrong_key) = (counters.frames.damaged, counters.wrong_key);
        (running.join().expect("no panic").expect("a flight"), heard)
    })
}

fn files(folder: &Path) -> Vec<String> {
    let mut names: Vec<String> = std::fs::read_dir(folder)
        .expect("folder")
        .map(|e| e.expect("entry").file_name().to_string_lossy().into_owned())
        .collect();
    names.sort();
    names
}

#[test]
fn messages_come_at_their_rates_and_every_exposure_brings_a_picture() {
    let folder = tempfile::tempdir().expect("folder");
    let settings = quick();
    let flight = settings.flight().expect("flight");
    let (report, heard) = fly_and_listen(settings, folder.path(), None, Signer::off(), |_| {});
    assert!(report.completed && report.peer, "{report:?}");
    let seconds = flight.reported.end_s();
    let near = |id: u32, hz: f64| {
        let n = heard.counts.get(&id).copied().unwrap_or(0) as f64;
        assert!((n - seconds * hz).abs() < 0.1 * seconds * hz + 6.0, "message {id}: {n} in {seconds} s");
    };
    near(HEARTBEAT_DATA::ID, 1.0);
    near(SYSTEM_TIME_DATA::ID, 2.0);
    near(GLOBAL_POSITION_INT_DATA::ID, 10.0);
    near(ATTITUDE_QUATERNION_DATA::ID, 25.0);
    near(GIMBAL_DEVICE_ATTITUDE_STATUS_DATA::ID, 20.0);
    assert_eq!(heard.counts.get(&SIM_STATE_DATA::ID), None, "truth only when asked for");
    assert_eq!(heard.feedbacks.len(), flight.exposures.len());
    assert!(heard.feedbacks.iter().enumerate().all(|(k, f)| usize::from(f.img_idx) == k + 1));
    assert_eq!(files(folder.path()).len(), flight.exposures.len());
    assert_eq!(heard.damaged, 0);
    for (e, f) in flight.exposures.iter().zip(&heard.feedbacks) {
        // The position announced is where the autopilot believes to be at the trigger.
        let at = EnuFrame::new(flight.origin).to_geodetic(flight.reported.at(e.trigger_s).position);
        assert!((at.lat_deg * 1e7 - f64::from(f.lat)).abs() < 1.0 && (at.lon_deg * 1e7 - f64::from(f.lng)).abs() < 1.0);
    }
}

#[test]
fn two_runs_of_a_seed_say_the_same() {
    let said = || loop {
        let folder = tempfile::tempdir().expect("folder");
        let mut settings = quick();
        settings.autopilot.faults = FaultSettings { byte_loss_pct: 0.2, picture_loss_pct: 50.0, ..Default::default() };
        let (report, heard) = fly_and_listen(settings, folder.path(), None, Signer::off(), |_| {});
        if report.frames_dropped > 0 {
            continue; // This machine was too busy to read along; what is then missing is not the seed's doing.
        }
        let positions: Vec<_> = heard.positions.iter().map(|p| (p.lat, p.lon, p.alt)).collect();
        let names = files(folder.path());
        let picture = std::fs::read(folder.path().join(&names[0])).expect("picture");
        break (positions, names, picture);
    };
    let (a, b) = (said(), said());
    assert!(a.1 == b.1 && a.2 == b.2);
    assert!(a.1.len() < 9, "{:?}", a.1);
    // Positions before take-off repeat as often as the wait lasted; the flight itself is the same.
    let fly = |p: &[(i32, i32, i32)]| p.iter().copied().filter(|q| q.0 != p[0].0).take(40).collect::<Vec<_>>();
    assert_eq!(fly(&a.0), fly(&b.0));
}

#[test]
fn time_parameters_and_messages_are_answered() {
    let folder = tempfile::tempdir().expect("folder");
    let (_, heard) = fly_and_listen(quick(), folder.path(), None, Signer::off(), |line| {
        let mut send = |command, param1, param2| {
            let m = COMMAND_LONG_DATA { command, param1, param2, target_system: 1, ..Default::default() };
            line.send(&m).expect("sent");
        };
        send(MavCmd::MAV_CMD_SET_MESSAGE_INTERVAL, 108.0, 50_000.0);
        send(MavCmd::MAV_CMD_SET_MESSAGE_INTERVAL, 999.0, 50_000.0);
        send(MavCmd::MAV_CMD_NAV_LAND, 0.0, 0.0);
        line.send(&TIMESYNC_DATA { ts1: 12_345, ..Default::default() }).expect("sent");
        line.send(&PARAM_REQUEST_LIST_DATA { target_system: 1, target_component: 1 }).expect("sent");
        let set = PARAM_SET_DATA {
            param_value: 1e9,
            target_system: 1,
            param_id: "SIM_GPS1_GLTCH_Z".into(),
            ..Default::default()
        };
        line.send(&set).expect("sent");
    });
    let results: Vec<MavResult> = heard.acks.iter().map(|a| a.result).collect();
    assert_eq!(
        results,
        [MavResult::MAV_RESULT_ACCEPTED, MavResult::MAV_RESULT_DENIED, MavResult::MAV_RESULT_UNSUPPORTED]
    );
    assert!(heard.counts.get(&SIM_STATE_DATA::ID).copied().unwrap_or(0) > 200);
    let answer = heard.times.iter().find(|t| t.ts1 == 12_345).expect("an answer");
    assert!(answer.tc1 >= 30_000_000_000 && answer.target_component == 191);
    assert_eq!(heard.parameters.len(), config::faults::FaultSettings::PARAMETERS.len() + 1);
    let glitch = heard.parameters.iter().filter(|p| p.param_id.to_str() == Ok("SIM_GPS1_GLTCH_Z"));
    assert!(glitch.clone().any(|p| p.param_value == 1e4), "clamped into its range");
    assert!(heard.positions.last().expect("positions").relative_alt > 9_000_000, "and it acts at once");
}

#[test]
fn the_reference_holds_true_poses_and_views_no_aircraft_had() {
    let (folder, reference) = (tempfile::tempdir().expect("folder"), tempfile::tempdir().expect("folder"));
    let settings = quick();
    let flight = settings.flight().expect("flight");
    let lens = settings.lens;
    let (report, _) = fly_and_listen(settings, folder.path(), Some(reference.path()), Signer::off(), |_| {});
    assert!(report.completed);
    let read = |name| -> serde_json::Value {
        serde_json::from_slice(&std::fs::read(reference.path().join(name)).expect(name)).expect("json")
    };
    let (transforms, split) = (read("transforms.json"), read("split.json"));
    let frames = transforms["frames"].as_array().expect("frames");
    let flown = flown_views(&flight, &lens);
    assert_eq!(frames.len(), flown.len() + 4);
    assert_eq!(
        (split["train"].as_array().expect("train").len(), split["test"].as_array().expect("test").len()),
        (flown.len(), 4)
    );
    for (frame, view) in frames.iter().zip(&flown) {
        let m = &frame["transform_matrix"];
        let column =
            |k: usize| DVec3::new(m[0][k].as_f64().unwrap(), m[1][k].as_f64().unwrap(), m[2][k].as_f64().unwrap());
        assert!((column(3) - view.position).length() < 1e-9);
        assert!((-column(2) - view.rotation * DVec3::Z).length() < 1e-9, "OpenGL looks along -z");
    }
    for frame in frames {
        let path = reference.path().join(frame["file_path"].as_str().expect("path"));
        assert_eq!(image::open(path).expect("a picture").width(), 64);
    }
    let name = frames[2]["file_path"].as_str().expect("path").trim_start_matches("images/");
    let (a, b) = (reference.path().join("images").join(name), folder.path().join(name));
    assert_eq!(
        std::fs::read(a).expect("flown"),
        std::fs::read(b).expect("delivered"),
        "the flown pictures are the same files"
    );
}

#[test]
fn stopping_early_ends_cleanly_and_impossible_settings_say_why() {
    let folder = tempfile::tempdir().expect("folder");
    let stop = AtomicBool::new(true);
    let report = run(&quick(), &LinkAddress::Pty(None), folder.path(), None, &stop, &mut |_| {}).expect("clean");
    assert!(!report.completed && report.pictures.delivered == 0);
    let refused = |change: &dyn Fn(&mut SimSettings)| {
        let mut settings = quick();
        change(&mut settings);
        match run(&settings, &LinkAddress::Pty(None), folder.path(), None, &stop, &mut |_| {}) {
            Err(e) => e.to_string(),
            Ok(_) => String::new(),
        }
    };
    assert!(refused(&|s| s.region.truncate(2)).contains("three corners"));
    assert!(refused(&|s| s.session.speed = f64::NAN).contains("speed"));
    assert!(refused(&|s| s.lens.fx = 0.0).contains("fx"));
    assert!(refused(&|s| s.survey.side_overlap = 1.0).contains("overlap"));
}

#[test]
fn a_second_flight_into_the_same_folder_writes_over_no_picture_of_the_first() {
    let folder = tempfile::tempdir().expect("a folder");
    let (settings, prefix) = (quick(), &quick().prefix);
    let names = || -> Vec<String> {
        let flight = counted_on(settings.flight().expect("a flight"), folder.path(), prefix);
        flight.exposures.into_iter().map(|exposure| exposure.name).collect()
    };
    let first = names();
    assert_eq!(first.first(), Some(&aircraft::picture_name(prefix, 1)));
    first.iter().for_each(|name| std::fs::write(folder.path().join(name), b"").expect("written"));
    let second = names();
    assert_eq!(second.first(), Some(&aircraft::picture_name(prefix, first.len() as u64 + 1)));
    assert!(second.len() == first.len() && second.iter().all(|name| !first.contains(name)));
}
