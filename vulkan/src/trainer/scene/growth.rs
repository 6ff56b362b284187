//! A scene that outgrows the device while it is densified, or as new ground comes, goes into cells then.

use crate::trainer::{TrainError, Trainer};

impl Trainer {
    /// Puts the Gaussians, all of which are on the device, into cells. The next step chooses a window.
    pub(in crate::trainer) fn enter_cells(&mut self) -> Result<(), TrainError> {
        self.flush()?;
        self.scene.close();
        let geometry = &self.parameters.geometry(&self.arena)[..self.gaussians];
        // There are cells for all that the scene may come to hold.
        let sizes = [self.gaussians, self.plan.scene];
        self.scene.divide::<TrainError>(&self.plan, &self.settings, sizes, &|see| {
            geometry.iter().for_each(see);
            Ok(())
        })?;
        for g in geometry {
            let cell = self.scene.cell_of(g).ok_or(TrainError::SceneChanged)?;
            self.scene.tags.push(cell as u32);
        }
        self.scene.cells.iter_mut().for_each(|cell| cell.on_device = true);
        self.page_out()
    }

    /// Where in a scene in cells densification stands, `steps` after the last one, as a share of one in a schedule that holds the whole
    /// scene and densifies every `interval` steps: each cell comes to its turn once in as many steps as it takes to go through all.
    pub(in crate::trainer) fn density_due(&self, steps: f32, interval: u32) -> f32 {
        let turns = self.gaussians() as f32 / self.gaussians.max(1) as f32;
        steps * turns / interval.max(1) as f32
    }

    /// Whether the step just taken was the last of its window.
    pub(in crate::trainer) fn window_ends(&self) -> bool {
        self.updates >= self.scene.window.until
    }
}
