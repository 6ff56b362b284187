//! Lenses: perspective and fisheye, with every distortion that calibration programs write, and the one way it is taken
//! out of a picture: by the HAL as pictures come in, by the data sets as they are read. Everything behind them works with
//! a pinhole.

use serde::{Deserialize, Serialize};

/// Steps of Newton's method that [`Distortion::undistort`] takes at most; a lens that a camera can have needs four or five.
const NEWTON_STEPS: usize = 50;
/// Residual, in normalised coordinates, at which it has converged: 1e-9 pixels at a focal length of 10,000.
const CONVERGED: f64 = 1e-13;
/// Rays further off the axis than this (86.4°) are no use to a pinhole picture.
const MAX_RADIUS: f64 = 16.0;

/// Distortion of normalised coordinates (x/z, y/z). One set of terms holds every model in use; a model leaves out those
/// that it does not have:
///
/// `r_d = r · (1 + k1 r² + k2 r⁴ + k3 r⁶ + k4 r⁸) / (1 + q1 r² + q2 r⁴ + q3 r⁶)`, then tangential (p) and thin-prism (s)
/// terms as in OpenCV. A fisheye first replaces r by the angle θ = atan r (the equidistant projection), as COLMAP's
/// `OPENCV_FISHEYE`, `RADIAL_FISHEYE` and `THIN_PRISM_FISHEYE` do.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Distortion {
    /// The terms apply to the angle from the optical axis instead of its tangent.
    pub fisheye: bool,
    /// r² term.
    pub k1: f64,
    /// r⁴ term.
    pub k2: f64,
    /// r⁶ term.
    pub k3: f64,
    /// r⁸ term (Metashape, fisheyes; not OpenCV's k4).
    pub k4: f64,
    /// First tangential term.
    pub p1: f64,
    /// Second tangential term.
    pub p2: f64,
    /// r² of the denominator (OpenCV's k4).
    pub q1: f64,
    /// r⁴ of the denominator (OpenCV's k5).
    pub q2: f64,
    /// r⁶ of the denominator (OpenCV's k6).
    pub q3: f64,
    /// Thin prism along x, r².
    pub sx1: f64,
    /// Thin prism along y, r².
    pub sy1: f64,
}

impl Distortion {
    /// True for a pinhole.
    pub fn is_none(&self) -> bool {
        *self == Self::default()
    }

    /// Undistorted → distorted normalised coordinates (OpenCV's `distortPoints`, COLMAP's `ImgFromCam` before the focal
    /// length).
    pub fn distort(&self, x: f64, y: f64) -> (f64, f64) {
        let (x, y) = match self.fisheye {
            true => {
                let r = x.hypot(y);
                let shrink = if r > 1e-9 { r.atan() / r } else { 1.0 };
                (x * shrink, y * shrink)
            }
            false => (x, y),
        };
        let r2 = x * x + y * y;
        let radial = 1.0 + r2 * (self.k1 + r2 * (self.k2 + r2 * (self.k3 + r2 * self.k4)));
        let radial = match (self.q1, self.q2, self.q3) {
            (0.0, 0.0, 0.0) => radial,
            (q1, q2, q3) => radial / (1.0 + r2 * (q1 + r2 * (q2 + r2 * q3))),
        };
        (
            x * radial + 2.0 * self.p1 * x * y + self.p2 * (r2 + 2.0 * x * x) + self.sx1 * r2,
            y * radial + self.p1 * (r2 + 2.0 * y * y) + 2.0 * self.p2 * x * y + self.sy1 * r2,
        )
    }

