//! Posed pictures: nerfstudio `transforms.json`, a COLMAP model, Mega-NeRF's form, an OpenDroneMap reconstruction or another program's project, with the split, the
//! sparse points and the aircraft's own telemetry when they are there; or a card, whose pictures have only what they say
//! of themselves. Opening reads the small files only; pictures are decoded
//! one at a time, so that a thousand of them need no more memory than one.

use std::collections::HashMap;
use std::path::{Path, PathBuf};

use geometry::geodesy::Geodetic;
use geometry::lens::Distortion;
use glam::DVec3;
use image::imageops;

use crate::card::control::SurveyedPoint;
use crate::card::{Card, CardOptions};
use crate::names::PictureNames;
use models::camera::{Intrinsics, Pose, PoseSigma, PosedImage, View};
use models::formats::reconstruction::{LensDescription, LocalFrame, Reconstruction, Shot};
use models::formats::telemetry;
use models::picture::{PictureError, decode_shown, dimensions};
use models::undistort::undistort;

mod ahead;
mod error;
mod facing;
mod frame;
mod masks;
mod points;
mod selection;
mod sources;
mod values;

pub use error::DatasetError;
pub use frame::DatasetFrame;
pub use points::SparsePoint;
pub use selection::{FlownRegion, Split};
use sources::{frames, reconstruction};

/// What a pose from bundle adjustment is worth: never exact, but far better than any GPS.
const RECONSTRUCTED_SIGMA: PoseSigma = PoseSigma { position_m: [0.02; 3], rotation_rad: [5e-4; 3] };

/// A picture's edge is at most this many times what its description says.
const MOST_LARGER: u32 = 8;

/// Where a frame's pose is taken from.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum PoseSource {
    /// The reconstruction that came with the data set.
    Dataset,
    /// Raw GPS and gimbal angles.
    Telemetry,
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
    /// How the description's coordinates became those of the frames; `None`: they are the same.
    pub local: Option<LocalFrame>,
    /// What is to be known about a card: its poses are priors only, which the pictures must settle. `None` for a
    /// reconstruction.
    pub card: Option<CardNotes>,
}

/// What reading a card left behind.
#[derive(Clone, Debug, Default)]
pub struct CardNotes {
    /// One line each: what was left out or changed, and why.
    pub lines: Vec<String>,
    /// One line each: what was used as it is.
    pub read: Vec<String>,
    /// Relative standard deviation of the focal lengths that the pictures state (the largest of the cameras').
    pub focal_sigma: f64,
    /// True when no picture states a distortion, so that it is for the pictures to tell.
    pub distortion_unknown: bool,
    /// Files that were found.
    pub found: usize,
    /// No picture says where it was taken.
    pub floats: bool,
    /// At least half of the pictures say how they were turned.
    pub has_attitudes: bool,
    /// Surveyed points marked in pictures.
    pub control: Vec<SurveyedPoint>,
    /// Others, that the result is measured against and that are not used for it.
    pub check: Vec<SurveyedPoint>,
}

/// What the pictures of a card say of one of them.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Settled {
    /// Lens, at whatever size the picture was asked, and pose.
    pub view: View,
    /// What is taken out of the picture on loading.
    pub distortion: Distortion,
}

impl Dataset {
    /// Reads the descriptions in `root`; without any, what its pictures say of themselves.
    ///
    /// # Errors
    /// A description is damaged or describes nothing, or there is neither one nor a picture with a position.
    pub fn open(root: &Path) -> Result<Self, DatasetError> {
        let Some((found, held_out)) = reconstruction(root)? else {
            return match root.is_dir() && Card::has_pictures(root) {
                true => Self::open_card(&[root.to_owned()], &CardOptions::default()),
                false => Err(DatasetError::NotADataset(root.to_owned())),
            };
        };
        let origin = found.origin;
        let mut frames = frames(root, found)?;
        if frames.is_empty() {
            return Err(DatasetError::Request(format!("{}: describes no pictures", root.display())));
        }
        let gps = root.join("gps.csv");
        let centers: Vec<DVec3> = frames.iter().map(|f| f.view.pose.center).collect();
        // What GPS is compared with is in metres, and where it is.
        let local = LocalFrame::of(&centers).filter(|_| origin.is_none() && !gps.is_file());
        if let Some(local) = local {
            tracing::info!("{}: coordinates are brought near their origin ({local})", root.display());
            frames.iter_mut().for_each(|f| f.view.pose.center = local.into_own(f.view.pose.center));
        }
        if gps.is_file() {
            let mut rows = telemetry::read(&gps, origin)?;
            for frame in &mut frames {
                frame.telemetry = rows.remove(&frame.name);
                frame.prior = frame.telemetry.map(|t| t.prior);
            }
        }
        let set = Self { root: root.to_owned(), frames, split: Split::default(), origin, local, card: None };
        facing::check(&set)?;
        let mut set = set.with_split(held_out)?;
        masks::find(&mut set)?;
        values::find(&mut set);
        Ok(set)
    }

