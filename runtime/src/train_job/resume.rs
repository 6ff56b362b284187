//! Taking up a model that an earlier run left in the output folder.

use std::collections::HashSet;

use models::cloud::GaussianCloud;
use models::dataset::Dataset;
use models::formats::model::{self, ModelHeader};

use super::TrainJob;
use super::start::Posed;
use crate::cli::CliError;

/// A model to continue.
pub(super) struct Resumed {
    pub header: ModelHeader,
    pub cloud: GaussianCloud,
}

impl Resumed {
    /// Poses as they were at the last checkpoint.
    pub fn posed(&self) -> Posed {
        let poses = self.header.views.iter().map(|(name, view)| (name.clone(), view.pose)).collect();
        Posed { poses, ..Default::default() }
    }
}

impl TrainJob {
    /// The model in `out` when it is of the same pictures and holds Gaussians; a model of other pictures is an error
    /// rather than overwritten.
    pub(super) fn resume(&self, set: &Dataset, frames: &[usize]) -> Result<Option<Resumed>, CliError> {
        let path = self.model_path();
        if self.fresh || !path.is_file() {
            return Ok(None);
        }
        let (header, cloud) = model::read(&path)?;
        if cloud.is_empty() {
            return Ok(None);
        }
        let names: HashSet<&str> = header.views.iter().map(|(n, _)| n.as_str()).collect();
        let wanted: HashSet<&str> = frames.iter().map(|&i| set.frames[i].name.as_str()).collect();
        if names != wanted {
            return Err(CliError::input(format!(
                "{}: was trained on other pictures; give another --out, or --fresh to replace it",
                path.display()
            )));
        }
        tracing::info!("continuing {} after {} steps", path.display(), header.steps);
        Ok(Some(Resumed { header, cloud }))
    }
}
