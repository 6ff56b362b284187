//! A scene of more Gaussians than the device holds: cells of ground, of which a window is on the device with its moments, and
//! the others wait in a file.
//!
//! Nothing on the device is approximate: a window is chosen so that the parts of pictures which are trained in it see no
//! Gaussian that is away. A cell that is away stands still; Adam's moments come back as they left. What happens depends on steps,
//! never on how fast the disk is.

mod amend;
mod begin;
mod cell;
mod page;
mod parts;
mod store;
mod window;

pub(crate) use cell::Blocks;
pub(super) use cell::Frustum;
pub(super) use page::Places;
pub(crate) use window::Choice;

use cell::CellBounds;
use config::plan::Plan;
use config::training::TrainSettings;
use models::cloud::GaussianCloud;
use models::ground_cell::{CellKey, Grid};
use std::collections::BTreeMap;
use store::{Chain, Store};
use window::Window;

use super::kept::Kept;
use super::parameters::Geometry;
use crate::error::TrainError;
use crate::pictures::Picture;
use rand::Rng;

/// Means by which the scene's extent is measured ([`config::training::scene_extent`] takes no more).
const SAMPLED_MEANS: usize = 4096;
/// Share of the ground that is left out on each side when the size of cells is chosen: strays.
const STRAY_SHARE: f32 = 0.02;
/// Cells are made smaller so often at most: Gaussians in one place would be in one cell whatever its size.
const MOST_CHANGES: u32 = 16;
/// This share of the cells wanted will do.
const ENOUGH: f32 = 0.8;
/// And this share, where smaller cells came to be no more than [`LEAST_GAIN`] times as many.
const ENOUGH_IN_VAIN: f32 = 0.25;
const LEAST_GAIN: f32 = 1.02;
/// Cells are made larger by this factor until there are few enough.
const WIDER: f32 = 1.2;

/// Shows every Gaussian of a scene, in the same order each time.
type Visit<'a, E> = &'a dyn Fn(&mut dyn FnMut(&Geometry)) -> Result<(), E>;

/// One cell.
pub(super) struct Cell {
    key: CellKey,
    pub bounds: CellBounds,
    /// Gaussians.
    pub count: usize,
    /// Where its Gaussians lie in the file, or lay before they came to the device.
    chain: Chain,
    pub on_device: bool,
    /// Of the window: on the device but while something is drawn.
    pub at_work: bool,
    /// A copy of it is on the device, to be drawn.
    pub copied: bool,
}

impl Cell {
    fn empty(key: CellKey) -> Self {
        Self {
            key,
            bounds: CellBounds::EMPTY,
            count: 0,
            chain: Chain::EMPTY,
            on_device: false,
            at_work: false,
            copied: false,
        }
    }
}

/// The cells, which of them are on the device, and the window of training.
pub(crate) struct Scene {
    grid: Grid,
    /// By key; none while all Gaussians are on the device.
    pub(super) cells: Vec<Cell>,
    pub store: Store,
    /// The cell of each Gaussian on the device.
    pub(super) tags: Vec<u32>,
    /// Gaussians on the device by cell.
    order: Vec<u32>,
    /// Where in `order` each cell begins, and in the end where it ends.
    starts: Vec<u32>,
    /// Places on the device of those that left, in order.
    holes: Vec<u32>,
    /// While something is drawn: the cell of each Gaussian of the window, as `tags` will have it again.
    window_tags: Vec<u32>,
    /// The device holds copies that are drawn.
    pub(super) drawing: bool,
    /// Gaussians that are not on the device.
    pub away: usize,
    /// Every Gaussian is where the cells say: false from when the file fails while cells are moved until the next load.
    whole: bool,
    pub(super) window: Window,
    /// Cells that a rendering sees.
    pub(super) drawn: Vec<u32>,
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
            starts: Vec::with_capacity(plan.cells()),
            holes: Vec::with_capacity(tags),
            window_tags: Vec::with_capacity(tags),
            drawing: false,
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

    /// Cells, and how many of them are on the device.
    pub fn cells(&self) -> (usize, usize) {
        (self.cells.len(), self.cells.iter().filter(|c| c.on_device).count())
    }

