//! Simulated surveys on which a map is measured: flown at two heights with two overlaps over flat, hilly and built-up ground.

use std::path::Path;

use engine::evaluate::save_png;
use glam::{DQuat, DVec3};
use models::camera::Pose;
use models::formats::transforms::pose_to_opengl;
use runtime::error::JobError;
use runtime::figures::write_json;
use serde::Serialize;
use sim::world::{PinholeView, World, WorldSettings};

/// Pictures along and across.
const GRID: [usize; 2] = [6, 5];
/// Picture size, pixels.
const SIZE: [u32; 2] = [320, 240];
/// Focal length, pixels.
const FOCAL: f64 = 260.0;
/// Ground beyond the outermost pictures that has relief and things on it, metres.
const RIM_M: f64 = 10.0;

/// How a survey is flown, and over what.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Survey {
    /// Height of flight above the world's zero, metres.
    pub height_m: f64,
    /// Share of a picture that the next one shows, along and across.
    pub overlap: f64,
    /// Height difference of the rolling ground, metres.
    pub relief_m: f32,
    /// Number of houses, trees and cars relative to the usual.
    pub density: f32,
}

impl Survey {
    /// In words.
    pub fn shown(&self) -> String {
        let Self { height_m, overlap, relief_m, density } = self;
        format!("{height_m} m up, {:.0} % overlap, {relief_m} m of relief, {density} × houses", 100.0 * overlap)
    }

    /// Two heights, two overlaps; flat, rolling and hilly ground, and a town.
    pub const EIGHT: [Self; 8] = [
        Self::of(42.0, 0.8, 5.0, 1.0),
        Self::of(42.0, 0.6, 5.0, 1.0),
        Self::of(84.0, 0.8, 0.0, 0.5),
        Self::of(84.0, 0.6, 25.0, 1.0),
        Self::of(42.0, 0.8, 5.0, 2.5),
        Self::of(42.0, 0.6, 25.0, 0.5),
        Self::of(84.0, 0.8, 5.0, 2.5),
        Self::of(84.0, 0.6, 0.0, 1.0),
    ];

    const fn of(height_m: f64, overlap: f64, relief_m: f32, density: f32) -> Self {
        Self { height_m, overlap, relief_m, density }
    }

    /// Between two pictures along and across, metres.
    fn spacing_m(&self) -> [f64; 2] {
        SIZE.map(|side| (1.0 - self.overlap) * f64::from(side) * self.height_m / FOCAL)
    }

    /// The ground of it.
    pub fn world(&self, seed: u64) -> World {
        let [half_width, half_height] = [0, 1].map(|k| {
            let flown = (GRID[k] - 1) as f64 * self.spacing_m()[k];
            0.5 * (flown + f64::from(SIZE[k]) * self.height_m / FOCAL)
        });
        let half_extent_m = half_width.max(half_height) + RIM_M;
        World::new(seed, &WorldSettings { half_extent_m, relief_m: self.relief_m, density: self.density })
    }

    /// Writes nadir pictures with their true poses to `root`; every 8th is held out, as in any data set without `split.json`.
    ///
    /// # Errors
    /// The folder cannot be written to.
    pub fn write(&self, root: &Path, world: &World) -> Result<(), JobError> {
        let [width, height] = SIZE;
        let (cx, cy) = (f64::from(width) / 2.0, f64::from(height) / 2.0);
        // Camera axes right, down, forward; the picture's top is north.
        let rotation = DQuat::from_xyzw(1.0, 0.0, 0.0, 0.0);
        let mut frames = Vec::new();
        for i in 0..GRID[0] * GRID[1] {
            let at = [i % GRID[0], i / GRID[0]];
            let [east, north] = [0, 1].map(|k| (at[k] as f64 - 0.5 * (GRID[k] - 1) as f64) * self.spacing_m()[k]);
            let center = DVec3::new(east, north, self.height_m);
            let view = PinholeView { width, height, fx: FOCAL, fy: FOCAL, cx, cy, position: center, rotation };
            let file = format!("images/{i:02}.png");
            save_png(&world.render(&view).0, &root.join(&file))?;
            let matrix = pose_to_opengl(&Pose { rotation, center });
            frames.push(serde_json::json!({ "file_path": file, "transform_matrix": matrix }));
        }
        let description = serde_json::json!({
            "fl_x": FOCAL, "fl_y": FOCAL, "cx": cx, "cy": cy, "w": width, "h": height,
            "enu_origin_wgs84": { "lat": 47.3977, "lon": 8.5456, "alt": 488.0 },
            "frames": frames,
        });
        write_json(&root.join("transforms.json"), &description)
    }
}
