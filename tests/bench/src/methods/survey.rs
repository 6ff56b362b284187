//! A simulated survey as a data set: aircraft side by side over the ray-cast world, true poses, and points as a structure-from-motion
//! leaves them.

use sim::world::{PinholeView, World, WorldSettings};
use std::path::Path;

use engine::evaluate::save_png;
use glam::{DQuat, DVec2, DVec3};
use models::camera::{Pinhole, Pose};
use models::formats::transforms::pose_to_opengl;
use serde_json::{Value, json};
use survey::dataset::{Dataset, SparsePoint};

use super::data::write_points;
use runtime::error::JobError;
use runtime::figures::write_json;

/// Aircraft that fly at least and at most: the depths of all pictures are in memory together.
pub const AIRCRAFT: std::ops::RangeInclusive<usize> = 2..=24;
/// Pictures along each side of a region.
const ALONG: usize = 4;
/// Between two pictures, metres: seven tenths overlap along the shorter side of a picture, three quarters along the longer one.
const SPACING_M: f64 = 12.0;
/// Height of flight above the world's zero, metres.
const HEIGHT_M: f64 = 42.0;
/// Picture size and focal length, pixels.
const SIZE: [u32; 2] = [320, 240];
const FOCAL: f64 = 260.0;
/// Every this many pictures one is held out: no multiple of a region's, so that some lie at borders and some do not.
const HELD_OUT_EVERY: usize = 7;
/// Points that are begun in each picture: what the structure-from-motion of sheffield_cross has.
const POINTS: usize = 150;
/// Pictures that must see a point.
const LEAST_TRACK: usize = 3;
/// Error of a point, metres along each axis at most: about half a pixel.
const POINT_ERROR_M: f64 = 0.1;
/// A picture sees a point when its own depth there is the point's to this share.
const SAME_DEPTH: f64 = 0.01;

/// A small generator, so that points depend on the seed and on nothing else.
struct Dice(u64);

impl Dice {
    fn next(&mut self) -> f64 {
        self.0 = self.0.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        (self.0 >> 33) as f64 / (1u64 << 31) as f64
    }
}

/// One exposure: whose, and where.
struct Exposure {
    aircraft: usize,
    center: DVec3,
}

/// South-western corner of a region.
fn corner(aircraft: usize, of: usize) -> DVec2 {
    let columns = (of as f64).sqrt().ceil() as usize;
    let rows = of.div_ceil(columns);
    let middle = DVec2::new(columns as f64, rows as f64) * 0.5;
    (DVec2::new((aircraft % columns) as f64, (aircraft / columns) as f64) - middle) * side_m()
}

fn side_m() -> f64 {
    ALONG as f64 * SPACING_M
}

fn exposures(aircraft: usize) -> Vec<Exposure> {
    let place = |aircraft: usize, of: usize, k: usize| {
        let step = DVec2::new((k % ALONG) as f64, (k / ALONG) as f64) + 0.5;
        Exposure { aircraft, center: (corner(aircraft, of) + step * SPACING_M).extend(HEIGHT_M) }
    };
    (0..aircraft).flat_map(|a| (0..ALONG * ALONG).map(move |k| place(a, aircraft, k))).collect()
}

fn name(i: usize, exposure: &Exposure) -> String {
    format!("a{}_{:02}.png", exposure.aircraft, i % (ALONG * ALONG))
}

/// Writes the survey of so many aircraft to `root`, unless the same one is there already.
///
/// # Errors
/// More aircraft than can be or fewer, or the folder cannot be written to.
pub fn write(root: &Path, aircraft: usize, seed: u64) -> Result<(), JobError> {
    if !AIRCRAFT.contains(&aircraft) {
        let (least, most) = (AIRCRAFT.start(), AIRCRAFT.end());
        return Err(JobError::Request(format!("--simulated {aircraft}: must be {least} to {most} aircraft")));
    }
    let note = root.join("survey.json");
    let same = json!({ "aircraft": aircraft, "seed": seed });
    let written = std::fs::read(&note).ok().and_then(|bytes| serde_json::from_slice::<Value>(&bytes).ok());
    if written.as_ref() == Some(&same) {
        return Ok(());
    }
    let exposures = exposures(aircraft);
    let reach = exposures.iter().map(|e| e.center.truncate().abs().max_element()).fold(0.0, f64::max);
    let world = World::new(seed, &WorldSettings { half_extent_m: reach + HEIGHT_M, ..WorldSettings::default() });
    let ([width, height], rotation) = (SIZE, DQuat::from_xyzw(1.0, 0.0, 0.0, 0.0));
    let (cx, cy) = (f64::from(width) / 2.0, f64::from(height) / 2.0);
    let (mut frames, mut depths) = (Vec::new(), Vec::new());
    for (i, exposure) in exposures.iter().enumerate() {
        let center = exposure.center;
        let view = PinholeView { width, height, fx: FOCAL, fy: FOCAL, cx, cy, position: center, rotation };
        let (picture, depth) = world.render(&view);
        let file = format!("images/{}", name(i, exposure));
        save_png(&picture, &root.join(&file))?;
        depths.push(depth);
        let matrix = pose_to_opengl(&Pose { rotation, center });
        frames.push(json!({ "file_path": file, "transform_matrix": matrix }));
    }
    let description = json!({
        "fl_x": FOCAL, "fl_y": FOCAL, "cx": cx, "cy": cy, "w": width, "h": height,
        "enu_origin_wgs84": { "lat": 47.3977, "lon": 8.5456, "alt": 488.0 },
        "frames": frames,
    });
    write_json(&root.join("transforms.json"), &description)?;
    write_json(&root.join("split.json"), &split(&exposures, aircraft))?;
    let set = Dataset::open(root)?;
    write_points(root, &set, &points(&set, &depths, seed)?)?;
    // Last: what is there without it is not all there.
    write_json(&note, &same)
}

