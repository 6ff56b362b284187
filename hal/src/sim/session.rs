//! One flight in wall-clock time: waits for somebody to listen, flies, and goes on beating until the listener had time
//! to finish. Simulators and replays alike run through here.

use std::path::Path;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use super::autopilot::Autopilot;
use super::error::SimError;
use super::faulty_link::{FaultyLink, LineFaults};
use super::photographer::{Photographer, PictureCounters};
use crate::link::{LinkAddress, Reconnecting};

/// Longest time between two looks at the link.
const TICK: Duration = Duration::from_millis(2);

/// How fast and how long.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct SessionSettings {
    /// Seconds of flight per second of wall clock; the autopilot's clocks run as fast, as in SITL.
    pub speed: f64,
    /// Take off when somebody speaks on the link, or after this many wall-clock seconds.
    pub wait_for_peer_s: f64,
    /// Stay on the ground for this long after that, wall-clock seconds: the companion learns the autopilot's clock.
    pub settle_s: f64,
    /// Go on sending for this many wall-clock seconds after the flight.
    pub linger_s: f64,
}

impl Default for SessionSettings {
    fn default() -> Self {
        Self { speed: 1.0, wait_for_peer_s: 20.0, settle_s: 3.0, linger_s: 5.0 }
    }
}

impl SessionSettings {
    /// # Errors
    /// [`SimError::Settings`] for a speed that is not positive, or times that are negative.
    pub fn check(&self) -> Result<(), SimError> {
        let wrong = |what, why: String| Err(SimError::Settings { what, why });
        if !(self.speed > 0.0 && self.speed <= 1000.0) {
            return wrong("speed", format!("{} must be above 0 and at most 1000", self.speed));
        }
        if !(self.wait_for_peer_s >= 0.0 && self.settle_s >= 0.0 && self.linger_s >= 0.0) {
            return wrong("waiting times", "must not be negative".into());
        }
        Ok(())
    }
}

/// What happened in a flight.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct SessionReport {
    /// True when every exposure was announced and every picture delivered.
    pub completed: bool,
    /// True when somebody spoke on the link before take-off.
    pub peer: bool,
    /// Exposures announced.
    pub triggers: u64,
    /// Exposures not announced, by the fault.
    pub triggers_lost: u64,
    /// Frames sent.
    pub frames_sent: u64,
    /// Frames the link would not take.
    pub frames_dropped: u64,
    /// What was done to the line.
    pub line: LineFaults,
    /// What was done with the pictures.
    pub pictures: PictureCounters,
    /// Seconds of flight flown.
    pub flight_s: f64,
}

/// Opens the simulator's end of a link and reports where the other end is (the path of a pseudo-terminal).
///
/// # Errors
/// The link's.
pub fn open(address: &LinkAddress, seed: u64, on_ready: &mut dyn FnMut(Option<&Path>)) -> Result<FaultyLink, SimError> {
    let link = Reconnecting::open(address.clone(), false)?;
    on_ready(link.link().and_then(|l| l.pty_path()));
    Ok(FaultyLink::new(link, seed))
}

/// Flies `autopilot`'s flight while `camera` delivers its pictures, until it is over or `stop` is set.
///
/// # Errors
/// A link that cannot be read or written for good, or a picture that cannot be made or stored.
pub fn fly(
    mut autopilot: Autopilot,
    mut camera: Option<Photographer>,
    settings: &SessionSettings,
    stop: &AtomicBool,
) -> Result<SessionReport, SimError> {
    settings.check()?;
    let start = Instant::now();
    let now = || start.elapsed().as_secs_f64() * settings.speed;
    let mut heard_at = None;
    while !stop.load(Ordering::Relaxed) {
        let wall_s = start.elapsed().as_secs_f64();
        if autopilot.heard() > 0 {
            heard_at.get_or_insert(wall_s);
        }
        if wall_s >= heard_at.unwrap_or(settings.wait_for_peer_s) + settings.settle_s {
            break;
        }
        autopilot.listen(&now, TICK)?;
        autopilot.advance(now())?;
    }
    let peer = heard_at.is_some();
    autopilot.take_off(now());
    let end_s = autopilot.flight().reported.end_s();
    let mut over: Option<Instant> = None;
    let mut flight_s = 0.0;
    let mut completed = false;
    while !stop.load(Ordering::Relaxed) {
        autopilot.listen(&now, TICK)?;
        let now_s = now();
        autopilot.advance(now_s)?;
        flight_s = autopilot.flight_s(now_s);
        if let Some(camera) = &mut camera {
            camera.deliver(flight_s, &autopilot.acting(now_s))?;
        }
        if flight_s >= end_s && camera.as_ref().is_none_or(Photographer::done) {
            completed = true;
            if over.get_or_insert_with(Instant::now).elapsed().as_secs_f64() >= settings.linger_s {
                break;
            }
        }
    }
    let pictures = match camera {
        Some(camera) => camera.finish(!completed)?,
        None => PictureCounters::default(),
    };
    let (triggers, triggers_lost) = autopilot.triggers();
    let counters = autopilot.counters();
    Ok(SessionReport {
        completed,
        peer,
        triggers,
        triggers_lost,
        frames_sent: counters.sent,
        frames_dropped: counters.send_failed,
        line: autopilot.line().done(),
        pictures,
        flight_s: flight_s.min(end_s),
    })
}
