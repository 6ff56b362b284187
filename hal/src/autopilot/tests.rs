//! What autopilots really send, message by message.

use geometry::geodesy::{EnuFrame, Geodetic};
use glam::{DQuat, DVec3};

use super::*;
use crate::frames::euler_to_ned;
use crate::mavlink::dialect::{GimbalDeviceFlags, GpsFixType, MavBool, MavFrame};
use crate::mavlink::{Encoder, Framer};
use crate::trigger::{Source, TriggerKind};

const S: u64 = 1_000_000_000;
const HOME: Geodetic = Geodetic { lat_deg: 46.84265, lon_deg: -91.9939, alt_m: 200.0 };

/// An autopilot heard through real frames, one per call.
struct Wire {
    autopilot: Autopilot,
    encoder: Encoder,
    now_ns: u64,
}

impl Wire {
    fn new() -> Self {
        let ids = Ids { system: 1, autopilot: 1, own_component: 100 };
        Self { autopilot: Autopilot::new(ids), encoder: Encoder::new(1, 1), now_ns: 500 * S }
    }

    fn handle<D: MessageData>(&mut self, message: &D) -> Handled {
        let mut framer = Framer::new();
        framer.push(self.encoder.encode(message, None));
        self.autopilot.handle(&framer.next_frame().expect("a frame"), self.now_ns)
    }

    /// Level flight east at 10 m/s from boot time `from_ms`, 25 attitudes and 10 positions a second.
    fn fly(&mut self, from_ms: u32, to_ms: u32) {
        for time_boot_ms in (from_ms..to_ms).step_by(20) {
            self.now_ns += 20_000_000;
            if time_boot_ms % 40 == 0 {
                self.handle(&ATTITUDE_QUATERNION_DATA { time_boot_ms, q1: 1.0, ..Default::default() });
            }
            if time_boot_ms % 100 == 0 {
                self.position(time_boot_ms, 0.0);
            }
        }
    }

    fn position(&mut self, time_boot_ms: u32, off_m: f64) -> Handled {
        let east = f64::from(time_boot_ms) * 0.01;
        let at = EnuFrame::new(HOME).to_geodetic(DVec3::new(east, off_m, 0.0));
        self.handle(&GLOBAL_POSITION_INT_DATA {
            time_boot_ms,
            lat: (at.lat_deg * 1e7) as i32,
            lon: (at.lon_deg * 1e7) as i32,
            alt: (at.alt_m * 1e3) as i32,
            vy: 1000,
            ..Default::default()
        })
    }

    fn counters(&self) -> HalCounters {
        self.autopilot.counters()
    }
}

#[test]
fn feedback_is_placed_from_unix_time_and_from_wrapping_boot_time() {
    let mut h = Wire::new();
    h.fly(10_000, 12_000);
    let boot_us = (1u64 << 32) - 500_000;
    h.handle(&SYSTEM_TIME_DATA { time_unix_usec: 1_795_248_400_000_000, time_boot_ms: 12_000 });
    h.handle(&CAMERA_FEEDBACK_DATA { time_usec: 1_795_248_399_500_000, img_idx: 1, ..Default::default() });
    h.handle(&CAMERA_FEEDBACK_DATA { time_usec: 11_900_000, img_idx: 3, ..Default::default() });
    h.handle(&CAMERA_FEEDBACK_DATA { time_usec: 11_900_000, img_idx: 3, ..Default::default() });
    // Not a time of this flight: taken at its arrival.
    h.handle(&CAMERA_FEEDBACK_DATA { time_usec: boot_us, img_idx: 4, ..Default::default() });
    let times: std::vec::Vec<_> =
        core::iter::from_fn(|| h.autopilot.next_trigger()).map(|t| (t.sequence, t.boot_ns / 1_000_000)).collect();
    assert_eq!(times[..2], [(1, 11_500), (3, 11_900)]);
    assert!(times.len() == 3 && times[2].1.abs_diff(12_000) < 60, "{times:?}");
    let c = h.counters();
    assert_eq!(
        (
            c.exposures.triggers,
            c.exposures.trigger_gaps,
            c.exposures.trigger_duplicates,
            c.exposures.trigger_times_mended
        ),
        (3, 1, 1, 1)
    );
}

