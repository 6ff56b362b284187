//! Maps of a model: every block seen from above with parallel rays, in the memory of one block whatever the map's size.

use std::path::Path;

use disk::Disk;
use glam::{DQuat, DVec2, DVec3, Vec3};
use models::camera::{OrthographicView, Pose, View};
use models::cloud::GaussianCloud;
use models::formats::model::{Chunks, ModelHeader};
use survey::ortho::OrthoError;
use survey::ortho::crs::Crs;
use survey::ortho::extent::{Extent, SAMPLE, ViewsAround};
use survey::ortho::files::{MapFiles, NO_HEIGHT, Pixels, Written};
use survey::ortho::grid::{BLOCK, Block, BlockView, DRAWN, Grid, MARGIN};
use survey::ortho::seen::{DepthMaps, Vantage};
use survey::ortho::surface::{Scratch, Surface};
use survey::ortho::up::{self, Up};
use vulkan::trainer::{Rendering, Trainer};

use crate::device::map_renderer;
use crate::error::EngineError;

/// Where less than this share of a pixel is covered, there is no ground.
const LEAST_COVER: f32 = 0.5;
/// Who saw the ground is asked once for squares of so many pixels a side.
const SEEN_CELL: u32 = 4;
/// Squares along each side of what is drawn of a block.
const SEEN_CELLS: u32 = DRAWN / SEEN_CELL;

/// What a map should be.
#[derive(Clone, Debug)]
pub struct MapRequest {
    /// Side of a pixel, metres; `None`: what a pixel of the training pictures covers.
    pub gsd: Option<f64>,
    /// Most pixels; larger ones are taken where there would be more.
    pub most_pixels: Option<u32>,
    /// Code of a projected reference system; `None`: the UTM zone of the origin.
    pub epsg: Option<u16>,
    /// West, south, east, north in metres of the reference system; `None`: what the pictures cover, inside of the region.
    pub bounds: Option<[f64; 4]>,
    /// Ground that fewer training pictures saw is left out.
    pub min_views: usize,
    /// Ground whose height has a larger standard deviation, or none, is left out; metres.
    pub max_sigma_m: Option<f64>,
    /// The axis that points up, where the model is nowhere on Earth; `None`: what its cameras say.
    pub up: Option<Up>,
}

impl Default for MapRequest {
    fn default() -> Self {
        // bench map: orthophoto 26.0 dB of what two pictures saw, 29.3 dB of what four did; the sparsest flights leave few places to four.
        Self { gsd: None, most_pixels: None, epsg: None, bounds: None, min_views: 3, max_sigma_m: None, up: None }
    }
}

/// A model's ground and the raster to draw it in.
pub struct Map {
    extent: Extent,
    grid: Grid,
    surface: Surface,
    min_views: usize,
    max_sigma_m: Option<f64>,
    /// Model → a frame whose z is up, which all else here is in.
    turn: DQuat,
}

/// Keeps what the TIFF writer puts aside on the disk of `folder`: the system's temporary folder is memory on many boards. For
/// the whole process; the first folder stays.
pub fn keep_scratch_in(folder: &Path) {
    let _ = tempfile::env::override_temp_dir(folder);
}

/// Draws a model's file into files in `folder`, as large as its training pictures say. For the merged scene, after all else.
///
/// # Errors
/// The model, the device, or the disk.
pub fn draw_file(model: &Path, device: Option<&str>, folder: &Path) -> Result<Written, EngineError> {
    let model = Chunks::open(model)?;
    let map = Map::of_file(&model, &MapRequest::default())?;
    let mut trainer = map_renderer(device, &model)?;
    let written = map.write(&mut trainer, &model.header, (&Disk::default(), folder), |_, _| true)?;
    written.ok_or(EngineError::Unfinished)
}

