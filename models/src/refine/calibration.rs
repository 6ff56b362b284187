//! What the given lens lacks, the same for all key frames: what a survey's pictures can tell of a lens that nobody has calibrated. Each
//! has a prior, and is freed only where the pictures tell it ([`observable`](super::Refiner)).

use glam::{DVec2, DVec3};

use super::radial::Radial;
use crate::camera::{Intrinsics, Pinhole, Pose};

/// Parameters of a lens: log focal scale, log aspect, the principal point's shift (2), and two radial terms.
pub(crate) const LENS: usize = 6;

/// Of any picture size: ratios, and lengths in focal lengths.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub(crate) struct Calibration {
    /// Natural logarithm of true over given focal length, of both on the mean.
    pub log_focal: f64,
    /// Natural logarithm of true over given fy / fx. Pixels are square, but a shutter that rolls along the flight stretches pictures: on
    /// sheffield_cross by 0.17 %, which a single focal length answers by growing 2 %, the tilts of the block with it.
    pub log_aspect: f64,
    /// True less given principal point, in focal lengths.
    pub shift: DVec2,
    /// Radial distortion.
    pub radial: Radial,
}

impl Calibration {
    fn focal(&self, k: &Intrinsics) -> DVec2 {
        let half = 0.5 * self.log_aspect;
        DVec2::new(f64::from(k.fx) * (self.log_focal - half).exp(), f64::from(k.fy) * (self.log_focal + half).exp())
    }

    fn principal(&self, k: &Intrinsics) -> DVec2 {
        DVec2::new(k.cx.into(), k.cy.into()) + self.shift * self.focal(k)
    }

    /// A camera with this lens, its radial distortion aside.
    pub fn camera(&self, pose: Pose, k: &Intrinsics) -> Pinhole {
        Pinhole { pose, f: self.focal(k), c: self.principal(k) }
    }

    /// The pinhole of it.
    pub fn intrinsics(&self, k: &Intrinsics) -> Intrinsics {
        let ([fx, fy], [cx, cy]) = (self.focal(k).as_vec2().to_array(), self.principal(k).as_vec2().to_array());
        Intrinsics { fx, fy, cx, cy, ..*k }
    }

    /// Derivatives of the pixel of a [`camera`](Self::camera) by log focal scale, log aspect, shift along x and y, `k1` and `k2`.
    pub fn by_lens(&self, camera: &Pinhole, p: DVec3) -> [DVec2; LENS] {
        let n = p.truncate() / p.z;
        let r2 = n.length_squared();
        let whole = (n * self.radial.stretch(r2) + self.shift) * camera.f;
        let bent = n * camera.f * r2;
        [
            whole,
            whole * DVec2::new(-0.5, 0.5),
            DVec2::new(camera.f.x, 0.0),
            DVec2::new(0.0, camera.f.y),
            bent,
            bent * r2,
        ]
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use glam::DQuat;

    const K: Intrinsics = Intrinsics { width: 640, height: 480, fx: 390.0, fy: 402.0, cx: 311.0, cy: 243.0 };
    const GIVEN: Calibration = Calibration {
        log_focal: 0.05,
        log_aspect: -0.02,
        shift: DVec2::new(0.01, -0.03),
        radial: Radial { k1: -0.11, k2: 0.04 },
    };

    fn pixel(lens: &Calibration, p: DVec3) -> DVec2 {
        let pose = Pose { rotation: DQuat::IDENTITY, center: DVec3::ZERO };
        lens.radial.pixel(&lens.camera(pose, &K), p)
    }

    #[test]
    fn derivatives_by_the_lens_are_those_of_finite_differences() {
        let h = 1e-6;
        let moved = |k: usize, h: f64| {
            let mut lens = GIVEN;
            match k {
                0 => lens.log_focal += h,
                1 => lens.log_aspect += h,
                2 => lens.shift.x += h,
                3 => lens.shift.y += h,
                4 => lens.radial.k1 += h,
                _ => lens.radial.k2 += h,
            }
            lens
        };
        let pose = Pose { rotation: DQuat::IDENTITY, center: DVec3::ZERO };
        for p in [DVec3::new(7.0, -4.0, 11.0), DVec3::new(-3.0, 9.0, 17.0), DVec3::new(0.0, 0.0, 5.0)] {
            for (k, d) in GIVEN.by_lens(&GIVEN.camera(pose, &K), p).into_iter().enumerate() {
                let numeric = (pixel(&moved(k, h), p) - pixel(&moved(k, -h), p)) / (2.0 * h);
                assert!((d - numeric).length() < 1e-6 * (1.0 + d.length()), "{p} {k}: {d} {numeric}");
            }
        }
    }

    #[test]
    fn a_lens_that_lacks_nothing_is_the_given_one_to_the_bit_and_another_is_its_own_pinhole() {
        assert_eq!(Calibration::default().intrinsics(&K), K);
        let k = GIVEN.intrinsics(&K);
        assert!((k.fy / k.fx - K.fy / K.fx * (-0.02f32).exp()).abs() < 1e-5);
        assert!((k.cx - K.cx - 0.01 * k.fx).abs() < 1e-3 && (k.cy - K.cy + 0.03 * k.fy).abs() < 1e-3);
    }
}
