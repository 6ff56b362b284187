//! A flight on a simulated clock: the same autopilot, line, faults and camera as `dgtr sim`, but time moves only when it is
//! told to, as fast as the machine can. Two rehearsals of a seed are the same to the last byte, on a busy machine as well.

use std::path::Path;
use std::sync::Arc;
use std::time::Duration;

use super::autopilot::Autopilot;
use super::faulty_link::FaultyLink;
use super::session::{Session, SessionReport};
use super::world::World;
use super::{SimError, SimSettings, camera_over};
use hal::link::WireLink;
use hal::time::ManualClock;
use hal::traits::Clock;

/// An aircraft whose time is moved by hand.
pub struct Rehearsal {
    session: Session<WireLink>,
    clock: Arc<ManualClock>,
}

impl Rehearsal {
    /// The aircraft of `settings` over `world`, with its pictures in `folder`; and the companion's end of its line. Its
    /// time is `clock`'s, from 0 on.
    ///
    /// # Errors
    /// Settings without a flight, a folder that cannot be used.
    pub fn new(
        settings: &SimSettings,
        world: Arc<World>,
        folder: &Path,
        clock: Arc<ManualClock>,
    ) -> Result<(Self, WireLink), SimError> {
        let flight = settings.flight()?;
        let (here, there) = WireLink::pair();
        let camera = camera_over(world, &flight, &settings.lens, folder, None, settings.seed)?.waiting_for_pictures();
        let autopilot = Autopilot::new(FaultyLink::new(here, settings.seed), flight, settings.autopilot());
        Ok((Self { session: Session::new(autopilot, Some(camera), &settings.session)?, clock }, there))
    }

    /// Says and delivers everything that is due by the clock; false when flight and lingering are over.
    ///
    /// # Errors
    /// A picture that cannot be made or stored.
    pub fn turn(&mut self) -> Result<bool, SimError> {
        let wall_s = self.clock.now_ns() as f64 * 1e-9;
        self.session.turn(&|| wall_s, Duration::ZERO)
    }

    /// What happened.
    ///
    /// # Errors
    /// As [`Session::finish`].
    pub fn finish(self) -> Result<SessionReport, SimError> {
        self.session.finish()
    }
}
