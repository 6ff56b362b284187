//! An aircraft that lands half-way through its region for another battery: the flight goes on when it takes off again in time, and is
//! over when it does not. The autopilot speaks over a wire in memory, on a clock that moves only when told.

use std::collections::HashSet;
use std::path::Path;
use std::sync::Arc;
use std::time::Duration;

use config::coverage::CoverageSettings;
use config::link::LinkSettings;
use config::mission::{CameraSettings, KeyframeSettings, MountAttitude, MountSettings};
use disk::Disk;
use geometry::geodesy::{EnuFrame, Geodetic};
use glam::DVec3;
use hal::camera::FolderCamera;
use hal::link::{LinkAddress, WireLink};
use hal::mavlink::dialect::{
    ATTITUDE_DATA, CAMERA_FEEDBACK_DATA, GLOBAL_POSITION_INT_DATA, HEARTBEAT_DATA, MavAutopilot, MavModeFlag,
};
use hal::mavlink::{Encoder, MessageData};
use hal::time::ManualClock;
use hal::traits::Link;
use hal::vehicle::{Vehicle, VehicleSettings};
use models::camera::Intrinsics;
use pages::watch::Watch;

use super::geotags::Geotags;
use super::handover::handover;
use super::intake::{EndOfFlight, Ended, FlightCounters, FlightPlan, Intake};
use super::record::Recorder;

const ORIGIN: Geodetic = Geodetic { lat_deg: 47.4, lon_deg: 8.5, alt_m: 430.0 };
const LENS: CameraSettings = CameraSettings::pinhole(64, 48, 50.0);
/// Ten turns a second.
const TURN_MS: u64 = 100;

struct Autopilot {
    line: WireLink,
    encoder: Encoder,
}

impl Autopilot {
    fn say<D: MessageData>(&mut self, message: &D) {
        self.line.write(self.encoder.encode(message, None)).expect("written");
        // What the other side says is not kept.
        let mut heard = [0; 4096];
        while self.line.read(&mut heard, Duration::ZERO).is_ok_and(|r| r.bytes > 0) {}
    }

    fn at(&mut self, boot_ms: u32, armed: bool, east_m: f64, up_m: f64) -> Geodetic {
        if boot_ms.is_multiple_of(1000) {
            let mut heartbeat =
                HEARTBEAT_DATA { autopilot: MavAutopilot::MAV_AUTOPILOT_ARDUPILOTMEGA, ..HEARTBEAT_DATA::default() };
            heartbeat.base_mode.set(MavModeFlag::MAV_MODE_FLAG_SAFETY_ARMED, armed);
            self.say(&heartbeat);
        }
        let place = EnuFrame::new(ORIGIN).to_geodetic(DVec3::new(east_m, 0.0, up_m));
        self.say(&ATTITUDE_DATA { time_boot_ms: boot_ms, ..ATTITUDE_DATA::default() });
        self.say(&GLOBAL_POSITION_INT_DATA {
            time_boot_ms: boot_ms,
            lat: (place.lat_deg * 1e7) as i32,
            lon: (place.lon_deg * 1e7) as i32,
            alt: (place.alt_m * 1e3) as i32,
            relative_alt: (up_m * 1e3) as i32,
            ..GLOBAL_POSITION_INT_DATA::default()
        });
        place
    }
}

