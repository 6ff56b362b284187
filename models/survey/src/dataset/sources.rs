//! From a description on disc to frames: the layouts that data sets come in.

use std::collections::HashMap;
use std::path::{Path, PathBuf};

use super::error::DatasetError;
use super::frame::DatasetFrame;
use models::camera::View;
use models::formats::reconstruction::Reconstruction;
use models::formats::{colmap, mega_nerf, opensfm, transforms};
use models::picture::{Orientation, dimensions};

pub(super) fn file_name(path: &str) -> &str {
    path.rsplit(['/', '\\']).next().unwrap_or(path)
}

/// A description, and the numbers of the pictures that it holds out, where it says so.
pub(super) type Described = (Reconstruction, Option<Vec<usize>>);

/// The description in `root`: nerfstudio's, COLMAP's, Mega-NeRF's, OpenSfM's; `None` where there is none.
pub(super) fn reconstruction(root: &Path) -> Result<Option<Described>, DatasetError> {
    let file = root.join("transforms.json");
    if file.is_file() {
        return Ok(Some((transforms::read(&file)?, None)));
    }
    if let Some(model) = colmap::Model::find(root) {
        return Ok(Some((model.read()?, None)));
    }
    if let Some((found, held_out)) = mega_nerf::read(root)? {
        return Ok(Some((found, Some(held_out))));
    }
    Ok(opensfm::find(root).map(|file| opensfm::read(&file)).transpose()?.map(|found| (found, None)))
}

/// Where the picture that a description calls `name` lies: as written, or in the folder of pictures; Blender data sets
/// leave the extension out.
fn locate(root: &Path, name: &str) -> PathBuf {
    let places = [root.join(name), root.join("images").join(name), root.join("images").join(file_name(name))];
    let there = |path: &PathBuf| match path.extension() {
        Some(_) => path.is_file().then(|| path.clone()),
        None => ["png", "jpg", "jpeg"].iter().map(|e| path.with_extension(e)).find(|p| p.is_file()),
    };
    places.iter().find_map(there).unwrap_or_else(|| places[0].clone())
}

pub(super) fn frames(root: &Path, found: Reconstruction) -> Result<Vec<DatasetFrame>, DatasetError> {
    let mut seen = HashMap::new();
    for shot in &found.shots {
        *seen.entry(file_name(&shot.path).to_owned()).or_insert(0usize) += 1;
    }
    let unique = seen.values().all(|&n| n == 1);
    found
        .shots
        .into_iter()
        .map(|shot| {
            let path = locate(root, &shot.path);
            let full = path.strip_prefix(root).unwrap_or(&path).to_string_lossy().into_owned();
            let name = if unique { file_name(&full).to_owned() } else { full };
            let size = match shot.lens.size {
                Some(size) => size,
                None => dimensions(&path)?,
            };
            let view = View { intrinsics: shot.lens.intrinsics(size), pose: shot.pose };
            // The programs that write reconstructions do not obey orientation tags; their lenses are of the stored picture.
            let orientation = Orientation::default();
            let distortion = shot.lens.distortion;
            let mask = shot.mask.map(|mask| root.join(mask));
            Ok(DatasetFrame { name, path, view, distortion, orientation, mask, prior: None, telemetry: None })
        })
        .collect()
}