    /// Distorted → undistorted normalised coordinates, by Newton's method; `None` where no ray in front of the camera
    /// ends up there, or only one beyond the radius at which the polynomial turns back.
    pub fn undistort(&self, xd: f64, yd: f64) -> Option<(f64, f64)> {
        if self.is_none() {
            return Some((xd, yd));
        }
        // A fisheye's angle is found first and its tangent last: on the angle Newton's method is well behaved up to 90°.
        let inner = Self { fisheye: false, ..*self };
        let (mut x, mut y) = (xd, yd);
        for _ in 0..NEWTON_STEPS {
            let (u, v) = inner.distort(x, y);
            let (du, dv) = (u - xd, v - yd);
            if du.hypot(dv) < CONVERGED * (1.0 + xd.hypot(yd)) {
                let r = x.hypot(y);
                return match self.fisheye {
                    _ if inner.fold(r) < r => None,
                    false => Some((x, y)),
                    true if r < MAX_RADIUS.atan() => {
                        let stretch = if r > 1e-9 { r.tan() / r } else { 1.0 };
                        Some((x * stretch, y * stretch))
                    }
                    true => None,
                };
            }
            let h = 1e-7 * (1.0 + x.hypot(y));
            let (right, left) = (inner.distort(x + h, y), inner.distort(x - h, y));
            let (below, above) = (inner.distort(x, y + h), inner.distort(x, y - h));
            let [a, b] = [(right.0 - left.0) / (2.0 * h), (below.0 - above.0) / (2.0 * h)];
            let [c, d] = [(right.1 - left.1) / (2.0 * h), (below.1 - above.1) / (2.0 * h)];
            let determinant = a * d - b * c;
            if determinant.abs() < 1e-12 {
                return None;
            }
            x -= (d * du - b * dv) / determinant;
            y -= (a * dv - c * du) / determinant;
            if !(x.is_finite() && y.is_finite()) {
                return None;
            }
        }
        None
    }

    /// Radius (for a fisheye: angle) below `within` at which the radial polynomial turns back, so that what lies further
    /// out would be drawn a second time, mirrored; infinite for most lenses.
    fn fold(&self, within: f64) -> f64 {
        const SAMPLES: u32 = 64;
        // The slope is 1 + 3 k₁r² + 5 k₂r⁴ + …; where even all of the terms together do not undo the 1 there is nothing to look for.
        let r2 = within * within;
        let terms = r2
            * (3.0 * self.k1.abs()
                + r2 * (5.0 * self.k2.abs() + r2 * (7.0 * self.k3.abs() + r2 * 9.0 * self.k4.abs())));
        if terms < 1.0 && [self.q1, self.q2, self.q3] == [0.0; 3] {
            return f64::INFINITY;
        }
        let radial = Self { fisheye: false, p1: 0.0, p2: 0.0, sx1: 0.0, sy1: 0.0, ..*self };
        let at = |i: u32| within * f64::from(i) / f64::from(SAMPLES);
        let image = |i| radial.distort(at(i), 0.0).0;
        (0..SAMPLES).find(|&i| image(i + 1) <= image(i)).map_or(f64::INFINITY, at)
    }
}

/// Rows of 8-bit RGB, without padding.
#[derive(Clone, Copy, Debug)]
pub struct Pixels<'a> {
    /// 3 · width · height bytes.
    pub rgb: &'a [u8],
    /// Pixels per row, at least one.
    pub width: usize,
    /// Rows, at least one.
    pub height: usize,
}

impl Pixels<'_> {
    /// Bilinear colour at a pixel position, (0.5, 0.5) being the centre of the first pixel; positions outside take the
    /// nearest pixel of the edge.
    pub fn bilinear(&self, u: f32, v: f32) -> [u8; 3] {
        let u = (u - 0.5).clamp(0.0, (self.width - 1) as f32);
        let v = (v - 0.5).clamp(0.0, (self.height - 1) as f32);
        let (x, y) = (u as usize, v as usize);
        let (across, down) = (u - x as f32, v - y as f32);
        let (x1, y1) = ((x + 1).min(self.width - 1), (y + 1).min(self.height - 1));
        std::array::from_fn(|c| {
            let at = |x: usize, y: usize| f32::from(self.rgb[3 * (y * self.width + x) + c]);
            let top = at(x, y) + (at(x1, y) - at(x, y)) * across;
            let bottom = at(x, y1) + (at(x1, y1) - at(x, y1)) * across;
            (top + (bottom - top) * down).round() as u8
        })
    }
}

/// A lens whose pinhole keeps its focal lengths and principal point, pixels.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Lens {
    /// Focal lengths.
    pub focal: [f64; 2],
    /// Principal point; the centre of the first pixel is (0.5, 0.5).
    pub principal: [f64; 2],
    /// What the lens does to the rays.
    pub distortion: Distortion,
}

