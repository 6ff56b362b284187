//! Key frames on disk: what a restarted flight continues from, and a data set that `dgtr train` reads as it is.
//!
//! A folder of lossless pictures and one `transforms.json` (nerfstudio), with what only this project needs in a
//! `dgtr` object per frame. Every file is written aside and renamed, pictures before the list that names them, so
//! that a power cut loses at most the key frame being written.

use std::path::{Path, PathBuf};

use config::geodesy::Geodetic;
use models::camera::{Intrinsics, Pose, PoseSigma, PosedImage, View};
use models::dataset;
use models::formats::{FormatError, read_bounded, transforms, write_atomic};
use serde::{Deserialize, Serialize};

/// 4,096 key frames (the most a mission allows) at 2 KiB each.
const LIST_LIMIT: u64 = 8 << 20;

/// Why a stored key frame could not be used.
#[derive(Debug, thiserror::Error)]
pub enum StoreError {
    /// A file could not be read or written.
    #[error(transparent)]
    File(#[from] FormatError),
    /// A picture could not be decoded or encoded.
    #[error("key frame {}: {what}; remove {} to start without earlier key frames", path.display(), folder.display())]
    Picture {
        /// The picture.
        path: PathBuf,
        /// The store.
        folder: PathBuf,
        /// What is wrong.
        what: String,
    },
}

#[derive(Serialize, Deserialize)]
struct List {
    camera_model: String,
    fl_x: f32,
    fl_y: f32,
    cx: f32,
    cy: f32,
    w: u32,
    h: u32,
    enu_origin_wgs84: Origin,
    frames: Vec<Entry>,
}

#[derive(Serialize, Deserialize)]
struct Origin {
    lat: f64,
    lon: f64,
    alt: f64,
}

#[derive(Serialize, Deserialize)]
struct Entry {
    file_path: String,
    transform_matrix: [[f64; 4]; 4],
    dgtr: Extra,
}

/// What nerfstudio's format has no field for.
#[derive(Clone, Copy, Serialize, Deserialize)]
struct Extra {
    time_ns: u64,
    pose: Pose,
    /// Null where nothing is known: JSON has no infinity.
    position_sigma_m: [Option<f32>; 3],
    rotation_sigma_rad: [Option<f32>; 3],
}

impl Extra {
    fn new(frame: &PosedImage) -> Self {
        let known = |sigma: [f32; 3]| sigma.map(|s| s.is_finite().then_some(s));
        Self {
            time_ns: frame.time_ns,
            pose: frame.view.pose,
            position_sigma_m: known(frame.sigma.position_m),
            rotation_sigma_rad: known(frame.sigma.rotation_rad),
        }
    }

