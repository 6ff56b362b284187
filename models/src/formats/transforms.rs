//! nerfstudio / instant-ngp `transforms.json`: OpenGL camera-to-world matrices (x right, y up, the camera looks
//! along −z), converted here and nowhere else to OpenCV axes.

use std::path::Path;

use config::geodesy::Geodetic;
use glam::{DMat3, DQuat, DVec3};
use serde::Deserialize;

use super::{FormatError, read_bounded};
use crate::camera::Pose;
use config::lens::Distortion;

/// A hundred thousand frames at 2 KiB of JSON each.
const LIMIT: u64 = 200 << 20;
/// More pictures than one flight takes; bounds what later stages allocate per frame.
const MAX_FRAMES: u64 = 100_000;

/// The file, as far as this project needs it.
#[derive(Clone, Debug)]
pub struct Transforms {
    /// Frames in file order.
    pub frames: Vec<TransformsFrame>,
    /// WGS-84 origin of the world frame, when the file tells it.
    pub origin: Option<Geodetic>,
}

/// One picture of the file.
#[derive(Clone, Debug)]
pub struct TransformsFrame {
    /// As written in the file.
    pub file_path: String,
    /// Lens at the size the file speaks of.
    pub lens: Lens,
    /// Camera (OpenCV axes) → world.
    pub pose: Pose,
}

/// A lens whose picture size may have to be read from the picture.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Lens {
    /// Width and height, where the file has them.
    pub size: Option<(u32, u32)>,
    /// Focal lengths in pixels, or the horizontal field of view in radians.
    pub focal: Focal,
    /// Principal point; `None` = the middle.
    pub centre: Option<(f64, f64)>,
    /// Brown–Conrady coefficients, all zero for a pinhole.
    pub distortion: Distortion,
}

/// How the file states the focal length.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Focal {
    /// fx, fy.
    Pixels(f64, f64),
    /// Horizontal field of view (`camera_angle_x` of Blender data sets).
    FieldOfView(f64),
}

/// The lens fields, which the file may give once for all frames or for each.
#[derive(Clone, Copy, Default, Deserialize)]
struct RawLens {
    fl_x: Option<f64>,
    fl_y: Option<f64>,
    cx: Option<f64>,
    cy: Option<f64>,
    w: Option<f64>,
    h: Option<f64>,
    camera_angle_x: Option<f64>,
    k1: Option<f64>,
    k2: Option<f64>,
    k3: Option<f64>,
    k4: Option<f64>,
    p1: Option<f64>,
    p2: Option<f64>,
}

#[derive(Deserialize)]
struct RawFrame {
    file_path: String,
    transform_matrix: Vec<Vec<f64>>,
    #[serde(flatten)]
    lens: RawLens,
}

#[derive(Deserialize)]
struct RawOrigin {
    lat: f64,
    lon: f64,
    alt: f64,
}

#[derive(Deserialize)]
struct RawFile {
    frames: Vec<RawFrame>,
    camera_model: Option<String>,
    enu_origin_wgs84: Option<RawOrigin>,
    #[serde(flatten)]
    lens: RawLens,
}

/// Reads `transforms.json`.
pub fn read(path: &Path) -> Result<Transforms, FormatError> {
    let bytes = read_bounded(path, LIMIT)?;
    let raw: RawFile = serde_json::from_slice(&bytes)
        .map_err(|e| FormatError::invalid(path, format!("not a transforms.json of nerfstudio: {e}")))?;
    if raw.frames.len() as u64 > MAX_FRAMES {
        let size = raw.frames.len() as u64;
        return Err(FormatError::TooLarge {
            path: path.to_owned(),
            what: "its number of frames",
            size,
            limit: MAX_FRAMES,
        });
    }
    if let Some(model) = raw.camera_model.as_deref()
        && !["PINHOLE", "SIMPLE_PINHOLE", "OPENCV", "RADIAL", "SIMPLE_RADIAL", "perspective"].contains(&model)
    {
        return Err(FormatError::invalid(
            path,
            format!("camera_model {model:?} is not supported; undistort the pictures to PINHOLE"),
        ));
    }
    let origin = match raw.enu_origin_wgs84 {
        None => None,
        Some(o) => {
            let o = Geodetic { lat_deg: o.lat, lon_deg: o.lon, alt_m: o.alt };
            if !o.is_valid() {
                return Err(FormatError::invalid(path, "enu_origin_wgs84 is not a position on the earth"));
            }
            Some(o)
        }
    };
    let mut frames = Vec::with_capacity(raw.frames.len());
    for frame in raw.frames {
        let bad = |what: String| FormatError::invalid(path, format!("frame {:?}: {what}", frame.file_path));
        let pose = opengl_to_pose(&frame.transform_matrix).map_err(|e| bad(e.to_owned()))?;
        let lens = lens(&frame.lens, &raw.lens).map_err(|e| bad(e.to_owned()))?;
        frames.push(TransformsFrame { file_path: frame.file_path, lens, pose });
    }
    Ok(Transforms { frames, origin })
}

