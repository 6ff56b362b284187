//! Flights as vehicles of others fly them, each told as a story: what the autopilot, its cameras and its mounts say, and when pictures
//! come. A survey of three lines with a picture every two seconds, on a simulated clock.

#![allow(clippy::expect_used, clippy::panic, reason = "a test fails by panicking")]

#[allow(dead_code, reason = "stories of other files use the rest")]
mod sortie;

use config::mission::MountAttitude;
use glam::DVec3;
use hal::matcher::Reason;
use hal::mavlink::dialect::{
    CAMERA_FEEDBACK_DATA, CAMERA_IMAGE_CAPTURED_DATA, COMMAND_INT_DATA, COMMAND_LONG_DATA, DIGICAM_CONTROL_DATA,
    GIMBAL_DEVICE_ATTITUDE_STATUS_DATA, GimbalDeviceFlags, MavBool, MavCmd,
};
use hal::traits::PictureClues;
use hal::vehicle::{Complaint, UnmatchedReason, VehicleSettings};

use sortie::{Flown, SECOND, Sortie, boot_ms, boot_us, on_earth, settings, unix_us};

const AUTOPILOT: (u8, u8) = (1, 1);
const SHOTS: usize = 12;
const BEGIN_S: f64 = 10.0;
const INTERVAL_S: f64 = 2.0;
const SPEED_M_S: f64 = 5.0;
/// A picture is complete so long after its exposure.
const LATENCY_S: f64 = 0.3;
/// Places are right within 30 ms of flight.
const RIGHT_M: f64 = 0.15;

/// A flight and where it takes place.
struct Story {
    sortie: Sortie,
    settings: VehicleSettings,
    base: DVec3,
}

/// Three lines of 30 m, 10 m apart, without a stop.
fn path(at_s: f64) -> DVec3 {
    let flown = ((at_s - BEGIN_S) * SPEED_M_S).clamp(0.0, 110.0);
    let (line, along) = ((flown / 40.0).floor().min(2.0), flown % 40.0);
    let forth = if line % 2.0 == 0.0 { along.min(30.0) } else { 30.0 - along.min(30.0) };
    DVec3::new(10.0 * line + (along - 30.0).max(0.0), forth, 40.0)
}

fn shot(k: usize) -> f64 {
    BEGIN_S + k as f64 * INTERVAL_S
}

impl Story {
    fn new() -> Self {
        Self::at(DVec3::ZERO)
    }

    fn at(base: DVec3) -> Self {
        let mut sortie = Sortie::default();
        sortie.telemetry(1, [2.0, shot(SHOTS) + 12.0], 20.0, |at| base + path(at));
        Self { sortie, settings: settings(1), base }
    }

    /// The message of exposure `k` of a camera, with the number and the time that it says.
    fn feedback(&self, k: usize, (camera, number): (u8, u16), time_usec: u64) -> CAMERA_FEEDBACK_DATA {
        let ([lat, lng], alt_m) = on_earth(self.base + path(shot(k)));
        CAMERA_FEEDBACK_DATA {
            time_usec,
            cam_idx: camera,
            img_idx: number,
            lat,
            lng,
            alt_msl: alt_m as f32,
            ..CAMERA_FEEDBACK_DATA::default()
        }
    }

    /// Exposure `k` is announced `late_s` after it, and its picture comes.
    fn exposes(&mut self, k: usize, late_s: f64) {
        let message = self.feedback(k, (0, k as u16 + 1), unix_us(shot(k)));
        self.sortie.say(shot(k) + late_s, AUTOPILOT, &message);
        self.takes(k);
    }

    fn takes(&mut self, k: usize) {
        self.takes_at(k, shot(k) + LATENCY_S);
    }

    fn takes_at(&mut self, k: usize, at_s: f64) {
        let clues =
            PictureClues { arrived_ns: (at_s * SECOND) as u64, number: Some(k as u64 + 1), ..PictureClues::default() };
        self.sortie.takes(clues, k.to_string());
    }

    fn fly(self) -> (Flown, DVec3) {
        (self.sortie.fly(&self.settings), self.base)
    }

    /// Every picture has its own exposure's place.
    #[track_caller]
    fn all_right(self) -> Flown {
        let (flown, base) = self.fly();
        right(&flown, base);
        assert_eq!(flown.posed.len(), SHOTS, "{:?}", flown.unmatched);
        flown
    }
}

/// No picture has another exposure's place.
#[track_caller]
fn right(flown: &Flown, base: DVec3) {
    for (name, place, confidence) in flown.places() {
        let off = (place - base - path(shot(name.parse().expect("its number")))).length();
        assert!(off < RIGHT_M, "picture {name} is {off:.2} m off at {confidence:.2}");
    }
}

