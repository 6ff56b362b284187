//! Link and camera to key frames, one turn at a time on whatever clock: listens, picks, decodes, hands over, and decides when
//! the flight is over: several signs agree that the aircraft is down, or nothing was heard for longer than it can fly. Never
//! waits for the reconstruction: key frames wait decoded, as they will be trained on, as many as are planned for; those beyond
//! wait as files and are decoded once more.

use std::collections::{HashSet, VecDeque};
use std::sync::mpsc::TrySendError;
use std::time::Duration;

use config::coverage::CoverageSettings;
use config::mission::KeyframeSettings;
use hal::camera::Picture;
use hal::counters::HalCounters;
use hal::error::HalError;
use hal::mavlink::dialect::MavSeverity;
use hal::traits::{Camera, Clock, Link};
use hal::vehicle::{Event, PosedPicture, Vehicle, VehicleSettings};
use models::camera::{Intrinsics, Pose, PoseSigma, PosedImage, View};
use models::picture;
use pages::watch::Watch;

use super::geotags::Geotags;
use super::handover::{CaptureEnd, Seen};
use super::record::{Entry, Recorder};
use super::show::ShownCapture;
use crate::capture::{Decision, KeyframeCounters, KeyframeSelector};
use crate::coverage::Coverage;
use crate::error::FlightError;
use crate::keyframe_store::KeyFrame;

mod ground;
mod station;

/// After the aircraft has landed, pictures that nobody announced may still be on their way from the camera for this long.
const LATE_PICTURES_NS: u64 = 2_000_000_000;
/// Key frames that wait decoded: what a rebuild of several seconds may hold up.
pub(super) const DECODED_AHEAD: usize = 16;
/// Events taken in one turn, so that the job's words are heard between them.
const EVENTS_A_TURN: usize = 64;

/// Of a region that is covered to this share nothing is left to fly for, percent.
const COVERED: u32 = 95;

/// When the capture is over.
#[derive(Clone, Copy, Debug)]
pub struct EndOfFlight {
    /// Silence of link and camera after which nobody can be flying any more.
    pub silence: Duration,
    /// Give up when nothing at all was heard for this long; None = wait for ever.
    pub patience: Option<Duration>,
}

/// Why capture ended.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Ended {
    /// The aircraft flew and is down again: several signs agreed for seconds.
    Landed,
    /// The recording is at its end.
    RecordingOver,
    /// Link and camera stayed silent for longer than the aircraft can fly.
    LinkLost,
    /// Nothing was ever heard.
    NeverHeard,
    /// Somebody asked.
    Asked,
}

/// What capture has counted.
#[derive(Clone, Debug, Default)]
pub struct FlightCounters {
    /// Fates of the matched pictures.
    pub keyframes: KeyframeCounters,
    /// Pictures decoded: each that became a key frame once, and each that turned out to show nothing.
    pub decoded: u32,
    /// Pictures that could not be decoded.
    pub undecodable: u32,
    /// Pictures or triggers that found no partner.
    pub unmatched: u32,
    /// Times the link was lost.
    pub links_lost: u32,
    /// The HAL's own counters.
    pub hal: HalCounters,
    /// The ground that the key frames see; `None` before the first of them, or for a region without an area.
    pub coverage: Option<Coverage>,
}

/// What capture needs to know.
pub struct FlightPlan {
    /// Link, camera, lens, mount, origin.
    pub vehicle: VehicleSettings,
    /// Lens of the pictures that are trained on (undistorted, scaled).
    pub intrinsics: Intrinsics,
    /// The key-frame rule.
    pub keyframes: KeyframeSettings,
    /// Longest training, seconds; what the ground station is shown and may change.
    pub training_seconds: Option<f64>,
    /// When ground is covered.
    pub coverage: CoverageSettings,
    /// Which ground is to be: corners, metres east and north.
    pub region: Vec<[f64; 2]>,
    /// Poses of earlier key frames.
    pub earlier: Vec<Pose>,
    /// Their names: no new one may take them.
    pub earlier_names: HashSet<String>,
    /// When it is over.
    pub end: EndOfFlight,
    /// Where every matched picture is noted.
    pub geotags: Geotags,
    /// The live page; this is its aircraft 0.
    pub watch: Watch,
    /// Takes what happens.
    pub recorder: Recorder,
}