/// When the motors run, seconds: `flights` of 30 s each; a picture every two seconds while aloft.
fn flown(flights: &[u64], swap_s: f32, seconds: u64) -> (Option<(Ended, u64)>, FlightCounters) {
    let folder = tempfile::tempdir().expect("a folder");
    let pictures = folder.path().join("pictures");
    std::fs::create_dir(&pictures).expect("a folder");
    let clock = Arc::new(ManualClock::default());
    let vehicle = VehicleSettings {
        link: LinkSettings { battery_swap_s: swap_s, ..LinkSettings::default() },
        mount: MountSettings {
            attitude: MountAttitude::Fixed,
            rotation_deg: [0.0, -90.0, 0.0],
            ..MountSettings::default()
        },
        ..VehicleSettings::new(LinkAddress::Pty(None), LENS, ORIGIN)
    };
    let (line, other) = WireLink::pair();
    let camera = FolderCamera::open(&pictures).expect("the folder").on_simulated_clock();
    let plan = FlightPlan {
        vehicle: vehicle.clone(),
        intrinsics: Intrinsics { width: 64, height: 48, fx: 50.0, fy: 50.0, cx: 32.0, cy: 24.0 },
        keyframes: KeyframeSettings::default(),
        training_seconds: None,
        coverage: CoverageSettings::default(),
        region: vec![[-20.0, -20.0], [400.0, -20.0], [400.0, 20.0], [-20.0, 20.0]],
        earlier: Vec::new(),
        earlier_names: HashSet::new(),
        end: EndOfFlight { silence: Duration::from_secs(1800), patience: None },
        geotags: Geotags::open(&Disk::default(), folder.path(), ORIGIN).expect("a file"),
        watch: Watch::default(),
        recorder: Recorder::default(),
    };
    let (mut job, end) = handover();
    let mut intake =
        Intake::new(plan, Vehicle::new(line, camera, clock.clone(), &vehicle).expect("a vehicle"), clock.clone(), end);
    let mut autopilot = Autopilot { line: other, encoder: Encoder::new(1, 1) };
    let (mut exposures, mut taken) = (0, 0);
    for turn in 0..seconds * 1000 / TURN_MS {
        let (ms, s) = (turn * TURN_MS, turn * TURN_MS / 1000);
        clock.set(ms * 1_000_000);
        let since = |from: &u64| s.checked_sub(*from).filter(|since| *since < 30);
        let aloft = flights.iter().find_map(since);
        // Up within four seconds, along for twenty, down again; the second flight begins where the first one ended.
        let phase = |from: &u64| (ms as f64 / 1000.0 - *from as f64).clamp(0.0, 30.0);
        let east_m: f64 = flights.iter().map(|from| 5.0 * (phase(from) - 6.0).clamp(0.0, 20.0)).sum();
        let up_m = flights
            .iter()
            .map(|from| (10.0 * (phase(from) - 2.0)).min(10.0 * (30.0 - phase(from))).clamp(0.0, 40.0))
            .sum::<f64>();
        // Without a battery nothing is said; then the autopilot's clock and its count of exposures begin anew.
        let swap = flights.get(1).map(|up_s| (up_s - 12)..(up_s - 4));
        if swap.as_ref().is_some_and(|swap| swap.contains(&s)) {
            exposures = 0;
            intake.turn(Duration::ZERO).expect("capture waits");
            continue;
        }
        let boot_ms = match swap.filter(|swap| s >= swap.end) {
            Some(swap) => 2_000 + (ms - swap.end * 1000) as u32,
            None => 60_000 + ms as u32,
        };
        let place = autopilot.at(boot_ms, aloft.is_some(), east_m, up_m);
        if up_m >= 40.0 && ms % 2000 == 1000 {
            exposures += 1;
            autopilot.say(&CAMERA_FEEDBACK_DATA {
                time_usec: u64::from(boot_ms) * 1000,
                img_idx: exposures,
                lat: (place.lat_deg * 1e7) as i32,
                lng: (place.lon_deg * 1e7) as i32,
                alt_msl: place.alt_m as f32,
                ..CAMERA_FEEDBACK_DATA::default()
            });
            taken += 1;
            photograph(&pictures.join(format!("IMG_{taken:04}.jpg")), taken);
        }
        let ended = intake.turn(Duration::ZERO).expect("capture goes on");
        take_all(&mut job);
        if let Some(ended) = ended {
            return (Some((ended, s)), intake.finish());
        }
    }
    (None, intake.finish())
}

/// Takes what capture hands over.
fn take_all(job: &mut super::Handover) {
    use engine::PictureSource;
    while job.next(Duration::ZERO).is_ok_and(|frame| frame.is_some()) {}
}

fn photograph(path: &Path, number: u16) {
    let image = image::RgbImage::from_fn(64, 48, |x, y| image::Rgb([(x * 4) as u8, (y * 5) as u8, number as u8]));
    image.save(path).expect("written");
}

#[test]
fn a_battery_swap_goes_on_with_the_same_flight_and_one_that_takes_too_long_ends_it() {
    // Down at 40 s, up again at 60 s, down at 90 s.
    let (ended, counters) = flown(&[10, 60], 60.0, 400);
    let (why, at_s) = ended.expect("it ends");
    assert!(why == Ended::Landed && at_s >= 90 + 60, "{why:?} at {at_s} s");
    let both = counters.hal.pictures.pictures;
    assert_eq!((counters.hal.posed_frames, counters.unmatched), (both, 0));
    let (ended, counters) = flown(&[10], 20.0, 400);
    let (why, at_s) = ended.expect("it ends");
    assert!(why == Ended::Landed && (60..90).contains(&at_s), "{why:?} at {at_s} s");
    assert_eq!(both, 2 * counters.hal.pictures.pictures);
    let (ended, _) = flown(&[10], 0.0, 400);
    assert!(ended.is_some_and(|(_, at_s)| at_s < 60), "{ended:?}");
}
