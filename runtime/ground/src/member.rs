//! A model that takes part in an aggregation: what is known of it stays in memory, its Gaussians stay in their file and are
//! read when it is their turn. So the memory of an aggregation does not grow by what an aircraft's model holds.

use std::path::PathBuf;

use geometry::geodesy::Geodetic;
use glam::{DVec2, DVec3};
use models::cloud::GaussianCloud;
use models::formats::model::{self, ModelHeader};
use models::light::PictureLight;

use super::frame::{MAX_APART_M, Motion};
use super::{AggregateError, LocalModel};

/// Means that stand for all when the ground of a model is measured.
const SAMPLE: usize = 8192;
/// Share of them that is left out on each side: one stray Gaussian a kilometre off is not ground that was seen.
const STRAY_SHARE: usize = 50;

/// A rectangle of ground, metres east and north.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Bounds {
    /// South-western corner.
    pub low: DVec2,
    /// North-eastern corner.
    pub high: DVec2,
}

impl Bounds {
    /// Of nothing.
    pub const EMPTY: Self = Self { low: DVec2::INFINITY, high: DVec2::NEG_INFINITY };

    /// The smallest around both.
    pub fn around(self, p: DVec2) -> Self {
        Self { low: self.low.min(p), high: self.high.max(p) }
    }

    /// Its sides; zeros when it is empty.
    pub fn span(&self) -> DVec2 {
        (self.high - self.low).max(DVec2::ZERO)
    }

    /// m² that both hold.
    pub fn shared_m2(&self, other: &Self) -> f64 {
        let span = Self { low: self.low.max(other.low), high: self.high.min(other.high) }.span();
        span.x * span.y
    }
}

/// Where a cloud's ground lies, in its own frame.
#[derive(Clone, Copy, Debug)]
struct Ground {
    bounds: Bounds,
    height_m: f64,
}

impl Ground {
    fn of(cloud: &GaussianCloud) -> Self {
        let stride = cloud.len().div_ceil(SAMPLE).max(1);
        let sorted = |axis: usize| {
            let mut v: Vec<f32> =
                cloud.means.iter().step_by(stride).map(|m| m[axis]).filter(|v| v.is_finite()).collect();
            v.sort_unstable_by(f32::total_cmp);
            v
        };
        let [x, y, z] = [0, 1, 2].map(sorted);
        let at = |v: &[f32], i: usize| v.get(i).copied().map_or(0.0, f64::from);
        let last = |v: &[f32]| v.len().saturating_sub(1 + v.len() / STRAY_SHARE);
        let bounds = match x.is_empty() || y.is_empty() {
            true => Bounds::EMPTY,
            false => Bounds {
                low: DVec2::new(at(&x, x.len() / STRAY_SHARE), at(&y, y.len() / STRAY_SHARE)),
                high: DVec2::new(at(&x, last(&x)), at(&y, last(&y))),
            },
        };
        Self { bounds, height_m: at(&z, z.len() / 2) }
    }
}

/// One model of an aggregation.
#[derive(Clone, Debug)]
pub struct Member {
    /// Its file.
    pub path: PathBuf,
    /// What it says about itself, in the common frame once [`unify`] and registration have moved it.
    pub header: ModelHeader,
    /// Gaussians in the file.
    pub gaussians: usize,
    /// SH degree of the file.
    pub sh_degree: u8,
    ground: Ground,
    content: [u8; 32],
    /// Where the file's frame lies on the globe.
    origin: Option<Geodetic>,
    /// From the file's frame to the header's.
    motion: Motion,
    /// The part of it that registration said.
    correction: Option<Motion>,
    /// Log gain of its colours over the common light's.
    gain: [f32; 3],
}

impl Member {
    /// What is to be remembered of a model; its Gaussians are given back.
    pub fn of(model: LocalModel) -> Self {
        Self {
            gaussians: model.cloud.len(),
            sh_degree: model.cloud.sh_degree,
            ground: Ground::of(&model.cloud),
            content: model.content,
            origin: model.header.origin,
            motion: Motion::NONE,
            correction: None,
            gain: [0.0; 3],
            path: model.path,
            header: model.header,
        }
    }

    /// The aircraft's name, or the file's when it has none.
    pub fn name(&self) -> &str {
        match self.header.aircraft.as_str() {
            "" => self.path.file_stem().and_then(|s| s.to_str()).unwrap_or("?"),
            name => name,
        }
    }

    /// BLAKE3 of the file.
    pub fn content(&self) -> &[u8; 32] {
        &self.content
    }

    /// Whether its place and size on the globe are known.
    pub fn is_georeferenced(&self) -> bool {
        self.origin.is_some()
    }

    /// Moves it; its Gaussians follow when they are read.
    pub fn moved(&mut self, by: &Motion) {
        by.header(&mut self.header);
        self.motion = self.motion.then(by);
    }

    /// Moves it to where its neighbours have it. Regions are agreed on beforehand and stay where they are.
    pub fn corrected(&mut self, by: &Motion) {
        let region = std::mem::take(&mut self.header.region);
        self.moved(by);
        self.header.region = region;
        self.correction = Some(*by);
    }

    /// What registration moved it by.
    pub fn correction(&self) -> Option<&Motion> {
        self.correction.as_ref()
    }

    /// Log gain of its colours over the common light's.
    pub fn gain(&self) -> [f32; 3] {
        self.gain
    }

