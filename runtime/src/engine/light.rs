//! Training pictures in one light: what the pictures say of each other's exposure, white balance and fall-off is taken out of them before
//! they are trained on, and kept beside the model.

use std::path::Path;

use image::RgbImage;
use models::camera::Intrinsics;
use models::light::{Light, PictureLight};

use super::Reconstruction;
use crate::error::JobError;
use crate::run_json::RunReport;

/// What it is called in run.json.
const NAME: &str = "light";
/// A light that changes no value by more than this factor is the one there was: half a step of 8 bits.
const SAME: f32 = 1.002;

/// The light of the pictures that the model in `folder` was trained on; even where nothing is known of it.
pub fn of_model(folder: &Path) -> Light {
    let told = RunReport::read(folder).ok().and_then(|mut run| run.more.remove(NAME));
    let light = told.and_then(|told| serde_json::from_value::<Light>(told).ok());
    light.filter(Light::is_usable).unwrap_or_default()
}

impl Reconstruction {
    /// The pictures' light as far as it is known.
    pub fn light(&self) -> &Light {
        &self.light
    }

    /// Brings all training pictures from the light they are kept in into `light`'s common one.
    pub(super) fn even_light(&mut self, light: Option<Light>) -> Result<(), JobError> {
        // Without new depths (a continuation) what was known stays.
        if let Some(light) = light {
            self.light = light;
        }
        self.taken_out.resize(self.views.len(), PictureLight::default());
        for i in 0..self.views.len() {
            let (was, now) = (self.taken_out[i], self.light.of(&self.views[i].0));
            if was == now || was.furthest(&now) < SAME {
                continue;
            }
            let Some(view) = self.trainer.view_pose(i) else { continue };
            let mut image = self.trainer.view_image(i)?;
            now.change(&was, &mut image, &view.intrinsics);
            self.trainer.set_image(i, &image)?;
            self.taken_out[i] = now;
        }
        if self.light != Light::default() {
            self.report.more.insert(NAME.to_owned(), serde_json::to_value(&self.light)?);
        }
        Ok(())
    }

    /// An earlier picture as view `i` is trained on it, at any size.
    pub(super) fn in_common_light(&self, i: usize, mut picture: RgbImage) -> RgbImage {
        let (width, height) = picture.dimensions();
        let lens: Intrinsics = self.views[i].1.intrinsics.resized(width, height);
        let taken_out = self.taken_out.get(i).copied().unwrap_or_default();
        taken_out.change(&PictureLight::default(), &mut picture, &lens);
        picture
    }
}
