//! A rendering's colours fitted to a picture's, as papers on large scenes do before they compare (VastGaussian, after Mip-NeRF 360): no
//! model can know the exposure and white balance of a picture that it has not seen.

use nalgebra::{Matrix4, Matrix4x3};

/// What holds the fit together where a picture has fewer colours than it has unknowns, in pixels.
const HELD: f64 = 1e-3;

/// `rgb` (interleaved, 0…1) under the affine map of colours that brings it closest to `target` in least squares, clipped to 0…1;
/// as it is where no map does.
pub fn colors_fitted(rgb: &[f32], target: &[f32]) -> Vec<f32> {
    let homogeneous = |p: &[f32]| [f64::from(p[0]), f64::from(p[1]), f64::from(p[2]), 1.0];
    let (mut normal, mut rest) = (Matrix4::<f64>::identity() * HELD, Matrix4x3::<f64>::zeros());
    // Towards leaving colours as they are.
    (0..3).for_each(|c| rest[(c, c)] = HELD);
    for (p, t) in rgb.chunks_exact(3).zip(target.chunks_exact(3)) {
        let p = homogeneous(p);
        for i in 0..4 {
            (0..4).for_each(|j| normal[(i, j)] += p[i] * p[j]);
            (0..3).for_each(|c| rest[(i, c)] += p[i] * f64::from(t[c]));
        }
    }
    let map = normal.cholesky().map(|factor| factor.solve(&rest)).filter(|map| map.iter().all(|v| v.is_finite()));
    let Some(map) = map else { return rgb.to_vec() };
    let mapped = |p: &[f32]| -> [f32; 3] {
        let p = homogeneous(p);
        std::array::from_fn(|c| (0..4).map(|i| p[i] * map[(i, c)]).sum::<f64>().clamp(0.0, 1.0) as f32)
    };
    rgb.chunks_exact(3).flat_map(mapped).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn picture() -> Vec<f32> {
        (0..3 * 400).map(|i| ((i * i * 7 + i) % 101) as f32 / 150.0 + 0.1).collect()
    }

    #[test]
    fn exposure_and_white_balance_are_fitted_and_nothing_else() {
        let seen = picture();
        let other: Vec<f32> = seen.iter().enumerate().map(|(i, v)| v * [1.3, 1.0, 0.7][i % 3] + 0.02).collect();
        let clipped: Vec<f32> = other.iter().map(|v| v.min(1.0)).collect();
        assert!(crate::metrics::psnr(&seen, &clipped) < 20.0);
        assert!(crate::metrics::psnr(&colors_fitted(&seen, &clipped), &clipped) > 60.0);
        // A texture in another place is no matter of colours.
        let moved: Vec<f32> = seen.iter().cycle().skip(300).take(seen.len()).copied().collect();
        assert!(crate::metrics::psnr(&colors_fitted(&seen, &moved), &moved) < 20.0);
    }

    #[test]
    fn a_picture_of_one_colour_and_one_that_is_not_finite_are_survived() {
        let (flat, gray) = (vec![0.5; 60], vec![0.25; 60]);
        assert!(crate::metrics::psnr(&colors_fitted(&flat, &gray), &gray) > 50.0);
        assert!(colors_fitted(&[], &[]).is_empty());
        assert!(colors_fitted(&[f32::NAN; 6], &[0.5; 6]).iter().all(|v| v.is_nan()));
    }
}
