//! The flight as seen from the job: a thread that owns link and camera, picks key frames, and never waits for the
//! reconstruction.

use std::thread::JoinHandle;
use std::time::Duration;

use config::mission::KeyframeSettings;
use hal::counters::HalCounters;
use hal::time::MonotonicClock;
use hal::vehicle::{Vehicle, VehicleSettings};
use models::camera::{Intrinsics, Pose};

use super::FlyError;
use super::geotags::Geotags;
use super::handover::{Handover, handover};
use super::intake::Intake;
use crate::capture::KeyframeCounters;

/// How long one turn of the loop waits for the link.
const TURN: Duration = Duration::from_millis(20);

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
    handover: Handover,
    thread: JoinHandle<Result<(Ended, FlightCounters), FlyError>>,
}

/// What the capture thread needs to know.
pub struct FlightPlan {
    /// Link, camera, lens, mount, origin.
    pub vehicle: VehicleSettings,
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
        let (handover, end) = handover();
        let thread = std::thread::Builder::new()
            .name("capture".into())
            .spawn(move || {
                let mut intake = Intake::new(plan, vehicle, MonotonicClock::default(), end);
                loop {
                    if let Some(ended) = intake.turn(TURN)? {
                        return Ok((ended, intake.finish()));
                    }
                }
            })
            .map_err(|e| FlyError::Thread(format!("could not be started: {e}")))?;
        Ok(Self { handover, thread })
    }

    /// The job's end of it.
    pub fn handover(&self) -> &Handover {
        &self.handover
    }

    /// Ends capture and returns what it counted.
    ///
    /// # Errors
    /// The error that ended the thread.
    pub fn finish(self) -> Result<(Ended, FlightCounters), FlyError> {
        self.handover.stop();
        drop(self.handover);
        self.thread.join().map_err(|_| FlyError::Thread("ended abnormally".into()))?
    }
}
