//! The whole training step on the CPU: forward, loss, backward, Adam. Noise, DropGaussian and density control are
//! left to their own stages; every parameter of every Gaussian is stepped in every step, which is what the shaders'
//! deferred moments must amount to.

use config::training::TrainSettings;

use super::adam::{Moments, adam};
use super::camera::Camera;
use super::gaussian::{Gaussian, PARAMETERS};
use super::loss::{Exposure, Target};
use super::project::Limits;
use super::real::Real;
use super::step::{ViewGradient, backward, forward};

/// A cloud in training.
#[derive(Clone, Debug)]
pub struct ReferenceTrainer<R> {
    /// The parameters.
    pub cloud: Vec<Gaussian<R>>,
    moments: Vec<[Moments<R>; PARAMETERS]>,
    step: u32,
    /// May be changed between steps.
    pub settings: TrainSettings,
    extent: f32,
    limits: Limits,
}

impl<R: Real> ReferenceTrainer<R> {
    /// Starts with `cloud`; `extent` is the scene's, metres.
    pub fn new(cloud: Vec<Gaussian<R>>, settings: TrainSettings, extent: f32, limits: Limits) -> Self {
        let moments = vec![[Moments::default(); PARAMETERS]; cloud.len()];
        Self { cloud, moments, step: 0, settings, extent, limits }
    }

    /// Learning rate of parameter `k` at `progress`.
    fn rate(&self, k: usize, progress: f32) -> R {
        let r = &self.settings.rates;
        let rate = match k {
            0..3 => return R::of(r.mean(progress, self.extent).into()),
            3..6 => r.log_scale,
            6..10 => r.rotation,
            10 => r.opacity,
            11..14 => r.sh_dc,
            _ => r.sh_rest,
        };
        R::of((rate * r.decay(progress)).into())
    }

    /// One step on one view at `progress` of the schedule; gradients that are not finite count as zero.
    pub fn step(&mut self, camera: &Camera<R>, target: &Target<R>, progress: f32) -> ViewGradient<R> {
        let degree = self.settings.sh.degree_at(progress);
        let all = |_: usize| R::ONE;
        let rendered = forward(&self.cloud, camera, |_| degree, all, &self.limits);
        let gradient = backward(
            &self.cloud,
            camera,
            |_| degree,
            all,
            &self.limits,
            &rendered,
            target,
            &Exposure::default(),
            &self.settings.loss,
        );
        self.step += 1;
        for i in 0..self.cloud.len() {
            let mut row = gradient.gaussians[i];
            for k in 0..PARAMETERS {
                let rate = self.rate(k, progress);
                let g = *row.parameter(k);
                let g = if g.is_finite() { g } else { R::ZERO };
                adam(self.cloud[i].parameter(k), &mut self.moments[i][k], g, rate, self.step);
            }
        }
        gradient
    }
}
