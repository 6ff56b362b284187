//! The last two gates: a received file must be a model, and the model what this aircraft of this mission should have made.

use std::collections::HashSet;
use std::path::Path;

use config::mission::Mission;
use geometry::geodesy::Geodetic;
use glam::{DVec2, DVec3, Vec3};
use models::camera::View;
use uplink::admission::ModelRefusal;

use crate::frame::{MAX_APART_M, Motion};
use crate::region::Region;
use crate::{AggregateError, LocalModel};

/// Reads a received model and checks that it may count as `aircraft`'s. Its region is the mission's, whatever it says
/// itself: one model that claims the ground of all would cost the others theirs.
///
/// # Errors
/// Not a model, or not one of this aircraft and mission.
pub fn admit(mission: &Mission, aircraft: &str, path: &Path) -> Result<LocalModel, ModelRefusal> {
    // Without the path: it lies under a temporary name, and the same reason should read the same.
    let parse = |e: AggregateError| ModelRefusal::Parse(e.to_string().replace(&format!("{}: ", path.display()), ""));
    let refuse = |why: String| Err(ModelRefusal::Meaning(why));
    // A rounded file is a thirtieth of what it becomes: the bound holds for both.
    let unpacked = models::formats::model::unpacked_bytes(path).map_err(|e| parse(e.into()))?;
    if unpacked > mission.upload.max_model_bytes() {
        return refuse(format!("unpacked it takes {} MiB, more than upload.max_model_mib", unpacked >> 20));
    }
    let mut model = LocalModel::read(path).map_err(parse)?;
    let header = &mut model.header;
    // Models made by hand may leave out who made them.
    if !header.mission.is_empty() && header.mission != mission.name {
        return refuse(format!("it was made for mission {:?}", header.mission));
    }
    if !header.aircraft.is_empty() && header.aircraft != aircraft {
        return refuse(format!("it was made by {:?}", header.aircraft));
    }
    let own = *header.origin.get_or_insert(mission.origin);
    let Some(to_own) = motion(mission.origin, own) else {
        return refuse(format!("its origin is no place within {:.0} km of the mission's", MAX_APART_M / 1e3));
    };
    // The reader bounds them by what a picture can be; each is rendered here, so the mission's camera is the bound.
    let (views, most) = (header.views.len(), mission.keyframes.max as usize);
    if views > most {
        return refuse(format!("it has {views} views, more than the mission's keyframes.max, {most}"));
    }
    let too_large = |v: &View| v.intrinsics.width > mission.camera.width || v.intrinsics.height > mission.camera.height;
    if let Some((name, _)) = header.views.iter().find(|(_, v)| too_large(v)) {
        return refuse(format!("its view {name:?} is larger than the mission's camera"));
    }
    let Ok(known) = mission.aircraft(Some(aircraft)) else {
        return refuse("the mission does not know its aircraft".into());
    };
    header.region = mission.region(known);
    to_own.corners(&mut header.region);
    header.aircraft = aircraft.into();
    let Some(reach) = Reach::of(&model) else {
        return refuse("the mission declares no region for its aircraft".into());
    };
    let place = reach.place(&model, mission.ground.cell_m.into());
    let gaussians = model.cloud.len();
    if place.near == 0 {
        return refuse("none of its Gaussians lies near its aircraft's region".into());
    }
    if 2 * place.far > gaussians {
        return refuse(format!(
            "{} of its {gaussians} Gaussians lie farther from its aircraft's region than {FAR_LENGTHS:.0} times its length",
            place.far
        ));
    }
    if place.squares > place.most_squares {
        return refuse(format!(
            "its Gaussians are strewn over more than {} squares of ground.cell_m, the most that its aircraft's region makes likely",
            place.most_squares
        ));
    }
    // Each of them would be a square of its own.
    let is_far: Vec<bool> = model.cloud.means.iter().map(|mean| reach.is_far(mean)).collect();
    model.cloud.retain(|i| !is_far[i]);
    Ok(model)
}

/// From its aircraft's region a model shows little beyond so many times the region's length: the horizon behind what was flown over.
const FAR_LENGTHS: f64 = 20.0;
/// Squares of ground that the Gaussians of the horizon and of false matches may lie in, beyond those around the region; and one more for
/// so many Gaussians.
const STRAY_SQUARES: f64 = 256.0;
const PER_STRAY: f64 = 1000.0;

/// Where the Gaussians of a model lie beside its aircraft's region.
struct Place {
    /// No farther from it than it is long.
    near: usize,
    /// Farther than [`FAR_LENGTHS`] times that: they are left out.
    far: usize,
    /// Squares of ground with one of the others, and how many there may be: each is a job of the merge.
    squares: usize,
    most_squares: usize,
}

/// The region of a model's aircraft, and how far it reaches.
struct Reach {
    region: Region,
    low: DVec2,
    high: DVec2,
}

impl Reach {
    /// Of a model whose region the mission declares; `None` where it has none.
    fn of(model: &LocalModel) -> Option<Self> {
        // No height is asked for.
        let region = Region::of(&model.header, 0.0)?;
        let low = region.corners.iter().copied().fold(DVec2::INFINITY, DVec2::min);
        let high = region.corners.iter().copied().fold(DVec2::NEG_INFINITY, DVec2::max);
        Some(Self { region, low, high })
    }

    fn length(&self) -> f64 {
        self.low.distance(self.high)
    }

    fn distance(&self, mean: &[f32; 3]) -> f64 {
        self.region.distance(Vec3::from(*mean).as_dvec3().truncate())
    }

    /// What is no number is nowhere.
    fn is_far(&self, mean: &[f32; 3]) -> bool {
        let distance = self.distance(mean);
        distance.is_nan() || distance > FAR_LENGTHS * self.length()
    }

    fn place(&self, model: &LocalModel, cell_m: f64) -> Place {
        let around = ((self.high - self.low + 2.0 * self.length()) / cell_m).ceil() + 1.0;
        let most_squares = (around.x * around.y + STRAY_SQUARES + model.cloud.len() as f64 / PER_STRAY) as usize;
        let (mut near, mut far, mut squares) = (0, 0, HashSet::new());
        for mean in &model.cloud.means {
            near += usize::from(self.distance(mean) <= self.length());
            if self.is_far(mean) {
                far += 1;
            } else if squares.len() <= most_squares {
                // More than the bound are not counted on.
                let at = Vec3::from(*mean).as_dvec3().truncate();
                squares.insert((at / cell_m).floor().as_i64vec2());
            }
        }
        Place { near, far, squares: squares.len(), most_squares }
    }
}

/// From the mission's frame to the model's own, if they belong together.
fn motion(mission: Geodetic, own: Geodetic) -> Option<Motion> {
    let motion = own.is_valid().then(|| Motion::between(mission, own))?;
    (motion.point(DVec3::ZERO).length() <= MAX_APART_M).then_some(motion)
}

#[cfg(test)]
mod tests;