impl Lens {
    /// Pixel at which a point in camera axes (x right, y down, z forward) is seen; `None` behind the camera.
    pub fn project(&self, [x, y, z]: [f64; 3]) -> Option<[f64; 2]> {
        if z <= 0.0 || z.is_nan() {
            return None;
        }
        let (u, v) = self.distortion.distort(x / z, y / z);
        Some([self.focal[0] * u + self.principal[0], self.focal[1] * v + self.principal[1]])
    }

    /// Ray (x, y at z = 1) that is seen at a pixel; `None` where the lens sees nothing that a pinhole could.
    pub fn unproject(&self, [u, v]: [f64; 2]) -> Option<[f64; 2]> {
        let (x, y) = ((u - self.principal[0]) / self.focal[0], (v - self.principal[1]) / self.focal[1]);
        self.distortion.undistort(x, y).map(|(x, y)| [x, y])
    }

    /// Row `row` of the pinhole's picture, into 3 · width bytes. Where the pinhole sees past the picture, or past
    /// the radius at which the polynomial turns back, the edge is repeated: a black border would be learnt as black ground.
    pub fn undistort_row(&self, picture: Pixels<'_>, row: usize, out: &mut [u8]) {
        let y = (row as f64 + 0.5 - self.principal[1]) / self.focal[1];
        let across = |column: f64| (column - self.principal[0]) / self.focal[0];
        let reach = across(0.0).abs().max(across((out.len() / 3) as f64).abs()).hypot(y);
        let fold = match self.distortion.fisheye {
            true => self.distortion.fold(reach.atan()).min(MAX_RADIUS.atan()).tan(),
            false => self.distortion.fold(reach),
        };
        for (column, pixel) in out.chunks_exact_mut(3).enumerate() {
            let x = across(column as f64 + 0.5);
            let inward = if fold < reach { (fold / x.hypot(y)).min(1.0) } else { 1.0 };
            let (xd, yd) = self.distortion.distort(x * inward, y * inward);
            let (u, v) = (self.focal[0] * xd + self.principal[0], self.focal[1] * yd + self.principal[1]);
            pixel.copy_from_slice(&picture.bilinear(u as f32, v as f32));
        }
    }
}

#[cfg(test)]
#[allow(clippy::unwrap_used)] // a test may
mod tests {
    use super::*;

    const SIDE: usize = 101;

    fn undistorted(rgb: &[u8], k1: f64) -> Vec<u8> {
        let distortion = Distortion { k1, ..Distortion::default() };
        let lens = Lens { focal: [80.0; 2], principal: [50.5; 2], distortion };
        let mut out = vec![0; rgb.len()];
        for (row, line) in out.chunks_exact_mut(3 * SIDE).enumerate() {
            lens.undistort_row(Pixels { rgb, width: SIDE, height: SIDE }, row, line);
        }
        out
    }

    fn picture(of: impl Fn(usize, usize) -> [u8; 3]) -> Vec<u8> {
        (0..SIDE * SIDE).flat_map(|i| of(i % SIDE, i / SIDE)).collect()
    }

    fn at(rgb: &[u8], x: usize, y: usize) -> [u8; 3] {
        let i = 3 * (y * SIDE + x);
        [rgb[i], rgb[i + 1], rgb[i + 2]]
    }

    #[test]
    fn a_weak_lens_never_turns_back_and_a_strong_one_does_where_its_slope_is_zero() {
        // 1 + 3 k₁r² is zero at r = 1 / √(−3 k₁).
        for k1 in [-0.3f64, -0.9] {
            let lens = Distortion { k1, ..Distortion::default() };
            let turns = (-3.0 * k1).sqrt().recip();
            assert_eq!(lens.fold(0.99 * turns), f64::INFINITY, "{k1}");
            assert!((lens.fold(1.5 * turns) / turns - 1.0).abs() < 0.03, "{k1}");
        }
        // A later term makes good again what an earlier one undoes, before or after the slope is zero.
        let turns_back = |k2: f64| Distortion { k1: -0.5, k2, ..Distortion::default() }.fold(1.5).is_finite();
        assert!(turns_back(0.05) && !turns_back(0.2));
    }

