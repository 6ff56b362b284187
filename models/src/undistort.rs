//! Brown–Conrady lens distortion, removed once when a picture comes in, so that everything behind it works with
//! a pinhole.

use image::{Rgb, RgbImage};
use serde::{Deserialize, Serialize};

use crate::camera::Intrinsics;

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

/// The same picture seen through a pinhole with the same intrinsics, bilinearly sampled; the border of the source
/// is repeated where the pinhole sees past it.
pub fn undistort(image: &RgbImage, k: &Intrinsics, distortion: &Distortion) -> RgbImage {
    let (fx, fy, cx, cy) = (f64::from(k.fx), f64::from(k.fy), f64::from(k.cx), f64::from(k.cy));
    RgbImage::from_fn(image.width(), image.height(), |u, v| {
        let x = (f64::from(u) + 0.5 - cx) / fx;
        let y = (f64::from(v) + 0.5 - cy) / fy;
        let (xd, yd) = distortion.distort(x, y);
        sample_bilinear(image, (fx * xd + cx) as f32, (fy * yd + cy) as f32)
    })
}

/// Colour at a pixel position (centres at .5); positions outside take the nearest border pixel.
pub fn sample_bilinear(image: &RgbImage, x: f32, y: f32) -> Rgb<u8> {
    let (w, h) = (image.width(), image.height());
    let fx = (x - 0.5).clamp(0.0, w.saturating_sub(1) as f32);
    let fy = (y - 0.5).clamp(0.0, h.saturating_sub(1) as f32);
    let (x0, y0) = (fx as u32, fy as u32);
    let (x1, y1) = ((x0 + 1).min(w - 1), (y0 + 1).min(h - 1));
    let (ax, ay) = (fx - x0 as f32, fy - y0 as f32);
    let (a, b, c, d) =
        (image.get_pixel(x0, y0), image.get_pixel(x1, y0), image.get_pixel(x0, y1), image.get_pixel(x1, y1));
    let mut out = [0; 3];
    for (i, o) in out.iter_mut().enumerate() {
        let top = f32::from(a[i]) * (1.0 - ax) + f32::from(b[i]) * ax;
        let bottom = f32::from(c[i]) * (1.0 - ax) + f32::from(d[i]) * ax;
        *o = (top * (1.0 - ay) + bottom * ay).round() as u8;
    }
    Rgb(out)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn no_distortion_leaves_the_picture_as_it_is() {
        let image = RgbImage::from_fn(17, 9, |x, y| Rgb([x as u8 * 9, y as u8 * 20, 7]));
        let k = Intrinsics { width: 17, height: 9, fx: 12.0, fy: 12.5, cx: 8.0, cy: 4.5 };
        assert_eq!(undistort(&image, &k, &Distortion::default()), image);
    }

    #[test]
    fn barrel_distortion_is_taken_out() {
        // A point drawn where the lens shows it must come back to where the pinhole sees it.
        let k = Intrinsics { width: 101, height: 101, fx: 60.0, fy: 60.0, cx: 50.5, cy: 50.5 };
        let lens = Distortion { k1: -0.2, ..Default::default() };
        let (xd, yd) = lens.distort(0.5, 0.25);
        let mut image = RgbImage::new(101, 101);
        for dy in -2..=2 {
            for dx in -2..=2 {
                image.put_pixel(
                    (60.0 * xd + 50.0).round() as u32 + 2 - (dx + 2) as u32 + 2,
                    (60.0 * yd + 50.0).round() as u32 + 2 - (dy + 2) as u32 + 2,
                    Rgb([255; 3]),
                );
            }
        }
        let out = undistort(&image, &k, &lens);
        assert_eq!(out.get_pixel(80, 65)[0], 255);
        assert_eq!(out.get_pixel(74, 62)[0], 0);
    }
}
