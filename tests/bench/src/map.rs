//! How true a map is: a simulated survey is trained, its orthophoto and heights are compared with what the ray-cast world
//! shows from straight above, and with heights taken directly from the first Gaussians, the fused depth maps.

mod picture;

use sim::world::{FromAbove, MapKind, World};
use std::path::Path;

use engine::device::map_renderer;
use engine::evaluate::heights::HeightScores;
use engine::ortho::{DrawnBlock, Map, MapRequest};
use glam::{DMat4, DVec2, DVec3, DVec4};
use models::cloud::GaussianCloud;
use models::formats::model::{self, Chunks, ModelHeader};
use serde::Serialize;
use survey::ortho::files::NO_HEIGHT;
use survey::ortho::grid::{Block, Grid};

use super::child;
use runtime::device_report::survey as world;
use runtime::error::JobError;

/// Roofs and ground within so many pixels of a step in height are left out of the figures: there, half a pixel aside is
/// metres up or down.
const EDGE_PIXELS: i64 = 2;
/// A step in height, metres.
const STEP_M: f64 = 0.5;
/// Squares whose shift against the exact orthophoto is measured, pixels a side.
const PATCH: u32 = 64;
/// Share of a square that must hold ground.
const PATCH_COVER: f64 = 0.9;
/// Rounds of Gauss–Newton on a square's shift.
const ROUNDS: usize = 8;

/// What was measured.
#[derive(Clone, Debug, Serialize)]
pub struct MapScores {
    /// Side of a pixel, metres.
    pub gsd_m: f64,
    /// Pixels compared.
    pub pixels: usize,
    /// Of the ground that two pictures saw, the share that the map shows.
    pub covered: f64,
    /// Orthophoto against the exact one, dB.
    pub psnr: f64,
    /// Root mean square of the squares' shifts, pixels.
    pub shift_px: f64,
    /// Squares whose shift was measured.
    pub squares: usize,
    /// Heights on bare ground and roofs, away from steps.
    pub heights: HeightScores,
    /// Heights from the fused depth maps alone.
    pub fused_depth: HeightScores,
}

/// A map and the truth, pixel by pixel.
struct Compared {
    columns: usize,
    rows: usize,
    /// Red, green, blue, 0 to 1; `None` where the map has nothing.
    drawn: Vec<Option<[f32; 3]>>,
    heights: Vec<f32>,
    truth: Vec<FromAbove>,
    /// Where in the model, metres.
    places: Vec<DVec2>,
}

/// Writes the simulated survey to `out`, trains it with `training` (flags of `dgtr train`) and measures its map, without the
/// ground that fewer than `min_views` pictures saw.
///
/// # Errors
/// The training fails, or the folder cannot be written to.
pub fn measure(out: &Path, seed: u64, min_views: usize, training: &[String]) -> Result<MapScores, JobError> {
    let (data, world) = (out.join("data"), world::world(seed));
    world::write_data_set(&data, seed, 1.0)?;
    let train = |name: &str, more: &[String]| {
        let mut arguments = ["train", &data.display().to_string(), "--fresh", "--seed"].map(str::to_owned).to_vec();
        arguments.push(seed.to_string());
        arguments.extend_from_slice(more);
        let folder = out.join(name);
        child::run(&arguments, &folder, None)?.report(name)?;
        Ok::<_, JobError>(folder.join("model.dgtr"))
    };
    // One step moves nothing: these are the Gaussians as the depth maps were fused into them.
    let (_, first) = model::read(&train("fused", &["--steps".into(), "1".into()])?)?;
    let model = Chunks::open(&train("trained", training)?)?;
    let map = Map::of_file(&model, &MapRequest { min_views, ..MapRequest::default() })?;
    let compared = draw(&map, &model, &world)?;
    let origin = model.header.origin.map_or(0.0, |o| o.alt_m);
    let level: Vec<bool> = (0..compared.truth.len()).map(|i| compared.is_level(i)).collect();
    let fused = fused_heights(&first, &compared, map.grid().gsd());
    let errors_of = |height: &dyn Fn(usize) -> Option<f64>| {
        let compare = |i: usize| compared.drawn[i].and_then(|_| height(i)).map(|h| h - compared.truth[i].height);
        let all: Vec<Option<f64>> = (0..level.len()).filter(|i| level[*i]).map(compare).collect();
        let missing = all.iter().filter(|e| e.is_none()).count();
        HeightScores::of(&all.into_iter().flatten().collect::<Vec<f64>>(), missing)
    };
    picture::write(&out.join("errors.png"), &compared, &level, origin)?;
    let (shift_px, squares) = compared.shift();
    let drawn = compared.drawn.iter().flatten().count();
    Ok(MapScores {
        gsd_m: map.grid().gsd(),
        pixels: drawn,
        covered: drawn as f64 / seen_pixels(&map, &model.header, &compared) as f64,
        psnr: compared.psnr(),
        shift_px,
        squares,
        heights: errors_of(&|i| Some(f64::from(compared.heights[i]) - origin)),
        fused_depth: errors_of(&|i| fused[i]),
    })
}

