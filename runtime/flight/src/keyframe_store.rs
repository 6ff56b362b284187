//! Key frames on disk: what a restarted flight continues from, and a data set that `dgtr train` reads as it is.
//!
//! A folder of the camera's own files and one `transforms.json` (nerfstudio), with what only this project needs in a
//! `dgtr` object per frame. Pictures are durable before the list that names them, and the list before stays as the older of two
//! generations. What is damaged all the same is set aside and named; the rest is used.

use std::path::{Path, PathBuf};

use config::error::{Error, ErrorKind};
use config::mission::CameraSettings;
use disk::plan::picture_bytes;
use disk::{Damaged, Disk, previous};
use geometry::geodesy::Geodetic;
use hal::camera::{Picture, is_complete};
use hal::error::HalError;
use image::RgbImage;
use models::camera::{Intrinsics, Pose, PosedImage, View};
use models::formats::{FormatError, transforms};
use models::picture;

mod list;

use list::{Entry, Extra, List, name, read_list};

/// Fewer key frames than this are never thinned out: too little to build from.
const MIN_KEPT: usize = 8;

/// What a full disk costs first, in this order; after it key frames are no longer kept.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Relief {
    /// The older of the two generations of checkpoint and list.
    OldCheckpoints,
    /// Pictures whose neighbours show the same ground.
    CoveredPictures,
}

impl Relief {
    /// The ladder.
    pub const LADDER: [Self; 2] = [Self::OldCheckpoints, Self::CoveredPictures];

    /// In words, for messages.
    pub fn name(self) -> &'static str {
        match self {
            Self::OldCheckpoints => "the older checkpoints",
            Self::CoveredPictures => "pictures of ground that others cover",
        }
    }
}

/// Why a stored key frame could not be used.
#[derive(Debug, thiserror::Error)]
pub enum StoreError {
    /// A file could not be read or written.
    #[error(transparent)]
    File(#[from] FormatError),
    /// The camera's file of a key frame cannot be read.
    #[error(transparent)]
    Camera(HalError),
    /// The stored ones are of another camera, or a picture is not what the list says.
    #[error("key frame {}: {what}", path.display())]
    Picture {
        /// The picture.
        path: PathBuf,
        /// What is wrong, and how to mend it.
        what: String,
    },
}

impl Error for StoreError {
    fn kind(&self) -> ErrorKind {
        match self {
            Self::File(e) => e.kind(),
            Self::Camera(e) => e.kind(),
            Self::Picture { .. } => ErrorKind::Input,
        }
    }
}

impl StoreError {
    /// Whether room or a medium that comes back may mend it.
    pub fn may_pass(&self) -> bool {
        matches!(self, Self::File(e) if e.may_pass())
    }
}

/// A key frame on its way from the camera.
#[derive(Clone, Debug)]
pub struct KeyFrame {
    /// Its pixels and pose, as they are trained on.
    pub posed: PosedImage,
    /// The picture as the camera gave it, to be kept.
    pub file: Picture,
}

/// The key frames of one flight.
pub struct KeyframeStore {
    disk: Disk,
    folder: PathBuf,
    camera: CameraSettings,
    /// The pictures as they are trained on.
    lens: Intrinsics,
    list: List,
}

impl KeyframeStore {
    /// Opens the store in `folder`, or starts one there. A list that cannot be read is set aside, named in a warning, and the
    /// generation before it is used.
    ///
    /// # Errors
    /// A list of another camera; a damaged one that cannot be set aside.
    pub fn open(
        disk: &Disk,
        folder: &Path,
        camera: &CameraSettings,
        lens: &Intrinsics,
        origin: Geodetic,
    ) -> Result<Self, StoreError> {
        let path = folder.join(list::FILE);
        let mut list = List::new(camera, origin);
        disk.sweep(folder);
        disk.sweep(&folder.join("images"));
        let aside = |e| FormatError::Io { path: path.clone(), action: "setting aside", source: e };
        let newest = disk.newest(&path, read_list).map_err(aside)?;
        newest.damaged.iter().for_each(|d| tracing::warn!("{d}"));
        if let Some(old) = newest.found {
            if (old.w, old.h) != (list.w, list.h) {
                let what = format!(
                    "holds pictures of {}×{}, the mission says {}×{}; give another --out",
                    old.w, old.h, list.w, list.h
                );
                return Err(StoreError::Picture { path, what });
            }
            list.frames = old.frames;
        }
        Ok(Self { disk: disk.clone(), folder: folder.into(), camera: *camera, lens: *lens, list })
    }

