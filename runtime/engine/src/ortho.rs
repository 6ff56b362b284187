//! Maps of a model: every block seen from above with parallel rays, in the memory of one block whatever the map's size.

use std::path::Path;

use disk::Disk;
use glam::{DQuat, DVec2, DVec3, Vec3};
use models::camera::{Pose, View};
use models::cloud::GaussianCloud;
use models::formats::model::{Chunks, ModelHeader};
use survey::ortho::OrthoError;
use survey::ortho::crs::Crs;
use survey::ortho::extent::{Extent, SAMPLE, ViewsAround};
use survey::ortho::files::{MapFiles, NO_HEIGHT, Written};
use survey::ortho::grid::{BLOCK, Block, BlockView, Grid};
use survey::ortho::up::{self, Up};
use vulkan::trainer::{Rendering, Trainer};

use crate::device::map_renderer;
use crate::error::EngineError;

/// Where less than this share of a pixel is covered, there is no ground.
const LEAST_COVER: f32 = 0.5;
/// Who saw the ground is asked once for squares of so many pixels a side.
const SEEN_CELL: u32 = 4;

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
    /// The axis that points up, where the model is nowhere on Earth; `None`: what its cameras say.
    pub up: Option<Up>,
}

impl Default for MapRequest {
    fn default() -> Self {
        // bench map: orthophoto 26.0 dB of what two pictures saw, 29.3 dB of what four did; the sparsest flights leave few places to four.
        Self { gsd: None, most_pixels: None, epsg: None, bounds: None, min_views: 3, up: None }
    }
}

/// A model's ground and the raster to draw it in.
pub struct Map {
    extent: Extent,
    grid: Grid,
    min_views: usize,
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
    rendering: Rendering,
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
        Ok(Self { extent, grid: Grid::new(crs, bounds, gsd)?, min_views: request.min_views, turn })
    }

    /// Ground that fewer training pictures saw is left out.
    pub fn min_views(&self) -> usize {
        self.min_views
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
                files.write(block, &mut drawn.rgba, &drawn.heights)?;
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
        let ground = self.extent.ground(place);
        let look = self.grid.look(block, self.extent.top(place))?;
        let back = self.turn.conjugate();
        let pose = &look.view.pose;
        let mut view = look.view;
        view.pose = Pose { rotation: back * pose.rotation, center: back * pose.center };
        trainer.render_orthographic(&view, &mut into.rendering)?;
        let pixels = block.width as usize * block.height as usize;
        into.rgba.clear();
        into.rgba.resize(4 * pixels, 0);
        into.heights.clear();
        into.heights.resize(pixels, NO_HEIGHT);
        for y in (0..block.height).step_by(SEEN_CELL as usize) {
            for x in (0..block.width).step_by(SEEN_CELL as usize) {
                if self.is_seen(&seen, &look, &into.rendering, [x, y], ground) {
                    fill(into, block, [x, y], look.top_m);
                }
            }
        }
        Ok(true)
    }

    /// Whether enough pictures saw the middle of the square at `corner`.
    fn is_seen(
        &self,
        seen: &ViewsAround<'_>,
        look: &BlockView,
        rendering: &Rendering,
        corner: [u32; 2],
        ground: f64,
    ) -> bool {
        if !self.extent.has_views() || self.min_views == 0 {
            return true;
        }
        let [u, v] = corner.map(|k| k + SEEN_CELL / 2);
        let (i, view) = ((v * BLOCK + u) as usize, &look.view);
        let cover = 1.0 - rendering.transmittance[i];
        let depth = match cover < LEAST_COVER {
            true => view.pose.center.z - ground,
            false => f64::from(rendering.depth[i]),
        };
        let half = f64::from(BLOCK) / 2.0;
        let [right, down] = view.pixels_per_metre;
        let local = DVec3::new((f64::from(u) - half) / right, (f64::from(v) - half) / down, depth);
        seen.count(view.pose.center + view.pose.rotation * local) >= self.min_views
    }
}

/// Takes the pixels of a square from the rendering.
fn fill(into: &mut DrawnBlock, block: Block, [x, y]: [u32; 2], top_m: f64) {
    for v in y..(y + SEEN_CELL).min(block.height) {
        for u in x..(x + SEEN_CELL).min(block.width) {
            let (from, to) = ((v * BLOCK + u) as usize, (v * block.width + u) as usize);
            let cover = 1.0 - into.rendering.transmittance[from];
            if cover >= LEAST_COVER {
                let byte = |c: usize| (into.rendering.rgb[3 * from + c] / cover).clamp(0.0, 1.0) * 255.0;
                let color = [byte(0), byte(1), byte(2)].map(|v| v.round() as u8);
                into.rgba[4 * to..4 * to + 3].copy_from_slice(&color);
                into.rgba[4 * to + 3] = u8::MAX;
                into.heights[to] = (top_m - f64::from(into.rendering.depth[from])) as f32;
            }
        }
    }
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
