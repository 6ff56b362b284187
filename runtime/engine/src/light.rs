//! Training pictures in one light: what the pictures say of each other's exposure, white balance and fall-off is taken out of them before
//! they are trained on, and kept in the model.

use image::RgbImage;
use models::light::{Light, PictureLight};

use super::Reconstruction;
use crate::error::EngineError;

/// A light that changes no value by more than this factor is the one there was: half a step of 8 bits.
const SAME: f32 = 1.002;

impl Reconstruction {
    /// Brings the training pictures from number `from` on from the light they are kept in into the common one of `light`; without it
    /// (a continuation makes no new depths) into that of the model that is continued.
    pub(super) fn even_light(&mut self, light: Option<Light>, from: usize) -> Result<(), EngineError> {
        self.taken_out.resize(self.views.len(), PictureLight::default());
        for i in from..self.views.len() {
            let (name, was) = (&self.views[i].0, self.taken_out[i]);
            let known = || self.resumed_lights.get(name).copied().filter(|_| self.builds == 0).unwrap_or(was);
            let now = light.as_ref().map_or_else(known, |light| light.of(name));
            if was == now || was.furthest(&now) < SAME {
                continue;
            }
            let Some(view) = self.trainer.view_pose(i) else { continue };
            let mut image = self.trainer.view_image(i)?;
            now.change(&was, &mut image, &view.intrinsics);
            self.trainer.set_image(i, &image)?;
            self.taken_out[i] = now;
        }
        Ok(())
    }

    /// The light of each view's picture, as the model states it: nothing where it was even.
    pub(super) fn lights(&self, views: usize) -> Vec<PictureLight> {
        let lights = &self.taken_out[..views.min(self.taken_out.len())];
        let even = lights.iter().all(|light| *light == PictureLight::default());
        if even { Vec::new() } else { lights.to_vec() }
    }

    /// An earlier picture as view `i` is trained on it, at any size.
    pub(super) fn in_common_light(&self, i: usize, mut picture: RgbImage) -> RgbImage {
        let (width, height) = picture.dimensions();
        let lens = self.views[i].1.intrinsics.resized(width, height);
        let taken_out = self.taken_out.get(i).copied().unwrap_or_default();
        taken_out.change(&PictureLight::default(), &mut picture, &lens);
        picture
    }
}