    /// Number of stored key frames.
    pub fn len(&self) -> usize {
        self.list.frames.len()
    }

    /// True when nothing is stored yet.
    pub fn is_empty(&self) -> bool {
        self.list.frames.is_empty()
    }

    /// Stores one more key frame; a picture of the same name is replaced.
    ///
    /// # Errors
    /// When the disk is full or not writable, or the camera's file is gone; what is stored stays as it was.
    pub fn add(&mut self, frame: &KeyFrame) -> Result<(), StoreError> {
        let file_path = format!("images/{}", frame.posed.name);
        let path = self.folder.join(&file_path);
        let limit = picture_bytes(self.camera.width, self.camera.height);
        let bytes = frame.file.to_file(limit).map_err(StoreError::Camera)?;
        self.disk.replace(&path, |out| out.write_all(&bytes)).map_err(|e| FormatError::disk(&path, e))?;
        let transform_matrix = transforms::pose_to_opengl(&frame.posed.view.pose);
        let entry = Entry { file_path, transform_matrix, dgtr: Extra::new(&frame.posed) };
        let at = self.list.frames.iter().position(|f| f.file_path == entry.file_path);
        let replaced = at.map(|at| self.list.frames.remove(at));
        self.list.frames.push(entry);
        if let Err(e) = self.save() {
            self.list.frames.pop();
            self.list.frames.extend(replaced);
            return Err(e);
        }
        Ok(())
    }

    /// Writes refined poses into the list that other programs read; the poses as captured stay beside them.
    ///
    /// # Errors
    /// As [`KeyframeStore::add`].
    pub fn refine(&mut self, mut pose: impl FnMut(&str) -> Option<Pose>) -> Result<(), StoreError> {
        for entry in &mut self.list.frames {
            if let Some(p) = pose(&name(&entry.file_path)) {
                entry.transform_matrix = transforms::pose_to_opengl(&p);
            }
        }
        self.save()
    }

    /// Names of all key frames.
    pub fn names(&self) -> impl Iterator<Item = String> + '_ {
        self.list.frames.iter().map(|f| name(&f.file_path))
    }

    /// Poses of all key frames, as captured.
    pub fn poses(&self) -> Vec<Pose> {
        self.list.frames.iter().map(|f| f.dgtr.pose).collect()
    }

    /// Reads key frame `i` with its pose as captured.
    ///
    /// # Errors
    /// A picture that is missing, damaged or of another size.
    pub fn load(&self, i: usize) -> Result<PosedImage, StoreError> {
        let entry = &self.list.frames[i];
        let image = self.picture(entry)?;
        Ok(PosedImage {
            name: name(&entry.file_path),
            time_ns: entry.dgtr.time_ns,
            image: picture::resized(image, (self.lens.width, self.lens.height)),
            view: View { intrinsics: self.lens, pose: entry.dgtr.pose },
            mask: None,
            sigma: entry.dgtr.sigma(),
        })
    }

    /// The undistorted picture, read to its end: a decoder makes grey of what is missing.
    fn picture(&self, entry: &Entry) -> Result<RgbImage, StoreError> {
        let path = self.folder.join(&entry.file_path);
        let wrong = |why: String| StoreError::Camera(HalError::Picture { path: path.clone(), why });
        if !is_complete(&path).map_err(|e| wrong(e.to_string()))? {
            return Err(wrong("is cut off (its end marker is missing)".into()));
        }
        Picture::Path(path.clone()).load(&self.camera).map_err(StoreError::Camera)
    }

    /// Width and height of the pictures as the camera gives them.
    pub fn camera_size(&self) -> (u32, u32) {
        (self.camera.width, self.camera.height)
    }

    /// The picture of key frame `name` at `scale` of the camera's size; `None` when it is not kept.
    ///
    /// # Errors
    /// A picture that is missing, damaged or of another size.
    pub fn whole(&self, name: &str, scale: f64) -> Result<Option<RgbImage>, StoreError> {
        let Some(entry) = self.list.frames.iter().find(|f| list::name(&f.file_path) == name) else { return Ok(None) };
        let image = self.picture(entry)?;
        let edge = |side: u32| ((f64::from(side) * scale).round() as u32).max(1);
        Ok(Some(picture::resized(image, (edge(self.camera.width), edge(self.camera.height)))))
    }