fn lens(own: &RawLens, all: &RawLens) -> Result<Lens, &'static str> {
    let pick = |f: fn(&RawLens) -> Option<f64>| f(own).or_else(|| f(all));
    let coefficient = |f: fn(&RawLens) -> Option<f64>| pick(f).unwrap_or(0.0);
    if coefficient(|l| l.k4) != 0.0 {
        return Err("k4 is a fisheye or rational coefficient, which is not supported; undistort the pictures first");
    }
    let distortion = Distortion {
        k1: coefficient(|l| l.k1),
        k2: coefficient(|l| l.k2),
        k3: coefficient(|l| l.k3),
        p1: coefficient(|l| l.p1),
        p2: coefficient(|l| l.p2),
    };
    let size = match (pick(|l| l.w), pick(|l| l.h)) {
        (Some(w), Some(h)) if (1.0..=65_536.0).contains(&w) && (1.0..=65_536.0).contains(&h) => {
            Some((w as u32, h as u32))
        }
        (None, None) => None,
        _ => return Err("w and h must both be there and between 1 and 65536"),
    };
    let focal = match (pick(|l| l.fl_x), pick(|l| l.fl_y), pick(|l| l.camera_angle_x)) {
        (Some(x), y, _) => Focal::Pixels(x, y.unwrap_or(x)),
        (None, _, Some(angle)) if angle > 0.0 && angle < std::f64::consts::PI => Focal::FieldOfView(angle),
        _ => return Err("neither fl_x nor a camera_angle_x between 0 and pi is given"),
    };
    if let Focal::Pixels(x, y) = focal
        && !(x > 0.0 && y > 0.0 && x.is_finite() && y.is_finite())
    {
        return Err("fl_x and fl_y must be positive numbers");
    }
    let centre = match (pick(|l| l.cx), pick(|l| l.cy)) {
        (Some(x), Some(y)) if x.is_finite() && y.is_finite() => Some((x, y)),
        (None, None) => None,
        _ => return Err("cx and cy must both be numbers"),
    };
    Ok(Lens { size, focal, centre, distortion })
}

/// A 3×4 or 4×4 camera-to-world matrix with OpenGL axes → pose with OpenCV axes: y and z change sign.
pub fn opengl_to_pose(rows: &[Vec<f64>]) -> Result<Pose, &'static str> {
    if rows.len() < 3 || rows.iter().take(3).any(|r| r.len() != 4) {
        return Err("transform_matrix must have 3 or 4 rows of 4 numbers");
    }
    if rows.iter().take(3).flatten().any(|v| !v.is_finite()) {
        return Err("transform_matrix holds a number that is not finite");
    }
    let column = |j: usize| DVec3::new(rows[0][j], rows[1][j], rows[2][j]);
    let m = DMat3::from_cols(column(0), -column(1), -column(2));
    // A few files carry 1e-3 of rounding; a scale or a mirror is a mistake that would train to nonsense.
    let error = m.transpose() * m - DMat3::IDENTITY;
    if error.to_cols_array().iter().any(|e| e.abs() > 1e-2) || m.determinant() < 0.0 {
        return Err("transform_matrix is not a rotation (scaled or mirrored); export rigid camera-to-world matrices");
    }
    Ok(Pose { rotation: DQuat::from_mat3(&m).normalize(), center: column(3) })
}

/// Inverse of [`opengl_to_pose`]: the 4×4 matrix `transforms.json` wants.
pub fn pose_to_opengl(pose: &Pose) -> [[f64; 4]; 4] {
    let m = DMat3::from_quat(pose.rotation);
    let (x, y, z, c) = (m.x_axis, -m.y_axis, -m.z_axis, pose.center);
    [[x.x, y.x, z.x, c.x], [x.y, y.y, z.y, c.y], [x.z, y.z, z.z, c.z], [0.0, 0.0, 0.0, 1.0]]
}
