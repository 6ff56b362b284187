//! The pictures that a model is trained on, and crops of them: pixels in a slot of the device or in a file, camera, exposure and
//! last loss on the host. Initialisation, exposure correction and training borrow the store; none of them owns it.

mod crops;
mod pose;
pub(crate) mod sampler;
mod slots;

pub use crops::CropPlace;

use crate::device::Device;
use crate::device::frame::Window;
use crate::error::TrainError;
use crate::layout::LEFT_OUT;
use config::plan::Plan;
use config::training::{AdamSettings, RateSettings};
use crops::Crop;
use image::RgbImage;
use models::camera::{DepthPrior, Pose, PosedImage, View};
use models::mask::Mask;
use pose::Adjust;
use slots::Slots;

/// What a step may visit, by its index.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Picture {
    /// A whole picture at training size.
    View(usize),
    /// A crop of a larger one.
    Crop(usize),
}

impl std::fmt::Display for Picture {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self {
            Self::View(index) => write!(f, "view {index}"),
            Self::Crop(index) => write!(f, "crop {index}"),
        }
    }
}

/// A whole picture.
struct TrainingView {
    view: View,
    width: u32,
    height: u32,
    /// Offset of the packed depth prior inside the view, u32; 0 when there is none.
    depth_at: u32,
    last_loss: f32,
    adjust: Adjust,
}

/// What a step needs to know of the picture that it visits.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Seen {
    /// Its camera, a crop's with its own lens.
    pub view: View,
    /// Offset of its depth prior, u32; 0 when there is none.
    pub depth_at: u32,
    /// Logarithm of the gain (r, g, b), then the offset.
    pub exposure: [f64; 6],
}

/// By what a view's pose and exposure are refined; `None` where they stay.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Refinement<'a> {
    /// Gradient by (turn, shift) of the camera.
    pub pose: Option<[f64; 6]>,
    /// Gradient by gain and offset.
    pub exposure: Option<[f64; 6]>,
    pub rates: &'a RateSettings,
    pub adam: &'a AdamSettings,
    /// Length scale of the scene, metres.
    pub extent: f32,
}

/// Views, crops, and where their pixels are.
pub struct PictureStore {
    views: Vec<TrainingView>,
    crops: Vec<Crop>,
    slots: Slots,
    plan: Plan,
}

impl std::fmt::Debug for PictureStore {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "PictureStore({} views, {} crops)", self.views.len(), self.crops.len())
    }
}

impl PictureStore {
    /// An empty store with room for the pictures of `plan`, on the device that was opened with it.
    pub fn new(plan: &Plan) -> Self {
        Self {
            views: Vec::with_capacity(plan.views),
            crops: Vec::with_capacity(plan.crops),
            slots: Slots::new(plan),
            plan: plan.clone(),
        }
    }

    /// Number of views.
    pub fn len(&self) -> usize {
        self.views.len()
    }

    /// Whether there is no view.
    pub fn is_empty(&self) -> bool {
        self.views.is_empty()
    }

    /// Takes a picture in, with an optional depth prior of any size; returns its index.
    /// A picture with more pixels than planned is reduced to fit.
    ///
    /// # Errors
    /// [`TrainError::TooManyViews`]; [`TrainError::BadView`] for empty pictures, poses or lenses that are not finite, or a
    /// prior whose maps do not have the size it states; [`TrainError::ViewFile`].
    pub fn add(
        &mut self,
        device: &mut Device,
        picture: &PosedImage,
        prior: Option<&DepthPrior>,
    ) -> Result<usize, TrainError> {
        let index = self.views.len();
        if index >= self.plan.views {
            return Err(TrainError::TooManyViews { planned: self.plan.views });
        }
        check(picture, prior)?;
        let (width, height) = self.fitting(picture.image.width(), picture.image.height());
        let reduced: RgbImage;
        let mut image = &picture.image;
        if (width, height) != image.dimensions() {
            reduced = image::imageops::resize(image, width, height, image::imageops::FilterType::Triangle);
            image = &reduced;
        }
        let mut view = picture.view;
        view.intrinsics = view.intrinsics.resized(width, height);
        let adjust = Adjust::default();
        self.views.push(TrainingView { view, width, height, depth_at: 0, last_loss: f32::INFINITY, adjust });
        let mask = picture.mask.as_ref().map(|mask| mask.resized(width, height));
        self.write_pixels(device, Picture::View(index), image, mask.as_ref());
        if let Err(e) = self.set_prior(device, index, prior) {
            // A view without its pixels is none.
            self.views.pop();
            return Err(e);
        }
        Ok(index)
    }

