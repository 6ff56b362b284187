//! One aircraft as the runtime sees it: the generic driver over link, camera and clock. [`Vehicle::poll`] gives poses,
//! exposures and posed pictures in order, on the companion's clock, in East-North-Up metres; everything lost on the way is
//! counted and named.

mod cameras;
mod complaints;
mod event;
mod exposures;
pub mod mount;
mod service;
mod settings;

use std::time::{Duration, Instant};

use geometry::geodesy::EnuFrame;

pub use complaints::Complaint;
pub use event::{CameraPose, Event, PoseReport, PosedPicture, Unmatched, UnmatchedReason};
pub use settings::VehicleSettings;

use crate::autopilot::{Autopilot, AutopilotState, Handled, Ids};
use crate::blank::{Blank, blank};
use crate::camera::{AnyCamera, Picture, undistort};
use crate::counters::{ExposureCounters, HalCounters, LinkCounters, PictureCounters};
use crate::error::HalError;
use crate::failsafe::Flags;
use crate::link::Reconnecting;
use crate::matcher::{Matcher, MatcherSettings};
use crate::mavlink::channel::Channel;
use crate::mavlink::dialect::MavSeverity;
use crate::peer::{Peers, Verdict};
use crate::time::MonotonicClock;
use crate::traits::{Camera, Clock, Link, LinkState, TriggerSource};
use cameras::{Cameras, Passage};
use event::Events;
use exposures::Exposures;
use mount::Mount;
use service::Service;

/// The link is read in slices of this, so that pictures and timers are served while it is silent.
const SLICE: Duration = Duration::from_millis(20);

/// The driver. `Vehicle` alone means the real thing: any link, any camera, the monotonic clock.
pub struct Vehicle<L: Link = Reconnecting, C = AnyCamera, K = MonotonicClock> {
    channel: Channel<L>,
    camera: C,
    now: Now<K>,
    peers: Peers,
    autopilot: Autopilot,
    matcher: Matcher<Picture>,
    exposures: Exposures,
    mount: Mount,
    service: Service,
    settings: VehicleSettings,
    events: Events,
    lost: bool,
    trouble: Trouble,
    finished: bool,
    counters: HalCounters,
}

/// The companion's clock; a recording brings its own.
struct Now<K> {
    clock: K,
    recorded_ns: Option<u64>,
}

/// What is wrong with the pictures that came last.
#[derive(Default)]
struct Trouble {
    /// Exposures given up since the last picture came.
    pictureless: u32,
    /// Pictures in a row that showed nothing or could not be decoded.
    poor: u32,
    /// The ground control station knows of them.
    told: bool,
}

impl Trouble {
    /// A picture is good again; what the ground control station is told of it.
    fn recovered(&mut self) -> Option<String> {
        let poor = std::mem::take(&mut self.poor);
        std::mem::take(&mut self.told).then(|| format!("dgtr: pictures are good again, {poor} were not"))
    }
}

impl Vehicle {
    /// Opens the link and the camera. A serial port that is not there yet is waited for; an address or camera that can
    /// never work is an error.
    ///
    /// # Errors
    /// One line on the link, the camera or the signing key.
    pub fn open(settings: &VehicleSettings) -> Result<Self, HalError> {
        let link = Reconnecting::open(settings.address.clone(), settings.patient)?;
        let camera = match &settings.camera {
            Some(source) => AnyCamera::open(source, &settings.lens, settings.pictures_since)?,
            None => AnyCamera::None,
        };
        Self::new(link, camera, MonotonicClock::default(), settings)
    }

    /// The link's address and state, for messages.
    pub fn link(&self) -> &Reconnecting {
        self.channel.link()
    }
}

