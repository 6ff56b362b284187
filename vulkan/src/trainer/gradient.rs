//! Gradients for inspection: what a step would follow, for every parameter, the camera and the exposure. The gradient
//! checks compare them with the CPU references and with central differences.

use super::step::Visit;
use super::{PictureStore, TrainError, Trainer};
use crate::device::Gradients;
use crate::pictures::Picture;
use models::cloud::GaussianCloud;

/// Loss and its gradient by what a view owns.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct ViewGradients {
    /// The whole loss.
    pub loss: f32,
    /// Camera: turn about x, y, z and shift along them, in the camera's frame (p' = exp(turn) p + shift).
    pub pose: [f64; 6],
    /// Logarithm of the gain r, g, b, then the offset r, g, b.
    pub exposure: [f64; 6],
}

impl Trainer {
    /// Gradient of view `index`'s loss at full resolution and degree; `into` receives a cloud-shaped gradient, zero for
    /// Gaussians out of view. Adam's moments start anew afterwards; no parameter changes.
    ///
    /// # Errors
    /// [`TrainError::Empty`], [`TrainError::BadView`] when there is no such view, [`TrainError::Gpu`].
    pub fn gradient(
        &mut self,
        pictures: &mut PictureStore,
        index: usize,
        into: &mut GaussianCloud,
    ) -> Result<ViewGradients, TrainError> {
        if self.model.gaussians == 0 {
            return Err(TrainError::Empty { non_finite: 0 });
        }
        if index >= pictures.len() {
            return Err(TrainError::BadView { name: format!("view {index}"), why: "does not exist".into() });
        }
        self.model.flush(&mut self.device)?;
        self.model.measure_extent(&self.device, || pictures.centers());
        self.model.open_degrees(&mut self.device);
        self.model.forget_moments(&mut self.device);
        let framed = self.frame(pictures, Visit::whole(Picture::View(index), 1.0));
        (self.device.frame.background, self.device.frame.drop_share) = ([0.0; 3], 0.0);
        self.device.write_frame();
        self.project(pictures, Picture::View(index), framed)?;
        let by = Gradients { pose: true, exposure: true, keep: true };
        self.device.differentiate(by)?;
        let sums = self.device.partial_sums(by);
        let loss = self.device.weigh(&sums, &self.settings.loss).loss;
        crate::model::clear(into, self.plan().sh_degree);
        for g in self.model.geometry(&self.device) {
            let [[x, y, z, opacity], [sx, sy, sz, _], rotation] = g.first;
            into.means.push([x, y, z]);
            into.opacity_logits.push(opacity);
            into.log_scales.push([sx, sy, sz]);
            into.rotations.push(rotation);
        }
        let (sh, scale) = (self.model.parameters.sh_first, self.device.frame.moment_scale);
        let stride = into.sh_stride();
        for index in 0..self.model.gaussians {
            into.sh.extend((0..stride).map(|k| sh.first(&self.device.arena, index, k, scale)));
        }
        self.model.forget_moments(&mut self.device);
        Ok(ViewGradients { loss, pose: sums.pose, exposure: sums.exposure })
    }
}
