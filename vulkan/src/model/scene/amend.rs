//! Gaussians that come, move and go while a scene in cells is trained: in its file, where they lie. The cells that have none of them
//! are not touched.

use models::cloud::GaussianCloud;

use super::cell::{self, CellBounds};
use super::store::Rewritten;
use super::{Cell, Scene};
use crate::error::TrainError;
use crate::model::amend::{BoundingBox, Fate, SAMPLED, donor_of, pull_of};
use crate::model::parameters::{Geometry, Parameters, record_of};
use config::plan::BLOCK_GAUSSIANS;

impl CellBounds {
    /// Whether a mean of the cell may lie in `within`.
    fn meets(&self, within: &BoundingBox) -> bool {
        (0..3).all(|k| self.low[k] <= within.high[k] && self.high[k] >= within.low[k])
    }
}

impl Scene {
    /// The cells of some means in `within`. One that is not a number is in no bounds: where all are visited, so are all cells.
    fn cells_of(&mut self, within: &BoundingBox) -> (&mut super::Store, impl Iterator<Item = &mut Cell>) {
        let (store, all) = (&mut self.store, *within == BoundingBox::ALL);
        (store, self.cells.iter_mut().filter(move |cell| cell.count > 0 && (all || cell.bounds.meets(within))))
    }

    /// The cell that a new Gaussian comes to; a neighbour, whose bounds grow, where there is no room for one of its own.
    fn cell_for(&mut self, g: &Geometry) -> usize {
        let key = self.grid.key(g.mean, cell::reach_of(g));
        self.cell_or_new(key).unwrap_or_else(|near| near.min(self.cells.len() - 1))
    }

    /// A record whose second moments new ones begin with ([`donor_of`]), of some cells at equal steps.
    fn donor(&mut self) -> Result<Option<Vec<u8>>, TrainError> {
        let Self { cells, store, .. } = self;
        let few = SAMPLED / BLOCK_GAUSSIANS;
        let mut pulls: Vec<(f32, (usize, usize))> = Vec::with_capacity(2 * SAMPLED);
        let beginning = |cell: &Cell| {
            let mut chain = cell.chain;
            chain.count = chain.count.min(BLOCK_GAUSSIANS as u32);
            chain
        };
        for (index, cell) in cells.iter().enumerate().step_by(cells.len().div_ceil(few).max(1)) {
            store.read(&beginning(cell), |i, record| {
                pulls.push((pull_of(&Geometry::of_record(record)), (index, i)));
                Ok::<(), TrainError>(())
            })?;
        }
        let Some((index, place)) = donor_of(pulls.into_iter()) else { return Ok(None) };
        let mut donor = None;
        store.read(&beginning(&cells[index]), |i, record| {
            donor = if i == place { Some(record.to_vec()) } else { donor.take() };
            Ok::<(), TrainError>(())
        })?;
        Ok(donor)
    }

    /// Shows every Gaussian of `within`, cell by cell; all cells are in the file.
    pub fn each_within(&mut self, within: &BoundingBox, mut see: impl FnMut(&Geometry)) -> Result<(), TrainError> {
        self.check_whole()?;
        let (store, cells) = self.cells_of(within);
        for cell in cells {
            store.read(&cell.chain, |_, record| {
                let g = Geometry::of_record(record);
                if within.holds(g.mean) {
                    see(&g);
                }
                Ok::<(), TrainError>(())
            })?;
        }
        Ok(())
    }

    /// Moves Gaussians of `within` and takes others out, in the order of [`Scene::each_within`]; never the last one. What moves out of
    /// its cell stays with it, whose bounds grow, until the cell was on the device.
    pub fn revise(&mut self, within: &BoundingBox, mut fate: impl FnMut(&Geometry) -> Fate) -> Result<(), TrainError> {
        self.check_whole()?;
        self.whole = false;
        let mut left = self.away;
        let (store, cells) = self.cells_of(within);
        for cell in cells {
            let mut bounds = CellBounds::EMPTY;
            store.rewrite(&mut cell.chain, |record| {
                let mut g = Geometry::of_record(record);
                let fate = if within.holds(g.mean) { fate(&g) } else { Fate::Stays };
                let rewritten = match fate {
                    Fate::Goes if left > 1 => {
                        left -= 1;
                        return Rewritten::Goes;
                    }
                    Fate::Moves { mean, rotation } => {
                        (g.mean, g.rotation) = (mean, rotation);
                        g.into_record(record);
                        Rewritten::Changes
                    }
                    Fate::Stays | Fate::Goes => Rewritten::Stays,
                };
                bounds.add(&g);
                rewritten
            })?;
            (cell.bounds, cell.count) = (bounds, cell.chain.count as usize);
        }
        self.away = left;
        self.whole = true;
        Ok(())
    }

