//! Gaussians that go in and out of files: those that training begins with, and checkpoints.

use std::path::Path;

use disk::Disk;
use job::run_json::RunReport;
use models::cloud::{GaussianCloud, Plausible};
use models::formats::model::{self, Chunks, ModelHeader};

use super::Training;
use crate::error::EngineError;
use crate::pieces::{self, load, save, told};

/// The model that an earlier run left.
pub(crate) enum Earlier {
    Whole(ModelHeader, GaussianCloud),
    Pieces(Chunks),
}

impl Earlier {
    pub fn header(&self) -> &ModelHeader {
        match self {
            Self::Whole(header, _) => header,
            Self::Pieces(model) => &model.header,
        }
    }

    pub fn gaussians(&self) -> usize {
        match self {
            Self::Whole(_, cloud) => cloud.len(),
            Self::Pieces(model) => model.count,
        }
    }
}

impl Training {
    /// The model of an earlier run at `path`, read as a whole or to be read piece by piece.
    pub(crate) fn earlier(&self, disk: &Disk, path: &Path) -> Result<Option<Earlier>, EngineError> {
        Ok(match self.in_pieces {
            true => model::open_checkpoint(disk, path)?.map(Earlier::Pieces),
            false => model::read_checkpoint(disk, path)?.map(|(header, mut cloud)| {
                told(Plausible::of(&cloud.means).mend(&mut cloud));
                Earlier::Whole(header, cloud)
            }),
        })
    }

    /// Training begins with its Gaussians.
    pub(crate) fn begin_with(&mut self, earlier: Earlier) {
        match earlier {
            Earlier::Whole(_, cloud) => self.cloud.clone_from(&cloud),
            Earlier::Pieces(model) => self.first = Some(model),
        }
    }

    /// Gives the trainer the Gaussians that it begins with; how many of them it took.
    pub(crate) fn load_first(&mut self, report: &mut RunReport) -> Result<usize, EngineError> {
        let loaded = match self.first.take() {
            Some(model) => load(&mut self.trainer, &model)?,
            None => self.trainer.load(&self.cloud)?,
        };
        // The trainer has the Gaussians: a scene in pieces is not kept beside it.
        if self.in_pieces {
            self.cloud = GaussianCloud::default();
        }
        report.skip("gaussians_not_finite", loaded.dropped_non_finite as u64);
        report.skip("gaussians_over_capacity", loaded.dropped_over_capacity as u64);
        Ok(loaded.loaded)
    }

    /// Writes the Gaussians as they are now as a checkpoint; how many there are.
    pub(crate) fn write(&mut self, disk: &Disk, path: &Path, header: &ModelHeader) -> Result<usize, EngineError> {
        if self.in_pieces && self.has_model() {
            return save(&mut self.trainer, disk, path, header);
        }
        if self.has_model() && !self.is_average() {
            self.trainer.snapshot(&mut self.cloud)?;
        }
        told(Plausible::of(&self.cloud.means).mend(&mut self.cloud));
        model::write_checkpoint(disk, path, header, &self.cloud)?;
        Ok(self.cloud.len())
    }

    /// Means of the model as of the last checkpoint; of one in pieces, every so many, at most `most`.
    pub(crate) fn means(&mut self, most: usize) -> Result<Vec<[f32; 3]>, EngineError> {
        if !self.in_pieces {
            return Ok(self.cloud.means.clone());
        }
        Ok(pieces::means(&mut self.trainer, most)?)
    }
}
