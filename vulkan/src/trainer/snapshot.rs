//! The trained Gaussians out of the trainer: as a whole, or piece by piece, where they are more than the host's memory holds.

use super::parameters::{Held, clear, push_record};
use super::{TrainError, Trainer};
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
        self.each_held(cloud, |_| Ok::<(), TrainError>(()))
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
        self.each_held::<E>(&mut piece, |piece| {
            if piece.len() == PIECE {
                take(piece)?;
                clear(piece, piece.sh_degree);
            }
            Ok(())
        })?;
        if piece.is_empty() { Ok(()) } else { take(&piece) }
    }

    /// Adds every Gaussian to `cloud`, which `added` sees after each.
    fn each_held<E: From<TrainError>>(
        &mut self,
        cloud: &mut GaussianCloud,
        mut added: impl FnMut(&mut GaussianCloud) -> Result<(), E>,
    ) -> Result<(), E> {
        self.flush()?;
        let (parameters, arena, plan) = (self.parameters, &self.arena, &self.plan);
        let mut record = std::mem::take(&mut self.record);
        let done = self.scene.each_record(self.gaussians, |from| {
            match from {
                Held::OnDevice(index) => {
                    parameters.read_record(arena, index, &mut record);
                    push_record(cloud, plan, &record);
                }
                Held::InFile(record) => push_record(cloud, plan, record),
            }
            added(cloud)
        });
        self.record = record;
        done?;
        Ok(self.arena.failure().map_err(TrainError::from)?)
    }
}
