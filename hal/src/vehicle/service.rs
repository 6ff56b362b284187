//! What a vehicle does besides listening: heartbeats, TIMESYNC, STATUSTEXT, the MAVLink camera's answers, and the signing
//! time stamp.

use geometry::geodesy::{EnuFrame, Geodetic};

use super::complaints::Complaints;
use super::{CameraPose, Event, Vehicle, VehicleSettings};
use crate::autopilot::{Autopilot, Gimbal};
use crate::camera::Picture;
use crate::error::HalError;
use crate::mavlink::channel::Channel;
use crate::mavlink::dialect::{MavSeverity, MavType, STATUSTEXT_DATA};
use crate::mavlink::signing_store::{self, SigningStore};
use crate::mavlink::{MessageData, Signer};
use crate::mavlink_camera::{CameraInfo, MavlinkCamera, ParameterId, Reply, Request, Shot};
use crate::traits::{Camera, Clock, Link};

/// Heartbeats at 1 Hz, as the protocol asks.
const HEARTBEAT_NS: u64 = 1_000_000_000;
/// TIMESYNC requests: fast until the mapping has settled, then at 1 Hz.
const FAST_TIMESYNC_NS: u64 = 250_000_000;
const SLOW_TIMESYNC_NS: u64 = 1_000_000_000;
const FAST_REQUESTS: u32 = 16;
/// Warnings about pictures and the camera are logged this often at most.
const WARN_EVERY_NS: u64 = 5_000_000_000;

/// Timers and answers.
pub(super) struct Service {
    pub(super) component: MavlinkCamera,
    pub(super) complaints: Complaints,
    store: Option<SigningStore>,
    announces: bool,
    next_heartbeat_ns: u64,
    next_timesync_ns: u64,
    requests: u32,
    next_warning_ns: u64,
    /// Restarts and steps of the autopilot's clock that were answered with fast TIMESYNC requests.
    clock_events: u64,
    gimbals_named: usize,
    last_free_ns: Option<u64>,
    /// Number of the last long text.
    texts: u16,
}

impl Service {
    pub(super) fn new(settings: &VehicleSettings) -> Result<(Self, Signer), HalError> {
        let (signer, store) = signing_store::open(&settings.link)?;
        let info = CameraInfo { width: settings.lens.width, height: settings.lens.height };
        let service = Self {
            component: MavlinkCamera::new(info, settings.link.own_component),
            complaints: Complaints::default(),
            store,
            announces: settings.link.act_as_camera,
            next_heartbeat_ns: 0,
            next_timesync_ns: 0,
            requests: 0,
            next_warning_ns: 0,
            clock_events: 0,
            gimbals_named: 0,
            last_free_ns: None,
            texts: 0,
        };
        Ok((service, signer))
    }

    /// Says in the log that a picture or the camera failed, not more often than is useful.
    pub(super) fn warn_seldom(&mut self, error: &HalError, now_ns: u64) {
        if self.may_warn(now_ns) {
            tracing::warn!("{error}");
        }
    }

    /// Whether the last complaint is long enough ago for another one.
    pub(super) fn may_warn(&mut self, now_ns: u64) -> bool {
        let may = now_ns >= self.next_warning_ns;
        if may {
            self.next_warning_ns = now_ns + WARN_EVERY_NS;
        }
        may
    }

    /// Says in the log which gimbal is believed when there are several; `wanted` is the mission's.
    pub(super) fn name_gimbals(&mut self, autopilot: &Autopilot, wanted: u8) {
        let (chosen, others) = autopilot.gimbals();
        if others.len() == self.gimbals_named {
            return;
        }
        self.gimbals_named = others.len();
        let name = |g: &Gimbal| format!("{} (reported by component {})", g.device, g.component);
        let others = others.iter().map(name).collect::<Vec<_>>().join(", ");
        match chosen {
            Some(chosen) => tracing::warn!(
                "several gimbals: {} carries the camera, {others} left out ([mount] gimbal says which)",
                name(&chosen)
            ),
            None => tracing::warn!("gimbals {others} are heard, [mount] gimbal = {wanted} is not"),
        }
    }

    /// An exposure was announced or asked for: the next free-running picture is due whatever its time.
    pub(super) fn make_due(&mut self) {
        self.last_free_ns = None;
    }

    /// Whether a free-running picture at `time_ns` is far enough from the last one.
    pub(super) fn is_due(&mut self, time_ns: u64, interval_ns: u64) -> bool {
        let due = self.last_free_ns.is_none_or(|last| time_ns >= last.saturating_add(interval_ns));
        if due {
            self.last_free_ns = Some(time_ns);
        }
        due
    }

    /// A frame was posed: ground stations are told with CAMERA_IMAGE_CAPTURED.
    pub(super) fn captured(&mut self, mid_boot_ns: u64, unix_us: Option<u64>, pose: &CameraPose, origin: Geodetic) {
        let at = EnuFrame::new(origin).to_geodetic(pose.position);
        self.component.captured(Shot {
            boot_ms: (mid_boot_ns / 1_000_000) as u32,
            unix_us: unix_us.unwrap_or(0),
            lat: (at.lat_deg * 1e7) as i32,
            lon: (at.lon_deg * 1e7) as i32,
            alt_mm: (at.alt_m * 1e3) as i32,
            relative_mm: (pose.position.z * 1e3) as i32,
        });
    }
}

