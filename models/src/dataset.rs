//! A folder of posed pictures: nerfstudio `transforms.json` or a COLMAP model, with the split, the sparse points
//! and the aircraft's own telemetry when they are there. Opening reads the small files only; pictures are decoded
//! one at a time, so that a thousand of them need no more memory than one.

use std::collections::{BTreeMap, HashMap};
use std::path::{Path, PathBuf};

use config::geodesy::Geodetic;
use image::imageops;

use crate::camera::{Intrinsics, PoseSigma, PosedImage, View};
use crate::formats::telemetry::{self, Telemetry};
use crate::formats::{FormatError, colmap, split};
use crate::undistort::undistort;
use config::lens::Distortion;

mod sources;

pub use sources::decode;
use sources::{file_name, from_colmap, from_transforms};

/// Without a `split.json` every eighth picture is held out, as 3DGS and its successors do.
const TEST_EVERY: usize = 8;
/// What a pose from bundle adjustment is worth: never exact, but far better than any GPS.
const RECONSTRUCTED_SIGMA: PoseSigma = PoseSigma { position_m: [0.02; 3], rotation_rad: [5e-4; 3] };

/// Why a data set cannot be used.
#[derive(Debug, thiserror::Error)]
pub enum DatasetError {
    /// One of its files is missing or wrong.
    #[error(transparent)]
    Format(#[from] FormatError),
    /// Not a data set at all.
    #[error("{}: neither transforms.json nor sparse/0/images.bin is there; give the folder that holds one of them", .0.display())]
    NotADataset(PathBuf),
    /// A picture is missing, unreadable or not what its description says.
    #[error("{}: {what}", path.display())]
    Picture {
        /// The picture.
        path: PathBuf,
        /// What is wrong.
        what: String,
    },
    /// A split, region or picture of this name does not exist.
    #[error("{}: no {kind} named {name:?}; there are: {known}", root.display())]
    Unknown {
        /// The data set.
        root: PathBuf,
        /// `split`, `region` or `picture`.
        kind: &'static str,
        /// What was asked for.
        name: String,
        /// What exists.
        known: String,
    },
    /// The caller asked for something impossible.
    #[error("{0}")]
    Request(String),
}

/// One picture of the set.
#[derive(Clone, Debug)]
pub struct DatasetFrame {
    /// File name (with its folder only where names would repeat).
    pub name: String,
    /// Where the picture lies.
    pub path: PathBuf,
    /// Lens (undistorted, full size) and reconstructed pose.
    pub view: View,
    /// What is taken out of the picture on loading.
    pub distortion: Distortion,
    /// GPS and gimbal angles, where recorded.
    pub telemetry: Option<Telemetry>,
}

/// An area flown by one aircraft.
#[derive(Clone, Debug)]
pub struct Region {
    /// Its name (`--region`).
    pub name: String,
    /// Corners counter-clockwise, ENU metres.
    pub polygon: Vec<[f64; 2]>,
    /// Frame numbers by list name.
    pub lists: BTreeMap<String, Vec<usize>>,
}

/// Which frames are for what, as indices into [`Dataset::frames`].
#[derive(Clone, Debug, Default)]
pub struct Split {
    /// `train`, `test`, …
    pub lists: BTreeMap<String, Vec<usize>>,
    /// May be empty.
    pub regions: Vec<Region>,
}

/// Where a frame's pose is taken from.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum PoseSource {
    /// The reconstruction that came with the data set.
    Dataset,
    /// Raw GPS and gimbal angles.
    Telemetry,
}

/// A triangulated point.
#[derive(Clone, Debug)]
pub struct SparsePoint {
    /// ENU metres.
    pub position: [f64; 3],
    /// 8-bit sRGB.
    pub color: [u8; 3],
    /// Mean reprojection error, pixels at full size.
    pub error_px: f64,
    /// Frames that saw it, sorted; empty when the file has no tracks.
    pub frames: Vec<u32>,
}

/// An opened data set.
#[derive(Clone, Debug)]
pub struct Dataset {
    /// Its folder.
    pub root: PathBuf,
    /// In capture (file) order.
    pub frames: Vec<DatasetFrame>,
    /// What to train on and what to hold out.
    pub split: Split,
    /// WGS-84 origin of the world frame, when known.
    pub origin: Option<Geodetic>,
}

