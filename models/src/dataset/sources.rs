//! From a description on disc to frames: the two layouts that data sets come in, and decoding with bounds.

use std::collections::HashMap;
use std::path::Path;

use config::geodesy::Geodetic;
use image::{ImageReader, Limits, RgbImage};

use super::{DatasetError, DatasetFrame};
use crate::camera::{Intrinsics, Pose, View};
use crate::formats::transforms::{Focal, Lens};
use crate::formats::{FormatError, colmap, transforms};

/// Largest picture edge taken; 16384² × 3 bytes is also what the decoder may allocate at most.
const MAX_EDGE: u32 = 16_384;

/// A JPEG or PNG as RGB, refused before decoding when it is too large.
pub fn decode(path: &Path) -> Result<RgbImage, DatasetError> {
    let bad = |what: String| DatasetError::Picture { path: path.to_owned(), what };
    let mut reader = open_picture(path)?;
    let mut limits = Limits::default();
    limits.max_image_width = Some(MAX_EDGE);
    limits.max_image_height = Some(MAX_EDGE);
    limits.max_alloc = Some(u64::from(MAX_EDGE) * u64::from(MAX_EDGE) * 3);
    reader.limits(limits);
    reader.decode().map(|i| i.into_rgb8()).map_err(|e| bad(format!("cannot be decoded ({e}); copy it again")))
}

fn open_picture(path: &Path) -> Result<ImageReader<std::io::BufReader<std::fs::File>>, DatasetError> {
    let bad = |e: std::io::Error| DatasetError::Picture {
        path: path.to_owned(),
        what: format!("cannot be opened ({e}); is the picture folder complete?"),
    };
    ImageReader::open(path).and_then(ImageReader::with_guessed_format).map_err(bad)
}

pub(super) fn file_name(path: &str) -> &str {
    path.rsplit(['/', '\\']).next().unwrap_or(path)
}

fn intrinsics(lens: &Lens, path: &Path) -> Result<Intrinsics, DatasetError> {
    let (width, height) = match lens.size {
        Some(size) => size,
        None => open_picture(path)?
            .into_dimensions()
            .map_err(|e| DatasetError::Picture { path: path.to_owned(), what: format!("cannot be decoded ({e})") })?,
    };
    let (fx, fy) = match lens.focal {
        Focal::Pixels(x, y) => (x, y),
        Focal::FieldOfView(angle) => {
            let f = 0.5 * f64::from(width) / (0.5 * angle).tan();
            (f, f)
        }
    };
    let (cx, cy) = lens.centre.unwrap_or((0.5 * f64::from(width), 0.5 * f64::from(height)));
    Ok(Intrinsics { width, height, fx: fx as f32, fy: fy as f32, cx: cx as f32, cy: cy as f32 })
}

/// Frames and origin of `transforms.json`.
pub(super) fn from_transforms(root: &Path) -> Result<(Vec<DatasetFrame>, Option<Geodetic>), DatasetError> {
    let file = transforms::read(&root.join("transforms.json"))?;
    let listed = file.frames.into_iter().map(|f| (f.file_path, f.lens, f.pose)).collect();
    Ok((frames(root, listed)?, file.origin))
}

/// Frames of `sparse/0`.
pub(super) fn from_colmap(root: &Path) -> Result<Vec<DatasetFrame>, DatasetError> {
    let folder = root.join("sparse/0");
    let cameras = colmap::read_cameras(&folder.join("cameras.bin"))?;
    let path = folder.join("images.bin");
    let mut images = colmap::read_images(&path)?;
    // COLMAP writes them in order of registration; names follow the capture.
    images.sort_by(|a, b| a.name.cmp(&b.name));
    let mut listed = Vec::with_capacity(images.len());
    for image in images {
        let Some(lens) = cameras.get(&image.camera_id) else {
            let what =
                format!("image {:?} refers to camera {}, which cameras.bin does not have", image.name, image.camera_id);
            return Err(FormatError::invalid(&path, what).into());
        };
        listed.push((format!("images/{}", image.name), *lens, image.pose));
    }
    frames(root, listed)
}

fn frames(root: &Path, listed: Vec<(String, Lens, Pose)>) -> Result<Vec<DatasetFrame>, DatasetError> {
    let mut seen = HashMap::new();
    for (path, ..) in &listed {
        *seen.entry(file_name(path).to_owned()).or_insert(0usize) += 1;
    }
    let unique = seen.values().all(|&n| n == 1);
    listed
        .into_iter()
        .map(|(file_path, lens, pose)| {
            let mut path = root.join(&file_path);
            // Blender data sets leave the extension out.
            if path.extension().is_none() {
                path =
                    ["png", "jpg", "jpeg"].iter().map(|e| path.with_extension(e)).find(|p| p.is_file()).unwrap_or(path);
            }
            let full = path.strip_prefix(root).unwrap_or(&path).to_string_lossy().into_owned();
            let name = if unique { file_name(&full).to_owned() } else { full };
            let intrinsics = intrinsics(&lens, &path)?;
            Ok(DatasetFrame {
                name,
                path,
                view: View { intrinsics, pose },
                distortion: lens.distortion,
                telemetry: None,
            })
        })
        .collect()
}
