//! Link and camera to key frames, one turn at a time on whatever clock: listens, picks, decodes, hands over, and decides when
//! the flight is over. Never waits for the reconstruction: pictures wait as paths, only as many as the channel holds are
//! decoded ahead.

use std::collections::VecDeque;
use std::path::Path;
use std::sync::mpsc::TrySendError;
use std::time::Duration;

use hal::camera::Picture;
use hal::error::HalError;
use hal::traits::{Camera, Clock, Link};
use hal::vehicle::{Event, Frame, Vehicle};
use models::camera::{Pose, PoseSigma, PosedImage, View};

use super::FlyError;
use super::flight::{Ended, FlightCounters, FlightPlan};
use super::handover::CaptureEnd;
use crate::capture::{Decision, KeyframeSelector};

/// After the aircraft has landed, pictures may still be on their way from the camera for this long.
const LATE_PICTURES_NS: u64 = 2_000_000_000;
/// Events taken in one turn, so that the job's words are heard between them.
const EVENTS_A_TURN: usize = 64;

#[derive(Clone, Copy)]
enum Phase {
    Flying,
    /// The flight is over; pictures may come until then.
    LatePictures(Ended, u64),
    /// What was chosen is handed over as long as somebody takes it.
    Emptying(Ended),
}

/// One aircraft's capture.
pub(super) struct Intake<L: Link, C, K> {
    plan: FlightPlan,
    vehicle: Vehicle<L, C, K>,
    clock: K,
    selector: KeyframeSelector,
    pending: VecDeque<Frame>,
    ready: Option<PosedImage>,
    end: CaptureEnd,
    phase: Phase,
    started_ns: u64,
    /// When the autopilot last showed a sign of life.
    heard_ns: Option<u64>,
    flown: bool,
    counters: FlightCounters,
}

