//! A scene of more Gaussians than the device holds: cells of ground, of which a window is on the device with its moments, and
//! the others wait in a file.
//!
//! Nothing on the device is approximate: a window is chosen so that the parts of pictures which are trained in it see no
//! Gaussian that is away. A cell that is away stands still; Adam's moments come back as they left. What happens depends on steps,
//! never on how fast the disk is.

mod cell;
mod drawing;
mod growth;
mod page;
mod parts;
mod store;
mod window;

pub(crate) use cell::Blocks;

use cell::Bounds;
use config::plan::Plan;
use config::training::TrainSettings;
use models::cloud::GaussianCloud;
use models::ground_cell::{CellKey, Grid};
use store::{Chain, Store};
use window::Window;

use super::parameters::Geometry;
use super::{TrainError, Trainer};

/// Means by which the scene's extent is measured ([`config::training::scene_extent`] looks at no more).
const SAMPLED_MEANS: usize = 4096;
/// Share of the ground that is left out on each side when the size of cells is chosen: strays.
const STRAY_SHARE: f32 = 0.02;
/// Cells are made smaller by 2^16 at most: Gaussians in one place would be in one cell whatever its size.
const MOST_HALVINGS: u32 = 16;

/// One cell.
struct Cell {
    key: CellKey,
    bounds: Bounds,
    /// Gaussians.
    count: usize,
    /// Where its Gaussians lie in the file, or lay before they came to the device.
    chain: Chain,
    on_device: bool,
}

impl Cell {
    fn empty(key: CellKey) -> Self {
        Self { key, bounds: Bounds::EMPTY, count: 0, chain: Chain::EMPTY, on_device: false }
    }
}

/// The cells, which of them are on the device, and the window of training.
pub(crate) struct Scene {
    grid: Grid,
    /// By key; none while all Gaussians are on the device.
    cells: Vec<Cell>,
    store: Store,
    /// The cell of each Gaussian on the device.
    tags: Vec<u32>,
    /// Gaussians on the device by cell.
    order: Vec<u32>,
    /// Gaussians that are not on the device.
    pub away: usize,
    /// Every Gaussian is where the cells say: false from when the file fails while cells are moved until the next load.
    whole: bool,
    window: Window,
    /// Cells that a rendering sees.
    drawn: Vec<u32>,
    /// Some means of all cells.
    means: Vec<[f32; 3]>,
}

impl Scene {
    pub fn new(plan: &Plan) -> Self {
        let tags = if plan.is_paged() { plan.gaussians } else { 0 };
        Self {
            grid: Grid { side: 1.0 },
            cells: Vec::with_capacity(plan.cells()),
            store: Store::new(plan),
            tags: Vec::with_capacity(tags),
            order: Vec::with_capacity(tags),
            away: 0,
            whole: true,
            window: Window::new(plan),
            drawn: Vec::with_capacity(plan.cells()),
            means: Vec::with_capacity(if plan.is_paged() { SAMPLED_MEANS } else { 0 }),
        }
    }

    /// Whether the Gaussians lie in cells.
    pub fn is_paged(&self) -> bool {
        !self.cells.is_empty()
    }

    /// Means that stand for all Gaussians, while they lie in cells.
    pub fn means(&self) -> &[[f32; 3]] {
        &self.means
    }

    /// All Gaussians are on the device from here on.
    pub fn close(&mut self) {
        self.cells.clear();
        self.tags.clear();
        self.store.clear();
        (self.away, self.whole) = (0, true);
        self.window.close();
    }