/// A story of which every exposure goes as `each` tells it.
fn story(mut each: impl FnMut(&mut Story, usize)) -> Story {
    let mut story = Story::new();
    (0..SHOTS).for_each(|k| each(&mut story, k));
    story
}

#[test]
fn a_plain_survey_is_posed_also_far_in_the_south_west_of_the_missions_origin() {
    story(|s, k| s.exposes(k, 0.0)).all_right();
    let mut far = Story::at(DVec3::new(-1900.0, -2700.0, 0.0));
    (0..SHOTS).for_each(|k| far.exposes(k, 0.0));
    let flown = far.all_right();
    assert!(flown.places().iter().all(|(_, place, _)| place.x < -1800.0 && place.y < -2600.0));
}

#[test]
fn of_two_cameras_exposed_together_or_each_by_itself_ours_is_believed() {
    let together = |s: &mut Story, k: usize| {
        let other = s.feedback(k, (1, k as u16 + 4), unix_us(shot(k)));
        s.exposes(k, 0.0);
        s.sortie.say(shot(k) + 0.001, AUTOPILOT, &other);
    };
    story(together).all_right();
    let mut own = story(|s, k| s.exposes(k, 0.0));
    for n in 0..40u16 {
        let at = BEGIN_S + 0.7 * f64::from(n);
        let ([lat, lng], _) = on_earth(path(at));
        let other = CAMERA_FEEDBACK_DATA {
            time_usec: unix_us(at),
            cam_idx: 1,
            img_idx: n + 1,
            lat,
            lng,
            ..CAMERA_FEEDBACK_DATA::default()
        };
        own.sortie.say(at, AUTOPILOT, &other);
    }
    own.all_right();
}

#[test]
fn px4s_captures_are_exposures_whether_they_succeeded_or_nobody_knows_and_failed_ones_are_none() {
    let captured = |s: &mut Story, k: usize, result: u8| {
        let ([lat, lon], alt_m) = on_earth(path(shot(k)));
        let message = CAMERA_IMAGE_CAPTURED_DATA {
            time_boot_ms: boot_ms(shot(k)),
            time_utc: unix_us(shot(k)),
            lat,
            lon,
            alt: (alt_m * 1e3) as i32,
            q: [1.0, 0.0, 0.0, 0.0],
            image_index: k as i32,
            capture_result: MavBool::from_bits_retain(result),
            ..CAMERA_IMAGE_CAPTURED_DATA::default()
        };
        s.sortie.say(shot(k), AUTOPILOT, &message);
    };
    // 1; and −1 of an autopilot that has no feedback from the hot-shoe.
    for result in [1, 0xFF] {
        let whole = story(|s, k| {
            captured(s, k, result);
            s.takes(k);
        });
        assert_eq!(whole.all_right().exposures, SHOTS);
    }
    // Two of them fail: no exposure, no picture that anybody misses.
    let failed = story(|s, k| {
        let fails = [4, 7].contains(&k);
        captured(s, k, if fails { 0 } else { 0xFF });
        if !fails {
            s.takes(k);
        }
    });
    let (flown, base) = failed.fly();
    right(&flown, base);
    assert_eq!((flown.exposures, flown.posed.len(), flown.unmatched.len()), (SHOTS - 2, SHOTS - 2, 0));
}

#[test]
fn exposures_without_a_time_with_a_number_that_stands_still_and_doubled_frames_are_exposures() {
    story(|s, k| {
        let message = s.feedback(k, (0, k as u16 + 1), 0);
        s.sortie.say(shot(k), AUTOPILOT, &message);
        s.takes(k);
    })
    .all_right();
    story(|s, k| {
        let message = s.feedback(k, (0, 0), unix_us(shot(k)));
        s.sortie.say(shot(k), AUTOPILOT, &message);
        s.takes(k);
    })
    .all_right();
    let doubled = story(|s, k| {
        let message = s.feedback(k, (0, k as u16 + 1), unix_us(shot(k)));
        let bytes = s.sortie.encode(AUTOPILOT, &message);
        s.sortie.arrives(shot(k), bytes.clone());
        s.sortie.arrives(shot(k) + 0.02, bytes);
        s.takes(k);
    });
    let flown = doubled.all_right();
    assert_eq!((flown.exposures, flown.counters.exposures.trigger_duplicates), (SHOTS, SHOTS as u64));
}

