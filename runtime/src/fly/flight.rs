//! The flight as seen from the job: a thread that owns link and camera, picks key frames, and never waits for the
//! reconstruction. Pictures wait as paths; only as many as the channel holds are decoded ahead.

use std::collections::VecDeque;
use std::path::Path;
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};
use std::sync::mpsc::{Receiver, SyncSender, TrySendError, sync_channel};
use std::sync::{Arc, Mutex, PoisonError};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use config::mission::{CameraSettings, KeyframeSettings};
use hal::counters::HalCounters;
use hal::failsafe::Flags;
use hal::mavlink::dialect::MavSeverity;
use hal::vehicle::{Event, Frame, Vehicle, VehicleSettings};
use models::camera::{Intrinsics, Pose, PoseSigma, PosedImage, View};

use super::FlyError;
use super::geotags::Geotags;
use crate::capture::{Decision, KeyframeCounters, KeyframeSelector};

/// Decoded key frames in the channel.
const AHEAD: usize = 2;
/// How long one turn of the loop waits for the link.
const TURN: Duration = Duration::from_millis(20);
/// After the aircraft has landed, pictures may still be on their way from the camera for this long.
const LATE_PICTURES: Duration = Duration::from_secs(2);

/// When the capture is over.
#[derive(Clone, Copy, Debug)]
pub struct EndOfFlight {
    /// Silence of the link after which an aircraft that has delivered pictures is taken for landed and switched off.
    pub silence: Duration,
    /// Give up when nothing at all was heard for this long; None = wait for ever.
    pub patience: Option<Duration>,
}

/// Why capture ended.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Ended {
    /// The aircraft disarmed after having flown.
    Landed,
    /// The recording is at its end.
    RecordingOver,
    /// The link stayed silent.
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
    /// Pictures that could not be decoded.
    pub undecodable: u32,
    /// Pictures or triggers that found no partner.
    pub unmatched: u32,
    /// Times the link was lost.
    pub links_lost: u32,
    /// The HAL's own counters.
    pub hal: HalCounters,
}

/// The running capture thread.
pub struct Flight {
    frames: Receiver<PosedImage>,
    waiting: Arc<AtomicUsize>,
    stop: Arc<AtomicBool>,
    flags: Arc<Mutex<Flags>>,
    words: SyncSender<(MavSeverity, String)>,
    thread: JoinHandle<Result<(Ended, FlightCounters), FlyError>>,
}

/// What the capture thread needs to know.
pub struct FlightPlan {
    /// Link, camera, mount, origin.
    pub vehicle: VehicleSettings,
    /// The lens as calibrated.
    pub lens: CameraSettings,
    /// Lens of the pictures that are trained on (undistorted, scaled).
    pub intrinsics: Intrinsics,
    /// The key-frame rule.
    pub keyframes: KeyframeSettings,
    /// Poses of earlier key frames.
    pub earlier: Vec<Pose>,
    /// When it is over.
    pub end: EndOfFlight,
    /// Where every matched picture is noted.
    pub geotags: Geotags,
}

impl Flight {
    /// Opens link and camera and starts listening.
    ///
    /// # Errors
    /// The port or the camera cannot be opened.
    pub fn start(plan: FlightPlan) -> Result<Self, FlyError> {
        let vehicle = Vehicle::open(&plan.vehicle)?;
        let (to, frames) = sync_channel(AHEAD);
        let (words, inbox) = sync_channel(16);
        let waiting = Arc::new(AtomicUsize::new(0));
        let stop = Arc::new(AtomicBool::new(false));
        let flags = Arc::new(Mutex::new(Flags::default()));
        let shared = (waiting.clone(), stop.clone(), flags.clone());
        let thread = std::thread::Builder::new()
            .name("capture".into())
            .spawn(move || Capture::new(plan, vehicle, to, inbox, shared.0, shared.2).run(&shared.1))
            .map_err(|e| FlyError::Thread(format!("could not be started: {e}")))?;
        Ok(Self { frames, waiting, stop, flags, words, thread })
    }

    /// The next key frame if one is ready, waiting `timeout` at most.
    pub fn next(&self, timeout: Duration) -> Option<PosedImage> {
        let frame = self.frames.recv_timeout(timeout).ok()?;
        self.waiting.fetch_sub(1, Ordering::AcqRel);
        Some(frame)
    }

    /// Key frames that wait to be taken.
    pub fn waiting(&self) -> usize {
        self.waiting.load(Ordering::Acquire)
    }

