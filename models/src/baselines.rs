//! What a picture of the scene costs nothing to guess: the nearest training picture laid onto flat ground, and one
//! colour everywhere. A model that does not clearly beat both has learnt nothing.

use glam::DVec3;
use rayon::prelude::*;

use crate::camera::{Pinhole, PosedImage, View};

/// Mean colour of pictures, 0…1: accumulate with [`MeanColor::add`].
#[derive(Clone, Copy, Debug, Default)]
pub struct MeanColor {
    sum: [u64; 3],
    pixels: u64,
}

impl MeanColor {
    /// Takes a picture in, without what its mask leaves out.
    pub fn add(&mut self, picture: &PosedImage) {
        for (_, _, p) in picture.image.enumerate_pixels().filter(|(x, y, _)| picture.keeps(*x, *y)) {
            for (sum, v) in self.sum.iter_mut().zip(p.0) {
                *sum += u64::from(v);
            }
            self.pixels += 1;
        }
    }

    /// The mean; mid grey before any picture.
    pub fn get(&self) -> [f32; 3] {
        match self.pixels {
            0 => [0.5; 3],
            n => self.sum.map(|s| (s as f64 / n as f64 / 255.0) as f32),
        }
    }

    /// A picture of `pixels` pixels of this colour, interleaved.
    pub fn picture(&self, pixels: usize) -> Vec<f32> {
        self.get().repeat(pixels)
    }
}

/// Number of the view whose camera is nearest to `target`'s; the first one of equals. `None` without views.
pub fn nearest_view(target: &View, views: &[View]) -> Option<usize> {
    let distance = |v: &View| v.pose.center.distance_squared(target.pose.center);
    (0..views.len()).min_by(|&a, &b| distance(&views[a]).total_cmp(&distance(&views[b])))
}

/// What `target` would see if the world were the plane z = 0 painted with `source`: interleaved RGB, 0…1. Pixels that
/// see the sky, or ground outside the source picture or that its mask leaves out, are `elsewhere`.
pub fn warp_over_ground(source: &PosedImage, target: &View, elsewhere: [f32; 3]) -> Vec<f32> {
    let (width, height) = (target.intrinsics.width as usize, target.intrinsics.height as usize);
    let mut out = vec![0.0; 3 * width * height];
    let (from, to) = (Pinhole::from(target), Pinhole::from(&source.view));
    out.par_chunks_mut(3 * width.max(1)).enumerate().for_each(|(y, row)| {
        for (x, pixel) in row.chunks_exact_mut(3).enumerate() {
            let ground = at_ground(&from, [x as f32 + 0.5, y as f32 + 0.5]);
            let color = ground.and_then(|p| sample(source, &to, p));
            pixel.copy_from_slice(&color.unwrap_or(elsewhere));
        }
    });
    out
}

/// Where a pixel's ray meets z = 0; `None` for rays that are level or point away from the ground.
fn at_ground(camera: &Pinhole, pixel: [f32; 2]) -> Option<DVec3> {
    let ray = camera.world_ray(pixel);
    let t = -camera.pose.center.z / ray.z;
    (t > 0.0 && t.is_finite()).then(|| camera.pose.center + ray * t)
}

