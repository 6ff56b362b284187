//! The truth of a simulated flight as a data set (nerfstudio `transforms.json`, `split.json`), so that what was
//! reconstructed from the reported poses can be judged by the true ones: the flown pictures for training, and views
//! between them that no aircraft ever had for testing.

use std::path::Path;
use std::sync::atomic::{AtomicBool, Ordering};

use geometry::geodesy::Geodetic;
use glam::{DMat3, DQuat, DVec3};
use serde_json::{Value, json};

use super::aircraft::Flight;
use super::axes::camera_to_enu;
use super::error::SimError;
use super::photographer::{to_jpeg, write_whole};
use super::world::{PinholeView, World};

/// One held-out view for this many flown ones.
const FLOWN_PER_TEST: usize = 6;
/// Fewest held-out views.
const FEWEST: usize = 4;

/// The lens of a view, without a place.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Lens {
    /// Picture width, pixels.
    pub width: u32,
    /// Picture height, pixels.
    pub height: u32,
    /// Focal length along x, pixels.
    pub fx: f64,
    /// Focal length along y, pixels.
    pub fy: f64,
    /// Principal point, x.
    pub cx: f64,
    /// Principal point, y.
    pub cy: f64,
}

impl Lens {
    /// This lens at a place; `rotation` is camera (OpenCV) → ENU.
    pub fn at(&self, position: DVec3, rotation: DQuat) -> PinholeView {
        let Self { width, height, fx, fy, cx, cy } = *self;
        PinholeView { width, height, fx, fy, cx, cy, position, rotation }
    }
}

/// The true views of a flight's exposures.
pub fn flown_views(flight: &Flight, lens: &Lens) -> Vec<PinholeView> {
    let view = |middle_s: f64| {
        let s = flight.truth.at(middle_s);
        lens.at(s.position, camera_to_enu(s.gimbal))
    };
    flight.exposures.iter().map(|e| view(e.middle_s)).collect()
}

/// Views between the flown ones: a third of the way to the next picture, aside of the line, turned a little.
pub fn held_out_views(flown: &[PinholeView]) -> Vec<PinholeView> {
    let count = (flown.len() / FLOWN_PER_TEST).max(FEWEST).min(flown.len());
    (0..count)
        .map(|k| {
            let index = (2 * k + 1) * flown.len() / (2 * count);
            let a = &flown[index];
            let next = flown.get(index + 1).filter(|b| (b.position - a.position).length() < 0.5 * a.position.z.abs());
            let step = next.map_or(DVec3::ZERO, |b| b.position - a.position);
            let side = if k % 2 == 0 { 1.0 } else { -1.0 };
            let aside = a.rotation * DVec3::X * (side * 0.06 * a.position.z);
            let position = a.position + 0.35 * step + aside + DVec3::Z * (0.03 * side * a.position.z);
            PinholeView { position, rotation: a.rotation * DQuat::from_rotation_z(0.15 * side), ..*a }
        })
        .collect()
}

/// Renders the held-out views into `folder/images` and writes `transforms.json` and `split.json`. The flown pictures are
/// expected in `folder/images` under `names`. Ends early, without the description, when `quit` is set.
///
/// # Errors
/// Files that cannot be written.
pub fn complete(
    folder: &Path,
    world: &World,
    origin: Geodetic,
    names: &[String],
    flown: &[PinholeView],
    quit: &AtomicBool,
) -> Result<(), SimError> {
    let Some(lens) = flown.first() else { return Ok(()) };
    let held_out = held_out_views(flown);
    let mut test = Vec::new();
    for (k, view) in held_out.iter().enumerate() {
        if quit.load(Ordering::Relaxed) {
            return Ok(());
        }
        let name = format!("held_out_{:03}.jpg", k + 1);
        write_whole(&folder.join("images").join(&name), &to_jpeg(&world.render(view).0)?)?;
        test.push(name);
    }
    let frame = |(name, view): (&String, &PinholeView)| json!({ "file_path": format!("images/{name}"), "transform_matrix": opengl_matrix(view) });
    let frames: Vec<Value> = names.iter().zip(flown).map(frame).chain(test.iter().zip(&held_out).map(frame)).collect();
    let transforms = json!({
        "camera_model": "PINHOLE",
        "w": lens.width, "h": lens.height,
        "fl_x": lens.fx, "fl_y": lens.fy, "cx": lens.cx, "cy": lens.cy,
        "world_frame": "ENU metres, z up",
        "enu_origin_wgs84": { "lat": origin.lat_deg, "lon": origin.lon_deg, "alt": origin.alt_m },
        "frames": frames,
    });
    let split = json!({ "train": names, "test": test });
    write_whole(&folder.join("split.json"), format!("{split:#}\n").as_bytes())?;
    write_whole(&folder.join("transforms.json"), format!("{transforms:#}\n").as_bytes())
}

/// Camera-to-world with OpenGL axes (x right, y up, looking along −z), rows.
fn opengl_matrix(view: &PinholeView) -> [[f64; 4]; 4] {
    let r = DMat3::from_quat(view.rotation);
    let (x, y, z, p) = (r.x_axis, -r.y_axis, -r.z_axis, view.position);
    [[x.x, y.x, z.x, p.x], [x.y, y.y, z.y, p.y], [x.z, y.z, z.z, p.z], [0.0, 0.0, 0.0, 1.0]]
}