fn is_held_out(i: usize) -> bool {
    i % HELD_OUT_EVERY == HELD_OUT_EVERY / 2
}

fn split(exposures: &[Exposure], aircraft: usize) -> Value {
    let names = |of: Option<usize>, held_out: bool| -> Vec<String> {
        let wanted = |(i, e): &(usize, &Exposure)| of.is_none_or(|a| a == e.aircraft) && is_held_out(*i) == held_out;
        exposures.iter().enumerate().filter(wanted).map(|(i, e)| name(i, e)).collect()
    };
    let region = |a: usize| {
        let low = corner(a, aircraft);
        let (low, high) = (low.to_array(), (low + side_m()).to_array());
        let (train, test) = (names(Some(a), false), names(Some(a), true));
        json!({ "id": format!("a{a}"), "bbox_min_xy": low, "bbox_max_xy": high, "train": train, "test": test })
    };
    let regions: Vec<Value> = (0..aircraft).map(region).collect();
    json!({ "train": names(None, false), "test": names(None, true), "regions": regions })
}

/// Points on the true surface, displaced a little, of those places that enough pictures see.
fn points(set: &Dataset, depths: &[Vec<f32>], seed: u64) -> Result<Vec<SparsePoint>, JobError> {
    let mut dice = Dice(seed ^ 0x9e37_79b9_7f4a_7c15);
    let cameras: Vec<Pinhole> = set.frames.iter().map(|f| Pinhole::from(&f.view)).collect();
    let depth_at = |i: usize, x: u32, y: u32| f64::from(depths[i][(y * SIZE[0] + x) as usize]);
    let mut points = Vec::new();
    for (i, camera) in cameras.iter().enumerate() {
        let picture = set.load(i, 1.0)?.image;
        for _ in 0..POINTS {
            let [x, y] = SIZE.map(|side| ((dice.next() * f64::from(side)) as u32).min(side - 1));
            let depth = depth_at(i, x, y);
            if depth <= 0.0 {
                continue;
            }
            let place = camera.unproject([x as f32 + 0.5, y as f32 + 0.5], depth);
            let sees = |j: &usize| {
                let Some(at) = cameras[*j].project(place).filter(|p| set.frames[*j].view.intrinsics.contains(*p))
                else {
                    return false;
                };
                let own = cameras[*j].local(place).z;
                (depth_at(*j, at.x as u32, at.y as u32) - own).abs() < SAME_DEPTH * own
            };
            let frames: Vec<u32> = (0..cameras.len()).filter(sees).map(|j| j as u32).collect();
            if frames.len() >= LEAST_TRACK {
                let error = [(); 3].map(|()| (2.0 * dice.next() - 1.0) * POINT_ERROR_M);
                let position = (place + DVec3::from(error)).to_array();
                points.push(SparsePoint { position, color: picture.get_pixel(x, y).0, error_px: 0.5, frames });
            }
        }
    }
    Ok(points)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_survey_has_a_region_for_each_aircraft_and_points_that_several_pictures_saw() {
        let dir = tempfile::tempdir().expect("temp dir");
        write(dir.path(), 2, 5).expect("written");
        let set = Dataset::open(dir.path()).expect("a data set");
        assert_eq!((set.frames.len(), set.split.regions.len()), (32, 2));
        let (train, test) = (set.select("train", None).expect("train"), set.select("test", None).expect("test"));
        assert_eq!((train.len(), test.len()), (27, 5));
        for region in ["a0", "a1"] {
            assert!(set.select("train", Some(region)).expect("its own").len() >= 13);
            assert!(!set.select("test", Some(region)).expect("its own").is_empty());
        }
        let points = set.sparse_points().expect("points");
        assert!(points.len() > 32 * POINTS / 2, "{}", points.len());
        assert!(points.iter().all(|p| p.frames.len() >= LEAST_TRACK && p.position[2].abs() < 30.0));
        assert!(
            set.sparse_points_of(&set.select("train", Some("a0")).expect("a0")).expect("points").len() < points.len()
        );
        // The same survey is not drawn again, another one is.
        let picture = dir.path().join("images/a0_00.png");
        std::fs::remove_file(&picture).expect("removed");
        write(dir.path(), 2, 5).expect("there already");
        assert!(!picture.is_file());
        write(dir.path(), 2, 6).expect("written");
        assert!(picture.is_file());
        for aircraft in [0, 1, 25] {
            assert!(write(dir.path(), aircraft, 5).is_err_and(|e| e.to_string().contains("2 to 24")));
        }
    }
}
