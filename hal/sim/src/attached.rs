//! A simulated camera on a vehicle that somebody else flies: a running ArduPilot or PX4 SITL, or any vehicle on a link. It
//! listens as the companion does, takes a picture of the ray-cast world whenever one is triggered, from where the vehicle
//! was (SIM_STATE where the simulator tells it, else the position it reports), and puts it into the camera folder.

use std::collections::VecDeque;
use std::path::Path;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::{Receiver, SyncSender, TrySendError, sync_channel};
use std::time::{Duration, Instant};

use config::faults::FaultSettings;
use config::link::LinkSettings;
use config::mission::MountSettings;
use geometry::geodesy::{EnuFrame, Geodetic};
use glam::DQuat;

use super::SimError;
use super::aircraft::{Exposure, picture_name};
use super::messages;
use super::photographer::{Photographer, PictureCounters, to_jpeg};
use super::reference::Lens;
use super::world::{PinholeView, World, WorldSettings};
use hal::autopilot::{Autopilot, Ids};
use hal::frames::{attitude_to_enu, attitude_to_ned, euler_to_ned, yaw_of_ned};
use hal::link::{LinkAddress, Reconnecting};
use hal::mavlink::MessageData;
use hal::mavlink::channel::Channel;
use hal::mavlink::dialect::{
    ATTITUDE_QUATERNION_DATA, COMMAND_LONG_DATA, GIMBAL_DEVICE_ATTITUDE_STATUS_DATA, GLOBAL_POSITION_INT_DATA,
    HEARTBEAT_DATA, MavAutopilot, MavCmd, MavState, MavType, SIM_STATE_DATA, SYSTEM_TIME_DATA,
};
use hal::mavlink::signing_store;
use hal::mavlink_camera::{CameraInfo, MavlinkCamera, Request};
use hal::pose::{BodyPose, PoseError};
use hal::time::MonotonicClock;
use hal::traits::{Clock, PoseSource, TriggerSource};
use hal::trigger::Trigger;
use hal::vehicle::mount::Mount;

/// Our component: MAV_COMP_ID_ONBOARD_COMPUTER. The camera that ground stations see is the onboard job's.
const COMPONENT: u8 = 191;
/// The camera that commands are meant for, MAV_COMP_ID_CAMERA.
const CAMERA: u8 = 100;
/// Longest wait for the link in one turn.
const TICK: Duration = Duration::from_millis(5);
/// From the exposure to the finished file, seconds: what `[link] picture_latency_ms` expects.
const TRANSFER_S: f64 = 0.2;
/// Exposures waiting for their pose, and pictures waiting to be made; more are missed, as by a camera that is busy.
const WAITING: usize = 32;
/// An exposure whose pose has not come by then is posed by what there is.
const PATIENCE_NS: u64 = 1_000_000_000;
/// States of the simulator kept: ten seconds of the 20 Hz asked for.
const STATES: usize = 200;
/// SIM_STATE has no time of its own: it is of the position that came right before.
const SAME_MOMENT_NS: u64 = 20_000_000;
/// Heartbeats and requests for the time, 1 Hz as the protocol asks; requests for messages, seldom, as they may be lost.
const BEAT_NS: u64 = 1_000_000_000;
const ASK_EVERY_BEATS: u64 = 10;
/// The messages needed and how often, microseconds apart; an autopilot that has one of them not denies it.
const STREAMS: [(u32, f32); 5] = [
    (GLOBAL_POSITION_INT_DATA::ID, 50_000.0),
    (SIM_STATE_DATA::ID, 50_000.0),
    (ATTITUDE_QUATERNION_DATA::ID, 50_000.0),
    (GIMBAL_DEVICE_ATTITUDE_STATUS_DATA::ID, 50_000.0),
    (SYSTEM_TIME_DATA::ID, 500_000.0),
];
/// A vehicle further from the mission's origin than this is over another place, metres.
const ELSEWHERE_M: f64 = 5_000.0;

