//! How true a map is: a simulated survey is trained, its orthophoto and heights are compared with what the ray-cast world
//! shows from straight above, and with heights taken directly from the first Gaussians, the fused depth maps.

mod picture;
pub mod survey;

use models::camera::{Pinhole, Pose, View};
use sim::world::{FromAbove, MapKind, PinholeView, World};
use std::path::Path;

use ::survey::ortho::files::NO_HEIGHT;
use ::survey::ortho::grid::{Block, Grid};
use engine::device::map_renderer;
use engine::evaluate::heights::{Compared as Height, HeightScores};
use engine::ortho::{DrawnBlock, Map, MapRequest};
use glam::{DMat4, DVec2, DVec3, DVec4};
use models::cloud::GaussianCloud;
use models::formats::model::{self, Chunks, ModelHeader};
use serde::Serialize;

use super::child;
use runtime::device_report::survey as usual;
use runtime::error::JobError;

use survey::Survey;

/// Roofs and ground within so many pixels of a step in height are left out of the figures: there, half a pixel aside is
/// metres up or down.
const EDGE_PIXELS: i64 = 2;
/// A step in height, metres.
const STEP_M: f64 = 0.5;
/// Squares whose shift against the exact orthophoto is measured, pixels a side.
const PATCH: u32 = 64;
/// What lies behind what a picture shows by more than this share of its depth is hidden in it.
const BEHIND: f64 = 0.01;
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
    /// Of the ground that enough pictures saw, the share that the map shows.
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
    /// Heights of all that has one, steps included and plants not.
    pub all_heights: HeightScores,
    /// Of the squares' shifts along both axes, the shares within one and two standard deviations of places.
    pub shift_within: [f64; 2],
}

/// A map and the truth, pixel by pixel.
struct Compared {
    columns: usize,
    rows: usize,
    /// Red, green, blue, 0 to 1; `None` where the map has nothing.
    drawn: Vec<Option<[f32; 3]>>,
    heights: Vec<f32>,
    height_sigmas: Vec<f32>,
    plane_sigmas: Vec<f32>,
    truth: Vec<FromAbove>,
    /// Where in the model, metres.
    places: Vec<DVec2>,
}

/// Writes a simulated survey (none: the one that `doctor` flies) to `out`, trains it with `training` (flags of `dgtr train`) and measures
/// its map, without the ground that fewer than `min_views` pictures saw.
///
/// # Errors
/// The training fails, or the folder cannot be written to.
pub fn measure(
    out: &Path,
    survey: Option<&Survey>,
    seed: u64,
    min_views: usize,
    training: &[String],
) -> Result<MapScores, JobError> {
    let data = out.join("data");
    let world = survey.map_or_else(|| usual::world(seed), |survey| survey.world(seed));
    match survey {
        None => usual::write_data_set(&data, seed, 1.0)?,
        Some(survey) => survey.write(&data, &world)?,
    }
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
    let errors_of = |counts: &dyn Fn(usize) -> bool, height: &dyn Fn(usize) -> Option<(f64, Option<f64>)>| {
        let compare = |i: usize| {
            let (z, sigma) = compared.drawn[i].and_then(|_| height(i))?;
            Some(Height { error: z - compared.truth[i].height, sigma })
        };
        let all: Vec<Option<Height>> = (0..level.len()).filter(|i| counts(*i)).map(compare).collect();
        let missing = all.iter().filter(|e| e.is_none()).count();
        HeightScores::of(&all.into_iter().flatten().collect::<Vec<Height>>(), missing)
    };
    let is_level = |i: usize| level[i];
    let drawn_height = |i: usize| {
        let sigma = Some(f64::from(compared.height_sigmas[i])).filter(|sigma| *sigma >= 0.0);
        Some((f64::from(compared.heights[i]) - origin, sigma))
    };
    picture::write(&out.join("errors.png"), &compared, &level, origin)?;
    let (shift_px, squares, shift_within) = compared.shift(map.grid().gsd());
    let drawn = compared.drawn.iter().flatten().count();
    Ok(MapScores {
        gsd_m: map.grid().gsd(),
        pixels: drawn,
        covered: covered(&map, &model.header, &compared, &world),
        psnr: compared.psnr(),
        shift_px,
        squares,
        heights: errors_of(&is_level, &drawn_height),
        fused_depth: errors_of(&is_level, &|i| fused[i].map(|z| (z, None))),
        all_heights: errors_of(&|i| compared.truth[i].kind != MapKind::Plant, &drawn_height),
        shift_within,
    })
}

