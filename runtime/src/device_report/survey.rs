//! A small survey of the ray-cast world, so that a device is measured with nothing at hand.

use std::path::Path;

use engine::evaluate::save_png;
use glam::{DQuat, DVec3};
use models::camera::Pose;
use models::formats::transforms::pose_to_opengl;
use sim::world::{PinholeView, World, WorldSettings};

use crate::error::JobError;
use crate::figures::write_json;

/// Height of flight above the world's zero, metres.
const HEIGHT_M: f64 = 42.0;
/// Between two pictures, metres: four fifths overlap along and across.
const SPACING_M: f64 = 9.0;
/// Pictures along and across.
const GRID: [usize; 2] = [6, 4];
/// Picture size, pixels.
const SIZE: [u32; 2] = [320, 240];
/// Focal length, pixels.
const FOCAL: f64 = 260.0;

/// The world of the data set.
pub fn world(seed: u64) -> World {
    World::new(seed, &WorldSettings { half_extent_m: 60.0, ..WorldSettings::default() })
}

/// Writes `GRID` nadir pictures, `larger` times as wide and high as `SIZE`, with their true poses to `root`; every 8th is held out,
/// as in any data set without `split.json`.
///
/// # Errors
/// The folder cannot be written to.
pub fn write_data_set(root: &Path, seed: u64, larger: f64) -> Result<(), JobError> {
    let world = world(seed);
    let [width, height] = SIZE.map(|side| (f64::from(side) * larger).round() as u32);
    let (focal, cx, cy) = (FOCAL * larger, f64::from(width) / 2.0, f64::from(height) / 2.0);
    // Camera axes right, down, forward; the picture's top is north.
    let rotation = DQuat::from_xyzw(1.0, 0.0, 0.0, 0.0);
    let mut frames = Vec::new();
    for i in 0..GRID[0] * GRID[1] {
        let (column, row) = ((i % GRID[0]) as f64, (i / GRID[0]) as f64);
        let place = |at: f64, of: usize| (at - 0.5 * (of - 1) as f64) * SPACING_M;
        let center = DVec3::new(place(column, GRID[0]), place(row, GRID[1]), HEIGHT_M);
        let view = PinholeView { width, height, fx: focal, fy: focal, cx, cy, position: center, rotation };
        let file = format!("images/{i:02}.png");
        save_png(&world.render(&view).0, &root.join(&file))?;
        let matrix = pose_to_opengl(&Pose { rotation, center });
        frames.push(serde_json::json!({ "file_path": file, "transform_matrix": matrix }));
    }
    let description = serde_json::json!({
        "fl_x": focal, "fl_y": focal, "cx": cx, "cy": cy, "w": width, "h": height,
        "enu_origin_wgs84": { "lat": 47.3977, "lon": 8.5456, "alt": 488.0 },
        "frames": frames,
    });
    write_json(&root.join("transforms.json"), &description)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_data_set_opens_and_its_pictures_overlap() {
        let dir = tempfile::tempdir().unwrap();
        write_data_set(dir.path(), 3, 1.0).unwrap();
        let set = survey::dataset::Dataset::open(dir.path()).unwrap();
        assert_eq!(set.frames.len(), 24);
        assert_eq!((set.select("test", None).unwrap().len(), set.select("train", None).unwrap().len()), (3, 21));
        let footprint = HEIGHT_M * f64::from(SIZE[1]) / FOCAL;
        assert!(SPACING_M < 0.5 * footprint);
    }
}