/// The camera and where it is.
#[derive(Clone, Debug)]
pub struct AttachedSettings {
    /// Seed of the world.
    pub world_seed: u64,
    /// Size and contents of the world.
    pub world: WorldSettings,
    /// Where it lies: the mission's origin.
    pub origin: Geodetic,
    /// The lens.
    pub lens: Lens,
    /// How the camera sits on the vehicle. One on a gimbal that the vehicle says nothing of looks straight down.
    pub mount: MountSettings,
    /// Signing.
    pub link: LinkSettings,
    /// The vehicle's system id.
    pub system_id: u8,
    /// Start of the pictures' names.
    pub prefix: String,
}

/// What was photographed.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct AttachedReport {
    /// Exposures triggered.
    pub triggers: u64,
    /// Of them without a picture: no pose, or more at once than can be made.
    pub missed: u64,
    /// What was done with the pictures.
    pub pictures: PictureCounters,
}

/// A state of the simulator.
#[derive(Clone, Copy)]
struct Truth {
    boot_ns: u64,
    at: Geodetic,
    attitude: DQuat,
}

/// Its own heartbeats.
#[derive(Default)]
struct Heartbeat {
    sent: u64,
    next_ns: u64,
}

struct Attached {
    channel: Channel<Reconnecting>,
    clock: MonotonicClock,
    autopilot: Autopilot,
    /// Understands the commands to a camera; its answers are the onboard job's business.
    commands: MavlinkCamera,
    mount: Mount,
    settings: AttachedSettings,
    truths: VecDeque<Truth>,
    /// Boot time of the newest position, and when it came.
    position_ns: Option<(u64, u64)>,
    waiting: VecDeque<(Trigger, u64)>,
    views: SyncSender<PinholeView>,
    photographer: Photographer,
    /// Highest number of a picture that was in the folder before.
    numbered: u64,
    heartbeat: Heartbeat,
    is_told: bool,
    report: AttachedReport,
}

/// Photographs for the vehicle at `address` until `stop` is set.
///
/// `on_ready` is told the path of the pseudo-terminal for `pty:` (else `None`).
///
/// # Errors
/// A link, signing key or folder that cannot be used, a picture that cannot be written.
pub fn photograph(
    settings: &AttachedSettings,
    address: &LinkAddress,
    camera_dir: &Path,
    stop: &AtomicBool,
    on_ready: &mut dyn FnMut(Option<&Path>),
) -> Result<AttachedReport, SimError> {
    let link = Reconnecting::open(address.clone(), true)?;
    on_ready(link.link().and_then(|l| l.pty_path()));
    let (signer, _) = signing_store::open(&settings.link)?;
    let world = World::new(settings.world_seed, &settings.world);
    let (views, inbox): (_, Receiver<PinholeView>) = sync_channel(WAITING);
    let pictures = inbox.into_iter().map(move |view| to_jpeg(&world.render(&view).0));
    let ids = Ids { system: settings.system_id, autopilot: 1, own_component: COMPONENT };
    let (width, height) = (settings.lens.width, settings.lens.height);
    let mut attached = Attached {
        channel: Channel::new(link, settings.system_id, COMPONENT, signer),
        clock: MonotonicClock::default(),
        autopilot: Autopilot::new(ids),
        commands: MavlinkCamera::new(CameraInfo { width, height }, CAMERA),
        mount: Mount::new(&settings.mount, EnuFrame::new(settings.origin)),
        settings: settings.clone(),
        truths: VecDeque::with_capacity(STATES),
        position_ns: None,
        waiting: VecDeque::with_capacity(WAITING),
        views,
        photographer: Photographer::on_demand(camera_dir, settings.world_seed, pictures)?,
        numbered: highest_number(camera_dir, &settings.prefix),
        heartbeat: Heartbeat::default(),
        is_told: false,
        report: AttachedReport::default(),
    };
    let begun = Instant::now();
    while !stop.load(Ordering::Relaxed) {
        attached.turn(begun.elapsed().as_secs_f64())?;
    }
    let Attached { views, photographer, report, .. } = attached;
    drop(views);
    Ok(AttachedReport { pictures: photographer.finish(true)?, ..report })
}

