//! A scene into the model and out of it: as a whole, or piece by piece, where it is larger than the host's memory.

use super::Model;
use super::kept::{Kept, LoadReport, Pieces};
use super::parameters::{Held, blend_record, clear, push_record, record_of};
use crate::device::Device;
use crate::error::TrainError;
use config::plan::Plan;
use config::training::TrainSettings;
use models::cloud::{GaussianCloud, sh_coefficients};

/// Gaussians of a piece.
const PIECE: usize = 16 << 10;

impl Model {
    /// Replaces the Gaussians by those of `pieces` that are finite, and of more than the plan has room for by the most important.
    pub fn load_pieces<E: From<TrainError>>(
        &mut self,
        device: &mut Device,
        settings: &TrainSettings,
        pieces: Pieces<'_, E>,
    ) -> Result<LoadReport, E> {
        let (kept, report) = Kept::new(pieces, device.plan().scene)?;
        if report.loaded == 0 {
            return Err(TrainError::Empty { non_finite: report.dropped_non_finite }.into());
        }
        self.scene.close();
        self.gaussians = 0;
        let degree = device.plan().sh_degree;
        let fill = |cloud: &GaussianCloud, row: usize, record: &mut [u8]| {
            record_of(cloud, row, 3 * sh_coefficients(degree.min(cloud.sh_degree)), record);
        };
        if report.loaded > device.plan().gaussians {
            self.scene.fill(device.plan(), settings, report.loaded, &kept, fill)?;
        } else {
            self.fill_device(device, report.loaded, &kept, fill)?;
        }
        self.restart();
        Ok(report)
    }

    fn fill_device<E: From<TrainError>>(
        &mut self,
        device: &mut Device,
        n: usize,
        kept: &Kept<'_, E>,
        fill: impl Fn(&GaussianCloud, usize, &mut [u8]),
    ) -> Result<(), E> {
        let Self { record, parameters, .. } = self;
        let mut to = 0;
        kept.each(&mut |cloud, rows| {
            for row in rows {
                // A source that gives more than it gave before is stopped before it leaves its place.
                if to == n {
                    return Err(TrainError::SceneChanged.into());
                }
                fill(cloud, *row as usize, record);
                parameters.write_record(&mut device.arena, to, record);
                to += 1;
            }
            Ok(())
        })?;
        if to < n {
            return Err(TrainError::SceneChanged.into());
        }
        self.gaussians = n;
        Ok(())
    }

    /// Writes the present parameters to `cloud`, reusing its memory.
    pub fn snapshot(&mut self, device: &mut Device, cloud: &mut GaussianCloud) -> Result<(), TrainError> {
        clear(cloud, device.plan().sh_degree);
        cloud.reserve_exact(self.total());
        self.each_record(device, |plan, record| {
            push_record(cloud, plan, record);
            Ok::<(), TrainError>(())
        })
    }

    /// Moves every parameter of `cloud` by `share` of the way to the present one.
    pub fn blend_into(&mut self, device: &mut Device, cloud: &mut GaussianCloud, share: f32) -> Result<(), TrainError> {
        let mut row = 0;
        self.each_record(device, |plan, record| {
            blend_record(cloud, row, plan, record, share);
            row += 1;
            Ok::<(), TrainError>(())
        })
    }

    /// Gives the present parameters to `take` piece by piece, in the order of [`Model::snapshot`].
    pub fn each_piece<E: From<TrainError>>(
        &mut self,
        device: &mut Device,
        take: &mut dyn FnMut(&mut GaussianCloud) -> Result<(), E>,
    ) -> Result<(), E> {
        let mut piece = GaussianCloud::with_capacity(device.plan().sh_degree, PIECE.min(self.total()));
        self.each_record::<E>(device, |plan, record| {
            push_record(&mut piece, plan, record);
            if piece.len() == PIECE {
                take(&mut piece)?;
                clear(&mut piece, plan.sh_degree);
            }
            Ok(())
        })?;
        if piece.is_empty() { Ok(()) } else { take(&mut piece) }
    }

    /// Gives the record of every Gaussian to `take`, up to date.
    fn each_record<E: From<TrainError>>(
        &mut self,
        device: &mut Device,
        mut take: impl FnMut(&Plan, &[u8]) -> Result<(), E>,
    ) -> Result<(), E> {
        self.flush(device)?;
        let Self { record, parameters, scene, .. } = self;
        let (arena, plan) = (&device.arena, device.plan());
        scene.each_record(self.gaussians, |from| match from {
            Held::OnDevice(index) => {
                parameters.read_record(arena, index, record);
                take(plan, record)
            }
            Held::InFile(record) => take(plan, record),
        })?;
        Ok(arena.failure().map_err(TrainError::from)?)
    }
}
