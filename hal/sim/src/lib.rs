//! What stands in for reality: a ray-cast world, an aircraft that flies over it and speaks MAVLink, and the faults
//! of both. Everything follows from a seed. [`replay`] plays recordings back as a living aircraft.

pub mod aircraft;
pub mod attached;
pub mod autopilot;
pub mod axes;
mod error;
pub mod faulty_link;
pub(crate) mod messages;
pub mod photographer;
mod random;
pub mod reference;
pub mod rehearsal;
pub mod replay;
pub mod session;
pub mod survey;
pub mod track;
pub mod world;

use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::AtomicBool;

use geometry::geodesy::Geodetic;
use glam::DVec2;

pub use error::SimError;
pub use session::{SessionReport, SessionSettings};

use aircraft::{Flight, Imperfections, Leg, Manner};
use attached::highest_number;
use autopilot::{Autopilot, AutopilotSettings};
use hal::link::LinkAddress;
use photographer::{Photographer, to_jpeg, write_whole};
use reference::{Lens, flown_views};
use survey::{Route, SurveySettings, lines};
use world::{World, WorldSettings};

/// No waypoint lies further from the mission's origin, metres.
const FARTHEST: f64 = 10_000.0;

/// One simulated aircraft over one world.
#[derive(Clone, Debug)]
pub struct SimSettings {
    /// Seed of the world; aircraft of one mission share it.
    pub world_seed: u64,
    /// Seed of the flight and of the faults.
    pub seed: u64,
    /// Size and contents of the world.
    pub world: WorldSettings,
    /// Origin of the ENU frame.
    pub origin: Geodetic,
    /// The lens.
    pub lens: Lens,
    /// Corners of the region to fly, metres east and north.
    pub region: Vec<[f64; 2]>,
    /// How it is flown.
    pub survey: SurveySettings,
    /// Flown instead of a survey of the region.
    pub route: Option<Route>,
    /// What is not as it should be.
    pub imperfections: Imperfections,
    /// Ids, clocks, signing and faults; its seed and clock drift are taken from here.
    pub autopilot: AutopilotSettings,
    /// Speed and waiting.
    pub session: SessionSettings,
    /// Start of the pictures' names.
    pub prefix: String,
}

impl SimSettings {
    /// The autopilot's settings, with the seed and the drift of this aircraft.
    fn autopilot(&self) -> AutopilotSettings {
        AutopilotSettings {
            seed: self.seed,
            clock_drift_ppm: self.imperfections.clock_drift_ppm,
            ..self.autopilot.clone()
        }
    }

    /// The flight these settings lead to.
    ///
    /// # Errors
    /// [`SimError::Settings`] when region, survey or lens allow none.
    pub fn flight(&self) -> Result<Flight, SimError> {
        let wrong = |what, why: String| Err(SimError::Settings { what, why });
        let (lens, survey) = (&self.lens, &self.survey);
        if lens.width == 0 || lens.height == 0 || !(lens.fx > 0.0 && lens.fy > 0.0) {
            return wrong("lens", "width, height, fx and fy must be positive".into());
        }
        if !(survey.height_m > 0.0 && survey.height_m < 10_000.0 && survey.speed_ms > 0.1 && survey.speed_ms < 100.0) {
            return wrong("survey", "height must be 0..10000 m and speed 0.1..100 m/s".into());
        }
        if !(0.0..1.0).contains(&survey.forward_overlap) || !(0.0..1.0).contains(&survey.side_overlap) {
            return wrong("survey", "overlaps must be at least 0 and below 1".into());
        }
        let named = |legs: &[Leg], manner| {
            aircraft::fly(self.origin, legs, manner, &self.imperfections, &self.prefix, self.seed)
        };
        let whole = |flight: Flight, legs: &[Leg]| {
            let (taken, planned) = (flight.exposures.len(), legs.iter().map(Leg::pictures).sum::<usize>());
            match taken < planned {
                true => Err(SimError::Settings {
                    what: "flight",
                    why: format!(
                        "takes longer than an hour, {taken} of {planned} pictures; fly a part of it or faster"
                    ),
                }),
                false => Ok(flight),
            }
        };
        if let Some(route) = &self.route {
            let manner = Manner { speed_ms: route.speed_ms, gimbal_pitch_deg: route.gimbal_pitch_deg };
            let near = |w: &survey::Waypoint| w.position.is_finite() && w.position.length() < FARTHEST;
            let flyable = route.speed_ms > 0.1 && route.speed_ms < 100.0 && route.waypoints.iter().all(near);
            let legs = if flyable { Leg::of_route(route) } else { Vec::new() };
            let flight = named(&legs, manner).ok_or_else(|| SimError::Settings {
                what: "route",
                why: "needs waypoints within 10 km of the mission's origin and a speed of 0.1..100 m/s".into(),
            })?;
            if let Some(low) = route.waypoints.iter().map(|w| w.position.z).find(|z| *z < 0.0) {
                return wrong("route", format!("leads {:.0} m below the mission's origin, where its ground is", -low));
            }
            return whole(flight, &legs);
        }
        let region: Vec<DVec2> = self.region.iter().map(|c| DVec2::from(*c)).collect();
        let footprint = DVec2::new(f64::from(lens.width) / lens.fx, f64::from(lens.height) / lens.fy) * survey.height_m;
        let legs = Leg::of_lines(&lines(&region, footprint, survey), survey.height_m);
        let manner = Manner { speed_ms: survey.speed_ms, gimbal_pitch_deg: survey.gimbal_pitch_deg };
        let flight = named(&legs, manner).ok_or_else(|| SimError::Settings {
            what: "region",
            why: "needs at least three corners around an area".into(),
        })?;
        whole(flight, &legs)
    }
}

