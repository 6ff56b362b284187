//! The light of pictures: cameras on auto change exposure and white balance from picture to picture, and lenses pass less of it to the
//! corners. What pictures of the same ground say of each other tells both; undone, all of them show the scene in one light.
//!
//! Values are compared as they are stored, in logarithms: under a camera's power law a factor of light is a factor of the value.

use std::collections::BTreeMap;

use image::RgbImage;
use serde::{Deserialize, Serialize};

use crate::camera::{Intrinsics, View};

mod solve;

pub use solve::{Ratio, Solved, solve};

/// Powers of the squared tangent that the fall-off towards the corners is made of: cos⁴ of 45 degrees to 1 %.
pub const FALLOFF_TERMS: usize = 3;
/// Gains outside of this are a picture of something else, or none.
const GAINS: [f32; 2] = [0.1, 10.0];
/// Pictures that say what one between them is in.
const NEIGHBOURS: usize = 4;

/// What differs between pictures of one camera, as natural logarithms: stored value = value in the common light · gain · fall-off.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Light {
    /// Of each picture that could be compared, red, green and blue.
    pub gains: BTreeMap<String, [f32; 3]>,
    /// Coefficients of t², t⁴ and t⁶, t the tangent of the angle off the optical axis.
    pub falloff: [f32; FALLOFF_TERMS],
    /// The largest t² that any picture was compared at; further out it falls no more.
    pub reach: f32,
}

impl Light {
    /// Of picture `name`; of one that could not be compared only what the lens does.
    pub fn of(&self, name: &str) -> PictureLight {
        let gain = self.gains.get(name).copied().unwrap_or_default();
        PictureLight { gain, falloff: self.falloff, reach: self.reach }
    }

    /// Log of what the lens passes at t².
    pub fn lens_at(&self, t2: f32) -> f32 {
        PictureLight { gain: [0.0; 3], falloff: self.falloff, reach: self.reach }.at(t2)[0]
    }

    /// Log of what the lens passes at the reach.
    pub fn corner(&self) -> f32 {
        self.of("").at(self.reach)[0]
    }
}

/// The light of one picture; the default is the common one.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct PictureLight {
    /// Log gain, red, green and blue.
    pub gain: [f32; 3],
    /// Log of what the lens passes: coefficients of t², t⁴ and t⁶, t the tangent of the angle off the optical axis.
    pub falloff: [f32; FALLOFF_TERMS],
    /// The largest t² for which that is known.
    pub reach: f32,
}

impl PictureLight {
    /// Whether every number of it can be worked with: it may come from another machine.
    pub fn is_usable(&self) -> bool {
        let known = |g: &f32| (GAINS[0].ln()..=GAINS[1].ln()).contains(g);
        let ends = [0.0, 0.5 * self.reach, self.reach].into_iter().flat_map(|t2| self.at(t2));
        self.reach.is_finite() && self.falloff.iter().all(|c| c.is_finite()) && ends.into_iter().all(|g| known(&g))
    }

    /// What a picture taken at `view` is likely to be in: cameras on auto change slowly, so it is the mean of those taken nearest
    /// to it, each with the weight of its nearness. `lights` are those of `views`, in their order.
    pub fn near<'a>(views: impl Iterator<Item = &'a View>, lights: &[Self], view: &View) -> Self {
        let apart = |v: &View| v.pose.center.distance_squared(view.pose.center);
        let mut near: Vec<(f64, &Self)> = views.zip(lights).map(|(v, light)| (apart(v), light)).collect();
        near.sort_by(|a, b| a.0.total_cmp(&b.0));
        near.truncate(NEIGHBOURS);
        // The farthest of them weighs half of one at the very place.
        let usual = near.last().map_or(1.0, |n| n.0).max(f64::MIN_POSITIVE);
        let (mut mean, mut sum) = (Self::default(), 0.0f32);
        for (distance, light) in near {
            let weight = (1.0 / (1.0 + distance / usual)) as f32;
            sum += weight;
            let blend = |mean: &mut f32, value: f32| *mean += (value - *mean) * weight / sum;
            mean.gain.iter_mut().zip(light.gain).for_each(|(m, v)| blend(m, v));
            mean.falloff.iter_mut().zip(light.falloff).for_each(|(m, v)| blend(m, v));
            blend(&mut mean.reach, light.reach);
        }
        mean
    }

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
    use crate::camera::Pose;

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
    fn light_from_another_machine_that_is_no_number_is_not_worked_with() {
        let good = light().of("a");
        assert!(good.is_usable() && PictureLight::default().is_usable());
        for bad in [f32::NAN, f32::INFINITY, 40.0] {
            assert!(!PictureLight { gain: [0.0, bad, 0.0], ..good }.is_usable());
            assert!(!PictureLight { falloff: [0.0, bad, 0.0], ..good }.is_usable());
        }
        assert!(!PictureLight { reach: f32::NAN, ..good }.is_usable());
    }

    #[test]
    fn a_picture_that_was_not_seen_is_expected_in_the_light_of_its_neighbours() {
        let at = |x: f64| View {
            intrinsics: LENS,
            pose: Pose { rotation: glam::DQuat::IDENTITY, center: glam::DVec3::new(x, 0.0, 0.0) },
        };
        let views: Vec<View> = (0..20).map(|i| at(f64::from(i))).collect();
        // It grows darker along the line.
        let lights: Vec<PictureLight> =
            (0..20).map(|i| PictureLight { gain: [-0.05 * i as f32; 3], ..light().of("a") }).collect();
        let near = PictureLight::near(views.iter(), &lights, &at(7.5));
        assert!((near.gain[0] + 0.375).abs() < 0.01 && (near.falloff[0] + 0.4).abs() < 1e-6, "{near:?}");
        assert!(PictureLight::near(views.iter(), &lights, &at(0.0)).gain[0] > -0.08);
        assert_eq!(PictureLight::near([].iter(), &[], &at(1.0)), PictureLight::default());
    }
}
