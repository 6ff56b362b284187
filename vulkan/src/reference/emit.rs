//! Stages *depth sort*, *tile count/emit*, *sort* and *ranges*: which Gaussian is drawn in which tile, in which order.
//!
//! Counting and emitting share [`tiles_touched`], so they cannot disagree. A tile is touched when the ellipse
//! α = cut-off reaches the rectangle of its pixel centres, exactly (StopThePop, AccuTile): the quadratic form's
//! minimum over the rectangle is compared with 2 ln(opacity/cut-off).

use super::camera::Camera;
use super::project::{Limits, Projected};
use super::real::Real;
use crate::constants::{TILE_HEIGHT, TILE_WIDTH};

const TILE: [u32; 2] = [TILE_WIDTH, TILE_HEIGHT];

/// Tiles across and down.
pub fn tile_grid(size: [u32; 2]) -> [u32; 2] {
    [size[0].div_ceil(TILE_WIDTH), size[1].div_ceil(TILE_HEIGHT)]
}

/// Least value of the quadratic form (x − mean)ᵀ Σ₂⁻¹ (x − mean) over the rectangle low…high.
///
/// It is 0 when the mean is inside. Otherwise the minimum lies on the boundary: on each edge the form is a convex
/// parabola in one variable, whose minimum is clamped to the edge.
pub fn least_power<R: Real>(p: &Projected<R>, low: [R; 2], high: [R; 2]) -> R {
    let [a, b, c] = p.conic;
    let l = [low[0] - p.mean2d[0], low[1] - p.mean2d[1]];
    let h = [high[0] - p.mean2d[0], high[1] - p.mean2d[1]];
    if (0..2).all(|k| l[k] <= R::ZERO && h[k] >= R::ZERO) {
        return R::ZERO;
    }
    let form = |x: R, y: R| a * x * x + R::of(2.0) * b * x * y + c * y * y;
    let on_x = |x: R| form(x, (-b * x / c).max(l[1]).min(h[1]));
    let on_y = |y: R| form((-b * y / a).max(l[0]).min(h[0]), y);
    on_x(l[0]).min(on_x(h[0])).min(on_y(l[1])).min(on_y(h[1]))
}

/// Calls `touched(tile index)` for every tile the ellipse reaches, row by row.
pub fn tiles_touched<R: Real>(p: &Projected<R>, camera: &Camera<R>, limits: &Limits, mut touched: impl FnMut(u32)) {
    let [across, down] = tile_grid(camera.size);
    let reach = p.reach(limits);
    let [a, b, c] = p.conic;
    let inverse = R::ONE / (a * c - b * b);
    let span = |k: usize, variance: R, tiles: u32| {
        let half = (reach * variance).sqrt();
        let tile = f64::from(TILE[k]);
        let index = |v: R| (v.f64() / tile).floor().clamp(0.0, f64::from(tiles)) as u32;
        // NaN (an unlimited reach times a variance of 0, or a hopelessly thin conic) means every tile.
        if half.f64().is_finite() {
            (index(p.mean2d[k] - half), index(p.mean2d[k] + half + R::of(tile)))
        } else {
            (0, tiles)
        }
    };
    let (x0, x1) = span(0, c * inverse, across);
    let (y0, y1) = span(1, a * inverse, down);
    let center = |k: usize, t: u32, end: bool| {
        let first = t * TILE[k];
        let last = (first + TILE[k]).min(camera.size[k]) - 1;
        R::of(f64::from(if end { last } else { first }) + 0.5)
    };
    for y in y0..y1 {
        for x in x0..x1 {
            let low = [center(0, x, false), center(1, y, false)];
            let high = [center(0, x, true), center(1, y, true)];
            if least_power(p, low, high) <= reach {
                touched(y * across + x);
            }
        }
    }
}

/// Drawn Gaussians from near to far; equal depths keep the order of their indices.
pub fn sort<R: Real>(projected: &[Option<Projected<R>>]) -> Vec<u32> {
    let mut order: Vec<u32> = (0..projected.len() as u32).filter(|i| projected[*i as usize].is_some()).collect();
    let depth = |i: &u32| projected[*i as usize].as_ref().map_or(0.0, |p| p.depth.f64());
    order.sort_by(|a, b| depth(a).total_cmp(&depth(b)));
    order
}

/// The instances of a picture: for each tile the Gaussians it draws, near to far.
#[derive(Clone, Debug, Default)]
pub struct Instances {
    /// Gaussian of each instance, tile by tile.
    pub gaussians: Vec<u32>,
    /// Instances `ranges[t]..ranges[t + 1]` belong to tile t.
    pub ranges: Vec<u32>,
}

/// Emits in depth order and sorts by tile, stably.
pub fn emit<R: Real>(projected: &[Option<Projected<R>>], camera: &Camera<R>, limits: &Limits) -> Instances {
    let [across, down] = tile_grid(camera.size);
    let mut pairs: Vec<(u32, u32)> = Vec::new();
    for i in sort(projected) {
        if let Some(p) = &projected[i as usize] {
            tiles_touched(p, camera, limits, |tile| pairs.push((tile, i)));
        }
    }
    pairs.sort_by_key(|(tile, _)| *tile);
    let mut ranges = vec![0u32; (across * down) as usize + 1];
    for (tile, _) in &pairs {
        ranges[*tile as usize + 1] += 1;
    }
    for t in 1..ranges.len() {
        ranges[t] += ranges[t - 1];
    }
    Instances { gaussians: pairs.into_iter().map(|(_, g)| g).collect(), ranges }
}
