//! The light of pictures: cameras on auto change exposure and white balance from picture to picture, and lenses pass less of it to the
//! corners. What pictures of the same ground say of each other tells both; undone, all of them show the scene in one light.
//!
//! Values are compared as they are stored, in logarithms: under a camera's power law a factor of light is a factor of the value.

use std::collections::BTreeMap;

use image::RgbImage;
use serde::{Deserialize, Serialize};

use crate::camera::Intrinsics;

mod solve;

pub use solve::{Ratio, Solved, solve};

/// Powers of the squared tangent that the fall-off towards the corners is made of: cos⁴ of 45 degrees to 1 %.
pub const FALLOFF_TERMS: usize = 3;
/// Gains outside of this are a picture of something else, or none.
const GAINS: [f32; 2] = [0.1, 10.0];

/// What differs between pictures of one camera, as natural logarithms: stored value = value in the common light · gain · fall-off.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Light {
    /// Of each picture that could be compared, red, green and blue.
    pub gains: BTreeMap<String, [f32; 3]>,
    /// Coefficients of t², t⁴ and t⁶, t the tangent of the angle off the optical axis.
    pub falloff: [f32; FALLOFF_TERMS],
    /// The largest t² that any picture was compared at; further out it falls no more.
    pub reach: f32,
}

impl Light {
    /// Log gain of the channels of picture `name`: none where it could not be compared.
    pub fn gain(&self, name: &str) -> [f32; 3] {
        self.gains.get(name).copied().unwrap_or_default()
    }

    /// Log of what the lens passes at t².
    pub fn falloff_at(&self, t2: f32) -> f32 {
        let t2 = t2.min(self.reach);
        self.falloff.iter().rev().fold(0.0, |sum, c| (sum + c) * t2)
    }

    /// The gains of picture `name` and the fall-off, as a light of their own.
    pub fn of(&self, name: &str) -> PictureLight {
        PictureLight { gain: self.gain(name), falloff: self.falloff, reach: self.reach }
    }

    /// What the lens passes at each pixel of a picture: to be put upon a rendering, which knows no lens.
    pub fn lens(&self) -> PictureLight {
        PictureLight { gain: [0.0; 3], falloff: self.falloff, reach: self.reach }
    }

    /// Whether every number of it can be worked with: it may come out of a file.
    pub fn is_usable(&self) -> bool {
        let gain = |g: &f32| (GAINS[0].ln()..=GAINS[1].ln()).contains(g);
        let corner = self.falloff_at(self.reach);
        self.gains.values().flatten().all(gain) && gain(&corner) && self.falloff.iter().all(|c| c.is_finite())
    }
}

/// The light of one picture.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct PictureLight {
    gain: [f32; 3],
    falloff: [f32; FALLOFF_TERMS],
    reach: f32,
}

impl PictureLight {
    /// Log of the stored value over the value in the common light, red, green and blue, at t².
    fn at(&self, t2: f32) -> [f32; 3] {
        let t2 = t2.min(self.reach);
        let falloff = self.falloff.iter().rev().fold(0.0, |sum, c| (sum + c) * t2);
        self.gain.map(|g| g + falloff)
    }

    /// Brings a picture from the light `self` into the light `into`, in place; `lens` is of the picture's size.
    pub fn change(&self, into: &Self, image: &mut RgbImage, lens: &Intrinsics) {
        if self == into {
            return;
        }
        for (x, y, pixel) in image.enumerate_pixels_mut() {
            let t2 = off_axis([x as f32 + 0.5, y as f32 + 0.5], lens);
            let (from, to) = (self.at(t2), into.at(t2));
            for c in 0..3 {
                pixel.0[c] = (f32::from(pixel.0[c]) * (to[c] - from[c]).exp()).round().min(255.0) as u8;
            }
        }
    }

    /// Largest factor by which [`Self::change`] would change a value.
    pub fn furthest(&self, other: &Self) -> f32 {
        let reach = self.reach.max(other.reach);
        let steps = (0..=8).map(|i| reach * i as f32 / 8.0);
        let apart = steps.flat_map(|t2| {
            let (a, b) = (self.at(t2), other.at(t2));
            [0, 1, 2].map(|c| (a[c] - b[c]).abs())
        });
        apart.fold(0.0, f32::max).exp()
    }
}

/// Squared tangent of the angle between a pixel's ray and the optical axis.
pub fn off_axis([x, y]: [f32; 2], lens: &Intrinsics) -> f32 {
    ((x - lens.cx) / lens.fx).powi(2) + ((y - lens.cy) / lens.fy).powi(2)
}

#[cfg(test)]
mod tests {
    use super::*;

    const LENS: Intrinsics = Intrinsics { width: 64, height: 48, fx: 40.0, fy: 40.0, cx: 32.0, cy: 24.0 };

    fn light() -> Light {
        let gains = BTreeMap::from([("a".to_owned(), [0.3, 0.1, -0.2])]);
        Light { gains, falloff: [-0.4, 0.05, 0.0], reach: 1.0 }
    }

    #[test]
    fn what_light_does_to_a_picture_is_undone() {
        let even = RgbImage::from_fn(64, 48, |x, y| image::Rgb([60 + (x % 64) as u8, 90 + y as u8, 120]));
        let light = light();
        let mut picture = even.clone();
        PictureLight::default().change(&light.of("a"), &mut picture, &LENS);
        assert!(picture.get_pixel(32, 24).0[0] > even.get_pixel(32, 24).0[0] + 25);
        assert!(picture.get_pixel(0, 0).0[1] < even.get_pixel(0, 0).0[1] - 15, "the corner is darker");
        light.of("a").change(&PictureLight::default(), &mut picture, &LENS);
        assert!(picture.as_raw().iter().zip(even.as_raw()).all(|(a, b)| a.abs_diff(*b) <= 2));
    }

    #[test]
    fn light_out_of_a_damaged_file_is_not_worked_with() {
        assert!(light().is_usable() && Light::default().is_usable());
        for bad in [f32::NAN, f32::INFINITY, 40.0] {
            let mut broken = light();
            broken.gains.insert("b".into(), [0.0, bad, 0.0]);
            assert!(!broken.is_usable());
            assert!(!Light { falloff: [0.0, bad, 0.0], ..light() }.is_usable());
        }
    }
}
