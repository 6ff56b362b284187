//! The MAVLink camera's promises.

use std::vec::Vec;

use super::*;
use crate::mavlink::dialect::{MavCmd, MavParamExtType, MavResult, ParamAck};
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

/// The answer to a command with these of its fields.
fn ask(camera: &mut MavlinkCamera, m: COMMAND_LONG_DATA, now_ns: u64) -> (Option<MavResult>, Vec<Reply>) {
    hear(camera, &COMMAND_LONG_DATA { target_system: 1, target_component: 100, ..m }, now_ns);
    let mut replies: Vec<Reply> = core::iter::from_fn(|| camera.next_reply(0, now_ns)).collect();
    let Some(Reply::Ack(ack)) = replies.first() else { return (None, replies) };
    let result = ack.result;
    replies.remove(0);
    (Some(result), replies)
}

#[test]
fn a_capture_sent_again_because_its_acknowledgement_was_lost_is_one_picture() {
    let mut camera = camera();
    let start = |id: f32, confirmation: u8| COMMAND_LONG_DATA {
        command: MavCmd::MAV_CMD_IMAGE_START_CAPTURE,
        param3: 1.0,
        param4: id,
        confirmation,
        ..COMMAND_LONG_DATA::default()
    };
    let accepted = Some(MavResult::MAV_RESULT_ACCEPTED);
    let mut taken = |m, now_ns| {
        let (result, _) = ask(&mut camera, m, now_ns);
        (result, captures(&mut camera, now_ns))
    };
    assert_eq!(taken(start(7.0, 0), S), (accepted, 1));
    // MAVSDK repeats it as it was, QGroundControl counts; both are told that it was done.
    assert_eq!(taken(start(7.0, 0), S + 700_000_000), (accepted, 0));
    assert_eq!(taken(start(7.0, 1), 4 * S), (accepted, 0));
    assert_eq!(taken(start(8.0, 0), 4 * S + 100_000_000), (accepted, 1), "the next picture");
    // Who does not number its captures means a new one each time, unless it says that it repeats itself.
    assert_eq!(taken(start(0.0, 0), 6 * S), (accepted, 1));
    assert_eq!(taken(start(0.0, 0), 7 * S), (accepted, 1));
    assert_eq!(taken(start(0.0, 1), 8 * S), (accepted, 0));
    // The first one was lost: what says that it is a repetition is the only one that came.
    assert_eq!(taken(start(9.0, 1), 9 * S), (accepted, 1));
    // A client that was started again counts from the beginning.
    assert_eq!(taken(start(8.0, 0), 30 * S), (accepted, 1));
}

#[test]
fn a_series_sent_again_goes_on_as_it_was() {
    let mut camera = camera();
    let series = |confirmation: u8| COMMAND_LONG_DATA {
        command: MavCmd::MAV_CMD_IMAGE_START_CAPTURE,
        param2: 2.0,
        param3: 3.0,
        confirmation,
        ..COMMAND_LONG_DATA::default()
    };
    ask(&mut camera, series(0), 0);
    assert_eq!(captures(&mut camera, 0), 1);
    ask(&mut camera, series(1), S);
    assert_eq!((1..20).map(|s| captures(&mut camera, s * S)).sum::<usize>(), 2);
}

#[test]
fn a_command_int_is_obeyed_and_answered_as_its_long_form() {
    let mut camera = camera();
    let int = |command, x| COMMAND_INT_DATA {
        command,
        x,
        param3: 1.0,
        target_system: 1,
        target_component: 100,
        ..COMMAND_INT_DATA::default()
    };
    for (command, now_ns) in [(MavCmd::MAV_CMD_IMAGE_START_CAPTURE, S), (MavCmd::MAV_CMD_DO_DIGICAM_CONTROL, 2 * S)] {
        hear(&mut camera, &int(command, 1), now_ns);
        let Some(Reply::Ack(ack)) = camera.next_reply(0, now_ns) else { panic!("no answer to {command:?}") };
        assert_eq!((ack.command, ack.result), (command, MavResult::MAV_RESULT_ACCEPTED));
        assert_eq!(captures(&mut camera, now_ns), 1, "{command:?}");
    }
    hear(&mut camera, &DIGICAM_CONTROL_DATA { target_system: 1, shot: 1, ..Default::default() }, 3 * S);
    assert_eq!(captures(&mut camera, 3 * S), 1, "the message that is older than both");
}

