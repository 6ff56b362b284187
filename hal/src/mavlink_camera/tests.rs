//! The MAVLink camera's promises.

use std::vec::Vec;

use super::*;
use crate::mavlink::dialect::{MavParamExtType, ParamAck};
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

fn hear<D: MessageData>(camera: &mut MavlinkCamera, message: &D, now_ns: u64) {
    let mut framer = Framer::new();
    framer.push(Encoder::new(255, 190).encode(message, None));
    camera.handle(&framer.next_frame().expect("a frame"), 1, now_ns);
}

/// Everything sent within a second of asking, one look every 5 ms.
fn a_second(camera: &mut MavlinkCamera, from_ns: u64) -> Vec<(u64, Reply)> {
    let looks = (0..200).map(|k| from_ns + k * S / 200);
    looks
        .flat_map(|now| core::iter::from_fn(|| camera.next_reply(0, now)).map(|r| (now, r)).collect::<Vec<_>>())
        .collect()
}

fn set(id: &str, value: [u8; 4], param_type: MavParamExtType) -> PARAM_EXT_SET_DATA {
    let mut param_value = [0; 128];
    param_value[..4].copy_from_slice(&value);
    PARAM_EXT_SET_DATA {
        target_system: 1,
        target_component: 100,
        param_id: id.into(),
        param_value: param_value.into(),
        param_type,
    }
}

/// Result and value of the acknowledgement that is sent.
fn acknowledged(camera: &mut MavlinkCamera, now_ns: u64) -> Option<(ParamAck, f32)> {
    let replies: Vec<Reply> = core::iter::from_fn(|| camera.next_reply(0, now_ns)).collect();
    replies.iter().find_map(|reply| match reply {
        Reply::Set(m) => Some((m.param_result, f32::from_le_bytes(m.param_value[..4].try_into().expect("four")))),
        _ => None,
    })
}

const REAL: MavParamExtType = MavParamExtType::MAV_PARAM_EXT_TYPE_REAL32;

#[test]
fn a_list_of_parameters_comes_one_by_one_at_a_pace_that_a_slow_line_carries() {
    let mut camera = camera();
    camera.note_count(ParameterId::KeyFrames, 7);
    assert!(a_second(&mut camera, 0).is_empty(), "nobody has asked");
    hear(&mut camera, &PARAM_EXT_REQUEST_LIST_DATA { target_system: 1, target_component: 0 }, S);
    let sent = a_second(&mut camera, S);
    let values: Vec<_> =
        sent.iter().filter_map(|(at, r)| if let Reply::Value(m) = r { Some((at, m)) } else { None }).collect();
    assert_eq!(values.iter().map(|(_, m)| m.param_index).collect::<Vec<_>>(), (0..COUNT as u16).collect::<Vec<_>>());
    assert!(values.windows(2).all(|w| w[1].0 - w[0].0 >= BULK_EVERY_NS));
    let key_frames = values[ParameterId::KeyFrames as usize].1;
    assert_eq!(
        (key_frames.param_id.to_str(), key_frames.param_value[0], key_frames.param_count),
        (Ok("KEY_FRAMES"), 7, COUNT as u16)
    );
    // From now on a change is told without being asked for, and only a change.
    camera.note_count(ParameterId::KeyFrames, 8);
    camera.note_count(ParameterId::Covered, 900);
    camera.note_count(ParameterId::Pictures, 0);
    let told: Vec<_> = a_second(&mut camera, 3 * S)
        .into_iter()
        .map(|(_, r)| if let Reply::Value(m) = r { (m.param_index, m.param_value[0]) } else { panic!("{r:?}") })
        .collect();
    assert_eq!(told, [(ParameterId::KeyFrames as u16, 8), (ParameterId::Covered as u16, 100)]);
}

#[test]
fn a_value_is_set_when_the_job_obeys_and_stays_as_it_was_otherwise() {
    let mut camera = camera();
    let (distance, twelve) = (ParameterId::KeyframeDistance, 12.5f32.to_le_bytes());
    hear(&mut camera, &set("KF_DISTANCE", twelve, REAL), S);
    assert_eq!(camera.next_request(S), Some(Request::Set(distance, 12.5)));
    assert_eq!(acknowledged(&mut camera, S), None, "not before it is obeyed");
    camera.answer(distance, Some(12.5));
    assert_eq!(acknowledged(&mut camera, S), Some((ParamAck::PARAM_ACK_ACCEPTED, 12.5)));
    // A repeated request is answered and not obeyed again.
    hear(&mut camera, &set("KF_DISTANCE", twelve, REAL), S);
    assert_eq!(
        (camera.next_request(S), acknowledged(&mut camera, S)),
        (None, Some((ParamAck::PARAM_ACK_ACCEPTED, 12.5)))
    );
    hear(&mut camera, &set("KF_DISTANCE", 3f32.to_le_bytes(), REAL), S);
    assert!(camera.next_request(S).is_some());
    camera.answer(distance, None);
    assert_eq!(acknowledged(&mut camera, S), Some((ParamAck::PARAM_ACK_FAILED, 12.5)));
}