/// Exposures once a second between 10 and 30 s after boot, stamped with the Unix time that `unix_us` says at a boot time, us; when they
/// were by the boot clock, ms.
fn exposed_by(unix_us: impl Fn(u64) -> u64) -> std::vec::Vec<u64> {
    let mut h = Wire::new();
    let mut times = std::vec::Vec::new();
    for s in 10..30u32 {
        let boot_us = u64::from(s) * 1_000_000;
        h.fly(s * 1000, s * 1000 + 1000);
        h.handle(&SYSTEM_TIME_DATA { time_unix_usec: unix_us(boot_us + 900_000), time_boot_ms: s * 1000 + 900 });
        let time_usec = unix_us(boot_us + 950_000);
        h.handle(&CAMERA_FEEDBACK_DATA { time_usec, img_idx: (s - 9) as u16, ..Default::default() });
        times.extend(core::iter::from_fn(|| h.autopilot.next_trigger()).map(|t| t.boot_ns / 1_000_000));
    }
    times
}

#[test]
fn a_rollover_of_gps_weeks_and_a_clock_that_is_set_in_mid_flight_move_no_exposure() {
    const UNIX_US: u64 = 1_795_248_400_000_000;
    const ROLLOVER_US: u64 = 1024 * 7 * 86_400 * 1_000_000;
    let wanted: std::vec::Vec<u64> = (10..30).map(|s| s * 1000 + 950).collect();
    assert_eq!(exposed_by(|boot| UNIX_US + boot), wanted);
    assert_eq!(exposed_by(|boot| UNIX_US + boot - if boot > 20_000_000 { ROLLOVER_US } else { 0 }), wanted);
    assert_eq!(exposed_by(|boot| boot + if boot > 20_000_000 { UNIX_US } else { 0 }), wanted);
}

#[test]
fn px4s_second_announcement_of_an_exposure_is_a_duplicate() {
    let mut h = Wire::new();
    h.fly(10_000, 11_000);
    for seq in 5..8u32 {
        h.fly(11_000 + seq * 1000, 12_000 + seq * 1000);
        let boot_ms = 11_900 + seq * 1000;
        h.handle(&CAMERA_TRIGGER_DATA { time_usec: u64::from(boot_ms) * 1000, seq });
        let captured = CAMERA_IMAGE_CAPTURED_DATA {
            time_boot_ms: boot_ms,
            image_index: seq as i32,
            capture_result: MavBool::MAV_BOOL_TRUE,
            ..Default::default()
        };
        h.handle(&captured);
    }
    let kinds: std::vec::Vec<_> = core::iter::from_fn(|| h.autopilot.next_trigger()).map(|t| t.kind).collect();
    assert_eq!(kinds, [TriggerKind::CameraTrigger; 3]);
    assert_eq!(h.counters().exposures.trigger_duplicates, 3);
}

#[test]
fn our_own_exposure_gives_way_to_the_autopilots_announcement() {
    let mut h = Wire::new();
    h.fly(10_000, 11_000);
    h.autopilot.announce_own(1, h.now_ns);
    h.handle(&CAMERA_FEEDBACK_DATA { time_usec: 10_950_000, img_idx: 1, ..Default::default() });
    h.autopilot.settle_own(h.now_ns + S);
    assert_eq!(h.autopilot.next_trigger().map(|t| t.kind), Some(TriggerKind::Feedback));
    assert_eq!(h.autopilot.next_trigger(), None);
    // Without one it counts, at the time it was made.
    h.now_ns += 20 * S;
    h.fly(31_000, 32_000);
    h.autopilot.announce_own(2, h.now_ns);
    h.autopilot.settle_own(h.now_ns + S);
    let trigger = h.autopilot.next_trigger().expect("announced");
    assert!(trigger.kind == TriggerKind::Command && trigger.boot_ns.abs_diff(32 * S) < S / 10, "{trigger:?}");
}