/// One block as drawn.
#[derive(Clone, Debug, Default)]
pub struct DrawnBlock {
    /// Red, green, blue, alpha (0 or 255) by pixel of the block, row by row.
    pub rgba: Vec<u8>,
    /// Height on the map's vertical scale, or [`NO_HEIGHT`].
    pub heights: Vec<f32>,
    /// Standard deviations of heights, metres, or [`NO_HEIGHT`].
    pub height_sigmas: Vec<f32>,
    /// Standard deviations of places along an axis of the plane, metres, or [`NO_HEIGHT`].
    pub plane_sigmas: Vec<f32>,
    rendering: Rendering,
    depths: DepthMaps,
    /// Heights of single rays; NaN where there is no ground, or too few pictures show it.
    rays: Vec<f32>,
    /// Heights of the surface.
    smooth: Vec<f32>,
    roughness: Vec<f32>,
    scratch: Scratch,
    /// How the squares are seen.
    vantages: Vec<Vantage>,
}

impl Map {
    /// The map of a model's file, of which a piece is in memory at a time.
    ///
    /// # Errors
    /// Errors of [`Map::of`]; the file cannot be read any more.
    pub fn of_file(model: &Chunks, request: &MapRequest) -> Result<Self, EngineError> {
        Self::of(&model.header, &model.sample(SAMPLE)?, request)
    }

    /// The map of a model.
    ///
    /// # Errors
    /// A request that makes no map of this model.
    pub fn of(header: &ModelHeader, cloud: &GaussianCloud, request: &MapRequest) -> Result<Self, EngineError> {
        let mut views: Vec<View> = header.views.iter().map(|(_, view)| *view).collect();
        let turn = match (header.origin, request.up) {
            (Some(_), Some(_)) => return Err(OrthoError::KnownUp.into()),
            (Some(_), None) => DQuat::IDENTITY,
            (None, Some(up)) => up.turn(),
            (None, None) => up::found(&views)?,
        };
        let mut turned = None;
        if turn != DQuat::IDENTITY {
            tracing::info!("the scene is turned so that its vertical {:.2} is up", turn.conjugate() * DVec3::Z);
            for view in &mut views {
                view.pose = Pose { rotation: turn * view.pose.rotation, center: turn * view.pose.center };
            }
            // Where and how solid they are is all that is asked of them.
            let cloud = turned.insert(cloud.clone());
            let rotation = turn.as_quat();
            cloud.means.iter_mut().for_each(|m| *m = (rotation * Vec3::from_array(*m)).to_array());
        }
        let Some(extent) = Extent::of(turned.as_ref().unwrap_or(cloud), &views, &header.region) else {
            return Err(EngineError::Request("the model holds no solid ground inside of its region".into()));
        };
        let crs = match (header.origin, request.epsg) {
            (Some(origin), Some(code)) => Crs::projected(code, origin)?,
            (Some(origin), None) => Crs::utm(origin)?,
            (None, Some(code)) => return Err(OrthoError::NoOrigin(code).into()),
            (None, None) => Crs::local(),
        };
        let Some(mut gsd) = request.gsd.or(extent.gsd()) else {
            return Err(EngineError::Request(
                "the model keeps no views to take the pixel size from; give --gsd".into(),
            ));
        };
        let covered = bounds(&crs, &extent)?;
        let bounds = request.bounds.map_or(covered, |[w, s, e, n]| [DVec2::new(w, s), DVec2::new(e, n)]);
        if bounds[0].cmpgt(covered[1]).any() || bounds[1].cmplt(covered[0]).any() {
            let [low, high] = covered;
            return Err(EngineError::Request(format!(
                "the bounds lie outside of the model's ground, which is {:.0},{:.0},{:.0},{:.0}",
                low.x, low.y, high.x, high.y
            )));
        }
        if let Some(most) = request.most_pixels {
            let size = bounds[1] - bounds[0];
            gsd = gsd.max((size.x * size.y / f64::from(most.max(1))).sqrt());
        }
        let surface = Surface::of(extent.gsd(), gsd);
        let grid = Grid::new(crs, bounds, gsd)?;
        let &MapRequest { min_views, max_sigma_m, .. } = request;
        Ok(Self { extent, grid, surface, min_views, max_sigma_m, turn })
    }

    /// Ground that fewer training pictures saw is left out.
    pub fn min_views(&self) -> usize {
        self.min_views
    }

    /// How its heights are taken from single rays.
    pub fn surface(&self) -> &Surface {
        &self.surface
    }

    /// Its raster.
    pub fn grid(&self) -> &Grid {
        &self.grid
    }

