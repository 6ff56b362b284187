//! Differences of heights between two maps, each with its standard deviation.

use glam::{DVec2, DVec3};

use super::Dated;
use super::register::{Registration, sloped};
use crate::heights::Heights;
use crate::noise::Noise;

/// A height that the other map has within this many pixels is no difference; more where the shift is known less well.
const WITHIN: f64 = 1.0;
/// Standard deviations of the shift that edges may be off by.
const EDGE_SIGMAS: f64 = 2.0;
/// Pixels around a place that are searched at most.
const MOST_WITHIN: f64 = 6.0;

/// Heights of the newer map less those of the older one, on the newer one's pixels.
pub struct Difference {
    /// The newer map's pixels.
    pub grid: Heights,
    /// Metres; NaN where one of the two saw nothing.
    pub metres: Vec<f32>,
    /// Standard deviation, metres.
    pub sigma: Vec<f32>,
    /// What no edge and no slope explains of it, metres; zero where the other map has such a height close by.
    pub beyond: Vec<f32>,
    /// Errors nearer to each other than this are one, metres.
    pub reach_m: f64,
    /// Standard deviation of what all heights are off by together, metres.
    pub bias_m: f64,
}

/// Compares.
pub fn compare(old: &Dated, new: &Dated, registration: &Registration) -> Difference {
    let (told, [w, h]) = ([old, new].map(|dated| dated.sigmas.as_ref()), new.heights.size());
    let (old, new) = (&old.heights, &new.heights);
    let shift = DVec3::from(registration.shift_m);
    // The older map on the newer one's pixels.
    let moved: Vec<f32> = (0..w * h)
        .map(|i| {
            let place = new.place(DVec2::new((i % w) as f64 + 0.5, (i / w) as f64 + 0.5)) - shift.truncate();
            old.height(place).map_or(f32::NAN, |z| (z + shift.z) as f32)
        })
        .collect();
    let before = new.with_values(moved);
    let edge = EDGE_SIGMAS * registration.sigma_m[0].max(registration.sigma_m[1]) / new.gsd();
    let within = (WITHIN + edge).min(MOST_WITHIN);
    let mut metres = vec![f32::NAN; w * h];
    let mut sigma = vec![f32::NAN; w * h];
    for i in 0..w * h {
        let (x, y) = (i % w, i / w);
        let Some((a, b)) = before.at(x, y).zip(new.at(x, y)) else { continue };
        let place = new.place(DVec2::new(x as f64 + 0.5, y as f64 + 0.5));
        // What the maps say of this place, and never less than what they differ by where nothing changed.
        let said = [told[0].map(|map| map.height(place - shift.truncate())), told[1].map(|map| map.at(x, y))];
        let Some(said) = said.into_iter().flatten().map(|sigma| sigma.map(|s| s * s)).sum::<Option<f64>>() else {
            continue;
        };
        metres[i] = (b - a) as f32;
        let slope = sloped(&before, place).map_or(DVec2::ZERO, |(_, slope)| slope);
        let way = DVec3::new(-slope.x, -slope.y, 1.0);
        let variance = registration.noise_m.powi(2).max(said) + way.dot(registration.covariance * way).max(0.0);
        sigma[i] = variance.sqrt() as f32;
    }
    let unexplained = [outside(new, &before, within), outside(&before, new, within)];
    let beyond = (0..w * h)
        .map(|i| {
            // Of both views of an edge the one that explains more.
            let [a, b] = [unexplained[0][i], -unexplained[1][i]];
            if !metres[i].is_finite() || a * b <= 0.0 {
                0.0
            } else if a.abs() < b.abs() {
                a
            } else {
                b
            }
        })
        .collect();
    // In the difference the ground itself is gone: what is left is noise, and little that changed.
    let apart = new.with_values(metres.clone());
    let reach_m = Noise::of(&apart).map_or(new.gsd(), |noise| noise.reach_m);
    Difference { grid: new.clone(), metres, sigma, beyond, reach_m, bias_m: registration.sigma_m[2] }
}

/// How far each height of `a` lies outside of those that `b` has within a distance of pixels.
fn outside(a: &Heights, b: &Heights, within: f64) -> Vec<f32> {
    let [w, h] = a.size();
    let low = filtered(b, within, f64::min);
    let high = filtered(b, within, f64::max);
    (0..w * h)
        .map(|i| match a.at(i % w, i / w) {
            Some(z) if low[i].is_finite() => {
                let (z, low, high) = (z as f32, low[i], high[i]);
                if z > high {
                    z - high
                } else if z < low {
                    z - low
                } else {
                    0.0
                }
            }
            _ => 0.0,
        })
        .collect()
}

/// The least or greatest height within a square of so many pixels, rows first, then columns.
fn filtered(heights: &Heights, within: f64, pick: fn(f64, f64) -> f64) -> Vec<f32> {
    let [w, h] = heights.size();
    let reach = within.round() as usize;
    let picked = |near: &mut dyn Iterator<Item = f64>| near.reduce(pick).map_or(f32::NAN, |z| z as f32);
    let rows: Vec<f32> = (0..w * h)
        .map(|i| {
            let (x, y) = (i % w, i / w);
            picked(&mut (x.saturating_sub(reach)..(x + reach + 1).min(w)).filter_map(|x| heights.at(x, y)))
        })
        .collect();
    (0..w * h)
        .map(|i| {
            let (x, y) = (i % w, i / w);
            let column = (y.saturating_sub(reach)..(y + reach + 1).min(h)).map(|y| f64::from(rows[y * w + x]));
            picked(&mut column.filter(|z| z.is_finite()))
        })
        .collect()
}