    /// Puts the Gaussians `keep` of a cloud into cells, all of them away; `fill(i, record)` writes Gaussian i.
    pub fn fill(
        &mut self,
        plan: &Plan,
        settings: &TrainSettings,
        cloud: &GaussianCloud,
        keep: &[usize],
        fill: impl Fn(usize, &mut [u8]),
    ) -> Result<(), TrainError> {
        self.close();
        let geometry = |i: usize| Geometry {
            mean: cloud.means[i],
            log_scale: cloud.log_scales[i],
            ..bytemuck::Zeroable::zeroed()
        };
        let keyed = self.divide(plan, settings, keep.len(), &|i| geometry(keep[i]));
        for run in keyed.chunk_by(|a, b| a.0 == b.0) {
            let mut cell = Cell { count: run.len(), ..Cell::empty(run[0].0) };
            run.iter().for_each(|(_, i)| cell.bounds.add(&geometry(keep[*i as usize])));
            self.store.append(&mut cell.chain, run.len(), |i, record| fill(keep[run[i].1 as usize], record))?;
            self.cells.push(cell);
        }
        self.away = keep.len();
        Ok(())
    }

    /// Chooses the size of cells for `n` Gaussians; returns the cell of each, by cell.
    fn divide(
        &mut self,
        plan: &Plan,
        settings: &TrainSettings,
        n: usize,
        geometry: &dyn Fn(usize) -> Geometry,
    ) -> Vec<(CellKey, u32)> {
        self.means.clear();
        let stride = n.div_ceil(SAMPLED_MEANS).max(1);
        self.means.extend((0..n).step_by(stride).map(|i| geometry(i).mean));
        let wide = |axis: usize| {
            let mut along: Vec<f32> = self.means.iter().map(|m| m[axis]).collect();
            along.sort_unstable_by(f32::total_cmp);
            let strays = (along.len() as f32 * STRAY_SHARE) as usize;
            along[along.len() - 1 - strays] - along[strays]
        };
        let per_cell = plan.gaussians as f32 / settings.cells.per_window as f32;
        let wanted = ((n as f32 / per_cell) as usize).clamp(1, plan.cells());
        let side = (wide(0) * wide(1) / wanted as f32).sqrt();
        self.grid.side = if side.is_finite() && side > 0.0 { side } else { 1.0 };
        let mut keyed = self.keyed(n, geometry);
        // Ground is not all covered alike: where much of it is empty, cells are smaller.
        for _ in 0..MOST_HALVINGS {
            if distinct(&keyed) >= wanted {
                break;
            }
            self.grid.side *= 0.5;
            keyed = self.keyed(n, geometry);
        }
        while distinct(&keyed) > plan.cells() && (self.grid.side * 2.0).is_finite() {
            self.grid.side *= 2.0;
            keyed = self.keyed(n, geometry);
        }
        keyed
    }

    /// Gaussians by cell, and in their order within it.
    fn keyed(&self, n: usize, geometry: &dyn Fn(usize) -> Geometry) -> Vec<(CellKey, u32)> {
        let key = |i: usize| {
            let g = geometry(i);
            (self.grid.key(g.mean, cell::reach_of(&g)), i as u32)
        };
        let mut keyed: Vec<(CellKey, u32)> = (0..n).map(key).collect();
        keyed.sort_unstable();
        keyed
    }

    /// Gaussian `from` takes place `to` on the device, or is copied there.
    pub fn place(&mut self, from: usize, to: usize) {
        if self.is_paged() {
            let tag = self.tags[from];
            match self.tags.get_mut(to) {
                Some(place) => *place = tag,
                None => self.tags.push(tag),
            }
        }
    }

    /// So many Gaussians remain on the device.
    pub fn truncate(&mut self, gaussians: usize) {
        self.tags.truncate(gaussians);
    }
}

fn distinct(keyed: &[(CellKey, u32)]) -> usize {
    keyed.chunk_by(|a, b| a.0 == b.0).count()
}

impl Trainer {
    /// Keeps the cells that find no room on the device in `file`, empty and with room for [`Plan::scene_file_bytes`]. Call it before
    /// [`Trainer::load`] where the plan holds fewer Gaussians than the scene.
    pub fn keep_scene_in(&mut self, file: std::fs::File) {
        self.scene.store.keep_in(file);
    }

    /// Cells of ground, and how many of them are on the device; (0, 0) while all Gaussians are.
    pub fn cells(&self) -> (usize, usize) {
        (self.scene.cells.len(), self.scene.cells.iter().filter(|c| c.on_device).count())
    }
}