    /// Draws the whole map into files in `folder`, through `disk`. `progress` hears of each of `total` blocks and may end it: then there is
    /// no new map, and `None` is the answer.
    ///
    /// # Errors
    /// The device or the disk fails.
    pub fn write(
        &self,
        trainer: &mut Trainer,
        header: &ModelHeader,
        (disk, folder): (&Disk, &Path),
        mut progress: impl FnMut(usize, usize) -> bool,
    ) -> Result<Option<Written>, EngineError> {
        let mut files = MapFiles::begin(folder, &self.grid)?;
        let mut drawn = DrawnBlock::default();
        let total = files.blocks().len();
        for i in 0..total {
            if !progress(i, total) {
                return Ok(None);
            }
            let block = files.blocks()[i];
            if self.draw(trainer, block, &mut drawn)? {
                let DrawnBlock { rgba, heights, height_sigmas, plane_sigmas, .. } = &mut drawn;
                files.write(block, Pixels { rgba, heights, height_sigmas, plane_sigmas })?;
            }
        }
        Ok(Some(files.finish(disk, header.origin)?))
    }

    /// Draws one block; false, and nothing drawn, where too few pictures looked.
    ///
    /// # Errors
    /// The device fails, or the reference system ends inside of the map.
    pub fn draw(&self, trainer: &mut Trainer, block: Block, into: &mut DrawnBlock) -> Result<bool, EngineError> {
        let half = DVec2::new(f64::from(block.width), f64::from(block.height)) / 2.0;
        let middle = self.grid.place(DVec2::new(f64::from(block.x), f64::from(block.y)) + half);
        let place = self.grid.crs().to_enu(middle.extend(0.0))?.truncate();
        let seen = self.extent.views_around(place, f64::from(BLOCK) * self.grid.gsd());
        if self.extent.has_views() && seen.views() < self.min_views {
            return Ok(false);
        }
        self.render_depths(trainer, &seen, into)?;
        let ground = self.extent.ground(place);
        let look = self.grid.look(block, self.extent.top(place))?;
        trainer.render_orthographic(
            &OrthographicView { pose: self.model_pose(look.view.pose), ..look.view },
            &mut into.rendering,
        )?;
        self.take_rays(&seen, &look, ground, into);
        let DrawnBlock { rays, smooth, roughness, scratch, .. } = &mut *into;
        self.surface.smooth(DRAWN as usize, rays, smooth);
        self.surface.roughness(DRAWN as usize, smooth, scratch, roughness);
        self.fill(into, block);
        Ok(true)
    }

    /// Renders what the views around a block have in front, where that is not known yet.
    fn render_depths(
        &self,
        trainer: &mut Trainer,
        seen: &ViewsAround<'_>,
        into: &mut DrawnBlock,
    ) -> Result<(), EngineError> {
        let DrawnBlock { rendering, depths, .. } = into;
        if self.min_views == 0 {
            return Ok(());
        }
        for (i, view) in depths.lacking(seen) {
            trainer.render(&View { pose: self.model_pose(view.pose), ..view }, rendering)?;
            let depth = |(sum, left): (&f32, &f32)| {
                let cover = 1.0 - left;
                if cover < LEAST_COVER { f32::NAN } else { sum / cover }
            };
            let map = rendering.depth.iter().zip(&rendering.transmittance).map(depth).collect();
            depths.insert(i, [view.intrinsics.width, view.intrinsics.height], map);
        }
        Ok(())
    }

    /// A pose of the map's frame in the model's.
    fn model_pose(&self, pose: Pose) -> Pose {
        let back = self.turn.conjugate();
        Pose { rotation: back * pose.rotation, center: back * pose.center }
    }

