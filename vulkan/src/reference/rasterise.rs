//! Stages *rasterise* and *rasterise_backward*: tiles → colour, depth, transmittance; and back.
//!
//! Forward (3DGS eq. 3, the paper's depth equation): per pixel, near to far, αᵢ = min(0.999, oᵢ e^{−σᵢ}) with
//! σ = ½ dᵀΣ₂⁻¹d; skipped below 1/255; C = Σ cᵢ αᵢ Tᵢ, D = Σ zᵢ αᵢ Tᵢ, T_{i+1} = Tᵢ (1 − αᵢ); a pixel ends
//! *before* the Gaussian that would bring T below 1e-4.
//!
//! Backward walks in the same direction, so that T is reproduced by the same multiplications; what lies behind
//! Gaussian i is the pixel's total minus what has been passed: dL/dαᵢ = Tᵢ (cᵢ·g) − (rest behind)/(1 − αᵢ).

use super::camera::{Camera, Rays};
use super::emit::{Instances, tile_grid};
use super::project::{Limits, Projected};
use super::real::Real;
use crate::constants::{ALPHA_MAX, TILE_HEIGHT, TILE_WIDTH};

/// What a pixel receives, or the loss' gradient to it.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Pixel<R> {
    /// Linear colour, without background.
    pub rgb: [R; 3],
    /// Alpha-blended depth, metres (not divided by the coverage); with parallel rays the median: where half of the light is
    /// gone.
    pub depth: R,
    /// What is left of the light from behind everything.
    pub transmittance: R,
}

/// One evaluation of α at a pixel.
struct Hit<R> {
    d: [R; 2],
    falloff: R,
    alpha: R,
    saturated: bool,
}

fn hit<R: Real>(p: &Projected<R>, x: u32, y: u32, limits: &Limits) -> Option<Hit<R>> {
    let d = [R::of(f64::from(x) + 0.5) - p.mean2d[0], R::of(f64::from(y) + 0.5) - p.mean2d[1]];
    let sigma = R::of(0.5) * (p.conic[0] * d[0] * d[0] + p.conic[2] * d[1] * d[1]) + p.conic[1] * d[0] * d[1];
    // Σ₂ is positive definite, so a negative σ is rounding near the centre: α is the peak there, never more.
    let sigma = sigma.max(R::ZERO);
    let falloff = (-sigma).exp();
    let raw = p.opacity * falloff;
    let alpha = raw.min(R::of(ALPHA_MAX.into()));
    // Written so that NaN is skipped.
    if !(alpha >= R::of(limits.alpha_min) && alpha > R::ZERO) {
        return None;
    }
    Some(Hit { d, falloff, alpha, saturated: raw > R::of(ALPHA_MAX.into()) })
}

fn for_each_pixel(size: [u32; 2], mut visit: impl FnMut(usize, u32, u32)) {
    let [across, down] = tile_grid(size);
    for tile in 0..across * down {
        let (x0, y0) = ((tile % across) * TILE_WIDTH, (tile / across) * TILE_HEIGHT);
        for y in y0..(y0 + TILE_HEIGHT).min(size[1]) {
            for x in x0..(x0 + TILE_WIDTH).min(size[0]) {
                visit(tile as usize, x, y);
            }
        }
    }
}

/// Draws the picture, row-major.
pub fn rasterise<R: Real>(
    projected: &[Option<Projected<R>>],
    instances: &Instances,
    camera: &Camera<R>,
    limits: &Limits,
) -> Vec<Pixel<R>> {
    let half = R::of(0.5);
    let mut picture = vec![Pixel::default(); (camera.size[0] * camera.size[1]) as usize];
    for_each_pixel(camera.size, |tile, x, y| {
        let out = &mut picture[(y * camera.size[0] + x) as usize];
        out.transmittance = R::ONE;
        for i in &instances.gaussians[instances.ranges[tile] as usize..instances.ranges[tile + 1] as usize] {
            let Some(p) = &projected[*i as usize] else { continue };
            let Some(h) = hit(p, x, y, limits) else { continue };
            let next = out.transmittance * (R::ONE - h.alpha);
            if next < R::of(limits.transmittance_min) {
                break;
            }
            let weight = out.transmittance * h.alpha;
            for c in 0..3 {
                out.rgb[c] += p.colour[c] * weight;
            }
            match camera.rays {
                Rays::Perspective => out.depth += p.depth * weight,
                Rays::Orthographic if out.transmittance > half && next <= half => out.depth = p.depth,
                Rays::Orthographic => {}
            }
            out.transmittance = next;
        }
    });
    picture
}