    /// Puts the pixels of a new picture into a slot; returns which.
    fn write_pixels(&mut self, device: &mut Device, picture: Picture, image: &RgbImage, mask: Option<&Mask>) -> usize {
        let slot = self.slots.claim(picture).0;
        let section = self.pixels_in(device, slot, picture);
        for (word, (x, y, p)) in device.arena.slice_mut::<u32>(section).iter_mut().zip(image.enumerate_pixels()) {
            let left_out = mask.is_some_and(|mask| !mask.keeps(x, y));
            *word = u32::from_le_bytes([p[0], p[1], p[2], if left_out { LEFT_OUT } else { 0 }]);
        }
        slot
    }

    /// Replaces the depth prior of view `index`, of any size; its pixels stay.
    ///
    /// # Errors
    /// [`TrainError::BadView`] when there is no such view, or the prior's maps do not have the size it states;
    /// [`TrainError::ViewFile`].
    pub fn set_prior(
        &mut self,
        device: &mut Device,
        index: usize,
        prior: Option<&DepthPrior>,
    ) -> Result<(), TrainError> {
        self.view_is_there(index)?;
        if let Some(why) = prior.and_then(broken) {
            return Err(TrainError::BadView { name: format!("view {index}"), why: why.to_owned() });
        }
        let slot = self.resident(device, Picture::View(index))?;
        let section = self.pixels_in(device, slot, Picture::View(index));
        let TrainingView { width, height, .. } = self.views[index];
        let pixels = width as usize * height as usize;
        let (colours, depths) = device.arena.slice_mut::<u32>(section).split_at_mut(pixels);
        let range = prior.and_then(depth_range);
        depths.fill(0);
        // Of each cell of the prior, confidence and depth; of each pixel, row and column there.
        let cells: Vec<(u32, u32)> = match (prior, range) {
            (Some(prior), Some(range)) => (0..prior.depth.len()).map(|at| quantised(prior, at, range)).collect(),
            _ => Vec::new(),
        };
        let (across, down) = prior.map_or((0, 0), |p| (p.width, p.height));
        let nearest = |i: u32, of: u32, cells: u32| {
            (((i as f32 + 0.5) / of as f32 * cells as f32) as usize).min((cells as usize).saturating_sub(1))
        };
        let columns: Vec<usize> = (0..width).map(|x| nearest(x, width, across)).collect();
        for y in 0..height {
            let row = nearest(y, height, down) * across as usize;
            for (x, column) in columns.iter().enumerate() {
                let i = y as usize * width as usize + x;
                if colours[i] >> 24 != u32::from(LEFT_OUT) {
                    let (confidence, depth) = cells.get(row + column).copied().unwrap_or_default();
                    depths[i / 2] |= depth << (16 * (i % 2));
                    colours[i] = (colours[i] & 0x00ff_ffff) | confidence << 24;
                }
            }
        }
        self.keep(device, slot, Picture::View(index))?;
        self.views[index].depth_at = if range.is_some() { pixels as u32 } else { 0 };
        Ok(())
    }

    /// Another camera for the picture of view `index`, as if it had been added with it: what was learnt of its exposure and
    /// loss is forgotten.
    ///
    /// # Errors
    /// [`TrainError::BadView`] when there is no such view, or the camera is not usable.
    pub fn renew(&mut self, index: usize, view: View) -> Result<(), TrainError> {
        self.view_is_there(index)?;
        if let Some(why) = unusable(&view) {
            return Err(TrainError::BadView { name: format!("view {index}"), why: why.to_owned() });
        }
        let resident = &mut self.views[index];
        let intrinsics = view.intrinsics.resized(resident.width, resident.height);
        resident.view = View { intrinsics, pose: view.pose };
        (resident.last_loss, resident.adjust) = (f32::INFINITY, Adjust::default());
        Ok(())
    }