    /// Key frame `i` if there is one. One whose picture cannot be read is set aside, named in a warning, and the next takes its
    /// number, so that half a picture never keeps a flight from going on.
    pub fn sound(&mut self, i: usize) -> Option<PosedImage> {
        while i < self.len() {
            match self.load(i) {
                Ok(frame) => return Some(frame),
                Err(e) => self.leave_out(i, &e),
            }
        }
        None
    }

    fn leave_out(&mut self, i: usize, why: &StoreError) {
        let path = self.folder.join(self.list.frames.remove(i).file_path);
        match self.disk.set_aside(&path) {
            Ok(aside) => tracing::warn!("{}", Damaged { why: why.to_string(), aside }),
            Err(e) => tracing::warn!("{why}; left out ({e})"),
        }
        if let Err(e) = self.save() {
            tracing::warn!("{e}; the list is written with the next key frame");
        }
    }

    /// Makes room: gives up every picture whose nearest neighbour stands no further from it than neighbours usually do, never
    /// both of a pair and never the last few. Returns how many.
    fn thin_out(&mut self) -> usize {
        let centers: Vec<_> = self.list.frames.iter().map(|f| f.dgtr.pose.center).collect();
        let nearest = |i: usize, kept: &[bool]| {
            let others = (0..centers.len()).filter(|&j| j != i && kept[j]);
            others.map(|j| centers[i].distance(centers[j])).fold(f64::INFINITY, f64::min)
        };
        let mut kept = vec![true; centers.len()];
        let mut spacings: Vec<f64> = (0..centers.len()).map(|i| nearest(i, &kept)).collect();
        spacings.sort_by(f64::total_cmp);
        let Some(&usual) = spacings.get(spacings.len() / 2) else { return 0 };
        for i in 0..centers.len() {
            let enough = kept.iter().filter(|k| **k).count() > MIN_KEPT;
            // A millimetre: poses of one line are never equally far to the last bit.
            kept[i] = !(enough && nearest(i, &kept) <= usual + 1e-3);
        }
        // Pictures first: on a full disk the shorter list has no room before. A start leaves out what is listed and gone.
        let mut gone = 0;
        let (disk, folder, mut kept) = (&self.disk, &self.folder, kept.into_iter());
        self.list.frames.retain(|f| {
            let stays = kept.next() != Some(false) || disk.remove(&folder.join(&f.file_path)).is_err();
            gone += usize::from(!stays);
            stays
        });
        if gone > 0
            && let Err(e) = self.save()
        {
            tracing::warn!("{e}; the list is written with the next key frame");
        }
        gone
    }

    /// As [`KeyframeStore::add`]; while there is no room, gives up what costs least and tries again.
    ///
    /// # Errors
    /// As [`KeyframeStore::add`], with nothing left to give up.
    pub fn add_with_relief(&mut self, frame: &KeyFrame, model: &Path) -> Result<(), StoreError> {
        let mut kept = self.add(frame);
        for relief in Relief::LADDER {
            if let Err(e) = &kept
                && e.may_pass()
                && self.relieve(relief, model)
            {
                tracing::warn!("{e}: gave up {}", relief.name());
                kept = self.add(frame);
            }
        }
        kept
    }

    /// Makes room; false when there was nothing to give up. `model` is the checkpoint kept beside the key frames.
    pub fn relieve(&mut self, relief: Relief, model: &Path) -> bool {
        match relief {
            Relief::OldCheckpoints => {
                // Both, whatever becomes of the first; they are kept again from the next writes on.
                let older = [previous(&self.folder.join(list::FILE)), previous(model)];
                older.map(|path| path.is_file() && self.disk.remove(&path).is_ok()).contains(&true)
            }
            Relief::CoveredPictures => self.thin_out() > 0,
        }
    }

    fn save(&self) -> Result<(), StoreError> {
        let path = self.folder.join(list::FILE);
        let json = serde_json::to_vec_pretty(&self.list)
            .map_err(|e| StoreError::Picture { path: path.clone(), what: e.to_string() })?;
        Ok(self.disk.replace_keeping(&path, |out| out.write_all(&json)).map_err(|e| FormatError::disk(&path, e))?)
    }
}

#[cfg(test)]
mod tests;