    /// Corners of the ground that it shows, in the common frame.
    pub fn corners(&self) -> [DVec3; 4] {
        let Ground { bounds: Bounds { low, high }, height_m } = self.ground;
        let corners = [low, DVec2::new(low.x, high.y), high, DVec2::new(high.x, low.y)];
        corners.map(|c| self.motion.point(c.extend(height_m)))
    }

    /// Its colours are `gain` (natural logarithm) over the common light's: that is taken out of its Gaussians when they are read, and
    /// is the light of its pictures.
    pub fn brought_into_common_light(&mut self, gain: [f32; 3]) {
        let header = &mut self.header;
        header.lights.resize(header.views.len(), PictureLight::default());
        for c in 0..3 {
            self.gain[c] += gain[c];
            header.lights.iter_mut().for_each(|light| light.gain[c] += gain[c]);
        }
    }

    /// From the frame of the file to the common one.
    pub fn motion(&self) -> &Motion {
        &self.motion
    }

    /// From the file's frame to that of another one's file, by what both say of their origins alone: the same whatever the
    /// common frame is.
    pub fn to_frame_of(&self, other: &Self) -> Motion {
        match (self.origin, other.origin) {
            (Some(own), Some(to)) if own != to => Motion::between(own, to),
            _ => Motion::NONE,
        }
    }

    /// The ground its Gaussians show, in the common frame.
    pub fn bounds(&self) -> Bounds {
        let Bounds { low, high } = self.ground.bounds;
        if low.cmpgt(high).any() {
            return Bounds::EMPTY;
        }
        self.corners().into_iter().map(|c| c.truncate()).fold(Bounds::EMPTY, Bounds::around)
    }

    /// The middle of that ground.
    pub fn middle(&self) -> DVec3 {
        let Ground { bounds: Bounds { low, high }, height_m } = self.ground;
        let middle = if low.cmple(high).all() { 0.5 * (low + high) } else { DVec2::ZERO };
        self.motion.point(middle.extend(height_m))
    }

    /// Its Gaussians in the common frame and light.
    ///
    /// # Errors
    /// The file cannot be read any more, or is another one by now.
    pub fn cloud(&self) -> Result<GaussianCloud, AggregateError> {
        let (_, mut cloud) = self.as_written()?;
        self.motion.cloud(&mut cloud);
        if self.gain != [0.0; 3] {
            cloud.multiply_colors(self.gain.map(|g| (-g).exp()));
        }
        Ok(cloud)
    }

    /// The file as it is, in its own frame.
    ///
    /// # Errors
    /// Errors of [`Member::cloud`].
    pub fn as_written(&self) -> Result<(ModelHeader, GaussianCloud), AggregateError> {
        let (header, cloud, content) = model::read_with_hash(&self.path)?;
        match content == self.content {
            true => Ok((header, cloud)),
            false => Err(AggregateError::Changed(self.path.display().to_string())),
        }
    }
}

/// Brings all models around `origin`, or around the first one's when None. Returns the common origin.
///
/// # Errors
/// Some models have an origin and others have none; or two lie too far apart.
pub fn unify(members: &mut [Member], origin: Option<Geodetic>) -> Result<Option<Geodetic>, AggregateError> {
    let Some(common) = origin.or_else(|| members.iter().find_map(|m| m.header.origin)) else { return Ok(None) };
    for member in members.iter_mut() {
        let Some(own) = member.header.origin else {
            return Err(AggregateError::NoOrigin(member.name().into()));
        };
        if own == common {
            continue;
        }
        if !own.is_valid() {
            return Err(AggregateError::NoOrigin(member.name().into()));
        }
        let motion = Motion::between(own, common);
        let apart_m = motion.point(DVec3::ZERO).length();
        if apart_m > MAX_APART_M {
            return Err(AggregateError::TooFar { name: member.name().into(), km: apart_m / 1e3 });
        }
        member.moved(&motion);
        member.header.origin = Some(common);
    }
    Ok(Some(common))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::{carpet, model, written};

    #[test]
    fn a_member_remembers_where_its_ground_is_and_reads_its_gaussians_where_they_were_moved() {
        let dir = tempfile::tempdir().expect("temp dir");
        let mut local = model("a", &[], carpet([0.0, 0.0], [40.0, 20.0], 1.0));
        local.cloud.means[0] = [9000.0, 0.5, 0.0];
        let mut member = written(dir.path(), &local);
        let bounds = member.bounds();
        assert!(bounds.span().distance(DVec2::new(40.0, 20.0)) < 3.0, "a stray counts for nothing: {bounds:?}");
        member.moved(&Motion::rigid(glam::DQuat::IDENTITY, DVec3::new(100.0, 0.0, 5.0)));
        assert!((member.bounds().low.x - bounds.low.x - 100.0).abs() < 1e-9);
        assert!((member.middle().z - 5.0).abs() < 1e-9);
        let cloud = member.cloud().expect("read");
        assert!(cloud.means.iter().zip(&local.cloud.means).all(|(m, l)| (m[0] - l[0] - 100.0).abs() < 1e-3));
    }

    #[test]
    fn a_file_that_was_exchanged_on_the_way_is_named() {
        let dir = tempfile::tempdir().expect("temp dir");
        let member = written(dir.path(), &model("a", &[], carpet([0.0, 0.0], [4.0, 4.0], 1.0)));
        written(dir.path(), &model("a", &[], carpet([0.0, 0.0], [5.0, 4.0], 1.0)));
        assert!(member.cloud().is_err_and(|e| e.to_string().contains("a.dgtr")));
    }
}