/// Pixels whose true surface at least two pictures saw.
fn seen_pixels(map: &Map, header: &ModelHeader, compared: &Compared) -> usize {
    let views: Vec<_> = header.views.iter().map(|(_, v)| (models::camera::Pinhole::from(v), v.intrinsics)).collect();
    let seen = |i: &usize| {
        let point = compared.places[*i].extend(compared.truth[*i].height);
        views.iter().filter(|(c, k)| c.project(point).is_some_and(|p| k.contains(p))).count() >= map.min_views()
    };
    (0..compared.truth.len()).filter(seen).count().max(1)
}

fn draw(map: &Map, model: &Chunks, world: &World) -> Result<Compared, JobError> {
    let mut trainer = map_renderer(None, model)?;
    let grid = map.grid();
    let [columns, rows] = grid.size().map(|n| n as usize);
    let n = columns * rows;
    let nothing = FromAbove { color: [0.0; 3], height: 0.0, kind: MapKind::Plant };
    let mut all = Compared {
        columns,
        rows,
        drawn: vec![None; n],
        heights: vec![NO_HEIGHT; n],
        truth: vec![nothing; n],
        places: vec![DVec2::ZERO; n],
    };
    let mut drawn = DrawnBlock::default();
    for block in grid.blocks() {
        let is_drawn = map.draw(&mut trainer, block, &mut drawn)?;
        for v in 0..block.height {
            for u in 0..block.width {
                let from = (v * block.width + u) as usize;
                let to = (block.y + v) as usize * columns + (block.x + u) as usize;
                let place = place(grid, block, [u, v])?;
                all.places[to] = place;
                all.truth[to] = averaged(world, place, grid.gsd());
                if is_drawn && drawn.rgba[4 * from + 3] > 0 {
                    let color = [0, 1, 2].map(|c| f32::from(drawn.rgba[4 * from + c]) / 255.0);
                    (all.drawn[to], all.heights[to]) = (Some(color), drawn.heights[from]);
                }
            }
        }
    }
    Ok(all)
}

/// The middle of a pixel, model metres.
fn place(grid: &Grid, block: Block, [u, v]: [u32; 2]) -> Result<DVec2, JobError> {
    let pixel = DVec2::new(f64::from(block.x + u) + 0.5, f64::from(block.y + v) + 0.5);
    let ground = grid.crs().to_map(DVec3::ZERO)?.z;
    Ok(grid.crs().to_enu(grid.place(pixel).extend(ground))?.truncate())
}

/// What a pixel shows: the mean of four samples, and the middle's height.
fn averaged(world: &World, place: DVec2, gsd: f64) -> FromAbove {
    let mut middle = world.from_above(place.x, place.y, gsd / 2.0);
    let mut sum = [0.0f32; 3];
    for (dx, dy) in [(-0.25, -0.25), (0.25, -0.25), (-0.25, 0.25), (0.25, 0.25)] {
        let sample = world.from_above(place.x + dx * gsd, place.y + dy * gsd, gsd / 2.0);
        (0..3).for_each(|c| sum[c] += sample.color[c].clamp(0.0, 1.0));
    }
    middle.color = sum.map(|s| s / 4.0);
    middle
}

/// Median height of the first Gaussians in each pixel, or of those in the pixels around it.
fn fused_heights(first: &GaussianCloud, compared: &Compared, gsd: f64) -> Vec<Option<f64>> {
    let (columns, rows) = (compared.columns as i64, compared.rows as i64);
    // Places grow by one pixel along rows and columns; the grid may be turned by the meridian's convergence.
    let start = compared.places[0];
    let along = |i: usize| (compared.places[i] - start) / i.max(1) as f64;
    let (right, down) =
        (along(compared.columns - 1), (compared.places[(compared.rows - 1) * compared.columns] - start));
    let down = down / (compared.rows - 1).max(1) as f64;
    let mut heights: Vec<Vec<f32>> = vec![Vec::new(); compared.truth.len()];
    for mean in first.means.iter().filter(|m| m.iter().all(|v| v.is_finite())) {
        let away = DVec2::new(mean[0].into(), mean[1].into()) - start;
        let at = [away.dot(right) / right.length_squared(), away.dot(down) / down.length_squared()];
        let [x, y] = at.map(|v| v.round() as i64);
        if (0..columns).contains(&x) && (0..rows).contains(&y) {
            heights[(y * columns + x) as usize].push(mean[2]);
        }
    }
    debug_assert!((right.length() - gsd).abs() < 0.1 * gsd);
    let around = |i: usize, reach: i64| {
        let (x, y) = (i as i64 % columns, i as i64 / columns);
        let mut all: Vec<f32> = Vec::new();
        for y in (y - reach).max(0)..=(y + reach).min(rows - 1) {
            for x in (x - reach).max(0)..=(x + reach).min(columns - 1) {
                all.extend(&heights[(y * columns + x) as usize]);
            }
        }
        all.sort_by(f32::total_cmp);
        all.get(all.len() / 2).map(|h| f64::from(*h))
    };
    (0..heights.len()).map(|i| (0..=2).find_map(|reach| around(i, reach))).collect()
}