#[test]
fn odometry_is_placed_by_the_origin_and_only_in_frames_tied_to_north() {
    let mut h = Wire::new();
    h.handle(&SYSTEM_TIME_DATA { time_unix_usec: 0, time_boot_ms: 5_000 });
    let odometry = ODOMETRY_DATA {
        time_usec: 5_000_000,
        x: 30.0,
        y: 40.0,
        z: -50.0,
        q: [1.0, 0.0, 0.0, 0.0],
        vx: 2.0,
        frame_id: MavFrame::MAV_FRAME_LOCAL_NED,
        child_frame_id: MavFrame::MAV_FRAME_BODY_FRD,
        pose_covariance: [f32::NAN; 21],
        ..Default::default()
    };
    assert_eq!(h.handle(&odometry), Handled::Other, "no origin yet");
    h.handle(&GPS_GLOBAL_ORIGIN_DATA {
        latitude: (HOME.lat_deg * 1e7) as i32,
        longitude: (HOME.lon_deg * 1e7) as i32,
        altitude: 200_000,
        ..Default::default()
    });
    let next = ODOMETRY_DATA { time_usec: 5_100_000, ..odometry.clone() };
    assert_eq!(h.handle(&next), Handled::Position);
    let pose = h.autopilot.pose_at(5_100_000_000).expect("a pose");
    let enu = EnuFrame::new(HOME).to_enu(pose.position);
    assert!((enu - DVec3::new(40.0, 30.0, 50.0)).length() < 0.02, "{enu}");
    assert!((pose.velocity - DVec3::new(0.0, 2.0, 0.0)).length() < 1e-6 && pose.position_sigma_m.is_finite());
    let adrift = ODOMETRY_DATA { time_usec: 5_200_000, frame_id: MavFrame::MAV_FRAME_LOCAL_FRD, ..odometry.clone() };
    assert_eq!(h.handle(&adrift), Handled::Other);
    h.handle(&ODOMETRY_DATA { time_usec: 5_300_000, x: f32::NAN, ..odometry.clone() });
    h.handle(&ODOMETRY_DATA { time_usec: 5_400_000, reset_counter: 1, ..odometry });
    assert_eq!((h.counters().telemetry.impossible, h.counters().telemetry.position_steps), (1, 1));
}

#[test]
fn gimbal_yaw_obeys_its_frame_flags() {
    let east = core::f64::consts::FRAC_PI_2;
    let flag = |f| GimbalDeviceFlags::GIMBAL_DEVICE_FLAGS_PITCH_LOCK | f;
    for (flags, vehicle_frame) in [
        (flag(GimbalDeviceFlags::GIMBAL_DEVICE_FLAGS_YAW_IN_VEHICLE_FRAME), true),
        (flag(GimbalDeviceFlags::GIMBAL_DEVICE_FLAGS_YAW_IN_EARTH_FRAME), false),
        (flag(GimbalDeviceFlags::GIMBAL_DEVICE_FLAGS_YAW_LOCK), false),
        (GimbalDeviceFlags::GIMBAL_DEVICE_FLAGS_PITCH_LOCK, true),
    ] {
        let mut h = Wire::new();
        let wire = |q: DQuat| [q.w as f32, q.x as f32, q.y as f32, q.z as f32];
        let [q1, q2, q3, q4] = wire(euler_to_ned(0.1, 0.0, east));
        let q = wire(euler_to_ned(0.0, -0.5, 0.0));
        for time_boot_ms in [8_000, 8_100] {
            h.handle(&ATTITUDE_QUATERNION_DATA { time_boot_ms, q1, q2, q3, q4, ..Default::default() });
            h.position(time_boot_ms, 0.0);
            h.handle(&GIMBAL_DEVICE_ATTITUDE_STATUS_DATA {
                time_boot_ms,
                q,
                flags,
                delta_yaw: f32::NAN,
                ..Default::default()
            });
        }
        let forward = h.autopilot.pose_at(8_050_000_000).expect("a pose").gimbal.expect("reported") * DVec3::X;
        let heading = if vehicle_frame { DVec3::X } else { DVec3::Y };
        let expected = heading * 0.5f64.cos() - DVec3::Z * 0.5f64.sin();
        assert!((forward - expected).length() < 1e-6, "{flags:?}: {forward}");
    }
}

