//! Training pictures in one light: what the pictures say of each other's exposure, white balance and fall-off is taken out of them before
//! they are trained on, and kept in the model.

use image::RgbImage;
use models::light::{Light, PictureLight};
use vulkan::trainer::PictureStore;

use super::Reconstruction;
use crate::error::EngineError;

/// A light that changes no value by more than this factor is the one there was: half a step of 8 bits.
const SAME: f32 = 1.002;

/// The pictures that are trained on, and the light that is taken out of each already.
pub(super) struct LitPictures {
    pub store: PictureStore,
    taken_out: Vec<PictureLight>,
}

impl LitPictures {
    /// Pictures as they were taken.
    pub fn new(store: PictureStore) -> Self {
        Self { store, taken_out: Vec::new() }
    }
}

impl Reconstruction {
    /// Brings the training pictures from number `from` on from the light they are kept in into the common one of `light`; without it
    /// (a continuation makes no new depths) into that of the model that is continued.
    pub(super) fn even_light(&mut self, light: Option<Light>, from: usize) -> Result<(), EngineError> {
        self.pictures.taken_out.resize(self.views.len(), PictureLight::default());
        for i in from..self.views.len() {
            let (name, was) = (&self.views[i].0, self.pictures.taken_out[i]);
            let known = || self.resumed_lights.get(name).copied().filter(|_| self.builds == 0).unwrap_or(was);
            let now = light.as_ref().map_or_else(known, |light| light.of(name));
            if was == now || was.furthest(&now) < SAME {
                continue;
            }
            let Some(view) = self.pictures.store.view(i) else { continue };
            let mut image = self.pictures.store.image(self.trainer.device_mut(), i)?;
            now.change(&was, &mut image, &view.intrinsics);
            self.pictures.store.set_image(self.trainer.device_mut(), i, &image)?;
            self.pictures.taken_out[i] = now;
        }
        Ok(())
    }

    /// The light of each view's picture, as the model states it: nothing where it was even.
    pub(super) fn lights(&self, views: usize) -> Vec<PictureLight> {
        let lights = &self.pictures.taken_out[..views.min(self.pictures.taken_out.len())];
        let even = lights.iter().all(|light| *light == PictureLight::default());
        if even { Vec::new() } else { lights.to_vec() }
    }

    /// An earlier picture as view `i` is trained on it, at any size.
    pub(super) fn in_common_light(&self, i: usize, mut picture: RgbImage) -> RgbImage {
        let (width, height) = picture.dimensions();
        let lens = self.views[i].1.intrinsics.resized(width, height);
        let taken_out = self.pictures.taken_out.get(i).copied().unwrap_or_default();
        taken_out.change(&PictureLight::default(), &mut picture, &lens);
        picture
    }
}
