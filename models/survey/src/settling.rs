//! The poses of a card, found by its pictures: from what they say of themselves where that is a guide, from the pictures alone where it
//! is none. What comes out is judged: by how many pictures it ties, and by what the pictures say of their places.

use std::collections::{HashMap, HashSet};
use std::ops::ControlFlow;

use config::refine::RefineSettings;
use models::camera::View;
use models::refine::{
    ControlPoint, LensPrecision, PosePrecision, PositionsReport, RefineError, RefineReport, Refiner, Untied,
};

use crate::dataset::{CardNotes, Dataset, PoseSource, Settled};

/// Rotations that the pictures contradict by more than this many standard deviations, and this many degrees, are named.
const CONTRADICTION: (f64, f64) = (5.0, 20.0);
/// Radial distortion (k1, k2) of a lens that nothing is known of: the survey cameras of the reference data have up to 0.015.
const UNKNOWN_RADIAL: f64 = 0.05;
/// Principal point of such a lens, in focal lengths.
const UNKNOWN_PRINCIPAL: f64 = 0.02;
/// How much a rolling shutter stretches pictures: 5 m/s for 30 ms are 0.15 m of some 60 m of ground, a quarter of a percent; twice that.
const ROLLING_SHUTTER: f64 = 0.005;
/// A card's pictures are matched at this many times the size, and with as many more key points, than in flight, where the time is
/// short: brighton_beach's card lies 0.80 m from its reference at 640 pixels and 0.07 m at 1,280.
const USUAL: Detail = Detail { side: 2.0, features: 2 };
/// Where few pictures hold together at the usual size: what is seen from further apart looks more alike when it is small.
const COARSE: Detail = Detail { side: 1.0, features: 2 };
/// Where pictures were taken far apart or all around and few hold together at either size: more points and smaller ones.
const FINE: Detail = Detail { side: 3.2, features: 6 };
/// Most pictures that are compared at [`FINE`]: each with each, so that the time grows with the square.
const MOST_FINE: usize = 64;
/// What `[refine]` allows of either.
const MOST_DETAIL: u32 = 8192;

impl Start {
    /// Looks after the first. Of pictures that were all compared, the second makes matches exact, the third finds more of them; in the
    /// order of capture each finds some from the places of the others (brighton_beach's 18 without GPS: 15, 17, 17 and 18 tied).
    fn looks_again(self) -> usize {
        match self {
            Self::Stated => 1,
            Self::Order => 3,
            Self::Pictures => 2,
        }
    }
}

/// Bound of an adjustment that no aircraft waits for, seconds.
const UNHURRIED_S: f64 = 600.0;
/// Share of the pictures that must hold together for no other way to be tried.
const ENOUGH: f64 = 0.95;
/// Share of tied pictures that may be turned or placed against what they say of themselves for no other way to be tried.
const CONTRADICTED: f64 = 1.0 / 3.0;

/// How closely pictures are matched, in multiples of `[refine]`.
#[derive(Clone, Copy, Debug)]
struct Detail {
    side: f32,
    features: usize,
}

/// Where the poses start from.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
enum Start {
    /// What the pictures say of themselves.
    Stated,
    /// The pictures, each compared first with those taken shortly before it; they say nothing of their places.
    Order,
    /// The pictures alone; what they say of their positions is asked once they lie right to each other.
    Pictures,
}

/// What settling a card needs of whoever asks for it.
pub struct Needs<'a, E> {
    /// A refiner without key frames.
    pub open: &'a mut dyn FnMut(&RefineSettings) -> Result<Refiner, E>,
    /// Surveyed points, marked in pictures of this share of their size.
    pub control: &'a dyn Fn(f64) -> Vec<ControlPoint>,
    /// Is told how many pictures have been taken in, and the last of them.
    pub taken: &'a mut dyn FnMut(usize, &str),
    /// True ends it.
    pub cancelled: &'a dyn Fn() -> bool,
    /// Whether there is memory for more detail than usual.
    pub fits: &'a dyn Fn(&RefineSettings) -> bool,
}

