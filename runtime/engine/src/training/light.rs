//! Training pictures in one light: what the pictures say of each other's exposure, white balance and fall-off is taken out of them before
//! they are trained on, and kept in the model.

use image::RgbImage;
use models::camera::View;
use models::light::PictureLight;
use vulkan::trainer::{PictureStore, Trainer};

use crate::error::EngineError;

/// A light that changes no value by more than this factor is the one there was: half a step of 8 bits.
const SAME: f32 = 1.002;

/// The pictures that are trained on, and the light that is taken out of each already.
pub(crate) struct LitPictures {
    pub store: PictureStore,
    taken_out: Vec<PictureLight>,
}

impl LitPictures {
    /// Pictures as they were taken.
    pub fn new(store: PictureStore) -> Self {
        Self { store, taken_out: Vec::new() }
    }

    /// Brings the pictures of `views` from number `from` on from the light they are kept in into the one that `light` says of them.
    pub fn even(
        &mut self,
        trainer: &mut Trainer,
        views: &[(String, View)],
        light: &dyn Fn(&str) -> Option<PictureLight>,
        from: usize,
    ) -> Result<(), EngineError> {
        self.taken_out.resize(views.len(), PictureLight::default());
        for (i, (name, _)) in views.iter().enumerate().skip(from) {
            let was = self.taken_out[i];
            let now = light(name).unwrap_or(was);
            if was == now || was.furthest(&now) < SAME {
                continue;
            }
            let Some(view) = self.store.view(i) else { continue };
            let mut image = self.store.image(trainer.device_mut(), i)?;
            now.change(&was, &mut image, &view.intrinsics);
            self.store.set_image(trainer.device_mut(), i, &image)?;
            self.taken_out[i] = now;
        }
        Ok(())
    }

    /// The light of each view's picture, as the model states it: nothing where it was even.
    pub fn lights(&self, views: usize) -> Vec<PictureLight> {
        let lights = &self.taken_out[..views.min(self.taken_out.len())];
        let even = lights.iter().all(|light| *light == PictureLight::default());
        if even { Vec::new() } else { lights.to_vec() }
    }

    /// An earlier picture as view `i` is trained on it, at any size; `view` is the training's.
    pub fn in_common_light(&self, i: usize, view: &View, mut picture: RgbImage) -> RgbImage {
        let (width, height) = picture.dimensions();
        let lens = view.intrinsics.resized(width, height);
        let taken_out = self.taken_out.get(i).copied().unwrap_or_default();
        taken_out.change(&PictureLight::default(), &mut picture, &lens);
        picture
    }
}
