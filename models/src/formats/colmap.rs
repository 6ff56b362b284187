//! COLMAP's binary sparse model (`cameras.bin`, `images.bin`, `points3D.bin`): OpenCV axes, world-to-camera
//! rotations stored w x y z. Keypoints are skipped; points keep which images saw them.

use std::collections::HashMap;
use std::path::Path;

use glam::{DQuat, DVec3};

use super::transforms::{Focal, Lens};
use super::{Bytes, FormatError, read_bounded};
use crate::camera::Pose;
use config::lens::Distortion;

/// A gigabyte holds some ten million points with their tracks, more than a board has room for.
const LIMIT: u64 = 1 << 30;

/// A registered image.
#[derive(Clone, Debug)]
pub struct ColmapImage {
    /// COLMAP's own number.
    pub id: u32,
    /// Path below the image folder.
    pub name: String,
    /// Number of the camera in `cameras.bin`.
    pub camera_id: u32,
    /// Camera (OpenCV axes) → world.
    pub pose: Pose,
}

/// A triangulated point.
#[derive(Clone, Debug)]
pub struct ColmapPoint {
    /// World position.
    pub position: DVec3,
    /// Mean colour of its keypoints.
    pub color: [u8; 3],
    /// Mean reprojection error, pixels.
    pub error: f64,
    /// Numbers of the images that saw it, sorted, each once; may be empty when the writer left tracks out.
    pub images: Vec<u32>,
}

/// Lenses by camera number.
pub fn read_cameras(path: &Path) -> Result<HashMap<u32, Lens>, FormatError> {
    let bytes = read_bounded(path, LIMIT)?;
    let mut r = Bytes::new(path, &bytes);
    let n = r.count(24, "the number of cameras")?;
    let mut cameras = HashMap::with_capacity(n);
    for _ in 0..n {
        let id = r.u32("a camera")?;
        let model = r.u32("a camera")?;
        let (w, h) = (r.u64("a camera")?, r.u64("a camera")?);
        if !(1..=65_536).contains(&w) || !(1..=65_536).contains(&h) {
            return Err(FormatError::invalid(path, format!("camera {id} has the size {w} x {h}")));
        }
        let mut p = [0.0; 8];
        // COLMAP's camera model numbers and their parameters (src/colmap/sensor/models.h).
        let parameters = match model {
            0 => 3,
            1 | 2 => 4,
            3 => 5,
            4 => 8,
            _ => {
                let what = format!(
                    "camera {id} has COLMAP model number {model}; supported are SIMPLE_PINHOLE, PINHOLE, SIMPLE_RADIAL, RADIAL, OPENCV: run colmap image_undistorter"
                );
                return Err(FormatError::invalid(path, what));
            }
        };
        for v in &mut p[..parameters] {
            *v = r.f64("a camera")?;
        }
        let mut distortion = Distortion::default();
        let (fx, fy, cx, cy) =
            if model == 1 || model == 4 { (p[0], p[1], p[2], p[3]) } else { (p[0], p[0], p[1], p[2]) };
        match model {
            2 => distortion.k1 = p[3],
            3 => (distortion.k1, distortion.k2) = (p[3], p[4]),
            4 => (distortion.k1, distortion.k2, distortion.p1, distortion.p2) = (p[4], p[5], p[6], p[7]),
            _ => {}
        }
        if p.iter().any(|v| !v.is_finite()) || fx <= 0.0 || fy <= 0.0 {
            return Err(FormatError::invalid(
                path,
                format!("camera {id} has impossible parameters {:?}", &p[..parameters]),
            ));
        }
        let lens =
            Lens { size: Some((w as u32, h as u32)), focal: Focal::Pixels(fx, fy), centre: Some((cx, cy)), distortion };
        cameras.insert(id, lens);
    }
    Ok(cameras)
}

/// Registered images in file order.
pub fn read_images(path: &Path) -> Result<Vec<ColmapImage>, FormatError> {
    let bytes = read_bounded(path, LIMIT)?;
    let mut r = Bytes::new(path, &bytes);
    let n = r.count(73, "the number of images")?;
    let mut images = Vec::with_capacity(n);
    for _ in 0..n {
        let id = r.u32("an image")?;
        let mut v = [0.0; 7];
        for x in &mut v {
            *x = r.f64("an image")?;
        }
        let camera_id = r.u32("an image")?;
        let name = r.c_str("an image's name")?.to_owned();
        let keypoints = r.count(24, "an image's number of keypoints")?;
        r.take(keypoints * 24, "an image's keypoints")?;
        let q = DQuat::from_xyzw(v[1], v[2], v[3], v[0]);
        let t = DVec3::new(v[4], v[5], v[6]);
        if !t.is_finite() || !(1e-6..1e6).contains(&q.length()) {
            return Err(FormatError::invalid(path, format!("image {name:?} has no usable pose")));
        }
        let rotation = q.normalize().conjugate();
        images.push(ColmapImage { id, name, camera_id, pose: Pose { rotation, center: -(rotation * t) } });
    }
    Ok(images)
}

/// Coloured points with the images that saw them. Points at a position that is not finite are dropped; their
/// number is the second value.
pub fn read_points(path: &Path) -> Result<(Vec<ColmapPoint>, usize), FormatError> {
    let bytes = read_bounded(path, LIMIT)?;
    let mut r = Bytes::new(path, &bytes);
    let n = r.count(51, "the number of points")?;
    let mut points = Vec::with_capacity(n);
    let mut dropped = 0;
    for _ in 0..n {
        r.u64("a point")?;
        let position = DVec3::new(r.f64("a point")?, r.f64("a point")?, r.f64("a point")?);
        let color = [r.u8("a point")?, r.u8("a point")?, r.u8("a point")?];
        let error = r.f64("a point")?;
        let track = r.count(8, "a point's track length")?;
        let mut images = Vec::with_capacity(track);
        for _ in 0..track {
            images.push(r.u32("a point's track")?);
            r.u32("a point's track")?;
        }
        images.sort_unstable();
        images.dedup();
        if position.is_finite() {
            points.push(ColmapPoint { position, color, error, images });
        } else {
            dropped += 1;
        }
    }
    Ok((points, dropped))
}