impl<L, C, K> Vehicle<L, C, K>
where
    L: Link<Error = HalError>,
    C: Camera<Picture = Picture, Error = HalError>,
    K: Clock,
{
    /// A vehicle over these parts.
    ///
    /// # Errors
    /// A signing key that cannot be read.
    pub fn new(link: L, camera: C, clock: K, settings: &VehicleSettings) -> Result<Self, HalError> {
        let ids = Ids { system: settings.system_id, autopilot: 1, own_component: settings.link.own_component };
        let ns = |seconds: f32| (f64::from(seconds.max(0.0)) * 1e9) as u64;
        let matching = MatcherSettings {
            latency_ns: ns(settings.link.picture_latency_ms * 1e-3),
            patience_ns: ns(settings.link.patience_s),
            ..MatcherSettings::default()
        };
        let (service, signer) = Service::new(settings)?;
        Ok(Self {
            channel: Channel::new(link, ids.system, ids.own_component, signer),
            camera,
            now: Now { clock, recorded_ns: None },
            peers: Peers::new(ids.system),
            autopilot: match settings.pictures_since {
                Some(_) => Autopilot::new(ids).continued(ns(settings.link.standing_limit_s)),
                None => Autopilot::new(ids),
            }
            .with_gimbal(settings.mount.gimbal),
            matcher: Matcher::new(matching),
            exposures: Exposures::new(Cameras::new(settings.lens.index, matching.patience_ns)),
            mount: Mount::new(&settings.mount, EnuFrame::new(settings.origin)),
            service,
            settings: settings.clone(),
            events: Events::default(),
            lost: false,
            trouble: Trouble::default(),
            finished: false,
            counters: HalCounters::default(),
        })
    }

    /// The next event, waiting `timeout` at most for one.
    ///
    /// # Errors
    /// Errors of a link that does not reconnect by itself.
    pub fn poll(&mut self, timeout: Duration) -> Result<Option<Event>, HalError> {
        let deadline = Instant::now() + timeout;
        loop {
            if let Some(event) = self.events.pop_front() {
                return Ok(Some(event));
            }
            let left = deadline.saturating_duration_since(Instant::now());
            self.receive(left.min(SLICE))?;
            self.look_at_link();
            let now_ns = self.now_ns();
            self.serve(now_ns);
            complaints::look(self, now_ns);
            if self.finished {
                self.hand_out(true);
            } else {
                self.take_pictures(now_ns);
                self.settle(now_ns);
            }
            if self.events.is_empty() && (left.is_zero() || self.finished) {
                return Ok(None);
            }
        }
    }

    /// The companion's clock as this vehicle sees it: a recording brings its own.
    pub fn now_ns(&self) -> u64 {
        self.now.recorded_ns.unwrap_or_else(|| self.now.clock.now_ns())
    }

    /// True once a recording is at its end and every picture and exposure is accounted for.
    pub fn is_finished(&self) -> bool {
        self.finished && self.events.is_empty() && self.exposures.pending.is_empty() && self.exposures.is_closed()
    }

    /// True while pictures of announced exposures have not come.
    pub fn awaits_pictures(&self) -> bool {
        self.exposures.await_pictures()
    }

    /// Complete pictures seen so far.
    pub fn pictures(&self) -> u64 {
        self.counters.pictures.pictures
    }

    /// True while the autopilot is silent or the link closed.
    pub fn is_link_lost(&self) -> bool {
        self.lost
    }

    /// What this side knows for the failsafe ladder: link, position, camera, battery. The runtime adds its own.
    pub fn flags(&self) -> Flags {
        let (state, limits) = (self.autopilot(), &self.settings.failsafe);
        let sigma = self.autopilot.track().newest_position().map(|p| p.sigma_m.max_element());
        Flags {
            link_lost: self.lost && state.heartbeat_ns.is_some(),
            position_poor: state.gps_fix.is_some_and(|fix| fix < 3)
                || sigma.is_some_and(|s| s > f64::from(limits.position_sigma_m)),
            camera_silent: self.trouble.pictureless >= limits.silent_exposures,
            pictures_poor: self.trouble.poor >= limits.poor_pictures,
            battery_low: state.battery_percent.is_some_and(|p| p <= limits.battery_low_pct),
            ..Flags::default()
        }
    }

    /// Pictures are posed by their own time: video, or an intervalometer that nobody announces.
    fn is_free_running(&self) -> bool {
        self.settings.link.free_running || self.camera.is_continuous()
    }

    /// What the autopilot says about itself.
    pub fn autopilot(&self) -> AutopilotState {
        self.autopilot.state(self.now_ns())
    }

    /// Height of the place where the aircraft takes off, metres above the mission's origin, as the autopilot says.
    pub fn home_m(&self) -> Option<f64> {
        self.autopilot().home_alt_m.map(|alt_m| alt_m - self.settings.origin.alt_m)
    }

    /// Undistorted pixels of a frame. One that shows nothing is counted and the ground control station told: once when they
    /// begin, and how many there were when they are over.
    ///
    /// # Errors
    /// [`HalError::Picture`] when it cannot be decoded or has the wrong size, [`HalError::Blank`] when it shows nothing.
    pub fn load(&mut self, frame: &PosedPicture) -> Result<image::RgbImage, HalError> {
        let decoded = frame.picture.decode(&self.settings.lens);
        let blank = decoded.as_ref().ok().and_then(blank);
        if blank.is_none() && decoded.is_ok() {
            if let Some(text) = self.trouble.recovered() {
                self.status_text(MavSeverity::MAV_SEVERITY_INFO, &text);
            }
        } else {
            self.trouble.poor = self.trouble.poor.saturating_add(1);
        }
        if let Some(blank) = blank {
            let path = frame.picture.name();
            *match blank {
                Blank::Black => &mut self.counters.pictures.pictures_black,
                Blank::Overexposed => &mut self.counters.pictures.pictures_overexposed,
                Blank::Constant => &mut self.counters.pictures.pictures_constant,
            } += 1;
            if !self.trouble.told && self.service.may_warn(self.now_ns()) {
                self.trouble.told = true;
                let name = path.file_name().unwrap_or_default().to_string_lossy().into_owned();
                self.status_text(MavSeverity::MAV_SEVERITY_WARNING, &format!("dgtr: {name} is {blank}, left out"));
            }
            return Err(HalError::Blank { path, blank });
        }
        Ok(undistort(decoded?, &self.settings.lens))
    }

    /// Everything counted so far.
    pub fn counters(&self) -> HalCounters {
        let (heard, wire) = (self.autopilot.counters(), self.channel.counters());
        let own = self.counters;
        let link = LinkCounters {
            frames: wire.frames.frames,
            damaged: wire.frames.damaged,
            skipped_bytes: wire.frames.skipped_bytes,
            unknown: wire.frames.unknown + wire.frames.unsupported,
            unsigned: wire.unsigned,
            wrong_key: wire.wrong_key,
            replayed: wire.replayed,
            sent: wire.sent,
            send_failed: wire.send_failed,
            foreign: heard.link.foreign + own.link.foreign,
            lost: heard.link.lost,
            ..own.link
        };
        let exposures = ExposureCounters {
            triggers_unmatched: heard.exposures.triggers_unmatched + own.exposures.triggers_unmatched,
            exposures_tilted: own.exposures.exposures_tilted,
            poseless: own.exposures.poseless,
            ..heard.exposures
        };
        let pictures = PictureCounters { pictures_lost: self.camera.lost_pictures(), ..own.pictures };
        HalCounters {
            link,
            telemetry: heard.telemetry,
            exposures,
            pictures,
            events_dropped: self.events.dropped,
            ..own
        }
    }

    fn receive(&mut self, wait: Duration) -> Result<(), HalError> {
        self.channel.fill(wait)?;
        self.now.recorded_ns = self.channel.received_ns().or(self.now.recorded_ns);
        if self.channel.link().state() == LinkState::Ended {
            self.channel.end();
        }
        self.take_frames();
        Ok(())
    }

    fn take_frames(&mut self) {
        let (now_ns, peer) = (self.now_ns(), self.channel.peer());
        loop {
            let (mut verdict, mut claims) = (Verdict::Refuse, false);
            let (peers, refused) = (&mut self.peers, &mut self.counters.link.refused_peers);
            let complaints = &mut self.service.complaints;
            let frame = self.channel.next_frame_if(|frame| {
                complaints.hear(frame);
                verdict = peers.judge(peer, frame, now_ns);
                *refused += u64::from(verdict == Verdict::Refuse);
                claims |= verdict == Verdict::Claims;
                matches!(verdict, Verdict::Take | Verdict::TakeAfresh)
            });
            let Some(frame) = frame else {
                if let Some(peer) = peer.filter(|_| claims) {
                    self.channel.link_mut().vouch(peer);
                }
                break;
            };
            if verdict == Verdict::TakeAfresh {
                self.autopilot.start_afresh();
            }
            self.service.component.handle(&frame, self.autopilot.ids().system, now_ns);
            if self.autopilot.handle(&frame, now_ns) == Handled::Position {
                let report = self.mount.report(&self.autopilot, now_ns);
                report.into_iter().for_each(|pose| self.events.push(Event::Pose(pose)));
            }
        }
        if let Some(pinned) = self.peers.address().filter(|pinned| peer == Some(*pinned)) {
            self.channel.link_mut().pin(pinned);
        }
    }

    fn look_at_link(&mut self) {
        let state = self.channel.link().state();
        let silent = self.autopilot().heartbeat_ns.is_some_and(|t| {
            let limit_ns = (f64::from(self.settings.link.heartbeat_timeout_s) * 1e9) as u64;
            self.now_ns().saturating_sub(t) > limit_ns
        });
        let lost = silent || state != LinkState::Up;
        if lost && !self.lost {
            self.counters.link.link_losses += u64::from(state != LinkState::Ended);
            self.channel.resynchronise();
            self.events.push(Event::LinkLost);
        } else if !lost && self.lost {
            self.events.push(Event::LinkBack);
        }
        self.lost = lost;
        if state == LinkState::Ended && !self.finished {
            self.finish();
        }
    }

    /// Announced exposures into the matcher and the list of poses to find.
    fn take_triggers(&mut self, now_ns: u64) {
        while let Some(trigger) = self.autopilot.next_trigger() {
            let passage = self.exposures.cameras.take_trigger(trigger);
            if passage == Passage::Other {
                self.counters.link.foreign += 1;
                continue;
            }
            let delay_ns = (f64::from(self.settings.lens.exposure_delay_ms) * 1e6) as i64;
            let (mid_boot_ns, awaited) = (trigger.boot_ns.saturating_add_signed(delay_ns), !self.is_free_running());
            if let Some(oldest) = self.exposures.push(trigger, mid_boot_ns, now_ns, awaited) {
                self.counters.exposures.triggers_unmatched += 1;
                tracing::warn!("exposure {}: no picture came", oldest.sequence);
            }
            self.events.push(Event::Trigger(trigger));
            if self.is_free_running() {
                self.service.make_due();
            } else if passage == Passage::Through(trigger)
                && let Some(outcome) = self.matcher.push_trigger(trigger)
            {
                self.take_outcome(outcome);
            }
        }
        self.service.name_gimbals(&self.autopilot, self.settings.mount.gimbal);
    }
}

#[cfg(test)]
mod tests;
