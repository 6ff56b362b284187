//! COLMAP's sparse model, binary and text: OpenCV axes, world-to-camera rotations stored w x y z. Keypoints are skipped,
//! points come one at a time with the images that saw them: a model of any size needs the memory of what is kept of it.

use std::collections::HashMap;
use std::path::{Path, PathBuf};

use super::FormatError;
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
/// The files of a model.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Model {
    folder: PathBuf,
    extension: &'static str,
}

impl Model {
    /// The model that belongs to the data set in `root`: in `sparse/0`, `sparse`, `colmap/sparse/0`, `colmap/sparse` or
    /// `root` itself, binary before text.
    pub fn find(root: &Path) -> Option<Self> {
        PLACES.iter().find_map(|place| {
            let folder = if *place == "." { root.to_owned() } else { root.join(place) };
            let there = |e: &&str| ["cameras", "images"].iter().all(|f| folder.join(f).with_extension(e).is_file());
            let extension = ["bin", "txt"].into_iter().find(there)?;
            Some(Self { folder, extension })
        })
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
        images.sort_by(|a, b| a.name.cmp(&b.name));
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