impl<L, C, K> Vehicle<L, C, K>
where
    L: Link<Error = HalError>,
    C: Camera<Picture = Picture, Error = HalError>,
    K: Clock,
{
    /// Tells the ground control station; long texts are sent in several chunks of 50 bytes.
    pub fn status_text(&mut self, severity: MavSeverity, text: &str) {
        let bytes = text.as_bytes();
        let chunks = bytes.chunks(50).take(usize::from(u8::MAX));
        // Chunks of one text share an id; 0 means that there is only one.
        self.service.texts =
            if bytes.len() > 50 { self.service.texts.wrapping_add(1).max(1) } else { self.service.texts };
        let id = if bytes.len() > 50 { self.service.texts } else { 0 };
        for (chunk_seq, chunk) in chunks.enumerate() {
            let mut padded = [0; 50];
            padded[..chunk.len()].copy_from_slice(chunk);
            let text = padded.into();
            send(&mut self.channel, &STATUSTEXT_DATA { severity, text, id, chunk_seq: chunk_seq as u8 });
        }
    }

    /// What a ground station is shown of the job: see [`MavlinkCamera::note_count`].
    pub fn show_count(&mut self, parameter: ParameterId, value: u32) {
        self.service.component.note_count(parameter, value);
    }

    /// What a ground station is shown of a setting.
    pub fn show_setting(&mut self, parameter: ParameterId, value: f32) {
        self.service.component.note_setting(parameter, value);
    }

    /// The answer to [`Event::Asked`]: what the setting is now, or `None` when that cannot be obeyed.
    pub fn answer(&mut self, parameter: ParameterId, obeyed: Option<f32>) {
        self.service.component.answer(parameter, obeyed);
    }

    /// Timers and answers that are due.
    pub(super) fn serve(&mut self, now_ns: u64) {
        let system = self.autopilot.ids().system;
        if system == 0 {
            return; // nobody to talk to yet
        }
        self.channel.set_ids(system, self.settings.link.own_component);
        while let Some(answer) = self.autopilot.next_answer() {
            send(&mut self.channel, &answer);
        }
        // A clock that jumped is learnt anew as fast as at the start.
        let heard = self.autopilot.counters();
        if heard.telemetry.clock_restarts + heard.telemetry.clock_steps != self.service.clock_events {
            self.service.clock_events = heard.telemetry.clock_restarts + heard.telemetry.clock_steps;
            (self.service.requests, self.service.next_timesync_ns) = (0, now_ns);
        }
        if now_ns >= self.service.next_timesync_ns {
            let every = if self.service.requests < FAST_REQUESTS { FAST_TIMESYNC_NS } else { SLOW_TIMESYNC_NS };
            self.service.requests = self.service.requests.saturating_add(1);
            self.service.next_timesync_ns = now_ns + every;
            let request = self.autopilot.ask_time(now_ns);
            send(&mut self.channel, &request);
        }
        if let Some(store) = &mut self.service.store
            && let Err(e) = store.keep(self.channel.signer_mut())
        {
            self.service.warn_seldom(&e, now_ns);
        }
        if now_ns >= self.service.next_heartbeat_ns {
            self.service.next_heartbeat_ns = now_ns + HEARTBEAT_NS;
            let mut heartbeat = self.service.component.heartbeat();
            if !self.service.announces {
                heartbeat.mavtype = MavType::MAV_TYPE_ONBOARD_CONTROLLER;
            }
            send(&mut self.channel, &heartbeat);
        }
        if self.service.announces {
            self.serve_camera(now_ns);
        }
    }

    fn serve_camera(&mut self, now_ns: u64) {
        while let Some(request) = self.service.component.next_request(now_ns) {
            match request {
                Request::Capture(sequence) => self.autopilot.announce_own(sequence, now_ns),
                Request::Set(parameter, value) => self.events.push(Event::Asked { parameter, value }),
            }
        }
        self.autopilot.settle_own(now_ns);
        let boot_ms = self.autopilot.clock().to_boot_ns(now_ns).unwrap_or(now_ns) / 1_000_000;
        while let Some(reply) = self.service.component.next_reply(boot_ms as u32, now_ns) {
            match &reply {
                Reply::Ack(m) => send(&mut self.channel, m),
                Reply::Information(m) => send(&mut self.channel, m),
                Reply::Settings(m) => send(&mut self.channel, m),
                Reply::Storage(m) => send(&mut self.channel, m),
                Reply::Status(m) => send(&mut self.channel, m),
                Reply::Captured(m) => send(&mut self.channel, m),
                Reply::File(m) => send(&mut self.channel, m),
                Reply::Value(m) => send(&mut self.channel, m),
                Reply::Set(m) => send(&mut self.channel, m),
            }
        }
    }
}

/// Sends, or counts in the channel that it could not: a link that takes nothing is reported by its silence.
fn send<L: Link, D: MessageData>(channel: &mut Channel<L>, message: &D) {
    let _ = channel.send(message);
}
