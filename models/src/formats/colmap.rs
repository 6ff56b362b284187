//! COLMAP's sparse model, binary and text: OpenCV axes, world-to-camera rotations stored w x y z. Keypoints are skipped,
//! points come one at a time with the images that saw them: a model of any size needs the memory of what is kept of it.

use std::collections::HashMap;
use std::path::{Path, PathBuf};

use super::FormatError;
use super::natural;
use super::reconstruction::{LensDescription, Reconstruction, Shot};

mod binary;
mod entries;
mod origin;
mod text;
mod write;

pub use entries::{ColmapImage, ColmapPoint};
pub use write::{Point, write};

/// Where a model lies below the folder of a data set, the usual place first.
const PLACES: [&str; 5] = ["sparse/0", "sparse", "colmap/sparse/0", "colmap/sparse", "."];
/// Most folders examined beside a numbered model.
const MOST_MODELS: usize = 4096;

/// The files of a model.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Model {
    folder: PathBuf,
    extension: &'static str,
}

impl Model {
    /// The model that belongs to the data set in `root`: in `sparse/0`, `sparse`, `colmap/sparse/0`, `colmap/sparse` or
    /// `root` itself, binary before text. Where COLMAP left several (`sparse/0`, `sparse/1`, …), that of the most images.
    ///
    /// # Errors
    /// What lies there is a part of a model only, or none of several can be read.
    pub fn find(root: &Path) -> Result<Option<Self>, FormatError> {
        let mut broken = None;
        for place in PLACES {
            let folder = if place == "." { root.to_owned() } else { root.join(place) };
            match Self::at(&folder) {
                Ok(Some(first)) => return first.largest_beside(),
                Ok(None) => {}
                // Another of them may be whole.
                Err(e) => {
                    match folder.file_name().is_some_and(|name| name == "0").then(|| Self::beside(&folder)).flatten() {
                        Some(model) => return model.largest_beside(),
                        None => broken = broken.or(Some(e)),
                    }
                }
            }
        }
        broken.map_or(Ok(None), Err)
    }

    /// The model in `folder`.
    fn at(folder: &Path) -> Result<Option<Self>, FormatError> {
        let there = |name: &str, e: &str| folder.join(name).with_extension(e).is_file();
        let both = |e: &&str| ["cameras", "images"].iter().all(|name| there(name, e));
        if let Some(extension) = ["bin", "txt"].into_iter().find(both) {
            return Ok(Some(Self { folder: folder.to_owned(), extension }));
        }
        // In the folder itself a file of such a name may be anybody's.
        if !folder.ancestors().take(2).any(|f| f.file_name().is_some_and(|name| name == "sparse")) {
            return Ok(None);
        }
        let parts = ["cameras", "images", "points3D"].iter().flat_map(|name| [("bin", *name), ("txt", *name)]);
        let found: Vec<String> =
            parts.filter(|(e, name)| there(name, e)).map(|(e, name)| format!("{name}.{e}")).collect();
        match found.is_empty() {
            true => Ok(None),
            false => Err(FormatError::invalid(
                folder,
                format!("a COLMAP model needs cameras and images, binary or text; only {} is there", found.join(", ")),
            )),
        }
    }

    /// Whole models in the folders beside `folder` that COLMAP numbers.
    fn siblings(folder: &Path) -> Vec<Self> {
        let entries = folder.parent().and_then(|above| std::fs::read_dir(above).ok()).into_iter().flatten().flatten();
        let is_number =
            |path: &PathBuf| path.file_name().and_then(|n| n.to_str()).is_some_and(|n| n.parse::<u32>().is_ok());
        let mut folders: Vec<PathBuf> = entries.take(MOST_MODELS).map(|e| e.path()).filter(is_number).collect();
        folders.sort();
        folders.iter().filter_map(|folder| Self::at(folder).ok().flatten()).collect()
    }

    fn beside(folder: &Path) -> Option<Self> {
        Self::siblings(folder).into_iter().next()
    }

    /// The one of the most images of those that lie beside it; itself, where it is the only one.
    fn largest_beside(self) -> Result<Option<Self>, FormatError> {
        if self.folder.file_name().and_then(|n| n.to_str()).is_none_or(|n| n.parse::<u32>().is_err()) {
            return Ok(Some(self));
        }
        let all = Self::siblings(&self.folder);
        if all.len() < 2 {
            return Ok(Some(self));
        }
        let counted = all.into_iter().map(|model| (model.images().map(|images| images.len()), model));
        let (whole, broken): (Vec<_>, Vec<_>) = counted.partition(|(count, _)| count.is_ok());
        let largest = whole.into_iter().rev().max_by_key(|(count, _)| count.as_ref().map_or(0, |n| *n));
        match (largest, broken.into_iter().next()) {
            (Some((_, model)), _) => Ok(Some(model)),
            (None, Some((Err(e), _))) => Err(e),
            (None, _) => Ok(Some(self)),
        }
    }