/// Of the pixels whose true surface enough pictures saw, the share that the map shows.
fn covered(map: &Map, header: &ModelHeader, compared: &Compared, world: &World) -> f64 {
    let views: Vec<_> = header.views.iter().map(|(_, view)| (Pinhole::from(view), photographed(world, view))).collect();
    let is_seen = |i: &usize| {
        let point = compared.places[*i].extend(compared.truth[*i].height);
        views.iter().filter(|(camera, depths)| shows(camera, depths, point)).count() >= map.min_views()
    };
    let seen: Vec<usize> = (0..compared.truth.len()).filter(is_seen).collect();
    let drawn = seen.iter().filter(|i| compared.drawn[**i].is_some()).count();
    drawn as f64 / seen.len().max(1) as f64
}

/// The true depths of a view, metres.
struct Depths {
    width: usize,
    of: Vec<f32>,
}

fn photographed(world: &World, view: &View) -> Depths {
    let k = &view.intrinsics;
    let [fx, fy, cx, cy] = [k.fx, k.fy, k.cx, k.cy].map(f64::from);
    let Pose { rotation, center: position } = view.pose;
    let camera = PinholeView { width: k.width, height: k.height, fx, fy, cx, cy, position, rotation };
    Depths { width: k.width as usize, of: world.render(&camera).1 }
}

/// Whether a picture shows a point, and nothing before it.
fn shows(camera: &Pinhole, depths: &Depths, point: DVec3) -> bool {
    let depth = camera.local(point).z;
    camera.project(point).filter(|p| p.cmpge(DVec2::ZERO).all() && p.x < depths.width as f64).is_some_and(|p| {
        let at = depths.of.get(p.y as usize * depths.width + p.x as usize);
        at.is_some_and(|seen| depth - f64::from(*seen) < BEHIND * depth)
    })
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
        height_sigmas: vec![NO_HEIGHT; n],
        plane_sigmas: vec![NO_HEIGHT; n],
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
                    (all.height_sigmas[to], all.plane_sigmas[to]) =
                        (drawn.height_sigmas[from], drawn.plane_sigmas[from]);
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

    /// Root mean square over squares of how far each is shifted against the truth, their number, and the shares of the shifts along both
    /// axes that are within one and two standard deviations of the square's places.
    fn shift(&self, gsd: f64) -> (f64, usize, [f64; 2]) {
        let (mut sum, mut n, mut within) = (0.0, 0usize, [0usize; 2]);
        for y in (1..self.rows.saturating_sub(PATCH as usize + 1)).step_by(PATCH as usize) {
            for x in (1..self.columns.saturating_sub(PATCH as usize + 1)).step_by(PATCH as usize) {
                if let Some(shift) = self.shift_of([x, y]) {
                    sum += shift.length_squared();
                    n += 1;
                    let sigma = self.plane_sigma([x, y]) / gsd;
                    let inside = |times: f64| shift.to_array().iter().filter(|s| s.abs() <= times * sigma).count();
                    within = [within[0] + inside(1.0), within[1] + inside(2.0)];
                }
            }
        }
        let n_or_one = n.max(1) as f64;
        ((sum / n_or_one).sqrt(), n, within.map(|k| k as f64 / (2.0 * n_or_one)))
    }

    /// Median of the standard deviations of a square's places, metres.
    fn plane_sigma(&self, [x0, y0]: [usize; 2]) -> f64 {
        let side = PATCH as usize;
        let all = (y0..y0 + side).flat_map(|y| self.plane_sigmas[y * self.columns + x0..][..side].iter());
        let mut known: Vec<f64> = all.filter(|sigma| **sigma >= 0.0).map(|sigma| f64::from(*sigma)).collect();
        geometry::median(&mut known).unwrap_or(0.0)
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
