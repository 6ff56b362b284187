//! The ground's work: local models in, one global model out (the paper's §Model Aggregation).
//!
//! Bring every model into one frame → keep of each what its aircraft answers for → unite → let every aircraft's own
//! model teach the union how its own training views look, where regions meet. Pictures are never needed. These algorithms know
//! nothing of files or processes; [`jobs`] are what is done with them: what is global is planned first, the rest is done square by
//! square of ground, each a pure job that any machine may do, and what they come to is put together.

use std::path::{Path, PathBuf};

use config::error::{Error, ErrorKind};
use models::cloud::GaussianCloud;
use models::formats::model::{self, ModelHeader};
use vulkan::trainer::TrainError;

use store::StoreError;

#[cfg(test)]
#[cfg(feature = "zenoh")]
#[path = "../../../tests/bad_link.rs"]
#[allow(dead_code, reason = "all of it is used where links are tested")]
mod bad_link;
pub mod block;
#[cfg(test)]
#[path = "../../../tests/carpet.rs"]
mod carpet;
pub mod compare;
pub mod distil;
pub mod frame;
mod hold;
pub mod jobs;
pub mod light;
pub mod member;
pub mod merge;
pub mod plan;
pub mod region;
pub mod register;
pub mod seam;
pub mod squares;
pub mod store;
#[cfg(test)]
mod testing;
pub mod visibility;

/// One aircraft's model as it arrived.
#[derive(Clone, Debug)]
pub struct LocalModel {
    /// Where it was read from.
    pub path: PathBuf,
    /// What it says about itself.
    pub header: ModelHeader,
    /// Its Gaussians.
    pub cloud: GaussianCloud,
    /// BLAKE3 of the file.
    pub content: [u8; 32],
}

impl LocalModel {
    /// Reads and verifies a model file.
    ///
    /// # Errors
    /// Unreadable, damaged, or not a model.
    pub fn read(path: &Path) -> Result<Self, AggregateError> {
        let (header, cloud, content) = model::read_with_hash(path)?;
        Ok(Self { path: path.into(), header, cloud, content })
    }
}

/// Why no global model could be made.
#[derive(Debug, thiserror::Error)]
pub enum AggregateError {
    /// A model file cannot be read or written.
    #[error(transparent)]
    Format(#[from] models::formats::FormatError),
    /// Nothing to merge.
    #[error("no models to merge; give at least one .dgtr file")]
    NoModels,
    /// Some models are georeferenced and this one is not.
    #[error("{0}: has no (valid) WGS-84 origin while other models have one; all or none must")]
    NoOrigin(String),
    /// Models of different places.
    #[error("{name}: its origin lies {km:.1} km from the others'; are these models of one mission?")]
    TooFar {
        /// Whose.
        name: String,
        /// How far.
        km: f64,
    },
    /// Another model lies under the name of one that was counted already.
    #[error("{0}: was replaced while it was being merged; run the command again")]
    Changed(String),
    /// The plan, the models' pieces or the cells.
    #[error(transparent)]
    Store(#[from] StoreError),
    /// More than a plan can have.
    #[error("more than {most} {what} to merge; merge fewer models, or in larger squares (ground.cell_m)")]
    TooMany {
        /// Of what.
        what: &'static str,
        /// The bound.
        most: usize,
    },
    /// Not all cells have been made yet.
    #[error("{count} of {of} cells are missing: {named}; run `dgtr ground cell` for them, then join again")]
    MissingCells {
        /// The first of them.
        named: String,
        /// How many.
        count: usize,
        /// Of how many.
        of: usize,
    },
    /// No cell of the plan has this key.
    #[error("{0}: is no cell of this plan; `dgtr ground plan` prints those there are")]
    NoCell(String),
    /// The plan was made by a dgtr that makes cells in another way.
    #[error("{0}: the plan names it otherwise than this dgtr would; use one dgtr for plan and cells")]
    OtherCell(String),
    /// Distillation does not fit into `ground.device_mib`.
    #[error("ground: {0}")]
    Plan(#[from] config::plan::PlanError),
    /// The device or the trainer.
    #[error(transparent)]
    Train(#[from] TrainError),
}

impl Error for AggregateError {
    fn kind(&self) -> ErrorKind {
        match self {
            Self::Format(e) => e.kind(),
            Self::Train(e) => e.kind(),
            Self::Store(e) => e.kind(),
            Self::Changed(_) | Self::MissingCells { .. } => ErrorKind::Failed,
            Self::NoModels
            | Self::NoOrigin(_)
            | Self::TooFar { .. }
            | Self::TooMany { .. }
            | Self::NoCell(_)
            | Self::OtherCell(_)
            | Self::Plan(_) => ErrorKind::Input,
        }
    }
}