    /// Reads the pictures below `folders` by what they say of themselves, whatever reconstruction lies beside them.
    ///
    /// # Errors
    /// See [`Card::open`].
    pub fn open_card(folders: &[PathBuf], options: &CardOptions) -> Result<Self, DatasetError> {
        let card = Card::open(folders, options)?;
        let focal_sigma = card.pictures.iter().map(|p| p.focal_sigma).fold(0.0, f64::max);
        let distortion_unknown = card.pictures.iter().all(|p| p.lens.distortion.is_none());
        let notes = CardNotes {
            lines: card.notes,
            read: card.read,
            focal_sigma,
            distortion_unknown,
            found: card.found,
            floats: card.origin.is_none(),
            has_attitudes: card.pictures.iter().filter(|p| p.has_attitude).count() * 2 >= card.pictures.len(),
            control: card.control,
            check: card.check,
        };
        let frames = card.pictures.into_iter().map(|p| {
            let size = p.lens.size.unwrap_or((1, 1));
            let view = View { intrinsics: p.lens.intrinsics(size), pose: p.prior.pose };
            let (distortion, orientation) = (p.lens.distortion, p.orientation);
            DatasetFrame {
                name: p.name,
                path: p.path,
                view,
                distortion,
                orientation,
                mask: None,
                values: None,
                prior: Some(p.prior),
                telemetry: None,
            }
        });
        let root = folders.first().cloned().unwrap_or_default();
        let frames = frames.collect();
        let set = Self { root, frames, split: Split::default(), origin: card.origin, local: None, card: Some(notes) };
        let mut set = set.with_split(None)?;
        masks::find(&mut set)?;
        values::find(&mut set);
        Ok(set)
    }

    /// Takes poses and lenses that the pictures have settled on in place of a card's priors; pictures that are not among them
    /// (they could not be decoded) are left out of the set.
    pub fn settle(&mut self, settled: &HashMap<String, Settled>) {
        masks::retain(self, |frame| settled.contains_key(&frame.name));
        for frame in &mut self.frames {
            let Some(Settled { view, distortion }) = settled.get(&frame.name) else { continue };
            frame.distortion = *distortion;
            // The pictures may have been smaller when they were asked.
            let full = &frame.view.intrinsics;
            frame.view = View { intrinsics: view.intrinsics.resized(full.width, full.height), pose: view.pose };
        }
        self.card = None;
    }

    /// Lenses and poses of the pictures as they are stored, for other programs.
    pub fn reconstruction(&self) -> Reconstruction {
        let shots = self.frames.iter().map(|f| {
            let back = f.orientation.inverse();
            let lens = back.of_lens(&LensDescription::new(&f.view.intrinsics, f.distortion));
            let center = f.view.pose.center;
            let center = self.local.map_or(center, |local| local.into_theirs(center));
            let pose = Pose { rotation: back.of_rotation(f.view.pose.rotation), center };
            let whole = |path: &Path| {
                std::path::absolute(path).unwrap_or_else(|_| path.to_owned()).to_string_lossy().into_owned()
            };
            Shot { path: whole(&f.path), lens, pose, mask: f.mask.as_deref().map(whole) }
        });
        Reconstruction { shots: shots.collect(), origin: self.origin }
    }

    fn frame(&self, i: usize) -> Result<&DatasetFrame, DatasetError> {
        self.frames.get(i).ok_or_else(|| {
            DatasetError::Request(format!(
                "{}: has {} pictures, number {i} was asked for",
                self.root.display(),
                self.frames.len()
            ))
        })
    }