/// A key frame that the job has not taken yet.
enum Waiting {
    Decoded(KeyFrame),
    File(PosedPicture),
}

#[derive(Clone, Copy)]
enum Phase {
    Flying,
    /// It has landed since then, and its region is not covered: it may take off again with another battery.
    OnGround(u64),
    /// The flight is over since then; pictures of announced exposures may still come.
    LatePictures(Ended, u64),
    /// Nothing comes any more; what was decided at the end is reported.
    Closing(Ended),
    /// What was chosen is handed over as long as somebody takes it.
    Emptying(Ended),
}

/// One aircraft's capture.
pub(super) struct Intake<L: Link, C, K> {
    plan: FlightPlan,
    vehicle: Vehicle<L, C, K>,
    clock: K,
    selector: KeyframeSelector,
    pending: VecDeque<Waiting>,
    end: CaptureEnd,
    phase: Phase,
    started_ns: u64,
    /// When the autopilot last showed a sign of life.
    heard_ns: Option<u64>,
    /// Complete pictures seen, and when the last one came.
    pictures: (u64, u64),
    /// Names of all key frames, those of earlier runs too.
    names: HashSet<String>,
    counters: FlightCounters,
    shown: ShownCapture,
    /// When the ground station was last shown how things stand.
    stationed_ns: Option<u64>,
}