    /// The picture of view `index` as it is trained on.
    ///
    /// # Errors
    /// [`TrainError::BadView`] when there is no such view; [`TrainError::ViewFile`].
    pub fn image(&mut self, device: &mut Device, index: usize) -> Result<RgbImage, TrainError> {
        self.view_is_there(index)?;
        let slot = self.resident(device, Picture::View(index))?;
        let TrainingView { width, height, .. } = self.views[index];
        let words = device.arena.slice::<u32>(self.pixels_in(device, slot, Picture::View(index))).iter();
        // As many words as the image has pixels: what is behind them is the depth prior.
        let mut pixels = words.map(|w| w.to_le_bytes());
        Ok(RgbImage::from_fn(width, height, |_, _| {
            let [r, g, b, _] = pixels.next().unwrap_or_default();
            image::Rgb([r, g, b])
        }))
    }

    /// Replaces the colours of view `index`; mask and depth prior stay.
    ///
    /// # Errors
    /// [`TrainError::BadView`] when there is no such view, or `image` is of another size; [`TrainError::ViewFile`].
    pub fn set_image(&mut self, device: &mut Device, index: usize, image: &RgbImage) -> Result<(), TrainError> {
        self.view_is_there(index)?;
        let TrainingView { width, height, .. } = self.views[index];
        if image.dimensions() != (width, height) {
            let why = "its new picture is of another size".to_owned();
            return Err(TrainError::BadView { name: format!("view {index}"), why });
        }
        let slot = self.resident(device, Picture::View(index))?;
        let section = self.pixels_in(device, slot, Picture::View(index));
        for (word, p) in device.arena.slice_mut::<u32>(section).iter_mut().zip(image.pixels()) {
            *word = (*word & 0xff00_0000) | u32::from_le_bytes([p[0], p[1], p[2], 0]);
        }
        self.keep(device, slot, Picture::View(index))
    }

    /// Which pixels of [`Self::image`] count; `None`: all.
    ///
    /// # Errors
    /// As [`Self::image`].
    pub fn mask(&mut self, device: &mut Device, index: usize) -> Result<Option<Mask>, TrainError> {
        self.view_is_there(index)?;
        let slot = self.resident(device, Picture::View(index))?;
        let TrainingView { width, height, .. } = self.views[index];
        let words =
            &device.arena.slice::<u32>(self.pixels_in(device, slot, Picture::View(index)))[..(width * height) as usize];
        let left_out = |word: &u32| word >> 24 == u32::from(LEFT_OUT);
        let mask = || Mask::from_fn(width, height, |x, y| !left_out(&words[(y * width + x) as usize]));
        Ok(words.iter().any(left_out).then(mask))
    }

    fn view_is_there(&self, index: usize) -> Result<(), TrainError> {
        match index < self.views.len() {
            true => Ok(()),
            false => Err(TrainError::BadView { name: format!("view {index}"), why: "does not exist".to_owned() }),
        }
    }

    /// The largest size of the same shape that the plan holds.
    fn fitting(&self, width: u32, height: u32) -> (u32, u32) {
        let fits = |w: u32, h: u32| {
            let tiles = Window::whole(w, h).tiles() as usize;
            w as usize * h as usize <= self.plan.pixels && tiles <= self.plan.tiles
        };
        let (mut w, mut h) = (width, height);
        let mut factor = (self.plan.pixels as f64 / (f64::from(width) * f64::from(height))).sqrt().min(1.0);
        while !fits(w, h) && (w > 1 || h > 1) {
            w = ((f64::from(width) * factor) as u32).max(1);
            h = ((f64::from(height) * factor) as u32).max(1);
            factor *= 0.99;
        }
        (w, h)
    }

    /// Camera of view `index` as it is now, refined pose included; `None` when there is no such view.
    pub fn view(&self, index: usize) -> Option<View> {
        self.views.get(index).map(|v| v.view)
    }

    /// Replaces the camera pose of view `index` (a better estimate arrived); its picture stays.
    ///
    /// # Errors
    /// [`TrainError::BadView`] when there is no such view or the pose is not finite.
    pub fn set_pose(&mut self, index: usize, pose: Pose) -> Result<(), TrainError> {
        let bad = |why: &str| TrainError::BadView { name: format!("view {index}"), why: why.to_owned() };
        if !is_usable(&pose) {
            return Err(bad("its pose is not finite"));
        }
        self.views.get_mut(index).ok_or_else(|| bad("does not exist"))?.view.pose = pose;
        Ok(())
    }

    /// Mean over the views of the loss of each when it was last visited; 0 before any was.
    pub fn mean_loss(&self) -> f32 {
        let seen = || self.views.iter().map(|v| f64::from(v.last_loss)).filter(|loss| loss.is_finite());
        (seen().sum::<f64>() / seen().count().max(1) as f64) as f32
    }

