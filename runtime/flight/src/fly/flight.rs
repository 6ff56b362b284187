//! The flight as seen from the job: a thread that owns link and camera, picks key frames, and never waits for the
//! reconstruction.

use std::thread::JoinHandle;
use std::time::Duration;

use hal::time::MonotonicClock;
use hal::vehicle::Vehicle;

use super::handover::{Handover, handover};
use super::intake::{Ended, FlightCounters, FlightPlan, Intake};
use crate::error::FlightError;

/// How long one turn of the loop waits for the link.
const TURN: Duration = Duration::from_millis(20);

/// The running capture thread.
pub struct Flight {
    handover: Handover,
    thread: JoinHandle<Result<(Ended, FlightCounters), FlightError>>,
}

impl Flight {
    /// Opens link and camera and starts listening.
    ///
    /// # Errors
    /// The port or the camera cannot be opened.
    pub fn start(plan: FlightPlan) -> Result<Self, FlightError> {
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
            .map_err(|e| FlightError::Capture(format!("the capture thread could not be started: {e}")))?;
        Ok(Self { handover, thread })
    }

    /// The job's end of it.
    pub fn handover(&mut self) -> &mut Handover {
        &mut self.handover
    }

    /// Ends capture: what was not taken yet can still be, why it ended, and what it counted.
    ///
    /// # Errors
    /// The error that ended the thread.
    pub fn finish(self) -> Result<(Handover, Ended, FlightCounters), FlightError> {
        self.handover.stop();
        let crashed = |_| FlightError::Capture("the capture thread ended abnormally".into());
        let (ended, counters) = self.thread.join().map_err(crashed)??;
        Ok((self.handover, ended, counters))
    }
}
