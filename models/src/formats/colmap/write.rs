//! Writes a binary model, so that other programs can start from our poses.

use std::path::Path;

use super::origin;
use crate::formats::reconstruction::{CameraModel, Reconstruction};
use crate::formats::{FormatError, write_atomic};

/// A coloured point without a track.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Point {
    /// World position.
    pub position: [f64; 3],
    /// 8-bit sRGB.
    pub color: [u8; 3],
}

/// Writes `cameras.bin`, `images.bin` and `points3D.bin` into `folder`, and the origin beside them when there is one.
/// Every distinct lens becomes one camera; there are no keypoints.
///
/// # Errors
/// The folder cannot be written to, a lens has no size, COLMAP has no camera model for it, or a name holds the character that ends one.
pub fn write(folder: &Path, reconstruction: &Reconstruction, points: &[Point]) -> Result<(), FormatError> {
    let mut cameras: Vec<((u32, u32), &'static CameraModel, Vec<f64>)> = Vec::new();
    let mut camera_of = Vec::with_capacity(reconstruction.shots.len());
    for shot in &reconstruction.shots {
        let bad = |what: String| FormatError::invalid(folder, format!("{}: {what}", shot.path));
        if shot.path.contains('\0') {
            return Err(bad("a name for COLMAP holds no zero character".to_owned()));
        }
        let size = shot.lens.size.ok_or_else(|| bad("its size is not known".to_owned()))?;
        let (model, values) = CameraModel::holding(&shot.lens.lens(size)).map_err(bad)?;
        let same = |c: &((u32, u32), &CameraModel, Vec<f64>)| c.0 == size && c.1.id == model.id && c.2 == values;
        let number = cameras.iter().position(same).unwrap_or_else(|| {
            cameras.push((size, model, values.clone()));
            cameras.len() - 1
        });
        camera_of.push(number as u32 + 1);
    }
    write_atomic(&folder.join("cameras.bin"), |w| {
        w.write_all(&(cameras.len() as u64).to_le_bytes())?;
        for (i, ((width, height), model, values)) in cameras.iter().enumerate() {
            w.write_all(&(i as u32 + 1).to_le_bytes())?;
            w.write_all(&model.id.to_le_bytes())?;
            w.write_all(&u64::from(*width).to_le_bytes())?;
            w.write_all(&u64::from(*height).to_le_bytes())?;
            values.iter().try_for_each(|v| w.write_all(&v.to_le_bytes()))?;
        }
        Ok(())
    })?;
    write_atomic(&folder.join("images.bin"), |w| {
        w.write_all(&(reconstruction.shots.len() as u64).to_le_bytes())?;
        for (i, (shot, camera)) in reconstruction.shots.iter().zip(&camera_of).enumerate() {
            let r = shot.pose.rotation.conjugate();
            let t = -(r * shot.pose.center);
            w.write_all(&(i as u32 + 1).to_le_bytes())?;
            [r.w, r.x, r.y, r.z, t.x, t.y, t.z].iter().try_for_each(|v| w.write_all(&v.to_le_bytes()))?;
            w.write_all(&camera.to_le_bytes())?;
            w.write_all(shot.path.as_bytes())?;
            w.write_all(&[0])?;
            w.write_all(&0u64.to_le_bytes())?;
        }
        Ok(())
    })?;
    write_atomic(&folder.join("points3D.bin"), |w| {
        w.write_all(&(points.len() as u64).to_le_bytes())?;
        for (i, p) in points.iter().enumerate() {
            w.write_all(&(i as u64 + 1).to_le_bytes())?;
            p.position.iter().try_for_each(|v| w.write_all(&v.to_le_bytes()))?;
            w.write_all(&p.color)?;
            w.write_all(&0f64.to_le_bytes())?;
            w.write_all(&0u64.to_le_bytes())?;
        }
        Ok(())
    })?;
    reconstruction.origin.map_or(Ok(()), |o| origin::write(folder, o))
}
