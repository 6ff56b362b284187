//! The MAVLink camera's promises.

use std::vec::Vec;

use super::*;
use crate::mavlink::{Encoder, Framer};

const S: u64 = 1_000_000_000;

fn camera() -> MavlinkCamera {
    MavlinkCamera::new(CameraInfo { width: 640, height: 480 }, 100)
}

/// Sends a command from a ground station; returns the acknowledgement and the replies.
fn command(
    camera: &mut MavlinkCamera,
    command: MavCmd,
    params: [f32; 5],
    now_ns: u64,
) -> (Option<MavResult>, Vec<Reply>) {
    let [param1, param2, param3, param4, param5] = params;
    let m = COMMAND_LONG_DATA {
        command,
        param1,
        param2,
        param3,
        param4,
        param5,
        target_system: 1,
        target_component: 100,
        ..COMMAND_LONG_DATA::default()
    };
    let mut framer = Framer::new();
    framer.push(Encoder::new(255, 190).encode(&m, None));
    camera.handle(&framer.next_frame().expect("a frame"), 1, now_ns);
    let mut replies: Vec<Reply> = core::iter::from_fn(|| camera.next_reply(0, now_ns)).collect();
    let acknowledged = match replies.first() {
        Some(Reply::Ack(ack)) if (ack.target_system, ack.target_component) == (255, 190) => Some(ack.result),
        _ => None,
    };
    replies.drain(..usize::from(acknowledged.is_some()));
    (acknowledged, replies)
}

fn captures(camera: &mut MavlinkCamera, now_ns: u64) -> usize {
    core::iter::from_fn(|| camera.next_request(now_ns)).count()
}

#[test]
fn information_is_acknowledged_first_and_then_sent() {
    let mut camera = camera();
    for (id, legacy) in [(259.0, 521), (260.0, 522), (261.0, 525), (262.0, 527)] {
        let (ack, replies) = command(&mut camera, MavCmd::MAV_CMD_REQUEST_MESSAGE, [id, 0.0, 0.0, 0.0, 0.0], 0);
        assert_eq!((ack, replies.len()), (Some(MavResult::MAV_RESULT_ACCEPTED), 1), "{id}");
        #[expect(deprecated, reason = "that is the point")]
        let old = match legacy {
            521 => MavCmd::MAV_CMD_REQUEST_CAMERA_INFORMATION,
            522 => MavCmd::MAV_CMD_REQUEST_CAMERA_SETTINGS,
            525 => MavCmd::MAV_CMD_REQUEST_STORAGE_INFORMATION,
            _ => MavCmd::MAV_CMD_REQUEST_CAMERA_CAPTURE_STATUS,
        };
        let (ack, replies) = command(&mut camera, old, [1.0, 0.0, 0.0, 0.0, 0.0], 0);
        assert_eq!((ack, replies.len()), (Some(MavResult::MAV_RESULT_ACCEPTED), 1), "{legacy}");
    }
}

#[test]
fn px4s_doubled_command_takes_one_picture() {
    let mut camera = camera();
    command(&mut camera, MavCmd::MAV_CMD_IMAGE_START_CAPTURE, [0.0, 0.0, 1.0, 7.0, 0.0], S);
    command(&mut camera, MavCmd::MAV_CMD_DO_DIGICAM_CONTROL, [0.0, 0.0, 0.0, 0.0, 1.0], S + 1_000_000);
    assert_eq!(captures(&mut camera, S + 2_000_000), 1);
    command(&mut camera, MavCmd::MAV_CMD_IMAGE_START_CAPTURE, [0.0, 0.0, 1.0, 8.0, 0.0], 2 * S);
    assert_eq!(captures(&mut camera, 2 * S), 1);
}

#[test]
fn a_series_runs_until_its_count_or_a_stop() {
    let mut camera = camera();
    command(&mut camera, MavCmd::MAV_CMD_IMAGE_START_CAPTURE, [0.0, 2.0, 3.0, 0.0, 0.0], 0);
    assert_eq!((0..20).map(|s| captures(&mut camera, s * S)).sum::<usize>(), 3);
    command(&mut camera, MavCmd::MAV_CMD_IMAGE_START_CAPTURE, [0.0, 1.0, 0.0, 0.0, 0.0], 20 * S);
    assert_eq!((20..25).map(|s| captures(&mut camera, s * S)).sum::<usize>(), 5);
    command(&mut camera, MavCmd::MAV_CMD_IMAGE_STOP_CAPTURE, [0.0; 5], 25 * S);
    assert_eq!((25..30).map(|s| captures(&mut camera, s * S)).sum::<usize>(), 0);
}

#[test]
fn what_cannot_be_done_is_denied_or_unsupported() {
    use MavResult::{MAV_RESULT_DENIED as DENIED, MAV_RESULT_UNSUPPORTED as UNSUPPORTED};
    let mut camera = camera();
    for (what, params, expected) in [
        (MavCmd::MAV_CMD_IMAGE_START_CAPTURE, [0.0, 0.001, 5.0, 0.0, 0.0], DENIED),
        (MavCmd::MAV_CMD_IMAGE_START_CAPTURE, [0.0, f32::NAN, 0.0, 0.0, 0.0], DENIED),
        (MavCmd::MAV_CMD_SET_CAMERA_MODE, [0.0, 1.0, 0.0, 0.0, 0.0], DENIED),
        (MavCmd::MAV_CMD_SET_MESSAGE_INTERVAL, [30.0, 1e6, 0.0, 0.0, 0.0], DENIED),
        (MavCmd::MAV_CMD_REQUEST_MESSAGE, [30.0, 0.0, 0.0, 0.0, 0.0], UNSUPPORTED),
        (MavCmd::MAV_CMD_SET_CAMERA_ZOOM, [0.0; 5], UNSUPPORTED),
        (MavCmd::MAV_CMD_COMPONENT_ARM_DISARM, [1.0, 0.0, 0.0, 0.0, 0.0], UNSUPPORTED),
    ] {
        assert_eq!(command(&mut camera, what, params, 0).0, Some(expected), "{what:?}");
    }
    assert_eq!(captures(&mut camera, S), 0);
}

#[test]
fn capture_status_comes_at_the_interval_asked_for() {
    let mut camera = camera();
    command(&mut camera, MavCmd::MAV_CMD_SET_MESSAGE_INTERVAL, [262.0, 5e5, 0.0, 0.0, 0.0], 0);
    let sent = (1..=20).filter(|tick| camera.next_reply(0, tick * S / 10).is_some()).count();
    assert_eq!(sent, 4);
}