    /// One line where others lie beside it, whole or not.
    pub fn said(&self) -> Option<String> {
        let others: Vec<Self> = Self::siblings(&self.folder).into_iter().filter(|m| m.folder != self.folder).collect();
        let of = |model: &Self| match model.images() {
            Ok(images) => format!("{} of {} images", model.folder.display(), images.len()),
            Err(e) => format!("{e}"),
        };
        let other: Vec<String> = others.iter().map(of).collect();
        (!other.is_empty()).then(|| format!("{} is taken, the largest; not used: {}", of(self), other.join(", ")))
    }

    /// One of its files: `cameras`, `images` or `points3D`.
    pub fn file(&self, name: &str) -> PathBuf {
        self.folder.join(name).with_extension(self.extension)
    }

    /// Lenses by camera number.
    ///
    /// # Errors
    /// The file cannot be read, is damaged, or holds a camera model that is not supported.
    pub fn cameras(&self) -> Result<HashMap<u32, LensDescription>, FormatError> {
        read_cameras(&self.file("cameras"))
    }

    /// Registered images in file order.
    ///
    /// # Errors
    /// The file cannot be read or is damaged.
    pub fn images(&self) -> Result<Vec<ColmapImage>, FormatError> {
        read_images(&self.file("images"))
    }

    /// Gives every point at a finite position to `take`, in file order; returns how many were not at one. None when the
    /// model has no file of points.
    ///
    /// # Errors
    /// The file cannot be read or is damaged.
    pub fn points(&self, take: &mut dyn FnMut(ColmapPoint)) -> Result<u64, FormatError> {
        let path = self.file("points3D");
        if path.is_file() { read_points(&path, take) } else { Ok(0) }
    }

    /// Poses and lenses, sorted by name: COLMAP writes images in order of registration, names follow the capture.
    ///
    /// # Errors
    /// As [`Model::cameras`] and [`Model::images`]; an image refers to a camera that is not there.
    pub fn read(&self) -> Result<Reconstruction, FormatError> {
        let cameras = self.cameras()?;
        let mut images = self.images()?;
        images.sort_by(|a, b| natural(&a.name, &b.name));
        let mut shots = Vec::with_capacity(images.len());
        for image in images {
            let Some(lens) = cameras.get(&image.camera_id) else {
                let what = format!(
                    "image {:?} refers to camera {}, which {} does not have",
                    image.name,
                    image.camera_id,
                    self.file("cameras").display()
                );
                return Err(FormatError::invalid(&self.file("images"), what));
            };
            shots.push(Shot { path: image.name, lens: *lens, pose: image.pose, mask: None });
        }
        Ok(Reconstruction { shots, origin: origin::read(&self.folder)? })
    }
}

/// Lenses of `cameras.bin` or `cameras.txt`.
///
/// # Errors
/// See [`Model::cameras`].
pub fn read_cameras(path: &Path) -> Result<HashMap<u32, LensDescription>, FormatError> {
    if is_text(path) { text::cameras(path) } else { binary::cameras(path) }
}

/// Images of `images.bin` or `images.txt`.
///
/// # Errors
/// See [`Model::images`].
pub fn read_images(path: &Path) -> Result<Vec<ColmapImage>, FormatError> {
    if is_text(path) { text::images(path) } else { binary::images(path) }
}

/// Points of `points3D.bin` or `points3D.txt`, one by one; returns how many were left out.
///
/// # Errors
/// See [`Model::points`].
pub fn read_points(path: &Path, take: &mut dyn FnMut(ColmapPoint)) -> Result<u64, FormatError> {
    finite(take, |finite| if is_text(path) { text::points(path, finite) } else { binary::points(path, finite) })
}

fn is_text(path: &Path) -> bool {
    path.extension().is_some_and(|e| e == "txt")
}

/// Passes on points at finite positions, their images sorted and each once; counts the others.
fn finite(
    take: &mut dyn FnMut(ColmapPoint),
    read: impl FnOnce(&mut dyn FnMut(ColmapPoint)) -> Result<(), FormatError>,
) -> Result<u64, FormatError> {
    let mut dropped = 0;
    read(&mut |mut point| {
        if !point.position.is_finite() {
            dropped += 1;
            return;
        }
        point.images.sort_unstable();
        point.images.dedup();
        take(point);
    })?;
    Ok(dropped)
}