impl<L, C, K> Intake<L, C, K>
where
    L: Link<Error = HalError>,
    C: Camera<Picture = Picture, Error = HalError>,
    K: Clock,
{
    /// `clock` runs as the vehicle's own does.
    pub(super) fn new(plan: FlightPlan, vehicle: Vehicle<L, C, K>, clock: K, end: CaptureEnd) -> Self {
        let mut selector = KeyframeSelector::new(plan.keyframes);
        plan.earlier.iter().for_each(|pose| selector.restore(*pose));
        Self {
            pending: VecDeque::with_capacity(plan.keyframes.max as usize),
            started_ns: clock.now_ns(),
            plan,
            vehicle,
            clock,
            selector,
            ready: None,
            end,
            phase: Phase::Flying,
            heard_ns: None,
            flown: false,
            counters: FlightCounters::default(),
        }
    }

    /// One look at link and camera, waiting `wait` at most; why the flight ended once everything is handed over.
    ///
    /// # Errors
    /// A link or camera that will not come back.
    pub(super) fn turn(&mut self, wait: Duration) -> Result<Option<Ended>, FlyError> {
        let stop = self.end.stop_asked();
        match self.phase {
            Phase::Flying => {
                if stop {
                    return Ok(Some(Ended::Asked));
                }
                if let Some(ended) = self.fly(wait)? {
                    self.phase = Phase::LatePictures(ended, self.clock.now_ns() + LATE_PICTURES_NS);
                }
            }
            Phase::LatePictures(ended, until_ns) => {
                if stop || self.vehicle.is_finished() || self.clock.now_ns() >= until_ns {
                    self.vehicle.finish();
                    self.listen(Duration::ZERO)?;
                    self.phase = Phase::Emptying(ended);
                } else {
                    self.listen(wait)?;
                }
            }
            Phase::Emptying(ended) => {
                if stop || (self.ready.is_none() && self.pending.is_empty()) {
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
        self.counters.keyframes = self.selector.counters();
        self.counters.hal = self.vehicle.counters();
        self.counters
    }

    fn fly(&mut self, wait: Duration) -> Result<Option<Ended>, FlyError> {
        while let Ok((severity, text)) = self.end.words.try_recv() {
            self.vehicle.status_text(severity, &text);
        }
        let alive = self.listen(wait)?;
        let now_ns = self.clock.now_ns();
        if alive {
            self.heard_ns = Some(now_ns);
        }
        self.end.set_flags(self.vehicle.flags());
        let armed = self.vehicle.autopilot().armed;
        if self.flown && !armed {
            return Ok(Some(Ended::Landed));
        }
        self.flown |= armed;
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

    /// Takes what link and camera have; true when the aircraft showed a sign of life.
    fn listen(&mut self, wait: Duration) -> Result<bool, FlyError> {
        let (mut alive, mut wait) = (false, wait);
        for _ in 0..EVENTS_A_TURN {
            let Some(event) = self.vehicle.poll(wait)? else { break };
            wait = Duration::ZERO;
            alive |= matches!(event, Event::Pose(_) | Event::Trigger(_) | Event::Frame(_) | Event::LinkBack);
            match event {
                Event::Frame(frame) => self.choose(frame),
                Event::Unmatched(what) => {
                    self.counters.unmatched += 1;
                    tracing::warn!("{what}");
                }
                Event::LinkLost => {
                    self.counters.links_lost += 1;
                    tracing::warn!("link to the autopilot lost; waiting for it to come back");
                }
                Event::LinkBack => tracing::info!("link to the autopilot is back"),
                Event::Pose(_) | Event::Trigger(_) => {}
            }
        }
        self.hand_over();
        Ok(alive)
    }

    /// A picture is looked at before it counts: one that shows nothing must not keep its place from the next.
    fn choose(&mut self, frame: Frame) {
        let pose = Pose { rotation: frame.pose.rotation, center: frame.pose.position };
        let mut decision = self.selector.consider(&pose);
        let loaded = if decision == Decision::Key { Some(self.vehicle.load(&frame)) } else { None };
        if let Some(Err(e)) = &loaded {
            tracing::warn!("{e}");
            decision = self.selector.retract();
            self.counters.undecodable += u32::from(!matches!(e, HalError::Blank { .. }));
        }
        tracing::debug!("picture {}: {decision:?}", frame.sequence);
        self.plan.geotags.note(&frame, decision);
        match loaded {
            None | Some(Err(_)) => {}
            Some(Ok(image)) => {
                self.end.count(true);
                if self.ready.is_none() && self.pending.is_empty() {
                    self.ready = Some(self.posed(&frame, image));
                } else {
                    self.pending.push_back(frame);
                }
            }
        }
    }

    /// Decodes and hands over as much as the channel takes, without waiting.
    fn hand_over(&mut self) {
        loop {
            if self.ready.is_none() {
                let Some(frame) = self.pending.pop_front() else { return };
                self.ready = self.load_again(&frame);
            }
            let Some(ready) = self.ready.take() else { continue };
            match self.end.frames.try_send(ready) {
                Ok(()) => {}
                Err(TrySendError::Full(back)) => {
                    self.ready = Some(back);
                    return;
                }
                Err(TrySendError::Disconnected(_)) => {
                    self.pending.clear();
                    return;
                }
            }
        }
    }

    /// A key frame that had to wait: its pixels were not kept.
    fn load_again(&mut self, frame: &Frame) -> Option<PosedImage> {
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

    fn posed(&self, frame: &Frame, image: image::RgbImage) -> PosedImage {
        let lens = self.plan.intrinsics;
        let image = if image.dimensions() == (lens.width, lens.height) {
            image
        } else {
            image::imageops::resize(&image, lens.width, lens.height, image::imageops::FilterType::Triangle)
        };
        PosedImage {
            name: picture_name(&frame.picture.name(), frame.sequence),
            time_ns: frame.time_ns,
            image,
            view: View { intrinsics: lens, pose: Pose { rotation: frame.pose.rotation, center: frame.pose.position } },
            sigma: PoseSigma { position_m: frame.pose.position_sigma_m, rotation_rad: frame.pose.rotation_sigma_rad },
        }
    }
}

/// The file's own name, or the trigger's number for pictures that never were a file; always `.png`, as it is stored.
pub(super) fn picture_name(path: &Path, sequence: u32) -> String {
    match path.file_stem().and_then(|s| s.to_str()) {
        Some(stem) if path.extension().is_some() => format!("{stem}.png"),
        _ => format!("frame_{sequence:06}.png"),
    }
}
