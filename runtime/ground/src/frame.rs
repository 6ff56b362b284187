//! One East-North-Up frame for models that were made around different origins.
//!
//! The change of frame is a rigid motion (ENU → ECEF → ENU), computed in f64 and rounded to f32 once. Whatever turns a
//! model turns the spherical harmonics of its colours, too.

use glam::{DMat3, DQuat, DVec3};

use geometry::geodesy::{EnuFrame, Geodetic};
use models::align::similarity::Similarity;
use models::cloud::{GaussianCloud, ShTurn};
use models::formats::model::ModelHeader;

/// Models whose origins lie farther apart than this do not belong to one mission (and f32 metres would lose millimetres).
pub const MAX_APART_M: f64 = 20_000.0;

/// A motion from one frame to another: a turn, a shift, and a change of scale where that is not known.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Motion(Similarity);

impl Motion {
    /// Leaves everything where it is.
    pub const NONE: Self = Self(Similarity::IDENTITY);

    /// From coordinates around `from` to coordinates around `to`.
    pub fn between(from: Geodetic, to: Geodetic) -> Self {
        let (from, to) = (EnuFrame::new(from), EnuFrame::new(to));
        let place = |p: DVec3| to.to_enu(from.to_geodetic(p));
        let translation = place(DVec3::ZERO);
        // A long lever keeps the nanometres of the geodetic round trip out of the rotation.
        let lever = 1e5;
        let axis = |a: DVec3| (place(a * lever) - translation) / lever;
        let rotation = DQuat::from_mat3(&DMat3::from_cols(axis(DVec3::X), axis(DVec3::Y), axis(DVec3::Z)));
        Self::rigid(rotation, translation)
    }

    /// Turns about the origin, then shifts.
    pub fn rigid(rotation: DQuat, translation: DVec3) -> Self {
        Self::of(Similarity { scale: 1.0, rotation, translation })
    }

    /// Any similarity.
    pub fn of(similarity: Similarity) -> Self {
        Self(Similarity { rotation: similarity.rotation.normalize(), ..similarity })
    }

    /// The numbers it is made of, as a file keeps them: x y z w of the turn, scale, shift.
    pub fn parts(&self) -> [f64; 8] {
        let Similarity { scale, rotation: q, translation: t } = self.0;
        [q.x, q.y, q.z, q.w, scale, t.x, t.y, t.z]
    }

    /// The motion of [`Motion::parts`], bit for bit.
    pub fn of_parts([x, y, z, w, scale, a, b, c]: [f64; 8]) -> Self {
        Self(Similarity { scale, rotation: DQuat::from_xyzw(x, y, z, w), translation: DVec3::new(a, b, c) })
    }

    /// First `self`, then `after`.
    pub fn then(&self, after: &Self) -> Self {
        Self(self.0.then(&after.0))
    }

    /// Its turn, shift and scale.
    pub fn similarity(&self) -> &Similarity {
        &self.0
    }

    /// Angle of its rotation, radians.
    pub fn angle(&self) -> f64 {
        2.0 * self.0.rotation.w.abs().min(1.0).acos()
    }

    /// Moves a point.
    pub fn point(&self, p: DVec3) -> DVec3 {
        self.0.apply(p)
    }

    /// Moves positions, orientations, sizes and the directions of colours of a cloud.
    pub fn cloud(&self, cloud: &mut GaussianCloud) {
        if *self == Self::NONE {
            return;
        }
        for mean in &mut cloud.means {
            *mean = self.point(glam::Vec3::from(*mean).as_dvec3()).as_vec3().to_array();
        }
        for [w, x, y, z] in &mut cloud.rotations {
            let q = DQuat::from_xyzw(f64::from(*x), f64::from(*y), f64::from(*z), f64::from(*w));
            let r = (self.0.rotation * q).as_quat();
            [*w, *x, *y, *z] = [r.w, r.x, r.y, r.z];
        }
        if self.0.scale != 1.0 {
            let larger = self.0.scale.ln() as f32;
            cloud.log_scales.as_flattened_mut().iter_mut().for_each(|s| *s += larger);
        }
        let (turn, degree, stride) = (ShTurn::new(self.0.rotation), cloud.sh_degree, cloud.sh_stride());
        if degree > 0 {
            cloud.sh.chunks_exact_mut(stride).for_each(|sh| turn.apply(degree, sh));
        }
    }

