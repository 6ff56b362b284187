//! nerfstudio / instant-ngp `transforms.json`: OpenGL camera-to-world matrices (x right, y up, the camera looks
//! along −z), converted here and nowhere else to OpenCV axes. Lens fields stand once for all frames or in each; the
//! camera model is the file's, or the frame's own.

use std::borrow::Cow;
use std::path::Path;

use geometry::lens::Distortion;
use glam::{DMat3, DQuat, DVec3};
use serde::Deserialize;
use serde_json::{Value, json};

use super::reconstruction::{Focal, LensDescription, Reconstruction, Shot, check_count, origin, picture_size};
use super::{FormatError, read_bounded, without_mark, write_atomic};
use crate::camera::Pose;

/// A hundred thousand frames at 2 KiB of JSON each.
const LIMIT: u64 = 200 << 20;
/// The lens fields, which the file may give once for all frames or for each.
#[derive(Clone, Default, Deserialize)]
struct RawLens {
    camera_model: Option<String>,
    fl_x: Option<f64>,
    fl_y: Option<f64>,
    cx: Option<f64>,
    cy: Option<f64>,
    w: Option<f64>,
    h: Option<f64>,
    camera_angle_x: Option<f64>,
    is_fisheye: Option<bool>,
    #[serde(flatten)]
    terms: RawTerms,
}

/// Terms of a distortion.
#[derive(Clone, Default, Deserialize)]
struct RawTerms {
    k1: Option<f64>,
    k2: Option<f64>,
    k3: Option<f64>,
    k4: Option<f64>,
    k5: Option<f64>,
    k6: Option<f64>,
    p1: Option<f64>,
    p2: Option<f64>,
    sx1: Option<f64>,
    sy1: Option<f64>,
}

#[derive(Deserialize)]
struct RawFrame {
    file_path: String,
    transform_matrix: Vec<Vec<Option<f64>>>,
    mask_path: Option<String>,
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
    enu_origin_wgs84: Option<RawOrigin>,
    ply_file_path: Option<String>,
    applied_transform: Option<Vec<Vec<Option<f64>>>>,
    applied_scale: Option<f64>,
    #[serde(flatten)]
    lens: RawLens,
}

fn parse(path: &Path) -> Result<RawFile, FormatError> {
    let bytes = read_bounded(path, LIMIT)?;
    serde_json::from_slice(&without_nan(without_mark(&bytes)))
        .map_err(|e| FormatError::invalid(path, format!("not a transforms.json of nerfstudio: {e}")))
}

/// Python writes numbers that are none as words that JSON does not have; they become `null`, which is named where a number is needed.
fn without_nan(json: &[u8]) -> Cow<'_, [u8]> {
    const WORDS: [&[u8]; 3] = [b"-Infinity", b"Infinity", b"NaN"];
    let mut mended: Option<Vec<u8>> = None;
    let (mut at, mut quoted) = (0, false);
    while at < json.len() {
        let word = WORDS.iter().find(|word| !quoted && json[at..].starts_with(word));
        match (json[at], word) {
            (_, Some(word)) => {
                let mended = mended.get_or_insert_with(|| json[..at].to_vec());
                mended.extend(b"null");
                at += word.len();
                continue;
            }
            (b'\\', None) if quoted && at + 1 < json.len() => {
                if let Some(mended) = &mut mended {
                    mended.push(json[at]);
                }
                at += 1;
            }
            (b'"', None) => quoted = !quoted,
            _ => {}
        }
        if let Some(mended) = &mut mended {
            mended.push(json[at]);
        }
        at += 1;
    }
    mended.map_or(Cow::Borrowed(json), Cow::Owned)
}

/// What stands in a file beside its frames about the points that belong to it.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct PointsOf {
    /// Path of a PLY of points in the frame of the poses, as the file names it.
    pub ply: Option<String>,
    /// What leads from the frame of the COLMAP model that the poses were made of into theirs: a matrix and a shift.
    pub applied: Option<(DMat3, DVec3)>,
}

