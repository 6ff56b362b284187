//! The motion that brings an older map onto a newer one: a shift in three directions, by the slopes of the ground (Nuth and Kääb 2011),
//! robustly, from coarse to fine.
//!
//! Of h_new(p) = h_old(p − d) + z the differences of heights are −∇h·d + z to first order. Ground that changed is far from that, and its
//! weight falls to nothing (Tukey's biweight). What the ground does not tell (the shift on a plain) stays at zero, within [`EXPECTED_M`].

use glam::{DMat3, DVec2, DVec3};

use crate::MeasureError;
use crate::heights::Heights;

/// Standard deviation of a shift that is expected of GPS, metres.
pub const EXPECTED_M: f64 = 3.0;
/// Coarser pixels, in pixels, one after the other.
const PYRAMID: [usize; 4] = [16, 8, 4, 2];
/// Steps at each.
const STEPS: usize = 8;
/// Differences beyond this many standard deviations have no weight.
const BIWEIGHT: f64 = 4.685;
/// Of a median of absolute values to a standard deviation.
const NORMAL: f64 = 1.4826;
/// Pixels that both maps hold at the coarsest level that is used.
const FEWEST: usize = 64;
/// Less of the common ground than this unchanged, and nothing says which part is.
const LEAST_UNCHANGED: f64 = 0.4;

/// A shift of a map and what it is worth.
#[derive(Clone, Copy, Debug, PartialEq, serde::Serialize)]
pub struct Registration {
    /// East, north, up, metres: the older map is moved by it.
    pub shift_m: [f64; 3],
    /// Its standard deviations.
    pub sigma_m: [f64; 3],
    /// Its covariance.
    #[serde(skip)]
    pub covariance: DMat3,
    /// Share of the common ground that fits the shift.
    pub unchanged: f64,
    /// Standard deviation of a difference of heights where nothing changed, metres.
    pub noise_m: f64,
}

/// Finds it.
///
/// # Errors
/// Too little ground in common, or too little of it unchanged.
pub fn register(old: &Heights, new: &Heights) -> Result<Registration, MeasureError> {
    let mut shift = DVec3::ZERO;
    let mut found = None;
    for side in PYRAMID {
        let (coarse_old, coarse_new) = (old.coarser(side), new.coarser(side));
        for step in 0..STEPS {
            let Some(fit) = fit(&coarse_old, &coarse_new, shift) else { break };
            shift += fit.step;
            let small = fit.step.abs().max_element() < 1e-3 * new.gsd();
            found = Some(fit);
            if small && step > 0 {
                break;
            }
        }
    }
    let fit = found.ok_or_else(|| MeasureError::Request("the two maps have too little ground in common".into()))?;
    if fit.unchanged < LEAST_UNCHANGED {
        return Err(MeasureError::Request(format!(
            "{:.0} % of the ground that both maps hold fits one motion; at least {:.0} % must not have changed",
            100.0 * fit.unchanged,
            100.0 * LEAST_UNCHANGED
        )));
    }
    let c = fit.covariance;
    let sigma = DVec3::new(c.x_axis.x, c.y_axis.y, c.z_axis.z).max(DVec3::ZERO).map(f64::sqrt);
    Ok(Registration {
        shift_m: shift.to_array(),
        sigma_m: sigma.to_array(),
        covariance: c,
        unchanged: fit.unchanged,
        noise_m: fit.noise_m,
    })
}

struct Fit {
    step: DVec3,
    covariance: DMat3,
    unchanged: f64,
    noise_m: f64,
}

/// One step towards the shift, from where it is.
fn fit(old: &Heights, new: &Heights, shift: DVec3) -> Option<Fit> {
    let [w, h] = new.size();
    let flat = shift.truncate();
    // Slopes of the older map, and differences, where both have heights.
    let mut rows: Vec<(DVec3, f64)> = Vec::new();
    for y in 0..h {
        for x in 0..w {
            let Some(height) = new.at(x, y) else { continue };
            let place = new.place(DVec2::new(x as f64 + 0.5, y as f64 + 0.5)) - flat;
            let Some((before, slope)) = sloped(old, place) else { continue };
            rows.push((DVec3::new(-slope.x, -slope.y, 1.0), height - before - shift.z));
        }
    }
    if rows.len() < FEWEST {
        return None;
    }
    let mut off: Vec<f64> = rows.iter().map(|r| r.1).collect();
    let middle = geometry::median(&mut off)?;
    off.iter_mut().for_each(|d| *d = (*d - middle).abs());
    let mut scale = (NORMAL * geometry::median(&mut off)?).max(1e-6);
    let mut step = DVec3::new(0.0, 0.0, middle);
    // The expected shift as three observations of zero.
    let prior = DMat3::from_diagonal(DVec3::new(EXPECTED_M.powi(-2), EXPECTED_M.powi(-2), 0.0));
    let mut covariance = DMat3::ZERO;
    let mut unchanged = 0.0;
    for _ in 0..STEPS {
        let (mut normal, mut right, mut kept) = (DMat3::ZERO, DVec3::ZERO, 0usize);
        for (slope, difference) in &rows {
            let t = (difference - slope.dot(step)) / (BIWEIGHT * scale);
            if t.abs() >= 1.0 {
                continue;
            }
            let weight = (1.0 - t * t).powi(2) / (scale * scale);
            normal += weight * DMat3::from_cols(*slope * slope.x, *slope * slope.y, *slope * slope.z);
            right += weight * *slope * *difference;
            kept += 1;
        }
        normal += prior;
        // The prior is of the whole shift, not of this step.
        right -= prior * shift;
        let inverse = normal.inverse();
        if !inverse.is_finite() {
            return None;
        }
        (step, covariance, unchanged) = (inverse * right, inverse, kept as f64 / rows.len() as f64);
        let mut rest: Vec<f64> = rows.iter().map(|(s, d)| (d - s.dot(step)).abs()).collect();
        scale = (NORMAL * geometry::median(&mut rest)?).max(1e-6);
    }
    // Errors of neighbours agree: as many as a reach of two of these pixels holds count as one.
    Some(Fit { step, covariance: covariance * 4.0, unchanged, noise_m: scale })
}

/// Height and slope at a place.
pub(super) fn sloped(heights: &Heights, place: DVec2) -> Option<(f64, DVec2)> {
    let gsd = heights.gsd();
    let at = |dx: f64, dy: f64| heights.height(place + gsd * DVec2::new(dx, dy));
    let (e, w, n, s) = (at(1.0, 0.0)?, at(-1.0, 0.0)?, at(0.0, 1.0)?, at(0.0, -1.0)?);
    Some((at(0.0, 0.0)?, DVec2::new(e - w, n - s) / (2.0 * gsd)))
}