impl Dataset {
    /// Reads the descriptions in `root`.
    pub fn open(root: &Path) -> Result<Self, DatasetError> {
        let (mut frames, origin) = if root.join("transforms.json").is_file() {
            from_transforms(root)?
        } else if root.join("sparse/0/images.bin").is_file() {
            (from_colmap(root)?, None)
        } else {
            return Err(DatasetError::NotADataset(root.to_owned()));
        };
        if frames.is_empty() {
            return Err(DatasetError::Request(format!("{}: describes no pictures", root.display())));
        }
        let gps = root.join("gps.csv");
        if gps.is_file() {
            let mut rows = telemetry::read(&gps, origin)?;
            for frame in &mut frames {
                frame.telemetry = rows.remove(&frame.name);
            }
        }
        let mut dataset = Self { root: root.to_owned(), frames, split: Split::default(), origin };
        let file = root.join("split.json");
        dataset.split = if file.is_file() { dataset.resolve(&file)? } else { dataset.every_eighth() };
        Ok(dataset)
    }

    /// The frames of a split, restricted to a region's when one is named; `all` is always a split.
    pub fn select(&self, split: &str, region: Option<&str>) -> Result<Vec<usize>, DatasetError> {
        let unknown = |kind, name: &str, known: Vec<&str>| DatasetError::Unknown {
            root: self.root.clone(),
            kind,
            name: name.to_owned(),
            known: if known.is_empty() { "none".to_owned() } else { known.join(", ") },
        };
        let all: Vec<usize> = (0..self.frames.len()).collect();
        let whole = match self.split.lists.get(split) {
            Some(list) => list,
            None if split == "all" => &all,
            None => {
                return Err(unknown(
                    "split",
                    split,
                    self.split.lists.keys().map(String::as_str).chain(["all"]).collect(),
                ));
            }
        };
        let Some(name) = region else { return Ok(whole.clone()) };
        let regions = &self.split.regions;
        let Some(region) = regions.iter().find(|r| r.name == name) else {
            return Err(unknown("region", name, regions.iter().map(|r| r.name.as_str()).collect()));
        };
        Ok(match region.lists.get(split) {
            Some(list) => list.clone(),
            None => whole.iter().copied().filter(|i| region.lists.values().any(|l| l.contains(i))).collect(),
        })
    }

    /// The region of this name.
    pub fn region(&self, name: &str) -> Option<&Region> {
        self.split.regions.iter().find(|r| r.name == name)
    }

    /// Decodes frame `i`, undistorts it and scales it (Lanczos over the source area; `scale` in 0…1), with the
    /// reconstructed pose.
    pub fn load(&self, i: usize, scale: f64) -> Result<PosedImage, DatasetError> {
        self.load_posed(i, scale, PoseSource::Dataset)
    }

    /// As [`Dataset::load`], with the pose from `source`.
    pub fn load_posed(&self, i: usize, scale: f64, source: PoseSource) -> Result<PosedImage, DatasetError> {
        let frame = self.frames.get(i).ok_or_else(|| {
            DatasetError::Request(format!(
                "{}: has {} pictures, number {i} was asked for",
                self.root.display(),
                self.frames.len()
            ))
        })?;
        let intrinsics = scaled(&frame.view.intrinsics, scale)?;
        let (pose, sigma) = match (source, frame.telemetry) {
            (PoseSource::Dataset, _) => (frame.view.pose, RECONSTRUCTED_SIGMA),
            (PoseSource::Telemetry, Some(t)) => (t.pose, t.sigma),
            (PoseSource::Telemetry, None) => {
                let what = format!(
                    "{}: no GPS and gimbal angles for {}; use the data set's poses",
                    self.root.join("gps.csv").display(),
                    frame.name
                );
                return Err(DatasetError::Request(what));
            }
        };
        let bad = |what: &str| DatasetError::Picture { path: frame.path.clone(), what: what.to_owned() };
        let mut image = decode(&frame.path)?;
        let full = &frame.view.intrinsics;
        // A description may speak of the full size while the folder holds a copy scaled down evenly.
        let aspect =
            f64::from(image.width()) * f64::from(full.height) / (f64::from(image.height()) * f64::from(full.width));
        if (aspect - 1.0).abs() > 0.01 {
            return Err(bad(&format!(
                "is {} x {}, its description says {} x {}",
                image.width(),
                image.height(),
                full.width,
                full.height
            )));
        }
        if !frame.distortion.is_none() {
            let k = full.resized(image.width(), image.height());
            image = undistort(&image, &k, &frame.distortion);
        }
        if (image.width(), image.height()) != (intrinsics.width, intrinsics.height) {
            image = imageops::resize(&image, intrinsics.width, intrinsics.height, imageops::FilterType::Lanczos3);
        }
        let time_ns = frame.telemetry.map_or(0, |t| t.time_ns);
        Ok(PosedImage { name: frame.name.clone(), time_ns, image, view: View { intrinsics, pose }, sigma })
    }