    /// Moves everything that a model says about places besides its Gaussians.
    pub fn header(&self, header: &mut ModelHeader) {
        for (_, view) in &mut header.views {
            view.pose.center = self.point(view.pose.center);
            view.pose.rotation = (self.0.rotation * view.pose.rotation).normalize();
        }
        self.corners(&mut header.region);
    }

    /// Moves the corners of a region, which is drawn on the ground plane.
    pub fn corners(&self, region: &mut [[f64; 2]]) {
        for corner in region {
            let p = self.point(DVec3::new(corner[0], corner[1], 0.0));
            *corner = [p.x, p.y];
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const A: Geodetic = Geodetic { lat_deg: 28.0394, lon_deg: -82.6979, alt_m: -69.75 };

    #[test]
    fn a_change_of_origin_is_exact_to_a_tenth_of_a_millimetre() {
        let frame = EnuFrame::new(A);
        for far in [10.0, 300.0, 5_000.0] {
            let b = frame.to_geodetic(DVec3::new(far, -0.7 * far, 12.0));
            let motion = Motion::between(A, b);
            let other = EnuFrame::new(b);
            for p in [DVec3::ZERO, DVec3::new(150.0, -90.0, 64.0), DVec3::new(-120.5, 200.25, -3.0)] {
                let truth = other.to_enu(frame.to_geodetic(p));
                assert!((motion.point(p) - truth).length() < 1e-6);
                // Through f32, as in a cloud whose own extent is some hundred metres.
                let mut cloud = GaussianCloud::with_capacity(0, 1);
                cloud.push(p.as_vec3().to_array(), [0.0; 3], [1.0, 0.0, 0.0, 0.0], 0.0, &[0.0; 3]);
                motion.cloud(&mut cloud);
                let back = Motion::between(b, A);
                let there = glam::Vec3::from(cloud.means[0]).as_dvec3();
                assert!((there - truth).length() < 1e-4 * (far / 300.0).max(1.0), "{far} {p}");
                assert!((back.point(motion.point(p)) - p).length() < 1e-6);
            }
        }
    }

    #[test]
    fn orientation_and_views_turn_with_the_frame() {
        let b = Geodetic { lat_deg: A.lat_deg, lon_deg: A.lon_deg + 0.1, alt_m: 0.0 };
        let motion = Motion::between(A, b);
        let q = DQuat::from_euler(glam::EulerRot::XYZ, 0.3, -1.0, 2.0);
        let mut cloud = GaussianCloud::with_capacity(0, 1);
        let f = q.as_quat();
        cloud.push([0.0; 3], [0.0; 3], [f.w, f.x, f.y, f.z], 0.0, &[0.0; 3]);
        motion.cloud(&mut cloud);
        let [w, x, y, z] = cloud.rotations[0].map(f64::from);
        // A direction given in the Gaussian's own axes ends where moving two points would have put it.
        let moved = DQuat::from_xyzw(x, y, z, w) * DVec3::X;
        let truth = motion.point(q * DVec3::X) - motion.point(DVec3::ZERO);
        assert!((moved - truth).length() < 1e-6);
    }
    #[test]
    fn colours_and_sizes_go_with_a_turn_and_a_change_of_scale() {
        let motion = Motion::of(Similarity {
            scale: 2.0,
            rotation: DQuat::from_rotation_z(std::f64::consts::FRAC_PI_2),
            translation: DVec3::X,
        });
        let mut cloud = GaussianCloud::with_capacity(1, 1);
        // Red towards the east only: the third function of degree 1 is −x.
        let mut sh = [0.0f32; 12];
        sh[9] = -1.0;
        cloud.push([1.0, 0.0, 0.0], [0.0; 3], [1.0, 0.0, 0.0, 0.0], 0.0, &sh);
        motion.cloud(&mut cloud);
        assert!((glam::Vec3::from(cloud.means[0]) - glam::Vec3::new(1.0, 2.0, 0.0)).length() < 1e-6);
        assert!((cloud.log_scales[0][0] - 2.0f32.ln()).abs() < 1e-6);
        // Now towards the north: the first is −y.
        let red: Vec<f32> = cloud.sh.iter().step_by(3).copied().collect();
        assert!((red[1] + 1.0).abs() < 1e-5 && red[2].abs() < 1e-5 && red[3].abs() < 1e-5, "{red:?}");
    }
}