    /// Takes the heights of a rendering's rays where enough pictures show what they meet.
    fn take_rays(&self, seen: &ViewsAround<'_>, look: &BlockView, ground: f64, into: &mut DrawnBlock) {
        let DrawnBlock { rendering, depths, rays, vantages, .. } = into;
        let cover = |i: usize| 1.0 - rendering.transmittance[i];
        rays.clear();
        rays.extend((0..rendering.depth.len()).map(|i| match cover(i) < LEAST_COVER {
            true => f32::NAN,
            false => (look.top_m - f64::from(rendering.depth[i])) as f32,
        }));
        vantages.clear();
        let view = &look.view;
        let [right, down] = view.pixels_per_metre;
        let half = f64::from(DRAWN) / 2.0;
        for y in (0..DRAWN).step_by(SEEN_CELL as usize) {
            for x in (0..DRAWN).step_by(SEEN_CELL as usize) {
                let mut met = [0.0; (SEEN_CELL * SEEN_CELL) as usize];
                let mut n = 0;
                for i in square([x, y]).filter(|i| cover(*i) >= LEAST_COVER) {
                    met[n] = rendering.depth[i];
                    n += 1;
                }
                let depth = match n {
                    0 => view.pose.center.z - ground,
                    _ => f64::from(*met[..n].select_nth_unstable_by(n / 2, f32::total_cmp).1),
                };
                let [u, v] = [x, y].map(|k| f64::from(k) + 0.5 * f64::from(SEEN_CELL) - half);
                let point = view.pose.center + view.pose.rotation * DVec3::new(u / right, v / down, depth);
                let vantage = depths.vantage(seen, point);
                let is_known = !self.extent.has_views() || vantage.views >= self.min_views;
                if !is_known {
                    square([x, y]).for_each(|i| rays[i] = f32::NAN);
                }
                vantages.push(vantage);
            }
        }
    }

    /// Takes a block's own pixels out of what was drawn of it.
    fn fill(&self, into: &mut DrawnBlock, block: Block) {
        let pixels = block.width as usize * block.height as usize;
        for of in [&mut into.heights, &mut into.height_sigmas, &mut into.plane_sigmas] {
            of.clear();
            of.resize(pixels, NO_HEIGHT);
        }
        into.rgba.clear();
        into.rgba.resize(4 * pixels, 0);
        for (v, u) in (0..block.height).flat_map(|v| (0..block.width).map(move |u| (v, u))) {
            let [x, y] = [u, v].map(|k| k + MARGIN);
            let (from, to) = ((y * DRAWN + x) as usize, (v * block.width + u) as usize);
            let height = into.smooth[from];
            if !height.is_finite() {
                continue;
            }
            let vantage = &into.vantages[(y / SEEN_CELL * SEEN_CELLS + x / SEEN_CELL) as usize];
            let sigmas = vantage.per_pixel.filter(|_| into.roughness[from].is_finite()).map(|[plane, up]| {
                let up = Surface::height_sigma(into.roughness[from], up);
                [up, Surface::plane_sigma(up, vantage.slope, plane)]
            });
            if self.max_sigma_m.is_some_and(|most| sigmas.is_none_or(|[up, _]| up > most)) {
                continue;
            }
            let cover = 1.0 - into.rendering.transmittance[from];
            let byte = |c: usize| (into.rendering.rgb[3 * from + c] / cover).clamp(0.0, 1.0) * 255.0;
            let color = [byte(0), byte(1), byte(2)].map(|v| v.round() as u8);
            into.rgba[4 * to..4 * to + 3].copy_from_slice(&color);
            into.rgba[4 * to + 3] = u8::MAX;
            into.heights[to] = height;
            if let Some([up, plane]) = sigmas {
                (into.height_sigmas[to], into.plane_sigmas[to]) = (eight_bits(up as f32), eight_bits(plane as f32));
            }
        }
    }
}

/// Rounded to eight significant bits, half a percent: what is beyond them says nothing and compresses badly.
fn eight_bits(value: f32) -> f32 {
    f32::from_bits(value.to_bits().wrapping_add(1 << 15) & !0xffff)
}

/// The pixels of a square of what is drawn, by its corner.
fn square([x, y]: [u32; 2]) -> impl Iterator<Item = usize> {
    (y..y + SEEN_CELL).flat_map(move |v| (x..x + SEEN_CELL).map(move |u| (v * DRAWN + u) as usize))
}

/// The box, in map metres, around the ground that the pictures cover.
fn bounds(crs: &Crs, extent: &Extent) -> Result<[DVec2; 2], OrthoError> {
    let [low, high] = extent.bounds();
    let ground = extent.ground((low + high) / 2.0);
    let mut bounds = [DVec2::INFINITY, DVec2::NEG_INFINITY];
    for corner in [low, high, DVec2::new(low.x, high.y), DVec2::new(high.x, low.y)] {
        let at = crs.to_map(corner.extend(ground))?.truncate();
        bounds = [bounds[0].min(at), bounds[1].max(at)];
    }
    Ok(bounds)
}