impl Attached {
    fn turn(&mut self, wall_s: f64) -> Result<(), SimError> {
        self.channel.fill(TICK)?;
        let now_ns = self.clock.now_ns();
        self.hear(now_ns);
        while let Some(Request::Capture(sequence)) = self.commands.next_request(now_ns) {
            self.autopilot.announce_own(sequence, now_ns);
        }
        while self.commands.next_reply(0, now_ns).is_some() {}
        self.autopilot.settle_own(now_ns);
        while let Some(answer) = self.autopilot.next_answer() {
            self.say(&answer);
        }
        if now_ns >= self.heartbeat.next_ns {
            self.heartbeat.next_ns = now_ns + BEAT_NS;
            self.beat(now_ns);
        }
        while let Some(trigger) = self.autopilot.next_trigger() {
            self.report.triggers += 1;
            if self.waiting.len() == WAITING {
                self.waiting.pop_front();
                self.miss(&trigger, "too many at once");
            }
            self.waiting.push_back((trigger, now_ns));
        }
        self.expose(now_ns, wall_s);
        self.photographer.deliver(wall_s, &FaultSettings::default())
    }

    fn hear(&mut self, now_ns: u64) {
        let system = self.autopilot.ids().system;
        while let Some(frame) = self.channel.next_frame() {
            self.commands.handle(&frame, system, now_ns);
            self.autopilot.handle(&frame, now_ns);
            if frame.system() != system {
                continue;
            }
            if frame.id() == GLOBAL_POSITION_INT_DATA::ID {
                self.position_ns = self.autopilot.track().newest_position().map(|p| (p.boot_ns, now_ns));
            } else if let Some(m) = frame.message::<SIM_STATE_DATA>()
                && let Some((boot_ns, heard_ns)) = self.position_ns
                && now_ns.saturating_sub(heard_ns) <= SAME_MOMENT_NS
                && self.truths.back().is_none_or(|newest| newest.boot_ns != boot_ns)
            {
                let (at, attitude, _) = messages::truth(&m);
                if at.is_valid() && attitude.is_finite() {
                    if self.truths.len() == STATES {
                        self.truths.pop_front();
                    }
                    self.truths.push_back(Truth { boot_ns, at, attitude });
                }
            }
        }
    }

    /// Sends; a vehicle that is not there yet, or not any more, is waited for.
    fn say<D: MessageData>(&mut self, message: &D) {
        let _ = self.channel.send(message);
    }

    fn beat(&mut self, now_ns: u64) {
        self.say(&HEARTBEAT_DATA {
            mavtype: MavType::MAV_TYPE_ONBOARD_CONTROLLER,
            autopilot: MavAutopilot::MAV_AUTOPILOT_INVALID,
            system_status: MavState::MAV_STATE_ACTIVE,
            mavlink_version: 3,
            ..HEARTBEAT_DATA::default()
        });
        let request = self.autopilot.ask_time(now_ns);
        self.say(&request);
        if self.heartbeat.sent % ASK_EVERY_BEATS == 1 {
            for (id, every_us) in STREAMS {
                self.say(&COMMAND_LONG_DATA {
                    command: MavCmd::MAV_CMD_SET_MESSAGE_INTERVAL,
                    target_system: self.settings.system_id,
                    target_component: 1,
                    param1: id as f32,
                    param2: every_us,
                    ..COMMAND_LONG_DATA::default()
                });
            }
        }
        self.heartbeat.sent += 1;
    }