/// Bilinear colour of the source at a place on the ground.
fn sample(source: &PosedImage, camera: &Pinhole, p: DVec3) -> Option<[f32; 3]> {
    let q = camera.project(p).filter(|q| source.view.intrinsics.contains(*q))?.as_vec2();
    source.keeps(q.x as u32, q.y as u32).then_some(())?;
    Some(crate::undistort::sample_bilinear(&source.image, q.x, q.y).0.map(|c| f32::from(c) / 255.0))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::camera::{Intrinsics, Pose, PoseSigma};
    use crate::mask::Mask;
    use glam::DQuat;
    use image::{Rgb, RgbImage};

    fn nadir(east: f64, north: f64, yaw: f64) -> View {
        let down = DQuat::from_xyzw(1.0, 0.0, 0.0, 0.0);
        View {
            intrinsics: Intrinsics { width: 40, height: 30, fx: 35.0, fy: 35.0, cx: 20.0, cy: 15.0 },
            pose: Pose { rotation: DQuat::from_rotation_z(yaw) * down, center: DVec3::new(east, north, 35.0) },
        }
    }

    /// Flat ground with a colour ramp of 4 per metre: at 35 m one pixel sees one metre.
    fn ground(view: View) -> PosedImage {
        let camera = Pinhole::from(&view);
        let image = RgbImage::from_fn(40, 30, |x, y| {
            let p = at_ground(&camera, [x as f32 + 0.5, y as f32 + 0.5]).unwrap();
            Rgb([(100.0 + 2.0 * p.x).round() as u8, (100.0 + 2.0 * p.y).round() as u8, 50])
        });
        let sigma = PoseSigma { position_m: [0.0; 3], rotation_rad: [0.0; 3] };
        PosedImage { name: "s".into(), time_ns: 0, image, view, mask: None, sigma }
    }

    #[test]
    fn flat_ground_is_predicted_exactly_where_the_source_saw_it() {
        let source = ground(nadir(0.0, 0.0, 0.0));
        for target in [nadir(4.0, 3.0, 0.0), nadir(-3.0, 2.0, 0.7)] {
            let truth = ground(target);
            let warped = warp_over_ground(&source, &target, [-1.0; 3]);
            let (mut seen, mut worst) = (0, 0.0f32);
            for (w, t) in warped.chunks_exact(3).zip(truth.image.pixels()) {
                if w[0] >= 0.0 {
                    seen += 1;
                    worst = worst.max((0..3).map(|i| (w[i] * 255.0 - f32::from(t[i])).abs()).fold(0.0, f32::max));
                }
            }
            assert!(seen > 700 && seen < 1200 && worst <= 2.0, "{seen} {worst}");
        }
    }

    #[test]
    fn the_sky_and_unseen_ground_take_the_given_colour() {
        let source = ground(nadir(0.0, 0.0, 0.0));
        let mut up = nadir(0.0, 0.0, 0.0);
        up.pose.rotation = DQuat::IDENTITY;
        let far = nadir(1e4, 0.0, 0.0);
        for view in [up, far] {
            assert!(warp_over_ground(&source, &view, [0.25; 3]).iter().all(|v| *v == 0.25));
        }
    }

    #[test]
    fn the_mean_colour_is_the_mean_over_all_pixels() {
        let mut mean = MeanColor::default();
        assert_eq!(mean.get(), [0.5; 3]);
        let of = |image| PosedImage { image, ..ground(nadir(0.0, 0.0, 0.0)) };
        mean.add(&of(RgbImage::from_pixel(1, 1, Rgb([255, 0, 0]))));
        mean.add(&of(RgbImage::from_pixel(3, 1, Rgb([0, 0, 255]))));
        assert_eq!(mean.get(), [0.25, 0.0, 0.75]);
        assert_eq!(mean.picture(2), [0.25, 0.0, 0.75, 0.25, 0.0, 0.75]);
    }

    #[test]
    fn what_a_mask_leaves_out_is_no_guess() {
        let target = nadir(4.0, 3.0, 0.0);
        let elsewhere = |source: &PosedImage| {
            warp_over_ground(source, &target, [-1.0; 3]).chunks_exact(3).filter(|p| p[0] < 0.0).count()
        };
        let whole = ground(nadir(0.0, 0.0, 0.0));
        let masked = PosedImage { mask: Some(Mask::from_fn(40, 30, |x, _| x < 20)), ..whole.clone() };
        // Four metres to the east, 16 of the 20 columns are in the picture still.
        assert!(elsewhere(&masked) >= elsewhere(&whole) + 16 * 25, "{} {}", elsewhere(&masked), elsewhere(&whole));
        let (mut all, mut west) = (MeanColor::default(), MeanColor::default());
        all.add(&whole);
        west.add(&masked);
        // The ramp rises by two of 255 a metre: half the width is 20 m.
        assert!((all.get()[0] - west.get()[0] - 20.0 / 255.0).abs() < 1e-3, "{:?} {:?}", all.get(), west.get());
        let nothing = PosedImage { mask: Some(Mask::from_fn(40, 30, |_, _| false)), ..whole };
        let mut none = MeanColor::default();
        none.add(&nothing);
        assert_eq!(none.get(), [0.5; 3]);
    }

    #[test]
    fn the_nearest_view_is_the_one_with_the_nearest_camera() {
        let views = [nadir(9.0, 0.0, 0.0), nadir(1.0, 0.0, 0.0)];
        assert_eq!(nearest_view(&nadir(0.0, 0.0, 0.0), &views), Some(1));
        assert_eq!(nearest_view(&nadir(0.0, 0.0, 0.0), &[]), None);
    }
}