/// What a file says of its points.
///
/// # Errors
/// The file cannot be read, or its `applied_transform` is no matrix.
pub fn points_of(path: &Path) -> Result<PointsOf, FormatError> {
    let raw = parse(path)?;
    let scale = raw.applied_scale.unwrap_or(1.0);
    let applied = match raw.applied_transform {
        None if scale == 1.0 => None,
        None => Some((DMat3::from_diagonal(DVec3::splat(scale)), DVec3::ZERO)),
        Some(rows) => {
            let m = matrix(&rows).map_err(|_| FormatError::invalid(path, "its applied_transform is no matrix"))?;
            let column = |j: usize| DVec3::new(m[0][j], m[1][j], m[2][j]) * scale;
            Some((DMat3::from_cols(column(0), column(1), column(2)), column(3)))
        }
    };
    Ok(PointsOf { ply: raw.ply_file_path, applied })
}

/// Reads `transforms.json`.
///
/// # Errors
/// The file cannot be read, is no such file, or says something impossible of a frame.
pub fn read(path: &Path) -> Result<Reconstruction, FormatError> {
    let raw = parse(path)?;
    check_count(path, raw.frames.len() as u64)?;
    let origin = raw.enu_origin_wgs84.map(|o| origin(path, "enu_origin_wgs84", o.lat, o.lon, o.alt)).transpose()?;
    let mut shots = Vec::with_capacity(raw.frames.len());
    for frame in raw.frames {
        let bad = |what: String| FormatError::invalid(path, format!("frame {:?}: {what}", frame.file_path));
        let pose = matrix(&frame.transform_matrix).and_then(|m| opengl_to_pose(&m)).map_err(|e| bad(e.to_owned()))?;
        let lens = lens(&frame.lens, &raw.lens).map_err(bad)?;
        shots.push(Shot { path: frame.file_path, lens, pose, mask: frame.mask_path });
    }
    Ok(Reconstruction { shots, origin })
}

/// nerfstudio's camera models (`nerfstudio/cameras/cameras.py`), COLMAP's names, and Blender's "perspective".
fn is_fisheye(model: &str) -> Result<bool, String> {
    match model {
        "PINHOLE" | "SIMPLE_PINHOLE" | "OPENCV" | "FULL_OPENCV" | "RADIAL" | "SIMPLE_RADIAL" | "perspective" => {
            Ok(false)
        }
        "OPENCV_FISHEYE" | "RADIAL_FISHEYE" | "SIMPLE_RADIAL_FISHEYE" | "THIN_PRISM_FISHEYE" | "fisheye" => Ok(true),
        _ => Err(format!(
            "camera_model {model:?} is not supported (perspective and fisheye models are); undistort the pictures to PINHOLE"
        )),
    }
}

fn lens(own: &RawLens, all: &RawLens) -> Result<LensDescription, String> {
    let pick = |f: fn(&RawLens) -> Option<f64>| f(own).or_else(|| f(all));
    let term = |f: fn(&RawLens) -> Option<f64>| pick(f).unwrap_or(0.0);
    let model = own.camera_model.as_deref().or(all.camera_model.as_deref());
    let fisheye = match model {
        Some(model) => is_fisheye(model)?,
        None => own.is_fisheye.or(all.is_fisheye).unwrap_or(false),
    };
    // OpenCV's k4, k5, k6 stand below the fraction bar; in every other model k4 is the term after k3.
    let rational =
        !fisheye && (model == Some("FULL_OPENCV") || pick(|l| l.terms.k5).is_some() || pick(|l| l.terms.k6).is_some());
    let k4 = term(|l| l.terms.k4);
    let distortion = Distortion {
        fisheye,
        k1: term(|l| l.terms.k1),
        k2: term(|l| l.terms.k2),
        k3: term(|l| l.terms.k3),
        k4: if rational { 0.0 } else { k4 },
        p1: term(|l| l.terms.p1),
        p2: term(|l| l.terms.p2),
        q1: if rational { k4 } else { 0.0 },
        q2: if rational { term(|l| l.terms.k5) } else { 0.0 },
        q3: if rational { term(|l| l.terms.k6) } else { 0.0 },
        sx1: term(|l| l.terms.sx1),
        sy1: term(|l| l.terms.sy1),
    };
    let size = match (pick(|l| l.w), pick(|l| l.h)) {
        (Some(w), Some(h)) => Some(picture_size(w, h).ok_or("w and h must be between 1 and 65536")?),
        (None, None) => None,
        _ => return Err("w and h must both be there".to_owned()),
    };
    let focal = match (pick(|l| l.fl_x), pick(|l| l.fl_y), pick(|l| l.camera_angle_x)) {
        (Some(x), y, _) => Focal::Pixels(x, y.unwrap_or(x)),
        (None, _, Some(angle)) => Focal::FieldOfView(angle),
        _ => return Err("neither fl_x nor a camera_angle_x between 0 and pi is given".to_owned()),
    };
    let principal = match (pick(|l| l.cx), pick(|l| l.cy)) {
        (Some(x), Some(y)) => Some((x, y)),
        (None, None) => None,
        _ => return Err("cx and cy must both be numbers".to_owned()),
    };
    let lens = LensDescription { size, focal, principal, distortion };
    match lens.fault() {
        None => Ok(lens),
        Some(fault) => Err(fault.to_owned()),
    }
}