    /// What the next update visits, and which part of it.
    pub fn next_part(&mut self, crops_due: bool, rng: &mut impl Rng) -> (Picture, Blocks) {
        self.window.next_part(crops_due, rng)
    }

    /// All Gaussians are on the device from here on.
    pub fn close(&mut self) {
        self.cells.clear();
        self.tags.clear();
        self.store.clear();
        (self.away, self.whole, self.drawing) = (0, true, false);
        self.window.close();
    }

    /// Puts the `n` Gaussians that are kept into cells, all of them away; `fill(piece, row, record)` writes one. The scene is read a few
    /// times: for the size of cells and what is in them, then to bring each Gaussian to its cell.
    pub fn fill<E: From<TrainError>>(
        &mut self,
        plan: &Plan,
        settings: &TrainSettings,
        n: usize,
        kept: &Kept<'_, E>,
        fill: impl Fn(&GaussianCloud, usize, &mut [u8]),
    ) -> Result<(), E> {
        self.close();
        let done = self.divide(plan, settings, [n, n], &|see| {
            kept.each(&mut |cloud, rows| {
                rows.iter().for_each(|row| see(&geometry_of(cloud, *row as usize)));
                Ok(())
            })
        });
        if let Err(e) = done.and_then(|()| self.bring(n, kept, fill)) {
            self.close();
            return Err(e);
        }
        self.away = n;
        Ok(())
    }

    /// Puts Gaussians, all of which are on the device, into cells, of which there are enough for as many as the scene may come to hold.
    pub fn enclose(&mut self, plan: &Plan, settings: &TrainSettings, geometry: &[Geometry]) -> Result<(), TrainError> {
        self.close();
        self.divide::<TrainError>(plan, settings, [geometry.len(), plan.scene], &|see| {
            geometry.iter().for_each(see);
            Ok(())
        })?;
        for g in geometry {
            let cell = self.cell_of(g).ok_or(TrainError::SceneChanged)?;
            self.tags.push(cell as u32);
        }
        self.cells.iter_mut().for_each(|cell| cell.on_device = true);
        Ok(())
    }

    /// Brings each Gaussian to its cell, in order.
    fn bring<E: From<TrainError>>(
        &mut self,
        n: usize,
        kept: &Kept<'_, E>,
        fill: impl Fn(&GaussianCloud, usize, &mut [u8]),
    ) -> Result<(), E> {
        for cell in &mut self.cells {
            self.store.set_aside(&mut cell.chain, cell.count)?;
        }
        let mut order: Vec<(u32, u32)> = Vec::new();
        kept.each(&mut |cloud, rows| {
            order.clear();
            for row in rows {
                let cell = self.cell_of(&geometry_of(cloud, *row as usize)).ok_or(TrainError::SceneChanged)?;
                order.push((cell as u32, *row));
            }
            order.sort_unstable();
            for run in order.chunk_by(|a, b| a.0 == b.0) {
                let chain = &mut self.cells[run[0].0 as usize].chain;
                self.store.append(chain, run.len(), |i, record| fill(cloud, run[i].1 as usize, record))?;
            }
            Ok(())
        })?;
        let all: usize = self.cells.iter().map(|cell| cell.chain.count as usize).sum();
        let as_counted = self.cells.iter().all(|cell| cell.chain.count as usize == cell.count);
        if as_counted && all == n { Ok(()) } else { Err(TrainError::SceneChanged.into()) }
    }

