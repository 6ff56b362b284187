//! A scene that the host's memory does not hold: its Gaussians come out of a model's file and go into the next one piece by piece, and lie in
//! the trainer's file of cells in between.

use std::cell::Cell;
use std::io;
use std::path::Path;

use disk::Disk;
use models::cloud::{GaussianCloud, Plausible};
use models::formats::model::{self, Chunks, ModelHeader};
use vulkan::trainer::{LoadReport, TrainError, Trainer};

use crate::error::EngineError;

/// Means by which the size of a scene is told.
const SAMPLE: usize = 4096;

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

/// Says how many values of a model were mended.
pub(crate) fn told(mended: usize) {
    if mended > 0 {
        tracing::warn!(
            "{mended} values that no scene has, as flipped bits of memory leave them, are mended in the model"
        );
    }
}

/// Means of the trainer's Gaussians: every so many, at most `most`.
///
/// # Errors
/// Errors of [`Trainer::each_piece`].
pub(crate) fn means(trainer: &mut Trainer, most: usize) -> Result<Vec<[f32; 3]>, TrainError> {
    let (every, mut at, mut means) = (trainer.gaussians().div_ceil(most).max(1), 0, Vec::new());
    trainer.each_piece::<TrainError>(&mut |piece| {
        means.extend(piece.means.iter().skip((every - at % every) % every).step_by(every));
        at += piece.len();
        Ok(())
    })?;
    Ok(means)
}

/// Gives the Gaussians of a model to the trainer, of which the host holds a piece at a time.
///
/// # Errors
/// The model is damaged or cannot be read any more; those of [`Trainer::load_pieces`].
pub fn load(trainer: &mut Trainer, model: &Chunks) -> Result<LoadReport, EngineError> {
    let (left_out, mended) = (Cell::new(0), Cell::new(0));
    let plausible = Plausible::of(&model.sample(SAMPLE)?.means);
    let loaded = trainer.load_pieces::<EngineError>(&|take| {
        mended.set(0);
        left_out.set(model.each(&mut |piece: &mut GaussianCloud| {
            mended.update(|n| n + plausible.mend(piece));
            take(piece)
        })?);
        Ok(())
    })?;
    told(mended.get());
    Ok(LoadReport { dropped_non_finite: loaded.dropped_non_finite + left_out.get() as usize, ..loaded })
}

/// Writes the trainer's Gaussians as a checkpoint, of which the host holds a piece at a time; how many there are.
///
/// # Errors
/// The device cannot be read, the file of the cells neither, or the disk not written; the file written before stays.
pub fn save(trainer: &mut Trainer, disk: &Disk, path: &Path, header: &ModelHeader) -> Result<usize, EngineError> {
    let (count, sh_degree) = (trainer.gaussians(), trainer.plan().sh_degree);
    let plausible = Plausible::of(&means(trainer, SAMPLE)?);
    let (mut failed, mut mended) = (None, 0);
    let mut pieces = |write: &mut dyn FnMut(&GaussianCloud) -> io::Result<()>| {
        mended = 0;
        let written = trainer.each_piece::<NotWritten>(&mut |piece| {
            mended += plausible.mend(piece);
            write(piece).map_err(NotWritten::Disk)
        });
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
    told(mended);
    match (failed, written) {
        (Some(e), _) => Err(e.into()),
        (None, written) => Ok(written.map(|()| count)?),
    }
}

#[cfg(test)]
mod tests;
