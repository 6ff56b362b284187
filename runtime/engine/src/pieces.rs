//! A scene that the host's memory does not hold: its Gaussians come out of a model's file and go into the next one piece by piece, and lie in
//! the trainer's file of cells in between.

use std::cell::Cell;
use std::io;
use std::path::Path;

use disk::Disk;
use models::cloud::GaussianCloud;
use models::formats::model::{self, Chunks, ModelHeader};
use vulkan::trainer::{LoadReport, TrainError, Trainer};

use crate::error::EngineError;

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

#[cfg(test)]
mod tests;