/// Simulates one flight on `address`: MAVLink there, pictures into `camera_dir` at their time, and, with
/// `reference_dir`, the truth as a data set with held-out views.
///
/// `on_ready` is told the path of the pseudo-terminal for `pty:` (else `None`) before anything is sent; `stop` ends
/// the simulation early and cleanly.
///
/// # Errors
/// Settings without a flight, a link or folder that cannot be used.
pub fn run(
    settings: &SimSettings,
    address: &LinkAddress,
    camera_dir: &Path,
    reference_dir: Option<&Path>,
    stop: &AtomicBool,
    on_ready: &mut dyn FnMut(Option<&Path>),
) -> Result<SessionReport, SimError> {
    settings.session.check()?;
    let flight = counted_on(settings.flight()?, camera_dir, &settings.prefix);
    let link = session::open(address, settings.seed, on_ready)?;
    let world = Arc::new(World::new(settings.world_seed, &settings.world));
    let camera = camera_over(world, &flight, &settings.lens, camera_dir, reference_dir, settings.seed)?;
    session::fly(Autopilot::new(link, flight, settings.autopilot()), Some(camera), &settings.session, stop)
}

/// The flight with the pictures' numbers going on where those of the camera's folder end, as a camera counts.
fn counted_on(mut flight: Flight, camera_dir: &Path, prefix: &str) -> Flight {
    let earlier = highest_number(camera_dir, prefix);
    if earlier > 0 {
        for (exposure, number) in flight.exposures.iter_mut().zip(earlier + 1..) {
            exposure.name = aircraft::picture_name(prefix, number);
        }
    }
    flight
}

/// A camera that renders a flight's true views of `world`.
pub(crate) fn camera_over(
    world: Arc<World>,
    flight: &Flight,
    lens: &Lens,
    camera_dir: &Path,
    reference_dir: Option<&Path>,
    seed: u64,
) -> Result<Photographer, SimError> {
    let views = flown_views(flight, lens);
    let names: Vec<String> = flight.exposures.iter().map(|e| e.name.clone()).collect();
    let origin = flight.origin;
    let images = reference_dir.map(|d| d.join("images"));
    if let Some(folder) = &images {
        std::fs::create_dir_all(folder).map_err(|source| SimError::Folder { path: folder.clone(), source })?;
    }
    let reference = reference_dir.map(Path::to_path_buf);
    let (later_world, later_views, later_names) = (Arc::clone(&world), views.clone(), names.clone());
    let picture = move |index: usize| {
        let bytes = to_jpeg(&world.render(&views[index]).0)?;
        if let Some(folder) = &images {
            write_whole(&folder.join(&names[index]), &bytes)?;
        }
        Ok(bytes)
    };
    let afterwards = move |quit: &AtomicBool| match reference {
        Some(folder) => reference::complete(&folder, &later_world, origin, &later_names, &later_views, quit),
        None => Ok(()),
    };
    Photographer::new(camera_dir, flight.exposures.clone(), seed, picture, afterwards)
}

#[cfg(test)]
pub(crate) mod companion;
#[cfg(test)]
mod tests;
