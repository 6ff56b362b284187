//! Depth where no second picture looks (the rim of the region) or nothing has texture: inverse depth is linear on a
//! plane, so the picture's ground plane plus smoothly spread residuals continues what is known. Used only where no other
//! picture knows better; where the plane recedes beyond the depth range (sky), nothing is invented.

use super::depth_frame::DepthGrid;

/// Confidence from which a depth takes part in the fit.
const TRUSTED: f32 = 0.3;
/// Share of the picture that must be trusted before anything is continued from it.
const MIN_SHARE: f32 = 0.05;
/// Rounds of reweighting; trees and roofs are outliers of the ground.
const ROUNDS: usize = 6;

/// Every how many samples, across and down, takes part in the fit of three numbers.
const STEP: usize = 3;

/// Depths for the whole grid; 0 where nothing should be filled. `None` when too little is known.
pub fn continued(grid: &DepthGrid, range: [f32; 2]) -> Option<Vec<f32>> {
    let (w, h) = (grid.width, grid.height);
    let known: Vec<f32> = (0..w * h)
        .map(|i| if grid.confidence[i] > TRUSTED && grid.depth[i] > 0.0 { 1.0 / grid.depth[i] } else { 0.0 })
        .collect();
    let trusted = known.iter().filter(|v| **v > 0.0).count();
    if (trusted as f32) < MIN_SHARE * (w * h) as f32 {
        return None;
    }
    let plane = fit(&known, w, h)?;
    let at = |i: usize| plane[0] + plane[1] * (i % w) as f32 / w as f32 + plane[2] * (i / w) as f32 / h as f32;
    let residual: Vec<(f32, f32)> =
        known.iter().enumerate().map(|(i, &v)| if v > 0.0 { (v - at(i), 1.0) } else { (0.0, 0.0) }).collect();
    let spread = push_pull(&residual, w, h);
    let (nearest, farthest) = (1.0 / range[0], 1.0 / range[1]);
    Some(
        (0..w * h)
            .map(|i| {
                let inverse = at(i) + spread[i];
                if inverse >= farthest && inverse <= nearest { 1.0 / inverse } else { 0.0 }
            })
            .collect(),
    )
}

/// Robust plane through the known values over 0…1 coordinates: least squares, reweighted by 1/(1 + (r/s)²).
fn fit(known: &[f32], w: usize, h: usize) -> Option<[f32; 3]> {
    let mut plane = [0.0f64; 3];
    let mut scale = f64::INFINITY;
    for _ in 0..ROUNDS {
        let mut a = nalgebra::Matrix3::<f64>::zeros();
        let mut b = nalgebra::Vector3::<f64>::zeros();
        let mut sum = 0.0;
        let mut weights = 0.0;
        let sample = |i: usize| (i % w).is_multiple_of(STEP) && (i / w).is_multiple_of(STEP);
        for (i, &v) in known.iter().enumerate().filter(|(i, v)| **v > 0.0 && sample(*i)) {
            let x = nalgebra::Vector3::new(1.0, (i % w) as f64 / w as f64, (i / w) as f64 / h as f64);
            let r = f64::from(v) - (plane[0] + plane[1] * x[1] + plane[2] * x[2]);
            let weight = if scale.is_finite() { 1.0 / (1.0 + (r / scale).powi(2)) } else { 1.0 };
            a += x * x.transpose() * weight;
            b += x * (weight * f64::from(v));
            sum += weight * r.abs();
            weights += weight;
        }
        let solved = a.cholesky()?.solve(&b);
        // The first round has no residuals yet.
        scale = if scale.is_finite() { (sum / weights).max(1e-9) } else { 1e9 };
        plane = [solved[0], solved[1], solved[2]];
    }
    Some(plane.map(|v| v as f32))
}

/// Fills unknown values by averages of growing neighbourhoods (a pyramid of weighted means, read back bilinearly).
fn push_pull(values: &[(f32, f32)], w: usize, h: usize) -> Vec<f32> {
    if w <= 1 && h <= 1 {
        return values.iter().map(|v| if v.1 > 0.0 { v.0 } else { 0.0 }).collect();
    }
    let (cw, ch) = (w.div_ceil(2), h.div_ceil(2));
    let mut coarse = vec![(0.0f32, 0.0f32); cw * ch];
    for j in 0..h {
        for i in 0..w {
            let (v, weight) = values[j * w + i];
            let c = &mut coarse[(j / 2) * cw + i / 2];
            c.0 += v * weight;
            c.1 += weight;
        }
    }
    for c in &mut coarse {
        *c = if c.1 > 0.0 { (c.0 / c.1, c.1.min(1.0)) } else { (0.0, 0.0) };
    }
    let below = push_pull(&coarse, cw, ch);
    let sample = |i: usize, j: usize| {
        let (x, y) = ((i as f32 - 0.5) / 2.0, (j as f32 - 0.5) / 2.0);
        let (x, y) = (x.clamp(0.0, (cw - 1) as f32), y.clamp(0.0, (ch - 1) as f32));
        let (x0, y0) = (x as usize, y as usize);
        let (x1, y1) = ((x0 + 1).min(cw - 1), (y0 + 1).min(ch - 1));
        let (fx, fy) = (x - x0 as f32, y - y0 as f32);
        let top = below[y0 * cw + x0] * (1.0 - fx) + below[y0 * cw + x1] * fx;
        let bottom = below[y1 * cw + x0] * (1.0 - fx) + below[y1 * cw + x1] * fx;
        top * (1.0 - fy) + bottom * fy
    };
    (0..w * h).map(|k| if values[k].1 > 0.0 { values[k].0 } else { sample(k % w, k / w) }).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn slope(i: usize) -> f32 {
        1.0 / (0.02 + 0.00005 * (i % 64) as f32 - 0.0002 * (i / 64) as f32)
    }

    fn grid(known: impl Fn(usize) -> bool) -> DepthGrid {
        DepthGrid {
            width: 64,
            height: 48,
            stride: 2,
            depth: (0..64 * 48).map(slope).collect(),
            confidence: (0..64 * 48).map(|i| if known(i) { 0.9 } else { 0.0 }).collect(),
        }
    }

    #[test]
    fn the_ground_continues_beyond_what_is_known() {
        let filled = continued(&grid(|i| i % 64 < 32), [10.0, 200.0]).unwrap();
        for i in 0..64 * 48 {
            assert!((filled[i] / slope(i) - 1.0).abs() < 0.01, "{i}: {} {}", filled[i], slope(i));
        }
    }

    #[test]
    fn nothing_is_invented_beyond_the_range_or_from_nothing() {
        let filled = continued(&grid(|i| i / 64 < 24), [10.0, 70.0]).unwrap();
        assert!(filled.iter().enumerate().all(|(i, &d)| if slope(i) > 75.0 {
            d == 0.0
        } else {
            slope(i) > 65.0 || d > 0.0
        }));
        assert!(continued(&grid(|_| false), [10.0, 70.0]).is_none());
    }
}
