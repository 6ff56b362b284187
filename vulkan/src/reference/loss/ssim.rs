//! SSIM with an 11 × 11 Gaussian window (σ = 1.5), zero outside the picture, as in 3DGS; and its gradient.
//!
//! S = A₁A₂/(B₁B₂) with A₁ = 2μxμy + C₁, A₂ = 2σxy + C₂, B₁ = μx² + μy² + C₁, B₂ = σx² + σy² + C₂ (Wang et al. 2004).
//! Rounding may make a variance negative on constant pictures: it is then 0. C₂ > 0 keeps B₂ positive.

use crate::constants::{SSIM_C1, SSIM_C2, SSIM_RADIUS, SSIM_WINDOW};
use crate::reference::real::Real;

/// Separable convolution with the window; the window is symmetric, so this is its own adjoint.
fn blur<R: Real>(image: &[R], width: usize) -> Vec<R> {
    let height = image.len() / width.max(1);
    let tap = |k: usize| R::of(SSIM_WINDOW[k.abs_diff(SSIM_RADIUS)].into());
    let along = |source: &[R], x: usize, y: usize, dx: usize, dy: usize| -> R {
        (0..=2 * SSIM_RADIUS)
            .filter_map(|k| {
                let (px, py) =
                    ((x + k * dx).checked_sub(SSIM_RADIUS * dx)?, (y + k * dy).checked_sub(SSIM_RADIUS * dy)?);
                (px < width && py < height).then(|| source[py * width + px] * tap(k))
            })
            .sum()
    };
    let pass = |source: &[R], dx: usize, dy: usize| -> Vec<R> {
        (0..source.len()).map(|i| along(source, i % width, i / width, dx, dy)).collect()
    };
    pass(&pass(image, 1, 0), 0, 1)
}

/// Mean SSIM of one channel and its gradient to `x`.
pub fn ssim<R: Real>(x: &[R], y: &[R], width: usize) -> (R, Vec<R>) {
    let n = x.len();
    let product = |a: &[R], b: &[R]| -> Vec<R> { a.iter().zip(b).map(|(a, b)| *a * *b).collect() };
    let (mx, my) = (blur(x, width), blur(y, width));
    let (xx, yy, xy) = (blur(&product(x, x), width), blur(&product(y, y), width), blur(&product(x, y), width));
    let (c1, c2, two) = (R::of(SSIM_C1.into()), R::of(SSIM_C2.into()), R::of(2.0));
    let mean = R::of(1.0 / n.max(1) as f64);
    let mut total = R::ZERO;
    let (mut g_mean, mut g_square, mut g_cross) = (vec![R::ZERO; n], vec![R::ZERO; n], vec![R::ZERO; n]);
    for i in 0..n {
        let vx = (xx[i] - mx[i] * mx[i]).max(R::ZERO);
        let vy = (yy[i] - my[i] * my[i]).max(R::ZERO);
        let cov = xy[i] - mx[i] * my[i];
        let (a1, a2) = (two * mx[i] * my[i] + c1, two * cov + c2);
        let (b1, b2) = (mx[i] * mx[i] + my[i] * my[i] + c1, vx + vy + c2);
        let s = a1 * a2 / (b1 * b2);
        total += s * mean;
        let d_cross = two * a1 / (b1 * b2);
        let d_square = -s / b2;
        g_cross[i] = d_cross * mean;
        g_square[i] = d_square * mean;
        g_mean[i] =
            (two * my[i] * a2 / (b1 * b2) - two * mx[i] * s / b1 - my[i] * d_cross - two * mx[i] * d_square) * mean;
    }
    let (gm, gs, gc) = (blur(&g_mean, width), blur(&g_square, width), blur(&g_cross, width));
    (total, (0..n).map(|i| gm[i] + two * x[i] * gs[i] + y[i] * gc[i]).collect())
}
