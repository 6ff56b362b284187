//! Picture quality as the 3DGS papers measure it, so that figures can be compared with theirs.

use rayon::prelude::*;

mod colors;

pub use colors::colors_fitted;

/// Window of 3DGS's `ssim` (utils/loss_utils.py): 11 × 11, Gaussian with σ = 1.5.
const WINDOW: usize = 11;
const SIGMA: f64 = 1.5;
/// (0.01)² and (0.03)² for a dynamic range of 1 (Wang et al. 2004).
const C1: f64 = 1e-4;
const C2: f64 = 9e-4;

/// Peak signal-to-noise ratio in dB of two equally long slices of values in 0…1; infinite when they are equal, NaN
/// when they are empty or differ in length.
pub fn psnr(a: &[f32], b: &[f32]) -> f64 {
    if a.len() != b.len() || a.is_empty() {
        return f64::NAN;
    }
    let sum: f64 = a.iter().zip(b).map(|(x, y)| f64::from(x - y).powi(2)).sum();
    -10.0 * (sum / a.len() as f64).log10()
}

/// Mean structural similarity of two interleaved RGB pictures (`3·width·height` values in 0…1) over all pixels and
/// channels, with zeros around the border as 3DGS's convolution has them. NaN when a size does not fit.
pub fn ssim(a: &[f32], b: &[f32], width: usize, height: usize) -> f64 {
    ssim_where(a, b, width, height, |_| true)
}

/// As [`ssim`], the mean over the pixels for which `kept` says so; NaN when that is none.
pub fn ssim_where(a: &[f32], b: &[f32], width: usize, height: usize, kept: impl Fn(usize) -> bool + Sync) -> f64 {
    if a.len() != 3 * width * height || b.len() != a.len() || a.is_empty() {
        return f64::NAN;
    }
    let weights = window();
    let total: f64 = (0..3usize)
        .into_par_iter()
        .map(|c| {
            let plane =
                |of: &dyn Fn(usize) -> f64| -> Vec<f64> { (0..width * height).map(|i| of(3 * i + c)).collect() };
            let blur = |of: &dyn Fn(usize) -> f64| blurred(&plane(of), width, height, &weights);
            let (x, y) = (|i: usize| f64::from(a[i]), |i: usize| f64::from(b[i]));
            let (mx, my) = (blur(&x), blur(&y));
            let (xx, yy, xy) = (blur(&|i| x(i) * x(i)), blur(&|i| y(i) * y(i)), blur(&|i| x(i) * y(i)));
            (0..width * height)
                .filter(|i| kept(*i))
                .map(|i| {
                    let (vx, vy, cov) = (xx[i] - mx[i] * mx[i], yy[i] - my[i] * my[i], xy[i] - mx[i] * my[i]);
                    (2.0 * mx[i] * my[i] + C1) * (2.0 * cov + C2)
                        / ((mx[i] * mx[i] + my[i] * my[i] + C1) * (vx + vy + C2))
                })
                .sum::<f64>()
        })
        .sum();
    total / (3 * (0..width * height).filter(|i| kept(*i)).count()) as f64
}

/// 8-bit RGB as interleaved values in 0…1.
pub fn to_f32(image: &image::RgbImage) -> Vec<f32> {
    image.as_raw().iter().map(|&v| f32::from(v) / 255.0).collect()
}

/// Interleaved values in 0…1 as 8-bit RGB, rounded; what is outside, or not a number, is clamped. `None` when the
/// number of values is not `3·width·height`.
pub fn to_rgb8(rgb: &[f32], width: u32, height: u32) -> Option<image::RgbImage> {
    image::RgbImage::from_raw(width, height, rgb.iter().map(|v| (v.clamp(0.0, 1.0) * 255.0).round() as u8).collect())
}