    #[test]
    fn a_point_seen_through_barrel_distortion_returns_to_where_a_pinhole_sees_it() {
        // A pinhole sees it 40 pixels right of the centre: x = 0.5, distorted x = 0.5 (1 − 0.2 · 0.25) = 0.475, 38 pixels.
        let out = undistorted(&picture(|x, y| if (x, y) == (50 + 38, 50) { [255; 3] } else { [0; 3] }), -0.2);
        assert_eq!((at(&out, 50 + 40, 50), at(&out, 50 + 38, 50)), ([255; 3], [0; 3]));
    }

    #[test]
    fn where_the_lens_saw_nothing_the_edge_is_repeated_and_nothing_is_black() {
        // Pincushion: the pinhole's corners lie outside of the picture.
        let out = undistorted(&picture(|x, _| [if x < 50 { 80 } else { 160 }, 90, 100]), 0.3);
        assert_eq!((at(&out, 0, 0), at(&out, 100, 100)), ([80, 90, 100], [160, 90, 100]));
        assert!(out.chunks_exact(3).all(|p| p[0] >= 80 && p[1] == 90 && p[2] == 100));
    }

    #[test]
    fn without_distortion_the_picture_stays_as_it_is() {
        let image = picture(|x, y| [x as u8, y as u8, 7]);
        assert_eq!(undistorted(&image, 0.0), image);
        assert_eq!(undistorted(&image, 1e-9), image);
    }

    /// Lenses of every kind, with coefficients as calibrations of real cameras have them.
    fn lenses() -> Vec<(&'static str, Distortion)> {
        let d = Distortion::default();
        let fisheye = Distortion { fisheye: true, ..d };
        vec![
            ("pinhole", d),
            ("SIMPLE_RADIAL", Distortion { k1: -0.12, ..d }),
            ("RADIAL", Distortion { k1: -0.0153, k2: 0.0147, ..d }),
            ("OPENCV", Distortion { k1: -0.27, k2: 0.11, p1: 4e-4, p2: -3e-4, ..d }),
            (
                "FULL_OPENCV",
                Distortion { k1: 0.3, k2: -0.02, k3: 0.01, p1: 1e-4, p2: 2e-4, q1: 0.5, q2: 0.05, q3: 0.002, ..d },
            ),
            ("Brown of Metashape", Distortion { k1: -0.1, k2: 0.06, k3: -0.02, k4: 0.004, p1: 2e-4, p2: 1e-4, ..d }),
            ("SIMPLE_RADIAL_FISHEYE", Distortion { k1: 0.02, ..fisheye }),
            ("RADIAL_FISHEYE", Distortion { k1: 0.02, k2: -0.004, ..fisheye }),
            ("OPENCV_FISHEYE", Distortion { k1: -0.03, k2: 0.006, k3: -0.004, k4: 7e-4, ..fisheye }),
            (
                "THIN_PRISM_FISHEYE",
                Distortion {
                    k1: -0.03,
                    k2: 6e-3,
                    k3: -4e-3,
                    k4: 7e-4,
                    p1: 1e-4,
                    p2: -2e-4,
                    sx1: 3e-4,
                    sy1: -1e-4,
                    ..fisheye
                },
            ),
        ]
    }

    #[test]
    fn every_lens_returns_the_ray_that_it_projected() {
        for (name, distortion) in lenses() {
            let lens = Lens { focal: [951.0, 949.0], principal: [800.5, 449.0], distortion };
            for i in 0..41 {
                for j in 0..41 {
                    let ray = [(f64::from(i) - 20.0) / 20.0 * 0.85, (f64::from(j) - 20.0) / 20.0 * 0.6];
                    let pixel = lens.project([7.0 * ray[0], 7.0 * ray[1], 7.0]).unwrap();
                    let back = lens.unproject(pixel).unwrap();
                    let off = (back[0] - ray[0]).hypot(back[1] - ray[1]);
                    assert!(off < 1e-11, "{name} {ray:?}: {off:e}");
                }
            }
            assert_eq!(lens.project([0.0, 0.0, -1.0]), None, "{name}");
        }
    }

