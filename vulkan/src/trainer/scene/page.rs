//! Cells onto the device and back, with their moments.

use super::cell::{self, Bounds};
use super::{Cell, Scene};
use crate::arena::Arena;
use crate::trainer::parameters::{Held, Parameters};
use crate::trainer::{TrainError, Trainer, state};

impl Scene {
    /// Every Gaussian, cell by cell; `on_device` of them are there.
    pub fn each_record<E: From<TrainError>>(
        &mut self,
        on_device: usize,
        mut take: impl FnMut(Held<'_>) -> Result<(), E>,
    ) -> Result<(), E> {
        if !self.is_paged() {
            return (0..on_device).try_for_each(|i| take(Held::OnDevice(i)));
        }
        self.check_whole()?;
        self.sort_by_cell(on_device);
        let mut from = 0;
        for (index, cell) in self.cells.iter().enumerate() {
            if cell.on_device {
                let run = run_of(&self.order[from..], &self.tags, index as u32);
                run.iter().try_for_each(|i| take(Held::OnDevice(*i as usize)))?;
                from += run.len();
            } else {
                self.store.read(&cell.chain, |_, record| take(Held::InFile(record)))?;
            }
        }
        Ok(())
    }

    /// What was lost on the way to the file or from it must not be taken for a smaller scene.
    fn check_whole(&self) -> Result<(), TrainError> {
        match self.whole {
            true => Ok(()),
            false => {
                Err(TrainError::SceneFile("it failed while cells were moved; go on from the last checkpoint".into()))
            }
        }
    }

    fn sort_by_cell(&mut self, on_device: usize) {
        let Self { order, tags, .. } = self;
        order.clear();
        order.extend(0..on_device as u32);
        order.sort_unstable_by_key(|i| (tags[*i as usize], *i));
    }

    /// Takes all Gaussians off the device. With `again`, those that left their cell are counted to the one they came to; cells may
    /// have other indices then.
    fn page_out(
        &mut self,
        arena: &Arena,
        parameters: &Parameters,
        on_device: usize,
        again: bool,
    ) -> Result<(), TrainError> {
        self.check_whole()?;
        if again {
            self.count_to_cells_again(arena, parameters);
        }
        self.sort_by_cell(on_device);
        self.measure(arena, parameters);
        self.whole = false;
        let Self { cells, store, order, tags, .. } = self;
        for cell in cells.iter_mut().filter(|cell| cell.on_device) {
            store.forget(&mut cell.chain);
            cell.on_device = false;
        }
        let mut from = 0;
        while from < order.len() {
            let index = tags[order[from] as usize];
            let run = run_of(&order[from..], tags, index);
            let cell = &mut cells[index as usize];
            store.append(&mut cell.chain, run.len(), |i, record| {
                parameters.read_record(arena, run[i] as usize, record);
            })?;
            from += run.len();
        }
        tags.clear();
        self.away += on_device;
        self.whole = true;
        Ok(())
    }

    /// Counts and bounds the cells on the device, and those to which Gaussians came from there.
    pub fn measure(&mut self, arena: &Arena, parameters: &Parameters) {
        for cell in self.cells.iter_mut().filter(|cell| cell.on_device) {
            (cell.bounds, cell.count) = (Bounds::EMPTY, 0);
        }
        for (g, tag) in parameters.geometry(arena).iter().zip(&self.tags) {
            let cell = &mut self.cells[*tag as usize];
            cell.bounds.add(g);
            cell.count += 1;
        }
    }

    /// Counts those that left their cell, or outgrew it, to another; while there is room for one more it may be a new one.
    fn count_to_cells_again(&mut self, arena: &Arena, parameters: &Parameters) {
        for (i, g) in parameters.geometry(arena)[..self.tags.len()].iter().enumerate() {
            let (home, reach) = (self.cells[self.tags[i] as usize].key, cell::reach_of(g));
            if self.grid.holds(home, g.mean, reach) || !g.is_finite() {
                continue;
            }
            let key = self.grid.key(g.mean, reach);
            let found = self.cells.binary_search_by_key(&key, |cell| cell.key);
            self.tags[i] = match found {
                Ok(other) => other as u32,
                Err(new) if self.cells.len() < self.cells.capacity() => {
                    self.tags.iter_mut().filter(|tag| **tag >= new as u32).for_each(|tag| *tag += 1);
                    self.cells.insert(new, Cell::empty(key));
                    new as u32
                }
                // It stays, and the bounds of its cell grow.
                Err(_) => self.tags[i],
            };
        }
    }

    /// Puts the cells `wanted`, in order, onto the empty device; returns how many Gaussians they have.
    fn page_in(&mut self, arena: &mut Arena, parameters: &Parameters, wanted: &[u32]) -> Result<usize, TrainError> {
        self.check_whole()?;
        self.whole = false;
        let mut n = 0;
        for &index in wanted {
            let cell = &mut self.cells[index as usize];
            self.store.read(&cell.chain, |i, record| {
                parameters.write_record(arena, n + i, record);
                Ok::<(), TrainError>(())
            })?;
            cell.on_device = true;
            n += cell.chain.count as usize;
            self.tags.resize(n, index);
        }
        self.away -= n;
        self.whole = true;
        Ok(n)
    }
}

/// Those at the beginning of `order` that belong to cell `index`.
fn run_of<'a>(order: &'a [u32], tags: &[u32], index: u32) -> &'a [u32] {
    let end = order.iter().position(|i| tags[*i as usize] != index).unwrap_or(order.len());
    &order[..end]
}

impl Trainer {
    /// Takes all cells off the device. With `again`, Gaussians that left their cell are counted to the one they came to, and cells may
    /// have other indices.
    pub(super) fn page_out(&mut self, again: bool) -> Result<(), TrainError> {
        let _phase = tracing::trace_span!("page out").entered();
        self.flush()?;
        let moved = self.scene.store.moved;
        self.scene.page_out(&self.arena, &self.parameters, self.gaussians, again)?;
        self.counters.paged_bytes += self.scene.store.moved - moved;
        self.gaussians = 0;
        Ok(())
    }

    /// Puts the cells `wanted`, by index and in order, onto the empty device.
    pub(super) fn page_in(&mut self, wanted: &[u32]) -> Result<(), TrainError> {
        let _phase = tracing::trace_span!("page in", cells = wanted.len()).entered();
        let moved = self.scene.store.moved;
        self.gaussians = self.scene.page_in(&mut self.arena, &self.parameters, wanted)?;
        self.counters.paged_bytes += self.scene.store.moved - moved;
        // A cell that is away stands still: it missed nothing.
        let (steps, all_degrees) = (self.steps, self.settings.sh.raise_share >= 1.0);
        for g in &mut self.parameters.geometry_mut(&mut self.arena)[..self.gaussians] {
            g.state = state::up_to(g.state, steps);
            if all_degrees {
                g.state = state::with_degree(g.state, self.plan.sh_degree);
            }
        }
        Ok(())
    }
}
