//! A scene that the host's memory does not hold: its Gaussians come out of a model's file and go into the next one piece by piece, and lie in
//! the trainer's file of cells in between.

use std::cell::Cell;
use std::io;
use std::path::Path;

use disk::Disk;
use models::cloud::GaussianCloud;
use models::formats::model::{self, Chunks, ModelHeader};
use vulkan::trainer::{LoadReport, TrainError, Trainer};

use super::{EngineSettings, Reconstruction, model_path};
use crate::error::EngineError;

/// The model that an earlier run left.
pub(super) enum Earlier {
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

/// Whether the Gaussians of such a job are together in the trainer's file only: what a flight builds anew, and what is rounded as a whole, is
/// in memory.
pub(super) fn is_in_pieces(settings: &EngineSettings, trainer: &Trainer) -> bool {
    trainer.plan().is_paged() && !settings.incremental && settings.delivers.is_none()
}

/// Why a model is not written.
enum NotWritten {
    Trainer(TrainError),
    Disk(io::Error),
}

impl From<TrainError> for NotWritten {
    fn from(e: TrainError) -> Self {
        Self::Trainer(e)
    }
}

/// Gives the Gaussians of a model to the trainer, of which the host holds a piece at a time.
///
/// # Errors
/// The model is damaged or cannot be read any more; those of [`Trainer::load_pieces`].
pub fn load(trainer: &mut Trainer, model: &Chunks) -> Result<LoadReport, EngineError> {
    let left_out = Cell::new(0);
    let loaded = trainer.load_pieces::<EngineError>(&|take| {
        left_out.set(model.each(take)?);
        Ok(())
    })?;
    Ok(LoadReport { dropped_non_finite: loaded.dropped_non_finite + left_out.get() as usize, ..loaded })
}

/// Writes the trainer's Gaussians as a checkpoint, of which the host holds a piece at a time; how many there are.
///
/// # Errors
/// The device cannot be read, the file of the cells neither, or the disk not written; the file written before stays.
pub fn save(trainer: &mut Trainer, disk: &Disk, path: &Path, header: &ModelHeader) -> Result<usize, EngineError> {
    let (count, sh_degree) = (trainer.gaussians(), trainer.plan().sh_degree);
    let mut failed = None;
    let mut pieces = |write: &mut dyn FnMut(&GaussianCloud) -> io::Result<()>| {
        let written = trainer.each_piece::<NotWritten>(&mut |piece| write(piece).map_err(NotWritten::Disk));
        written.map_err(|e| match e {
            NotWritten::Disk(e) => e,
            NotWritten::Trainer(e) => {
                let said = io::Error::other(e.to_string());
                failed = Some(e);
                said
            }
        })
    };
    let written = model::write_checkpoint_pieces(disk, path, header, (count, sh_degree), &mut pieces);
    match (failed, written) {
        (Some(e), _) => Err(e.into()),
        (None, written) => Ok(written.map(|()| count)?),
    }
}

impl Reconstruction {
    /// Training begins with the Gaussians of this model, as they are.
    pub fn begin_with(&mut self, model: Chunks) {
        self.first = Some(model);
    }

    /// The model of an earlier run in `out`, read as a whole or to be read piece by piece.
    pub(super) fn earlier(&self, out: &Path) -> Result<Option<Earlier>, EngineError> {
        let (disk, path) = (&self.settings.disk, model_path(out));
        Ok(match self.in_pieces {
            true => model::open_checkpoint(disk, &path)?.map(Earlier::Pieces),
            false => model::read_checkpoint(disk, &path)?.map(|(header, cloud)| Earlier::Whole(header, cloud)),
        })
    }

    /// Gives the trainer the Gaussians that it begins with.
    pub(super) fn load_first(&mut self) -> Result<LoadReport, EngineError> {
        let loaded = match self.first.take() {
            Some(model) => load(&mut self.trainer, &model)?,
            None => self.trainer.load(&self.cloud)?,
        };
        // The trainer has the Gaussians: a scene in pieces is not kept beside it.
        if self.in_pieces {
            self.cloud = GaussianCloud::default();
        }
        Ok(loaded)
    }

    /// Writes the trained Gaussians as a checkpoint; how many there are.
    pub(super) fn write_pieces(&mut self, path: &Path) -> Result<usize, EngineError> {
        save(&mut self.trainer, &self.settings.disk, path, &self.header)
    }

    /// Means of the model as of the last checkpoint; of one in pieces, every so many, at most `most`.
    ///
    /// # Errors
    /// The device cannot be read, or the file of the cells.
    pub fn means(&mut self, most: usize) -> Result<Vec<[f32; 3]>, EngineError> {
        if !self.in_pieces {
            return Ok(self.cloud.means.clone());
        }
        let (every, mut at, mut means) = (self.trainer.gaussians().div_ceil(most).max(1), 0, Vec::new());
        self.trainer.each_piece::<TrainError>(&mut |piece| {
            means.extend(piece.means.iter().skip((every - at % every) % every).step_by(every));
            at += piece.len();
            Ok(())
        })?;
        Ok(means)
    }
}

#[cfg(test)]
mod tests;
