//! What hostile bytes meet: framer, autopilot, camera component, matcher. One piece of code for the fuzz targets and for the
//! seeded test, so that what the one finds the other repeats.
#![allow(dead_code, reason = "each target uses its part")]

use hal::autopilot::{Autopilot, Ids};
use hal::matcher::{Matcher, MatcherSettings};
use hal::mavlink::dialect::{
    COMMAND_LONG_DATA, FILE_TRANSFER_PROTOCOL_DATA, MavCmd, MavParamExtType, PARAM_EXT_REQUEST_LIST_DATA,
    PARAM_EXT_REQUEST_READ_DATA, PARAM_EXT_SET_DATA,
};
use hal::mavlink::{Encoder, Framer};
use hal::mavlink_camera::{COUNT, CameraInfo, Kind, MavlinkCamera, Reply, Request, TABLE};
use hal::traits::{PictureClues, PoseSource, TriggerSource};
use hal::trigger::{Trigger, TriggerKind};

/// Everything of the capture loop that has no I/O.
pub struct CaptureLoop {
    pub framer: Framer,
    pub autopilot: Autopilot,
    pub camera: MavlinkCamera,
    pub matcher: Matcher<u32>,
    /// Pictures and exposures accounted for, and poses found.
    pub outcomes: u64,
    pub poses: u64,
}

impl CaptureLoop {
    pub fn new() -> Self {
        Self {
            framer: Framer::new(),
            autopilot: Autopilot::new(Ids { system: 1, autopilot: 1, own_component: 101 }),
            camera: MavlinkCamera::new(CameraInfo { width: 640, height: 480 }, 100),
            matcher: Matcher::new(MatcherSettings::default()),
            outcomes: 0,
            poses: 0,
        }
    }

    /// Bytes that came at `now_ns`; every exposure they announce gets a picture with the clues that `picture` makes up.
    pub fn handle(&mut self, bytes: &[u8], now_ns: u64, mut picture: impl FnMut() -> PictureClues) {
        let mut rest = bytes;
        while !rest.is_empty() {
            rest = &rest[self.framer.push(rest)..];
            while let Some(frame) = self.framer.next_frame() {
                self.camera.handle(&frame, 1, now_ns);
                self.autopilot.handle(&frame, now_ns);
            }
        }
        while self.camera.next_request(now_ns).is_some() || self.camera.next_reply(0, now_ns).is_some() {}
        while self.autopilot.next_answer().is_some() {}
        while let Some(trigger) = self.autopilot.next_trigger() {
            self.outcomes += u64::from(self.matcher.push_trigger(trigger).is_some());
            let at = trigger.boot_ns;
            if let Ok(pose) = self.autopilot.pose_at(at).or_else(|_| self.autopilot.pose_near(at)) {
                self.poses += 1;
                assert!(pose.attitude.is_finite() && pose.position.is_valid() && pose.position_sigma_m.is_finite());
            }
            self.outcomes += u64::from(self.matcher.push_picture(picture(), 0).is_some());
        }
        while self.matcher.poll(now_ns).is_some() {
            self.outcomes += 1;
        }
    }
}

/// Target `parser`: the first byte of each piece says how long it is and how much later it comes.
pub fn parse(mut data: &[u8]) -> CaptureLoop {
    let mut capture = CaptureLoop::new();
    let mut now_ns = 1_000_000_000u64;
    while let Some((&head, rest)) = data.split_first() {
        let (piece, later) = rest.split_at(rest.len().min(usize::from(head)));
        now_ns = now_ns.wrapping_add(1 << (head % 48));
        capture.handle(piece, now_ns, || PictureClues { arrived_ns: now_ns, ..PictureClues::default() });
        data = later;
    }
    capture
}

/// What a ground station asked, and what came of it.
#[derive(Default)]
pub struct Answered {
    pub replies: u64,
    pub settings: u64,
}

