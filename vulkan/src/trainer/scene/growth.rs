//! A scene that outgrows the device while it is densified goes into cells then.

use super::{Cell, Scene};
use crate::trainer::{TrainError, Trainer};

impl Trainer {
    /// Puts the Gaussians, all of which are on the device, into cells. The next step chooses a window.
    pub(in crate::trainer) fn enter_cells(&mut self) -> Result<(), TrainError> {
        self.flush()?;
        self.scene.close();
        let geometry = self.parameters.geometry(&self.arena);
        let keyed = self.scene.divide(&self.plan, &self.settings, self.gaussians, &|i| geometry[i]);
        let Scene { cells, tags, .. } = &mut self.scene;
        tags.resize(self.gaussians, 0);
        for run in keyed.chunk_by(|a, b| a.0 == b.0) {
            run.iter().for_each(|(_, i)| tags[*i as usize] = cells.len() as u32);
            cells.push(Cell { on_device: true, ..Cell::empty(run[0].0) });
        }
        self.page_out(false)
    }

    /// What a densification at the end of a window is worth of one in a schedule that holds the whole scene: each cell comes to its
    /// turn once in as many steps as it takes to go through all of them.
    pub(in crate::trainer) fn window_share(&self, interval: u32) -> f32 {
        let turns = self.gaussians() as f32 / self.gaussians.max(1) as f32;
        (self.settings.cells.steps as f32 * turns / interval.max(1) as f32).min(1.0)
    }

    /// Whether the step just taken was the last of its window.
    pub(in crate::trainer) fn window_ends(&self) -> bool {
        self.steps >= self.scene.window.until
    }
}