#[test]
fn values_out_of_bounds_of_another_type_or_read_only_never_reach_the_job() {
    let mut camera = camera();
    let count = MavParamExtType::MAV_PARAM_EXT_TYPE_UINT32;
    for (name, value, kind, expected) in [
        ("KF_DISTANCE", f32::NAN.to_le_bytes(), REAL, ParamAck::PARAM_ACK_VALUE_UNSUPPORTED),
        ("KF_DISTANCE", f32::INFINITY.to_le_bytes(), REAL, ParamAck::PARAM_ACK_VALUE_UNSUPPORTED),
        ("KF_DISTANCE", (-0.1f32).to_le_bytes(), REAL, ParamAck::PARAM_ACK_VALUE_UNSUPPORTED),
        ("KF_ROTATION", 0f32.to_le_bytes(), REAL, ParamAck::PARAM_ACK_VALUE_UNSUPPORTED),
        ("TRAIN_SECONDS", 1e9f32.to_le_bytes(), REAL, ParamAck::PARAM_ACK_VALUE_UNSUPPORTED),
        ("KF_DISTANCE", 9u32.to_le_bytes(), count, ParamAck::PARAM_ACK_VALUE_UNSUPPORTED),
        ("STATE", 1u32.to_le_bytes(), count, ParamAck::PARAM_ACK_VALUE_UNSUPPORTED),
        ("NO_SUCH_THING", 1u32.to_le_bytes(), count, ParamAck::PARAM_ACK_FAILED),
    ] {
        hear(&mut camera, &set(name, value, kind), S);
        assert_eq!(acknowledged(&mut camera, S).map(|a| a.0), Some(expected), "{name}");
        assert_eq!(camera.next_request(S), None, "{name}");
    }
    let elsewhere = PARAM_EXT_SET_DATA { target_component: 101, ..set("KF_DISTANCE", 9f32.to_le_bytes(), REAL) };
    hear(&mut camera, &elsewhere, S);
    assert_eq!((camera.next_request(S), acknowledged(&mut camera, S)), (None, None));
}

#[test]
fn the_definition_named_by_the_information_is_read_in_a_burst() {
    let mut camera = camera();
    let (_, replies) = command(&mut camera, MavCmd::MAV_CMD_REQUEST_MESSAGE, [259.0, 0.0, 0.0, 0.0, 0.0], 0);
    let Some(Reply::Information(m)) = replies.first() else { panic!("{replies:?}") };
    let path = m.cam_definition_uri.to_str().ok().and_then(|uri| uri.strip_prefix("mftp://")).expect("MAVLink FTP");
    let ask = |camera: &mut MavlinkCamera, opcode: u8, data: &[u8]| {
        let mut payload = [0; 251];
        (payload[3], payload[4]) = (opcode, data.len() as u8);
        payload[12..12 + data.len()].copy_from_slice(data);
        hear(
            camera,
            &FILE_TRANSFER_PROTOCOL_DATA { target_network: 0, target_system: 1, target_component: 100, payload },
            S,
        );
    };
    ask(&mut camera, 4, path.as_bytes());
    ask(&mut camera, 15, &[]);
    let sent = a_second(&mut camera, S);
    let mut text = Vec::new();
    for (_, reply) in &sent[1..] {
        let Reply::File(m) = reply else { panic!("{reply:?}") };
        assert_eq!((m.target_system, m.target_component, m.payload[3]), (255, 190, 128));
        text.extend_from_slice(&m.payload[12..12 + usize::from(m.payload[4])]);
    }
    let text = std::string::String::from_utf8(text).expect("UTF-8");
    assert!(text.contains(&std::format!("<definition version=\"{:05}\">", m.cam_definition_version)), "{text}");
    assert!(text.ends_with("</mavlinkcamera>\n") && sent.len() > 5);
    assert!(sent[1..].windows(2).all(|w| w[1].0 - w[0].0 >= BULK_EVERY_NS));
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