    /// The coloured sparse points of `sparse/0/points3D.bin`; none when the file is not there.
    pub fn sparse_points(&self) -> Result<Vec<SparsePoint>, DatasetError> {
        let folder = self.root.join("sparse/0");
        if !folder.join("points3D.bin").is_file() {
            return Ok(Vec::new());
        }
        let (points, dropped) = colmap::read_points(&folder.join("points3D.bin"))?;
        if dropped > 0 {
            tracing::warn!("{}: {dropped} points are not at a finite position and were left out", folder.display());
        }
        let by_name: HashMap<&str, u32> =
            self.frames.iter().enumerate().map(|(i, f)| (f.name.as_str(), i as u32)).collect();
        let images = if folder.join("images.bin").is_file() {
            colmap::read_images(&folder.join("images.bin"))?
        } else {
            Vec::new()
        };
        let by_id: HashMap<u32, u32> = images
            .iter()
            .filter_map(|m| Some((m.id, *by_name.get(m.name.as_str()).or_else(|| by_name.get(file_name(&m.name)))?)))
            .collect();
        Ok(points
            .into_iter()
            .map(|p| {
                let mut frames: Vec<u32> = p.images.iter().filter_map(|id| by_id.get(id).copied()).collect();
                frames.sort_unstable();
                SparsePoint { position: p.position.to_array(), color: p.color, error_px: p.error, frames }
            })
            .collect())
    }

    /// The points that at least two of `frames` saw: what a strict held-out test may start from. Points without
    /// tracks (some writers leave them out) are kept.
    pub fn sparse_points_of(&self, frames: &[usize]) -> Result<Vec<SparsePoint>, DatasetError> {
        let chosen: std::collections::HashSet<u32> = frames.iter().map(|&i| i as u32).collect();
        let mut points = self.sparse_points()?;
        points.retain(|p| p.frames.is_empty() || p.frames.iter().filter(|f| chosen.contains(f)).count() >= 2);
        Ok(points)
    }

    fn every_eighth(&self) -> Split {
        let mut by_name: Vec<usize> = (0..self.frames.len()).collect();
        by_name.sort_by(|&a, &b| self.frames[a].name.cmp(&self.frames[b].name));
        let mut test: Vec<usize> = by_name.iter().copied().step_by(TEST_EVERY).collect();
        test.sort_unstable();
        let train = (0..self.frames.len()).filter(|i| test.binary_search(i).is_err()).collect();
        Split { lists: BTreeMap::from([("test".to_owned(), test), ("train".to_owned(), train)]), regions: Vec::new() }
    }

    fn resolve(&self, path: &Path) -> Result<Split, DatasetError> {
        let file = split::read(path)?;
        let by_name: HashMap<&str, usize> = self.frames.iter().enumerate().map(|(i, f)| (f.name.as_str(), i)).collect();
        let lists = |lists: BTreeMap<String, Vec<String>>| -> Result<BTreeMap<String, Vec<usize>>, DatasetError> {
            lists
                .into_iter()
                .map(|(list, names)| {
                    let numbers = names.iter().map(|n| {
                        by_name.get(n.as_str()).or_else(|| by_name.get(file_name(n))).copied().ok_or_else(|| {
                            FormatError::invalid(
                                path,
                                format!("list {list:?} names {n:?}, which is not a picture of this data set"),
                            )
                            .into()
                        })
                    });
                    let numbers = numbers.collect::<Result<Vec<_>, DatasetError>>()?;
                    Ok((list, numbers))
                })
                .collect()
        };
        let mut regions = Vec::with_capacity(file.regions.len());
        for r in file.regions {
            let mut lists = lists(r.lists)?;
            // A region calls its `train_dense` list `images`.
            if let Some(images) = lists.get("images").cloned() {
                lists.entry("train_dense".to_owned()).or_insert(images);
            }
            let polygon = vec![[r.min[0], r.min[1]], [r.max[0], r.min[1]], [r.max[0], r.max[1]], [r.min[0], r.max[1]]];
            regions.push(Region { name: r.name, polygon, lists });
        }
        Ok(Split { lists: lists(file.lists)?, regions })
    }
}

/// The lens of a picture scaled by `scale`, at least one pixel wide and high.
pub fn scaled(intrinsics: &Intrinsics, scale: f64) -> Result<Intrinsics, DatasetError> {
    if !(scale > 0.0 && scale <= 1.0) {
        return Err(DatasetError::Request(format!("the image scale is {scale}; it must be above 0 and at most 1")));
    }
    let edge = |n: u32| ((f64::from(n) * scale).round() as u32).max(1);
    Ok(intrinsics.resized(edge(intrinsics.width), edge(intrinsics.height)))
}