/// Per-Gaussian gradients in the picture, plus the size of the positional gradient for density control.
#[derive(Clone, Debug, Default)]
pub struct RasterGradient<R> {
    /// dL/d[`Projected`], one per Gaussian (zero where nothing was drawn).
    pub projected: Vec<Projected<R>>,
    /// Σ over instances of ‖Σ over the tile's pixels of dL/dmean2d‖.
    pub position: Vec<R>,
}

/// Sends the loss' gradient per pixel back to the projected Gaussians.
///
/// `freeze_shape`: the depth's part of dL/dα moves centres and opacities but not the conic (paper, shape freezing).
pub fn rasterise_backward<R: Real>(
    projected: &[Option<Projected<R>>],
    instances: &Instances,
    camera: &Camera<R>,
    limits: &Limits,
    picture: &[Pixel<R>],
    upstream: &[Pixel<R>],
    freeze_shape: bool,
) -> RasterGradient<R> {
    let n = projected.len();
    let mut slots = vec![Projected::<R>::default(); instances.gaussians.len()];
    for_each_pixel(camera.size, |tile, x, y| {
        let at = (y * camera.size[0] + x) as usize;
        let (total, g) = (&picture[at], &upstream[at]);
        let dot_rgb = |c: &[R; 3]| c[0] * g.rgb[0] + c[1] * g.rgb[1] + c[2] * g.rgb[2];
        // What is still behind, as seen by the loss: colour with background, and depth.
        let mut behind_rgb = dot_rgb(&total.rgb);
        let mut behind_depth = total.depth * g.depth;
        let through = total.transmittance * g.transmittance;
        let mut t = R::ONE;
        for at in instances.ranges[tile] as usize..instances.ranges[tile + 1] as usize {
            let Some(p) = &projected[instances.gaussians[at] as usize] else { continue };
            let Some(h) = hit(p, x, y, limits) else { continue };
            let open = R::ONE - h.alpha;
            let next = t * open;
            if next < R::of(limits.transmittance_min) {
                break;
            }
            let weight = t * h.alpha;
            let lit = dot_rgb(&p.colour);
            behind_rgb -= lit * weight;
            behind_depth -= p.depth * g.depth * weight;
            let d_rgb = t * lit - (behind_rgb + through) / open;
            let d_depth = t * p.depth * g.depth - behind_depth / open;
            let slot = &mut slots[at];
            for c in 0..3 {
                slot.colour[c] += weight * g.rgb[c];
            }
            slot.depth += weight * g.depth;
            t = next;
            if h.saturated {
                continue;
            }
            let d_alpha = d_rgb + d_depth;
            slot.opacity += h.falloff * d_alpha;
            // α = o e^{−σ}: dL/dσ = −α dL/dα, and d = pixel − mean.
            let d_sigma = -h.alpha * d_alpha;
            let d_shape = if freeze_shape { -h.alpha * d_rgb } else { d_sigma };
            let half = R::of(0.5);
            slot.conic[0] += half * h.d[0] * h.d[0] * d_shape;
            slot.conic[1] += h.d[0] * h.d[1] * d_shape;
            slot.conic[2] += half * h.d[1] * h.d[1] * d_shape;
            slot.mean2d[0] -= (p.conic[0] * h.d[0] + p.conic[1] * h.d[1]) * d_sigma;
            slot.mean2d[1] -= (p.conic[1] * h.d[0] + p.conic[2] * h.d[1]) * d_sigma;
        }
    });
    let mut out = RasterGradient { projected: vec![Projected::default(); n], position: vec![R::ZERO; n] };
    for (slot, i) in slots.iter().zip(&instances.gaussians) {
        let to = &mut out.projected[*i as usize];
        for k in 0..2 {
            to.mean2d[k] += slot.mean2d[k];
        }
        for k in 0..3 {
            to.conic[k] += slot.conic[k];
            to.colour[k] += slot.colour[k];
        }
        to.opacity += slot.opacity;
        to.depth += slot.depth;
        out.position[*i as usize] += (slot.mean2d[0] * slot.mean2d[0] + slot.mean2d[1] * slot.mean2d[1]).sqrt();
    }
    out
}