    #[test]
    fn a_fisheye_returns_rays_up_to_80_degrees_off_its_axis() {
        for (name, distortion) in lenses().into_iter().filter(|l| l.1.fisheye) {
            for degrees in [1.0f64, 30.0, 60.0, 80.0] {
                let r = degrees.to_radians().tan();
                let (u, v) = distortion.distort(0.6 * r, 0.8 * r);
                let (x, y) = distortion.undistort(u, v).unwrap();
                assert!((x - 0.6 * r).hypot(y - 0.8 * r) < 1e-9 * (1.0 + r * r), "{name} {degrees}");
            }
        }
    }

    /// COLMAP's own formulas (`src/colmap/sensor/models.h`), written out model by model as they stand there.
    #[test]
    fn projections_are_colmaps() {
        let (u, v) = (0.31f64, -0.22f64);
        let r = u.hypot(v);
        let (k1, k2, p1, p2) = (-0.11, 0.05, 3e-4, -2e-4);
        let r2 = u * u + v * v;
        // OpenCVCameraModel::Distortion returns what is added.
        let radial = k1 * r2 + k2 * r2 * r2;
        let opencv = (
            u + u * radial + 2.0 * p1 * u * v + p2 * (r2 + 2.0 * u * u),
            v + v * radial + 2.0 * p2 * u * v + p1 * (r2 + 2.0 * v * v),
        );
        let close = |a: (f64, f64), b: (f64, f64), name: &str| {
            assert!((a.0 - b.0).hypot(a.1 - b.1) < 1e-15, "{name}: {a:?} {b:?}");
        };
        close(Distortion { k1, k2, p1, p2, ..Default::default() }.distort(u, v), opencv, "OPENCV");
        let (k3, k4, k5, k6) = (0.01, 0.4, 0.03, 0.002);
        let radial =
            (1.0 + k1 * r2 + k2 * r2.powi(2) + k3 * r2.powi(3)) / (1.0 + k4 * r2 + k5 * r2.powi(2) + k6 * r2.powi(3));
        let full = (
            u * radial + 2.0 * p1 * u * v + p2 * (r2 + 2.0 * u * u),
            v * radial + 2.0 * p2 * u * v + p1 * (r2 + 2.0 * v * v),
        );
        let d = Distortion { k1, k2, k3, p1, p2, q1: k4, q2: k5, q3: k6, ..Default::default() };
        close(d.distort(u, v), full, "FULL_OPENCV");
        let theta = r.atan();
        let (t2, c) = (theta * theta, [0.02, -0.005, 0.001, -2e-4]);
        let thetad = theta * (1.0 + c[0] * t2 + c[1] * t2.powi(2) + c[2] * t2.powi(3) + c[3] * t2.powi(4));
        let fisheye = Distortion { fisheye: true, k1: c[0], k2: c[1], k3: c[2], k4: c[3], ..Default::default() };
        close(fisheye.distort(u, v), (u * thetad / r, v * thetad / r), "OPENCV_FISHEYE");
        let (uu, vv, sx1, sy1) = (theta * u / r, theta * v / r, 2e-4, -3e-4);
        let radial = c[0] * t2 + c[1] * t2.powi(2) + c[2] * t2.powi(3) + c[3] * t2.powi(4);
        let prism = (
            uu + uu * radial + 2.0 * p1 * uu * vv + p2 * (t2 + 2.0 * uu * uu) + sx1 * t2,
            vv + vv * radial + 2.0 * p2 * uu * vv + p1 * (t2 + 2.0 * vv * vv) + sy1 * t2,
        );
        close(Distortion { p1, p2, sx1, sy1, ..fisheye }.distort(u, v), prism, "THIN_PRISM_FISHEYE");
    }

    #[test]
    fn beyond_the_radius_at_which_a_polynomial_turns_back_there_is_no_ray() {
        // r (1 − 0.4 r²) is largest at r = 0.913.
        let lens = Distortion { k1: -0.4, ..Default::default() };
        assert!((lens.fold(2.0) - 0.913).abs() < 0.04, "{}", lens.fold(2.0));
        assert!(lens.undistort(0.6, 0.0).is_some());
        assert_eq!(lens.undistort(0.7, 0.0), None);
        assert_eq!(Distortion { k1: 0.2, ..Default::default() }.fold(16.0), f64::INFINITY);
    }
}
