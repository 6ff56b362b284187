//! A seeded scene of any number of Gaussians under a camera of any size: the same on every machine, and shaped like what
//! the product sees — a ground with relief from 40 m up, covered once by Gaussians that overlap their neighbours.

use glam::{DQuat, DVec3};
use image::{Rgb, RgbImage};
use models::camera::{Intrinsics, Pose, PoseSigma, PosedImage, View};
use models::cloud::{GaussianCloud, SH_C0};

/// Height of the cameras, metres.
const HEIGHT_M: f64 = 40.0;
/// Relief of the ground, metres up and down.
const RELIEF_M: f32 = 3.0;
/// The ground is larger than the picture by this on every side, so that some Gaussians are out of view.
const MARGIN: f32 = 1.15;
/// Share of the Gaussians that [`view`] sees, but for those at its edges.
pub const IN_VIEW: f64 = 1.0 / (MARGIN as f64 * MARGIN as f64);
/// Standard deviation of a Gaussian in distances to its neighbour.
const OVERLAP: f32 = 0.6;

/// A small generator, so that the scene depends on the seed and on nothing else (PCG, as in the shaders).
#[derive(Clone, Debug)]
struct Dice(u32);

impl Dice {
    fn next(&mut self) -> f32 {
        self.0 = self.0.wrapping_mul(747_796_405).wrapping_add(2_891_336_453);
        let word = ((self.0 >> ((self.0 >> 28) + 4)) ^ self.0).wrapping_mul(277_803_737);
        ((word >> 22) ^ word) as f32 / 4_294_967_296.0
    }

    fn within(&mut self, low: f32, high: f32) -> f32 {
        low + (high - low) * self.next()
    }
}

/// A camera that looks straight down, `shift` of the picture's width east of the middle.
pub fn view(width: u32, height: u32, shift: f64) -> View {
    let focal = 0.8 * width as f32;
    let intrinsics =
        Intrinsics { width, height, fx: focal, fy: focal, cx: 0.5 * width as f32, cy: 0.5 * height as f32 };
    let across = HEIGHT_M * f64::from(width) / f64::from(focal);
    let center = DVec3::new(shift * across, 0.0, HEIGHT_M);
    View { intrinsics, pose: Pose { rotation: DQuat::from_xyzw(1.0, 0.0, 0.0, 0.0), center } }
}

/// `count` Gaussians of SH degree 3 that cover what [`view`] sees.
pub fn cloud(count: usize, width: u32, height: u32, seed: u64) -> GaussianCloud {
    let mut dice = Dice(seed as u32 ^ 0x9e37_79b9);
    let across = MARGIN * HEIGHT_M as f32 / 0.8;
    let down = across * height as f32 / width as f32;
    let sigma = OVERLAP * (across * down / count.max(1) as f32).sqrt();
    let mut cloud = GaussianCloud::with_capacity(3, count);
    let mut sh = vec![0.0; cloud.sh_stride()];
    for _ in 0..count {
        let (x, y) = (dice.within(-0.5, 0.5) * across, dice.within(-0.5, 0.5) * down);
        let z = RELIEF_M * ((0.3 * x).sin() * (0.4 * y).cos()) + dice.within(-0.1, 0.1);
        let size = |spread: f32| (sigma * spread).ln();
        let log_scales = [size(dice.within(0.7, 1.3)), size(dice.within(0.7, 1.3)), size(0.2)];
        let half_turn = dice.within(0.0, std::f32::consts::PI);
        for (k, s) in sh.iter_mut().enumerate() {
            *s = if k < 3 { dice.within(-0.5, 0.5) / SH_C0 } else { dice.within(-0.05, 0.05) };
        }
        cloud.push([x, y, z], log_scales, [half_turn.cos(), 0.0, 0.0, half_turn.sin()], dice.within(-1.0, 3.0), &sh);
    }
    cloud
}

/// A photograph from `view`: fields and stripes of seeded colours.
pub fn picture(view: &View, seed: u64) -> PosedImage {
    let mut dice = Dice(seed as u32 ^ 0x85eb_ca6b);
    let colours: Vec<[f32; 3]> = (0..64).map(|_| std::array::from_fn(|_| dice.within(30.0, 225.0))).collect();
    let k = view.intrinsics;
    let image = RgbImage::from_fn(k.width, k.height, |x, y| {
        let (u, v) = (8 * x / k.width.max(1), 8 * y / k.height.max(1));
        let stripe = 20.0 * (0.35 * x as f32 + 0.2 * y as f32).sin();
        Rgb(colours[(u + 8 * v) as usize % 64].map(|c| (c + stripe) as u8))
    });
    let sigma = PoseSigma { position_m: [0.0; 3], rotation_rad: [0.0; 3] };
    PosedImage { name: format!("synthetic {seed}"), time_ns: 0, image, view: *view, mask: None, sigma }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_seed_is_one_scene_and_every_is_valid() {
        let a = cloud(500, 64, 48, 7);
        assert!((0..a.len()).all(|i| a.is_valid(i)) && a.len() == 500);
        assert_eq!(a, cloud(500, 64, 48, 7));
        assert_ne!(a, cloud(500, 64, 48, 8));
        let v = view(64, 48, 0.0);
        assert_eq!(picture(&v, 7).image, picture(&v, 7).image);
    }
}
