//! From a description on disc to frames: the layouts that data sets come in.

use std::collections::{HashMap, HashSet};
use std::path::{Path, PathBuf};

use super::error::DatasetError;
use super::frame::DatasetFrame;
use crate::names::composed;
use crate::projects;
use models::camera::View;
use models::formats::reconstruction::Reconstruction;
use models::formats::{colmap, mega_nerf, opensfm, transforms};
use models::picture::{Orientation, dimensions};

/// nerfstudio's description.
pub(super) const TRANSFORMS: &str = "transforms.json";
/// Most names read in one folder of pictures.
const MOST_NAMES: usize = 200_000;

pub(super) fn file_name(path: &str) -> &str {
    path.rsplit(['/', '\\']).next().unwrap_or(path)
}

/// A description, and the numbers of the pictures that it holds out, where it says so.
pub(super) type Described = (Reconstruction, Option<Vec<usize>>);

/// The description in `root`: nerfstudio's, COLMAP's, Mega-NeRF's, OpenSfM's, another program's project; `None` where there is none.
pub(super) fn reconstruction(root: &Path) -> Result<Option<Described>, DatasetError> {
    let file = root.join(TRANSFORMS);
    if file.is_file() {
        return Ok(Some((transforms::read(&file)?, None)));
    }
    if let Some(found) = lists(root)? {
        return Ok(Some(found));
    }
    if let Some(model) = colmap::Model::find(root)? {
        if let Some(line) = model.said() {
            tracing::warn!("{line}");
        }
        return Ok(Some((model.read()?, None)));
    }
    if let Some((found, held_out)) = mega_nerf::read(root)? {
        return Ok(Some((found, Some(held_out))));
    }
    if let Some(file) = opensfm::find(root) {
        return Ok(Some((opensfm::read(&file)?, None)));
    }
    let mut places = Places::default();
    let mut size_of = |name: &str| dimensions(&places.locate(root, name)).ok();
    Ok(projects::find(root, &mut size_of)?.map(|found| (found, None)))
}

/// Blender's form: a file for each list of pictures. What is for choosing between models (`val`) is neither trained on nor held out.
fn lists(root: &Path) -> Result<Option<Described>, DatasetError> {
    let of = |list: &str| root.join(format!("transforms_{list}.json"));
    if !of("train").is_file() {
        return Ok(None);
    }
    let mut found = transforms::read(&of("train"))?;
    let first = found.shots.len();
    if let Some(held_out) = ["test", "val"].into_iter().map(of).find(|file| file.is_file()) {
        let mut names: HashSet<String> = found.shots.iter().map(|shot| shot.path.clone()).collect();
        let others = transforms::read(&held_out)?.shots.into_iter().filter(|shot| names.insert(shot.path.clone()));
        found.shots.extend(others);
    }
    let held_out = (first..found.shots.len()).collect();
    Ok(Some((found, Some(held_out))))
}

/// Where pictures lie, each folder listed once where a name is not found as it is written.
#[derive(Default)]
struct Places {
    listed: HashMap<PathBuf, HashMap<String, PathBuf>>,
}

impl Places {
    /// Where the picture that a description calls `name` lies: as written, or in the folder of pictures, without regard to capitals and
    /// to how accents are written; Blender data sets leave the extension out.
    fn locate(&mut self, root: &Path, name: &str) -> PathBuf {
        let name = name.replace('\\', "/");
        let places = [root.join(&name), root.join("images").join(&name), root.join("images").join(file_name(&name))];
        let there = |path: &PathBuf| {
            let with = |extension: &str| {
                let mut whole = path.as_os_str().to_owned();
                whole.push(extension);
                PathBuf::from(whole)
            };
            ["", ".png", ".jpg", ".jpeg", ".JPG", ".JPEG", ".PNG", ".tif", ".TIF", ".webp"]
                .iter()
                .map(|e| with(e))
                .find(|p| p.is_file())
        };
        let found = places.iter().find_map(there);
        found.or_else(|| places.iter().find_map(|path| self.alike(path))).unwrap_or_else(|| places[0].clone())
    }

    fn alike(&mut self, path: &Path) -> Option<PathBuf> {
        let folder = path.parent()?;
        let key = |name: &str| composed(name).to_lowercase();
        let list = || {
            let entries = std::fs::read_dir(folder).into_iter().flatten().flatten().take(MOST_NAMES);
            entries.map(|e| (key(&e.file_name().to_string_lossy()), e.path())).collect()
        };
        let listed = self.listed.entry(folder.to_owned()).or_insert_with(list);
        listed.get(&key(&path.file_name()?.to_string_lossy())).cloned()
    }
}

pub(super) fn frames(root: &Path, found: Reconstruction) -> Result<Vec<DatasetFrame>, DatasetError> {
    let mut seen = HashMap::new();
    for shot in &found.shots {
        *seen.entry(file_name(&shot.path).to_owned()).or_insert(0usize) += 1;
    }
    let unique = seen.values().all(|&n| n == 1);
    let mut places = Places::default();
    found
        .shots
        .into_iter()
        .map(|shot| {
            let path = places.locate(root, &shot.path);
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
            Ok(DatasetFrame {
                name,
                path,
                view,
                distortion,
                orientation,
                mask,
                values: None,
                prior: None,
                telemetry: None,
            })
        })
        .collect()
}