    /// Views of the exposures whose pose is known.
    fn expose(&mut self, now_ns: u64, wall_s: f64) {
        while let Some((trigger, heard_ns)) = self.waiting.front().copied() {
            let patient = now_ns.saturating_sub(heard_ns) < PATIENCE_NS;
            let body = match self.autopilot.pose_at(trigger.boot_ns) {
                Err(PoseError::NotYet | PoseError::Empty) if patient => return,
                Err(PoseError::NotYet) => self.autopilot.pose_near(trigger.boot_ns),
                other => other,
            };
            self.waiting.pop_front();
            let view = body.ok().and_then(|body| self.view(body, trigger.boot_ns));
            let Some(view) = view else {
                self.miss(&trigger, "the vehicle has not said where it was");
                continue;
            };
            match self.views.try_send(view) {
                Ok(()) => {
                    let number = self.numbered + u64::from(trigger.sequence);
                    let name = picture_name(&self.settings.prefix, number);
                    let ready_s = wall_s + TRANSFER_S;
                    self.photographer.expose(Exposure { trigger_s: wall_s, middle_s: wall_s, ready_s, name });
                }
                Err(TrySendError::Full(_) | TrySendError::Disconnected(_)) => {
                    self.miss(&trigger, "this machine makes pictures too slowly");
                }
            }
        }
    }

    fn miss(&mut self, trigger: &Trigger, why: &str) {
        self.report.missed += 1;
        tracing::warn!("exposure {}: no picture, {why}", trigger.sequence);
    }

    /// The camera's view at an exposure: where the vehicle truly was, if that is known.
    fn view(&mut self, mut body: BodyPose, boot_ns: u64) -> Option<PinholeView> {
        if let Some((at, attitude)) = self.truth(boot_ns) {
            (body.position, body.attitude) = (at, attitude);
        }
        if body.gimbal.is_none() {
            let heading = yaw_of_ned(attitude_to_ned(body.attitude));
            body.gimbal = Some(attitude_to_enu(euler_to_ned(0.0, -std::f64::consts::FRAC_PI_2, heading)));
        }
        let pose = self.mount.camera_pose(&body, 0.0)?;
        if pose.position.truncate().length() > ELSEWHERE_M && !std::mem::replace(&mut self.is_told, true) {
            tracing::warn!(
                "the vehicle is {:.0} km from the mission's origin, where the simulated ground lies; start the simulator there, \
                 or give its home as origin",
                pose.position.truncate().length() / 1e3
            );
        }
        Some(self.settings.lens.at(pose.position, pose.rotation))
    }

    /// The simulator's own state at a boot time, between the two around it.
    fn truth(&self, boot_ns: u64) -> Option<(Geodetic, DQuat)> {
        let next = self.truths.partition_point(|t| t.boot_ns < boot_ns);
        let (b, a) = (self.truths.get(next)?, self.truths.get(next.checked_sub(1)?)?);
        let share = (boot_ns - a.boot_ns) as f64 / (b.boot_ns - a.boot_ns).max(1) as f64;
        let between = |a: f64, b: f64| a + (b - a) * share;
        let at = Geodetic {
            lat_deg: between(a.at.lat_deg, b.at.lat_deg),
            lon_deg: between(a.at.lon_deg, b.at.lon_deg),
            alt_m: between(a.at.alt_m, b.at.alt_m),
        };
        Some((at, attitude_to_enu(a.attitude.slerp(b.attitude, share)).normalize()))
    }
}

/// Highest number of the pictures in `folder` whose names begin with `prefix`; a camera goes on counting from there.
pub(crate) fn highest_number(folder: &Path, prefix: &str) -> u64 {
    let names = std::fs::read_dir(folder).into_iter().flatten().flatten().map(|entry| entry.file_name());
    let number = |name: std::ffi::OsString| name.to_str()?.strip_prefix(prefix)?.strip_suffix(".jpg")?.parse().ok();
    names.filter_map(number).max().unwrap_or(0)
}
