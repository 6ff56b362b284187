//! Radial distortion that the given lens lacks: two terms, which is what a survey's pictures can tell of a lens that
//! nobody has calibrated. Left out, a flat block bends to a bowl in its place (James & Robson 2014): on brighton_beach by
//! 1.2° from one end of a line to the other.

use crate::camera::Pinhole;
use geometry::lens::Distortion;
use glam::{DVec2, DVec3};

/// `k1`, `k2` of [`Distortion`], in normalised coordinates: of any picture size.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub(crate) struct Radial {
    pub k1: f64,
    pub k2: f64,
}

impl Radial {
    pub fn is_none(&self) -> bool {
        *self == Self::default()
    }

    /// As the lens that pictures are undistorted by.
    pub fn distortion(&self) -> Distortion {
        Distortion { k1: self.k1, k2: self.k2, ..Distortion::default() }
    }

    /// Camera axes → pixel; only meaningful for `p.z > 0`.
    pub fn pixel(&self, camera: &Pinhole, p: DVec3) -> DVec2 {
        let n = p.truncate() / p.z;
        n * self.stretch(n.length_squared()) * camera.f + camera.c
    }

    /// Where a pinhole would have seen what is at `pixel`; the same where the polynomial has turned back.
    pub fn undistorted(&self, camera: &Pinhole, pixel: [f32; 2]) -> [f32; 2] {
        if self.is_none() {
            return pixel;
        }
        let n = (DVec2::new(pixel[0].into(), pixel[1].into()) - camera.c) / camera.f;
        match self.distortion().undistort(n.x, n.y) {
            Some((x, y)) => (DVec2::new(x, y) * camera.f + camera.c).as_vec2().to_array(),
            None => pixel,
        }
    }

    /// How much farther from the middle something at this squared distance is seen.
    pub fn stretch(&self, r2: f64) -> f64 {
        1.0 + r2 * (self.k1 + r2 * self.k2)
    }

    /// Rows of d(pixel)/d(point in camera axes).
    pub fn by_local(&self, camera: &Pinhole, p: DVec3) -> (DVec3, DVec3) {
        let z = 1.0 / p.z;
        let (x, y) = (p.x * z, p.y * z);
        let r2 = x * x + y * y;
        let (d, slope) = (self.stretch(r2), self.k1 + 2.0 * self.k2 * r2);
        // d(x·D)/dx and so on, D the stretch.
        let (xx, xy, yy) = (d + 2.0 * x * x * slope, 2.0 * x * y * slope, d + 2.0 * y * y * slope);
        let row = |f: f64, by_x: f64, by_y: f64| DVec3::new(by_x, by_y, -(by_x * x + by_y * y)) * (f * z);
        (row(camera.f.x, xx, xy), row(camera.f.y, xy, yy))
    }
}

#[cfg(test)]
#[allow(clippy::unwrap_used)] // a test may
mod tests {
    use super::*;
    use crate::camera::{Intrinsics, Pose};
    use glam::DQuat;

    const K: Intrinsics = Intrinsics { width: 640, height: 480, fx: 390.0, fy: 402.0, cx: 311.0, cy: 243.0 };
    const LENS: Radial = Radial { k1: -0.11, k2: 0.04 };

    fn camera() -> Pinhole {
        Pinhole::new(Pose { rotation: DQuat::IDENTITY, center: DVec3::ZERO }, &K, 1.0)
    }

    #[test]
    fn derivatives_are_those_of_finite_differences() {
        let h = 1e-6;
        for p in [DVec3::new(7.0, -4.0, 11.0), DVec3::new(-3.0, 9.0, 17.0), DVec3::new(0.0, 0.0, 5.0)] {
            let (u, v) = LENS.by_local(&camera(), p);
            for k in 0..3 {
                let step = DVec3::from_array(std::array::from_fn(|i| if i == k { h } else { 0.0 }));
                let d = (LENS.pixel(&camera(), p + step) - LENS.pixel(&camera(), p - step)) / (2.0 * h);
                assert!((d - DVec2::new(u[k], v[k])).length() < 1e-6, "{p} {k}: {d} {u} {v}");
            }
        }
    }

    #[test]
    fn an_undistorted_key_point_is_where_a_pinhole_sees_the_point() {
        let p = DVec3::new(6.0, -5.0, 10.0);
        let seen = LENS.pixel(&camera(), p).as_vec2().to_array();
        let back = LENS.undistorted(&camera(), seen);
        let straight = camera().pixel(p);
        assert!((DVec2::new(back[0].into(), back[1].into()) - straight).length() < 1e-3, "{back:?} {straight}");
    }
}
