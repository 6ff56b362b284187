//! Crops: windows of the camera's pictures at a larger size than whole pictures are trained at, so that detail which a training
//! picture cannot show is learnt at the cost of a step on one. A crop has the pose and the exposure of its view; only its lens is its
//! own, with a principal point that may lie outside of it.

use super::{Picture, PictureStore};
use crate::device::Device;
use crate::error::TrainError;
use image::RgbImage;
use models::camera::{Intrinsics, View};
use models::mask::Mask;

/// Where a crop lies in the picture it was cut out of.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct CropPlace {
    /// Its left edge, pixels.
    pub x: u32,
    /// Its upper edge, pixels.
    pub y: u32,
    /// Width and height of the picture it was cut out of, pixels.
    pub whole: (u32, u32),
}

/// A crop.
pub(super) struct Crop {
    /// Its view.
    pub view: usize,
    pub place: CropPlace,
    pub width: u32,
    pub height: u32,
    pub last_loss: f32,
}

impl Crop {
    /// Its camera: that of the view it was cut out of, whose focal length and pose may have been refined since.
    pub fn seen_from(&self, view: &View) -> View {
        let (CropPlace { x, y, whole }, (width, height)) = (self.place, (self.width, self.height));
        let lens = view.intrinsics.resized(whole.0, whole.1);
        let (cx, cy) = (lens.cx - x as f32, lens.cy - y as f32);
        View { intrinsics: Intrinsics { width, height, cx, cy, ..lens }, pose: view.pose }
    }
}

impl PictureStore {
    /// Takes in a crop of the picture of view `view`, of which the pixels count that `mask` keeps, where there is one.
    ///
    /// # Errors
    /// [`TrainError::TooManyCrops`]; [`TrainError::BadView`] when there is no such view, or the crop has no pixels, more than planned,
    /// or lies outside of its picture; [`TrainError::ViewFile`].
    pub fn add_crop(
        &mut self,
        device: &mut Device,
        view: usize,
        image: &RgbImage,
        mask: Option<&Mask>,
        place: CropPlace,
    ) -> Result<(), TrainError> {
        let index = self.crops.len();
        if index >= self.plan.crops {
            return Err(TrainError::TooManyCrops { planned: self.plan.crops });
        }
        self.view_is_there(view)?;
        let (width, height) = image.dimensions();
        let ends = |at: u32, side: u32, whole: u32| side > 0 && at.checked_add(side).is_some_and(|end| end <= whole);
        let lies_within = ends(place.x, width, place.whole.0) && ends(place.y, height, place.whole.1);
        if !lies_within || self.fitting(width, height) != (width, height) {
            let why =
                format!("a crop of {width}x{height} of a picture of {}x{} does not fit", place.whole.0, place.whole.1);
            return Err(TrainError::BadView { name: format!("view {view}"), why });
        }
        self.crops.push(Crop { view, place, width, height, last_loss: f32::INFINITY });
        let slot = self.write_pixels(device, Picture::Crop(index), image, mask);
        // A crop without its pixels is none.
        self.keep(device, slot, Picture::Crop(index)).inspect_err(|_| _ = self.crops.pop())
    }

    /// Number of crops.
    pub fn crops(&self) -> usize {
        self.crops.len()
    }

    /// The view whose camera a picture was taken with.
    pub(crate) fn view_of(&self, picture: Picture) -> usize {
        match picture {
            Picture::View(index) => index,
            Picture::Crop(index) => self.crops[index].view,
        }
    }

    /// The camera of a picture as it is now.
    pub(crate) fn camera(&self, picture: Picture) -> View {
        let view = self.views[self.view_of(picture)].view;
        match picture {
            Picture::View(_) => view,
            Picture::Crop(index) => self.crops[index].seen_from(&view),
        }
    }
}

#[cfg(test)]
mod tests {
    use glam::{DQuat, DVec3};
    use models::camera::Pose;

    use super::*;

    #[test]
    fn a_crop_sees_what_the_whole_picture_sees_there() {
        let small = Intrinsics { width: 64, height: 48, fx: 60.0, fy: 61.0, cx: 32.5, cy: 23.5 };
        let view = View { intrinsics: small, pose: Pose { rotation: DQuat::IDENTITY, center: DVec3::ZERO } };
        let place = CropPlace { x: 100, y: 40, whole: (256, 192) };
        let crop = Crop { view: 0, place, width: 64, height: 48, last_loss: 0.0 };
        let lens = crop.seen_from(&view).intrinsics;
        // A ray through the whole picture's pixel (130, 60) goes through the crop's (30, 20).
        let whole = small.resized(256, 192);
        let ray = [(130.0 - whole.cx) / whole.fx, (60.0 - whole.cy) / whole.fy];
        assert_eq!([ray[0] * lens.fx + lens.cx, ray[1] * lens.fy + lens.cy], [30.0, 20.0]);
        assert_eq!((lens.width, lens.height), (64, 48));
    }
}
