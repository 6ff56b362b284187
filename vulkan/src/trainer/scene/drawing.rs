//! Drawing a scene of which the device holds a part at a time: the same bits as from one that holds all of it.

use super::cell::Sight;
use crate::layout::Frame;
use crate::trainer::{TrainError, Trainer};

impl Sight {
    /// Of the region that `frame` shows.
    fn of_region(frame: &Frame) -> Self {
        Self::new(frame, frame.region_origin, frame.region)
    }
}

impl Trainer {
    /// Has all cells on the device that may show in the region of the frame; returns how many Gaussians they have where those are
    /// too many.
    pub(in crate::trainer) fn hold_region(&mut self) -> Result<Option<usize>, TrainError> {
        let sight = Sight::of_region(&self.frame);
        if !self.scene.drawing {
            // A window that is over ends as it would have without the drawing.
            self.end_window()?;
            // Training moved what is on the device.
            self.scene.measure(&self.arena, &self.parameters);
        }
        let mut cells = std::mem::take(&mut self.scene.drawn);
        cells.clear();
        let (mut needed, mut away) = (0, false);
        for (i, cell) in self.scene.cells.iter().enumerate() {
            if sight.blocks(&cell.bounds).is_some() {
                cells.push(i as u32);
                needed += cell.count;
                away |= !(cell.on_device || cell.copied);
            }
        }
        let fits = needed <= self.plan.gaussians;
        let done = if away && fits { self.draw_instead(&cells) } else { Ok(()) };
        self.scene.drawn = cells;
        done.map(|()| (away && !fits).then_some(needed))
    }
}
