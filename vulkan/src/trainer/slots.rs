//! Where a view's pixels are: in a slot of the arena, or in a file until a step wants them.
//!
//! What a step computes does not depend on how many slots there are: a view comes back as it was written, byte for byte. The
//! order of views follows from the seed, so that the next one is known while a step runs, and the system reads it ahead.

use super::{TrainError, Trainer};
use crate::arena::Section;
use config::plan::{Plan, view_bytes};
use rustix::fs::{Advice, fadvise};
use std::fs::File;
use std::num::NonZeroU64;
use std::os::unix::fs::FileExt;

/// The view slots and the file behind them.
pub(crate) struct Slots {
    held: Vec<Held>,
    /// Uses of any slot so far.
    uses: u64,
    file: Option<File>,
    /// Bytes of a view in the file.
    record: u64,
    /// Views read back since they were added.
    pub read_back: u64,
}

#[derive(Clone, Copy, Default)]
struct Held {
    view: Option<usize>,
    last_use: u64,
}

impl Slots {
    pub fn new(plan: &Plan) -> Self {
        let (held, record) = (vec![Held::default(); plan.view_slots], view_bytes(plan.pixels as u64));
        Self { held, uses: 0, file: None, record, read_back: 0 }
    }

    /// The slot of `view`, and whether its pixels are there; where they are not, the slot unused for longest is now its.
    fn claim(&mut self, view: usize) -> (usize, bool) {
        self.uses += 1;
        let there = self.held.iter().position(|held| held.view == Some(view));
        let oldest = || (0..self.held.len()).min_by_key(|&slot| self.held[slot].last_use).unwrap_or(0);
        let slot = there.unwrap_or_else(oldest);
        self.held[slot] = Held { view: Some(view), last_use: self.uses };
        (slot, there.is_some())
    }

    /// Nothing is in `slot` that could be used.
    fn give_up(&mut self, slot: usize) {
        self.held[slot] = Held::default();
    }

    fn file(&self) -> Result<&File, TrainError> {
        self.file.as_ref().ok_or_else(|| TrainError::ViewFile("none was given; call Trainer::keep_views_in".into()))
    }
}

fn failed(view: usize, e: std::io::Error) -> TrainError {
    TrainError::ViewFile(format!("view {view}: {e}"))
}

impl Trainer {
    /// Keeps the views that find no slot on the device in `file`, empty and with room for
    /// [`config::plan::PlanRequest::view_file_bytes`]. Call it before the first view where the plan holds fewer slots than views.
    pub fn keep_views_in(&mut self, file: File) {
        self.slots.file = Some(file);
    }

    /// Views read back from the file so far.
    pub fn views_read_back(&self) -> u64 {
        self.slots.read_back
    }

    /// A slot for a new view.
    pub(super) fn slot_for_new(&mut self, view: usize) -> usize {
        self.slots.claim(view).0
    }

    /// The slot of a view, read back from the file when it is not on the device. The device must be idle.
    pub(super) fn resident(&mut self, view: usize) -> Result<usize, TrainError> {
        let (slot, there) = self.slots.claim(view);
        if !there {
            let _phase = tracing::trace_span!("read view", view).entered();
            let section = self.pixels_in(slot, view);
            let at = view as u64 * self.slots.record;
            let bytes = self.arena.slice_mut::<u8>(section);
            let read = self.slots.file().and_then(|f| f.read_exact_at(bytes, at).map_err(|e| failed(view, e)));
            if let Err(e) = read {
                self.slots.give_up(slot);
                return Err(e);
            }
            self.slots.read_back += 1;
        }
        Ok(slot)
    }

    /// Writes a view's slot to the file, where there is not a slot for every view.
    pub(super) fn keep(&mut self, slot: usize, view: usize) -> Result<(), TrainError> {
        if self.plan.view_slots >= self.plan.views {
            return Ok(());
        }
        let at = view as u64 * self.slots.record;
        let bytes = self.arena.slice::<u8>(self.pixels_in(slot, view));
        let kept = self.slots.file().and_then(|f| f.write_all_at(bytes, at).map_err(|e| failed(view, e)));
        kept.inspect_err(|_| self.slots.give_up(slot))
    }

    /// Has the system read the view that comes next.
    pub(super) fn read_ahead(&self) {
        let slots = &self.slots;
        if let (Some(file), Some(next)) = (&slots.file, self.sampler.peek())
            && !slots.held.iter().any(|held| held.view == Some(next))
        {
            // Advice that is not taken costs time, nothing else.
            _ = fadvise(file, next as u64 * slots.record, NonZeroU64::new(slots.record), Advice::WillNeed);
        }
    }

    /// What a view takes of its slot.
    pub(super) fn pixels_in(&self, slot: usize, view: usize) -> Section {
        let resident = &self.views[view];
        let bytes = view_bytes(u64::from(resident.width) * u64::from(resident.height));
        Section { bytes, ..self.arena.view_slot(&self.plan, slot) }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_view_unused_for_longest_gives_way() {
        let mut slots = Slots { held: vec![Held::default(); 2], uses: 0, file: None, record: 0, read_back: 0 };
        assert_eq!(
            [0, 1, 0, 2, 0, 1].map(|view| slots.claim(view)),
            [(0, false), (1, false), (0, true), (1, false), (0, true), (1, false)]
        );
        slots.give_up(0);
        assert_eq!((slots.claim(3), slots.claim(1)), ((0, false), (1, true)), "what was given up goes first");
    }
}