#[test]
fn a_spike_is_left_out_and_a_lasting_jump_is_followed_with_its_size_as_uncertainty() {
    let mut h = Wire::new();
    h.fly(10_000, 12_000);
    assert_eq!(h.position(12_000, 60.0), Handled::Other);
    h.handle(&ATTITUDE_QUATERNION_DATA { time_boot_ms: 12_000, q2: 1.0, ..Default::default() });
    h.handle(&ATTITUDE_QUATERNION_DATA { time_boot_ms: 12_010, q1: f32::NAN, ..Default::default() });
    h.fly(12_100, 13_000);
    assert_eq!(
        (h.counters().telemetry.spikes, h.counters().telemetry.impossible, h.counters().telemetry.position_steps),
        (2, 1, 0)
    );
    let heard: std::vec::Vec<_> = (0..6).map(|i| h.position(13_000 + i * 100, 60.0)).collect();
    assert_eq!(
        heard,
        [Handled::Other, Handled::Other, Handled::Other, Handled::Other, Handled::Position, Handled::Position]
    );
    assert_eq!(h.counters().telemetry.position_steps, 1);
    let newest = h.autopilot.track().newest_position().expect("one");
    assert!(newest.sigma_m.min_element() > 50.0, "{}", newest.sigma_m);
}

#[test]
fn gps_accuracy_reaches_the_pose_and_its_loss_shows() {
    let mut h = Wire::new();
    let gps = |fix_type, h_acc, eph| GPS_RAW_INT_DATA {
        fix_type,
        h_acc,
        v_acc: 900,
        eph,
        epv: u16::MAX,
        ..Default::default()
    };
    for (message, east) in [
        (gps(GpsFixType::GPS_FIX_TYPE_RTK_FIXED, 14, 100), 0.0099),
        (gps(GpsFixType::GPS_FIX_TYPE_3D_FIX, 0, 80), 0.8485),
        (gps(GpsFixType::GPS_FIX_TYPE_NO_FIX, 0, u16::MAX), 100.0),
    ] {
        h.handle(&message);
        let next = h.autopilot.track().newest_position().map_or(9_000, |p| (p.boot_ns / 1_000_000) as u32 + 100);
        h.position(next, 0.0);
        let sigma = h.autopilot.track().newest_position().expect("one").sigma_m;
        assert!((sigma.x - east).abs() < 1e-3 * east.max(1.0), "{sigma}");
    }
    assert_eq!(h.autopilot.state(h.now_ns).gps_fix, Some(1));
}

#[test]
fn a_restarted_autopilot_starts_a_new_track() {
    let mut h = Wire::new();
    h.fly(600_000, 602_000);
    h.fly(3_000, 5_000);
    assert_eq!(h.counters().telemetry.clock_restarts, 1);
    assert_eq!(h.autopilot.pose_at(601 * S), Err(PoseError::NotYet));
    assert!(h.autopilot.pose_at(4 * S).is_ok());
    let mapped = h.autopilot.clock().to_companion_ns(4_900_000_000).expect("mapped");
    assert!(mapped.abs_diff(h.now_ns) < S / 5);
}

#[test]
fn other_systems_and_our_own_echo_are_ignored_and_a_timesync_is_answered() {
    let mut h = Wire::new();
    h.encoder = Encoder::new(2, 1);
    assert_eq!(h.position(9_000, 0.0), Handled::Foreign);
    h.encoder = Encoder::new(1, 100);
    assert_eq!(h.position(9_000, 0.0), Handled::Foreign);
    assert_eq!(h.counters().link.foreign, 2);
    h.encoder = Encoder::new(1, 1);
    h.handle(&TIMESYNC_DATA { tc1: 0, ts1: 77, ..Default::default() });
    let answer = h.autopilot.next_answer().expect("an answer");
    assert_eq!((answer.ts1, answer.tc1), (77, h.now_ns as i64));
    h.handle(&TIMESYNC_DATA { tc1: 0, ts1: 78, target_system: 1, target_component: 50 });
    assert_eq!(h.autopilot.next_answer(), None);
}