impl<L, C, K> Intake<L, C, K>
where
    L: Link<Error = HalError>,
    C: Camera<Picture = Picture, Error = HalError>,
    K: Clock,
{
    /// `clock` runs as the vehicle's own does.
    pub(super) fn new(mut plan: FlightPlan, vehicle: Vehicle<L, C, K>, clock: K, end: CaptureEnd) -> Self {
        plan.recorder.set_clock(vehicle.now_ns());
        let mut selector = KeyframeSelector::new(plan.keyframes);
        plan.earlier.iter().for_each(|pose| selector.restore(*pose));
        let shown = ShownCapture::new(plan.watch.clone(), plan.intrinsics, &plan.earlier);
        Self {
            pending: VecDeque::with_capacity(plan.keyframes.max as usize),
            names: std::mem::take(&mut plan.earlier_names),
            started_ns: clock.now_ns(),
            pictures: (0, clock.now_ns()),
            plan,
            vehicle,
            clock,
            selector,
            end,
            phase: Phase::Flying,
            heard_ns: None,
            counters: FlightCounters::default(),
            shown,
            stationed_ns: None,
        }
    }

    /// One look at link and camera, waiting `wait` at most; why the flight ended once everything is handed over.
    ///
    /// # Errors
    /// A link or camera that will not come back.
    pub(super) fn turn(&mut self, wait: Duration) -> Result<Option<Ended>, FlightError> {
        let stop = self.end.stop_asked();
        self.show_station();
        match self.phase {
            Phase::Flying => {
                if stop {
                    return Ok(Some(Ended::Asked));
                }
                if let Some(ended) = self.fly(wait)? {
                    let now_ns = self.clock.now_ns();
                    self.phase = match ended == Ended::Landed && self.may_take_off_again() {
                        true => Phase::OnGround(now_ns),
                        false => Phase::LatePictures(ended, now_ns),
                    };
                }
            }
            Phase::OnGround(since_ns) => {
                let ended = self.fly(wait)?;
                let now_ns = self.clock.now_ns();
                let swap_ns = (f64::from(self.plan.vehicle.link.battery_swap_s) * 1e9) as u64;
                let over = now_ns.saturating_sub(since_ns) >= swap_ns;
                self.phase = match ended {
                    _ if stop => return Ok(Some(Ended::Asked)),
                    None if self.vehicle.autopilot().armed => {
                        let line = "takes off again: the flight goes on";
                        tracing::info!("{line}");
                        self.say(MavSeverity::MAV_SEVERITY_INFO, format!("dgtr: {line}"));
                        Phase::Flying
                    }
                    Some(Ended::RecordingOver) => Phase::LatePictures(Ended::RecordingOver, now_ns),
                    Some(Ended::LinkLost) => Phase::LatePictures(Ended::Landed, now_ns),
                    _ if over => Phase::LatePictures(Ended::Landed, now_ns),
                    _ => self.phase,
                };
            }
            Phase::LatePictures(ended, since_ns) => {
                self.listen(wait)?;
                let quiet_ns = self.clock.now_ns().saturating_sub(since_ns.max(self.pictures.1));
                let late_ns = (f64::from(self.plan.vehicle.link.late_pictures_s) * 1e9) as u64;
                let all_came = !self.vehicle.awaits_pictures() && quiet_ns >= LATE_PICTURES_NS;
                if stop || self.vehicle.is_finished() || all_came || quiet_ns >= late_ns {
                    self.vehicle.finish();
                    self.shown.over();
                    self.phase = Phase::Closing(ended);
                }
            }
            Phase::Closing(ended) => {
                self.listen(Duration::ZERO)?;
                if self.vehicle.is_finished() {
                    self.tell_coverage();
                    self.phase = Phase::Emptying(ended);
                }
            }
            Phase::Emptying(ended) => {
                if stop || self.pending.is_empty() {
                    return Ok(Some(ended));
                }
                self.hand_over();
                std::thread::sleep(wait);
            }
        }
        Ok(None)
    }

    /// What was counted, at the end.
    pub(super) fn finish(mut self) -> FlightCounters {
        if self.counters.coverage.is_none() {
            self.counters.coverage = self.survey();
        }
        self.counters.keyframes = self.selector.counters();
        self.counters.hal = self.vehicle.counters();
        self.counters
    }

    fn fly(&mut self, wait: Duration) -> Result<Option<Ended>, FlightError> {
        while let Ok((severity, text)) = self.end.words.try_recv() {
            self.say(severity, text);
        }
        let alive = self.listen(wait)?;
        let now_ns = self.clock.now_ns();
        if alive {
            self.heard_ns = Some(now_ns);
        }
        self.end.set_flags(self.vehicle.flags());
        let (autopilot, lost) = (self.vehicle.autopilot(), self.vehicle.is_link_lost());
        self.shown.aircraft(&autopilot, lost, self.vehicle.pictures());
        self.end.set_seen(Seen { battery_pct: autopilot.battery_percent, covered_pct: self.shown.covered });
        if self.vehicle.autopilot().landed {
            return Ok(Some(Ended::Landed));
        }
        if self.vehicle.is_finished() {
            return Ok(Some(Ended::RecordingOver));
        }
        let since = |ns: u64| Duration::from_nanos(now_ns.saturating_sub(ns));
        Ok(match self.heard_ns {
            Some(at) if since(at) > self.plan.end.silence => Some(Ended::LinkLost),
            None if self.plan.end.patience.is_some_and(|p| since(self.started_ns) > p) => Some(Ended::NeverHeard),
            _ => None,
        })
    }

    /// Whether the flight may go on after this landing: some of its region is not covered. Says so.
    fn may_take_off_again(&mut self) -> bool {
        let swap_s = self.plan.vehicle.link.battery_swap_s;
        let covered = self.survey().map(|coverage| coverage.percent()).filter(|_| swap_s > 0.0);
        let Some(covered) = covered.filter(|percent| *percent < COVERED) else { return false };
        let line = format!("landed, {covered} % of the region covered: waits {swap_s} s for another take-off");
        tracing::info!("{line} ([link] battery_swap_s)");
        self.say(MavSeverity::MAV_SEVERITY_INFO, format!("dgtr: {line}"));
        true
    }

    /// Takes what link and camera have; true when the aircraft showed a sign of life.
    fn listen(&mut self, wait: Duration) -> Result<bool, FlightError> {
        let (mut alive, mut wait) = (false, wait);
        for _ in 0..EVENTS_A_TURN {
            let Some(event) = self.vehicle.poll(wait)? else { break };
            wait = Duration::ZERO;
            alive |= matches!(event, Event::Pose(_) | Event::Trigger(_) | Event::Posed(_) | Event::LinkBack);
            match event {
                Event::Posed(frame) => self.choose(frame),
                Event::Unmatched(what) => {
                    self.counters.unmatched += 1;
                    tracing::warn!("{what}");
                }
                Event::LinkLost => {
                    self.counters.links_lost += 1;
                    tracing::warn!("link to the autopilot lost; waiting for it to come back");
                }
                Event::Complaint { what, line } => self.shown.complain(what, line.is_some()),
                Event::LinkBack => tracing::info!("link to the autopilot is back"),
                Event::Pose(report) => {
                    self.shown.at = Some(report.position.to_array());
                    self.plan.recorder.note(report.time_ns, Entry::Pose(report));
                }
                Event::Asked { parameter, value } => self.set(parameter, value),
                Event::Trigger(t) => self.plan.recorder.note(t.time_ns, Entry::Exposure(t.sequence)),
            }
        }
        let pictures = self.vehicle.pictures();
        if pictures != self.pictures.0 {
            self.pictures = (pictures, self.clock.now_ns());
            // Somebody still photographs: the aircraft flies, whatever its line does.
            alive |= self.heard_ns.is_some();
        }
        self.hand_over();
        Ok(alive)
    }

    /// A picture is looked at before it counts: one that shows nothing must not keep its place from the next.
    fn choose(&mut self, frame: PosedPicture) {
        let pose = Pose { rotation: frame.pose.rotation, center: frame.pose.position };
        self.look_at_ground();
        let mut decision = self.selector.consider(&pose);
        let loaded = (decision == Decision::Key).then(|| self.vehicle.load(&frame));
        self.counters.decoded += u32::from(loaded.is_some());
        if let Some(Err(e)) = &loaded {
            tracing::warn!("{e}");
            decision = self.selector.retract();
            self.counters.undecodable += u32::from(!matches!(e, HalError::Blank { .. }));
        }
        tracing::debug!("picture {}: {decision:?}", frame.sequence);
        self.plan.geotags.note(&frame, decision);
        if let Some(Ok(image)) = loaded {
            self.shown.key_frame(pose, &image, self.selector.map(), self.clock.now_ns());
            self.plan.recorder.note_key_frame(frame.time_ns, pose, &image);
            self.end.count(true);
            let decoded = self.pending.iter().filter(|w| matches!(w, Waiting::Decoded(_))).count();
            let waiting = match decoded < DECODED_AHEAD {
                true => Waiting::Decoded(self.posed(&frame, image)),
                false => Waiting::File(frame),
            };
            self.pending.push_back(waiting);
        }
    }

    /// Hands over as much as the channel takes, without waiting.
    fn hand_over(&mut self) {
        while let Some(next) = self.pending.pop_front() {
            let ready = match next {
                Waiting::Decoded(ready) => Some(ready),
                Waiting::File(frame) => self.load_again(&frame),
            };
            let Some(ready) = ready else { continue };
            match self.end.frames.try_send(ready) {
                Ok(()) => {}
                Err(TrySendError::Full(back)) => {
                    self.pending.push_front(Waiting::Decoded(back));
                    return;
                }
                Err(TrySendError::Disconnected(_)) => self.pending.clear(),
            }
        }
    }

    /// A key frame that had to wait behind too many: its pixels were not kept.
    fn load_again(&mut self, frame: &PosedPicture) -> Option<KeyFrame> {
        self.counters.decoded += 1;
        match self.vehicle.load(frame) {
            Ok(image) => Some(self.posed(frame, image)),
            Err(e) => {
                tracing::warn!("{e}; the picture is left out");
                self.counters.undecodable += 1;
                self.end.count(false);
                None
            }
        }
    }

    fn posed(&mut self, frame: &PosedPicture, image: image::RgbImage) -> KeyFrame {
        let lens = self.plan.intrinsics;
        let posed = PosedImage {
            name: unused_name(&mut self.names, frame.picture.file_name(frame.sequence)),
            time_ns: frame.time_ns,
            image: picture::resized(image, (lens.width, lens.height)),
            view: View { intrinsics: lens, pose: Pose { rotation: frame.pose.rotation, center: frame.pose.position } },
            mask: None,
            sigma: PoseSigma { position_m: frame.pose.position_sigma_m, rotation_rad: frame.pose.rotation_sigma_rad },
        };
        KeyFrame { posed, file: frame.picture.clone() }
    }
}

/// `name`, or with a number behind it when it is taken: a camera that counts anew with every start takes other pictures under
/// the same names.
fn unused_name(taken: &mut HashSet<String>, name: String) -> String {
    let (stem, extension) = name.rsplit_once('.').unwrap_or((&name, "png"));
    let others = (2..).map(|k: u64| format!("{stem}-{k}.{extension}"));
    let unused = std::iter::once(name.clone()).chain(others).find(|name| !taken.contains(name)).unwrap_or(name);
    taken.insert(unused.clone());
    unused
}