/// Writes `transforms.json`; every frame has its own lens, as nerfstudio allows.
///
/// # Errors
/// The file cannot be written, or a lens has no size.
pub fn write(path: &Path, reconstruction: &Reconstruction) -> Result<(), FormatError> {
    let mut frames = Vec::with_capacity(reconstruction.shots.len());
    for shot in &reconstruction.shots {
        let Some((w, h)) = shot.lens.size else {
            return Err(FormatError::invalid(path, format!("{}: its size is not known", shot.path)));
        };
        let (lens, d) = (shot.lens.lens((w, h)), shot.lens.distortion);
        let rational = d.q1 != 0.0 || d.q2 != 0.0 || d.q3 != 0.0;
        if rational && d.k4 != 0.0 {
            let what = format!("{}: nerfstudio has no model with both k4 and a denominator", shot.path);
            return Err(FormatError::invalid(path, what));
        }
        let model = match (d.fisheye, rational) {
            (true, _) if d.p1 != 0.0 || d.p2 != 0.0 || d.sx1 != 0.0 || d.sy1 != 0.0 => "THIN_PRISM_FISHEYE",
            (true, _) => "OPENCV_FISHEYE",
            (false, true) => "FULL_OPENCV",
            (false, false) => "OPENCV",
        };
        let mut frame = json!({
            "file_path": shot.path, "transform_matrix": pose_to_opengl(&shot.pose), "camera_model": model, "w": w, "h": h,
            "fl_x": lens.focal[0], "fl_y": lens.focal[1], "cx": lens.principal[0], "cy": lens.principal[1],
        });
        let k4 = if rational { d.q1 } else { d.k4 };
        let terms = [
            ("k1", d.k1),
            ("k2", d.k2),
            ("k3", d.k3),
            ("k4", k4),
            ("k5", d.q2),
            ("k6", d.q3),
            ("p1", d.p1),
            ("p2", d.p2),
            ("sx1", d.sx1),
            ("sy1", d.sy1),
        ];
        for (name, value) in terms.into_iter().filter(|(_, v)| *v != 0.0) {
            frame[name] = value.into();
        }
        if let Some(mask) = &shot.mask {
            frame["mask_path"] = mask.as_str().into();
        }
        frames.push(frame);
    }
    let mut file = json!({ "frames": frames });
    if let Some(o) = reconstruction.origin {
        file["enu_origin_wgs84"] = json!({ "lat": o.lat_deg, "lon": o.lon_deg, "alt": o.alt_m });
    }
    write_json(path, &file)
}

/// Pretty JSON, written whole or not at all.
pub(super) fn write_json(path: &Path, value: &Value) -> Result<(), FormatError> {
    write_atomic(path, |w| serde_json::to_writer_pretty(w, value).map_err(std::io::Error::other))
}

/// Three rows of four numbers; what is no number is NaN.
fn matrix(rows: &[Vec<Option<f64>>]) -> Result<Vec<Vec<f64>>, &'static str> {
    let number = |v: &Option<f64>| v.unwrap_or(f64::NAN);
    match rows.len() >= 3 && rows.iter().take(3).all(|row| row.len() == 4) {
        true => Ok(rows.iter().take(3).map(|row| row.iter().map(number).collect()).collect()),
        false => Err("transform_matrix must have 3 or 4 rows of 4 numbers"),
    }
}

/// A 3×4 or 4×4 camera-to-world matrix with OpenGL axes → pose with OpenCV axes: y and z change sign.
///
/// # Errors
/// A matrix that is no rotation with a translation.
pub fn opengl_to_pose(rows: &[Vec<f64>]) -> Result<Pose, &'static str> {
    if rows.len() < 3 || rows.iter().take(3).any(|r| r.len() != 4) {
        return Err("transform_matrix must have 3 or 4 rows of 4 numbers");
    }
    if rows.iter().take(3).flatten().any(|v| !v.is_finite()) {
        return Err("transform_matrix holds NaN, null or an infinite number");
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
