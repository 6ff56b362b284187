//! Gradients for inspection: what a step would follow, for every parameter, the camera and the exposure. The gradient
//! checks compare them with the CPU twins and with central differences.

use super::rows::GEOMETRY;
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
            return Err(TrainError::Empty { unsound: 0 });
        }
        if index >= self.views.len() {
            return Err(TrainError::BadView { name: format!("view {index}"), why: "does not exist".into() });
        }
        self.flush()?;
        self.measure_extent();
        self.open_degrees();
        self.forget_all();
        self.prepare_frame(index, 1.0);
        self.frame.background = [0.0; 4];
        self.write_frame();
        self.forward_count(index)?;
        self.gradients_only = true;
        let done = self.forward_backward();
        self.gradients_only = false;
        done?;
        let sums = self.partial_sums();
        let loss = self.weigh(&sums).loss;
        let rows = self.rows;
        super::rows::clear(into, self.plan.sh_degree);
        let stride = into.sh_stride();
        for g in self.arena.slice::<[f32; 4]>(rows.geometry).chunks_exact(GEOMETRY).take(self.gaussians) {
            into.means.push([g[3][0], g[3][1], g[3][2]]);
            into.opacity_logits.push(g[3][3]);
            into.log_scales.push([g[4][0], g[4][1], g[4][2]]);
            into.rotations.push(g[5]);
        }
        for row in 0..self.gaussians {
            into.sh.extend((0..stride).map(|k| rows.sh_first.first(&self.arena, row, k, self.frame.adam[3])));
        }
        self.forget_all();
        let l = sums.loss;
        Ok(ViewGradients { loss, pose: sums.pose, exposure: [l[1], l[2], l[3], l[4], l[5], l[6]] })
    }

    fn forget_all(&mut self) {
        let rows = self.rows;
        for row in 0..self.gaussians {
            rows.forget(&mut self.arena, row);
        }
    }
}
