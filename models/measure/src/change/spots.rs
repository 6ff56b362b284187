//! What differs together: spots with their outline, area and volume.

use glam::DVec2;

use super::compare::Difference;
use crate::contours::outlines;
use crate::heights::Heights;
use crate::volume::Measured;

/// A spot begins where a difference is this many standard deviations, and goes on to where it is this many.
const BEGINS: f32 = 3.0;
const GOES_ON: f32 = 1.0;
/// A mean of less than this many of its own standard deviations may be noise.
const SURE: f64 = 5.0;
/// Squares of so many pixels a side tell how far means are off that nothing changed: errors of models reach far.
const SIDES: [usize; 7] = [1, 2, 4, 8, 16, 32, 64];
/// Nine in ten of such means are nearer to zero than this many of their standard deviations, where errors are normal.
const NINE_IN_TEN: f64 = 1.645;
/// Fewer squares tell nothing.
const FEWEST_SQUARES: usize = 50;
/// Independent patches that a spot has at the least.
const LEAST_PATCHES: f64 = 2.0;
/// Pixels that a spot has beyond [`BEGINS`] at the least.
const LEAST_PIXELS: usize = 6;

/// Something that changed.
#[derive(Clone, Debug, PartialEq)]
pub struct Spot {
    /// Its outline, then the outlines of what did not change within it, map coordinates.
    pub rings: Vec<Vec<DVec2>>,
    /// Its middle, map coordinates.
    pub middle: DVec2,
    /// m².
    pub area_m2: f64,
    /// Mean difference of heights; below zero where something is gone.
    pub height_m: Measured,
    /// Greatest difference, metres.
    pub most_m: f64,
    /// What came, or went (below zero).
    pub volume_m3: Measured,
}

/// Finds them, largest volume first.
pub fn find(difference: &Difference) -> Vec<Spot> {
    let [w, h] = difference.grid.size();
    let share = |i: usize| {
        let share = difference.metres[i] / difference.sigma[i];
        if share.is_finite() { share } else { 0.0 }
    };
    let begins = |i: usize| {
        let beyond = difference.beyond[i] / difference.sigma[i];
        if beyond.is_finite() && beyond.abs() >= BEGINS { beyond } else { 0.0 }
    };
    let spreads = spreads(difference);
    let mut of = vec![0u32; w * h];
    let mut spots = Vec::new();
    let mut queue: Vec<usize> = Vec::new();
    let mut number = 0;
    for start in 0..w * h {
        let sign = begins(start).signum();
        if begins(start) == 0.0 || of[start] != 0 {
            continue;
        }
        number += 1;
        let (mut pixels, mut seeds) = (Vec::new(), 0);
        queue.push(start);
        of[start] = number;
        while let Some(i) = queue.pop() {
            pixels.push(i);
            seeds += usize::from(begins(i) * sign > 0.0);
            let (x, y) = (i % w, i / w);
            for v in y.saturating_sub(1)..(y + 2).min(h) {
                for u in x.saturating_sub(1)..(x + 2).min(w) {
                    let j = v * w + u;
                    if of[j] == 0 && share(j) * sign >= GOES_ON {
                        of[j] = number;
                        queue.push(j);
                    }
                }
            }
        }
        if seeds >= LEAST_PIXELS {
            spots.extend(spot(difference, &spreads, &pixels, seeds));
        }
    }
    spots.sort_by(|a, b| b.volume_m3.value.abs().total_cmp(&a.volume_m3.value.abs()));
    spots
}

/// Standard deviations of mean differences over squares of [`SIDES`], as nine in ten of them say; the rest may have changed.
fn spreads(difference: &Difference) -> Vec<f64> {
    let all = difference.grid.with_values(difference.metres.clone());
    let mut spreads: Vec<f64> = Vec::new();
    for side in SIDES {
        let means = all.coarser(side);
        let [w, h] = means.size();
        let mut off: Vec<f64> = (0..w * h).filter_map(|i| means.at(i % w, i / w)).map(f64::abs).collect();
        if off.len() < FEWEST_SQUARES {
            break;
        }
        let at = off.len() * 9 / 10;
        let (_, spread, _) = off.select_nth_unstable_by(at, f64::total_cmp);
        spreads.push(*spread / NINE_IN_TEN);
    }
    spreads
}

/// A spot of its pixels; `None` where noise alone may make it.
fn spot(difference: &Difference, spreads: &[f64], pixels: &[usize], seeds: usize) -> Option<Spot> {
    let grid = &difference.grid;
    let w = grid.size()[0];
    let pixel_m2 = grid.pixel_m2();
    let count = pixels.len() as f64;
    let area_m2 = count * pixel_m2;
    let mean = pixels.iter().map(|i| f64::from(difference.metres[*i])).sum::<f64>() / count;
    let variance = pixels.iter().map(|i| f64::from(difference.sigma[*i]).powi(2)).sum::<f64>() / count;
    let patches = (area_m2 / difference.reach_m.powi(2)).max(1.0);
    let alike = SIDES.iter().zip(spreads).take_while(|(side, _)| side.pow(2) as f64 <= count).last();
    let of_squares = alike.map_or(0.0, |(_, spread)| *spread);
    let sigma = (variance / patches + difference.bias_m.powi(2)).sqrt().max(of_squares);
    let core = seeds as f64 * pixel_m2 / difference.reach_m.powi(2);
    if mean.abs() < SURE * sigma || core < LEAST_PATCHES {
        return None;
    }
    let place = |i: &usize| DVec2::new((i % w) as f64 + 0.5, (i / w) as f64 + 0.5);
    let middle = grid.place(pixels.iter().map(place).sum::<DVec2>() / count);
    let most = pixels
        .iter()
        .map(|i| f64::from(difference.metres[*i]))
        .fold(0.0, |a: f64, b| if b.abs() > a.abs() { b } else { a });
    // What lies below one standard deviation at its rim is not in it.
    let rings = rings(grid, pixels);
    let rim: f64 = rings.iter().map(|r| geometry::polygon::perimeter(r)).sum::<f64>() * grid.gsd();
    let volume = mean * area_m2;
    let lost = rim * variance.sqrt();
    let volume_sigma = ((sigma * area_m2).powi(2) + lost.powi(2)).sqrt();
    Some(Spot {
        rings,
        middle,
        area_m2,
        height_m: Measured { value: mean, sigma },
        most_m: most,
        volume_m3: Measured { value: volume, sigma: volume_sigma },
    })
}

/// Outlines of pixels, with a pixel of nothing around them, so that each is closed.
fn rings(grid: &Heights, pixels: &[usize]) -> Vec<Vec<DVec2>> {
    let w = grid.size()[0];
    let [low, high] = bounds(pixels, w);
    let size = [high[0] - low[0] + 3, high[1] - low[1] + 3];
    let mut mask = vec![0.0; size[0] * size[1]];
    for i in pixels {
        mask[(i / w - low[1] + 1) * size[0] + i % w - low[0] + 1] = 1.0;
    }
    outlines(grid, [low[0] as f64 - 1.0, low[1] as f64 - 1.0].into(), size, mask)
}

/// The least and the greatest column and row.
fn bounds(pixels: &[usize], w: usize) -> [[usize; 2]; 2] {
    pixels.iter().map(|i| [i % w, i / w]).fold([[usize::MAX; 2], [0; 2]], |[low, high], p| {
        [[low[0].min(p[0]), low[1].min(p[1])], [high[0].max(p[0]), high[1].max(p[1])]]
    })
}