/// What the pictures of a card agree on.
#[derive(Default)]
pub struct Settlement {
    /// Lens and pose of every picture that is part of the scene, by name.
    pub settled: HashMap<String, Settled>,
    /// Those that are turned against what they say of themselves, and by how many degrees.
    pub contradicted: Vec<(String, f64)>,
    /// Those that are no part of the scene, and why.
    pub untied: Vec<(String, Untied)>,
    /// Those that could not be decoded, or not be taken.
    pub skipped: Vec<String>,
    /// How well the pose of each picture of the scene is known, in its units.
    pub precision: HashMap<String, PosePrecision>,
    /// How well the lens is known.
    pub lens: Option<LensPrecision>,
    /// The last adjustment.
    pub solved: RefineReport,
    /// Pictures whose stated positions the others contradict, of those that could be compared; nothing where none were asked.
    pub positions: Option<PositionsReport>,
    /// Positions are stated, but most of them contradict the pictures: none is believed.
    pub positions_refused: bool,
    /// Pictures whose solved places are further from their stated positions than these may be wrong, and how far, metres.
    pub places_off: Vec<(String, f64)>,
    /// How far solved heights are from stated ones in the median, and what these are stated to, metres.
    pub height_off_m: Option<(f64, f64)>,
    /// Nothing says where the scene is, which way it lies and how large it is, surveyed points aside.
    pub floats: bool,
    /// Surveyed points say it.
    pub is_fixed: bool,
}

impl Settlement {
    fn of(set: &Dataset, refiner: &Refiner, solved: RefineReport, has_attitudes: bool) -> Self {
        let untied = refiner.untied().into_iter().map(|(name, why)| (name.to_owned(), why)).collect();
        let mut found = Self { untied, solved, is_fixed: refiner.is_fixed(), ..Self::default() };
        let left_out: HashSet<&str> = found.untied.iter().map(|(name, _)| name.as_str()).collect();
        for frame in set.frames.iter().filter(|f| !left_out.contains(f.name.as_str())) {
            let name = &frame.name;
            let (Some(pose), Some(intrinsics)) = (refiner.pose(name), refiner.intrinsics(name)) else { continue };
            if let Some(prior) = frame.prior.filter(|_| has_attitudes) {
                let away = prior.pose.rotation.angle_between(pose.rotation).to_degrees();
                let sigma = f64::from(prior.sigma.rotation_rad.iter().fold(0.0f32, |a, b| a.max(*b))).to_degrees();
                if away > CONTRADICTION.1.max(CONTRADICTION.0 * sigma) {
                    found.contradicted.push((name.clone(), away));
                }
            }
            // Only a picture without a distortion of its own may have been given one.
            let distortion = if frame.distortion.is_none() { refiner.distortion() } else { frame.distortion };
            found.precision.extend(refiner.precision(name).map(|p| (name.clone(), p)));
            found.settled.insert(name.clone(), Settled { view: View { intrinsics, pose }, distortion });
        }
        found
    }

    /// Whether no other way than this one needs to be tried.
    fn suffices(&self, start: Start, all: usize) -> bool {
        let used = self.settled.len() as f64;
        let agrees = |against: usize| against as f64 <= CONTRADICTED * used;
        // Where pictures alone were the start, how they say they were turned was not asked.
        let turned = if start == Start::Stated { self.contradicted.len() } else { 0 };
        used >= ENOUGH * all as f64 && agrees(turned) && agrees(self.places_off.len())
    }

    /// Whether it is worth more than `other`: more pictures hold together and lie where they say.
    fn beats(&self, other: &Self) -> bool {
        let worth = |s: &Self| {
            let agree = s.settled.len().saturating_sub(s.places_off.len());
            (agree, s.settled.len(), usize::from(!s.positions_refused))
        };
        worth(self) > worth(other)
    }
}

/// Finds the poses of a card's pictures. From the likelier start; from the other one, and at another size, where few
/// pictures hold together. `None`
/// when asked to stop.
///
/// # Errors
/// The network fails, or `needs` does.
pub fn settle<E: From<RefineError>>(
    set: &Dataset,
    notes: &CardNotes,
    settings: &RefineSettings,
    needs: &mut Needs<'_, E>,
) -> Result<Option<Settlement>, E> {
    let known = if notes.floats { Start::Order } else { Start::Stated };
    // Positions alone are no attitude.
    let ways = match notes.floats || notes.has_attitudes {
        true => [(known, USUAL), (Start::Pictures, USUAL), (Start::Pictures, COARSE), (Start::Pictures, FINE)],
        false => [(Start::Pictures, USUAL), (known, USUAL), (Start::Pictures, COARSE), (Start::Pictures, FINE)],
    };
    let closely =
        set.frames.len() <= MOST_FINE && (needs.fits)(&of_card(set, notes, settings, (Start::Pictures, FINE)));
    let mut best: Option<Settlement> = None;
    for (start, detail) in ways.into_iter().take(if closely { 4 } else { 3 }) {
        let Some(found) = attempt(set, notes, settings, (start, detail), needs)? else { return Ok(None) };
        tracing::debug!("{start:?}, {detail:?}: {} of {} hold together", found.settled.len(), set.frames.len());
        if best.as_ref().is_none_or(|b| found.beats(b)) {
            best = Some(found);
        }
        if best.as_ref().is_some_and(|b| b.suffices(start, set.frames.len())) {
            break;
        }
    }
    Ok(best)
}