#[test]
fn announcements_that_come_late_all_or_one_at_the_start_or_in_mid_flight_shift_no_picture() {
    for late_s in [1.0, 1.3, 2.0, 2.6, 3.0] {
        story(|s, k| s.exposes(k, late_s)).all_right();
    }
    for one in [0, 6, SHOTS - 1] {
        for late_s in [1.3, 2.5, 3.9] {
            story(|s, k| s.exposes(k, if k == one { late_s } else { 0.1 })).all_right();
        }
    }
}

#[test]
fn a_hot_shoe_that_blinks_twice_is_believed_at_the_shutter() {
    story(|s, k| {
        // Writing takes 0.7 to 1.3 s.
        let written = shot(k) + 0.7 + 0.6 * ((k * k) as f64 * 0.618).fract();
        let shutter = s.feedback(k, (0, 2 * k as u16 + 1), unix_us(shot(k)));
        s.sortie.say(shot(k), AUTOPILOT, &shutter);
        let card = CAMERA_FEEDBACK_DATA { img_idx: 2 * k as u16 + 2, time_usec: unix_us(written), ..shutter };
        s.sortie.say(written, AUTOPILOT, &card);
        s.takes_at(k, written + 0.1);
    })
    .all_right();
}

#[test]
fn a_clock_that_goes_back_by_1024_weeks_or_is_set_in_mid_flight_moves_no_exposure() {
    const WEEKS_US: u64 = 1024 * 7 * 86_400 * 1_000_000;
    let set_at = shot(5) + 1.0;
    let stamps: [&dyn Fn(f64) -> u64; 2] = [&|at| unix_us(at) - if at > set_at { WEEKS_US } else { 0 }, &|at| {
        if at > set_at { unix_us(at) } else { boot_us(at) }
    }];
    for stamp in stamps {
        story(|s, k| {
            let message = s.feedback(k, (0, k as u16 + 1), stamp(shot(k)));
            s.sortie.say(shot(k), AUTOPILOT, &message);
            s.takes(k);
        })
        .all_right();
    }
}

#[test]
fn every_way_to_ask_for_a_picture_takes_one_picture_each() {
    type Ask = fn(&mut Story, usize);
    let asks: [(&str, Ask); 4] = [
        ("DIGICAM_CONTROL, the message", |s, k| {
            let message = DIGICAM_CONTROL_DATA {
                target_system: 1,
                target_component: 100,
                shot: 1,
                ..DIGICAM_CONTROL_DATA::default()
            };
            s.sortie.say(shot(k), AUTOPILOT, &message);
        }),
        ("COMMAND_INT", |s, k| {
            let message = COMMAND_INT_DATA {
                param3: 1.0,
                param4: k as f32 + 1.0,
                command: MavCmd::MAV_CMD_IMAGE_START_CAPTURE,
                target_system: 1,
                target_component: 100,
                ..COMMAND_INT_DATA::default()
            };
            s.sortie.say(shot(k), AUTOPILOT, &message);
        }),
        ("COMMAND_LONG", |s, k| {
            let message = start_capture(k, 0);
            s.sortie.say(shot(k), AUTOPILOT, &message);
        }),
        ("COMMAND_LONG, sent again for want of an answer", |s, k| {
            for (after_s, confirmation) in [(0.0, 0), (0.7, 1)] {
                let message = start_capture(k, confirmation);
                s.sortie.say(shot(k) + after_s, AUTOPILOT, &message);
            }
        }),
    ];
    for (name, ask) in asks {
        let story = story(|s, k| {
            ask(s, k);
            s.takes(k);
        });
        assert_eq!(story.all_right().exposures, SHOTS, "{name}");
    }
}

fn start_capture(k: usize, confirmation: u8) -> COMMAND_LONG_DATA {
    COMMAND_LONG_DATA {
        param3: 1.0,
        param4: k as f32 + 1.0,
        command: MavCmd::MAV_CMD_IMAGE_START_CAPTURE,
        target_system: 1,
        target_component: 100,
        confirmation,
        ..COMMAND_LONG_DATA::default()
    }
}

#[test]
fn another_aircraft_on_the_line_with_exposures_of_its_own_is_left_out() {
    let mut story = story(|s, k| s.exposes(k, 0.0));
    story.sortie.telemetry(2, [2.0, shot(SHOTS)], 5.0, |at| path(at + 3.0) + DVec3::new(500.0, 0.0, 0.0));
    for k in 0..SHOTS {
        let message = story.feedback(k, (0, k as u16 + 50), unix_us(shot(k) + 0.4));
        story.sortie.say(shot(k) + 0.4, (2, 1), &message);
    }
    assert_eq!(story.all_right().exposures, SHOTS);
}

