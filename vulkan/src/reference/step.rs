//! One view, forward and backward: what a training step computes before the optimiser.

use config::training::LossSettings;

use super::camera::Camera;
use super::emit::{Instances, emit};
use super::entropy::entropy_gradient;
use super::gaussian::Gaussian;
use super::loss::{Exposure, Loss, Target, loss};
use super::project::{Culled, Limits, Projected, project};
use super::project_backward::project_backward;
use super::rasterise::{Pixel, rasterise, rasterise_backward};
use super::real::Real;
use super::view_dependence::magnitude_gradient;

/// What the forward half leaves behind.
#[derive(Clone, Debug)]
pub struct Forward<R> {
    /// What each Gaussian became.
    pub projected: Vec<Option<Projected<R>>>,
    /// Why the others were not drawn.
    pub culled: Vec<Option<Culled>>,
    /// Who is drawn where.
    pub instances: Instances,
    /// The picture, row-major.
    pub picture: Vec<Pixel<R>>,
}

/// Renders a cloud. `degree` gives each Gaussian's own SH degree, `opacity_scale` DropGaussian's factor.
pub fn forward<R: Real>(
    cloud: &[Gaussian<R>],
    camera: &Camera<R>,
    degree: impl Fn(usize) -> u8,
    opacity_scale: impl Fn(usize) -> R,
    limits: &Limits,
) -> Forward<R> {
    let results: Vec<_> =
        cloud.iter().enumerate().map(|(i, g)| project(g, camera, degree(i), opacity_scale(i), limits)).collect();
    let projected: Vec<_> = results.iter().map(|r| r.ok()).collect();
    let instances = emit(&projected, camera, limits);
    let picture = rasterise(&projected, &instances, camera, limits);
    Forward { projected, culled: results.into_iter().map(Result::err).collect(), instances, picture }
}

/// Gradients of one view's loss.
#[derive(Clone, Debug)]
pub struct ViewGradient<R> {
    /// The loss, its terms, and the gradient of exposure.
    pub loss: Loss<R>,
    /// Per Gaussian; zero where it was not drawn.
    pub gaussians: Vec<Gaussian<R>>,
    /// Whether the Gaussian was drawn (its Adam step is not deferred).
    pub seen: Vec<bool>,
    /// Size of the positional gradient in the picture, for density control.
    pub position: Vec<R>,
    /// ω, v of the camera.
    pub pose: [R; 6],
}

/// Loss and gradients of a view rendered by [`forward`] with the same arguments.
#[expect(clippy::too_many_arguments, reason = "the arguments of `forward` once more, and the target's")]
pub fn backward<R: Real>(
    cloud: &[Gaussian<R>],
    camera: &Camera<R>,
    degree: impl Fn(usize) -> u8,
    opacity_scale: impl Fn(usize) -> R,
    limits: &Limits,
    rendered: &Forward<R>,
    target: &Target<R>,
    exposure: &Exposure<R>,
    settings: &LossSettings,
) -> ViewGradient<R> {
    let loss = loss(&rendered.picture, target, exposure, settings);
    let raster = rasterise_backward(
        &rendered.projected,
        &rendered.instances,
        camera,
        limits,
        &rendered.picture,
        &loss.gradient,
        settings.freeze_shape,
    );
    let mut out = ViewGradient {
        loss,
        gaussians: vec![Gaussian::default(); cloud.len()],
        seen: vec![false; cloud.len()],
        position: raster.position,
        pose: [R::ZERO; 6],
    };
    for (i, g) in cloud.iter().enumerate().filter(|(i, _)| rendered.projected[*i].is_some()) {
        let up = &raster.projected[i];
        if let Ok((gradient, pose)) = project_backward(g, camera, degree(i), opacity_scale(i), limits, up) {
            out.gaussians[i] = gradient;
            out.seen[i] = true;
            for k in 0..6 {
                out.pose[k] += pose[k];
            }
        }
    }
    let seen = out.seen.iter().filter(|seen| **seen).count();
    let weight = R::of(f64::from(settings.entropy) / seen.max(1) as f64);
    let sh_weight = R::of(f64::from(settings.view_dependence));
    for (i, g) in cloud.iter().enumerate().filter(|(i, _)| out.seen[*i]) {
        out.gaussians[i].opacity_logit += weight * entropy_gradient(g.opacity_logit);
        let by_sh = out.gaussians[i].sh.as_flattened_mut().iter_mut().zip(g.sh.as_flattened()).skip(3);
        // Where the picture has no gradient it does not show the Gaussian, or not that degree.
        for (by, c) in by_sh.filter(|(by, _)| **by != R::ZERO) {
            *by += sh_weight * magnitude_gradient(*c);
        }
    }
    out
}
