//! Gradients for inspection: what a step would follow, for every parameter, the camera and the exposure. The gradient
//! checks compare them with the CPU references and with central differences.

use super::scene::Blocks;
use super::slots::Picture;
use super::{TrainError, Trainer};
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
    pub fn gradient(&mut self, index: usize, into: &mut GaussianCloud) -> Result<ViewGradients, TrainError> {
        if self.gaussians == 0 {
            return Err(TrainError::Empty { non_finite: 0 });
        }
        if index >= self.views.len() {
            return Err(TrainError::BadView { name: format!("view {index}"), why: "does not exist".into() });
        }
        self.flush()?;
        self.measure_extent();
        self.open_degrees();
        self.forget_all();
        let (_, first_pixel, _) = self.prepare_frame(Picture::View(index), Blocks::WHOLE, 1.0);
        (self.frame.background, self.frame.drop_share) = ([0.0; 3], 0.0);
        self.write_frame();
        self.forward_count(Picture::View(index), first_pixel)?;
        self.gradients_only = true;
        let done = self.forward_backward();
        self.gradients_only = false;
        done?;
        let sums = self.partial_sums();
        let loss = self.weigh(&sums).loss;
        super::parameters::clear(into, self.plan.sh_degree);
        for g in &self.parameters.geometry(&self.arena)[..self.gaussians] {
            let [[x, y, z, opacity], [sx, sy, sz, _], rotation] = g.first;
            into.means.push([x, y, z]);
            into.opacity_logits.push(opacity);
            into.log_scales.push([sx, sy, sz]);
            into.rotations.push(rotation);
        }
        let (sh, scale, stride) = (self.parameters.sh_first, self.frame.moment_scale, into.sh_stride());
        for index in 0..self.gaussians {
            into.sh.extend((0..stride).map(|k| sh.first(&self.arena, index, k, scale)));
        }
        self.forget_all();
        Ok(ViewGradients { loss, pose: sums.pose, exposure: sums.exposure })
    }

    fn forget_all(&mut self) {
        for index in 0..self.gaussians {
            self.parameters.forget(&mut self.arena, index);
        }
    }
}