    /// What the HAL saw last, for the failsafe ladder.
    pub fn flags(&self) -> Flags {
        *self.flags.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Whether capture goes on.
    pub fn is_flying(&self) -> bool {
        !self.thread.is_finished()
    }

    /// Says a line to the ground control station (STATUSTEXT); dropped when the link cannot keep up.
    pub fn say(&self, severity: MavSeverity, text: String) {
        let _ = self.words.try_send((severity, text));
    }

    /// Asks capture to end.
    pub fn stop(&self) {
        self.stop.store(true, Ordering::Relaxed);
    }

    /// Ends capture and returns what it counted.
    ///
    /// # Errors
    /// The error that ended the thread.
    pub fn finish(self) -> Result<(Ended, FlightCounters), FlyError> {
        self.stop();
        drop(self.frames);
        self.thread.join().map_err(|_| FlyError::Thread("ended abnormally".into()))?
    }
}

struct Capture {
    plan: FlightPlan,
    vehicle: Vehicle,
    selector: KeyframeSelector,
    pending: VecDeque<Frame>,
    to: SyncSender<PosedImage>,
    ready: Option<PosedImage>,
    words: Receiver<(MavSeverity, String)>,
    waiting: Arc<AtomicUsize>,
    flags: Arc<Mutex<Flags>>,
    counters: FlightCounters,
}

impl Capture {
    fn new(
        plan: FlightPlan,
        vehicle: Vehicle,
        to: SyncSender<PosedImage>,
        words: Receiver<(MavSeverity, String)>,
        waiting: Arc<AtomicUsize>,
        flags: Arc<Mutex<Flags>>,
    ) -> Self {
        let mut selector = KeyframeSelector::new(plan.keyframes);
        plan.earlier.iter().for_each(|pose| selector.restore(*pose));
        let pending = VecDeque::with_capacity(plan.keyframes.max as usize);
        let counters = FlightCounters::default();
        Self { plan, vehicle, selector, pending, to, ready: None, words, waiting, flags, counters }
    }

    fn run(mut self, stop: &AtomicBool) -> Result<(Ended, FlightCounters), FlyError> {
        let started = Instant::now();
        // When the autopilot last showed a sign of life.
        let mut heard: Option<Instant> = None;
        let mut flown = false;
        let ended = loop {
            if stop.load(Ordering::Relaxed) {
                break Ended::Asked;
            }
            while let Ok((severity, text)) = self.words.try_recv() {
                self.vehicle.status_text(severity, &text);
            }
            if self.turn()? {
                heard = Some(Instant::now());
            }
            *self.flags.lock().unwrap_or_else(PoisonError::into_inner) = self.vehicle.flags();
            let armed = self.vehicle.autopilot().armed;
            if flown && !armed {
                break Ended::Landed;
            }
            flown |= armed;
            if self.vehicle.is_finished() {
                break Ended::RecordingOver;
            }
            match heard {
                Some(at) if at.elapsed() > self.plan.end.silence => break Ended::LinkLost,
                None if self.plan.end.patience.is_some_and(|p| started.elapsed() > p) => break Ended::NeverHeard,
                _ => {}
            }
        };
        self.drain(stop)?;
        self.counters.keyframes = self.selector.counters();
        self.counters.hal = self.vehicle.counters();
        Ok((ended, self.counters))
    }

    /// One look at link and camera; true when the aircraft showed a sign of life.
    fn turn(&mut self) -> Result<bool, FlyError> {
        let event = self.vehicle.poll(TURN)?;
        let alive = matches!(event, Some(Event::Pose(_) | Event::Trigger(_) | Event::Frame(_) | Event::LinkBack));
        match event {
            Some(Event::Frame(frame)) => self.choose(frame),
            Some(Event::Unmatched(what)) => {
                self.counters.unmatched += 1;
                tracing::warn!("{what}");
            }
            Some(Event::LinkLost) => {
                self.counters.links_lost += 1;
                tracing::warn!("link to the autopilot lost; waiting for it to come back");
            }
            Some(Event::LinkBack) => tracing::info!("link to the autopilot is back"),
            Some(Event::Pose(_) | Event::Trigger(_)) | None => {}
        }
        self.hand_over();
        Ok(alive)
    }

    fn choose(&mut self, frame: Frame) {
        let pose = Pose { rotation: frame.pose.rotation, center: frame.pose.position };
        let decision = self.selector.consider(&pose);
        tracing::debug!("picture {}: {decision:?}", frame.sequence);
        self.plan.geotags.note(&frame, decision);
        if decision == Decision::Key {
            self.waiting.fetch_add(1, Ordering::AcqRel);
            self.pending.push_back(frame);
        }
    }

    /// Decodes and hands over as much as the channel takes, without waiting.
    fn hand_over(&mut self) {
        loop {
            if self.ready.is_none() {
                let Some(frame) = self.pending.pop_front() else { return };
                self.ready = self.load(frame);
            }
            let Some(ready) = self.ready.take() else { continue };
            match self.to.try_send(ready) {
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

    /// After landing: waits for late pictures, then hands over what still waits, as long as somebody takes it.
    fn drain(&mut self, stop: &AtomicBool) -> Result<(), FlyError> {
        let until = Instant::now() + LATE_PICTURES;
        while Instant::now() < until && !stop.load(Ordering::Relaxed) && !self.vehicle.is_finished() {
            self.turn()?;
        }
        while (self.ready.is_some() || !self.pending.is_empty()) && !stop.load(Ordering::Relaxed) {
            self.hand_over();
            std::thread::sleep(TURN);
        }
        Ok(())
    }

    fn load(&mut self, frame: Frame) -> Option<PosedImage> {
        match frame.picture.load(&self.plan.lens) {
            Ok(image) => Some(self.posed(frame, image)),
            Err(e) => {
                tracing::warn!("{e}; the picture is left out");
                self.counters.undecodable += 1;
                self.waiting.fetch_sub(1, Ordering::AcqRel);
                None
            }
        }
    }

    fn posed(&self, frame: Frame, image: image::RgbImage) -> PosedImage {
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
fn picture_name(path: &Path, sequence: u32) -> String {
    match path.file_stem().and_then(|s| s.to_str()) {
        Some(stem) if path.extension().is_some() => format!("{stem}.png"),
        _ => format!("frame_{sequence:06}.png"),
    }
}
