//! The trained Gaussians out of the trainer: as a whole, or piece by piece, where they are more than the host's memory holds.

use super::parameters::{Held, blend_record, clear, push_record};
use super::{TrainError, Trainer};
use config::plan::Plan;
use models::cloud::GaussianCloud;

/// Gaussians of a piece.
const PIECE: usize = 16 << 10;

impl Trainer {
    /// Writes the present parameters to `cloud`, reusing its memory.
    ///
    /// # Errors
    /// [`TrainError::Gpu`], [`TrainError::SceneFile`].
    pub fn snapshot(&mut self, cloud: &mut GaussianCloud) -> Result<(), TrainError> {
        clear(cloud, self.plan.sh_degree);
        cloud.reserve_exact(self.gaussians());
        self.each_record(|plan, record| {
            push_record(cloud, plan, record);
            Ok::<(), TrainError>(())
        })
    }

    /// Moves every parameter of `cloud`, which is an earlier [`Trainer::snapshot`] of as many Gaussians, by `share` of the way to the present
    /// one. Allocates nothing.
    ///
    /// # Errors
    /// As [`Trainer::snapshot`]; the cloud is of no use then.
    pub fn blend_into(&mut self, cloud: &mut GaussianCloud, share: f32) -> Result<(), TrainError> {
        let mut row = 0;
        self.each_record(|plan, record| {
            blend_record(cloud, row, plan, record, share);
            row += 1;
            Ok::<(), TrainError>(())
        })
    }

    /// Gives the present parameters to `take` piece by piece, in the order of [`Trainer::snapshot`]. What it has not flushed before it
    /// does first, so that it gives the same Gaussians until the next step.
    ///
    /// # Errors
    /// As [`Trainer::snapshot`], and those of `take`.
    pub fn each_piece<E: From<TrainError>>(
        &mut self,
        take: &mut dyn FnMut(&GaussianCloud) -> Result<(), E>,
    ) -> Result<(), E> {
        let mut piece = GaussianCloud::with_capacity(self.plan.sh_degree, PIECE.min(self.gaussians()));
        self.each_record::<E>(|plan, record| {
            push_record(&mut piece, plan, record);
            if piece.len() == PIECE {
                take(&piece)?;
                clear(&mut piece, plan.sh_degree);
            }
            Ok(())
        })?;
        if piece.is_empty() { Ok(()) } else { take(&piece) }
    }

    /// Gives the record of every Gaussian to `take`, up to date.
    fn each_record<E: From<TrainError>>(
        &mut self,
        mut take: impl FnMut(&Plan, &[u8]) -> Result<(), E>,
    ) -> Result<(), E> {
        self.flush()?;
        let (parameters, arena, plan) = (self.parameters, &self.arena, &self.plan);
        let mut record = std::mem::take(&mut self.record);
        let done = self.scene.each_record(self.gaussians, |from| match from {
            Held::OnDevice(index) => {
                parameters.read_record(arena, index, &mut record);
                take(plan, &record)
            }
            Held::InFile(record) => take(plan, record),
        });
        self.record = record;
        done?;
        Ok(self.arena.failure().map_err(TrainError::from)?)
    }
}
