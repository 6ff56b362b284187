//! The form in which Mega-NeRF (Turki et al., CVPR 2022) publishes Mill-19 and its poses of UrbanScene3D, from which the papers of
//! large scenes took them: `coordinates.pt`, and in `train` and `val` one file of `metadata` per picture of `rgbs`.
//!
//! Its world has x down, y right and z back, in units of `pose_scale_factor` metres around the middle of the cameras; its cameras
//! have x right, y up and z back (`scripts/colmap_to_mega_nerf.py`, `mega_nerf/ray_utils.py`). Here the world has x right, y ahead
//! and z up, in metres, around the same place.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use geometry::lens::Distortion;
use glam::{DMat3, DQuat, DVec3};

use super::FormatError;
use super::reconstruction::{Focal, LensDescription, Reconstruction, Shot, check_count, picture_size};
use super::torch::{self, Numbers};
use crate::camera::Pose;

/// The file that tells this form from others.
const COORDINATES: &str = "coordinates.pt";
/// What pictures may be called, in the order in which they are looked for.
const EXTENSIONS: [&str; 4] = ["jpg", "JPG", "png", "PNG"];
/// Names in a folder at most; [`check_count`] then says it in pictures.
const MOST_NAMES: usize = 1_000_000;

/// The reconstruction in `root`, with the numbers of the pictures that its authors hold out; `None` where there is none.
///
/// # Errors
/// A file cannot be read, is not what its name says, or says something impossible.
pub fn read(root: &Path) -> Result<Option<(Reconstruction, Vec<usize>)>, FormatError> {
    let coordinates = root.join(COORDINATES);
    if !coordinates.is_file() {
        return Ok(None);
    }
    let metres = match scalar(&torch::read(&coordinates)?, "pose_scale_factor") {
        Some(v) if v > 0.0 && v < 1e6 => v,
        _ => return Err(FormatError::invalid(&coordinates, "its pose_scale_factor is no positive number")),
    };
    // By name: pictures of both lists are numbered in the order in which they were taken.
    let mut files: BTreeMap<String, (PathBuf, bool)> = BTreeMap::new();
    for (list, is_held_out) in [("train", false), ("val", true)] {
        for path in metadata(&root.join(list).join("metadata"))? {
            let name = path.file_stem().map(|s| s.to_string_lossy().into_owned()).unwrap_or_default();
            if files.insert(name.clone(), (path.clone(), is_held_out)).is_some() {
                return Err(FormatError::invalid(&path, "is in train and in val; a picture is in one of them"));
            }
        }
    }
    check_count(&coordinates, files.len() as u64)?;
    let (mut shots, mut held_out) = (Vec::with_capacity(files.len()), Vec::new());
    for (name, (path, is_held_out)) in files {
        if is_held_out {
            held_out.push(shots.len());
        }
        let list = if is_held_out { "val" } else { "train" };
        let bad = |what: &str| FormatError::invalid(&path, what);
        let numbers = torch::read(&path)?;
        let pose = pose(&numbers, metres).ok_or_else(|| bad("its c2w is no pose of 3 x 4 numbers"))?;
        let lens = lens(&numbers).map_err(bad)?;
        let picture = |extension: &str| format!("{list}/rgbs/{name}.{extension}");
        let picture = EXTENSIONS.map(picture).into_iter().find(|p| root.join(p).is_file());
        let picture = picture.unwrap_or_else(|| format!("{list}/rgbs/{name}.{}", EXTENSIONS[0]));
        shots.push(Shot { path: picture, lens, pose, mask: None });
    }
    Ok(Some((Reconstruction { shots, origin: None }, held_out)))
}

/// The files of a folder of metadata; none where it is not there.
fn metadata(folder: &Path) -> Result<Vec<PathBuf>, FormatError> {
    if !folder.is_dir() {
        return Ok(Vec::new());
    }
    let failed = |e| FormatError::io(folder, "listing", e);
    let mut found = Vec::new();
    for entry in std::fs::read_dir(folder).map_err(failed)?.take(MOST_NAMES) {
        let path = entry.map_err(failed)?.path();
        if path.extension().is_some_and(|e| e == "pt") {
            found.push(path);
        }
    }
    Ok(found)
}

fn scalar(numbers: &Numbers, name: &str) -> Option<f64> {
    match numbers.get(name)?[..] {
        [v] => Some(v),
        _ => None,
    }
}

fn pose(numbers: &Numbers, metres: f64) -> Option<Pose> {
    let rows: &[f64; 12] = numbers.get("c2w")?[..].try_into().ok()?;
    let column = |c: usize| to_world(DVec3::new(rows[c], rows[4 + c], rows[8 + c]));
    let [right, up, back, center] = [0, 1, 2, 3].map(column);
    let axes = DMat3::from_cols(right, -up, -back);
    let unit = DMat3::IDENTITY.abs_diff_eq(axes.transpose() * axes, 1e-3) && axes.determinant() > 0.0;
    let pose = Pose { rotation: DQuat::from_mat3(&axes).normalize(), center: metres * center };
    (unit && pose.center.is_finite()).then_some(pose)
}

/// From x down, y right and z back.
fn to_world(v: DVec3) -> DVec3 {
    DVec3::new(v.y, -v.z, -v.x)
}

fn lens(numbers: &Numbers) -> Result<LensDescription, &'static str> {
    let size = scalar(numbers, "W").zip(scalar(numbers, "H")).and_then(|(w, h)| picture_size(w, h));
    let Some(&[fx, fy, cx, cy]) = numbers.get("intrinsics").map(|k| &k[..]) else {
        return Err("its intrinsics are not four numbers");
    };
    // Its `distortion` was taken out of the pictures before they were written.
    let lens = LensDescription {
        size: Some(size.ok_or("its W and H must be between 1 and 65536")?),
        focal: Focal::Pixels(fx, fy),
        principal: Some((cx, cy)),
        distortion: Distortion::default(),
    };
    lens.fault().map_or(Ok(lens), Err)
}