#[test]
fn a_command_to_all_that_means_another_camera_is_left_to_it() {
    let mut camera = camera();
    let to_all = |param1: f32| COMMAND_LONG_DATA {
        command: MavCmd::MAV_CMD_IMAGE_START_CAPTURE,
        param1,
        param3: 1.0,
        target_system: 1,
        ..COMMAND_LONG_DATA::default()
    };
    for (camera_id, expected) in [(101.0, 0), (2.0, 0), (100.0, 1), (0.0, 1)] {
        hear(&mut camera, &to_all(camera_id), S);
        assert_eq!(captures(&mut camera, S), expected, "{camera_id}");
        assert_eq!(core::iter::from_fn(|| camera.next_reply(0, S)).count(), expected, "{camera_id}");
    }
}

#[test]
fn what_was_captured_is_told_with_its_own_time_and_can_be_asked_for_again() {
    let mut camera = camera();
    for k in 0..1500u32 {
        camera.captured(Shot { boot_ms: 10_000 + k, unix_us: 1_790_000_000_000_000, lat: k as i32, ..Shot::default() });
        let Some(Reply::Captured(m)) = camera.next_reply(99_000, S) else { panic!("{k} is not told") };
        assert_eq!((m.image_index, m.time_boot_ms, m.time_utc), (k as i32, 10_000 + k, 1_790_000_000_000_000));
    }
    let message = |index: f32| COMMAND_LONG_DATA {
        command: MavCmd::MAV_CMD_REQUEST_MESSAGE,
        param1: 263.0,
        param2: index,
        ..COMMAND_LONG_DATA::default()
    };
    #[expect(deprecated, reason = "that is the point")]
    let legacy = |index: f32| COMMAND_LONG_DATA {
        command: MavCmd::MAV_CMD_REQUEST_CAMERA_IMAGE_CAPTURE,
        param1: index,
        ..COMMAND_LONG_DATA::default()
    };
    for m in [message(1499.0), message(476.0), legacy(1000.0)] {
        let (result, replies) = ask(&mut camera, m.clone(), S);
        assert_eq!(result, Some(MavResult::MAV_RESULT_ACCEPTED));
        let [Reply::Captured(told)] = replies.as_slice() else { panic!("{replies:?}") };
        assert_eq!(told.image_index as f32, m.param1 + m.param2 - if m.param2 > 0.0 { 263.0 } else { 0.0 });
        assert_eq!(told.lat, told.image_index);
    }
    for m in [message(1500.0), message(475.0), message(-1.0), message(f32::NAN), legacy(9999.0)] {
        assert_eq!(ask(&mut camera, m, S).0, Some(MavResult::MAV_RESULT_DENIED), "never taken, or no longer kept");
    }
}

#[test]
fn the_mode_that_a_survey_sets_is_taken_and_told() {
    let mut camera = camera();
    let survey = [0.0, 2.0, 0.0, 0.0, 0.0];
    let (ack, _) = command(&mut camera, MavCmd::MAV_CMD_SET_CAMERA_MODE, survey, S);
    assert_eq!(ack, Some(MavResult::MAV_RESULT_ACCEPTED));
    let (_, replies) = command(&mut camera, MavCmd::MAV_CMD_REQUEST_MESSAGE, [260.0, 0.0, 0.0, 0.0, 0.0], S);
    let Some(Reply::Settings(m)) = replies.first() else { panic!("{replies:?}") };
    assert_eq!(m.mode_id, CameraMode::CAMERA_MODE_IMAGE_SURVEY);
}