fn announced(h: &mut Wire) -> std::vec::Vec<(u8, u32, u64)> {
    let all = core::iter::from_fn(|| h.autopilot.next_trigger());
    all.map(|t| (t.source.camera, t.sequence, t.boot_ns / 1_000_000)).collect()
}

#[test]
fn two_cameras_of_one_autopilot_count_for_themselves() {
    let mut h = Wire::new();
    h.fly(10_000, 12_000);
    for (cam_idx, img_idx, ms) in [(0, 1, 11_000), (1, 4, 11_000), (0, 2, 11_500), (1, 5, 11_500), (1, 6, 11_900)] {
        h.handle(&CAMERA_FEEDBACK_DATA { cam_idx, img_idx, time_usec: ms * 1000, ..Default::default() });
    }
    let expected = [(0, 1, 11_000), (1, 4, 11_000), (0, 2, 11_500), (1, 5, 11_500), (1, 6, 11_900)];
    assert_eq!(announced(&mut h), expected);
    assert_eq!((h.counters().exposures.trigger_gaps, h.counters().exposures.trigger_duplicates), (0, 0));
}

#[test]
fn a_duplicate_is_the_same_in_time_place_and_number_and_a_counter_may_stand_still_or_start_anew() {
    let mut h = Wire::new();
    h.fly(10_000, 16_000);
    // Never counts; told twice; starts anew in mid-flight; overtaken on the way.
    for (img_idx, ms) in [(0, 11_000), (0, 12_000), (0, 12_000), (7, 13_000), (8, 13_500), (1, 14_000), (2, 14_500)] {
        h.handle(&CAMERA_FEEDBACK_DATA { img_idx, time_usec: ms * 1000, ..Default::default() });
    }
    h.handle(&CAMERA_FEEDBACK_DATA { img_idx: 4, time_usec: 15_500_000, ..Default::default() });
    h.handle(&CAMERA_FEEDBACK_DATA { img_idx: 3, time_usec: 15_000_000, ..Default::default() });
    let all = announced(&mut h);
    let times: std::vec::Vec<u64> = all.iter().map(|t| t.2).collect();
    assert_eq!(times, [11_000, 12_000, 13_000, 13_500, 14_000, 14_500, 15_500, 15_000]);
    let mut numbers: std::vec::Vec<u32> = all.iter().map(|t| t.1).collect();
    assert_eq!(numbers[7] + 1, numbers[6], "the one that was overtaken comes before");
    numbers.sort_unstable();
    numbers.dedup();
    assert_eq!((numbers.len(), h.counters().exposures.trigger_duplicates), (8, 1), "no number twice");
}

#[test]
fn exposures_without_any_time_are_counted_as_they_come() {
    let mut h = Wire::new();
    h.fly(10_000, 11_000);
    for k in 0..5u16 {
        h.fly(11_000 + u32::from(k) * 1000, 12_000 + u32::from(k) * 1000);
        h.handle(&CAMERA_FEEDBACK_DATA { img_idx: 0, ..Default::default() });
        h.handle(&CAMERA_FEEDBACK_DATA { img_idx: 0, ..Default::default() });
    }
    let all = announced(&mut h);
    assert!(all.len() == 5 && all.windows(2).all(|w| w[1].2 - w[0].2 > 900 && w[1].1 > w[0].1), "{all:?}");
    assert_eq!(h.counters().exposures.trigger_duplicates, 5, "each came twice");
}

#[test]
fn doubled_and_reordered_frames_are_no_losses() {
    let mut h = Wire::new();
    let encoded: std::vec::Vec<std::vec::Vec<u8>> = (0..100)
        .map(|ms| h.encoder.encode(&SYSTEM_TIME_DATA { time_boot_ms: ms, ..Default::default() }, None).to_vec())
        .collect();
    for k in 0..100usize {
        // Each twice, neighbours exchanged, one of the hundred lost.
        if k ^ 1 != 50 {
            for _ in 0..2 {
                let mut framer = Framer::new();
                framer.push(&encoded[k ^ 1]);
                h.autopilot.handle(&framer.next_frame().expect("a frame"), h.now_ns);
            }
        }
    }
    assert!(h.counters().link.lost <= 51, "{}", h.counters().link.lost);
}