#[cfg(test)]
#[allow(clippy::unwrap_used, reason = "a test fails by panicking")]
mod tests {
    use super::*;
    use crate::device::renderer;
    use models::camera::Intrinsics;

    /// From which place on, eastwards, the model's ground lies too deep, metres.
    const SUNK_FROM: f64 = 12.0;
    const DEPTH: f32 = 15.0;

    /// Level ground, but for what one picture alone shows: nothing tested its depth.
    fn cloud() -> GaussianCloud {
        let mut cloud = GaussianCloud::with_capacity(0, 81 * 81);
        for n in 0..81 * 81 {
            let [x, y] = [n % 81, n / 81].map(|k| 0.5 * k as f32 - 20.0);
            let z = if f64::from(x) > SUNK_FROM { -DEPTH } else { 0.0 };
            cloud.push([x, y, z], [-1.2; 3], [1.0, 0.0, 0.0, 0.0], 6.0, &[0.5; 3]);
        }
        cloud
    }

    /// Straight down from 40 m above a place, 26 m of ground wide.
    fn nadir(east: f64) -> (String, View) {
        let intrinsics = Intrinsics { width: 130, height: 130, fx: 200.0, fy: 200.0, cx: 65.0, cy: 65.0 };
        let rotation = DQuat::from_rotation_x(std::f64::consts::PI);
        (east.to_string(), View { intrinsics, pose: Pose { rotation, center: DVec3::new(east, 0.0, 40.0) } })
    }

    fn drawn(request: &MapRequest) -> (Map, DrawnBlock) {
        let cloud = cloud();
        let header = ModelHeader { views: [-8.0, 0.0, 8.0].map(nadir).to_vec(), ..ModelHeader::default() };
        let request =
            MapRequest { up: Some(Up::named("z").unwrap()), gsd: Some(0.25), min_views: 2, ..request.clone() };
        let map = Map::of(&header, &cloud, &request).unwrap();
        let mut trainer = renderer(None, &cloud, 130, 130).unwrap();
        let mut drawn = DrawnBlock::default();
        let [block] = map.grid.blocks().collect::<Vec<_>>().try_into().unwrap();
        assert!(map.draw(&mut trainer, block, &mut drawn).unwrap());
        (map, drawn)
    }

    /// The height at a place on the equator of the map, and its standard deviation.
    fn at(map: &Map, drawn: &DrawnBlock, east: f64) -> Option<(f32, f32)> {
        let pixel = map.grid.pixel(DVec2::new(east, 0.0));
        let i = pixel.y as usize * map.grid.size()[0] as usize + pixel.x as usize;
        (drawn.rgba[4 * i + 3] > 0).then(|| (drawn.heights[i], drawn.height_sigmas[i]))
    }

    #[test]
    fn ground_behind_what_other_pictures_show_is_no_ground() {
        let (map, drawn) = drawn(&MapRequest::default());
        for east in [-6.0, 0.0, 6.0] {
            let (height, sigma) = at(&map, &drawn, east).unwrap();
            assert!(height.abs() < 0.1 && (0.0..0.2).contains(&sigma), "{east}: {height} ± {sigma}");
        }
        // Two frusta hold the point at that depth; one of the two pictures shows ground in front of it.
        for east in [13.5, 14.5, 15.5] {
            assert_eq!(at(&map, &drawn, east), None, "{east}");
        }
    }

    #[test]
    fn a_bound_on_standard_deviations_leaves_out_what_is_worth_less() {
        let (map, all) = drawn(&MapRequest::default());
        let (_, sigma) = at(&map, &all, 0.0).unwrap();
        let most = |m: f32| MapRequest { max_sigma_m: Some(m.into()), ..MapRequest::default() };
        let (map, few) = drawn(&most(0.5 * sigma));
        assert_eq!(at(&map, &few, 0.0), None);
        let count = |of: &DrawnBlock| of.rgba.chunks_exact(4).filter(|p| p[3] > 0).count();
        let (map, known) = drawn(&most(2.0 * sigma));
        assert!(at(&map, &known, 0.0).is_some() && count(&few) < count(&known) && count(&known) <= count(&all));
    }
}
