//! Which Gaussians of a scene in cells are on the device: those of the window that is trained, or those that a drawing shows.

use super::scene::{Choice, Frustum, Places, Scene};
use super::{Model, common_degree};
use crate::device::Device;
use crate::error::TrainError;
use config::training::TrainSettings;

impl Model {
    /// Moves cells, and counts what was moved.
    pub(super) fn page(
        &mut self,
        device: &mut Device,
        how: impl FnOnce(&mut Scene, Places<'_>) -> Result<(), TrainError>,
    ) -> Result<(), TrainError> {
        let _phase = tracing::trace_span!("page").entered();
        let moved = self.scene.store.moved;
        let degree = common_degree(device.plan(), self.own_degrees);
        let arena = &mut device.arena;
        let done = how(&mut self.scene, Places { arena, parameters: self.parameters, updates: self.updates, degree });
        self.counters.paged_bytes += self.scene.store.moved - moved;
        self.gaussians = self.scene.tags.len();
        done
    }

    /// Pages all out; no window is at work.
    fn page_out(&mut self, device: &mut Device) -> Result<(), TrainError> {
        self.page(device, |scene, places| {
            scene.leave(&places, |_| false)?;
            scene.tags.clear();
            Ok(())
        })
    }

    /// Those that left their cell for one that is away leave the device, too.
    fn settle_in_cells(&mut self, device: &mut Device) -> Result<(), TrainError> {
        self.page(device, |scene, mut places| {
            scene.count_to_cells_again(places.arena, &places.parameters);
            scene.measure(places.arena, &places.parameters);
            scene.leave(&places, |cell| cell.on_device)?;
            scene.close_up(&mut places, 0);
            Ok(())
        })
    }

    /// All cells in their file, and a window at its end: the next step chooses another one.
    pub(super) fn leave_for_file(&mut self, device: &mut Device) -> Result<(), TrainError> {
        self.end_drawing(device)?;
        if self.gaussians > 0 {
            self.settle_in_cells(device)?;
            self.page_out(device)?;
        }
        self.scene.window.end_at(self.updates);
        Ok(())
    }

    /// Puts the Gaussians, all of which are on the device, into cells: a scene outgrows the device while it is densified, or as new ground
    /// comes. The next step chooses a window.
    pub fn enter_cells(&mut self, device: &mut Device, settings: &TrainSettings) -> Result<(), TrainError> {
        self.flush(device)?;
        let geometry = &self.parameters.geometry(&device.arena)[..self.gaussians];
        self.scene.enclose(device.plan(), settings, geometry)?;
        self.page_out(device)
    }

    /// Has the cells of a window on the device: the present one's, or those of the next when it is over.
    pub fn hold_window(&mut self, device: &mut Device, by: Choice<'_>) -> Result<(), TrainError> {
        self.end_drawing(device)?;
        if !self.window_ends() {
            return Ok(());
        }
        self.end_window(device)?;
        let updates = by.updates;
        let Scene { window, cells, .. } = &mut self.scene;
        window.choose(cells, by)?;
        self.page(device, |scene, mut places| {
            scene.cells.iter_mut().for_each(|cell| cell.at_work = false);
            scene.window.cells.iter().for_each(|index| scene.cells[*index as usize].at_work = true);
            scene.leave(&places, |cell| cell.at_work)?;
            scene.come(&mut places)
        })?;
        self.scene.window.until = self.updates + updates;
        self.counters.windows += 1;
        Ok(())
    }

    /// Whether the step just taken was the last of its window.
    pub fn window_ends(&self) -> bool {
        self.updates >= self.scene.window.until
    }

    /// Counts to their cells again what a window that is over moved.
    fn end_window(&mut self, device: &mut Device) -> Result<(), TrainError> {
        if self.gaussians == 0 || !self.window_ends() {
            return Ok(());
        }
        self.settle_in_cells(device)
    }

    /// Where in a scene in cells densification stands, `steps` after the last one, as a share of one in a schedule that holds the whole
    /// scene and densifies every `interval` steps: each cell comes to its turn once in as many steps as it takes to go through all.
    pub fn density_due(&self, steps: f32, interval: u32) -> f32 {
        let turns = self.total() as f32 / self.gaussians.max(1) as f32;
        steps * turns / interval.max(1) as f32
    }

    /// Has all cells on the device that may show in the region of the frame; returns how many Gaussians they have where those are
    /// too many. What is drawn has the same bits as from a device that holds the whole scene.
    pub fn hold_region(&mut self, device: &mut Device) -> Result<Option<usize>, TrainError> {
        let frustum = Frustum::of_region(&device.frame);
        if !self.scene.drawing {
            // A window that is over ends as it would have without the drawing.
            self.end_window(device)?;
            // Training moved what is on the device.
            self.scene.measure(&device.arena, &self.parameters);
        }
        let mut drawn = std::mem::take(&mut self.scene.drawn);
        drawn.clear();
        let (mut needed, mut away) = (0, false);
        for (i, cell) in self.scene.cells.iter().enumerate() {
            if frustum.blocks(&cell.bounds).is_some() {
                drawn.push(i as u32);
                needed += cell.count;
                away |= !(cell.on_device || cell.copied);
            }
        }
        let fits = needed <= device.plan().gaussians;
        let instead = |scene: &mut Scene, mut places: Places<'_>| scene.draw_instead(&mut places, &drawn);
        let done = if away && fits { self.page(device, instead) } else { Ok(()) };
        self.scene.drawn = drawn;
        done.map(|()| (away && !fits).then_some(needed))
    }

    /// Has the window back that was on the device before something was drawn.
    fn end_drawing(&mut self, device: &mut Device) -> Result<(), TrainError> {
        if !self.scene.drawing {
            return Ok(());
        }
        self.page(device, |scene, mut places| scene.end_drawing(&mut places))
    }
}