impl Compared {
    /// Ground or roof, and no step in height nearby.
    fn is_level(&self, i: usize) -> bool {
        let here = &self.truth[i];
        let (x, y) = ((i % self.columns) as i64, (i / self.columns) as i64);
        let near = |k: i64| -EDGE_PIXELS..=EDGE_PIXELS + k;
        matches!(here.kind, MapKind::Ground | MapKind::Roof)
            && near(0).all(|dy| {
                near(0).all(|dx| {
                    let inside =
                        (0..self.columns as i64).contains(&(x + dx)) && (0..self.rows as i64).contains(&(y + dy));
                    !inside || {
                        let there = &self.truth[((y + dy) * self.columns as i64 + x + dx) as usize];
                        there.kind == here.kind && (there.height - here.height).abs() < STEP_M
                    }
                })
            })
    }

    fn psnr(&self) -> f64 {
        let (mut sum, mut n) = (0.0, 0usize);
        for (drawn, truth) in self.drawn.iter().zip(&self.truth) {
            if let Some(drawn) = drawn {
                sum += (0..3).map(|c| f64::from(drawn[c] - truth.color[c]).powi(2)).sum::<f64>();
                n += 3;
            }
        }
        -10.0 * (sum / n.max(1) as f64).log10()
    }

    /// Root mean square over squares of how far each is shifted against the truth, and their number.
    fn shift(&self) -> (f64, usize) {
        let (mut sum, mut n) = (0.0, 0usize);
        for y in (1..self.rows.saturating_sub(PATCH as usize + 1)).step_by(PATCH as usize) {
            for x in (1..self.columns.saturating_sub(PATCH as usize + 1)).step_by(PATCH as usize) {
                if let Some(shift) = self.shift_of([x, y]) {
                    sum += shift.length_squared();
                    n += 1;
                }
            }
        }
        ((sum / n.max(1) as f64).sqrt(), n)
    }

    /// Least squares over the square's pixels: drawn(p) = gain · truth(p + shift) + offset (Lucas & Kanade 1981). `None` where
    /// too little is covered, or the square has no texture to hold on to.
    fn shift_of(&self, [x0, y0]: [usize; 2]) -> Option<DVec2> {
        let luma = |c: [f32; 3]| f64::from(c[0] + c[1] + c[2]) / 3.0;
        let truth = |x: f64, y: f64| {
            let (x, y) = (x.clamp(0.0, self.columns as f64 - 1.001), y.clamp(0.0, self.rows as f64 - 1.001));
            let (i, j) = (x as usize, y as usize);
            let (u, v) = (x - i as f64, y - j as f64);
            let at = |i: usize, j: usize| luma(self.truth[j * self.columns + i].color);
            (at(i, j) * (1.0 - u) + at(i + 1, j) * u) * (1.0 - v)
                + (at(i, j + 1) * (1.0 - u) + at(i + 1, j + 1) * u) * v
        };
        let side = PATCH as usize;
        let covered: Vec<(usize, usize, f64)> = (y0..y0 + side)
            .flat_map(|y| (x0..x0 + side).map(move |x| (x, y)))
            .filter_map(|(x, y)| Some((x, y, luma(self.drawn[y * self.columns + x]?))))
            .collect();
        if (covered.len() as f64) < PATCH_COVER * (side * side) as f64 {
            return None;
        }
        let mut p = DVec4::new(0.0, 0.0, 1.0, 0.0);
        for _ in 0..ROUNDS {
            let (mut a, mut b) = (DMat4::ZERO, DVec4::ZERO);
            for &(x, y, drawn) in &covered {
                let (px, py) = (x as f64 + p[0], y as f64 + p[1]);
                let value = truth(px, py);
                let dx = 0.5 * (truth(px + 1.0, py) - truth(px - 1.0, py));
                let dy = 0.5 * (truth(px, py + 1.0) - truth(px, py - 1.0));
                let row = DVec4::new(p.z * dx, p.z * dy, value, 1.0);
                a += DMat4::from_cols(row * row.x, row * row.y, row * row.z, row);
                b += row * (drawn - p.z * value - p.w);
            }
            if a.x_axis.x.min(a.y_axis.y) < 1e-3 * covered.len() as f64 {
                return None;
            }
            p += a.inverse() * b;
        }
        let shift = DVec2::new(p[0], p[1]);
        (shift.is_finite() && shift.length() < f64::from(PATCH) / 4.0).then_some(shift)
    }
}
