//! Brown–Conrady lens distortion as in OpenCV, and the one way it is taken out of a picture: by the HAL as pictures come
//! in, by the data sets as they are read. Everything behind them works with a pinhole.

use serde::{Deserialize, Serialize};

/// OpenCV's radial (k) and tangential (p) coefficients on normalised coordinates.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Distortion {
    /// r² term.
    pub k1: f64,
    /// r⁴ term.
    pub k2: f64,
    /// r⁶ term.
    pub k3: f64,
    /// First tangential term.
    pub p1: f64,
    /// Second tangential term.
    pub p2: f64,
}

impl Distortion {
    /// True for a pinhole.
    pub fn is_none(&self) -> bool {
        *self == Self::default()
    }

    /// Undistorted → distorted normalised coordinates (OpenCV's `distortPoints`).
    pub fn distort(&self, x: f64, y: f64) -> (f64, f64) {
        let r2 = x * x + y * y;
        let radial = 1.0 + r2 * (self.k1 + r2 * (self.k2 + r2 * self.k3));
        (
            x * radial + 2.0 * self.p1 * x * y + self.p2 * (r2 + 2.0 * x * x),
            y * radial + self.p1 * (r2 + 2.0 * y * y) + 2.0 * self.p2 * x * y,
        )
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
#[derive(Clone, Copy, Debug)]
pub struct Lens {
    /// Focal lengths.
    pub focal: [f64; 2],
    /// Principal point; the centre of the first pixel is (0.5, 0.5).
    pub principal: [f64; 2],
    /// What the lens does to the rays.
    pub distortion: Distortion,
}

impl Lens {
    /// Row `row` of the pinhole's picture, into 3 · width bytes. Where the pinhole sees past the picture its edge is
    /// repeated: training has no mask, and a black border would be learnt as black ground.
    pub fn undistort_row(&self, picture: Pixels<'_>, row: usize, out: &mut [u8]) {
        let y = (row as f64 + 0.5 - self.principal[1]) / self.focal[1];
        for (column, pixel) in out.chunks_exact_mut(3).enumerate() {
            let x = (column as f64 + 0.5 - self.principal[0]) / self.focal[0];
            let (xd, yd) = self.distortion.distort(x, y);
            let (u, v) = (self.focal[0] * xd + self.principal[0], self.focal[1] * yd + self.principal[1]);
            pixel.copy_from_slice(&picture.bilinear(u as f32, v as f32));
        }
    }
}

#[cfg(test)]
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
}