/// Target `station`: a kind, a length and as many bytes make a request for a file, a parameter or a message. Whatever they are,
/// what leaves is of the one file and the table, and what is asked of the job lies within its bounds.
pub fn ask_camera(mut data: &[u8]) -> Answered {
    let mut camera = MavlinkCamera::new(CameraInfo { width: 640, height: 480 }, 100);
    let (mut framer, mut encoder) = (Framer::new(), Encoder::new(255, 190));
    let (mut answered, mut now_ns) = (Answered::default(), 1_000_000_000u64);
    let (target_system, target_component) = (1, 100);
    while let [kind, length, rest @ ..] = data {
        let (given, later) = rest.split_at(rest.len().min(usize::from(*length)));
        data = later;
        let mut bytes = [0; 256];
        bytes[..given.len()].copy_from_slice(given);
        let [a, b, ..] = bytes;
        let mut name = [0; 16];
        name.copy_from_slice(&bytes[2..18]);
        let mut value = [0; 128];
        value.copy_from_slice(&bytes[18..146]);
        let mut payload = [0; 251];
        payload.copy_from_slice(&bytes[..251]);
        let frame = match kind % 5 {
            0 => {
                let m = FILE_TRANSFER_PROTOCOL_DATA { target_network: 0, target_system, target_component, payload };
                encoder.encode(&m, None)
            }
            1 => encoder.encode(&PARAM_EXT_REQUEST_LIST_DATA { target_system, target_component: a }, None),
            2 => {
                let (param_index, param_id) = (i16::from_le_bytes([a, b]), name.into());
                let m = PARAM_EXT_REQUEST_READ_DATA { param_index, target_system, target_component, param_id };
                encoder.encode(&m, None)
            }
            3 => {
                let param_type = match a % 4 {
                    0 => MavParamExtType::MAV_PARAM_EXT_TYPE_REAL32,
                    1 => MavParamExtType::MAV_PARAM_EXT_TYPE_UINT32,
                    2 => MavParamExtType::MAV_PARAM_EXT_TYPE_REAL64,
                    _ => MavParamExtType::MAV_PARAM_EXT_TYPE_CUSTOM,
                };
                let (param_id, param_value) = (name.into(), value.into());
                let m = PARAM_EXT_SET_DATA { target_system, target_component, param_id, param_value, param_type };
                encoder.encode(&m, None)
            }
            _ => {
                let command = MavCmd::MAV_CMD_REQUEST_MESSAGE;
                let (param1, param2) = (f32::from(u16::from_le_bytes([a, b])), 0.0);
                let m = COMMAND_LONG_DATA {
                    command,
                    target_system,
                    target_component,
                    param1,
                    param2,
                    ..Default::default()
                };
                encoder.encode(&m, None)
            }
        };
        framer.push(frame);
        while let Some(frame) = framer.next_frame() {
            camera.handle(&frame, 1, now_ns);
        }
        while let Some(request) = camera.next_request(now_ns) {
            let Request::Set(id, value) = request else { continue };
            let Kind::Set(least, most, _) = id.row().kind else { panic!("{id:?} is read only") };
            assert!((least..=most).contains(&value), "{id:?} {value}");
            answered.settings += 1;
            camera.answer(id, (a % 2 == 0).then_some(value));
        }
        // Ten looks, each as much later as lets a line breathe: a file and the list are longer than that.
        for _ in 0..10 {
            while let Some(reply) = camera.next_reply(0, now_ns) {
                answered.replies += 1;
                if let Reply::Value(m) = reply {
                    assert!(usize::from(m.param_index) < COUNT && usize::from(m.param_count) == COUNT);
                    assert_eq!(m.param_id.to_str(), Ok(TABLE[usize::from(m.param_index)].name));
                }
            }
            now_ns = now_ns.wrapping_add(25_000_000);
        }
    }
    answered
}

