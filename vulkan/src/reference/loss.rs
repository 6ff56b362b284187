//! Stage *loss*: `λ₁·L1 + λ₂·(1 − SSIM) + λ₃·(1 − ρ(D, D_est))` and its gradient per pixel.
//!
//! The rendering passes through its view's exposure first: x = e^{gain}·(rgb + T·background) + offset, per channel.

pub mod pearson;
pub mod ssim;

use super::rasterise::Pixel;
use super::real::Real;
use config::training::LossSettings;

/// Per-view exposure: log gain and offset of each channel; zero means "as rendered".
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Exposure<R> {
    /// Natural logarithm of the gain, r g b.
    pub log_gain: [R; 3],
    /// Added after the gain, r g b.
    pub offset: [R; 3],
}

/// What a rendering is compared with.
#[derive(Clone, Copy, Debug)]
pub struct Target<'a, R> {
    /// Width of the picture.
    pub width: usize,
    /// The photograph, row-major, 0…1.
    pub rgb: &'a [[R; 3]],
    /// Estimated depth and its confidence, row-major, if there is any.
    pub depth: Option<(&'a [R], &'a [R])>,
    /// Which pixels are compared, row-major; `None`: all. The others count as rendered right.
    pub kept: Option<&'a [bool]>,
    /// Colour behind the scene in this step.
    pub background: [R; 3],
}

/// The value of each term, unweighted, and the gradient of the weighted sum.
#[derive(Clone, Debug, Default)]
pub struct Loss<R> {
    /// Mean |x − y| over pixels and channels.
    pub l1: R,
    /// Mean SSIM over pixels and channels.
    pub ssim: R,
    /// Pearson's ρ of the depths; 1 without a prior, so that the term vanishes.
    pub pearson: R,
    /// The weighted sum.
    pub total: R,
    /// dL/d of every pixel.
    pub gradient: Vec<Pixel<R>>,
    /// dL/d exposure.
    pub exposure: Exposure<R>,
}

/// Compares a rendering with its target.
pub fn loss<R: Real>(
    picture: &[Pixel<R>],
    target: &Target<R>,
    exposure: &Exposure<R>,
    settings: &LossSettings,
) -> Loss<R> {
    let n = picture.len();
    let gain = exposure.log_gain.map(|g| g.exp());
    let behind = |p: &Pixel<R>, c: usize| p.rgb[c] + p.transmittance * target.background[c];
    let kept = |i: usize| target.kept.is_none_or(|kept| kept[i]);
    let mut out = Loss { pearson: R::ONE, gradient: vec![Pixel::default(); n], ..Loss::default() };
    let per_value = R::of(1.0 / (3.0 * n.max(1) as f64));
    for c in 0..3 {
        let x: Vec<R> = picture.iter().map(|p| gain[c] * behind(p, c) + exposure.offset[c]).collect();
        let y: Vec<R> = target.rgb.iter().enumerate().map(|(i, t)| if kept(i) { t[c] } else { x[i] }).collect();
        let (ssim, mut to_x) = ssim::ssim(&x, &y, target.width);
        out.ssim += ssim * R::of(1.0 / 3.0);
        for (i, g) in to_x.iter_mut().enumerate() {
            if !kept(i) {
                *g = R::ZERO;
                continue;
            }
            let difference = x[i] - y[i];
            out.l1 += difference.abs() * per_value;
            *g = -(*g) * R::of(f64::from(settings.ssim) / 3.0);
            if difference != R::ZERO {
                *g += R::of(settings.l1.into()) * per_value * (difference / difference.abs());
            }
            out.exposure.offset[c] += *g;
            out.exposure.log_gain[c] += *g * gain[c] * behind(&picture[i], c);
            out.gradient[i].rgb[c] = *g * gain[c];
            out.gradient[i].transmittance += *g * gain[c] * target.background[c];
        }
    }
    if let Some((prior, confidence)) = target.depth {
        let depth: Vec<R> = picture.iter().map(|p| p.depth).collect();
        let (rho, to_depth) = pearson::pearson(&depth, prior, confidence, R::of(settings.depth_confidence.into()));
        out.pearson = rho;
        for (pixel, g) in out.gradient.iter_mut().zip(to_depth) {
            pixel.depth = -g * R::of(settings.depth.into());
        }
    }
    out.total = R::of(settings.l1.into()) * out.l1
        + R::of(settings.ssim.into()) * (R::ONE - out.ssim)
        + R::of(settings.depth.into()) * (R::ONE - out.pearson);
    out
}