fn window() -> [f64; WINDOW] {
    let mut w = [0.0; WINDOW];
    for (i, v) in w.iter_mut().enumerate() {
        *v = (-((i as f64 - (WINDOW / 2) as f64).powi(2)) / (2.0 * SIGMA * SIGMA)).exp();
    }
    let sum: f64 = w.iter().sum();
    w.map(|v| v / sum)
}

fn blurred(plane: &[f64], width: usize, height: usize, weights: &[f64; WINDOW]) -> Vec<f64> {
    let half = WINDOW / 2;
    let mut rows = vec![0.0; plane.len()];
    for (row, out) in plane.chunks_exact(width).zip(rows.chunks_exact_mut(width)) {
        for (x, o) in out.iter_mut().enumerate() {
            let from = x.saturating_sub(half);
            let to = (x + half + 1).min(width);
            *o = row[from..to].iter().zip(&weights[from + half - x..]).map(|(v, w)| v * w).sum();
        }
    }
    let mut out = vec![0.0; plane.len()];
    for (y, line) in out.chunks_exact_mut(width).enumerate() {
        for from in y.saturating_sub(half)..(y + half + 1).min(height) {
            let w = weights[from + half - y];
            for (o, v) in line.iter_mut().zip(&rows[from * width..(from + 1) * width]) {
                *o += w * v;
            }
        }
    }
    out
}

#[cfg(test)]
mod tests {
    use super::*;

    fn noise(seed: u32, n: usize) -> Vec<f32> {
        let mut s = seed;
        (0..n)
            .map(|_| {
                s = s.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
                (s >> 8) as f32 / (1 << 24) as f32
            })
            .collect()
    }

    #[test]
    fn a_uniform_error_of_a_tenth_is_twenty_decibels() {
        assert!((psnr(&[0.5; 30], &[0.6; 30]) - 20.0).abs() < 1e-5);
        assert_eq!(psnr(&[0.5; 3], &[0.5; 3]), f64::INFINITY);
        assert!(psnr(&[], &[]).is_nan() && psnr(&[0.0], &[0.0, 1.0]).is_nan());
    }

    #[test]
    fn ssim_is_one_for_equal_pictures_and_does_not_depend_on_order() {
        for (w, h) in [(1, 1), (1, 17), (17, 1), (23, 12)] {
            let (a, b) = (noise(1, 3 * w * h), noise(2, 3 * w * h));
            assert!((ssim(&a, &a, w, h) - 1.0).abs() < 1e-12, "{w}x{h}");
            assert!((ssim(&a, &b, w, h) - ssim(&b, &a, w, h)).abs() < 1e-12);
            assert!(ssim(&a, &b, w, h) < 0.9);
        }
    }

    #[test]
    fn ssim_equals_the_direct_two_dimensional_sum() {
        let (w, h) = (14usize, 9usize);
        let (a, b) = (noise(3, 3 * w * h), noise(4, 3 * w * h));
        let g = window();
        let mut total = 0.0;
        for c in 0..3 {
            for y in 0..h as i64 {
                for x in 0..w as i64 {
                    let mut s = [0.0f64; 5];
                    for dy in -5..=5i64 {
                        for dx in -5..=5i64 {
                            let (u, v) = (x + dx, y + dy);
                            if u < 0 || v < 0 || u >= w as i64 || v >= h as i64 {
                                continue;
                            }
                            let k = g[(dx + 5) as usize] * g[(dy + 5) as usize];
                            let i = 3 * (v as usize * w + u as usize) + c;
                            let (p, q) = (f64::from(a[i]), f64::from(b[i]));
                            for (sum, term) in s.iter_mut().zip([p, q, p * p, q * q, p * q]) {
                                *sum += k * term;
                            }
                        }
                    }
                    let [m, n, mm, nn, mn] = s;
                    total += (2.0 * m * n + C1) * (2.0 * (mn - m * n) + C2)
                        / ((m * m + n * n + C1) * (mm - m * m + nn - n * n + C2));
                }
            }
        }
        assert!((ssim(&a, &b, w, h) - total / (3 * w * h) as f64).abs() < 1e-12);
    }
}