#[test]
fn pictures_that_nobody_announces_are_named_and_announced_ones_that_never_come_are_missed() {
    let (unannounced, _) = story(Story::takes).fly();
    assert!(unannounced.posed.is_empty() && unannounced.exposures == 0);
    let named = unannounced.complaints.iter().any(|line| line.starts_with(Complaint::Unannounced.name()));
    assert!(named, "{:?}", unannounced.complaints);
    // The autopilot announces, and no camera takes pictures.
    let announced_only = story(|s, k| {
        let message = s.feedback(k, (0, k as u16 + 1), unix_us(shot(k)));
        s.sortie.say(shot(k), AUTOPILOT, &message);
    });
    let (announced_only, _) = announced_only.fly();
    let missed = |u: &&hal::vehicle::Unmatched| u.reason == UnmatchedReason::Matching(Reason::NoPicture);
    assert_eq!(announced_only.unmatched.iter().filter(missed).count(), SHOTS);
    assert_eq!(announced_only.counters.exposures.triggers_unmatched, SHOTS as u64);
    assert!(announced_only.camera_was_silent, "the failsafe hears of it in flight");
    assert!(announced_only.posed.is_empty() && announced_only.exposures == SHOTS);
}

/// A mount that reports where it points, radians: yaw against the airframe.
fn report(at_s: f64, device: u8, pitch: f64, yaw: f64, in_earth: bool) -> GIMBAL_DEVICE_ATTITUDE_STATUS_DATA {
    let (p, y) = (pitch / 2.0, yaw / 2.0);
    let q = [y.cos() * p.cos(), -y.sin() * p.sin(), y.cos() * p.sin(), y.sin() * p.cos()].map(|v| v as f32);
    let lock = GimbalDeviceFlags::GIMBAL_DEVICE_FLAGS_ROLL_LOCK | GimbalDeviceFlags::GIMBAL_DEVICE_FLAGS_PITCH_LOCK;
    let frame = match in_earth {
        true => {
            GimbalDeviceFlags::GIMBAL_DEVICE_FLAGS_YAW_LOCK | GimbalDeviceFlags::GIMBAL_DEVICE_FLAGS_YAW_IN_EARTH_FRAME
        }
        false => GimbalDeviceFlags::GIMBAL_DEVICE_FLAGS_YAW_IN_VEHICLE_FRAME,
    };
    GIMBAL_DEVICE_ATTITUDE_STATUS_DATA {
        time_boot_ms: boot_ms(at_s),
        flags: lock | frame,
        q,
        gimbal_device_id: device,
        ..GIMBAL_DEVICE_ATTITUDE_STATUS_DATA::default()
    }
}

#[test]
fn two_mounts_or_one_reported_twice_are_never_interpolated_into_each_other() {
    use std::f64::consts::{FRAC_PI_2, FRAC_PI_4};
    type Tell = fn(&mut Story, f64);
    let down: Tell = |s, at| s.sortie.say(at, AUTOPILOT, &report(at, 1, -FRAC_PI_2, 0.0, false));
    let two: Tell = |s, at| {
        s.sortie.say(at, AUTOPILOT, &report(at, 1, -FRAC_PI_2, 0.0, false));
        s.sortie.say(at, AUTOPILOT, &report(at, 2, 0.0, 0.0, false));
    };
    // The second one's message is made a millisecond later.
    let later: Tell = |s, at| {
        s.sortie.say(at, AUTOPILOT, &report(at, 1, -FRAC_PI_2, 0.0, false));
        s.sortie.say(at, AUTOPILOT, &report(at + 0.001, 2, 0.0, 0.0, false));
    };
    // A mount of its own component whose clock starts elsewhere, in the earth's frame, and the autopilot's report of it.
    let own: Tell = |s, at| {
        s.sortie.say(at, (1, 154), &report(at - 50.0_f64.min(at), 0, -FRAC_PI_4, 0.7, true));
        s.sortie.say(at, AUTOPILOT, &report(at, 154, -FRAC_PI_4, 0.7, false));
    };
    for (name, tell, pitch_deg) in
        [("one", down, -90.0), ("two", two, -90.0), ("later", later, -90.0), ("own", own, -45.0)]
    {
        let mut story = story(|s, k| s.exposes(k, 0.0));
        story.settings.mount.attitude = MountAttitude::Gimbal;
        (0..(20.0 * shot(SHOTS)) as usize).map(|n| 2.0 + n as f64 * 0.05).for_each(|at| tell(&mut story, at));
        let flown = story.all_right();
        for posed in &flown.posed {
            let forward = posed.pose.rotation * DVec3::Z;
            let off = (forward.z.asin().to_degrees() - pitch_deg).abs();
            assert!(off < 1.0 && posed.pose.rotation_sigma_rad.iter().all(|s| *s < 0.1), "{name}: {off} {posed:?}");
        }
    }
}