    /// Chooses the size of cells for the `n` Gaussians that `visit` shows, which are to become `grown`, and counts and bounds the cells
    /// that have any.
    fn divide<E: From<TrainError>>(
        &mut self,
        plan: &Plan,
        settings: &TrainSettings,
        [n, grown]: [usize; 2],
        visit: Visit<'_, E>,
    ) -> Result<(), E> {
        self.sample(n, visit)?;
        let per_cell = plan.gaussians as f32 / settings.cells.per_window as f32;
        let wanted = ((grown as f32 / per_cell) as usize).clamp(1, plan.cells());
        let wanted = (wanted as u64 * n as u64 / grown.max(n) as u64).max(1) as usize;
        let side = (self.wide(0) * self.wide(1) / wanted as f32).sqrt();
        self.grid.side = if side.is_finite() && side > 0.0 { side } else { 1.0 };
        let mut found = self.count(visit)?;
        // Ground is not all covered alike: where much of it is empty, cells are smaller.
        let mut gains = true;
        for _ in 0..MOST_CHANGES {
            let share = found as f32 / wanted as f32;
            if share >= if gains { ENOUGH } else { ENOUGH_IN_VAIN } {
                break;
            }
            // As many as there are come of a square metre, nearly: Gaussians as large as cells are in coarser ones.
            self.grid.side *= share.sqrt().clamp(0.5, 0.9);
            let before = std::mem::replace(&mut found, self.count(visit)?);
            gains = found as f32 >= LEAST_GAIN * before as f32;
        }
        while found > self.cells.len() && (self.grid.side * WIDER).is_finite() {
            self.grid.side *= WIDER;
            found = self.count(visit)?;
        }
        self.cells.sort_unstable_by_key(|cell| cell.key);
        Ok(())
    }

    /// Takes means at equal steps through all Gaussians.
    fn sample<E: From<TrainError>>(&mut self, n: usize, visit: Visit<'_, E>) -> Result<(), E> {
        self.means.clear();
        let (stride, mut at) = (n.div_ceil(SAMPLED_MEANS).max(1), 0);
        visit(&mut |g| {
            if at % stride == 0 && self.means.len() < SAMPLED_MEANS {
                self.means.push(g.mean);
            }
            at += 1;
        })?;
        if at == n && n > 0 { Ok(()) } else { Err(TrainError::SceneChanged.into()) }
    }

    /// How wide the ground is along an axis, strays left out, metres.
    fn wide(&self, axis: usize) -> f32 {
        let mut along: Vec<f32> = self.means.iter().map(|m| m[axis]).collect();
        along.sort_unstable_by(f32::total_cmp);
        let strays = (along.len() as f32 * STRAY_SHARE) as usize;
        along[along.len() - 1 - strays] - along[strays]
    }

    /// Counts and bounds the cells of the present size that have Gaussians, in no order. How many they are: one more than there is room
    /// for where they are more, which are no use then.
    fn count<E>(&mut self, visit: Visit<'_, E>) -> Result<usize, E> {
        let Self { cells, grid, .. } = self;
        cells.clear();
        let (mut index, mut too_many) = (BTreeMap::new(), false);
        visit(&mut |g| {
            let key = grid.key(g.mean, cell::reach_of(g));
            let at = *index.entry(key).or_insert(cells.len() as u32) as usize;
            if at == cells.len() {
                if cells.len() == cells.capacity() {
                    index.remove(&key);
                    too_many = true;
                    return;
                }
                cells.push(Cell::empty(key));
            }
            cells[at].count += 1;
            cells[at].bounds.add(g);
        })?;
        Ok(cells.len() + usize::from(too_many))
    }

    /// The cell of a Gaussian; `None` when no cell was counted there.
    fn cell_of(&self, g: &Geometry) -> Option<usize> {
        let key = self.grid.key(g.mean, cell::reach_of(g));
        self.cells.binary_search_by_key(&key, |cell| cell.key).ok()
    }

    /// The cell of a key: a new one while there is room for one more, else where it would be among the others.
    fn cell_or_new(&mut self, key: CellKey) -> Result<usize, usize> {
        self.cells.binary_search_by_key(&key, |cell| cell.key).or_else(|new| {
            if self.cells.len() == self.cells.capacity() {
                return Err(new);
            }
            self.tags.iter_mut().filter(|tag| **tag >= new as u32).for_each(|tag| *tag += 1);
            self.cells.insert(new, Cell::empty(key));
            Ok(new)
        })
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

/// What cells are made by.
fn geometry_of(cloud: &GaussianCloud, row: usize) -> Geometry {
    Geometry { mean: cloud.means[row], log_scale: cloud.log_scales[row], ..bytemuck::Zeroable::zeroed() }
}
