//! `cameras.bin`, `images.bin`, `points3D.bin`.

use std::collections::HashMap;
use std::path::Path;

use glam::DVec3;

use super::entries::{ColmapImage, ColmapPoint, pose};
use crate::formats::FormatError;
use crate::formats::reconstruction::{CameraModel, LensDescription, check_count, picture_size};
use crate::formats::stream::Stream;

/// Longest parameter list of a camera model that is read.
const MAX_PARAMETERS: usize = 12;

pub(super) fn cameras(path: &Path) -> Result<HashMap<u32, LensDescription>, FormatError> {
    let mut r = Stream::open(path)?;
    let n = r.count(24, "the number of cameras")?;
    check_count(path, n)?;
    let mut cameras = HashMap::new();
    for _ in 0..n {
        let id = r.u32("a camera")?;
        let number = r.u32("a camera")?;
        let (w, h) = (r.u64("a camera")?, r.u64("a camera")?);
        let bad = |what: String| FormatError::invalid(path, format!("camera {id}: {what}"));
        let Some(size) = picture_size(w as f64, h as f64) else {
            return Err(bad(format!("its picture size is {w} x {h}")));
        };
        let Some(model) = CameraModel::numbered(number) else {
            let known = CameraModel::names();
            return Err(bad(format!(
                "COLMAP model number {number} is not supported ({known} are): run colmap image_undistorter"
            )));
        };
        let mut values = [0.0; MAX_PARAMETERS];
        for v in &mut values[..model.parameters.len()] {
            *v = r.f64("a camera")?;
        }
        cameras.insert(id, model.describe(size, &values[..model.parameters.len()]).map_err(bad)?);
    }
    Ok(cameras)
}

pub(super) fn images(path: &Path) -> Result<Vec<ColmapImage>, FormatError> {
    let mut r = Stream::open(path)?;
    let n = r.count(73, "the number of images")?;
    check_count(path, n)?;
    let mut images = Vec::with_capacity(n as usize);
    for _ in 0..n {
        let id = r.u32("an image")?;
        let mut v = [0.0; 7];
        for x in &mut v {
            *x = r.f64("an image")?;
        }
        let camera_id = r.u32("an image")?;
        let name = r.c_str("an image's name")?;
        let keypoints = r.count(24, "an image's number of keypoints")?;
        r.skip(keypoints * 24, "an image's keypoints")?;
        let [w, x, y, z, tx, ty, tz] = v;
        let Some(pose) = pose([w, x, y, z], DVec3::new(tx, ty, tz)) else {
            return Err(FormatError::invalid(path, format!("image {name:?} has no usable pose")));
        };
        images.push(ColmapImage { id, name, camera_id, pose });
    }
    Ok(images)
}

pub(super) fn points(path: &Path, take: &mut dyn FnMut(ColmapPoint)) -> Result<(), FormatError> {
    let mut r = Stream::open(path)?;
    let n = r.count(51, "the number of points")?;
    for _ in 0..n {
        r.u64("a point")?;
        let position = DVec3::new(r.f64("a point")?, r.f64("a point")?, r.f64("a point")?);
        let color = [r.u8("a point")?, r.u8("a point")?, r.u8("a point")?];
        let error = r.f64("a point")?;
        let track = r.count(8, "a point's track length")?;
        let mut images = Vec::with_capacity(track.min(1024) as usize);
        for _ in 0..track {
            images.push(r.u32("a point's track")?);
            r.u32("a point's track")?;
        }
        take(ColmapPoint { position, color, error, images });
    }
    Ok(())
}