    /// Views, and behind them crops.
    pub(crate) fn all(&self) -> impl Iterator<Item = Picture> {
        (0..self.views.len()).map(Picture::View).chain((0..self.crops.len()).map(Picture::Crop))
    }

    /// Where the cameras are, metres.
    pub(crate) fn centers(&self) -> Vec<[f64; 3]> {
        self.views.iter().map(|v| v.view.pose.center.to_array()).collect()
    }

    /// Loss of a view when it was last visited; infinite before.
    pub(crate) fn last_loss(&self, picture: Picture) -> f32 {
        match picture {
            Picture::View(index) => self.views[index].last_loss,
            Picture::Crop(index) => self.crops[index].last_loss,
        }
    }

    /// What a step needs to know of a picture.
    pub(crate) fn seen(&self, picture: Picture) -> Seen {
        let of = &self.views[self.view_of(picture)];
        let depth_at = if let Picture::View(_) = picture { of.depth_at } else { 0 };
        Seen { view: self.camera(picture), depth_at, exposure: of.adjust.exposure }
    }

    /// Takes in what a visit to `picture` taught: its loss, and how its view's pose and exposure move.
    pub(crate) fn learn(&mut self, picture: Picture, loss: f32, by: Refinement<'_>) {
        let index = self.view_of(picture);
        let of = &mut self.views[index];
        match picture {
            Picture::View(_) => of.last_loss = loss,
            Picture::Crop(crop) => self.crops[crop].last_loss = loss,
        }
        if let Some(gradient) = by.pose {
            of.adjust.move_pose(&mut of.view.pose, gradient, by.rates, by.extent, by.adam);
        }
        if let Some(gradient) = by.exposure {
            of.adjust.move_exposure(gradient, by.rates, by.adam);
        }
    }
}

pub(crate) fn is_usable(pose: &Pose) -> bool {
    pose.center.is_finite() && pose.rotation.is_finite() && pose.rotation.length_squared() > 1e-12
}

fn check(picture: &PosedImage, prior: Option<&DepthPrior>) -> Result<(), TrainError> {
    let bad = |why: &str| Err(TrainError::BadView { name: picture.name.clone(), why: why.to_owned() });
    if picture.image.width() == 0 || picture.image.height() == 0 {
        return bad("has no pixels");
    }
    unusable(&picture.view).or(prior.and_then(broken)).map_or(Ok(()), bad)
}

fn unusable(view: &View) -> Option<&'static str> {
    let lens = view.intrinsics;
    let finite = [lens.fx, lens.fy, lens.cx, lens.cy].iter().all(|v| v.is_finite());
    if !finite || lens.fx <= 0.0 || lens.fy <= 0.0 || lens.width == 0 || lens.height == 0 {
        return Some("its focal length or principal point is not usable");
    }
    (!is_usable(&view.pose)).then_some("its pose is not finite")
}

fn broken(prior: &DepthPrior) -> Option<&'static str> {
    let n = prior.width as usize * prior.height as usize;
    let whole = n > 0 && prior.depth.len() == n && prior.confidence.len() == n;
    (!whole).then_some("its depth prior's maps do not have the stated size")
}

fn usable(prior: &DepthPrior, at: usize) -> bool {
    prior.depth[at].is_finite() && prior.confidence[at] > 0.0
}

/// Confidence and depth of a prior's cell as a view holds them: in 8 bits, and in 16 over the range; 0 and 0 where it knows none.
fn quantised(prior: &DepthPrior, at: usize, (low, high): (f32, f32)) -> (u32, u32) {
    if !usable(prior, at) {
        return (0, 0);
    }
    let confidence = (prior.confidence[at].clamp(0.0, 1.0) * 255.0).round() as u8;
    let confidence = if confidence == LEFT_OUT { 0 } else { confidence };
    (confidence.into(), ((prior.depth[at] - low) / (high - low) * 65535.0).round() as u32)
}

/// Least and greatest usable depth; `None` when they coincide, which correlates with nothing.
fn depth_range(prior: &DepthPrior) -> Option<(f32, f32)> {
    let at = (0..prior.depth.len()).filter(|i| usable(prior, *i));
    let (low, high) =
        at.fold((f32::INFINITY, f32::NEG_INFINITY), |(l, h), i| (l.min(prior.depth[i]), h.max(prior.depth[i])));
    (high > low && (high - low).is_finite()).then_some((low, high))
}