    fn sigma(&self) -> PoseSigma {
        let or_infinite = |sigma: [Option<f32>; 3]| sigma.map(|s| s.unwrap_or(f32::INFINITY));
        PoseSigma { position_m: or_infinite(self.position_sigma_m), rotation_rad: or_infinite(self.rotation_sigma_rad) }
    }
}

/// The key frames of one flight.
pub struct KeyframeStore {
    folder: PathBuf,
    list: List,
}

impl KeyframeStore {
    /// Opens the store in `folder`, or starts one there.
    ///
    /// # Errors
    /// An existing list that cannot be read, or one of another camera.
    pub fn open(folder: &Path, intrinsics: &Intrinsics, origin: Geodetic) -> Result<Self, StoreError> {
        let path = folder.join("transforms.json");
        let i = intrinsics;
        let mut list = List {
            camera_model: "PINHOLE".into(),
            fl_x: i.fx,
            fl_y: i.fy,
            cx: i.cx,
            cy: i.cy,
            w: i.width,
            h: i.height,
            enu_origin_wgs84: Origin { lat: origin.lat_deg, lon: origin.lon_deg, alt: origin.alt_m },
            frames: Vec::new(),
        };
        if path.is_file() {
            let wrong = |what: String| StoreError::Picture { path: path.clone(), folder: folder.into(), what };
            let bytes = read_bounded(&path, LIST_LIMIT)?;
            let old: List = serde_json::from_slice(&bytes).map_err(|e| wrong(e.to_string()))?;
            if (old.w, old.h) != (list.w, list.h) {
                return Err(wrong(format!(
                    "holds pictures of {}×{}, the mission says {}×{}",
                    old.w, old.h, list.w, list.h
                )));
            }
            list.frames = old.frames;
        }
        Ok(Self { folder: folder.into(), list })
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
    /// When the disk is full or not writable.
    pub fn add(&mut self, frame: &PosedImage) -> Result<(), StoreError> {
        let stem = Path::new(&frame.name).file_stem().and_then(|s| s.to_str()).unwrap_or("frame");
        let file_path = format!("images/{stem}.png");
        let path = self.folder.join(&file_path);
        let mut png = Vec::new();
        frame.image.write_to(&mut std::io::Cursor::new(&mut png), image::ImageFormat::Png).map_err(|e| {
            StoreError::Picture { path: path.clone(), folder: self.folder.clone(), what: e.to_string() }
        })?;
        write_atomic(&path, |out| std::io::Write::write_all(out, &png))?;
        let transform_matrix = transforms::pose_to_opengl(&frame.view.pose);
        let entry = Entry { file_path, transform_matrix, dgtr: Extra::new(frame) };
        self.list.frames.retain(|f| f.file_path != entry.file_path);
        self.list.frames.push(entry);
        self.save()
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
        let path = self.folder.join(&entry.file_path);
        let wrong = |what: String| StoreError::Picture { path: path.clone(), folder: self.folder.clone(), what };
        let image = dataset::decode(&path).map_err(|e| wrong(e.to_string()))?;
        if image.dimensions() != (self.list.w, self.list.h) {
            return Err(wrong("has another size than the list says".into()));
        }
        let l = &self.list;
        let intrinsics = Intrinsics { width: l.w, height: l.h, fx: l.fl_x, fy: l.fl_y, cx: l.cx, cy: l.cy };
        Ok(PosedImage {
            name: name(&entry.file_path),
            time_ns: entry.dgtr.time_ns,
            image,
            view: View { intrinsics, pose: entry.dgtr.pose },
            sigma: entry.dgtr.sigma(),
        })
    }

    fn save(&self) -> Result<(), StoreError> {
        let path = self.folder.join("transforms.json");
        let json = serde_json::to_vec_pretty(&self.list).map_err(|e| StoreError::Picture {
            path: path.clone(),
            folder: self.folder.clone(),
            what: e.to_string(),
        })?;
        Ok(write_atomic(&path, |out| std::io::Write::write_all(out, &json))?)
    }
}

/// Key frames are known by the name of their file.
fn name(file_path: &str) -> String {
    file_path.rsplit('/').next().unwrap_or(file_path).to_owned()
}

#[cfg(test)]
mod tests {
    use super::*;
    use glam::{DQuat, DVec3};

    fn frame(name: &str, x: f64) -> PosedImage {
        PosedImage {
            name: name.into(),
            time_ns: 7,
            image: image::RgbImage::from_fn(4, 3, |x, y| image::Rgb([x as u8, y as u8, 9])),
            view: View {
                intrinsics: Intrinsics { width: 4, height: 3, fx: 3.0, fy: 3.0, cx: 2.0, cy: 1.5 },
                pose: Pose { rotation: DQuat::from_rotation_x(3.0), center: DVec3::new(x, 2.0, 40.0) },
            },
            sigma: PoseSigma { position_m: [1.0; 3], rotation_rad: [f32::INFINITY; 3] },
        }
    }

    const ORIGIN: Geodetic = Geodetic { lat_deg: 46.0, lon_deg: 7.0, alt_m: 500.0 };

    #[test]
    fn a_restarted_flight_finds_its_key_frames_as_they_were() {
        let dir = tempfile::tempdir().expect("tempdir");
        let intrinsics = frame("a.jpg", 0.0).view.intrinsics;
        let mut store = KeyframeStore::open(dir.path(), &intrinsics, ORIGIN).expect("new");
        store.add(&frame("a.jpg", 5.0)).expect("add");
        let again = KeyframeStore::open(dir.path(), &intrinsics, ORIGIN).expect("again").load(0).expect("load");
        let (stored, first) = (again.view, frame("a.jpg", 5.0));
        assert_eq!((stored, again.sigma, again.image), (first.view, first.sigma, first.image));
    }

    #[test]
    fn the_store_is_a_data_set() {
        let dir = tempfile::tempdir().expect("tempdir");
        let intrinsics = frame("a.jpg", 0.0).view.intrinsics;
        let mut store = KeyframeStore::open(dir.path(), &intrinsics, ORIGIN).expect("new");
        for i in 0..9 {
            store.add(&frame(&format!("{i}.jpg"), f64::from(i))).expect("add");
        }
        let again = KeyframeStore::open(dir.path(), &intrinsics, ORIGIN).expect("again");
        assert_eq!(again.len(), 9);
        let loaded = again.load(3).expect("load");
        assert_eq!((loaded.name.as_str(), loaded.view.pose.center.x, loaded.time_ns), ("3.png", 3.0, 7));
        let set = models::dataset::Dataset::open(dir.path()).expect("a data set");
        assert_eq!(set.frames.len(), 9);
        assert!((set.frames[3].view.pose.center - loaded.view.pose.center).length() < 1e-9);
        assert_eq!(set.origin, Some(ORIGIN));
    }
}