/// What is said of a gimbal: sender, device, pitch.
fn gimbal(h: &mut Wire, component: u8, gimbal_device_id: u8, time_boot_ms: u32, pitch: f64) {
    let q = euler_to_ned(0.0, pitch, 0.0);
    let own = core::mem::replace(&mut h.encoder, Encoder::new(1, component));
    h.handle(&GIMBAL_DEVICE_ATTITUDE_STATUS_DATA {
        time_boot_ms,
        gimbal_device_id,
        q: [q.w as f32, q.x as f32, q.y as f32, q.z as f32],
        flags: GimbalDeviceFlags::GIMBAL_DEVICE_FLAGS_PITCH_LOCK,
        delta_yaw: f32::NAN,
        ..Default::default()
    });
    h.encoder = own;
}

#[test]
fn two_mounts_are_never_interpolated_into_each_other() {
    let down = -core::f64::consts::FRAC_PI_2;
    for (wanted, order, expected) in [(0, [1, 2], down), (0, [2, 1], down), (2, [1, 2], 0.0), (1, [2, 1], down)] {
        let mut h = Wire::new();
        h.autopilot = Autopilot::new(h.autopilot.ids()).with_gimbal(wanted);
        h.fly(10_000, 11_000);
        for time_boot_ms in (11_000..12_000).step_by(100) {
            h.fly(time_boot_ms, time_boot_ms + 100);
            for (k, device) in order.into_iter().enumerate() {
                gimbal(&mut h, 1, device, time_boot_ms + 60 + k as u32, if device == 1 { down } else { 0.0 });
            }
        }
        let at = h.autopilot.pose_at(11_700 * 1_000_000).expect("a pose").gimbal.expect("reported") * DVec3::X;
        assert!((at.z - expected.sin()).abs() < 1e-6, "mission {wanted}, heard {order:?}: {at}");
        assert_eq!(h.autopilot.gimbals().1.len(), 1, "the other one is named");
    }
    // None is believed when the mission's is not heard.
    let mut h = Wire::new();
    h.autopilot = Autopilot::new(h.autopilot.ids()).with_gimbal(3);
    gimbal(&mut h, 1, 1, 11_000, down);
    assert_eq!((h.autopilot.gimbals().0, h.counters().telemetry.gimbals, h.counters().link.foreign), (None, 0, 1));
}

#[test]
fn a_mount_that_two_components_report_is_taken_from_one_of_them() {
    let mut h = Wire::new();
    h.fly(10_000, 11_000);
    for time_boot_ms in (11_000..11_500).step_by(100) {
        h.fly(time_boot_ms, time_boot_ms + 100);
        gimbal(&mut h, 154, 0, 77_000 + time_boot_ms, -0.5);
        gimbal(&mut h, 1, 154, time_boot_ms + 60, -0.5);
    }
    let (chosen, others) = h.autopilot.gimbals();
    assert_eq!(chosen.map(|g| (g.device, g.component)), Some((154, 1)), "the autopilot's report has the track's clock");
    assert_eq!(others.len(), 1);
    assert_eq!(h.counters().telemetry.gimbals, 6, "its first came before");
}

#[test]
fn a_trigger_knows_its_component() {
    let mut h = Wire::new();
    h.fly(10_000, 11_000);
    h.encoder = Encoder::new(1, 101);
    h.handle(&CAMERA_IMAGE_CAPTURED_DATA {
        image_index: 3,
        camera_id: 2,
        capture_result: MavBool::MAV_BOOL_TRUE,
        ..Default::default()
    });
    let trigger = h.autopilot.next_trigger().expect("announced");
    assert_eq!((trigger.source, trigger.sequence), (Source { component: 101, camera: 2 }, 3));
}