    /// Pose of frame `i` and how far it may be wrong, without a look at its picture.
    ///
    /// # Errors
    /// There is no such frame, or `source` does not know it.
    pub fn pose(&self, i: usize, source: PoseSource) -> Result<(Pose, PoseSigma), DatasetError> {
        let frame = self.frame(i)?;
        match (source, frame.prior) {
            (PoseSource::Dataset, _) if self.card.is_none() => Ok((frame.view.pose, RECONSTRUCTED_SIGMA)),
            (_, Some(prior)) => Ok((prior.pose, prior.sigma)),
            (_, None) => {
                let what = format!(
                    "{}: no GPS and gimbal angles for {}; use the data set's poses",
                    self.root.join("gps.csv").display(),
                    frame.name
                );
                Err(DatasetError::Request(what))
            }
        }
    }

    /// Decodes frame `i`, undistorts it and scales it (Lanczos over the source area; `scale` in 0…1), with the
    /// reconstructed pose.
    ///
    /// # Errors
    /// There is no such picture, it is damaged or not what its description says, or the scale makes no sense.
    pub fn load(&self, i: usize, scale: f64) -> Result<PosedImage, DatasetError> {
        self.load_posed(i, scale, PoseSource::Dataset)
    }

    /// As [`Dataset::load`], with the pose from `source`. A picture much larger than what is wanted of it is reduced
    /// while it is decoded.
    ///
    /// # Errors
    /// As [`Dataset::load`]; the picture has no telemetry.
    pub fn load_posed(&self, i: usize, scale: f64, source: PoseSource) -> Result<PosedImage, DatasetError> {
        let frame = self.frame(i)?;
        let intrinsics = scaled(&frame.view.intrinsics, scale)?;
        let (pose, sigma) = self.pose(i, source)?;
        let (w, h) = (intrinsics.width, intrinsics.height);
        let wanted = if frame.orientation.swaps() { (h, w) } else { (w, h) };
        let full = &frame.view.intrinsics;
        // Before a pixel of it is decoded: a few kilobytes may claim to be a gigabyte of them.
        let (w, h) = dimensions(&frame.path)?;
        let (w, h) = if frame.orientation.swaps() { (h, w) } else { (w, h) };
        // A description may speak of the full size while the folder holds a copy scaled down evenly.
        let aspect = f64::from(w) * f64::from(full.height) / (f64::from(h) * f64::from(full.width));
        if (aspect - 1.0).abs() > 0.01 || w > MOST_LARGER.saturating_mul(full.width) {
            let what = format!("is {w} x {h}, its description says {} x {}", full.width, full.height);
            return Err(PictureError { path: frame.path.clone(), what }.into());
        }
        let (stored, opaque) = decode_shown(&frame.path, wanted, frame.values)?;
        let mut image = frame.orientation.apply(stored);
        if !frame.distortion.is_none() {
            let k = full.resized(image.width(), image.height());
            image = undistort(&image, &k, &frame.distortion);
        }
        if (image.width(), image.height()) != (intrinsics.width, intrinsics.height) {
            image = imageops::resize(&image, intrinsics.width, intrinsics.height, imageops::FilterType::Lanczos3);
        }
        let time_ns = frame.prior.map_or(0, |p| p.time_ns);
        let mask = frame.mask_at(&intrinsics, opaque)?;
        Ok(PosedImage { name: frame.name.clone(), time_ns, image, mask, view: View { intrinsics, pose }, sigma })
    }
}

/// The pictures of a data set by name, numbered as its frames are.
pub fn picture_names(set: &Dataset) -> PictureNames {
    PictureNames::of(set.frames.iter().map(|f| f.name.as_str()))
}

/// The lens of a picture scaled by `scale`, at least one pixel wide and high.
///
/// # Errors
/// A scale that is not above 0 and at most 1.
pub fn scaled(intrinsics: &Intrinsics, scale: f64) -> Result<Intrinsics, DatasetError> {
    if !(scale > 0.0 && scale <= 1.0) {
        return Err(DatasetError::Request(format!("the image scale is {scale}; it must be above 0 and at most 1")));
    }
    let edge = |n: u32| ((f64::from(n) * scale).round() as u32).max(1);
    Ok(intrinsics.resized(edge(intrinsics.width), edge(intrinsics.height)))
}
