//! Masks of a data set's pictures: found by their names, checked when the set is opened, brought into the picture that is
//! learnt from.

use std::collections::HashMap;
use std::path::{Path, PathBuf};

use geometry::lens::Lens;
use rayon::prelude::*;

use super::{Dataset, DatasetError, DatasetFrame};
use crate::card::name_list;
use models::camera::Intrinsics;
use models::mask::{CORNERS, Mask};
use models::picture::PictureError;

/// Names read in one folder of masks; no survey has more pictures.
const MAX_FILES: usize = 200_000;
const FOLDER: &str = "masks";
const EXTENSIONS: [&str; 6] = [".png", ".jpg", ".jpeg", ".jpe", ".tif", ".tiff"];
/// A mask may be smaller or larger than its picture, not of another shape.
const SHAPE: f64 = 0.01;

/// What a folder holds, by its lower-case name.
type Listed = HashMap<String, PathBuf>;

/// Masks beside pictures; every folder is listed once.
#[derive(Default)]
struct Finder {
    listed: HashMap<PathBuf, Listed>,
}

impl Finder {
    /// `masks/NAME.jpg.png` (COLMAP), `NAME_mask.*` (OpenDroneMap) or `masks/NAME.*`, in the picture's own folder, the folder
    /// `masks` in it, or that beside it.
    fn of(&mut self, picture: &Path) -> Option<PathBuf> {
        let (folder, name) = (picture.parent()?, picture.file_name()?.to_string_lossy().to_lowercase());
        let stem = name.rsplit_once('.').map_or(name.as_str(), |(stem, _)| stem);
        let marked = format!("{stem}_mask");
        if let Some(found) = self.in_folder(folder, &[&marked]) {
            return Some(found);
        }
        let names = [name.as_str(), &marked, stem];
        let mut folders = vec![folder.join(FOLDER)];
        if let (Some(above), Some(own)) = (folder.parent(), folder.file_name()) {
            folders.push(above.join(FOLDER).join(own));
            // Names repeat in a card's folders, so that those above speak of one folder of pictures only.
            if own.eq_ignore_ascii_case("images") {
                folders.push(above.join(FOLDER));
            }
        }
        folders.iter().find_map(|folder| self.in_folder(folder, &names))
    }

    fn in_folder(&mut self, folder: &Path, names: &[&str]) -> Option<PathBuf> {
        let list = || -> Listed {
            let entries = std::fs::read_dir(folder).into_iter().flatten().flatten().take(MAX_FILES);
            let named = |path: PathBuf| Some((path.file_name()?.to_string_lossy().to_lowercase(), path));
            let files = entries.filter(|e| !e.file_type().is_ok_and(|t| t.is_dir())).filter_map(|e| named(e.path()));
            let mut files: Vec<_> = files.filter(|(name, _)| EXTENSIONS.iter().any(|e| name.ends_with(e))).collect();
            // Where two differ in case alone the first is the one, in whatever order the system lists them.
            files.sort_by(|a, b| b.1.cmp(&a.1));
            files.into_iter().collect()
        };
        if !self.listed.contains_key(folder) {
            self.listed.insert(folder.to_owned(), list());
        }
        let listed = self.listed.get(folder)?;
        names.iter().find_map(|name| EXTENSIONS.iter().find_map(|e| listed.get(&format!("{name}{e}")).cloned()))
    }
}

/// Finds the masks that the description does not name, and leaves out pictures of which a mask keeps nothing.
pub(super) fn find(set: &mut Dataset) -> Result<(), DatasetError> {
    let mut finder = Finder::default();
    for frame in &mut set.frames {
        frame.mask = frame.mask.take().or_else(|| finder.of(&frame.path));
    }
    let masked: Vec<&DatasetFrame> = set.frames.iter().filter(|f| f.mask.is_some()).collect();
    let judged: Vec<(&str, bool)> = masked
        .par_iter()
        .map(|frame| Ok((frame.name.as_str(), frame.stored_mask()?.is_some_and(|mask| mask.count() == 0))))
        .collect::<Result<_, PictureError>>()?;
    let black: Vec<String> = judged.iter().filter(|(_, black)| *black).map(|(name, _)| (*name).to_owned()).collect();
    if !judged.is_empty() {
        tracing::info!("{}: {} of {} pictures have masks", set.root.display(), judged.len(), set.frames.len());
    }
    if !black.is_empty() {
        tracing::warn!("{}: the mask is black all over; left out", name_list(&black));
        retain(set, |frame| !black.contains(&frame.name));
    }
    match set.frames.is_empty() {
        true => Err(DatasetError::Request(format!("{}: every picture's mask is black", set.root.display()))),
        false => Ok(()),
    }
}

/// Keeps the frames for which `keep` says so, in order, and their numbers in the lists.
pub(super) fn retain(set: &mut Dataset, mut keep: impl FnMut(&DatasetFrame) -> bool) {
    let mut number = vec![None; set.frames.len()];
    let (mut i, mut kept) = (0, 0);
    set.frames.retain(|frame| {
        let stays = keep(frame);
        number[i] = stays.then_some(kept);
        (i, kept) = (i + 1, kept + usize::from(stays));
        stays
    });
    let regions = set.split.regions.iter_mut().flat_map(|r| r.lists.values_mut());
    for list in set.split.lists.values_mut().chain(regions) {
        *list = list.iter().filter_map(|i| number[*i]).collect();
    }
}

impl DatasetFrame {
    /// The mask as its file has it.
    fn stored_mask(&self) -> Result<Option<Mask>, PictureError> {
        let Some(path) = &self.mask else { return Ok(None) };
        let mask = Mask::read(path)?;
        let (w, h) = mask.dimensions();
        let full = &self.view.intrinsics;
        let (width, height) =
            if self.orientation.swaps() { (full.height, full.width) } else { (full.width, full.height) };
        let shape = f64::from(w) * f64::from(height) / (f64::from(h) * f64::from(width));
        if (shape - 1.0).abs() > SHAPE {
            let what = format!("is {w} x {h}, its picture {width} x {height}; make the mask of the picture's shape");
            return Err(PictureError { path: path.clone(), what });
        }
        Ok(Some(mask))
    }

    /// The mask of the picture as it is loaded at the size of `lens`: turned, undistorted and scaled with it. Where no file is its mask,
    /// what is `opaque` of the picture.
    pub(super) fn mask_at(&self, lens: &Intrinsics, opaque: Option<Mask>) -> Result<Option<Mask>, PictureError> {
        let Some(stored) = self.stored_mask()?.or(opaque) else { return Ok(None) };
        let full = &self.view.intrinsics;
        let bent = Lens {
            focal: [full.fx.into(), full.fy.into()],
            principal: [full.cx.into(), full.cy.into()],
            distortion: self.distortion,
        };
        let size = [f64::from(full.width), f64::from(full.height)];
        let keeps = |u: f64, v: f64| {
            let mut place = [u, v];
            if !self.distortion.is_none() {
                let ray = [
                    (u * size[0] - bent.principal[0]) / bent.focal[0],
                    (v * size[1] - bent.principal[1]) / bent.focal[1],
                    1.0,
                ];
                let Some(seen) = bent.project(ray) else { return false };
                place = [seen[0] / size[0], seen[1] / size[1]];
            }
            stored.keeps_at(self.orientation.stored_place(place))
        };
        let (w, h) = (f64::from(lens.width), f64::from(lens.height));
        Ok(Some(Mask::from_fn(lens.width, lens.height, |x, y| {
            CORNERS.iter().all(|[a, b]| keeps((f64::from(x) + a) / w, (f64::from(y) + b) / h))
        })))
    }
}
