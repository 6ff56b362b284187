//! What a step will have to do, from how many Gaussians there are and how large the picture is.
//!
//! Of N Gaussians a picture of P pixels shows V = share·N; each has a = P/V pixels of it to itself. Its standard deviation on the picture
//! is then κ·√a, widened by the renderer's low-pass (0.3 px²), and it is drawn out to `REACH` of those. A disc of radius r meets, of
//! tiles of 8 × 4 pixels whose centres count (7 × 3 between the outer ones), (π·r² + 2·r·(7 + 3) + 7·3) / (8·4) on the mean, wherever it
//! lies (the area of the disc grown by the tile, over the tile's).

use std::f64::consts::PI;

use config::plan::{TILE_HEIGHT, TILE_WIDTH};
use vulkan::stages::work::Load;

use crate::model;

/// Standard deviations to which a Gaussian is drawn: √(2·ln(255·opacity)) for an opacity of 0.56. With it, the synthetic scenes of `bench
/// stages` after four and trained ones after a hundred steps have as many instances as were counted within a quarter (the tests below).
const REACH: f64 = 3.15;
/// The renderer's low-pass, px² (3DGS).
const LOW_PASS: f64 = 0.3;
/// Of a tile's pixels so many are evaluated: the rest lies behind what is opaque already (0.95 on fox, 0.98 on sheffield_cross).
const IN_FRONT: f64 = 0.96;

/// κ: how large Gaussians are beside the room they have.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Footprint(pub f64);

impl Footprint {
    /// Of trained Gaussians: fox with 10,756 and 24,000 Gaussians has 1.02 and 1.18, sheffield_cross 1.01 with 100,000, 0.95 with 25,000,
    /// at half its size 1.01 and (12,000) 0.82, brighton_beach 0.90 (`dgtr train DATASET --no-eval`, one to three visits a picture,
    /// from `work` and `skipped.culled` of `run.json`).
    pub const TRAINED: Self = Self(1.0);
    /// Of the synthetic scenes of `bench`, made with 0.6 ([`crate::cost::synthetic`]) and widened by a dozen steps: 0.70 to 0.76 (`bench
    /// stages --gaussians 6000,48000,100000 --sizes 128x96,480x360,640x480 --steps 12`).
    pub const SYNTHETIC: Self = Self(0.72);
}

/// What one picture looks at.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Visibility {
    /// Gaussians of the scene.
    pub gaussians: u64,
    /// Share of them that one picture sees, 0…1.
    pub share: f64,
    /// Pixels of the picture.
    pub pixels: u64,
}

impl Visibility {
    /// The work of a step.
    pub fn load(&self, footprint: Footprint) -> Load {
        let visible = (self.gaussians as f64 * self.share.clamp(0.0, 1.0)).max(1.0);
        let room = self.pixels as f64 / visible;
        let radius = REACH * (footprint.0 * footprint.0 * room + LOW_PASS).sqrt();
        let (width, height) = (TILE_WIDTH as f64, TILE_HEIGHT as f64);
        let (across, down) = (width - 1.0, height - 1.0);
        let met = (PI * radius * radius + 2.0 * radius * (across + down) + across * down) / (width * height);
        let instances = visible * met;
        let evaluations = instances * width * height * IN_FRONT;
        model::load(self.gaussians, visible as u64, instances as u64, evaluations as u64, self.pixels)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn near(is: u64, expected: f64, within: f64) -> bool {
        (is as f64 / expected - 1.0).abs() < within
    }

    #[test]
    fn instances_of_synthetic_and_of_trained_scenes_come_out_as_they_were_counted() {
        // Gaussians, visible, pixels, instances: the command at `Footprint::SYNTHETIC`.
        let synthetic = [
            (6000, 4998, 128 * 96, 21_617),
            (100_000, 78_700, 128 * 96, 167_168),
            (6000, 4998, 480 * 360, 145_991),
            (48_000, 37_248, 480 * 360, 246_245),
            (48_000, 37_296, 640 * 480, 368_818),
            (100_000, 76_800, 640 * 480, 475_497),
        ];
        // fox, sheffield_cross (whole and half the size), brighton_beach.
        let trained = [
            (10_756, 8207, 270 * 480, 206_297),
            (24_000, 19_330, 270 * 480, 313_313),
            (99_472, 29_300, 640 * 480, 521_300),
            (99_853, 23_108, 320 * 240, 185_964),
            (24_872, 7426, 640 * 480, 368_489),
            (59_871, 14_590, 640 * 360, 301_243),
        ];
        let of = |rows: [_; 6], footprint| rows.map(|row| (row, footprint));
        let all = [of(synthetic, Footprint::SYNTHETIC), of(trained, Footprint::TRAINED)].concat();
        for ((gaussians, visible, pixels, instances), footprint) in all {
            let share = visible as f64 / gaussians as f64;
            let load = Visibility { gaussians, share, pixels }.load(footprint);
            assert!(
                near(load.instances, instances as f64, 0.25),
                "{gaussians} at {pixels}: {} {instances}",
                load.instances
            );
        }
    }

    #[test]
    fn nothing_to_see_and_a_share_that_is_none_are_a_step_all_the_same() {
        let load = Visibility { gaussians: 0, share: f64::NAN, pixels: 0 }.load(Footprint::TRAINED);
        assert!(load.visible <= 1 && load.instances <= 2, "{load:?}");
        let all = Visibility { gaussians: 10, share: 7.0, pixels: 64 }.load(Footprint::TRAINED);
        assert_eq!(all.visible, 10);
    }
}