    /// Adds the Gaussians `rows` of a cloud to their cells, and cells where there are none; of each the first `coefficients` numbers of SH.
    pub fn extend(
        &mut self,
        cloud: &GaussianCloud,
        rows: &[usize],
        coefficients: usize,
        parameters: &Parameters,
    ) -> Result<(), TrainError> {
        self.check_whole()?;
        let donor = self.donor()?;
        let new = |row: usize| super::geometry_of(cloud, row);
        // All cells there will be, before any is counted by its place among them.
        rows.iter().for_each(|row| _ = self.cell_for(&new(*row)));
        let mut order: Vec<(u32, u32)> =
            rows.iter().map(|row| (self.cell_for(&new(*row)) as u32, *row as u32)).collect();
        order.sort_unstable();
        self.whole = false;
        for run in order.chunk_by(|a, b| a.0 == b.0) {
            let cell = &mut self.cells[run[0].0 as usize];
            self.store.append(&mut cell.chain, run.len(), |i, record| {
                record_of(cloud, run[i].1 as usize, coefficients, record);
                if let Some(donor) = &donor {
                    parameters.begin_with(record, donor);
                }
            })?;
            run.iter().for_each(|(_, row)| cell.bounds.add(&new(*row as usize)));
            cell.count += run.len();
        }
        self.away += rows.len();
        self.whole = true;
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use config::plan::{Plan, PlanRequest};

    use super::*;
    use crate::fixture::Fixture;
    use crate::gpu::Gpu;
    use crate::synthetic::{cloud, photo, plain, posed, view};
    use crate::trainer::Trainer;

    /// Small Gaussians seen from afar: a part of a picture shows few of them.
    fn afar(seed: u64, n: usize) -> GaussianCloud {
        let mut scene = cloud(seed, n, 0);
        scene.log_scales.iter_mut().for_each(|s| *s = s.map(|s| s.min(-2.0) - 2.5));
        scene.means.iter_mut().for_each(|m| m[2] += 30.0);
        scene
    }

    /// A trainer of 256 Gaussians at once, in which 240 were trained for some steps while 40 pictures came, and 200 more have come since.
    fn grown() -> Option<Fixture> {
        let Ok(gpu) = Gpu::open(None) else {
            needs::missing(needs::Need::Vulkan, "no Vulkan device");
            return None;
        };
        let request = PlanRequest {
            width: 48,
            height: 32,
            views: 40,
            max_gaussians: Some(256),
            scene_gaussians: Some(1000),
            ..Default::default()
        };
        let mut t = Fixture::new(&gpu, &Plan::new(&request).unwrap(), &plain()).unwrap();
        t.keep_scene_in(tempfile::tempfile().unwrap());
        t.load(&afar(1, 240)).unwrap();
        t.while_views_come();
        for k in 0..40 {
            let mut v = view(48, 32);
            v.intrinsics.fx *= 7.0;
            v.intrinsics.fy *= 7.0;
            t.add_view(&posed(&v, &photo(k, &v)), None).unwrap();
        }
        (0..6).for_each(|_| _ = t.step().unwrap());
        assert_eq!(t.extend(&afar(2, 200)).unwrap().loaded, 200);
        assert!(t.model.scene.is_paged() && t.gaussians() == 440);
        Some(t)
    }

    #[test]
    fn the_first_step_of_new_gaussians_is_of_the_usual_length() {
        let Some(mut t) = grown() else { return };
        let (mut moved, mut new) = (0, Vec::new());
        let Fixture { trainer: Trainer { device, model, .. }, .. } = &mut t;
        model.leave_for_file(device).unwrap();
        model
            .scene
            .each_within(&BoundingBox::ALL, |g| match g.first == [[0.0; 4]; 3] {
                true => new.push(g.second[0][0]),
                false => moved += 1,
            })
            .unwrap();
        assert!(moved > 100 && new.len() >= 200, "{moved} {}", new.len());
        let begun = new.iter().filter(|second| **second > 0.0).count();
        assert!(begun >= 200, "{begun} of {} begin with the second moments of another one", new.len());
    }

    #[test]
    fn while_views_come_windows_begin_with_the_newest() {
        let Some(mut t) = grown() else { return };
        // A new one every eight updates.
        let newest = |t: &mut Fixture| {
            let each = |_| {
                t.turns.views.forget();
                (0..8).filter(|_| t.step().unwrap().view >= 20).count()
            };
            (0..5).map(each).sum::<usize>()
        };
        let flying = newest(&mut t);
        assert!(flying >= 27, "{flying} of 40");
        t.turns.views.prefer_newest(false);
        let landed = newest(&mut t);
        assert!(landed < 27, "each has its turn: {landed} of 40");
    }
}
