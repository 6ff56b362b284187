//! Cells onto the device and back, with their moments.
//!
//! Where Gaussians lie on the device decides bits of what follows, so it depends on steps alone: those that leave make room, in order,
//! for those that come, and what a drawing pages out comes back to where it was.

use super::cell::{self, CellBounds};
use super::{Cell, Scene};
use crate::arena::Arena;
use crate::error::TrainError;
use crate::model::parameters::{Held, Parameters};
use crate::model::state;

/// The Gaussians' places in the arena while cells come and go.
pub(in crate::model) struct Places<'a> {
    pub arena: &'a mut Arena,
    pub parameters: Parameters,
    /// Updates so far.
    pub updates: u32,
    /// The SH degree that all Gaussians have, where they have one.
    pub degree: Option<u8>,
}

impl Places<'_> {
    /// Copies Gaussian `index` to a record. Its state says there how many steps it missed: while it is away it misses none.
    fn page_out(&self, index: usize, record: &mut [u8]) {
        self.parameters.read_record(self.arena, index, record);
        let missed = state::turned(self.parameters.geometry(self.arena)[index].state, self.updates);
        Parameters::write_state(record, missed);
    }

    /// Copies a record to place `index`.
    fn page_in(&mut self, index: usize, record: &[u8]) {
        self.parameters.write_record(self.arena, index, record);
        let g = &mut self.parameters.geometry_mut(self.arena)[index];
        g.state = state::turned(g.state, self.updates);
        if let Some(degree) = self.degree {
            g.state = state::with_degree(g.state, degree);
        }
    }

    /// Gaussian `index` missed nothing.
    fn up_to_date(&mut self, index: usize) {
        let g = &mut self.parameters.geometry_mut(self.arena)[index];
        g.state = state::up_to(g.state, self.updates);
    }
}

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
        self.sort_by_cell();
        let mut from = 0;
        for (index, cell) in self.cells.iter().enumerate() {
            // Of a cell that is away some may have come to be on the device, as those that left another one for it.
            self.store.read(&cell.chain, |_, record| take(Held::InFile(record)))?;
            let run = run_of(&self.order[from..], &self.tags, index as u32);
            run.iter().try_for_each(|i| take(Held::OnDevice(*i as usize)))?;
            from += run.len();
        }
        Ok(())
    }

    /// What was lost on the way to the file or from it must not be taken for a smaller scene.
    pub(super) fn check_whole(&self) -> Result<(), TrainError> {
        match self.whole {
            true => Ok(()),
            false => {
                Err(TrainError::SceneFile("it failed while cells were moved; go on from the last checkpoint".into()))
            }
        }
    }

    /// Those on the device, but for copies that are drawn.
    fn sort_by_cell(&mut self) {
        let Self { order, tags, starts, drawing, .. } = self;
        order.clear();
        if *drawing {
            return;
        }
        starts.clear();
        starts.resize(self.cells.len(), 0);
        tags.iter().for_each(|tag| starts[*tag as usize] += 1);
        let mut before = 0;
        starts.iter_mut().for_each(|start| before += std::mem::replace(start, before));
        order.resize(tags.len(), 0);
        for (i, tag) in tags.iter().enumerate() {
            let start = &mut starts[*tag as usize];
            order[*start as usize] = i as u32;
            *start += 1;
        }
    }

    /// Counts and bounds the cells on the device, and those to which Gaussians came from there.
    pub fn measure(&mut self, arena: &Arena, parameters: &Parameters) {
        for cell in self.cells.iter_mut().filter(|cell| cell.on_device) {
            (cell.bounds, cell.count) = (CellBounds::EMPTY, 0);
        }
        for (g, tag) in parameters.geometry(arena).iter().zip(&self.tags) {
            let cell = &mut self.cells[*tag as usize];
            cell.bounds.add(g);
            cell.count += 1;
        }
    }

    /// Counts those that left their cell, or outgrew it, to another; while there is room for one more it may be a new one.
    pub(in crate::model) fn count_to_cells_again(&mut self, arena: &Arena, parameters: &Parameters) {
        for (i, g) in parameters.geometry(arena)[..self.tags.len()].iter().enumerate() {
            let (home, reach) = (self.cells[self.tags[i] as usize].key, cell::reach_of(g));
            if self.grid.holds(home, g.mean, reach) || !g.is_finite() {
                continue;
            }
            // Where there is no room for its cell it stays, and the bounds of the one it is in grow.
            if let Ok(cell) = self.cell_or_new(self.grid.key(g.mean, reach)) {
                self.tags[i] = cell as u32;
            }
        }
    }

    /// Writes those to the file whose cell does not stay; their places are holes then.
    pub(in crate::model) fn leave(
        &mut self,
        places: &Places<'_>,
        stays: impl Fn(&Cell) -> bool,
    ) -> Result<(), TrainError> {
        self.check_whole()?;
        self.sort_by_cell();
        self.whole = false;
        let Self { cells, store, order, tags, holes, .. } = self;
        holes.clear();
        let mut from = 0;
        while from < order.len() {
            let index = tags[order[from] as usize];
            let run = run_of(&order[from..], tags, index);
            let cell = &mut cells[index as usize];
            if !stays(cell) {
                store.append(&mut cell.chain, run.len(), |i, record| places.page_out(run[i] as usize, record))?;
                holes.extend_from_slice(run);
            }
            from += run.len();
        }
        cells.iter_mut().for_each(|cell| cell.on_device &= stays(cell));
        holes.sort_unstable();
        self.away += holes.len();
        self.whole = true;
        Ok(())
    }

    /// Pages the cells at work in: into the holes, then behind the others. Whoever is last comes to the holes
    /// that are left.
    pub(in crate::model) fn come(&mut self, places: &mut Places<'_>) -> Result<(), TrainError> {
        self.check_whole()?;
        self.whole = false;
        let mut filled = 0;
        let Self { cells, store, tags, holes, .. } = self;
        for (index, cell) in cells.iter_mut().enumerate().filter(|(_, cell)| cell.at_work && !cell.on_device) {
            store.read(&cell.chain, |_, record| {
                let place = holes.get(filled).map_or(tags.len(), |hole| *hole as usize);
                places.page_in(place, record);
                match tags.get_mut(place) {
                    Some(tag) => *tag = index as u32,
                    None => tags.push(index as u32),
                }
                filled += 1;
                Ok::<(), TrainError>(())
            })?;
            self.away -= cell.chain.count as usize;
            store.forget(&mut cell.chain);
            cell.on_device = true;
        }
        let left = filled.min(holes.len());
        self.close_up(places, left);
        self.whole = true;
        Ok(())
    }

    /// The last ones come to the holes, but for the first `filled` of them.
    pub(in crate::model) fn close_up(&mut self, places: &mut Places<'_>, filled: usize) {
        for hole in self.holes.drain(filled..).rev() {
            let hole = hole as usize;
            let Some(last) = self.tags.pop() else { break };
            if let Some(tag) = self.tags.get_mut(hole) {
                *tag = last;
                places.parameters.shift(places.arena, self.tags.len(), hole);
            }
        }
        self.holes.clear();
    }

    /// Pages the window out, remembers where each of it was, and pages copies of the cells `drawn`, by index and in order,
    /// there instead.
    pub(in crate::model) fn draw_instead(&mut self, places: &mut Places<'_>, drawn: &[u32]) -> Result<(), TrainError> {
        if !self.drawing {
            self.leave(places, |_| false)?;
            std::mem::swap(&mut self.tags, &mut self.window_tags);
            self.drawing = true;
        }
        self.forget_copies();
        let Self { cells, store, tags, away, .. } = self;
        for &index in drawn {
            let (n, cell) = (tags.len(), &mut cells[index as usize]);
            store.read(&cell.chain, |i, record| {
                places.page_in(n + i, record);
                // What it missed it still has to do: here it is drawn as it is.
                places.up_to_date(n + i);
                Ok::<(), TrainError>(())
            })?;
            tags.resize(n + cell.chain.count as usize, index);
            *away -= cell.chain.count as usize;
            cell.copied = true;
        }
        Ok(())
    }

    fn forget_copies(&mut self) {
        self.away += self.tags.len();
        self.tags.clear();
        self.cells.iter_mut().for_each(|cell| cell.copied = false);
    }

    /// Puts the window back to where each of it was.
    pub(in crate::model) fn end_drawing(&mut self, places: &mut Places<'_>) -> Result<(), TrainError> {
        self.check_whole()?;
        self.forget_copies();
        self.whole = false;
        std::mem::swap(&mut self.tags, &mut self.window_tags);
        self.drawing = false;
        self.sort_by_cell();
        let Self { cells, store, order, tags, .. } = self;
        let mut from = 0;
        while from < order.len() {
            let index = tags[order[from] as usize];
            let run = run_of(&order[from..], tags, index);
            let cell = &mut cells[index as usize];
            store.read(&cell.chain, |i, record| {
                places.page_in(run[i] as usize, record);
                Ok::<(), TrainError>(())
            })?;
            store.forget(&mut cell.chain);
            from += run.len();
        }
        // A cell at work may have lost all it had.
        cells.iter_mut().for_each(|cell| cell.on_device = cell.at_work);
        self.away -= tags.len();
        self.whole = true;
        Ok(())
    }
}

/// Those at the beginning of `order` that belong to cell `index`.
fn run_of<'a>(order: &'a [u32], tags: &[u32], index: u32) -> &'a [u32] {
    let end = order.iter().position(|i| tags[*i as usize] != index).unwrap_or(order.len());
    &order[..end]
}
