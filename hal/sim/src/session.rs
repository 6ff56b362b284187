//! One flight in wall-clock time: waits for somebody to listen, flies, and goes on beating until the listener had time
//! to finish. Simulators and replays alike run through here.

use std::path::Path;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use super::autopilot::Autopilot;
use super::error::SimError;
use super::faulty_link::{FaultyLink, LineFaults};
use super::photographer::{Photographer, PictureCounters};
use hal::error::HalError;
use hal::link::{LinkAddress, Reconnecting};
use hal::traits::Link;

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
#[derive(Clone, Debug, Default, PartialEq)]
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
    /// The newest lines that the companion said to the ground control station.
    pub texts: Vec<String>,
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

/// One flight in the making, turn by turn, on whatever clock.
pub struct Session<L: Link<Error = HalError> = Reconnecting> {
    autopilot: Autopilot<L>,
    camera: Option<Photographer>,
    settings: SessionSettings,
    /// Wall-clock seconds of the first word of a peer, and of the flight's end.
    heard_s: Option<f64>,
    aloft: bool,
    over_s: Option<f64>,
    flight_s: f64,
    peer: bool,
}

impl<L: Link<Error = HalError>> Session<L> {
    /// An aircraft on the ground.
    ///
    /// # Errors
    /// [`SimError::Settings`].
    pub fn new(
        autopilot: Autopilot<L>,
        camera: Option<Photographer>,
        settings: &SessionSettings,
    ) -> Result<Self, SimError> {
        settings.check()?;
        let settings = *settings;
        Ok(Self { autopilot, camera, settings, heard_s: None, aloft: false, over_s: None, flight_s: 0.0, peer: false })
    }

    /// Listens for `wait` at most, then says and delivers what is due; `wall_s` is the time since the start. False when
    /// flight and lingering are over.
    ///
    /// # Errors
    /// A link that cannot be read or written for good, or a picture that cannot be made or stored.
    pub fn turn(&mut self, wall_s: &dyn Fn() -> f64, wait: Duration) -> Result<bool, SimError> {
        let speed = self.settings.speed;
        let now = || wall_s() * speed;
        if !self.aloft {
            let wall_s = wall_s();
            if self.autopilot.heard() > 0 {
                self.heard_s.get_or_insert(wall_s);
            }
            if wall_s >= self.heard_s.unwrap_or(self.settings.wait_for_peer_s) + self.settings.settle_s {
                self.peer = self.heard_s.is_some();
                self.autopilot.take_off(now());
                self.aloft = true;
            }
        }
        self.autopilot.listen(&now, wait)?;
        let now_s = now();
        self.autopilot.advance(now_s)?;
        if !self.aloft {
            return Ok(true);
        }
        self.flight_s = self.autopilot.flight_s(now_s);
        if let Some(camera) = &mut self.camera {
            camera.deliver(self.flight_s, &self.autopilot.acting(now_s))?;
        }
        let end_s = self.autopilot.flight().reported.end_s();
        if self.flight_s >= end_s && self.camera.as_ref().is_none_or(Photographer::done) {
            let wall_s = wall_s();
            if self.over_s.is_none() {
                self.autopilot.land(now_s)?;
            }
            return Ok(wall_s - *self.over_s.get_or_insert(wall_s) < self.settings.linger_s);
        }
        Ok(true)
    }

    /// Ends the session, whether the flight is over or not.
    ///
    /// # Errors
    /// What went wrong in the camera's last work.
    pub fn finish(mut self) -> Result<SessionReport, SimError> {
        let completed = self.over_s.is_some();
        let pictures = match self.camera {
            Some(camera) => camera.finish(!completed)?,
            None => PictureCounters::default(),
        };
        let (triggers, triggers_lost) = self.autopilot.triggers();
        let counters = self.autopilot.counters();
        Ok(SessionReport {
            completed,
            peer: self.peer,
            triggers,
            triggers_lost,
            frames_sent: counters.sent,
            frames_dropped: counters.send_failed,
            line: self.autopilot.line().done(),
            pictures,
            flight_s: self.flight_s.min(self.autopilot.flight().reported.end_s()),
            texts: self.autopilot.texts(),
        })
    }
}

/// Flies `autopilot`'s flight while `camera` delivers its pictures, until it is over or `stop` is set.
///
/// # Errors
/// A link that cannot be read or written for good, or a picture that cannot be made or stored.
pub fn fly(
    autopilot: Autopilot,
    camera: Option<Photographer>,
    settings: &SessionSettings,
    stop: &AtomicBool,
) -> Result<SessionReport, SimError> {
    let mut session = Session::new(autopilot, camera, settings)?;
    let start = Instant::now();
    while !stop.load(Ordering::Relaxed) && session.turn(&|| start.elapsed().as_secs_f64(), TICK)? {}
    session.finish()
}
