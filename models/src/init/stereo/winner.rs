//! The cheapest plane of each cell, its place between planes, and how sure it is.

use super::semi_global::Paths;
use super::volume::{Inverse, Volume};
use super::{PLANES, UNIT};

/// Planes around the winner that are not its rivals.
const NEAR: usize = 2;
/// Paths that are summed.
const PATHS: f32 = 8.0;
/// The chance of a depth, as a logistic function of its windows' correlation and of the logarithm of its margin: fitted to the depths
/// of sheffield_cross's pictures, every third one, against those of a model of all pictures. The fit is of the smoothness of few
/// sources. With more sources margins are smaller: there it orders depths and is no calibrated probability.
const CHANCE: [f32; 3] = [0.043, 7.47, 0.62];
/// Keeps the logarithm finite where two planes cost the same.
const NO_MARGIN: f32 = 0.05;
/// Where windows do not agree, the paths still say where the surroundings lie: better than a plane through the picture, which fills
/// places of no confidence.
const LEAST: f32 = 0.04;

pub fn choose(paths: &Paths, volume: &Volume, inverse: Inverse, (depth, confidence): (&mut Vec<f32>, &mut Vec<f32>)) {
    let n = paths.sums.len();
    for out in [&mut *depth, &mut *confidence] {
        out.clear();
        out.reserve_exact(n);
    }
    for (i, sums) in paths.sums.iter().enumerate() {
        let least = sums.iter().copied().fold(i16::MAX, i16::min);
        let plane = sums.iter().position(|s| *s == least).unwrap_or(0);
        let k = plane.clamp(1, PLANES - 2);
        // The vertex of the parabola through three sums.
        let [before, at, after] = [k - 1, k, k + 1].map(|d| f32::from(sums[d]));
        let bend = (before - 2.0 * at + after).max(1e-3);
        let offset = (0.5 * (before - after) / bend).clamp(-0.5, 0.5);
        let cheapest = |planes: std::ops::Range<usize>| sums[planes].iter().copied().fold(i16::MAX, i16::min);
        let rival = cheapest(0..plane.saturating_sub(NEAR)).min(cheapest((plane + NEAR + 1).min(PLANES)..PLANES));
        let margin = (f32::from(rival) - f32::from(least)) / (PATHS * UNIT as f32);
        let correlation = 1.0 - f32::from(volume.costs[plane * n + i]) / UNIT as f32;
        depth.push(1.0 / inverse.at(k as f32 + offset));
        // Of a place that windows agree on by half the pictures know half.
        confidence.push((chance(correlation, margin) * correlation).max(LEAST));
    }
}

/// Chance that a depth is right within 5 %.
fn chance(correlation: f32, margin: f32) -> f32 {
    let [constant, of_correlation, of_margin] = CHANCE;
    let x = constant + of_correlation * correlation + of_margin * (margin + NO_MARGIN).ln();
    1.0 / (1.0 + (-x).exp())
}