/// The settings of one way of settling a card.
fn of_card(
    set: &Dataset,
    notes: &CardNotes,
    settings: &RefineSettings,
    (start, detail): (Start, Detail),
) -> RefineSettings {
    let mut settings = settings.clone();
    settings.max_keyframes = settings.max_keyframes.max(set.frames.len());
    settings.focal_sigma = settings.focal_sigma.max(notes.focal_sigma);
    // No aircraft waits for it: what comes out must not depend on what else the machine does.
    settings.solve_seconds = settings.solve_seconds.max(UNHURRIED_S);
    if notes.distortion_unknown {
        settings.radial_sigma = settings.radial_sigma.max(UNKNOWN_RADIAL);
        settings.principal_sigma = settings.principal_sigma.max(UNKNOWN_PRINCIPAL);
    }
    settings.aspect_sigma = settings.aspect_sigma.max(ROLLING_SHUTTER);
    if start != Start::Stated {
        // Without telemetry there is nothing that could be off for all alike.
        (settings.mount_sigma_deg, settings.delay_sigma_s) = (0.0, 0.0);
    }
    settings.feature_side = ((settings.feature_side as f32 * detail.side) as u32).min(MOST_DETAIL);
    settings.max_features = (settings.max_features * detail.features).min(MOST_DETAIL as usize);
    settings
}

/// The share of their size at which pictures are matched: the network sees no more of them than this.
fn scale(set: &Dataset, settings: &RefineSettings) -> f64 {
    let longer = set.frames.iter().map(|f| f.view.intrinsics.width.max(f.view.intrinsics.height)).max().unwrap_or(1);
    (f64::from(settings.feature_side) / f64::from(longer)).min(1.0)
}

/// One way; `None` when asked to stop.
fn attempt<E: From<RefineError>>(
    set: &Dataset,
    notes: &CardNotes,
    settings: &RefineSettings,
    way: (Start, Detail),
    needs: &mut Needs<'_, E>,
) -> Result<Option<Settlement>, E> {
    let settings = of_card(set, notes, settings, way);
    let (scale, start) = (scale(set, &settings), way.0);
    let mut refiner = (needs.open)(&settings)?;
    let all: Vec<usize> = (0..set.frames.len()).collect();
    let (mut done, mut stopped, mut skipped) = (0, false, Vec::new());
    set.load_ahead(&all, scale, PoseSource::Telemetry, settings.threads, |i, picture| {
        let name = &set.frames[i].name;
        let added = picture.map_err(|e| e.to_string()).and_then(|p| {
            let taken = if start == Start::Pictures { refiner.collect(&p) } else { refiner.add(&p) };
            taken.map_err(|e| e.to_string())
        });
        if let Err(e) = added {
            tracing::warn!("{e}");
            skipped.push(name.clone());
        }
        done += 1;
        (needs.taken)(done, name);
        stopped = (needs.cancelled)();
        if stopped { ControlFlow::Break(()) } else { ControlFlow::Continue(()) }
    });
    if stopped {
        return Ok(None);
    }
    refiner.set_control((needs.control)(scale));
    let (mut positions, mut positions_refused) = (None, false);
    if start != Start::Stated {
        let placed = if start == Start::Pictures { refiner.place_all()? } else { refiner.bootstrap()? };
        if !notes.floats && placed.placed > 2 {
            positions = refiner.take_positions();
            positions_refused = positions.is_none();
        }
    }
    let has_attitudes = notes.has_attitudes && !notes.floats && !positions_refused;
    let look = |refiner: &mut Refiner| -> Result<Settlement, E> {
        let mut solved = refiner.solve()?;
        let mut lens = refiner.judge();
        if refiner.leave_out_apart() {
            solved = refiner.solve()?;
            lens = refiner.judge();
        }
        Ok(Settlement { lens, ..Settlement::of(set, refiner, solved, has_attitudes) })
    };
    let mut found = look(&mut refiner)?;
    for _ in 0..start.looks_again() {
        if (needs.cancelled)() {
            return Ok(None);
        }
        refiner.relink()?;
        let again = look(&mut refiner)?;
        // A later look knows more than those before; where it ties fewer pictures together all the same, they are believed.
        if again.settled.len() >= found.settled.len() {
            found = again;
        }
    }
    found.floats = notes.floats || positions_refused;
    if !found.floats {
        (found.height_off_m, found.places_off) = (refiner.height_off_m(), refiner.places_off());
    }
    Ok(Some(Settlement { skipped, positions, positions_refused, ..found }))
}
