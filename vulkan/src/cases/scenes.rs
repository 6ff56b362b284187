//! What the reference and the device make of the made-up scenes.

use models::camera::View;
use models::cloud::GaussianCloud;

use super::Broken;
use crate::fixture::Fixture;
use crate::gpu::Gpu;
use crate::reference::camera::Camera;
use crate::reference::gaussian::Gaussian;
use crate::reference::loss::{Exposure, Target};
use crate::reference::project::{Culled, Limits};
use crate::reference::rasterise::Pixel;
use crate::reference::real::Real;
use crate::reference::step::{ViewGradient, backward, forward};
use config::plan::{Plan, PlanRequest};
use config::training::{LossSettings, TrainSettings};

pub use crate::synthetic::{cloud, grey, photo, plain, posed, view};

/// What the reference makes of a scene.
pub struct Answer<R = f32> {
    /// The picture, row by row.
    pub picture: Vec<Pixel<R>>,
    /// Gaussian–tile instances.
    pub instances: usize,
    /// Why each Gaussian was not drawn.
    pub culled: Vec<Option<Culled>>,
    /// Loss and every gradient.
    pub gradient: ViewGradient<R>,
}

impl<R: Real> Answer<R> {
    /// How many Gaussians were not drawn for this reason.
    pub fn count(&self, why: Culled) -> usize {
        self.culled.iter().filter(|c| **c == Some(why)).count()
    }

    /// Every number of the picture and of every gradient.
    ///
    /// # Errors
    /// Which number is not finite.
    pub fn check_finite(&self, case: &str) -> Result<(), Broken> {
        for p in &self.picture {
            promise!(p.rgb.iter().chain([&p.depth, &p.transmittance]).all(|v| v.is_finite()), "{case}: picture");
        }
        promise!(self.gradient.loss.total.is_finite(), "{case}: loss");
        for g in &self.gradient.gaussians {
            let mut g = *g;
            promise!((0..59).all(|k| g.parameter(k).is_finite()), "{case}: gradient {g:?}");
        }
        promise!(self.gradient.pose.iter().all(|v| v.is_finite()), "{case}: pose");
        Ok(())
    }
}

/// The reference's full step before the optimiser, in f32, with the shaders' limits.
pub fn answer(cloud: &GaussianCloud, view: &View, photo: &[[f32; 3]], settings: &LossSettings) -> Answer {
    answer_in(cloud, view, photo, settings)
}

/// The reference's full step before the optimiser, in the arithmetic of choice.
pub fn answer_in<R: Real>(
    cloud: &GaussianCloud,
    view: &View,
    photo: &[[f32; 3]],
    settings: &LossSettings,
) -> Answer<R> {
    let gaussians = Gaussian::<R>::of_cloud(cloud);
    let camera = Camera::<R>::of(view);
    let limits = Limits::default();
    let all = |_: usize| R::ONE;
    let degree = |_: usize| cloud.sh_degree;
    let rendered = forward(&gaussians, &camera, degree, all, &limits);
    let rgb: Vec<_> = photo.iter().map(|p| p.map(|v| R::of(v.into()))).collect();
    let target =
        Target { width: view.intrinsics.width as usize, rgb: &rgb, depth: None, kept: None, background: [R::ZERO; 3] };
    let exposure = Exposure::default();
    let gradient = backward(&gaussians, &camera, degree, all, &limits, &rendered, &target, &exposure, settings);
    Answer {
        picture: rendered.picture,
        instances: rendered.instances.gaussians.len(),
        culled: rendered.culled,
        gradient,
    }
}

/// A trainer with `cloud` loaded and room for two views of `view`'s size.
///
/// # Errors
/// The device refuses the plan or the scene.
pub fn trainer(gpu: &Gpu, cloud: &GaussianCloud, view: &View, settings: &TrainSettings) -> Result<Fixture, Broken> {
    let mut trainer = empty_trainer(gpu, cloud.sh_degree, cloud.len().max(256), view, settings)?;
    trainer.load(cloud)?;
    Ok(trainer)
}

/// A trainer with room for `capacity` Gaussians, none of them loaded.
///
/// # Errors
/// The device refuses the plan.
pub fn empty_trainer(
    gpu: &Gpu,
    sh_degree: u8,
    capacity: usize,
    view: &View,
    settings: &TrainSettings,
) -> Result<Fixture, Broken> {
    let request = PlanRequest {
        device_mib: 64,
        width: view.intrinsics.width,
        height: view.intrinsics.height,
        views: 2,
        sh_degree,
        max_gaussians: Some(capacity),
        scene_gaussians: None,
        ..Default::default()
    };
    Ok(Fixture::new(gpu, &Plan::new(&request)?, settings)?)
}

/// Parameter `k` of row `i`: mean, log scale, rotation, opacity, SH.
pub fn parameter(cloud: &mut GaussianCloud, i: usize, k: usize) -> &mut f32 {
    let stride = cloud.sh_stride();
    match k {
        0..3 => &mut cloud.means[i][k],
        3..6 => &mut cloud.log_scales[i][k - 3],
        6..10 => &mut cloud.rotations[i][k - 6],
        10 => &mut cloud.opacity_logits[i],
        _ => &mut cloud.sh[i * stride + k - 11],
    }
}
