//! The last two gates: a received file must be a model, and the model what this aircraft of this mission should have made.

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
    match touches_region(&model) {
        true => Ok(model),
        false => refuse("none of its Gaussians lies near its aircraft's region".into()),
    }
}

/// From the mission's frame to the model's own, if they belong together.
fn motion(mission: Geodetic, own: Geodetic) -> Option<Motion> {
    let motion = own.is_valid().then(|| Motion::between(mission, own))?;
    (motion.point(DVec3::ZERO).length() <= MAX_APART_M).then_some(motion)
}

/// Whether at least one Gaussian lies in the region or no farther from it than the region is long.
fn touches_region(model: &LocalModel) -> bool {
    // The mission declares it, so that no height is asked for.
    let Some(region) = Region::of(&model.header, 0.0) else { return false };
    let low = region.corners.iter().copied().fold(DVec2::INFINITY, DVec2::min);
    let high = region.corners.iter().copied().fold(DVec2::NEG_INFINITY, DVec2::max);
    let near = |mean: &[f32; 3]| region.distance(Vec3::from(*mean).as_dvec3().truncate()) <= low.distance(high);
    model.cloud.means.iter().any(near)
}

#[cfg(test)]
mod tests;