/// Target `matcher`: twelve bytes an event. Every exposure and every picture must come out exactly once.
pub fn match_up(data: &[u8]) {
    let mut matcher = Matcher::new(MatcherSettings::default());
    let (mut now_ns, mut given, mut taken) = (0u64, 0usize, 0usize);
    let mut count = |outcome: hal::matcher::Outcome<u32>| {
        taken += 1 + usize::from(matches!(outcome, hal::matcher::Outcome::Matched { .. }));
    };
    for event in data.chunks_exact(12) {
        let number =
            |at: usize| u64::from(u32::from_le_bytes([event[at], event[at + 1], event[at + 2], event[at + 3]]));
        now_ns = now_ns.wrapping_add(number(0) << (event[8] % 8));
        let about_ns = now_ns.wrapping_add(number(4)).wrapping_sub(1 << 31);
        given += 1;
        if event[9] & 1 == 0 {
            let (sequence, kind) = (u32::from(event[10]), TriggerKind::Feedback);
            let trigger = Trigger {
                source: Default::default(),
                sequence,
                boot_ns: number(4) << 16,
                time_ns: about_ns,
                sigma_ns: 1,
                kind,
            };
            matcher.push_trigger(trigger).map(&mut count);
        } else {
            let clues = PictureClues {
                arrived_ns: about_ns,
                number: (event[9] & 2 != 0).then_some(event[10].into()),
                camera_ns: (event[9] & 4 != 0).then_some(number(4) << (event[11] % 32)),
                camera_resolution_ns: 1 << (event[11] % 40),
                ..PictureClues::default()
            };
            matcher.push_picture(clues, 0).map(&mut count);
        }
        while let Some(outcome) = matcher.poll(now_ns) {
            count(outcome);
        }
    }
    while let Some(outcome) = matcher.flush() {
        count(outcome);
    }
    assert_eq!(taken, given, "everything is accounted for once");
}

/// Target `reconcile`: sixteen bytes an exposure or a picture. Nobody is paired twice, and no picture with a later exposure.
pub fn reconcile_all(data: &[u8]) {
    let (mut exposures, mut pictures) = (Vec::new(), Vec::new());
    for item in data.chunks_exact(16) {
        let number = |at: usize| u64::from(u32::from_le_bytes([item[at], item[at + 1], item[at + 2], item[at + 3]]));
        let wide = |at: usize| number(at) << (item[15] % 33);
        if item[14] & 1 == 0 {
            let (sequence, kind) = (number(0) as u32 >> (item[13] % 32), TriggerKind::Feedback);
            exposures.push(Trigger {
                source: Default::default(),
                sequence,
                boot_ns: wide(4),
                time_ns: wide(8),
                sigma_ns: 1,
                kind,
            });
        } else {
            pictures.push(PictureClues {
                arrived_ns: wide(8) << 1,
                number: (item[14] & 2 != 0).then(|| wide(0)),
                camera_ns: (item[14] & 4 != 0).then(|| wide(4)),
                camera_resolution_ns: 1 << (item[13] % 40),
                written_ns: (item[14] & 8 != 0).then(|| wide(4)),
                ..PictureClues::default()
            });
        }
    }
    let known: Vec<_> = exposures.iter().copied().zip(pictures.iter().copied()).take(data.len() % 3).collect();
    let pairs = hal::matcher::reconcile::reconcile(&exposures, &pictures, &known);
    let distinct = |of: fn(&hal::matcher::reconcile::Pairing) -> usize| {
        pairs.iter().map(of).collect::<std::collections::HashSet<_>>().len() == pairs.len()
    };
    assert!(distinct(|p| p.exposure) && distinct(|p| p.picture), "paired twice");
    for p in &pairs {
        assert!((0.0..=1.0).contains(&p.confidence));
        assert!(pictures[p.picture].arrived_ns.saturating_add(1 << 29) >= exposures[p.exposure].time_ns);
    }
}
